"""What Catmull-Clark and Loop share: boundaries and semi-sharp creases, as OpenSubdiv has them."""

from abc import abstractmethod
from typing import ClassVar, Literal, NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from .._fans import as_table
from .._masks import Matrix, Term, as_masks, entries, identity, scale_rows
from .._normals import Weights
from .._patches import patch_vertices
from .._stage import INFINITE, Sides, Stage, ring_positions, sides_of, wear
from .._topology import LimitMasks
from .base import AbstractPrimalScheme, check_option

Edge: TypeAlias = Literal["edge-and-corner", "edge-only"]
"""What a boundary does: all of its edges are sharp, and with "edge-and-corner" so are vertices of a single face."""


class Sharpness(NamedTuple):
    """How sharp the vertices and edges of a level are, boundaries included."""

    edge: Float[np.ndarray, "e"]
    vertex: Float[np.ndarray, "v"]

    def wear(self) -> "Sharpness":
        """What is left of it at the next level."""
        return Sharpness(wear(self.edge), wear(self.vertex))

    def rule(self, stage: Stage) -> Int[np.ndarray, "v"]:
        """For every vertex 0 (smooth, or the end of one sharp edge), 1 (a crease) or 2 (a corner)."""
        sharp = stage.edges[self.edge > 0]
        n_sharp = np.bincount(sharp.ravel(), minlength=stage.n_vertices)
        return np.where((self.vertex > 0) | (n_sharp > 2), 2, (n_sharp == 2).astype(int))


def sharpness(stage: Stage, sides: Sides, boundary: Edge) -> Sharpness:
    """Sharpness of a level. Vertices without faces count as corners, so that they stay."""
    edge, vertex = stage.edge_sharpness, stage.vertex_sharpness
    edge = np.zeros(len(stage.edges)) if edge is None else edge
    vertex = np.zeros(stage.n_vertices) if vertex is None else vertex
    n_faces = np.bincount(sides.start, minlength=stage.n_vertices)
    corners = n_faces == 0 if boundary == "edge-only" else n_faces < 2
    return Sharpness(np.where(stage.right < 0, INFINITE, edge), np.where(corners, INFINITE, vertex))


def crease_masks(stage: Stage, sharp: Bool[np.ndarray, "e"], centre: float, end: float) -> Matrix:
    """`centre` times every vertex and `end` times the far ends of the sharp edges at it."""
    a, b = stage.edges[sharp].T
    v = np.arange(stage.n_vertices)
    return entries((len(v), len(v)), (v, v, centre), (a, b, end), (b, a, end))


def blend_vertices(stage: Stage, now: Sharpness, smooth: Matrix) -> Matrix:
    """The smooth, the crease and the corner rule, where each holds; between two levels of sharpness a blend."""
    later = now.wear()
    rule, next_rule = now.rule(stage), later.rule(stage)
    ending = (now.edge > 0) & (later.edge == 0)
    ends = stage.edges[ending].ravel()
    total = np.bincount(ends, np.repeat(now.edge[ending], 2), stage.n_vertices)
    count = np.bincount(ends, minlength=stage.n_vertices).astype(float)
    vertex_ends = (now.vertex > 0) & (later.vertex == 0)
    total, count = total + np.where(vertex_ends, now.vertex, 0), count + vertex_ends
    share = np.where((rule == 0) | (rule == next_rule), 1.0, np.minimum(total / np.maximum(count, 1), 1.0))
    weight = np.stack([share * (rule == i) + (1 - share) * (next_rule == i) for i in range(3)])
    # Where the crease is what comes after a corner, it runs along the edges that are still sharp then.
    a, b = stage.edges.T
    n = stage.n_vertices
    along = np.where(next_rule[:, None] == 1, [[True, False]], [[False, True]])  # later, now
    v = np.arange(n)
    terms: list[Term] = [(v, v, 0.75)]
    for i, sharp in enumerate((later.edge > 0, now.edge > 0)):
        for start, end in ((a, b), (b, a)):
            terms.append((start[sharp], end[sharp], np.where(along[start[sharp], i], 0.125, 0.0)))
    crease = entries((n, n), *terms)
    return scale_rows(weight[0], smooth) + scale_rows(weight[1], crease) + scale_rows(weight[2], identity(n))


