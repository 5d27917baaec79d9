"""What a sweep needs to know of the scan: pairs, their weights, and the noise that the distances show."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxsubdiv as js
from jaxsubdiv._linalg import dot, norm
from jaxsubdiv._surface import corner_weights

from ._correspondence import closest_points
from ._residuals import Correspondence
from ._robust import AbstractLoss, noise_scale
from ._scan import Scan

_BOUNDARY_SCALE = 1 / 3  # least scale of the loss at an open boundary, in control edges
_ON_BOUNDARY = 1e-3  # how far, in parts of a face, a surface point may lie from a boundary and count as on it


class Look(NamedTuple):
    """The scan as seen from one surface; lengths in mm."""

    at: js.SurfacePoint
    """The surface point closest to every scan point."""
    pairs: Correspondence
    distances: Float[Array, "p"]
    """Signed, positive outside."""
    weights: Float[Array, "p"]
    scale: Float[Array, ""]
    """Of the robust loss: the noise, or what the annealing keeps it at."""
    rms: Float[Array, ""]
    robust_rms: Float[Array, ""]


def look(
    surface: js.RefinedSurface,
    scan: Scan,
    open_vertices: Bool[np.ndarray, "v"],
    edge: float,
    loss: AbstractLoss,
    floor: float,
) -> Look:
    """Pair every scan point with the closest point of the surface, and weigh the pairs by how far apart they lie.

    Args:
        open_vertices: which vertices of the surface lie on a boundary.
        edge: length of a control edge in mm.
        loss: how a point loses weight with its distance.
        floor: the least scale of the loss in mm.
    """
    at = closest_points(surface, np.asarray(scan.points))
    return _measure(surface, scan, at, open_vertices, edge, loss, jnp.asarray(floor, scan.points.dtype))


@jax.jit
def _measure(
    surface: js.RefinedSurface,
    scan: Scan,
    at: js.SurfacePoint,
    open_vertices: Bool[Array | np.ndarray, "v"],
    edge: float | Float[Array, ""],
    loss: AbstractLoss,
    floor: Float[Array, ""],
) -> Look:
    on, normals = js.evaluate(surface, at)
    away = scan.points - on
    distance, given = norm(away)[:, 0], scan.weights_or_ones()
    corners, inside = corner_weights(surface, at)
    at_boundary = jnp.sum(jnp.where(open_vertices[corners], inside, 0.0), axis=1) > 1 - _ON_BOUNDARY
    # Beyond a boundary the distance runs along the surface, and says nothing of the noise across it.
    counted = jnp.where(at_boundary, 0.0, given)
    scale = jnp.maximum(noise_scale(distance, counted), floor)
    # Near a boundary the surface may have to grow, by up to a control edge: what is farther is not covered by the mesh.
    at_its_scale = jnp.where(at_boundary, jnp.maximum(scale, edge * _BOUNDARY_SCALE), scale)
    weights = given * loss.weight(distance / jnp.maximum(at_its_scale, jnp.finfo(scale.dtype).tiny))
    weights = jnp.where(at_boundary & (distance > edge), 0.0, weights)
    return Look(
        at=at,
        pairs=Correspondence(scan.points, corners, inside, normals, weights / jnp.mean(weights), at_boundary),
        distances=jnp.where(dot(normals, away)[:, 0] < 0, -distance, distance),
        weights=weights,
        scale=scale,
        rms=jnp.sqrt(jnp.average(distance**2, weights=given)),
        robust_rms=jnp.sqrt(jnp.average(distance**2, weights=weights)),
    )
