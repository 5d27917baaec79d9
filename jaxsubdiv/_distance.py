"""Closest points on a triangle mesh, on the host."""

import numpy as np
from jaxtyping import Float, Int


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
        found = _to_triangles(points[left][:, None], corners[candidates])
        best = found.argmin(axis=1)
        rows = np.arange(len(left))
        distance[left], nearest[left] = found[rows, best], candidates[rows, best]
        # A triangle that was not tried is farther than its middle less its size.
        settled = (distance[left] <= to_middle[:, -1] - reach) | (k == len(corners))
        left, k = left[~settled], min(4 * k, len(corners))
    return distance, nearest


def _to_triangles(p: Float[np.ndarray, "p 1 3"], corners: Float[np.ndarray, "p k 3 3"]) -> Float[np.ndarray, "p k"]:
    """Distance from points to triangles: to the plane where the foot lies inside, else to the nearest side."""
    a, b, c = np.moveaxis(corners, 2, 0)
    normal = np.cross(b - a, c - a)
    square = np.einsum("...x,...x", normal, normal)
    safe = np.where(square > 0, square, 1)
    least, inside = np.inf, square > 0
    for start, end in ((a, b), (b, c), (c, a)):
        side, to = end - start, p - start
        length = np.einsum("...x,...x", side, side)
        at = np.clip(np.einsum("...x,...x", to, side) / np.where(length > 0, length, 1), 0, 1)
        least = np.minimum(least, np.linalg.norm(to - at[..., None] * side, axis=-1))
        inside = inside & (np.einsum("...x,...x", np.cross(side, to), normal) >= 0)
    above = np.abs(np.einsum("...x,...x", p - a, normal)) / np.sqrt(safe)
    return np.where(inside, above, least)
