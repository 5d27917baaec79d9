"""The outside of a scan of something hollow, such as a skull with an inner table: the points that can be seen."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from .closest_points import nearest_rows
from .scan import Scan, ScanError

_VIEWS, _LEAST_VIEWS = 60, 5  # from all around; from fewer, points inside are seen too, through openings
_CELL, _DEPTH = 3.0, 2.0  # of a view, in distances between points; how far behind the foremost one, in cells
_LEAST_COSINE = 0.3  # between a normal and the line of sight
_SAMPLE = 20_000  # points whose neighbours tell the distance between points


def choose_outside(scan: Scan) -> Scan:
    """The points of a scan that are seen from outside: that face the eye and lie foremost, in five of sixty views.

    Args:
        scan: with outward normals, or with faces that run counter-clockwise as seen from outside.

    Returns:
        The scan with these points alone.

    Raises:
        ScanError: the scan has neither normals nor faces, or hardly a point is seen: its normals may point inward.
    """
    points, normals = np.asarray(scan.points, np.float64), _find_normals(scan)
    some = points if len(points) <= _SAMPLE else points[np.random.default_rng(0).choice(len(points), _SAMPLE, False)]
    # One of two nearest may be a repeated point.
    apart = nearest_rows(KDTree(points), some, min(3, len(points)))[0][:, -1]
    cell = _CELL * max(float(np.median(apart)), 1e-9 * float(np.ptp(points, axis=0).max())) or 1.0  # of a lone point
    seen = np.zeros(len(points), int)
    for view in _spread_views():
        seen += (normals @ view > _LEAST_COSINE) & _find_foremost(points, view, cell)
    chosen = seen >= _LEAST_VIEWS
    if chosen.mean() < 0.01:
        raise ScanError(
            f"of {len(points)} points {chosen.sum()} are seen from outside: do the normals, or the faces, point inward?"
        )
    return scan.rows(chosen)


def _find_normals(scan: Scan) -> Float[np.ndarray, "p 3"]:
    if scan.normals is not None:
        normals = np.asarray(scan.normals, np.float64)
    elif scan.faces is not None:
        points, normals = np.asarray(scan.points, np.float64), np.zeros((scan.n_points, 3))
        a, b, c = (points[scan.faces[:, k]] for k in range(3))
        for k in range(3):
            np.add.at(normals, scan.faces[:, k], np.cross(b - a, c - a))
    else:
        raise ScanError("the outside is chosen by normals or faces, and the scan has neither: give a mesh, or normals.")
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)


def _spread_views() -> Float[np.ndarray, "d 3"]:
    """Spread evenly over the sphere, along a spiral."""
    k = np.arange(_VIEWS)
    z, turn = 1 - 2 * (k + 0.5) / _VIEWS, np.pi * (3 - 5**0.5) * k
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _find_foremost(
    points: Float[np.ndarray, "p 3"], view: Float[np.ndarray, "3"], cell: float
) -> Bool[np.ndarray, "p"]:
    """Whether no other point lies before a point, in its cell of the view."""
    aside = np.cross(view, np.eye(3)[int(np.argmin(np.abs(view)))])
    aside /= np.linalg.norm(aside)
    cells = np.floor(np.stack([points @ aside, points @ np.cross(view, aside)], axis=1) / cell).astype(int)
    cells -= cells.min(axis=0)
    _, of_points = np.unique(cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1], return_inverse=True)
    towards = points @ view
    front = np.full(of_points.max() + 1, -np.inf)
    np.maximum.at(front, of_points, towards)
    return towards > front[of_points] - _DEPTH * cell