class AbstractCreasedScheme(AbstractPrimalScheme):
    """A linear scheme with a smooth rule for vertices and edges, and creases along cubic B-splines."""

    h: None = eqx.field(init=False, default=None)
    weights: Weights = eqx.field(static=True, default="area", init=False)
    boundary: eqx.AbstractVar[Edge]

    interpolates: ClassVar[bool] = False
    takes_creases: ClassVar[bool] = True

    def __check_init__(self) -> None:
        check_option("boundary", self.boundary, ("edge-and-corner", "edge-only"))

    @abstractmethod
    def smooth_vertices(self, stage: Stage, sides: Sides) -> Matrix:
        """Weights of the vertices, right where a vertex has faces all around."""

    @abstractmethod
    def smooth_edges(self, stage: Stage, sides: Sides) -> Matrix:
        """Weights of the edge vertices, right where an edge has two faces."""

    @abstractmethod
    def smooth_limit(self, stage: Stage, sides: Sides) -> Matrix:
        """Weights of the limit positions, right where a vertex has faces all around."""

    @abstractmethod
    def limit_tangents(self, stage: Stage, sides: Sides, position: np.ndarray) -> tuple[Matrix, Matrix]:
        """Weights of two tangents at every vertex, whose cross product points outward."""

    def vertex_masks(self, stage: Stage, sides: Sides) -> Matrix:
        return blend_vertices(stage, sharpness(stage, sides, self.boundary), self.smooth_vertices(stage, sides))

    def edge_masks(self, stage: Stage, sides: Sides) -> Matrix:
        sharp = np.minimum(sharpness(stage, sides, self.boundary).edge, 1.0)
        e, (a, b) = np.arange(len(stage.edges)), stage.edges.T
        middle = entries((len(e), stage.n_vertices), (e, a, 0.5), (e, b, 0.5))
        return scale_rows(1 - sharp, self.smooth_edges(stage, sides)) + scale_rows(sharp, middle)

    def limit(self, stage: Stage) -> LimitMasks:
        sides = sides_of(stage)
        now = sharpness(stage, sides, self.boundary)
        if any(((values > 0) & (values < INFINITE)).any() for values in now):
            raise ValueError(
                "some creases are still sharp after the last level, where the limit has no weights of its own. Refine "
                "by as many levels as the greatest sharpness, rounded up, or drop `limit`."
            )
        rule, n = now.rule(stage), stage.n_vertices
        crease = crease_masks(stage, now.edge > 0, 2 / 3, 1 / 6)
        points = (
            scale_rows(1.0 * (rule == 0), self.smooth_limit(stage, sides))
            + scale_rows(1.0 * (rule == 1), crease)
            + scale_rows(1.0 * (rule == 2), identity(n))
        )
        # On a crease inside there are two normals; the mesh's own, between them, stands in.
        n_ends = np.bincount(sides.start[sides.twin < 0], minlength=n)
        inside, at_border = (rule == 0) & (n_ends == 0), n_ends == 1
        known = 1.0 * (inside | (at_border & (np.bincount(stage.edges[now.edge > 0].ravel(), minlength=n) == 2)))
        first, second = self.limit_tangents(stage, sides, ring_positions(sides))
        return LimitMasks(
            as_masks(points),
            (as_masks(scale_rows(known, first)), as_masks(scale_rows(known, second))),
            as_table(patch_vertices(stage, sides, self.takes[-1], now.edge > 0)),
        )


class Border(NamedTuple):
    """Neighbours along the boundary."""

    next: Int[np.ndarray, "v"]
    """For every vertex the far end of the boundary edge that leaves it, or -1."""
    previous: Int[np.ndarray, "v"]
    """The far end of the one that comes in, or -1."""


def border(stage: Stage, sides: Sides) -> Border:
    """Neighbours of every vertex along the boundary."""
    ends = np.full((2, stage.n_vertices), -1)
    outer = sides.twin < 0
    ends[0, sides.start[outer]] = sides.end[outer]
    ends[1, sides.end[outer]] = sides.start[outer]
    return Border(*ends)


def border_tangent_weights(
    k: Float[np.ndarray, "v"],
    eigenvalue: Float[np.ndarray, "v"],
    beside: Float[np.ndarray, "v"],
    inside: Float[np.ndarray, "v"],
) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """Weights of a boundary vertex and of its two boundary neighbours in the tangent across the boundary.

    The tangent is the left eigenvector of the ring's own subdivision, in which the inner edges i = 1 to k - 1 weigh
    sin(i pi/k). With (3/4, 1/8, 1/8) at the vertex and (1/2, 1/2) beside it two equations are left for its weights.

    Args:
        k: number of faces.
        eigenvalue: of the inner edges.
        beside: what the inner edges' and faces' rules give of a boundary neighbour.
        inside: what they give of the vertex itself.
    """
    itself = (beside + (eigenvalue - 1 / 2) * inside) / ((eigenvalue - 1) * (eigenvalue - 1 / 4))
    neighbour = (eigenvalue - 3 / 4) * itself - inside
    return np.where(k == 1, -2.0, itself), np.where(k == 1, 1.0, neighbour)
