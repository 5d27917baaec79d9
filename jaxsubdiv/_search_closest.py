"""Closest points inside of compiled programs: for every point the closest point of the surface, in pure JAX.

Neighbouring rows of faces are neighbours on the surface, because refining replaces a face by its children: sixteen rows
are a patch. A patch lies in a flat cylinder about its mean normal, and the distance from the cylinder bounds that from
the patch. For every point the patches are looked at in the order of their bounds, until the next bound is beyond the
closest triangle found: three patches on average for a point near a smooth surface, ten for a scattered one.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ._surface import RefinedSurface, SurfacePoint
from .closest import FaceChoice, polish, to_faces, triangle_choice, triangle_distance
from .linalg import cross, dot, norm, unit

_ROUNDING = 16.0  # times the precision of the numbers: by so much a bound is too large at most


class _Patches(NamedTuple):
    """Runs of triangles, each in a cylinder."""

    triangles: Float[Array, "k 9 m"]
    """A corner, and the edges from it to the next corner and to the one before."""
    middle: Float[Array, "k 3"]
    axis: Float[Array, "k 3"]
    half_height: Float[Array, "k 1"]
    radius: Float[Array, "k 1"]


class _Found(NamedTuple):
    """How far the search of a point has come."""

    key: Int[Array, ""]
    """Of the next patch to look at."""
    squared: Float[Array, ""]
    """Squared distance of the closest triangle so far."""
    triangle: Int[Array, ""]
    uv: Float[Array, "2"]


@partial(jax.jit, static_argnames=("memory", "patch"))
def search_closest(
    surface: RefinedSurface,
    points: Float[Array, "p 3"],
    choice: FaceChoice | None = None,
    *,
    memory: int = 1 << 25,
    patch: int = 16,
) -> SurfacePoint:
    """Closest surface point of every point, as `closest_points` finds it on the host, under `jit` and `vmap`.

    Exact: the same distances to rounding, on surfaces of any kind; only where two faces are equally near may it be the
    other one. It works in the dtype of the surface, and has no derivative: `evaluate` has one, at fixed places.

    Every point is held against a bound of every patch, so that the time grows with points times faces. It is made for
    programs that must not leave the device; on the host, and on large surfaces, `closest_points` is faster.

    Args:
        surface: triangles, quads or both.
        points: positions in the unit of the surface. One that is not finite gets some place of the surface.
        choice: the faces that each point may lie on; default: all.
        memory: about how many bytes may be used at once, beside the surface: points go in blocks that fit.
        patch: triangles a patch, best a power of four.
    """
    vertices = lax.stop_gradient(surface.vertices)
    points = lax.stop_gradient(points).astype(vertices.dtype)
    patches, n = _patches(vertices, surface.triangles(), patch), len(points)
    a_point = vertices.dtype.itemsize * (4 * len(patches.middle) + 40 * patch)
    blocks = max(-(-n * a_point // memory), 1)
    size = -(-n // blocks)
    padded = jnp.pad(points, ((0, blocks * size - n), (0, 0)), mode="edge").reshape(blocks, size, 3)
    if choice is None:
        triangle, uv = lax.map(jax.vmap(lambda point: _search(patches, point)), padded)
    else:
        rows, chosen = triangle_choice(choice, surface, jnp)
        chosen = jnp.pad(chosen, ((0, 0), (0, len(patches.middle) * patch - chosen.shape[1])), mode="edge")
        chosen = chosen.reshape(len(chosen), -1, patch)
        rows = jnp.pad(rows, (0, blocks * size - n), mode="edge").reshape(blocks, size)
        of_one = jax.vmap(lambda point, row: _search(patches, point, chosen[row]))
        triangle, uv = lax.map(lambda some: of_one(*some), (padded, rows))
    triangle, uv = triangle.reshape(-1)[:n], uv.reshape(-1, 2)[:n]
    n_triangles, quads = surface.faces[3].shape[0], surface.faces[4]
    face, uv = to_faces(n_triangles, triangle, uv, jnp)
    if len(quads):
        corners = vertices[quads[jnp.maximum(face - n_triangles, 0)]]
        uv = jnp.where((face >= n_triangles)[:, None], polish(corners, points, uv, jnp), uv)
    return SurfacePoint(face, uv)


def _patches(vertices: Float[Array, "v 3"], triangles: Int[Array, "s 3"], patch: int) -> _Patches:
    n = -(-len(triangles) // patch)
    filled = jnp.pad(triangles, ((0, n * patch - len(triangles)), (0, 0)), mode="edge")
    corners = vertices[filled].reshape(n, patch, 3, 3)
    a, b, c = (corners[:, :, i] for i in range(3))
    # Where the normals cancel there is no axis, and the cylinder is a sphere.
    axis = unit(jnp.sum(cross(b - a, c - a), axis=1))
    x = corners.reshape(n, -1, 3)
    middle = (x.min(axis=1) + x.max(axis=1)) / 2
    axes = jnp.broadcast_to(axis[:, None], x.shape)
    along = dot(axes, x - middle[:, None])[..., 0]
    low, high = along.min(axis=1, keepdims=True), along.max(axis=1, keepdims=True)
    middle = middle + axis * (low + high) / 2
    away = x - middle[:, None]
    beside = norm(away - dot(axes, away) * axes)[..., 0]
    edges = jnp.concatenate([a, b - a, c - a], axis=-1)
    return _Patches(edges.swapaxes(1, 2), middle, axis, (high - low) / 2, beside.max(axis=1, keepdims=True))


def _search(
    patches: _Patches, point: Float[Array, "3"], chosen: Bool[Array, "k m"] | None = None
) -> tuple[Int[Array, ""], Float[Array, "2"]]:
    """The closest triangle of a point, of all patches or of those chosen in them, and the place in it."""
    size, number = patches.triangles.shape[-1], (1 << (len(patches.middle) - 1).bit_length()) - 1
    keys, most = _keys(patches, point, number)
    if chosen is not None:
        keys = jnp.where(chosen.any(axis=1), keys, most)

    def is_closer(found: _Found) -> Bool[Array, ""]:
        return lax.bitcast_convert_type(found.key & ~number, point.dtype) < found.squared

    def look(found: _Found) -> _Found:
        patch = (found.key & number).astype(jnp.int32)
        a, ab, ac = jnp.split(patches.triangles[patch], 3)
        squared, u, v = triangle_distance(a, ab, ac, point[:, None], jnp)
        if chosen is not None:
            squared = jnp.where(chosen[patch], squared, jnp.inf)
        best = jnp.argmin(squared).astype(jnp.int32)
        nearer = squared[best] < found.squared
        return _Found(
            jnp.min(jnp.where(keys > found.key, keys, most)),
            jnp.where(nearer, squared[best], found.squared),
            jnp.where(nearer, patch * size + best, found.triangle),
            jnp.where(nearer, jnp.stack([u[best], v[best]]), found.uv),
        )

    # Nothing found yet; made from the arguments, so that under `shard_map` it varies over devices as they do.
    first = jnp.min(keys)
    nothing = (first & 0).astype(jnp.int32)
    zero = nothing.astype(point.dtype)
    none = _Found(first, zero + jnp.inf, nothing, jnp.stack([zero, zero]))
    found = lax.while_loop(is_closer, look, none)
    return found.triangle, found.uv


def _keys(patches: _Patches, point: Float[Array, "3"], number: int) -> tuple[Int[Array, "k"], Int[Array, ""]]:
    """Squared distances of a point from the cylinders with the patches' numbers in their last bits, and infinity.

    Floating point numbers that are not negative have the order of their bits: a minimum tells bound and patch at once.

    Args:
        number: mask of the bits that are the patch's number; without them the bound is a little less, and still one.
    """
    away = point[None] - patches.middle
    rounding = _ROUNDING * jnp.finfo(point.dtype).eps
    along, squared = dot(patches.axis, away), dot(away, away)
    beside = jnp.sqrt(jnp.maximum(squared * (1 - rounding) - along**2, 0.0))
    out = jnp.maximum(jnp.abs(along) - patches.half_height, 0.0), jnp.maximum(beside - patches.radius, 0.0)
    reach = patches.half_height + patches.radius + jnp.sqrt(squared)
    bounds = jnp.maximum(jnp.sqrt(out[0] ** 2 + out[1] ** 2) - rounding * reach, 0.0)[:, 0] ** 2
    as_integer = jnp.int64 if point.dtype == jnp.float64 else jnp.int32
    bits, most = (lax.bitcast_convert_type(x, as_integer) for x in (bounds, jnp.asarray(jnp.inf, point.dtype)))
    return (bits & ~number) | jnp.arange(len(bits), dtype=as_integer), most
