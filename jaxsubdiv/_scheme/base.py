"""What the engine asks of a scheme, and what the schemes of a kind share."""

from abc import abstractmethod
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._control import strong_float
from .._masks import Matrix, as_masks, identity, stack
from .._normals import Boundary, Weights, chord_normals, fan_normals, ring_sum
from .._stage import Sides, Stage, hybrid_split, sides_of
from .._topology import AbstractLevel, Level, LimitMasks, MaskLevel, point_normal_level
from ..linalg import (
    Rows,
    Vectors,
    compile_apart,
    join_rows,
    max_abs,
    split_rows,
    take_each,
    take_planes,
    unit,
    unit_or,
    where,
)
from .seams import place_seam_points

OldNormals: TypeAlias = Literal["keep", "recompute"]


class Edges(NamedTuple):
    """Both ends of every edge of a level: positions, and normals of length 1 or 0."""

    x_a: Vectors
    x_b: Vectors
    n_a: Vectors
    n_b: Vectors

    @property
    def d(self) -> Vectors:
        """The edge as a vector."""
        return self.x_b - self.x_a


def gather_edges(level: Level, values: Float[Array, "v 6"]) -> Edges:
    """Ends of the edges of `level`, from the positions and normals side by side: one look-up an end."""
    (x_a, n_a), (x_b, n_b) = (map(split_rows, lax.split(end, (3, 3), axis=2)) for end in take_each(values, level.edges))
    return Edges(x_a, x_b, n_a, n_b)


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
    def edge_points(self, h: Float[Array, ""], edges: Edges) -> Vectors:
        """Positions of the edge vertices."""

    @abstractmethod
    def face_points(
        self,
        h: Float[Array, ""],
        level: Level,
        x: Float[Array, "v 3"],
        n: Float[Array, "v 3"],
        edge_points: Float[Array, "e 3"],
    ) -> Rows:
        """Positions of the face vertices, one in the middle of every quad."""

    def seam_factor(self, t_a: Rows, t_b: Rows) -> Float[Array, "*rows 1"] | float:
        """Factor of the tangents at both ends of a seam, which run from the first end to the second."""
        return 1.0

    def refine_level(
        self, h: Float[Array, ""] | None, level: Level, x: Float[Array, "v 3"], n: Float[Array, "v 3"], recompute: bool
    ) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
        assert h is not None
        values = jnp.concatenate([x, n], axis=1)
        edge_points = _edge_points(self, h, level, values)
        if level.seams is not None:
            edge_points = place_seam_points(level, x, n, edge_points, h, self.seam_factor)
        face_points = _face_points(self, h, level, x, n, edge_points)
        refined = jnp.concatenate([x, edge_points, face_points])
        edge_normals = _unit_normals(_edge_normal_sums(self, level, values, refined), n, level.edges)
        face_normals = _unit_normals(_face_normal_sums(self, level, edge_points, face_points), n, level.quads)
        if recompute:
            assert level.old_fans is not None  # see `_check` in `_refine`
            n = fan_normals(level.old_fans, x, refined, n, self.weights)
        return refined, jnp.concatenate([n, edge_normals, face_normals])


# The stages of a level. Each runs over the edges or the quads once.


@compile_apart
def _edge_points(
    scheme: AbstractPointNormalScheme, h: Float[Array, ""], level: Level, values: Float[Array, "v 6"]
) -> Float[Array, "e 3"]:
    return join_rows(scheme.edge_points(h, gather_edges(level, values)))[0]


@compile_apart
def _face_points(
    scheme: AbstractPointNormalScheme,
    h: Float[Array, ""],
    level: Level,
    x: Float[Array, "v 3"],
    n: Float[Array, "v 3"],
    edge_points: Float[Array, "e 3"],
) -> Float[Array, "q 3"]:
    return join_rows(scheme.face_points(h, level, x, n, edge_points))[0]


@compile_apart
def edge_chord_normals(level: Level, values: Float[Array, "v 6"]) -> Float[Array, "e 3"]:
    """The normal of every edge, at right angles to it."""
    (x_a, x_b), (n_a, n_b) = (take_planes(rows, level.edges) for rows in lax.split(values, (3, 3), axis=1))
    return join_rows(chord_normals(n_a, n_b, x_b - x_a))[0]


