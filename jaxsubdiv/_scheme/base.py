"""What the engine asks of a scheme, and what the schemes of a kind share."""

from abc import abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._control import strong_float
from .._linalg import Rows, largest, take, unit, unit_or
from .._masks import Matrix, as_masks, identity, stack
from .._normals import Boundary, Weights, chord_normals, fan_normals, ring_sum
from .._stage import Sides, Stage, hybrid_split, sides_of
from .._topology import AbstractLevel, Level, LimitMasks, MaskLevel, point_normal_level
from .seams import on_seams

OldNormals: TypeAlias = Literal["keep", "recompute"]


class Edges(NamedTuple):
    """Both ends of every edge of a level: positions, and normals of length 1 or 0."""

    x_a: Float[Array, "e 3"]
    x_b: Float[Array, "e 3"]
    n_a: Float[Array, "e 3"]
    n_b: Float[Array, "e 3"]

    @property
    def d(self) -> Float[Array, "e 3"]:
        """The edge as a vector."""
        return self.x_b - self.x_a


def gather_edges(level: Level, x: Float[Array, "v 3"], n: Float[Array, "v 3"]) -> Edges:
    """Ends of the edges of `level`."""
    a, b = level.edges[:, 0], level.edges[:, 1]
    return Edges(take(x, a), take(x, b), take(n, a), take(n, b))


def tangent_length(h: object) -> Float[Array, "..."]:
    """`h` as a strong scalar or one value a level."""
    h = strong_float(h)
    if h.ndim > 1:
        raise ValueError(f"`h` must be a scalar or one value a level, shape [] or [levels]; got {list(h.shape)}.")
    return h


