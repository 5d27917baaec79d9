"""Boundary curves: where an open surface ends, as its boundary follows from points of the curve."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv.errors import name_rows
from jaxsubdiv.half_edges import half_edges
from jaxsubdiv.linalg import dot, take

from ...scan.closest_points import nearest_on_segments
from ...scan.scan import ScanError

_ON_CURVE = 1e-9  # in lengths of the boundary edge: a point that is nearer is on it, in no direction from it


class BoundaryCurve(NamedTuple):
    """Points of the curve that an open surface ends at, such as the rim of a valve or of the scanned surface."""

    points: Float[np.ndarray, "b 3"]
    """In mm, as many as there are, in any order; of the whole boundary of the surface or of a part of it."""
    deviation: float = 0.5
    """How far the boundary may be off each of them, as a standard deviation in mm."""


class Rim(NamedTuple):
    """Points of the curve, paired with the boundary of the surface as one sweep holds them."""

    points: Float[Array, "b 3"]
    face: Int[np.ndarray, "b"]
    """Of the surface."""
    ends: Int[Array, "b 2"]
    """Vertices of the boundary edge that each is paired with."""
    along: Float[Array, "b"]
    """Where on it, 0 to 1."""
    directions: Float[Array, "b 2 3"]
    """Two unit vectors across the boundary, which slides freely along itself."""
    deviation: Float[Array, ""]

    def rows(self, vertices: Float[Array, "w 3"]) -> Float[Array, "r"]:
        """Distances across the boundary over their standard deviation, two a point."""
        a, b = (take(vertices, end) for end in self.ends.T)
        away = a + self.along[:, None] * (b - a) - self.points
        return jnp.stack([dot(self.directions[:, i], away)[:, 0] for i in (0, 1)], axis=1).reshape(-1) / self.deviation


class _Sides(NamedTuple):
    start: Int[np.ndarray, "s"]
    end: Int[np.ndarray, "s"]
    face: Int[np.ndarray, "s"]


def boundary_of(mesh: js.ControlMesh | js.RefinedSurface) -> Float[np.ndarray, "b 3"]:
    """Where an open mesh ends: its boundary vertices, of all its holes too, in the unit of the mesh.

    Of a scan that is a surface: `BoundaryCurve(boundary_of(js.read_mesh("scan.ply")))`.

    Raises:
        ScanError: the mesh is closed.
    """
    start, end, _ = _boundary_sides(mesh.faces)
    rows = np.unique(np.concatenate([start, end]))
    if not len(rows):
        raise ScanError("the mesh is closed: it has no boundary to take points of.")
    return np.asarray(mesh.vertices, np.float64)[rows]


def checked_curve(curve: BoundaryCurve, topology: js.Topology) -> BoundaryCurve:
    """The curve as float64.

    Raises:
        ScanError: points are not finite positions, or the deviation is not positive.
        ValueError: the control mesh is closed.
    """
    points, deviation = np.asarray(curve.points, np.float64), float(curve.deviation)
    if points.ndim != 2 or points.shape[-1] != 3 or len(points) == 0:
        raise ScanError(f"`boundary` needs points of the shape [b, 3], at least one; got {list(points.shape)}.")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        raise ScanError(f"`boundary` points are not finite in rows {name_rows(np.flatnonzero(~finite))}. Drop them.")
    if not 0 < deviation < np.inf:
        raise ScanError(f"the deviation of `boundary` must be positive and finite; got {deviation}.")
    if not len(_boundary_sides(topology.control_faces).start):
        raise ValueError("the control mesh is closed: it has no boundary that could lie on the curve of `boundary`.")
    return BoundaryCurve(points, deviation)


def pair_with_boundary(curve: BoundaryCurve, surface: js.RefinedSurface) -> Rim:
    """Every point of the curve with the exactly closest point of the surface's boundary edges."""
    vertices = np.asarray(surface.vertices, np.float64)
    start, end, face = _boundary_sides(surface.faces)
    side, along = nearest_on_segments(vertices[start], vertices[end], curve.points)
    a, b = vertices[start[side]], vertices[end[side]]
    edge = b - a
    away = curve.points - (a + along[:, None] * edge)
    # The first direction is that of the distance: at a corner of the boundary it is not at right angles to the edge,
    # and the boundary slides along what of the edge is.
    tangent = _unit(edge)
    normals = np.asarray(surface.normals, np.float64)[start[side]]
    near = np.linalg.norm(away, axis=1) <= _ON_CURVE * np.linalg.norm(edge, axis=1)
    first = _unit(np.where(near[:, None], normals - np.sum(normals * tangent, axis=1, keepdims=True) * tangent, away))
    second = _unit(np.cross(tangent, first))
    dtype = surface.vertices.dtype
    return Rim(
        jnp.asarray(curve.points, dtype),
        face[side],
        jnp.asarray(np.stack([start[side], end[side]], axis=1), jnp.int32),
        jnp.asarray(along, dtype),
        jnp.asarray(np.stack([first, second], axis=1), dtype),
        jnp.asarray(curve.deviation, dtype),
    )


def held_vertices(curve: BoundaryCurve, surface: js.RefinedSurface, edge: float) -> Bool[np.ndarray, "w"]:
    """Which vertices of the boundary the curve speaks of: those within a control edge of a place paired with it."""
    vertices = np.asarray(surface.vertices, np.float64)
    start, end, _ = _boundary_sides(surface.faces)
    side, along = nearest_on_segments(vertices[start], vertices[end], curve.points)
    places = vertices[start[side]] + along[:, None] * (vertices[end[side]] - vertices[start[side]])
    rows = np.unique(np.concatenate([start, end]))
    held = np.zeros(len(vertices), bool)
    held[rows] = KDTree(places).query(vertices[rows])[0] <= edge
    return held


def _boundary_sides(faces: Mapping[int, Any]) -> _Sides:
    """The half-edges that have no other beside them."""
    sides = half_edges({size: np.asarray(rows) for size, rows in faces.items()})
    alone = np.bincount(sides.edge, minlength=len(sides.edges))[sides.edge] == 1
    return _Sides(sides.start[alone], sides.end[alone], sides.face[alone])


def _unit(rows: Float[np.ndarray, "b 3"]) -> Float[np.ndarray, "b 3"]:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(float).tiny)
