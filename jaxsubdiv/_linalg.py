"""Row-wise vector algebra whose gradients are finite at every row.

Vectors are the last axis, of length 3. Products are written out over the three coordinates: on XLA's CPU backend a
reduction over an axis of 3 takes a slow path (about 3 times slower for a whole refinement).
"""

from typing import TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

Rows: TypeAlias = Float[Array, "*rows 3"]


def take(rows: Float[Array, "v 3"], index: Int[Array, "*i"]) -> Float[Array, "*i 3"]:
    """`rows[index]`, without the wrap and clamp of indices: the tables are known to be in range."""
    return rows.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def dot(a: Rows, b: Rows) -> Float[Array, "*rows 1"]:
    """Dot product of every row; the axis is kept, to multiply rows with."""
    return a[..., 0:1] * b[..., 0:1] + a[..., 1:2] * b[..., 1:2] + a[..., 2:3] * b[..., 2:3]


def cross(a: Rows, b: Rows) -> Rows:
    """Cross product of every row."""
    a0, a1, a2 = a[..., 0:1], a[..., 1:2], a[..., 2:3]
    b0, b1, b2 = b[..., 0:1], b[..., 1:2], b[..., 2:3]
    return jnp.concatenate([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def largest(a: Rows) -> Float[Array, "*rows 1"]:
    """Largest absolute coordinate of every row, without a gradient: a scale that cannot under- or overflow."""
    a = jnp.abs(lax.stop_gradient(a))
    return jnp.maximum(jnp.maximum(a[..., 0:1], a[..., 1:2]), a[..., 2:3])


def unit_or(v: Rows, fallback: Rows | float, vanishes_below: Float[Array, "*rows 1"] | float = 0.0) -> Rows:
    """Unit vector of every row; `fallback` where the row vanishes.

    Args:
        v: rows of any length. They are scaled by their largest coordinate first, so that neither 1e-30 nor 1e30 is
            lost in the square.
        fallback: what stands in for a vanishing row, put out as it is.
        vanishes_below: a row whose largest coordinate is at or under this counts as zero.

    Returns:
        Rows of length 1, or `fallback`. The gradient in a vanishing row of `v` is 0.
    """
    scale = largest(v)
    there = scale > jnp.maximum(vanishes_below, jnp.finfo(v.dtype).tiny)
    # Guarded inside and outside of the root: one guard alone leaves NaN in the gradient of the other branch.
    scaled = jnp.where(there, v, 1.0) / jnp.where(there, scale, 1.0)
    return jnp.where(there, scaled / jnp.sqrt(dot(scaled, scaled)), fallback)


def unit(v: Rows) -> Rows:
    """Unit vector of every row; a zero row stays zero, with gradient 0."""
    return unit_or(v, 0.0)


def norm(v: Rows) -> Float[Array, "*rows 1"]:
    """Length of every row; the gradient at a zero row is 0."""
    return dot(v, unit(v))
