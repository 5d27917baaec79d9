"""Quantities of surfaces to train by: pure functions of arrays, differentiable, finite at degenerate rows.

A surface with leading axes gives one number, or one row of numbers, for each of the batch; points, normals and weights
then have the same leading axes. Lengths are in the unit of the vertices. Closest points are searched exactly, on the
device, without a gradient: the derivative of a distance is that at fixed feet.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from ._admissible import corner_cosines
from ._curvature import curvatures
from ._parts import SurfacePart as SurfacePart
from ._parts import surface_part as surface_part
from ._search_closest import search_closest
from ._search_nearest import search_nearest
from ._surface import RefinedSurface, SurfacePoint, evaluate
from .linalg import cross, dot, norm, take, unit

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def _vectorise(quantity: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """A function of one surface, and of arrays that belong to it, for any leading axes of them all.

    What the function takes by its name alone is the same for the whole batch.
    """
    signature = inspect.signature(quantity)

    @functools.wraps(quantity)
    def call_each(*arguments: Any, **named: Any) -> Any:
        given = signature.bind(*arguments, **named)
        given.apply_defaults()
        surface, *arrays = given.args
        if surface.vertices.ndim == 2:
            return quantity(*given.args, **given.kwargs)
        # Faces have leading axes only where the surfaces have different ones.
        of_faces = {size: 0 if rows.ndim > 2 else None for size, rows in surface.faces.items()}

        def call_one(vertices: Any, normals: Any, faces: Any, *arrays: Any) -> Any:
            return call_each(RefinedSurface(vertices, normals, faces), *arrays, **given.kwargs)

        axes = (0, 0, of_faces, *(0 for _ in arrays))
        return jax.vmap(call_one, in_axes=axes)(surface.vertices, surface.normals, surface.faces, *arrays)

    return call_each


def _mean(rows: Float[Array, "p"], weights: Shaped[Array, "p"] | None) -> Float[Array, ""]:
    """Weighted mean; 0 where the weights are all 0."""
    if weights is None:
        return jnp.mean(rows)
    weights = weights.astype(rows.dtype)
    total = jnp.sum(weights)
    return jnp.where(total > 0, jnp.sum(weights * rows) / jnp.where(total > 0, total, 1.0), 0.0)


@_vectorise
def closest_places(surface: RefinedSurface, points: Float[Array, "p 3"]) -> SurfacePoint:
    """Where the surface is closest to every point: `search_closest`, for any leading axes.

    Several losses of one surface and one cloud can share it.

    Args:
        surface: triangles, quads or both.
        points: positions.
    """
    return search_closest(surface, points.astype(surface.vertices.dtype))


@_vectorise
def distances_to_surface(
    surface: RefinedSurface, points: Float[Array, "p 3"], at: SurfacePoint | None = None
) -> Float[Array, "p"]:
    """Distance of every point from the surface, min over x in S of |p - x|.

    The gradient by the points and by the surface is that at fixed feet, which is exact; it is 0 for a point on the
    surface. `jnp.mean(distances**2)` is smooth there.

    Args:
        surface: triangles, quads or both.
        points: positions.
        at: the closest places, where they are known from `closest_places`.
    """
    points = points.astype(surface.vertices.dtype)
    at = closest_places(surface, points) if at is None else at
    return norm(points - evaluate(surface, at).points)[:, 0]


@_vectorise
def distances_to_points(
    surface: RefinedSurface, points: Float[Array, "p 3"], weights: Float[Array, "p"] | None = None
) -> Float[Array, "v"]:
    """Distance of every vertex of the surface from the nearest point, min over i of |x - p_i|.

    Args:
        surface: triangles, quads or both.
        points: positions.
        weights: those of 0 are not there; default: all are. Distances are 0 where there is none.
    """
    points, x = points.astype(surface.vertices.dtype), surface.vertices
    there = None if weights is None else weights > 0
    found = norm(x - take(points, search_nearest(x, points, there)))[:, 0]
    return found if there is None else jnp.where(there.any(), found, 0.0)


@_vectorise
def chamfer_distance(
    surface: RefinedSurface,
    points: Float[Array, "p 3"],
    weights: Float[Array, "p"] | None = None,
    at: SurfacePoint | None = None,
) -> Float[Array, ""]:
    """Mean squared distance from the points to the surface, plus that from the surface to the points.

    sum w_i d(p_i, S)^2 / sum w_i + sum A_v d(x_v, P)^2 / sum A_v, with A_v the vertices' shares of the area.

    Args:
        surface: triangles, quads or both.
        points: positions.
        weights: of the points, not negative; 0 for rows that fill up a batch of clouds.
        at: the points' closest places, where they are known from `closest_places`.
    """
    there, back = distances_to_surface(surface, points, at), distances_to_points(surface, points, weights)
    return _mean(there**2, weights) + _mean(back**2, surface.vertex_areas())


@_vectorise
def normal_disagreement(
    surface: RefinedSurface,
    points: Float[Array, "p 3"],
    normals: Float[Array, "p 3"],
    weights: Float[Array, "p"] | None = None,
    at: SurfacePoint | None = None,
    *,
    oriented: bool = True,
) -> Float[Array, ""]:
    """Mean of 1 - n_p . n_S between the points' normals and those of the surface at the closest places, 0 to 2.

    Args:
        surface: triangles, quads or both.
        points: positions.
        normals: of the points, of any length; a zero normal counts as one at right angles.
        weights: of the points, not negative.
        at: the points' closest places, where they are known from `closest_places`.
        oriented: whether the normals point outwards for sure; if not, the mean of 1 - (n_p . n_S)^2.
    """
    dtype = surface.vertices.dtype
    at = closest_places(surface, points) if at is None else at
    cosines = dot(unit(normals.astype(dtype)), evaluate(surface, at).normals)[:, 0]
    return _mean(1 - (cosines if oriented else cosines**2), weights)


@_vectorise
def surface_area(surface: RefinedSurface, *, part: SurfacePart | None = None) -> Float[Array, ""]:
    """Area, 1/2 sum |(b - a) x (c - a)| over the triangles; a quad is two. The gradient by a flat triangle is 0.

    Args:
        surface: triangles, quads or both.
        part: some of the faces; default: all.
    """
    triangles = surface.triangles() if part is None else part.triangles
    a, b, c = (take(surface.vertices, corner) for corner in triangles.T)
    return jnp.sum(norm(cross(b - a, c - a))) / 2


@_vectorise
def enclosed_volume(surface: RefinedSurface, *, part: SurfacePart) -> Float[Array, ""]:
    """Volume inside, 1/6 sum a . (b x c) over the triangles; a quad is two. Positive where the faces face outwards.

    Every rim of an open part is closed by the triangles from its sides to its middle: over a flat rim that is flat.

    Args:
        surface: triangles, quads or both.
        part: its faces and rims: `surface_part(topology)`, built once.
    """
    x = surface.vertices - jnp.mean(surface.vertices, axis=0, keepdims=True)  # far from the origin digits are lost
    a, b, c = (take(x, corner) for corner in part.triangles.T)
    volume = jnp.sum(dot(a, cross(b, c)))
    if part.n_rims:
        start, end = (take(x, corner) for corner in part.rims.T)
        number = jnp.zeros(part.n_rims, x.dtype).at[part.rim].add(1)
        middle = jnp.zeros((part.n_rims, 3), x.dtype).at[part.rim].add(start) / number[:, None]
        volume = volume + jnp.sum(dot(take(middle, part.rim), cross(end, start)))
    return volume / 6


@_vectorise
def bending_energy(surface: RefinedSurface) -> Float[Array, ""]:
    """Energy of a thin plate, the integral of k_1^2 + k_2^2 = 4 H^2 - 2 K over the surface; 8 pi for a sphere.

    By `curvatures` at the vertices, each with its share of the area. It has no unit: size does not matter.
    """
    found = curvatures(surface)
    return jnp.sum(surface.vertex_areas() * (4 * found.mean**2 - 2 * found.gaussian))


@_vectorise
def inverted_faces(surface: RefinedSurface, *, margin: float = 0.05) -> Float[Array, ""]:
    """How far faces are turned over: the mean over their corners of max(0, margin - cos)^2.

    cos is that between the normal at the vertex and the face's own normal at this corner, `corner_cosines`. Of a
    control mesh, `RefinedSurface(control.vertices, control.normals, topology.control_faces)`, it keeps the normals
    admissible: the surface is smooth where every cosine is above 0.05. Corners that have no normal are left out.

    Args:
        surface: triangles, quads or both.
        margin: the cosine from which on a corner costs nothing.
    """
    cosines = corner_cosines(surface.vertices, surface.normals, surface.faces)
    return _mean(jnp.maximum(margin - cosines, 0.0) ** 2, cosines != 0)


def edge_lengths(vertices: Float[Array, "*batch v 3"], edges: Int[Array, "e 2"]) -> Float[Array, "*batch e"]:
    """Length of every edge, |x_j - x_i|; the gradient by an edge of no length is 0.

    Args:
        vertices: positions, of the control mesh or of the surface.
        edges: `topology.levels[0].edges` for those of the control mesh.
    """
    ends = vertices[..., edges, :]
    return norm(ends[..., 1, :] - ends[..., 0, :])[..., 0]
