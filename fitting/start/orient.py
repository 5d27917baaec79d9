"""Normals of points that have none, and which way is out. On the host."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

from ..scan.closest_points import nearest_rows
from ..scan.outliers import covariances

_NEIGHBOURS = 16


def plane_fits(
    points: Float[np.ndarray, "p 3"], k: int = _NEIGHBOURS
) -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, "p"], Int[np.ndarray, "p k"]]:
    """Of every point and its `k` nearest: the normal of their plane, how far they lie off it (rms), and their rows."""
    _, rows = nearest_rows(KDTree(points), points, min(k, len(points)))
    values, axes = np.linalg.eigh(covariances(points, rows))
    return axes[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0)), rows


def orient(
    points: Float[np.ndarray, "p 3"],
    normals: Float[np.ndarray, "p 3"],
    neighbours: Int[np.ndarray, "p k"],
    across_creases: bool = True,
) -> Float[np.ndarray, "p 3"]:
    """Normals turned so that neighbours agree, and then outwards.

    Agreement spreads along the spanning tree of neighbours whose planes are most alike; every part of the tree is
    turned so that it encloses volume rather than lacks it.

    Args:
        points: positions.
        normals: unit, of either sign.
        neighbours: rows of the nearest points, each point's own first.
        across_creases: mirror a normal at the line from point to point before it is compared, which is right on spheres
            and at creases that are seen well; False compares the normals as they are.

    Source: Hoppe et al. 1992, section 3.3; Xie et al. 2003 for the mirror.
    """
    n, k = neighbours.shape
    a, b = np.repeat(np.arange(n), k - 1), neighbours[:, 1:].ravel()
    line = points[b] - points[a]
    square = np.maximum(np.einsum("ex,ex->e", line, line), np.finfo(float).tiny)
    mirrored = 2.0 * across_creases * (np.einsum("ex,ex->e", normals[a], line) / square)[:, None] * line
    agree = np.einsum("ex,ex->e", normals[a] - mirrored, normals[b])
    cost = 1.0001 - np.abs(agree)
    # Every pair once: both directions would be summed, which makes the cost of mutual neighbours double.
    low, high = np.minimum(a, b), np.maximum(a, b)
    _, first = np.unique(low.astype(np.int64) * n + high, return_index=True)
    low, high, cost, flips = low[first], high[first], cost[first], agree[first] < 0
    tree = minimum_spanning_tree(coo_matrix((cost, (low, high)), shape=(n, n)).tocsr())
    flip = csr_matrix((flips + 1.0, (low, high)), shape=(n, n))
    part, label = connected_components(tree, directed=False)
    signs = np.ones(n)
    for i in range(part):
        start = int(np.flatnonzero(label == i)[0]) if part < 2000 else i
        order, before = breadth_first_order(tree, start, directed=False)
        if len(order) < 2:
            continue
        child, parent = order[1:], before[order[1:]]
        turned = np.asarray(flip[np.minimum(child, parent), np.maximum(child, parent)]).ravel() > 1.5
        for c, p, t in zip(child.tolist(), parent.tolist(), turned.tolist(), strict=True):
            signs[c] = -signs[p] if t else signs[p]
        x = points[order] - points[order].mean(axis=0)
        if np.sum(x * normals[order] * signs[order, None]) < 0:
            signs[order] *= -1
    return normals * signs[:, None]


def find_flipped(normals: Float[np.ndarray, "p 3"], against: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, "p"]:
    """Which normals point against the other ones."""
    return np.einsum("px,px->p", normals, against) < 0
