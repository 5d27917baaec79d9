"""Vector algebra whose gradients are finite at every row, in two layouts.

Rows hold the vectors in memory and between stages: the last axis, of length 3. `Vectors` hold the coordinates apart,
and are what is computed with inside a stage: nothing is then broadcast or summed along an axis of 3, which XLA's CPU
backend does slowly, and in a gradient twice so. Every function here takes either layout and gives back the same.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Bool, Float, Int

_SHORT = 1e-15

PerRow: TypeAlias = Float[Array, "*rows 1"]


class Vectors(eqx.Module):
    """Vectors with their coordinates apart."""

    x: PerRow
    y: PerRow
    z: PerRow

    def __add__(self, other: "Vectors") -> "Vectors":
        return Vectors(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vectors") -> "Vectors":
        return Vectors(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, factor: Array | float) -> "Vectors":
        return Vectors(self.x * factor, self.y * factor, self.z * factor)

    __rmul__ = __mul__

    def __truediv__(self, divisor: Array | float) -> "Vectors":
        return Vectors(self.x / divisor, self.y / divisor, self.z / divisor)


if TYPE_CHECKING:
    Rows: TypeAlias = Any  # pyright sees no sums and products in a union
else:
    Rows: TypeAlias = Float[Array, "*rows 3"] | Vectors


def split_rows(rows: Rows) -> Vectors:
    """Rows as `Vectors`: a split and no slices, whose adjoint is one concatenation where those of slices are pads."""
    return rows if isinstance(rows, Vectors) else Vectors(*lax.split(rows, (1, 1, 1), axis=rows.ndim - 1))


def join_rows(vectors: Rows) -> Float[Array, "*rows 3"]:
    """`Vectors` as rows."""
    if not isinstance(vectors, Vectors):
        return vectors
    return jnp.concatenate([vectors.x, vectors.y, vectors.z], axis=-1)


def _convert_like(given: Rows, found: Vectors) -> Any:
    return found if isinstance(given, Vectors) else join_rows(found)


def scale_to_moderate_length(normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Directions whose squares stay in the range of single precision: rows far from length 1 are scaled to it."""
    size = np.abs(normals).max(axis=1, keepdims=True, initial=0)
    far = np.isfinite(size) & (size > 0) & ((size < _SHORT) | (size > 1 / _SHORT))
    return np.divide(normals, size, out=normals.copy(), where=far)


def take(rows: Float[Array, "v _"], index: Int[Array, "*i"]) -> Float[Array, "*i _"]:
    """`rows[index]`, without the wrap and clamp of indices: the tables are known to be in range."""
    return rows.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def take_each(rows: Float[Array, "v _"], table: Int[Array, "m k"]) -> list[Float[Array, "1 m _"]]:
    """The rows that each of the `k` columns of a table names: one gather, whose adjoint is one scatter."""
    return list(lax.split(take(rows, table.T), (1,) * table.shape[1], axis=0))


def compile_apart(stage: Callable) -> Callable:
    """A stage of a refinement that XLA's CPU backend compiles as a program of its own.

    Else it fuses a level into the gathers that read it, and computes every row again for each of its readers: 2 to 3
    times slower forward, 2 times backward. A call that must not be inlined is kept in reverse and forward mode and
    under `vmap`. What a gradient needs of the stage is computed again, and not kept.
    """

    @functools.wraps(stage)
    def inside(*arguments: Any) -> Any:
        with set_xla_metadata(inlineable=None):  # of the stage as a whole, not of the small calls that it makes
            return stage(*arguments)

    called = jax.jit(jax.checkpoint(inside, prevent_cse=False))

    def run(*arguments: Any) -> Any:
        if jax.default_backend() != "cpu":
            return called(*arguments)
        with set_xla_metadata(inlineable="false"):
            return called(*arguments)

    return run


@compile_apart
def _planes(rows: Float[Array, "v 3"], table: Int[Array, "m k"]) -> Float[Array, "3 k m"]:
    return jnp.moveaxis(take(rows, table.T), 2, 0)


def take_planes(rows: Float[Array, "v 3"], table: Int[Array, "m k"]) -> list[Vectors]:
    """`take_each`, kept apart from what is computed with it: only then does XLA's CPU backend compute on many rows at a
    time. A formula of a few products is faster without."""
    planes = _planes(rows, table)
    return [Vectors(*planes[:, i, None, :, None]) for i in range(table.shape[1])]


def dot(a: Rows, b: Rows) -> PerRow:
    """Dot product of every row; the axis is kept, to multiply rows with."""
    a, b = split_rows(a), split_rows(b)
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Rows, b: Rows) -> Any:
    """Cross product of every row."""
    p, q = split_rows(a), split_rows(b)
    return _convert_like(a, Vectors(p.y * q.z - p.z * q.y, p.z * q.x - p.x * q.z, p.x * q.y - p.y * q.x))


def max_abs(a: Rows) -> PerRow:
    """Largest absolute coordinate of every row, without a gradient: a scale that cannot under- or overflow."""
    a = split_rows(lax.stop_gradient(a))
    return jnp.maximum(jnp.maximum(jnp.abs(a.x), jnp.abs(a.y)), jnp.abs(a.z))


def where(there: Bool[Array, "*rows 1"], a: Rows | PerRow | float, b: Rows | PerRow | float) -> Any:
    """`a` in the rows that are there, else `b`; either may be a number a row, or one for all.

    Inside a stage it stands for `jnp.where`, which is a compiled call itself: in a derivative that would be kept apart.
    """
    if isinstance(a, Vectors) or isinstance(b, Vectors):
        p, q = (jax.tree.leaves(v) if isinstance(v, Vectors) else (v, v, v) for v in (a, b))
        return Vectors(*(where(there, *coordinate) for coordinate in zip(p, q, strict=True)))
    shape, dtype = jnp.broadcast_shapes(there.shape, jnp.shape(a), jnp.shape(b)), jnp.result_type(a, b)
    return lax.select(*(jnp.broadcast_to(v, shape) for v in (there, jnp.asarray(a, dtype), jnp.asarray(b, dtype))))


def unit_or(v: Rows, fallback: Rows | float, vanishes_below: PerRow | float = 0.0) -> Any:
    """Unit vector of every row; `fallback` where the row vanishes.

    Args:
        v: rows of any length. They are scaled by their largest coordinate first, so that neither 1e-30 nor 1e30 is
            lost in the square.
        fallback: what stands in for a vanishing row, put out as it is.
        vanishes_below: a row whose largest coordinate is at or under this counts as zero.

    Returns:
        Rows of length 1, or `fallback`. The gradient in a vanishing row of `v` is 0.
    """
    if not isinstance(v, Vectors):
        if not isinstance(fallback, float):
            fallback = split_rows(jnp.broadcast_to(join_rows(fallback), v.shape))
        return join_rows(unit_or(split_rows(v), fallback, vanishes_below))
    scale = max_abs(v)
    there = scale > jnp.maximum(vanishes_below, jnp.finfo(scale.dtype).tiny)
    # Guarded inside and outside of the root: one guard alone leaves NaN in the gradient of the other branch.
    scaled = where(there, v, 1.0) / where(there, scale, 1.0)
    return where(there, scaled / jnp.sqrt(dot(scaled, scaled)), fallback)


def unit(v: Rows) -> Any:
    """Unit vector of every row; a zero row stays zero, with gradient 0."""
    return unit_or(v, 0.0)


def norm(v: Rows) -> PerRow:
    """Length of every row; the gradient at a zero row is 0."""
    return dot(v, unit(v))
