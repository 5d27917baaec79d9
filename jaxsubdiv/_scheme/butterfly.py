"""The modified butterfly scheme for triangles."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import numpy as np

from .._masks import Matrix, Term, entries, scale_rows
from .._normals import Weights
from .._stage import Sides, Stage, ring_positions
from .base import AbstractPrimalScheme
from .creased import border


class ModifiedButterfly(AbstractPrimalScheme):
    """The modified butterfly scheme for triangles: interpolating, smooth (C1), linear.

    Edges between vertices of valence 6 take the eight-point rule; one with an extraordinary end the rule of that end's
    ring, and one with two the mean of both. Boundary edges take the four-point rule along the boundary. A wing that
    lies beyond a boundary is the mirror image of the corner on this side of it, and an end on the boundary counts as
    regular: our choice, as the source leaves several. VTK agrees to its single precision but at edges from inside to
    the boundary, where it takes other corners for the missing wings, and so moves points by up to an eighth of an edge
    even in a plane.

    Source: N. Dyn, D. Levin & J. Gregory, A butterfly subdivision scheme for surface interpolation with tension
    control, 1990; D. Zorin, P. Schroeder & W. Sweldens, Interpolating subdivision for meshes with arbitrary topology,
    1996.
    """

    h: None = eqx.field(init=False, default=None)
    weights: Weights = eqx.field(static=True, default="area", init=False)

    takes: ClassVar[tuple[int, ...]] = (3,)
    interpolates: ClassVar[bool] = True
    order: ClassVar[int] = 4

    def edge_masks(self, stage: Stage, sides: Sides) -> Matrix:
        valence = np.bincount(sides.start, minlength=stage.n_vertices)
        extraordinary = (valence != 6) & (border(stage, sides).next < 0)
        n_special = extraordinary[stage.edges].sum(axis=1)
        on_boundary = stage.right < 0
        regular = (n_special == 0) & ~on_boundary
        ring = _ring_rule(stage, sides, extraordinary, valence)
        return (
            scale_rows(1.0 * regular, _eight_point_rule(stage, sides))
            + scale_rows(np.where(on_boundary, 0.0, 1 / np.maximum(n_special, 1)), ring)
            + scale_rows(1.0 * on_boundary, four_point_boundary(stage, sides))
        )


def _eight_point_rule(stage: Stage, sides: Sides) -> Matrix:
    """1/2 for the ends, 1/8 for the corners opposite, -1/16 for the four wings beside those."""
    e = np.arange(len(stage.edges))
    terms: list[Term] = [(e[:, None], stage.edges, 1 / 2), (sides.edge, sides.start[sides.before], 1 / 8)]
    for beside in (sides.next, sides.before):
        across = sides.twin[beside]
        wing = np.where(across >= 0, sides.start[sides.before[across]], -1)
        terms.append((sides.edge, wing, -1 / 16))
        mirrored = across < 0  # a + b - c, c the corner of this triangle that is not on its boundary edge
        corner = sides.start[sides.before[beside]]
        for at, sign in ((sides.start[beside], 1), (sides.end[beside], 1), (corner, -1)):
            terms.append((sides.edge[mirrored], at[mirrored], -sign / 16))
    return entries((len(e), stage.n_vertices), *terms)


def _ring_rule(stage: Stage, sides: Sides, extraordinary: np.ndarray, valence: np.ndarray) -> Matrix:
    """For every edge the sum over its extraordinary ends: 3/4 of the end, and the weights of its ring."""
    e, n = np.arange(len(stage.edges)), stage.n_vertices
    position = ring_positions(sides)
    terms: list[Term] = [(e[:, None], stage.edges, np.where(extraordinary[stage.edges], 3 / 4, 0.0))]
    # Sides that leave each vertex, in order: rows of a table by valence.
    for k in np.unique(valence[extraordinary]):
        out = np.flatnonzero(extraordinary[sides.start] & (valence[sides.start] == k))
        out = out[np.lexsort((position[out], sides.start[out]))].reshape(-1, k)
        neighbours = sides.end[out]
        for j, weight in enumerate(_ring_weights(int(k))):
            terms.append((sides.edge[out], np.roll(neighbours, -j, axis=1), weight))
    return entries((len(e), n), *terms)


def _ring_weights(k: int) -> Sequence[float]:
    """Weights of the neighbours of a vertex of valence `k`, from that along the edge itself on."""
    if k == 3:
        return (5 / 12, -1 / 12, -1 / 12)
    if k == 4:
        return (3 / 8, 0.0, -1 / 8, 0.0)
    angle = 2 * np.pi * np.arange(k) / k
    return ((1 / 4 + np.cos(angle) + np.cos(2 * angle) / 2) / k).tolist()


def four_point_boundary(stage: Stage, sides: Sides) -> Matrix:
    """The four-point rule along the boundary: 9/16 for the ends, -1/16 for the vertices beside them; 0 elsewhere."""
    e = np.flatnonzero(stage.right < 0)
    a, b = stage.edges[e].T  # each runs the way of the boundary, as its only side does
    # Where two fans of faces share a vertex, the boundary of each stays with its fan.
    side = stage.left[e]
    follows = sides.next[side]
    while (turning := sides.twin[follows] >= 0).any():
        follows = np.where(turning, sides.next[sides.twin[follows]], follows)
    leads = np.empty_like(side)
    row = np.searchsorted(side, follows, sorter=(order := np.argsort(side)))
    leads[order[row]] = side
    rows = (len(stage.edges), stage.n_vertices)
    beside = [(e, sides.start[leads], -1 / 16), (e, sides.end[follows], -1 / 16)]
    return entries(rows, (e, a, 9 / 16), (e, b, 9 / 16), *beside)
