"""The surface seen from the scan: where there are points, how far the surface lies from them, and where it is worst."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

import jaxsubdiv as js

from ..model.pairing import Look
from ..scan.closest_points import nearest_rows

_NEAREST = 8  # scan points that make a local mean or median
_REACH = 5.0  # times the usual distance from a paired place to the next: so far the scan covers the surface around one
_LEAST_COSINE = 0.5  # between normals: beyond 60 degrees a point belongs to the other side of something thin
_CENTRES, _NEAR_PLACE = 5_000, (9, 200)  # places that are looked at, and the points that tell of each
_MANY = 100_000  # of more points an even part tells as much of spacings and local medians


class Place(NamedTuple):
    """A place of the surface, and how far the scan lies from it there."""

    position: Float[np.ndarray, "3"]
    """On the surface, in mm."""
    distance: float
    """Median signed distance of the nearest scan points in mm, positive outside."""
    n_points: int
    """Scan points within half a control edge."""


def distances_to_scan(surface: js.RefinedSurface, seen: Look, inliers: Bool[np.ndarray, "p"]) -> Float[np.ndarray, "v"]:
    """Signed distance in mm from every vertex of the surface to the scan, positive where the scan lies outside.

    The mean signed distance of the eight inliers on the same side that are paired with places nearest to the vertex.
    To the nearest point alone it would say how far apart the points are, and to a plane through them how curved the
    scan is between them. NaN where the scan does not cover the surface: where no such place is nearer than five times
    the usual distance from one to the next.
    """
    vertices, normals = np.asarray(surface.vertices, np.float64), unit(np.asarray(surface.normals, np.float64))
    feet, sides = take_at_pairs(vertices, seen)[inliers], unit(take_at_pairs(normals, seen))[inliers]
    if not len(feet):
        return np.full(len(vertices), np.nan)
    tree = KDTree(feet)
    away, nearest = nearest_rows(tree, vertices, min(_NEAREST, len(feet)))
    same = np.einsum("vkx,vx->vk", sides[nearest], normals) > _LEAST_COSINE
    covered = (same & (away <= _REACH * _spacing(tree, feet))).any(axis=1)
    mean = np.sum(same * np.asarray(seen.distances, np.float64)[inliers][nearest], axis=1) / np.maximum(
        same.sum(axis=1), 1
    )
    return np.where(covered, mean, np.nan)


def worst_places(
    surface: js.RefinedSurface, seen: Look, distances: Float[np.ndarray, "p"], edge: float, n: int = 5
) -> list[Place]:
    """Where the scan lies farthest from the surface, by the median of the nearest points: one outlier makes no place.

    As many points count as lie within a quarter of a control edge on average, from 9 to 200.

    Args:
        edge: length of a control edge in mm; places are at least so far apart.
        n: how many at most.
    """
    on = take_at_pairs(np.asarray(surface.vertices, np.float64), seen)
    many, centres = (slice(None, None, -(-len(on) // most)) for most in (_MANY, _CENTRES))
    a_disc = np.pi * (edge / 4) ** 2 / float(surface.areas().sum())
    k = min(int(np.clip(len(on[many]) * a_disc, *_NEAR_PLACE)), len(on[many]))
    near = nearest_rows(KDTree(on[many]), on[centres], k)[1]
    median = np.median(distances[many][near], axis=1)
    left, places = np.abs(median), []
    while len(places) < n and left.max() >= 0:
        worst = int(np.argmax(left))
        position = on[centres][worst]
        n_points = int(np.sum(np.linalg.norm(on - position, axis=1) <= edge / 2))
        places.append(Place(position, float(median[worst]), n_points))
        left[np.linalg.norm(on[centres] - position, axis=1) < edge] = -1
    return places


def weighted_quantile(values: Float[np.ndarray, "n"], weights: Float[np.ndarray, "n"], q: float) -> float:
    """The least value that at least a part `q` of all weight does not exceed."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, q * total[-1]), len(values) - 1)])


def _spacing(tree: KDTree, points: Float[np.ndarray, "p 3"]) -> float:
    """Median distance from a point to the next one that does not lie on it."""
    some = points[:: -(-len(points) // _MANY)]
    away = nearest_rows(tree, some, min(2, len(points)))[0][:, -1]
    return float(np.median(away[away > 0])) if np.any(away > 0) else 0.0


def take_at_pairs(values: Float[np.ndarray, "v 3"], seen: Look) -> Float[np.ndarray, "p 3"]:
    """Values at the surface points that are paired with the scan."""
    weights = np.asarray(seen.pairs.corner_weights, np.float64)
    return np.einsum("pk,pkx->px", weights, values[np.asarray(seen.pairs.corners)])


def unit(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Rows of length 1; zero stays zero."""
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(float).tiny)
