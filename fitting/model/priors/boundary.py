"""Boundary curves: where an open surface ends, as its boundary follows from points of the curve."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.closest import triangle_distance
from jaxsubdiv.errors import name_rows
from jaxsubdiv.half_edges import half_edges
from jaxsubdiv.linalg import cross, dot, norm, take, unit

from ...scan.scan import ScanError
from ..unknowns import AnyArray
from .base import AbstractFacePrior, Place, Start

_AT_ONCE = 256  # points that are held against all boundary edges together
_ON_CURVE = 1e-9  # in lengths of the boundary edge: a point that is nearer is on it, in no direction from it


class BoundaryCurve(NamedTuple):
    """Points of the curve that an open surface ends at, such as the rim of a valve or of the scanned surface."""

    points: Float[np.ndarray, "b 3"]
    """In mm, as many as there are, in any order; of the whole boundary of the surface or of a part of it."""
    deviation: float = 0.5
    """How far the boundary may be off each of them, as a standard deviation in mm."""


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


def check_curve(curve: BoundaryCurve, topology: js.Topology) -> BoundaryCurve:
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


class Rim(NamedTuple):
    """Points of the curve, paired with the boundary of the surface as one sweep holds them."""

    side: Int[Array, "b"]
    """The boundary edge that each is paired with."""
    along: Float[Array, "b"]
    """Where on it, 0 to 1."""
    directions: Float[Array, "b 2 3"]
    """Two unit vectors across the boundary, which slides freely along itself."""
    covered: Bool[Array, "w"]
    """Which vertices of the boundary the curve speaks of: those within a control edge of a place paired with it."""


class BoundaryPrior(AbstractFacePrior):
    """The boundary of the surface passes through the points of a curve.

    Attributes:
        points: of the curve, in mm.
        counts: 1 each; 0 of points that only fill up the array.
        deviation: standard deviation in mm.
        ends: vertices of the boundary edges.
        of_sides: the control face of each.
        vertices: those on the boundary.
    """

    name: ClassVar[str] = "rim"
    points: Float[Array, "b 3"]
    counts: Float[Array, "b"]
    deviation: Float[Array, ""]
    ends: Int[Array | np.ndarray, "s 2"]
    of_sides: Int[np.ndarray, "s"]
    vertices: Int[Array | np.ndarray, "r"]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "BoundaryPrior | None":
        curve = start.inputs.get("boundary")
        if curve is None:
            return None
        first, last, face = _boundary_sides(start.topology.faces)
        points = jnp.asarray(curve.points, start.control.vertices.dtype)
        ends = np.stack([first, last], axis=1)
        deviation = jnp.asarray(curve.deviation, points.dtype)
        counts = jnp.asarray(start.inputs.get("boundary_counts", np.ones(len(points))), points.dtype)
        return cls(points, counts, deviation, ends, start.owner[face], np.unique(ends))

    def hold(self, place: Place, strengths: dict[str, Any]) -> Rim:
        assert place.surface is not None
        return pair_with_boundary(self, place.surface, place.edge)

    def rows(self, place: Place, held: Rim) -> Float[Array, "m"]:
        """Distances across the boundary over their standard deviation, two a point."""
        assert place.surface is not None
        a, b = (take(place.surface.vertices, jnp.asarray(self.ends)[held.side, i]) for i in (0, 1))
        away = a + held.along[:, None] * (b - a) - self.points
        across = [dot(held.directions[:, i], away)[:, 0] for i in (0, 1)]
        return jnp.stack(across, axis=1).reshape(-1) / self.deviation

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return self.counts.repeat(2)

    def faces(self, held: Rim) -> Int[AnyArray, "m"]:
        return np.repeat(self.of_sides[np.asarray(held.side)], 2)


def pair_with_boundary(prior: BoundaryPrior, surface: js.RefinedSurface, edge: Float[Array, ""]) -> Rim:
    """Every point of the curve with the exactly closest point of the surface's boundary edges."""
    vertices, ends, points = surface.vertices, jnp.asarray(prior.ends), prior.points
    start, along_sides = vertices[ends[:, 0]], vertices[ends[:, 1]] - vertices[ends[:, 0]]

    def nearest(point: Float[Array, "3"]) -> tuple[Int[Array, ""], Float[Array, ""]]:
        # A triangle without area is its edges.
        squared, u, v = triangle_distance(start.T, along_sides.T, along_sides.T, point[:, None], jnp)
        side = jnp.argmin(squared)
        return side, (u + v)[side]

    side, along = lax.map(nearest, points, batch_size=_AT_ONCE)
    a, sides = start[side], along_sides[side]
    places = a + along[:, None] * sides
    away = points - places
    # The first direction is that of the distance: at a corner of the boundary it is not at right angles to the edge,
    # and the boundary slides along what of the edge is.
    tangent, normals = unit(sides), surface.normals[ends[side, 0]]
    near = norm(away) <= _ON_CURVE * norm(sides)
    first = unit(jnp.where(near, normals - dot(normals, tangent) * tangent, away))
    second = unit(cross(tangent, first))
    counted = jnp.where(prior.counts[:, None] > 0, places, jnp.inf)

    def is_near(vertex: Float[Array, "3"]) -> Bool[Array, ""]:
        return jnp.min(jnp.sum((counted - vertex[None]) ** 2, axis=1)) <= edge**2

    covered = lax.map(is_near, vertices[prior.vertices], batch_size=_AT_ONCE)
    mask = jnp.zeros(len(vertices), bool).at[prior.vertices].set(covered)
    return Rim(side.astype(jnp.int32), along, jnp.stack([first, second], axis=1), mask)


def _boundary_sides(faces: Mapping[int, Any]) -> _Sides:
    """The half-edges that have no other beside them."""
    sides = half_edges({size: np.asarray(rows) for size, rows in faces.items()})
    alone = np.bincount(sides.edge, minlength=len(sides.edges))[sides.edge] == 1
    return _Sides(sides.start[alone], sides.end[alone], sides.face[alone])
