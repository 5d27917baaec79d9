"""Correspondence: for every scan point the closest point of the surface. On the host, outside of differentiation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsubdiv import RefinedSurface, SurfacePoint
from jaxsubdiv._half_edges import half_edges

_FIRST_CANDIDATES = 8
_PAIRS_AT_ONCE = 2_000_000  # bounds the memory to a few hundred MB, however large scan and surface are
_QUAD_STEPS = 3


class _Triangles(NamedTuple):
    """Corners of the triangulated surface."""

    a: Float[np.ndarray, "t 3"]
    b: Float[np.ndarray, "t 3"]
    c: Float[np.ndarray, "t 3"]


def closest_points(surface: RefinedSurface, points: Float[np.ndarray, "p 3"]) -> SurfacePoint:
    """Closest surface point of every point: the face and where in it, not the nearest vertex.

    Triangles are searched exactly: candidates come nearest centre first from a k-d tree, until no face that was not
    looked at can be nearer. A quad is searched as its two triangles; the place found is then moved to the closest one
    on the bilinear patch, which `js.evaluate` puts there.

    Args:
        surface: values on the host or on the device.
        points: positions in the unit of the surface.
    """
    vertices = np.asarray(surface.vertices, np.float64)
    points = np.asarray(points, np.float64)
    corners = _Triangles(*(vertices[column] for column in np.asarray(surface.triangles()).T))
    triangle = _nearest_triangle(corners, points)
    _, uv = _distance_squared(_Triangles(*(corner[triangle] for corner in corners)), points)
    face, uv = _to_faces(len(surface.faces[3]), triangle, uv)
    in_quad = np.flatnonzero(face >= len(surface.faces[3]))
    if len(in_quad):
        quad = np.asarray(surface.faces[4])[face[in_quad] - len(surface.faces[3])]
        uv[in_quad] = _polish(vertices[quad], points[in_quad], uv[in_quad])
    return SurfacePoint(face.astype(np.int32), uv.astype(surface.vertices.dtype))


def boundary_vertices(surface: RefinedSurface) -> Bool[np.ndarray, "v"]:
    """Which vertices lie on an edge that has one face only."""
    sides = half_edges({size: np.asarray(faces) for size, faces in surface.faces.items()})
    faces_at_edge = np.bincount(sides.edge, minlength=len(sides.edges))
    mask = np.zeros(len(surface.vertices), bool)
    mask[sides.edges[faces_at_edge == 1]] = True
    return mask


def nearest_rows(
    tree: KDTree, points: Float[np.ndarray, "p 3"], k: int
) -> tuple[Float[np.ndarray, "p k"], Int[np.ndarray, "p k"]]:
    """Distances and rows of the `k` points of the tree nearest to each point; the last axis stays for `k = 1` too."""
    distances, rows = tree.query(points, k=k, workers=-1)
    return np.reshape(distances, (len(points), k)), np.reshape(rows, (len(points), k))


def _nearest_triangle(corners: _Triangles, points: Float[np.ndarray, "p 3"]) -> Int[np.ndarray, "p"]:
    centres = (corners.a + corners.b + corners.c) / 3
    radii = np.sqrt(np.max([((corner - centres) ** 2).sum(axis=1) for corner in corners], axis=0))
    reach = radii.max()
    tree = KDTree(centres)
    k = min(_FIRST_CANDIDATES, len(centres))
    nearest, distance = np.zeros(len(points), np.int64), np.zeros(len(points))
    unsure = []
    for rows in _chunks(np.full(len(points), k)):
        to_centre, candidates = nearest_rows(tree, points[rows], k)
        squared, _ = _distance_squared(_Triangles(*(corner[candidates] for corner in corners)), points[rows][:, None])
        best, along = squared.argmin(axis=1), np.arange(len(rows))
        nearest[rows], distance[rows] = candidates[along, best], np.sqrt(squared[along, best])
        # A triangle lies within `reach` of its centre: where the last centre is farther than that, none was missed.
        unsure.append(rows[distance[rows] + reach > to_centre[:, -1]])
    rest = np.concatenate(unsure) if k < len(centres) else np.zeros(0, np.int64)
    counts = tree.query_ball_point(points[rest], distance[rest] + reach, workers=-1, return_length=True)
    for part in _chunks(np.asarray(counts)):
        rows = rest[part]
        nearest[rows] = _nearest_in_reach(tree, corners, centres, radii, points[rows], distance[rows])
    return nearest


def _nearest_in_reach(
    tree: KDTree,
    corners: _Triangles,
    centres: Float[np.ndarray, "t 3"],
    radii: Float[np.ndarray, "t"],
    points: Float[np.ndarray, "p 3"],
    distance: Float[np.ndarray, "p"],
) -> Int[np.ndarray, "p"]:
    """Nearest triangle, given one that is `distance` off: looks at all that can be nearer."""
    distance = distance * (1 + 1e-9)  # so that rounding cannot lose the triangle that gave it
    lists = tree.query_ball_point(points, distance + radii.max(), workers=-1)
    triangle = np.concatenate([np.asarray(found, np.int64) for found in lists])
    point = np.repeat(np.arange(len(points)), [len(found) for found in lists])
    to_centre = np.sqrt(((points[point] - centres[triangle]) ** 2).sum(axis=1))
    closer = to_centre - radii[triangle] <= distance[point]
    point, triangle = point[closer], triangle[closer]
    squared, _ = _distance_squared(_Triangles(*(corner[triangle] for corner in corners)), points[point])
    order = np.lexsort((squared, point))
    first = order[np.searchsorted(point[order], np.arange(len(points)))]  # every point still has the one it came with
    return triangle[first]


def _chunks(counts: Int[np.ndarray, "n"]) -> list[Int[np.ndarray, "m"]]:
    """Rows in runs that hold `_PAIRS_AT_ONCE` pairs or less, or one row each."""
    if len(counts) == 0:
        return []
    run = np.cumsum(counts) // _PAIRS_AT_ONCE
    return np.split(np.arange(len(counts)), np.flatnonzero(np.diff(run)) + 1)


def _distance_squared(
    corners: _Triangles, points: Float[np.ndarray, "*#p 3"]
) -> tuple[Float[np.ndarray, "*#p"], Float[np.ndarray, "*#p 2"]]:
    """Squared distance to a triangle, and the place of the closest point: a + u (b - a) + v (c - a)."""
    ab, ac, ap = corners.b - corners.a, corners.c - corners.a, points - corners.a
    d00, d01, d11 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    area = d00 * d11 - d01 * d01
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
        # Outside, the closest point lies on one of the edges ab, ac, bc; a triangle without area is its edges alone.
        on_ab = np.nan_to_num(np.clip(d20 / d00, 0, 1))
        on_ac = np.nan_to_num(np.clip(d21 / d11, 0, 1))
        on_bc = np.nan_to_num(np.clip((d21 - d20 - d01 + d00) / (d00 - 2 * d01 + d11), 0, 1))
    zero = np.zeros_like(on_ab)
    places_u = np.stack([u, on_ab, zero, 1 - on_bc])
    places_v = np.stack([v, zero, on_ac, on_bc])
    squared = ((places_u[..., None] * ab + places_v[..., None] * ac - ap) ** 2).sum(axis=-1)
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)  # False where the area is zero
    squared[0] = np.where(inside, squared[0], np.inf)
    best = squared.argmin(axis=0)[None]
    chosen = (np.take_along_axis(table, best, axis=0)[0] for table in (squared, places_u, places_v))
    distance, u, v = chosen
    return distance, np.stack([u, v], axis=-1)


def _to_faces(
    n_triangle_faces: int, triangle: Int[np.ndarray, "p"], uv: Float[np.ndarray, "p 2"]
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p 2"]]:
    """From the triangulated view, where a quad is (a, b, c) and (a, c, d), to faces and their own coordinates."""
    half = triangle - n_triangle_faces
    in_quad, second = half >= 0, half % 2 == 1
    u, v = uv.T
    quad_uv = np.stack([np.where(second, u, u + v), np.where(second, u + v, v)], axis=1)
    return np.where(in_quad, n_triangle_faces + half // 2, triangle), np.where(in_quad[:, None], quad_uv, uv)


def _polish(
    corners: Float[np.ndarray, "p 4 3"], points: Float[np.ndarray, "p 3"], uv: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, "p 2"]:
    """Gauss-Newton steps to the closest point of a bilinear patch, kept inside of it."""
    a, b, c, d = np.moveaxis(corners, 1, 0)
    twist = a - b + c - d
    for _ in range(_QUAD_STEPS):
        u, v = uv[:, :1], uv[:, 1:]
        along_u, along_v = (b - a) + v * twist, (d - a) + u * twist
        residual = a + u * (b - a) + v * (d - a) + u * v * twist - points
        g0, g1 = _dot(along_u, residual), _dot(along_v, residual)
        h00, h01, h11 = _dot(along_u, along_u), _dot(along_u, along_v), _dot(along_v, along_v)
        # Where a side holds the point fast, the other coordinate moves alone.
        held_u = ((uv[:, 0] <= 0) & (g0 > 0)) | ((uv[:, 0] >= 1) & (g0 < 0))
        held_v = ((uv[:, 1] <= 0) & (g1 > 0)) | ((uv[:, 1] >= 1) & (g1 < 0))
        h01 = np.where(held_u | held_v, 0, h01)
        det = h00 * h11 - h01 * h01
        safe = np.where(det > 0, det, 1)
        step = np.stack([(h11 * g0 - h01 * g1), (h00 * g1 - h01 * g0)], axis=1) / safe[:, None]
        step[det <= 0] = 0
        step[held_u, 0] = 0
        step[held_v, 1] = 0
        uv = np.clip(uv - step, 0, 1)
    return uv


def _dot(a: Float[np.ndarray, "*p 3"], b: Float[np.ndarray, "*p 3"]) -> Float[np.ndarray, "*p"]:
    return np.einsum("...x,...x->...", a, b)
