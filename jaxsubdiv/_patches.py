"""Faces whose limit surface is known in closed form: bicubic B-splines and quartic box splines.

Where all corners of a face are regular and no crease is beside them, the limit of Catmull-Clark over a quad is the
bicubic B-spline of the 16 vertices of the faces around it, and that of Loop over a triangle the box spline of 12.
"""

from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._stage import Sides, Stage
from .linalg import take

Coordinate: TypeAlias = Float[Array, "p"]


def patch_vertices(stage: Stage, sides: Sides, size: int, sharp: Bool[np.ndarray, "e"]) -> Int[np.ndarray, "f w"]:
    """Vertices of the patch of every face of `size` corners, -1 where the limit is no such patch.

    Kind by kind, in the order of the corners; see `patch_weights` for the kinds.

    Args:
        stage: the last level.
        sides: of it.
        size: 4 for Catmull-Clark, 3 for Loop.
        sharp: whether an edge is a boundary or a crease at this level.
    """
    start, after, before, twin = sides.start, sides.next, sides.before, sides.twin
    n_faces = np.bincount(start, minlength=stage.n_vertices)
    regular = n_faces == (4 if size == 4 else 6)
    regular[stage.edges[sharp]] = False
    if stage.vertex_sharpness is not None:
        regular &= stage.vertex_sharpness == 0
    regular[start[sides.size != size]] = False
    first = sum(faces.size for corners, faces in stage.faces.items() if corners < size)
    s = first + np.arange(stage.faces[size].size)
    ahead, back = twin[s], twin[before[s]]  # -1, at the boundary, reads nonsense that `regular` takes out
    if size == 4:
        kinds = [start[s], start[after[after[ahead]]], start[before[back]], start[before[twin[after[ahead]]]]]
    else:
        kinds = [start[s], start[before[ahead]], start[before[twin[after[ahead]]]], start[before[twin[before[back]]]]]
    table = np.concatenate([kind.reshape(-1, size) for kind in kinds], axis=1)
    return np.where(regular[stage.faces[size]].all(axis=1)[:, None], table, -1)


def patch_points(table: Int[Array, "p w"], u: Coordinate, v: Coordinate, x: Float[Array, "v 3"]) -> Float[Array, "p 3"]:
    """Points of patches, from vertices that are not yet moved to the limit."""
    weights = _quad_weights(u, v) if table.shape[1] == 16 else _triangle_weights(u, v)
    return (weights[..., None] * take(x, jnp.maximum(table, 0))).sum(axis=1)


def _quad_weights(u: Coordinate, v: Coordinate) -> Float[Array, "p 16"]:
    """Of every corner; of its neighbours across the side after it and across the side before it; and of the one
    diagonally across it. `x` and `y` run from the corner along these two sides."""
    x, y = jnp.stack([u, v, 1 - u, 1 - v], axis=1), jnp.stack([v, 1 - u, 1 - v, u], axis=1)
    (here_x, out_x), (here_y, out_y) = _spline(x), _spline(y)
    return jnp.concatenate([here_x * here_y, here_x * out_y, out_x * here_y, out_x * out_y], axis=1)


def _spline(t: Array) -> tuple[Array, Array]:
    """Cubic B-splines of the knots 0 and -1, at t from 0 to 1."""
    return (4 - 6 * t**2 + 3 * t**3) / 6, (1 - t) ** 3 / 6


def _triangle_weights(u: Coordinate, v: Coordinate) -> Float[Array, "p 12"]:
    """Of every corner; of the vertex across the side after it; and of the corner's two further neighbours, beside that
    one and beside the one across the side before it.

    Source: J. Stam, Evaluation of Loop subdivision surfaces, 1998, appendix A, sorted by symmetry.
    """
    p = jnp.stack([1 - u - v, u, v], axis=1)
    q, r = jnp.roll(p, -1, axis=1), jnp.roll(p, 1, axis=1)
    corner = (
        6 * p**4
        + 24 * p**3 * (q + r)
        + p**2 * (24 * (q**2 + r**2) + 60 * q * r)
        + p * (8 * (q**3 + r**3) + 36 * q * r * (q + r))
        + (q**4 + r**4 + 6 * q * r * (q**2 + r**2) + 12 * q**2 * r**2)
    )
    across = p**4 + q**4 + 6 * p * q * (p**2 + q**2 + r * (p + q)) + 2 * r * (p**3 + q**3) + 12 * p**2 * q**2
    return jnp.concatenate([corner, across, p**4 + 2 * p**3 * q, p**4 + 2 * p**3 * r], axis=1) / 12
