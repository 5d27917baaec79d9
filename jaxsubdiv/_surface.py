"""The refined surface, and points on it: evaluate, sample."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from .linalg import cross, norm, take, unit


class RefinedSurface(eqx.Module):
    """A mesh of triangles and quads as a refinement leaves it, differentiable in its vertices and normals.

    Attributes:
        vertices: positions, in the unit of the control mesh.
        normals: unit normals at the vertices, as the scheme has them.
        faces: `{3: [T, 3], 4: [Q, 4]}`, both always present, oriented like the control faces. As one numbering, for
            `SurfacePoint.face`, the triangles come first, then the quads.
    """

    vertices: Float[Array, "*batch v 3"]
    normals: Float[Array, "*batch v 3"]
    faces: dict[int, Int[Array, "..."]]

    @property
    def n_faces(self) -> int:
        """Number of triangles and quads."""
        return self.faces[3].shape[0] + self.faces[4].shape[0]

    @eqx.filter_jit
    def triangles(self) -> Int[Array, "s 3"]:
        """Every face as triangles: the triangles, then every quad as two, cut from its first to its third corner."""
        quads = self.faces[4]
        halves = jnp.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1)
        return jnp.concatenate([self.faces[3], halves.reshape(-1, 3)])

    @eqx.filter_jit
    def areas(self) -> Float[Array, "f"]:
        """Area of every face, triangles first, in the squared unit of the vertices; a quad as its two triangles."""
        areas = self._triangle_areas()
        n = self.faces[3].shape[0]
        return jnp.concatenate([areas[:n], areas[n::2] + areas[n + 1 :: 2]])

    @eqx.filter_jit
    def vertex_areas(self) -> Float[Array, "v"]:
        """Every vertex' share of the area, an equal part of each of its faces, in the squared unit of the vertices."""
        areas, total, before = self.areas(), jnp.zeros_like(self.vertices[:, 0]), 0
        for size in (3, 4):
            faces = self.faces[size]
            shares = jnp.repeat(areas[before : before + len(faces)] / size, size)
            total = total.at[faces.reshape(-1)].add(shares)
            before += len(faces)
        return total

    @eqx.filter_jit
    def bounding_box(self) -> Float[Array, "2 3"]:
        """Least and greatest coordinates of the vertices that faces use."""
        used = take(self.vertices, self.triangles().reshape(-1))
        return jnp.stack([used.min(axis=0), used.max(axis=0)])

    def _triangle_areas(self) -> Float[Array, "s"]:
        a, b, c = (take(self.vertices, corner) for corner in self.triangles().T)
        return norm(cross(b - a, c - a))[:, 0] / 2


class SurfacePoint(eqx.Module):
    """Places on a surface that stay what they are when the surface moves.

    Attributes:
        face: rows of faces, the triangles numbered first, then the quads.
        uv: coordinates inside: a triangle's point is `(1-u-v) a + u b + v c`, a quad's the bilinear
            `(1-u)(1-v) a + u(1-v) b + uv c + (1-u)v d`.
    """

    face: Int[Array, "*p"] = eqx.field(converter=jnp.asarray)
    uv: Float[Array, "*p 2"] = eqx.field(converter=jnp.asarray)


class PointsAndNormals(NamedTuple):
    """Points on a surface and the unit normals there."""

    points: Float[Array, "*p 3"]
    normals: Float[Array, "*p 3"]


def corner_weights(surface: RefinedSurface, at: SurfacePoint) -> tuple[Int[Array, "*p 4"], Float[Array, "*p 4"]]:
    """The four vertices that a surface point lies between, and their weights; a triangle's fourth has weight 0."""
    triangles, quads = surface.faces[3], surface.faces[4]
    n_triangles = triangles.shape[0]
    # Triangles repeat their last corner, so that one table holds both.
    as_quads = jnp.concatenate([jnp.concatenate([triangles, triangles[:, 2:]], axis=1), quads])
    corners = as_quads[at.face]
    u, v = at.uv[..., 0].astype(surface.vertices.dtype), at.uv[..., 1].astype(surface.vertices.dtype)
    in_triangle = jnp.stack([1 - u - v, u, v, jnp.zeros_like(u)], axis=-1)
    in_quad = jnp.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)
    return corners, jnp.where((at.face < n_triangles)[..., None], in_triangle, in_quad)


@jax.jit
def evaluate(surface: RefinedSurface, at: SurfacePoint) -> PointsAndNormals:
    """Points on the surface and the normals there, differentiable in the surface and in `uv`.

    Args:
        surface: a refined surface, flat in its triangles and bilinear in its quads.
        at: where; `face` must be in range, as an index that is not cannot raise inside a compiled program.

    Returns:
        Points in the unit of the surface, and its vertex normals interpolated likewise and made unit.
    """
    corners, weights = corner_weights(surface, at)
    points = sum_corners(surface.vertices, corners, weights)
    return PointsAndNormals(points, unit(sum_corners(surface.normals, corners, weights)))


def sum_corners(
    values: Float[Array, "v 3"], corners: Int[Array, "*p 4"], weights: Float[Array, "*p 4"]
) -> Float[Array, "*p 3"]:
    """Values at the four corners, weighted and added."""
    terms = (take(values, corners[..., i]) * weights[..., i, None] for i in range(4))
    first, second, third, fourth = terms
    return (first + second) + (third + fourth)


@partial(jax.jit, static_argnums=1)
def sample_surface_points(surface: RefinedSurface, n: int, key: PRNGKeyArray | Array) -> SurfacePoint:
    """`n` places drawn by area; the draw has no gradient. See `sample` for what it is in quads."""
    areas = jax.lax.stop_gradient(surface._triangle_areas())
    of_triangle, of_uv = jax.random.split(key)
    triangle = jax.random.choice(of_triangle, areas.shape[0], (n,), p=areas / areas.sum())
    u, v = jax.random.uniform(of_uv, (2, n), areas.dtype)
    u, v = jnp.where(u + v > 1, 1 - u, u), jnp.where(u + v > 1, 1 - v, v)
    n_triangles = surface.faces[3].shape[0]
    half = triangle - n_triangles
    # The halves of a quad, (a, b, c) and (a, c, d), in its own coordinates: a + u (b - a) + v (c - a), and so on.
    second_half = half % 2 == 1
    quad_u, quad_v = jnp.where(second_half, u, u + v), jnp.where(second_half, u + v, v)
    in_triangle = triangle < n_triangles
    face = jnp.where(in_triangle, triangle, n_triangles + half // 2)
    return SurfacePoint(face, jnp.stack([jnp.where(in_triangle, u, quad_u), jnp.where(in_triangle, v, quad_v)], axis=1))


def sample(surface: RefinedSurface, n: int, key: PRNGKeyArray | Array) -> PointsAndNormals:
    """`n` points drawn uniformly by area, and the normals there; differentiable in the surface at fixed places.

    Every triangle, and each half of a quad, gets points by its area. Inside they lie uniformly in triangles and
    parallelograms; in a quad of another shape the density varies as the bilinear map stretches.

    Args:
        surface: the surface.
        n: how many.
        key: a `jax.random.key`.
    """
    return evaluate(surface, sample_surface_points(surface, n, key))
