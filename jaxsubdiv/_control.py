"""The values of a control mesh: what a refined surface is a function of."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


def strong_float(value: Any) -> Float[Array, "..."]:
    """`value` as a floating point array of a definite type: a weak one would compile everything once more."""
    if isinstance(value, str):  # JAX would look for a type of this name
        raise TypeError(f"numbers are needed; got the text {value[:40]!r}.")
    array = jnp.asarray(value)
    weak = array.weak_type or not jnp.issubdtype(array.dtype, jnp.floating)
    return jnp.asarray(array, jnp.result_type(float) if weak else array.dtype)


class Control(eqx.Module):
    """Vertices and normals of a control mesh.

    Attributes:
        vertices: positions, in the unit of the mesh (mm for scans).
        normals: one a vertex, of any length: only the direction counts. A zero normal gives no bend from its end.

    Leading axes are a batch for `jax.vmap`.
    """

    vertices: Float[Array, "*batch v 3"] = eqx.field(converter=strong_float)
    normals: Float[Array, "*batch v 3"] = eqx.field(converter=strong_float)
