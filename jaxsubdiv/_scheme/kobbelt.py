"""Kobbelt's interpolating scheme for quads."""

from typing import ClassVar

import equinox as eqx
import numpy as np

from .._masks import Matrix, Term, entries, scale_rows
from .._normals import Weights
from .._stage import Sides, Stage, ring_positions
from .base import AbstractPrimalScheme
from .butterfly import four_point_boundary
from .creased import border

_W = 1 / 16  # of the four-point rule; the source's tension omega = 1


class Kobbelt(AbstractPrimalScheme):
    """Kobbelt's interpolating scheme for quads: smooth (C1), linear; on regular grids the four-point rule both ways.

    At an extraordinary vertex the point beyond it is a virtual one, so that face points come out alike from either
    direction; where a face has several of them, as at the first level, the mean of both directions is taken. Boundary
    edges take the four-point rule along the boundary, and beyond a boundary points are extrapolated linearly: our
    choice.

    Source: L. Kobbelt, Interpolatory subdivision on open quadrilateral nets with arbitrary topology, 1996.
    """

    h: None = eqx.field(init=False, default=None)
    weights: Weights = eqx.field(static=True, default="area", init=False)

    takes: ClassVar[tuple[int, ...]] = (4,)
    interpolates: ClassVar[bool] = True
    order: ClassVar[int] = 4

    def edge_masks(self, stage: Stage, sides: Sides) -> Matrix:
        e, (a, b) = np.arange(len(stage.edges)), stage.edges.T
        rows = (len(e), stage.n_vertices)
        beyond = _extend_sides(stage, sides)
        # The side that leaves each end along the edge; one that comes in over a boundary has no such side.
        n_sides = len(sides.start)
        at_b = np.where(stage.right >= 0, stage.right, 0)
        pick = [entries((len(e), n_sides), (e, stage.left, 1.0)), entries((len(e), n_sides), (e, at_b, 1.0))]
        inner = entries(rows, (e, a, 1 / 2 + _W), (e, b, 1 / 2 + _W)) - _W * (pick[0] @ beyond + pick[1] @ beyond)
        on_boundary = 1.0 * (stage.right < 0)
        return scale_rows(1 - on_boundary, inner) + scale_rows(on_boundary, four_point_boundary(stage, sides))

    def face_masks(self, stage: Stage, sides: Sides) -> Matrix:
        edges = self.edge_masks(stage, sides)
        quad = sides.face
        opposite = sides.edge[sides.next[sides.next]]
        # Both directions: every edge of the quad, with the parallel one in the face on its other side.
        across = np.where(sides.twin >= 0, opposite[sides.twin], -1)
        out = across < 0
        # Beyond a boundary: twice the edge point less the one opposite.
        terms = [
            (quad, sides.edge, (1 / 2 + _W) / 2),
            (quad, across, -_W / 2),
            (quad[out], sides.edge[out], -_W),
            (quad[out], opposite[out], _W / 2),
        ]
        return entries((len(stage.faces[4]), edges.shape[0]), *terms) @ edges


def _extend_sides(stage: Stage, sides: Sides) -> Matrix:
    """For every side the point on the other side of its start, in line with it.

    With neighbours l_j and far corners h_j of the faces around a vertex of valence k, and the side toward l_0:
    4/k sum l - (l_-1 + l_0 + l_1) + (h_-2 + h_-1 + h_0 + h_1 - 4/k sum h) / 5, h_j between l_j and l_j+1; at valence 4
    this is l_2.
    """
    n, side = stage.n_vertices, np.arange(len(sides.start))
    rows = (len(side), n)
    on_border = border(stage, sides).next >= 0
    valence = np.bincount(sides.start, minlength=n)
    mirrored = on_border[sides.start]
    terms: list[Term] = [(side[mirrored], sides.start[mirrored], 2.0), (side[mirrored], sides.end[mirrored], -1.0)]
    position = ring_positions(sides)
    for k in np.unique(valence[sides.start[~mirrored]]):
        out = np.flatnonzero(~mirrored & (valence[sides.start] == k))
        out = out[np.lexsort((position[out], sides.start[out]))].reshape(-1, k)
        neighbour, corner = sides.end[out], sides.end[sides.next[out]]
        if k == 4:
            terms.append((out, np.roll(neighbour, -2, axis=1), 1.0))
            continue
        for j in range(k):
            terms.append((out, np.roll(neighbour, -j, axis=1), 4 / k))
            terms.append((out, np.roll(corner, -j, axis=1), -4 / (5 * k)))
        for j in (-1, 0, 1):
            terms.append((out, np.roll(neighbour, -j, axis=1), -1.0))
        for j in (-2, -1, 0, 1):
            terms.append((out, np.roll(corner, -j, axis=1), 1 / 5))
    return entries(rows, *terms)
