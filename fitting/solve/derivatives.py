"""Derivatives of a surface and of the rows on it by the unknowns, along many unknowns at once."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model.residual import Model
from ..model.unknowns import Unknowns, Variables


class Derivatives(NamedTuple):
    """Values at the start of a sweep, and their derivatives along the seeds of the elements, the last seed included."""

    surface: Float[Array, "v 3"]
    rows: Float[Array, "m"]
    """Of the face priors, one after the other."""
    of_surface: Float[Array, "s v 3"]
    of_rows: Float[Array, "s m"]


@eqx.filter_jit
def differentiate(
    model: Model, y: Variables, held: dict[str, Any], seeds: Float[Array | np.ndarray, "s n"]
) -> Derivatives:
    """The surface and the rows of the face priors at the start of a sweep, and their derivatives.

    Args:
        held: what each prior holds.
        seeds: see `Elements`.
    """
    dtype, split = y.control.vertices.dtype, model.layout.split

    def find(offset: Unknowns) -> tuple[Array, Array]:
        moved = model.retract(y, offset)
        place = model.place_of(moved)
        assert place.surface is not None
        none = jnp.zeros(0, dtype)
        rows = jnp.concatenate([none] + [one.rows(place, held[one.name]) for one in model.face_priors])
        return place.surface.vertices, rows

    (surface, rows), derivative = jax.linearize(find, split(jnp.zeros(model.layout.n, dtype)))
    of_surface, of_rows = jax.lax.map(lambda seed: derivative(split(seed)), jnp.asarray(seeds, dtype))
    return Derivatives(surface, rows, of_surface, of_rows)


@eqx.filter_jit
def differentiate_across(
    model: Model, y: Variables, seeds: Float[Array | np.ndarray, "s n"], normals: Float[Array, "v 3"]
) -> Float[Array, "s v"]:
    """How far each vertex of the surface moves along its normal, for a move of the unknowns along each seed."""
    dtype, split = y.control.vertices.dtype, model.layout.split
    zero = split(jnp.zeros(model.layout.n, dtype))
    _, derivative = jax.linearize(lambda offset: model.refine(model.retract(y, offset)).vertices, zero)
    return jax.lax.map(lambda seed: jnp.sum(derivative(split(seed)) * normals, axis=1), jnp.asarray(seeds, dtype))
