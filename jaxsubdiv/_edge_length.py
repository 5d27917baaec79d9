"""The usual length of a control edge, by which lengths are judged."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._topology import Topology
from .linalg import norm, take


def edge_length(topology: Topology, vertices: Float[Array, "v 3"]) -> Float[Array, ""]:
    """Root mean square length of the sides of the control faces."""
    sides = []
    for faces in topology.control_faces.values():
        corners = take(vertices, faces)
        sides.append((norm(jnp.roll(corners, -1, axis=1) - corners) ** 2).reshape(-1))
    return jnp.sqrt(jnp.mean(jnp.concatenate(sides)))
