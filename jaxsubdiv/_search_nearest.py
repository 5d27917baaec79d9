"""The nearest of some points inside of compiled programs."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


@partial(jax.jit, static_argnames="memory")
def search_nearest(
    places: Float[Array, "q 3"],
    points: Float[Array, "p 3"],
    there: Bool[Array, "p"] | None = None,
    *,
    memory: int = 1 << 25,
) -> Int[Array, "q"]:
    """The row of the point that is nearest to each place, under `jit` and `vmap`; the first of equally near ones.

    Exact: every distance is computed, so that the time grows with places times points. It has no derivative;
    `points[rows]` has one.

    Args:
        places: positions from which the nearest point is looked for.
        points: positions in the same unit.
        there: which of the points count; default: all. Where none does, the first is found.
        memory: about how many bytes may be used at once: places go in blocks that fit.
    """
    places = lax.stop_gradient(places)
    points = lax.stop_gradient(points).astype(places.dtype)
    n, x = len(places), points.T
    blocks = max(-(-n * len(points) * places.dtype.itemsize // memory), 1)
    size = -(-n // blocks)
    padded = jnp.pad(places, ((0, blocks * size - n), (0, 0)), mode="edge").reshape(blocks, size, 3)

    def nearest(some: Float[Array, "b 3"]) -> Int[Array, "b"]:
        away = [some[:, i, None] - x[i][None] for i in range(3)]  # a difference of squares would lose digits close by
        squared = away[0] ** 2 + away[1] ** 2 + away[2] ** 2
        if there is not None:
            squared = jnp.where(there[None], squared, jnp.inf)
        return jnp.argmin(squared, axis=1).astype(jnp.int32)

    return lax.map(nearest, padded).reshape(-1)[:n]
