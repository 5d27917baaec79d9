"""Closest points on a triangle mesh, on the host."""

import numpy as np
from jaxtyping import Float, Int

from .closest import triangle_distance


def closest_on_mesh(
    points: Float[np.ndarray, "p 3"], corners: Float[np.ndarray, "t 3 3"], first: int = 16
) -> tuple[Float[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """Distance of every point from a mesh, and the triangle that is closest. Exact.

    Args:
        points: from where.
        corners: of the triangles.
        first: how many triangles with the nearest middles are tried first; more where that does not settle it.
    """
    from scipy.spatial import KDTree  # here and not above: refining never needs it

    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max()
    tree = KDTree(middles)
    distance, nearest = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    left, k = np.arange(len(points)), min(first, len(corners))
    while len(left):
        found_at = tree.query(points[left], k=k)
        to_middle, candidates = (np.reshape(rows, (len(left), k)) for rows in found_at)  # one axis less for k = 1
        a, b, c = np.moveaxis(corners[candidates], (2, 3), (0, 1))
        found = np.sqrt(triangle_distance(a, b - a, c - a, points[left].T[..., None])[0])
        best = found.argmin(axis=1)
        rows = np.arange(len(left))
        distance[left], nearest[left] = found[rows, best], candidates[rows, best]
        # A triangle that was not tried is farther than its middle less its size.
        settled = (distance[left] <= to_middle[:, -1] - reach) | (k == len(corners))
        left, k = left[~settled], min(4 * k, len(corners))
    return distance, nearest