def check_option(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise for a value that the option does not have."""
    if value not in allowed:
        raise ValueError(f"`{name}` must be one of {', '.join(map(repr, allowed))}; got {value!r}.")


class AbstractScheme(eqx.Module):
    """Rules that make the points and normals of the next level. `refine` owns the loop.

    A rule sees one level: its tables, and the positions and unit normals of the vertices that there are. It never sees
    the level's number, or other levels.
    """

    h: eqx.AbstractVar[Any]
    """Tangent length, `Float[Array, ""]` or one a level; None in schemes that have none."""
    weights: eqx.AbstractVar[Weights]
    """How corner normals are weighed in (6)."""

    takes: ClassVar[tuple[int, ...]] = (3, 4)
    """Numbers of corners of the faces that it takes."""
    interpolates: ClassVar[bool]
    """Whether control vertices stay where they are."""
    is_linear: ClassVar[bool]
    """Whether new vertices are weighted sums of the control vertices, with weights that the faces alone decide."""
    uses_normals: ClassVar[bool]
    """Whether the surface depends on the control normals."""
    is_primal: ClassVar[bool] = True
    """Whether the vertices of a level are the first of the next one, moved or not."""
    takes_creases: ClassVar[bool] = False
    """Whether `build_topology` may be given creases."""
    takes_seams: ClassVar[bool] = False
    """Whether `build_topology` may be given seams."""
    order: ClassVar[int]
    """Power of the edge length by which the first new vertices come closer to a smooth surface through the control
    vertices (with its own normals), on regular meshes."""

    @property
    def recomputes_normals(self) -> bool:
        """Whether old vertices get new normals at every level."""
        return False

    @property
    def tables_for(self) -> str:
        """Schemes that say the same here run on the same tables."""
        return repr(self)

    @abstractmethod
    def level(self, stage: Stage, recompute: bool) -> AbstractLevel:
        """Tables of one level, in numpy; `recompute` asks for those that new normals of old vertices need."""

    @abstractmethod
    def split(self, stage: Stage) -> Stage:
        """The mesh of the next level."""

    def limit(self, stage: Stage) -> LimitMasks:
        """Weights of the limit surface at the vertices of a level."""
        raise ValueError(
            f"{type(self).__name__} has no limit masks; the linear schemes do. Build the tables without `limit`."
        )

    @abstractmethod
    def refine_level(
        self, h: Float[Array, ""] | None, level: Any, x: Float[Array, "v 3"], n: Float[Array, "v 3"], recompute: bool
    ) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
        """Positions and normals of the next level."""


class AbstractPointNormalScheme(AbstractScheme):
    """An interpolating scheme of points and normals: every face into four, normals by (4)-(6)."""

    boundary: eqx.AbstractVar[Boundary]
    """Where the normal of a new boundary vertex comes from."""

    interpolates: ClassVar[bool] = True
    is_linear: ClassVar[bool] = False
    uses_normals: ClassVar[bool] = True
    takes_seams: ClassVar[bool] = True

    @property
    def tables_for(self) -> str:
        return "points and normals"

    def level(self, stage: Stage, recompute: bool) -> Level:
        return point_normal_level(stage, recompute)

    def split(self, stage: Stage) -> Stage:
        return hybrid_split(stage)

    @abstractmethod
    def edge_points(self, h: Float[Array, ""], edges: Edges) -> Float[Array, "e 3"]:
        """Positions of the edge vertices."""

    @abstractmethod
    def face_points(
        self,
        h: Float[Array, ""],
        level: Level,
        x: Float[Array, "v 3"],
        n: Float[Array, "v 3"],
        edges: Edges,
        edge_points: Float[Array, "e 3"],
    ) -> Float[Array, "q 3"]:
        """Positions of the face vertices, one in the middle of every quad."""

    def seam_factor(self, t_a: Rows, t_b: Rows) -> Float[Array, "*rows 1"] | float:
        """Factor of the tangents at both ends of a seam, which run from the first end to the second."""
        return 1.0

    def refine_level(
        self, h: Float[Array, ""] | None, level: Level, x: Float[Array, "v 3"], n: Float[Array, "v 3"], recompute: bool
    ) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
        assert h is not None
        edges = gather_edges(level, x, n)
        edge_points = self.edge_points(h, edges)
        if level.seams is not None:
            edge_points = on_seams(level, x, n, edge_points, h, self.seam_factor)
        face_points = self.face_points(h, level, x, n, edges, edge_points)
        refined = jnp.concatenate([x, edge_points, face_points])
        edge_normals, face_normals = new_normals(self, level, edges, n, refined)
        if recompute:
            assert level.old_fans is not None  # see `_check` in `_refine`
            n = fan_normals(level.old_fans, x, refined, n, self.weights)
        return refined, jnp.concatenate([n, edge_normals, face_normals])


class AbstractLinearScheme(AbstractScheme):
    """A scheme whose new vertices are weighted sums of old ones. Its rules are sparse matrices, built on the host."""

    is_linear: ClassVar[bool] = True
    uses_normals: ClassVar[bool] = False

    @abstractmethod
    def masks(self, stage: Stage) -> Matrix:
        """Weights of the vertices of the next level over those of this one, old vertices left out if they stay."""

    def level(self, stage: Stage, recompute: bool) -> MaskLevel:
        return MaskLevel(edges=stage.edges, masks=as_masks(self.masks(stage)))

    def refine_level(
        self,
        h: Float[Array, ""] | None,
        level: MaskLevel,
        x: Float[Array, "v 3"],
        n: Float[Array, "v 3"],
        recompute: bool,
    ) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
        new = level.masks(x)
        refined = jnp.concatenate([x, new]) if self.interpolates else new
        return refined, jnp.zeros_like(refined)  # `refine` puts in those of the last mesh


class AbstractPrimalScheme(AbstractLinearScheme):
    """A linear scheme that splits faces: three rules, one a kind of new vertex."""

    def limit(self, stage: Stage) -> LimitMasks:
        """Where a scheme interpolates, vertices are on the limit; no masks of tangents are printed for those here."""
        return LimitMasks(as_masks(identity(stage.n_vertices)), None)

    def vertex_masks(self, stage: Stage, sides: Sides) -> Matrix:
        """Weights `[v, v]` of the old vertices in their new places; never asked of a scheme that interpolates."""
        raise NotImplementedError

    @abstractmethod
    def edge_masks(self, stage: Stage, sides: Sides) -> Matrix:
        """Weights `[e, v]` of the edge vertices."""

    def face_masks(self, stage: Stage, sides: Sides) -> Matrix | None:
        """Weights `[f, v]` of the face vertices; None where the split has none."""
        return None

    def masks(self, stage: Stage) -> Matrix:
        sides = sides_of(stage)
        old = None if self.interpolates else self.vertex_masks(stage, sides)
        rows = [old, self.edge_masks(stage, sides), self.face_masks(stage, sides)]
        return stack([matrix for matrix in rows if matrix is not None])

    def split(self, stage: Stage) -> Stage:
        return hybrid_split(stage)


def new_normals(
    scheme: AbstractPointNormalScheme, level: Level, edges: Edges, n: Float[Array, "v 3"], x: Float[Array, "w 3"]
) -> tuple[Float[Array, "e 3"], Float[Array, "q 3"]]:
    """Unit normals of the edge vertices and of the face vertices, eqs. (4)-(6) on the refined faces around them.

    Where the sum vanishes: the unit sum of the parents' normals.

    Args:
        n: normals of the old vertices.
        x: positions of old and new vertices.
    """
    n_old, n_edges = n.shape[0], level.edges.shape[0]
    edge_points, face_points = x[n_old : n_old + n_edges], x[n_old + n_edges :]

    wings = [take(x, column) for column in level.wings.T]
    half = len(wings) // 2
    ring = [edges.x_b, *wings[:half], edges.x_a, *wings[half:]]
    total, rounding = ring_sum(edge_points, ring, scheme.weights, ring_corners(level, n_old))
    if scheme.boundary == "chord":
        chord = chord_normals(edges.n_a, edges.n_b, edges.d)
        takes_chord = is_boundary(level, n_old) & (largest(chord) > 0)
        total, rounding = jnp.where(takes_chord, chord, total), jnp.where(takes_chord, 0.0, rounding)
    edge_normals = unit_or(total, unit(edges.n_a + edges.n_b), rounding)

    spokes = [take(edge_points, column) for column in level.quad_edges.T]
    total, rounding = ring_sum(face_points, spokes, scheme.weights)
    return edge_normals, unit_or(total, unit(corner_total(level, n)), rounding)


def is_boundary(level: Level, n_old: int) -> Bool[Array, "e 1"]:
    """Whether an edge has one face only: its edge vertex then stands in its own ring."""
    n_edges = level.edges.shape[0]
    return level.wings[:, -1:] == n_old + jnp.arange(n_edges, dtype=level.wings.dtype)[:, None]


def ring_corners(level: Level, n_old: int) -> Bool[Array, "k e 1"]:
    """Whether each neighbour of an edge vertex and the next are in one face.

    They are not where the ring stays at a quad's centre, nor where, on a boundary, it runs through the edge vertex.
    """
    half = level.wings.shape[1] // 2
    ring = jnp.stack([level.edges[:, 1], *level.wings.T[:half], level.edges[:, 0], *level.wings.T[half:]])
    itself = n_old + jnp.arange(ring.shape[1], dtype=ring.dtype)[None]
    after = jnp.roll(ring, -1, axis=0)
    return ((ring != after) & (ring != itself) & (after != itself))[..., None]


def corner_total(level: Level, values: Float[Array, "v 3"]) -> Float[Array, "q 3"]:
    """Sum of a value over the corners of every quad."""
    a, b, c, d = (take(values, column) for column in level.quads.T)
    return (a + b) + (c + d)
