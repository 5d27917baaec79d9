"""Correspondence: for every scan point the closest point of the surface. On the host, outside of differentiation."""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jaxsubdiv import RefinedSurface, SurfacePoint
from jaxsubdiv.half_edges import half_edges

_FIRST_CANDIDATES = 20  # enough for nearly all points near the surface
_MORE_CANDIDATES = 4  # times as many, for the points whose closest face is not certain yet
_PAIRS_AT_ONCE = 2_000_000  # bounds the memory to a few hundred MB, however large scan and surface are
_LARGE, _MOST_PARTS = 1.5, 24  # times the usual size: a larger triangle stands in the tree in parts, to so many a side
_QUAD_STEPS = 3

AnyArray: TypeAlias = Any  # of numpy or of JAX: what is below `triangle_distance` serves `_search` too


class _Triangles(NamedTuple):
    """A corner, and the edges from it to the next corner and to the one before, coordinate by coordinate."""

    a: Float[np.ndarray, "3 t"]
    ab: Float[np.ndarray, "3 t"]
    ac: Float[np.ndarray, "3 t"]


class _Centres(NamedTuple):
    """Middles of the triangles, or of equal parts of the large ones."""

    points: Float[np.ndarray, "c 3"]
    triangle: Int[np.ndarray, "c"]
    radius: Float[np.ndarray, "c"]
    """Within which the part lies."""


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
    a, b, c = (vertices[column].T for column in np.asarray(surface.triangles()).T)
    triangle, uv = _nearest_triangle(_Triangles(a, b - a, c - a), points)
    face, uv = to_faces(len(surface.faces[3]), triangle, uv)
    in_quad = np.flatnonzero(face >= len(surface.faces[3]))
    if len(in_quad):
        quad = np.asarray(surface.faces[4])[face[in_quad] - len(surface.faces[3])]
        uv[in_quad] = polish(vertices[quad], points[in_quad], uv[in_quad])
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