@compile_apart
def _edge_normal_sums(
    scheme: AbstractPointNormalScheme, level: Level, values: Float[Array, "v 6"], refined: Float[Array, "w 3"]
) -> Float[Array, "4 e"]:
    """Eq. (6) around every edge vertex of the refined mesh, and how much of it is rounding."""
    n_old, n_edges = values.shape[0], level.edges.shape[0]
    look_up = take_each if scheme.weights == "area" else take_planes
    (x_a, x_b), wings = (list(map(split_rows, look_up(refined, table))) for table in (level.edges, level.wings))
    half = len(wings) // 2
    ring = [x_b, *wings[:half], x_a, *wings[half:]]
    centre = split_rows(refined[None, n_old : n_old + n_edges])
    total, rounding = ring_sum(centre, ring, scheme.weights, ring_corners(level, n_old))
    if scheme.boundary == "chord":
        on_boundary = is_boundary(level, n_old)

        def of_nobody(values: Float[Array, "v 6"]) -> Float[Array, "e 3"]:
            return jnp.broadcast_to(0 * lax.stop_gradient(values[:1, :3]), (n_edges, 3))  # as in `_unit_normals`

        of_edges = jax.checkpoint(partial(edge_chord_normals, level))
        chord = split_rows(lax.cond(jnp.any(on_boundary), of_edges, of_nobody, values)[None])
        takes_chord = on_boundary & (max_abs(chord) > 0)
        total, rounding = where(takes_chord, chord, total), where(takes_chord, 0.0, rounding)
    return jnp.concatenate([*jax.tree.leaves(total), rounding])[..., 0]


@compile_apart
def _face_normal_sums(
    scheme: AbstractPointNormalScheme,
    level: Level,
    edge_points: Float[Array, "e 3"],
    face_points: Float[Array, "q 3"],
) -> Float[Array, "4 q"]:
    """The same around the face vertices."""
    look_up = take_each if scheme.weights == "area" else take_planes
    spokes = list(map(split_rows, look_up(edge_points, level.quad_edges)))
    total, rounding = ring_sum(split_rows(face_points[None]), spokes, scheme.weights)
    return jnp.concatenate([*jax.tree.leaves(total), rounding])[..., 0]


@compile_apart
def _unit_normals(sums: Float[Array, "4 m"], n: Float[Array, "v 3"], parents: Int[Array, "m k"]) -> Float[Array, "m 3"]:
    """Unit normals, eq. (6); where the sum vanishes: the unit sum of the parents' normals."""
    *total, rounding = lax.split(sums[..., None], (1, 1, 1, 1), axis=0)
    total = Vectors(*total)
    there = max_abs(total) > jnp.maximum(rounding, jnp.finfo(sums.dtype).tiny)

    def of_parents(n: Float[Array, "v 3"]) -> Float[Array, "m 3"]:
        first, *others = take_each(n, parents)
        return unit(sum(others, first))[0]

    def of_nobody(n: Float[Array, "v 3"]) -> Float[Array, "m 3"]:
        # Zeros that under `shard_map` vary over devices as the other branch does.
        return jnp.broadcast_to(0 * lax.stop_gradient(n[:1]), (sums.shape[1], 3))

    # The parents are looked up only where some sum vanishes: in most meshes none does.
    instead = lax.cond(jnp.all(there), of_nobody, jax.checkpoint(of_parents), n)
    return join_rows(unit_or(total, split_rows(instead[None]), rounding))[0]


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


def is_boundary(level: Level, n_old: int) -> Bool[Array, "1 e 1"]:
    """Whether an edge has one face only: its edge vertex then stands in its own ring."""
    n_edges = level.edges.shape[0]
    itself = n_old + jnp.arange(n_edges, dtype=level.wings.dtype)
    return (level.wings[:, -1] == itself)[None, :, None]


def ring_corners(level: Level, n_old: int) -> Bool[Array, "k 1 e 1"]:
    """Whether each neighbour of an edge vertex and the next are in one face.

    They are not where the ring stays at a quad's centre, nor where, on a boundary, it runs through the edge vertex.
    """
    half, (start, end), wings = level.wings.shape[1] // 2, level.edges.T, level.wings.T
    ring = [end, *wings[:half], start, *wings[half:]]
    itself = n_old + jnp.arange(len(start), dtype=start.dtype)
    pairs = zip(ring, [*ring[1:], ring[0]], strict=True)
    corners = [(one != after) & (one != itself) & (after != itself) for one, after in pairs]
    return jnp.stack(corners)[:, None, :, None]


def corner_total(level: Level, values: Float[Array, "v 3"]) -> Float[Array, "1 q 3"]:
    """Sum of a value over the corners of every quad."""
    a, b, c, d = take_each(values, level.quads)
    return (a + b) + (c + d)
