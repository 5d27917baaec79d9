"""Quantities of surfaces as differentiable functions of their vertices, which measures with deviations are made of."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import cross, dot, norm, take, unit

QUANTILES = (0.05, 0.5, 0.95)
_BAND = 0.05  # of the area: a quantile is the mean over as much of it about its rank
_G_CM2 = 1e-5  # of mm^5 at 1 g/ml


class Solid(NamedTuple):
    """The inside of a closed surface, filled evenly at 1 g/ml."""

    centre: Float[Array, "3"]
    """Of mass, in mm."""
    inertia: Float[Array, "3"]
    """Principal moments about it, the least first, in g cm^2."""


@jax.jit
def measure_solid(vertices: Float[Array, "v 3"], triangles: Int[Array | np.ndarray, "t 3"]) -> Solid:
    """The centre and the principal moments of inertia of what a closed surface encloses.

    Sums over the tetrahedra between a place in the middle and each triangle (a, b, c), of the volume d / 6 with
    d = a . (b x c): the integral of x is d / 24 s, and that of x x' is d / 120 (s s' + a a' + b b' + c c'), with
    s = a + b + c.

    Args:
        vertices: in mm.
        triangles: wound outwards.
    """
    middle = jnp.mean(vertices, axis=0, keepdims=True)
    x = vertices - middle
    corners = [take(x, corner) for corner in jnp.asarray(triangles).T]
    a, b, c = corners
    d, s = dot(a, cross(b, c)), a + b + c
    volume = jnp.sum(d) / 6
    centre = jnp.sum(d * s, axis=0) / (24 * volume)
    products = sum(jnp.einsum("tx,ty->xy", d * row, row) for row in (s, *corners)) / 120
    products = products - volume * centre[:, None] * centre[None]
    moments = jnp.trace(products) * jnp.eye(3, dtype=x.dtype) - products
    return Solid(middle[0] + centre, _G_CM2 * jnp.linalg.eigvalsh(moments))


def find_bands(values: Float[np.ndarray, "v"], areas: Float[np.ndarray, "v"]) -> Float[np.ndarray, "q v"]:
    """Weights of the vertices in the mean about each quantile of a value, by their areas."""
    order = np.argsort(values)
    rank = np.empty(len(values))
    total = np.cumsum(areas[order])
    rank[order] = (total - areas[order] / 2) / max(total[-1], np.finfo(float).tiny)
    near = np.abs(rank - np.array(QUANTILES)[:, None]) <= _BAND / 2
    none = ~near.any(axis=1)
    near[none, np.argmin(np.abs(rank - np.array(QUANTILES)[:, None]), axis=1)[none]] = True
    weights = near * np.maximum(areas, np.finfo(float).tiny)
    return weights / weights.sum(axis=1, keepdims=True)


@jax.jit
def measure_curvature(
    vertices: Float[Array, "v 3"], faces: dict[int, Array]
) -> tuple[Float[Array, "v"], Float[Array, "v"]]:
    """Mean and Gaussian curvature at every vertex, by finite differences over the refined surface.

    The normals follow from its faces, exactly on a ball, and the curvatures from how they turn along its edges. The
    curvature of the interpolating scheme has no bound at control vertices: finer levels show larger ones there. On the
    level of a fit it is a mean over an edge of that level.

    Source: N. Max, Weights for computing vertex normals from facet normals, 1999 (normals).
    """
    triangles = js.RefinedSurface(vertices, vertices, faces).triangles()
    sums = jnp.zeros_like(vertices)
    for turn in range(3):
        corner, ahead, behind = jnp.roll(triangles, -turn, axis=1).T
        one, other = (take(vertices, end) - take(vertices, corner) for end in (ahead, behind))
        lengths = dot(one, one) * dot(other, other)
        sums = sums.at[corner].add(cross(one, other) / jnp.where(lengths > 0, lengths, 1.0))
    normals = unit(sums)
    found = js.curvatures(js.RefinedSurface(vertices, normals, faces))
    return found.mean, found.gaussian


class Crossing(NamedTuple):
    """Where a plane passes a surface: segments that follow each other around its contours."""

    edges: Int[np.ndarray, "s 2 2"]
    """Of each segment, the edge that it comes from and the one that it goes to, by their vertices: the first below the
    plane."""
    contours: tuple[Int[np.ndarray, "_"], ...]
    """Segments of each contour, in their order."""
    is_closed: bool
    """Whether every contour comes back to where it began."""


def find_crossing(
    vertices: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    origin: Float[np.ndarray, "3"],
    normal: Float[np.ndarray, "3"],
) -> Crossing:
    """The segments along which a plane passes the triangles of a surface, which its normal sees run around the inside
    to the left."""
    above = (vertices - origin) @ normal > 0
    passing = triangles[above[triangles].any(axis=1) & ~above[triangles].all(axis=1)]
    rows = np.arange(len(passing))
    sides = above[passing]
    alone = np.where(sides.sum(axis=1) == 1, sides.argmax(axis=1), (~sides).argmax(axis=1))
    a, b, c = (passing[rows, (alone + step) % 3] for step in range(3))
    is_up = above[a][:, None]
    one, two = np.stack([a, b], axis=1), np.stack([a, c], axis=1)
    # Outwards is to the right: from the side (a, b) to (a, c) where a alone is above.
    start, end = np.where(is_up, one, two), np.where(is_up, two, one)
    ends = np.stack([start, end], axis=1)
    ends = np.where(above[ends[..., :1]], ends[..., ::-1], ends)
    contours, is_closed = _chain(ends)
    return Crossing(ends, contours, is_closed)


def _chain(ends: Int[np.ndarray, "s 2 2"]) -> tuple[tuple[Int[np.ndarray, "_"], ...], bool]:
    """Segments in the order in which they follow each other."""
    starts = {tuple(edge): i for i, edge in enumerate(ends[:, 0].tolist())}
    after = [starts.get(tuple(edge)) for edge in ends[:, 1].tolist()]
    is_after = {row for row in after if row is not None}
    order = [*(i for i in range(len(ends)) if i not in is_after), *range(len(ends))]  # open contours from their ends
    left, contours = set(range(len(ends))), []
    for first in order:
        contour, row = [], first
        while row is not None and row in left:
            left.discard(row)
            contour.append(row)
            row = after[row]
        if contour:
            contours.append(np.array(contour))
    return tuple(contours), len(is_after) == len(ends)


def crossing_points(
    vertices: Float[Array, "v 3"],
    crossing: Crossing,
    origin: Float[np.ndarray, "3"],
    normal: Float[np.ndarray, "3"],
) -> Float[Array, "s 2 3"]:
    """Both ends of every segment."""
    places = vertices[jnp.asarray(crossing.edges)]
    height = (places - jnp.asarray(origin, vertices.dtype)[None, None, None]) @ jnp.asarray(normal, vertices.dtype)
    below, over = height[..., 0], height[..., 1]
    part = (below / (below - over))[..., None]
    return places[..., 0, :] + part * (places[..., 1, :] - places[..., 0, :])


def measure_crossing(ends: Float[Array, "s 2 3"], normal: Float[np.ndarray, "3"]) -> Float[Array, "2"]:
    """The area inside of the segments, in the squared unit, and their length."""
    middle = jnp.mean(ends, axis=(0, 1))[None]
    a, b = ends[:, 0] - middle, ends[:, 1] - middle
    area = jnp.sum(cross(a, b) @ jnp.asarray(normal, ends.dtype)) / 2
    return jnp.stack([area, jnp.sum(norm(b - a))])
