"""Control edges keep their length along the surface, so that control vertices stay in their places."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import dot, norm, take, unit

from ..procrustes import align_shape
from ..unknowns import AnyArray
from .base import AbstractFacePrior, Place, Start


class Stretch(AbstractFacePrior):
    """The change of a control edge along the surface, against the template, as a part of the edge's length.

    Attributes:
        edges: control edges.
        of_edges: a control face of each.
        deviation: standard deviation of a change.
    """

    name: ClassVar[str] = "stretch"
    edges: Int[Array | np.ndarray, "e 2"]
    of_edges: Int[np.ndarray, "e"]
    deviation: Float[Array | np.ndarray, ""]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "Stretch":
        edges, faces = js.control_edges(start.topology)
        return cls(edges, faces, priors.stretch)

    def hold(
        self, place: Place, strengths: dict[str, Any]
    ) -> tuple[Float[Array, "e 3"], Float[Array, "e 3"], Float[Array, "e 1"]]:
        """The template's edges, moved along with the mesh; directions across the surface; and lengths."""
        moved = align_shape(place.template, place.control.vertices, jnp)
        a, b = jnp.asarray(self.edges).T
        normals = place.control.normals
        across = unit(take(normals, a) + take(normals, b))
        before = take(moved, b) - take(moved, a)
        length = jnp.maximum(norm(before), 1e-3 * js.edge_length(place.topology, moved))
        return before, across, length

    def rows(self, place: Place, held: tuple[Array, Array, Array]) -> Float[Array, "m"]:
        """Three a control edge."""
        before, across, length = held
        a, b = jnp.asarray(self.edges).T
        change = take(place.control.vertices, b) - take(place.control.vertices, a) - before
        return ((change - dot(across, change) * across) / length).reshape(-1)

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return self.deviation**-2

    def faces(self, held: Any) -> Int[AnyArray, "m"]:
        return np.repeat(self.of_edges, 3)
