"""Correspondence: for every scan point the closest point of the surface. On the host, outside of differentiation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

from jaxsubdiv import FaceChoice, RefinedSurface, SurfacePoint
from jaxsubdiv.closest import dot_products, polish, to_faces, triangle_choice, triangle_distance
from jaxsubdiv.half_edges import half_edges

_GROUP = 4  # triangles that stand in the tree as one: refining replaces a face by four, whose rows follow each other
_LARGE, _MOST_PARTS = 1.5, 24  # times the usual size: larger triangles stand in the tree in parts, to so many a side
_SAMPLE = 256  # points that tell how far the others will be
_SHELL = 0.2  # of their distance, beside the reach of a group: points so different are searched together
_PAIRS_AT_ONCE = 2_000_000  # bounds the memory to a few hundred MB, however large scan and surface are
_BLOCK = 8192  # pairs whose numbers fit the processor's cache
_TINY = np.finfo(float).tiny
_SLACK = 1e-9  # relative: by so much bounds are wider than rounding could make them wrong
_ROUNDING = 1e-10  # of squared distances whose parts along and across a normal are subtracted
_THIN = 1e-8  # squared sine of the angle at a corner: the normals of thinner triangles are not exact to `_ROUNDING`


class _Triangles(NamedTuple):
    """A corner, and the edges from it to the next corner and to the one before, coordinate by coordinate."""

    a: Float[np.ndarray, "3 *t"]
    ab: Float[np.ndarray, "3 *t"]
    ac: Float[np.ndarray, "3 *t"]


class _Groups(NamedTuple):
    """Four triangles each, or one part of a large triangle, in balls."""

    centres: Float[np.ndarray, "g 3"]
    radii: Float[np.ndarray, "g"]
    balls: Float[np.ndarray, "16 g"]
    """Of the members: the middle, in the plane of the triangle, and the radius. Missing ones are infinitely far."""
    triangles: Int[np.ndarray, "4 g"]


def closest_points(
    surface: RefinedSurface, points: Float[Array | np.ndarray, "p 3"], choice: FaceChoice | None = None
) -> SurfacePoint:
    """Closest surface point of every point: the face and where in it, not the nearest vertex.

    Triangles are searched exactly: a triangle near the point bounds its distance, and every triangle that may lie
    within the bound is looked at. Of triangles that are equally near to rounding it is the first: the result does not
    depend on the other points or on the number of threads. A quad is searched as its two triangles; the place found is
    then moved to the closest one on the bilinear patch, which `js.evaluate` puts there.

    Args:
        surface: values on the host or on the device.
        points: positions in the unit of the surface.
        choice: the faces that each point may lie on; default: all.
    """
    vertices = np.asarray(surface.vertices, np.float64)
    points = np.asarray(points, np.float64)
    by_coordinate = np.ascontiguousarray(vertices.T)
    a, b, c = (np.take(by_coordinate, column, axis=1) for column in np.asarray(surface.triangles()).T)
    triangles = _Triangles(a, b - a, c - a)
    if choice is None:
        triangle, uv = _nearest_triangle(triangles, points)
    else:
        triangle, uv = _nearest_chosen(triangles, points, *triangle_choice(choice, surface))
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
    search = _Search(triangles, points)
    if len(points):
        everyone = np.arange(len(points))
        search.look(everyone, search.usual_distance())
        search.look_around(everyone[~search.found])
    return search.nearest, search.uv


def _nearest_chosen(
    triangles: _Triangles,
    points: Float[np.ndarray, "p 3"],
    of_points: Int[np.ndarray, "p"],
    chosen: Bool[np.ndarray, "k t"],
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p 2"]]:
    """The nearest of the triangles that are chosen for each point: a search for each row of `chosen`."""
    nearest, uv = np.zeros(len(points), np.int64), np.zeros((len(points), 2))
    for row in np.unique(of_points):
        own, which = np.flatnonzero(of_points == row), np.flatnonzero(chosen[row])
        if not len(which):
            raise ValueError(f"there is no face that point {own[0]} may lie on.")
        part = _Triangles(*(rows[:, which] for rows in triangles))
        found, uv[own] = _nearest_triangle(part, points[own])
        nearest[own] = which[found]
    return nearest, uv


class _Search:
    """Of the nearest triangles of points: bounds of the distances first, then all triangles within them."""

    def __init__(self, triangles: _Triangles, points: Float[np.ndarray, "p 3"]):
        self._triangles = _Triangles(*(np.ascontiguousarray(rows) for rows in triangles))
        self._rows, self._points = points, np.ascontiguousarray(points.T)
        self._normals, self._groups = _normals(self._triangles), _groups(self._triangles)
        self._tree = _tree(self._groups.centres)
        self._reach = float(self._groups.radii.max())
        a, ab, ac = self._triangles
        size = max(np.abs(corner).max() for corner in (a, a + ab, a + ac)) + np.abs(self._points).max(axis=0, initial=0)
        self._rounding = 32 * np.finfo(float).eps * size  # of a distance
        self._bounds, self._distances = np.full((2, len(points)), np.inf)
        self.nearest, self.uv = np.zeros(len(points), np.int64), np.zeros((len(points), 2))
        self.found = np.zeros(len(points), bool)

    def usual_distance(self) -> float:
        """How far most points are from the surface at most, by a few of them."""
        rows = _take_sample(np.arange(len(self._rows)))
        distances = self._bound(rows, np.asarray(self._tree.query(self._rows[rows])[1]))
        most, half = np.quantile(distances, (0.85, 0.5))
        return float(np.clip(1.5 * most, 0.02 * self._reach, max(2 * self._reach, 1.5 * half)))  # not for outliers

    def look_around(self, rows: Int[np.ndarray, "r"]) -> None:
        """Find what is nearest to points that may be far away: those about as far together."""
        for lost in _split_into_parts(rows[np.isinf(self._bounds[rows])], 1.0):
            self._bounds[lost] = self._bound(lost, nearest_rows(self._tree, self._rows[lost], 1)[1][:, 0])
        shells = np.floor(np.log1p(_SHELL * self._bounds[rows] / max(self._reach, _TINY)) / np.log1p(_SHELL))
        for shell in np.unique(shells):
            alike = rows[shells == shell]
            self.look(alike, float(self._bounds[alike].max()))

    def look(self, rows: Int[np.ndarray, "r"], within: float) -> None:
        """Find what is nearest to the points that are no farther than `within` from the surface."""
        pairs = float(len(self._groups.radii))
        if len(rows) * pairs > _PAIRS_AT_ONCE:
            few = self._rows[_take_sample(rows)]
            pairs = float(self._tree.query_ball_point(few, within + self._reach, return_length=True).mean())
        for part in _split_into_parts(rows, pairs):
            self._look(part, within)

    def _look(self, rows: Int[np.ndarray, "r"], within: float) -> None:
        # A triangle that comes within a distance is in a group whose centre is no farther than that and the reach.
        near = _tree(self._rows[rows]).sparse_distance_matrix(self._tree, within + self._reach, output_type="ndarray")
        point, group, to_centre = (np.ascontiguousarray(near[name]) for name in ("i", "j", "v"))
        # The nearest group has a triangle that bounds the distance: mostly the closest one, or one beside it.
        least, first = np.full(len(rows), np.inf), np.full(len(rows), -1)
        np.minimum.at(least, point, to_centre)
        nearest = to_centre == least[point]
        first[point[nearest]] = group[nearest]
        reached = np.flatnonzero(first >= 0)
        row = rows[reached]
        self._bounds[row] = np.minimum(self._bounds[row], self._bound(row, first[reached]))
        sure = self._bounds[rows] <= within
        self.found[rows[sure]] = True
        bound = np.where(sure, self._bounds[rows], -np.inf)[point]
        pair = np.flatnonzero(to_centre <= bound + self._groups.radii[group])
        self._decide(*self._find_within(rows[point[pair]], group[pair], bound[pair]))

    def _bound(self, rows: Int[np.ndarray, "r"], groups: Int[np.ndarray, "r"]) -> Float[np.ndarray, "r"]:
        """Distances of points from a triangle of a group each, a little more."""
        balls = np.take(self._groups.balls, groups, axis=1).reshape(_GROUP, 4, -1)
        away = balls[:, :3] - np.take(self._points, rows, axis=1)
        member = dot_products(away, away).argmin(axis=0)
        distances = self._measure(rows, self._groups.triangles[member, groups])[0]
        return distances * (1 + _SLACK) + 100 * self._rounding[rows]

    def _find_within(
        self, rows: Int[np.ndarray, "k"], groups: Int[np.ndarray, "k"], bounds: Float[np.ndarray, "k"]
    ) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Points and triangles: those of the groups that may lie within the bounds."""
        kept_rows, kept = [rows[:0]], [rows[:0]]
        for start in range(0, len(rows), _BLOCK):
            row, group, bound = (values[start : start + _BLOCK] for values in (rows, groups, bounds))
            points = np.take(self._points, row, axis=1)
            balls = np.take(self._groups.balls, group, axis=1).reshape(_GROUP, 4, -1)
            for (*middle, radius), triangle in zip(balls, self._groups.triangles, strict=True):
                away = np.stack(middle) - points
                squared = dot_products(away, away, 0)
                hit = np.flatnonzero(squared <= (radius + bound) ** 2)
                which = triangle[group[hit]]
                # A triangle lies in the disc that its plane cuts out of the ball.
                squared = squared[hit]
                rounding = _ROUNDING * squared
                above = dot_products(np.take(self._normals, which, axis=1), away[:, hit], 0) ** 2
                beside = np.sqrt(np.maximum(squared - above - rounding, 0)) - radius[hit]
                to_disc = np.maximum(above - rounding, 0) + np.maximum(beside, 0) ** 2
                near = to_disc <= bound[hit] ** 2
                kept_rows.append(row[hit[near]])
                kept.append(which[near])
        return np.concatenate(kept_rows), np.concatenate(kept)

    def _decide(self, rows: Int[np.ndarray, "m"], triangles: Int[np.ndarray, "m"]) -> None:
        distances, u, v = self._measure(rows, triangles)
        np.minimum.at(self._distances, rows, distances)
        equal = np.flatnonzero(distances <= self._distances[rows] + self._rounding[rows])
        row, triangle = rows[equal], triangles[equal]
        self.nearest[row] = self._triangles.a.shape[1]
        np.minimum.at(self.nearest, row, triangle)
        first = equal[triangle == self.nearest[row]]
        self.uv[rows[first]] = np.stack([u[first], v[first]], axis=1)

    def _measure(
        self, rows: Int[np.ndarray, "m"], triangles: Int[np.ndarray, "m"]
    ) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Distances of points from a triangle each, and u and v of the closest points."""
        distances, u, v = np.zeros((3, len(rows)))
        for start in range(0, len(rows), _BLOCK):
            at = slice(start, start + _BLOCK)
            corner, ab, ac = (np.take(values, triangles[at], axis=1) for values in self._triangles)
            squared, u[at], v[at] = triangle_distance(corner, ab, ac, np.take(self._points, rows[at], axis=1))
            distances[at] = np.sqrt(squared)
        return distances, u, v


def _tree(points: Float[np.ndarray, "c 3"]) -> KDTree:
    return KDTree(points, leafsize=16, balanced_tree=False)  # built faster, and searched as fast


def _take_sample(rows: Int[np.ndarray, "r"]) -> Int[np.ndarray, "s"]:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), _SAMPLE)).astype(int)]


def _split_into_parts(rows: Int[np.ndarray, "r"], pairs: float) -> list[Int[np.ndarray, "s"]]:
    """Rows in parts of `_PAIRS_AT_ONCE`, where each has so many pairs."""
    parts = min(int(np.ceil(len(rows) * pairs / _PAIRS_AT_ONCE)), len(rows))
    return np.array_split(rows, max(parts, 1)) if len(rows) else []


def _normals(triangles: _Triangles) -> Float[np.ndarray, "3 t"]:
    """Unit normals; zero, which makes a ball of the disc, where a triangle is so thin that its normal is not exact."""
    (x, y, z), (p, q, r) = triangles.ab, triangles.ac
    normals = np.stack([y * r - z * q, z * p - x * r, x * q - y * p])
    squared = dot_products(normals, normals, 0)
    sound = squared > _THIN * dot_products(triangles.ab, triangles.ab, 0) * dot_products(triangles.ac, triangles.ac, 0)
    return normals * np.where(sound, 1 / np.sqrt(np.where(sound, squared, 1)), 0)


def _groups(triangles: _Triangles) -> _Groups:
    n_triangles = triangles.a.shape[1]
    members = np.minimum(np.arange(-(-n_triangles // _GROUP) * _GROUP), n_triangles - 1).reshape(-1, _GROUP).T
    of_members = _Triangles(*(np.take(rows, members, axis=1) for rows in triangles))
    (a, ab, ac), (middles, radii) = of_members, _balls(of_members)
    low = (a + np.minimum(np.minimum(ab, ac), 0)).min(axis=1)
    high = (a + np.maximum(np.maximum(ab, ac), 0)).max(axis=1)
    centres, squared = (low + high) / 2, np.zeros(members.shape[1])
    to_a = a - centres[:, None]
    for corner in (to_a, to_a + ab, to_a + ac):
        squared = np.maximum(squared, dot_products(corner, corner, 0).max(axis=0))
    reach = np.sqrt(squared) * (1 + _SLACK)
    balls = np.concatenate([middles, radii[None]]).swapaxes(0, 1)  # a member's four numbers one after another
    balls[1:, :3][:, :, -1][members[1:, -1] == members[:-1, -1]] = np.inf  # the last row, repeated
    largest = max(_LARGE * np.median(reach), _TINY)
    large = reach > largest
    if large.any():
        owner, points, sizes = _parts(triangles, np.unique(members[:, large]), largest)
        alone = np.full((_GROUP, 4, len(owner)), np.inf)
        alone[:, 3], alone[0] = 0, np.vstack([points, sizes])
        balls = np.concatenate([balls[..., ~large], alone], axis=2)
        members = np.concatenate([members[:, ~large], np.tile(owner, (_GROUP, 1))], axis=1)
        centres = np.concatenate([centres[:, ~large], points], axis=1)
        reach = np.concatenate([reach[~large], sizes])
    return _Groups(np.ascontiguousarray(centres.T), reach, balls.reshape(4 * _GROUP, -1), members)


def _balls(triangles: _Triangles) -> tuple[Float[np.ndarray, "3 t s"], Float[np.ndarray, "t s"]]:
    """Middles of the triangles, and how far the corners are from them."""
    a, ab, ac = triangles
    middle = (ab + ac) / 3
    squared = dot_products(middle, middle, 0)
    for side in (ab, ac):
        squared = np.maximum(squared, dot_products(middle - side, middle - side, 0))
    return a + middle, np.sqrt(squared) * (1 + _SLACK)


def _parts(
    triangles: _Triangles, which: Int[np.ndarray, "l"], largest: float
) -> tuple[Int[np.ndarray, "c"], Float[np.ndarray, "3 c"], Float[np.ndarray, "c"]]:
    """Equal parts of triangles, as many as make them no larger: whose they are, their middles and radii."""
    a, ab, ac = (rows[:, which, None] for rows in triangles)
    radii = _balls(_Triangles(a, ab, ac))[1][:, 0]
    number = np.clip(np.ceil(radii / largest), 1, _MOST_PARTS).astype(int)
    owner, points, sizes = [], [], []
    for n in np.unique(number):
        cut = number == n
        i, j = (index.ravel() for index in np.meshgrid(range(n), range(n), indexing="ij"))
        # Of a triangle cut in n a side: the parts that stand like it, then those upside down.
        u, v = (np.concatenate([(x + 1 / 3)[i + j < n], (x + 2 / 3)[i + j < n - 1]]) / n for x in (i, j))
        points.append((a[:, cut] + u * ab[:, cut] + v * ac[:, cut]).reshape(3, -1))
        owner.append(np.repeat(which[cut], len(u)))
        sizes.append(np.repeat(radii[cut] / n, len(u)))
    return np.concatenate(owner), np.concatenate(points, axis=1), np.concatenate(sizes)
