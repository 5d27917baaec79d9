"""Curvatures at the vertices of a surface, from how its normals turn along its edges."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._surface import RefinedSurface
from .linalg import cross, dot, norm, take, unit


class Curvatures(NamedTuple):
    """Curvatures at the vertices, per unit of length, or its square. Positive where the surface bends away from its
    normals: on a sphere of radius r with outward normals all are 1/r. 0 at a vertex without faces."""

    gaussian: Float[Array, "v"]
    mean: Float[Array, "v"]
    principal: Float[Array, "v 2"]
    """The larger one first. Where both are equal, their gradient is that of the mean."""


@jax.jit
def curvatures(surface: RefinedSurface) -> Curvatures:
    """Curvatures at the vertices, differentiable in the vertices and the normals.

    At every vertex the symmetric matrix S that comes closest, over its edges and the diagonals of its quads, to
    n_j - n_i = S (x_j - x_i) in the tangent plane, each weighed by 1/|x_j - x_i|^2. Exact on spheres, cylinders and
    planes with their own normals; else it converges with the edge length, as fast as the normals do.
    """
    x, n = surface.vertices, surface.normals
    pairs = []
    for faces in surface.faces.values():
        size = faces.shape[1]
        for ahead in range(1, size):
            pairs.append(jnp.stack([faces, jnp.roll(faces, -ahead, axis=1)], axis=-1).reshape(-1, 2))
    a, b = jnp.concatenate(pairs).T
    least = jnp.argmin(jnp.abs(n), axis=1)
    first = unit(cross(n, jnp.eye(3, dtype=n.dtype)[least]))
    second = cross(n, first)

    def total(rows: Float[Array, "e 1"]) -> Float[Array, "v"]:
        return jnp.zeros(x.shape[0], x.dtype).at[a].add(rows[:, 0])

    along, turn = take(x, b) - take(x, a), take(n, b) - take(n, a)
    e1, e2 = take(first, a), take(second, a)
    square = dot(along, along)
    weight = jnp.where(square > 0, 1 / jnp.where(square > 0, square, 1.0), 0.0)
    u, v, du, dv = dot(along, e1), dot(along, e2), dot(turn, e1), dot(turn, e2)
    uu, uv, vv = total(weight * u * u), total(weight * u * v), total(weight * v * v)
    p, q, r = total(weight * u * du), total(weight * (v * du + u * dv)), total(weight * v * dv)
    # [uu uv 0; uv uu+vv uv; 0 uv vv] (S11, S12, S22) = (p, q, r), by elimination of the outer two.
    trace = uu + vv
    determinant = trace * (uu * vv - uv * uv)
    there = determinant > 16 * jnp.finfo(x.dtype).eps * trace**3
    d = jnp.where(there, determinant, 1.0)
    s11 = jnp.where(there, (p * (trace * vv - uv**2) - q * uv * vv + r * uv**2) / d, 0.0)
    s12 = jnp.where(there, (-p * uv * vv + q * uu * vv - r * uu * uv) / d, 0.0)
    s22 = jnp.where(there, (p * uv**2 - q * uu * uv + r * (trace * uu - uv**2)) / d, 0.0)
    mean = (s11 + s22) / 2
    spread = norm(jnp.stack([(s11 - s22) / 2, s12, jnp.zeros_like(s12)], axis=1))[:, 0]
    return Curvatures(s11 * s22 - s12**2, mean, jnp.stack([mean + spread, mean - spread], axis=1))
