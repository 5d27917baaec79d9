"""Points that belong to no surface: told from the rest by how thinly they lie. On the host."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from .closest_points import nearest_rows

NEIGHBOURS = 10
# 95 % and more of the points in a ball have neighbours so thick, of the sparse points of a hand-traced head 7 %.
_AROUND, _THICK = 16, 1 / 3
_FEW_REPEATS = 0.9
_LOW = 0.2  # with 60 % of outliers a third of the surface's own points still lies below this quantile


def dense_points(points: Float[np.ndarray, "p 3"], spread: float = 1.7) -> Bool[np.ndarray, "p"]:
    """Points whose neighbours are about as near as those of the denser part: on a surface, not scattered in space.

    Args:
        points: positions in any one unit.
        spread: how many times farther than the lower fifth of all points a point may have its tenth neighbour. On a
            surface of even density that distance varies by a fifth; scattered points have theirs twice as far, even
            where they are most of the scan.
    """
    return is_dense(neighbour_distance(points), spread)


def is_dense(distance: Float[np.ndarray, "p"], spread: float = 1.7) -> Bool[np.ndarray, "p"]:
    """The same of points whose distances to their tenth neighbours are known."""
    if len(distance) <= 2 * NEIGHBOURS:
        return np.ones(len(distance), bool)
    return distance <= spread * max(np.quantile(distance, _LOW), np.finfo(float).tiny)


def scattered_points(points: Float[np.ndarray, "p 3"], dense: Bool[np.ndarray, "p"]) -> Bool[np.ndarray, "p"]:
    """Points that lie as thinly as outliers do and, unlike those of a sparse part of a surface, in no plane or line.

    Args:
        points: positions in any one unit.
        dense: see `dense_points`.
    """
    sparse = np.flatnonzero(~dense)
    scattered = np.zeros(len(points), bool)
    if len(sparse):
        _, rows = nearest_rows(KDTree(points), points[sparse], min(_AROUND + 1, len(points)))
        spread = np.linalg.eigvalsh(covariances(points, rows))
        scattered[sparse] = spread[:, 0] > _THICK**2 * spread[:, 2]
    return scattered


def covariances(points: Float[np.ndarray, "p 3"], near: Int[np.ndarray, "q k"]) -> Float[np.ndarray, "q 3 3"]:
    """How neighbourhoods, given by the rows of their points, spread about their middles."""
    around = points[near]
    around = around - around.mean(axis=1, keepdims=True)
    return np.einsum("qka,qkb->qab", around, around, optimize=True) / near.shape[1]


def neighbour_distance(points: Float[np.ndarray, "p 3"], k: int = NEIGHBOURS) -> Float[np.ndarray, "p"]:
    """Distance of every point to its `k`-th neighbour, in the unit of the points."""
    return nearest_rows(KDTree(points), points, min(k + 1, len(points)))[0][:, -1]


def first_of_each(points: Float[np.ndarray, "p 3"]) -> Int[np.ndarray, "q"]:
    """Rows of the points without repeats: those would be each other's neighbours, and make all others seem thin."""
    return np.sort(np.unique(points, axis=0, return_index=True)[1])


def rows_for_density(points: Float[np.ndarray, "p 3"]) -> Int[np.ndarray, "q"]:
    """All rows, or those of the points without repeats where these are a tenth or more: few change no density."""
    rows = first_of_each(points)
    return rows if len(rows) < _FEW_REPEATS * len(points) else np.arange(len(points))


def one_a_cell(points: Float[np.ndarray, "p 3"], cell: float) -> Int[np.ndarray, "c"]:
    """Row of the first point in every cell of a cubic grid that holds any: evens out the density.

    Args:
        points: positions in any one unit.
        cell: side of a cell in that unit.
    """
    key = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    width = key.max(axis=0) + 1
    return np.sort(np.unique((key[:, 0] * width[1] + key[:, 1]) * width[2] + key[:, 2], return_index=True)[1])
