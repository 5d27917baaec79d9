"""Valves: where the surface of a cavity ends, as points on the rims of its openings say."""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsubdiv.closest import triangle_distance
from jaxsubdiv.half_edges import half_edges
from jaxsubdiv.linalg import cross, dot, take, unit

from ..unknowns import AnyArray
from .base import AbstractFacePrior, Place, Start

_AT_ONCE = 256  # points that are held against all edges together


class ValvePoints(NamedTuple):
    """Points on the rims of valves, and the control faces between which each rim runs."""

    points: Float[np.ndarray, "b 3"]
    """In mm."""
    slices: Int[np.ndarray, "b"]
    """The row of the slice that each moves with; -1 where it stays."""
    kinds: Int[np.ndarray, "b"]
    """The valve of each."""
    valves: Bool[np.ndarray, "k f"]
    """The control faces of every valve."""
    beside: Bool[np.ndarray, "f"]
    """Control faces that a rim has on its other side."""
    deviation: float = 1.0
    """How far the rim may be off each point, as a standard deviation in mm."""


class _Paired(NamedTuple):
    """Points of rims, paired with edges of the surface as one sweep holds them."""

    side: Int[Array, "b"]
    along: Float[Array, "b"]
    directions: Float[Array, "b 2 3"]
    """Two unit vectors across the rim, which slides freely along itself."""


class ValvePrior(AbstractFacePrior):
    """The rim of every valve passes through the points that were marked on it.

    Robust weights would take these few points for outliers where the template's valve is far off. A sweep holds the
    shifts of slices that the points move with.

    Attributes:
        points, slices, kinds, deviation: as `ValvePoints` has them.
        planes: of the slices.
        ends: vertices of the edges of all rims.
        of_sides: the control face of each.
        own: which edges are of the rim of each valve.
    """

    name: ClassVar[str] = "valve"
    points: Float[Array, "b 3"]
    slices: Int[Array | np.ndarray, "b"]
    kinds: Int[Array | np.ndarray, "b"]
    deviation: Float[Array, ""]
    planes: Float[Array | np.ndarray, "n 2 3"]
    ends: Int[Array | np.ndarray, "s 2"]
    of_sides: Int[np.ndarray, "s"]
    own: Bool[Array | np.ndarray, "k s"]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "ValvePrior | None":
        given: ValvePoints | None = start.inputs.get("valves")
        if given is None or not len(given.points):
            return None
        sides = half_edges({size: np.asarray(rows) for size, rows in start.surface.faces.items()})
        owner = start.owner[sides.face]
        one, other = _both_sides(sides.edge)
        ends, faces, own = [], [], []
        for kind in given.valves:
            for a, b in ((one, other), (other, one)):
                rim = kind[owner[a]] & given.beside[owner[b]]
                ends.append(np.stack([sides.start[a[rim]], sides.end[a[rim]]], axis=1))
                faces.append(owner[a[rim]])
        counts = [len(ends[2 * k]) + len(ends[2 * k + 1]) for k in range(len(given.valves))]
        of_kind = np.repeat(np.arange(len(counts)), counts)
        own = of_kind[None] == np.arange(len(counts))[:, None]
        slices = start.inputs.get("slices")
        planes = np.zeros((1, 2, 3)) if slices is None else slices.planes
        dtype = start.control.vertices.dtype
        points, deviation = jnp.asarray(given.points, dtype), jnp.asarray(given.deviation, dtype)
        sides_of = np.concatenate(ends), np.concatenate(faces)
        return cls(points, given.slices, given.kinds, deviation, planes, *sides_of, own)

    def hold(self, place: Place, strengths: dict[str, Any]) -> _Paired:
        assert place.surface is not None
        vertices, points = place.surface.vertices, self._shift_points(place)
        ends = jnp.asarray(self.ends)
        start, sides = vertices[ends[:, 0]], vertices[ends[:, 1]] - vertices[ends[:, 0]]

        def nearest(one: tuple[Float[Array, "3"], Int[Array, ""]]) -> tuple[Int[Array, ""], Float[Array, ""]]:
            # A triangle without area is its edges.
            squared, u, v = triangle_distance(start.T, sides.T, sides.T, one[0][:, None], jnp)
            side = jnp.argmin(jnp.where(jnp.asarray(self.own)[one[1]], squared, jnp.inf))
            return side, (u + v)[side]

        side, along = lax.map(nearest, (points, jnp.asarray(self.kinds)), batch_size=_AT_ONCE)
        tangent = unit(sides[side])
        normals = place.surface.normals[ends[side, 0]]
        first = unit(normals - dot(normals, tangent) * tangent)
        return _Paired(side.astype(jnp.int32), along, jnp.stack([first, cross(tangent, first)], axis=1))

    def rows(self, place: Place, held: _Paired) -> Float[Array, "m"]:
        """Distances across the rim over their standard deviation, two a point."""
        assert place.surface is not None
        a, b = (take(place.surface.vertices, jnp.asarray(self.ends)[held.side, i]) for i in (0, 1))
        away = a + held.along[:, None] * (b - a) - self._shift_points(place)
        across = [dot(held.directions[:, i], away)[:, 0] for i in (0, 1)]
        return jnp.stack(across, axis=1).reshape(-1) / self.deviation

    def _shift_points(self, place: Place) -> Float[Array, "b 3"]:
        """The points with the shifts of their slices."""
        if "shifts" not in place.shared:
            return self.points
        planes, rows = jnp.asarray(self.planes, self.points.dtype), jnp.asarray(self.slices)
        moved = jnp.sum(place.shared["shifts"].astype(planes.dtype)[:, :, None] * planes, axis=1)
        return self.points + jnp.where((rows >= 0)[:, None], moved[jnp.maximum(rows, 0)], 0.0)

    def differentiate_shifts(self, held: _Paired) -> sp.csr_array:
        slices, planes = np.asarray(self.slices), np.asarray(self.planes, np.float64)
        moves = np.flatnonzero(slices >= 0)
        directions = np.asarray(held.directions, np.float64)[moves]
        values = -np.einsum("bix,bjx->bij", directions, planes[slices[moves]]) / float(self.deviation)
        rows = np.broadcast_to((2 * moves[:, None] + np.arange(2))[:, :, None], values.shape)
        columns = np.broadcast_to((2 * slices[moves][:, None] + np.arange(2))[:, None], values.shape)
        shape = 2 * len(slices), 2 * len(planes)
        return sp.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return 1.0

    def faces(self, held: _Paired) -> Int[AnyArray, "m"]:
        return np.repeat(self.of_sides[np.asarray(held.side)], 2)


def _both_sides(edge: Int[np.ndarray, "s"]) -> tuple[Int[np.ndarray, "e"], Int[np.ndarray, "e"]]:
    """The two half-edges of every edge that has two."""
    order = np.argsort(edge, kind="stable")
    twice = np.flatnonzero(edge[order][1:] == edge[order][:-1])
    return order[twice], order[twice + 1]
