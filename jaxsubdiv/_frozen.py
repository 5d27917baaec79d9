"""Parts of a module that neither gradients nor optimisers touch."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax


class Frozen(eqx.Module):
    """A pytree whose floating point arrays are held by their bits, as integers.

    A stopped gradient is not enough: weight decay also shrinks parameters whose gradient is zero. Everything that
    selects parameters by their floating type passes over these.
    """

    tree: Any
    dtypes: tuple[str | None, ...] = eqx.field(static=True)
    """Of the leaves that are held by their bits; None for the others."""

    def __init__(self, tree: Any):
        leaves, structure = jax.tree.flatten(tree)
        dtypes = [jnp.dtype(leaf.dtype) if eqx.is_inexact_array(leaf) else None for leaf in leaves]
        bits = [
            leaf if dtype is None else lax.bitcast_convert_type(jnp.asarray(leaf), f"int{8 * dtype.itemsize}")
            for leaf, dtype in zip(leaves, dtypes, strict=True)
        ]
        self.tree = jax.tree.unflatten(structure, bits)
        self.dtypes = tuple(None if dtype is None else dtype.name for dtype in dtypes)

    def thaw(self) -> Any:
        """The tree as it was given."""
        leaves, structure = jax.tree.flatten(self.tree)
        found = [
            leaf if dtype is None else lax.bitcast_convert_type(leaf, dtype)
            for leaf, dtype in zip(leaves, self.dtypes, strict=True)
        ]
        return jax.tree.unflatten(structure, found)
