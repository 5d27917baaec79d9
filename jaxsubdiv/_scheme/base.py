"""What the engine asks of a scheme, and what every scheme of points and normals shares."""

from abc import abstractmethod
from typing import Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._control import strong_float
from .._linalg import largest, take, unit, unit_or
from .._normals import Boundary, Weights, chord_normals, ring_sum
from .._topology import Level

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
    """An interpolating scheme: rules for the new points and for the normals. `refine` owns the loop.

    A rule sees one level: its tables, and the positions and unit normals of the vertices that there are. It never sees
    the level's number, or other levels.
    """

    h: eqx.AbstractVar[Float[Array, "..."]]
    weights: eqx.AbstractVar[Weights]
    """How corner normals are weighed in (6)."""
    boundary: eqx.AbstractVar[Boundary]
    """Where the normal of a new boundary vertex comes from."""

    @property
    @abstractmethod
    def recomputes_normals(self) -> bool:
        """Whether old vertices get new normals at every level."""

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


def new_normals(
    scheme: AbstractScheme, level: Level, edges: Edges, n: Float[Array, "v 3"], x: Float[Array, "w 3"]
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