def nearest_on_segments(
    a: Float[np.ndarray, "s 3"], b: Float[np.ndarray, "s 3"], points: Float[np.ndarray, "p 3"]
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """The segment from `a` to `b` that is closest to each point, and where on it, 0 to 1."""
    edge = (b - a).T
    segment, uv = _nearest_triangle(_Triangles(a.T, edge, edge), points)  # a triangle without area is its edges
    return segment, uv.sum(axis=1)


def _nearest_triangle(
    triangles: _Triangles, points: Float[np.ndarray, "p 3"]
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p 2"]]:
    centres = _centres(triangles)
    tree, reach = KDTree(centres.points), float(centres.radius.max())
    nearest, uv = np.zeros(len(points), np.int64), np.zeros((len(points), 2))
    squared = np.full(len(points), np.inf)
    unsure, k = np.arange(len(points)), min(_FIRST_CANDIDATES, len(centres.points))
    while len(unsure):
        left = []
        for rows in np.array_split(unsure, -(-len(unsure) * k // _PAIRS_AT_ONCE)):
            to_centre, candidates = nearest_rows(tree, points[rows], k)
            for columns in (slice(0, 1), slice(1, None)):  # the nearest centre's triangle spares most of the others
                # A part lies within its radius of its centre: what is farther by more is not worth a look.
                reached = to_centre[:, columns] - centres.radius[candidates[:, columns]]
                point, column = np.nonzero(reached <= np.sqrt(squared[rows])[:, None])
                triangle = centres.triangle[candidates[point, columns.start + column]]
                corner, ab, ac = (values[:, triangle] for values in triangles)
                found, *places = triangle_distance(corner, ab, ac, points[rows[point]].T)
                closer = found < squared[rows[point]]
                best = np.full(len(rows), np.inf)
                np.minimum.at(best, point[closer], found[closer])
                first = np.flatnonzero(closer & (found == best[point]))[::-1]  # of equals the first is written last
                row = rows[point[first]]
                nearest[row], squared[row] = triangle[first], found[first]
                uv[row] = np.stack([place[first] for place in places], axis=-1)
            # Where the last centre is farther than the closest face and the reach, no face was missed.
            left.append(rows[np.sqrt(squared[rows]) * (1 + 1e-9) + reach > to_centre[:, -1]])
        unsure = np.concatenate(left) if k < len(centres.points) else np.zeros(0, np.int64)
        k = min(_MORE_CANDIDATES * k, len(centres.points))
    return nearest, uv


def _centres(triangles: _Triangles) -> _Centres:
    a, ab, ac = (np.ascontiguousarray(rows.T) for rows in triangles)
    middle = (ab + ac) / 3
    radius = np.sqrt(np.max([_dot(rows, rows) for rows in (middle, middle - ab, middle - ac)], axis=0))
    parts = np.clip(np.ceil(radius / max(_LARGE * np.median(radius), np.finfo(float).tiny)), 1, _MOST_PARTS).astype(int)
    points, owner, sizes = [], [], []
    for n in np.unique(parts):
        which = np.flatnonzero(parts == n)
        i, j = (index.ravel() for index in np.meshgrid(range(n), range(n), indexing="ij"))
        # Of a triangle cut in n a side: the parts that stand like it, then those upside down.
        u, v = (np.concatenate([(x + 1 / 3)[i + j < n], (x + 2 / 3)[i + j < n - 1]]) / n for x in (i, j))
        points.append((a[which, None] + u[:, None] * ab[which, None] + v[:, None] * ac[which, None]).reshape(-1, 3))
        owner.append(np.repeat(which, len(u)))
        sizes.append(np.repeat(radius[which] / n, len(u)))
    return _Centres(np.concatenate(points), np.concatenate(owner), np.concatenate(sizes))


def triangle_distance(
    a: AnyArray, ab: AnyArray, ac: AnyArray, points: AnyArray, xp: Any = np
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Squared distance to a triangle each, and u and v of the closest point, a + u (b - a) + v (c - a).

    Args:
        a, ab, ac: a corner, and the edges from it to the next corner and to the one before; `[3, ...]`, coordinate by
            coordinate, as rows of three are slow.
        points: a point each, likewise.
        xp: numpy or jax.numpy.
    """
    ap = points - a

    def dot(x: AnyArray, y: AnyArray) -> AnyArray:
        return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]

    d00, d01, d11, d20, d21 = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
    area = d00 * d11 - d01 * d01
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)  # False where the area is zero
        # Outside, the closest point lies on one of the edges ab, ac, bc; a triangle without area is its edges alone.
        on_ab = xp.nan_to_num(xp.clip(d20 / d00, 0, 1))
        on_ac = xp.nan_to_num(xp.clip(d21 / d11, 0, 1))
        on_bc = xp.nan_to_num(xp.clip((d21 - d20 - d01 + d00) / (d00 - 2 * d01 + d11), 0, 1))

    def squared(u: AnyArray, v: AnyArray) -> AnyArray:
        away = u[None] * ab + v[None] * ac - ap  # not by the products above: their difference has no digits close by
        return dot(away, away)

    u, v = xp.where(inside, u, on_ab), xp.where(inside, v, 0.0)
    best = squared(u, v)
    for other_u, other_v in ((xp.zeros_like(on_ac), on_ac), (1 - on_bc, on_bc)):
        other = xp.where(inside, np.inf, squared(other_u, other_v))
        closer = other < best
        u, v, best = xp.where(closer, other_u, u), xp.where(closer, other_v, v), xp.where(closer, other, best)
    return best, u, v


def to_faces(n_triangle_faces: int, triangle: AnyArray, uv: AnyArray, xp: Any = np) -> tuple[AnyArray, AnyArray]:
    """From the triangulated view, where a quad is (a, b, c) and (a, c, d), to faces `[p]` and their own `uv [p, 2]`."""
    half = triangle - n_triangle_faces
    in_quad, second = half >= 0, half % 2 == 1
    u, v = uv.T
    quad_uv = xp.stack([xp.where(second, u, u + v), xp.where(second, u + v, v)], axis=1)
    return xp.where(in_quad, n_triangle_faces + half // 2, triangle), xp.where(in_quad[:, None], quad_uv, uv)


def polish(corners: AnyArray, points: AnyArray, uv: AnyArray, xp: Any = np) -> AnyArray:
    """Gauss-Newton steps to the closest point of a bilinear patch `[p, 4, 3]` each, kept inside of it."""
    a, b, c, d = xp.moveaxis(corners, 1, 0)
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
        h01 = xp.where(held_u | held_v, 0.0, h01)
        det = h00 * h11 - h01 * h01
        safe = xp.where(det > 0, det, 1.0)
        step_u = xp.where(held_u | (det <= 0), 0.0, (h11 * g0 - h01 * g1) / safe)
        step_v = xp.where(held_v | (det <= 0), 0.0, (h00 * g1 - h01 * g0) / safe)
        uv = xp.clip(uv - xp.stack([step_u, step_v], axis=1), 0, 1)
    return uv


def _dot(a: AnyArray, b: AnyArray) -> AnyArray:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
