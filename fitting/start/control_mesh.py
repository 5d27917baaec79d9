"""A control mesh made from a scan, where none is given."""

import warnings
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv.half_edges import half_edges

from ..scan.closest_points import nearest_rows
from ..scan.outliers import neighbour_distance
from ..scan.scan import Scan, ScanError
from ..scan.slices import contour_spacing
from .mesh_topology import MeshTopology, face_topology
from .orient import flipped, orient, plane_fits
from .poisson import Implicit, poisson
from .remesh import Coarse, Dense, coarsen, paired, relaxed

FaceKind: TypeAlias = Literal["triangle", "quad"]

_LEAST_POINTS = 50
_LEAST_FACES = 16
_SIZES = (1.0, 5000.0)  # mm: what is smaller or larger is hardly anatomy, but in another unit
_AT_MOST = 40_000  # points that are looked at: more change no coarse mesh
_CELLS = 160  # along the longest side: a cortex needs them, or its folds grow together
_NEIGHBOUR = 10  # the one whose distance tells the density
_COARSE_CELLS = 50
_TURNS = 6
_SMOOTHER = (1.0, 1.5, 2.5)
_SLICES_APART = 4.0  # times the spacing of the points in them: ten neighbours lie on one contour
_FLAT = 0.3  # thickness of a slice over its width
# A point is dropped where it lies thinly and its neighbours make no plane: sparse but smooth parts stay.
_THIN, _THICK = 1.7, 0.15
_FAR_OFF = 5.0  # robust standard deviations from the surface
_MAD = 1.4826
# What is made up: farther from a point than this many times the distance to its tenth neighbour.
_MADE_UP = 1.5
_RIM = 0.45  # of that distance: at a rim the surface ends this far past the last points
_OPEN = 0.2  # part of the closed surface that is made up: a face lacks half; a head with a hole of 80 mm up to 0.17
_BRIDGED = 0.03  # part of the surface: smaller gaps of an open scan are bridged too
_TOLD = 0.01
_CUT = 4.685
_BENT = 0.2  # cosine


class _Cloud(NamedTuple):
    """Points on the surface, oriented."""

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    reach: Float[np.ndarray, "p"]
    """Distance to the tenth neighbour."""
    noise: float

    @property
    def spacing(self) -> float:
        return float(np.median(self.reach) * np.sqrt(np.pi / _NEIGHBOUR))

    @property
    def areas(self) -> Float[np.ndarray, "p"]:
        # Capped: what is left of the outliers lies thinly, and would count for much.
        return np.pi * np.minimum(self.reach, 3 * np.median(self.reach)) ** 2 / _NEIGHBOUR


def control_mesh(
    scan: Scan, *, faces: int = 500, kind: FaceKind = "triangle", closed: bool | None = None
) -> js.ControlMesh:
    """A coarse, even mesh on the scan, with outward normals: one part, manifold, wound outwards.

    Outliers are dropped, normals estimated (those of the scan are used where it has any) and turned outwards; a Poisson
    surface bridges the holes, is cut back to the points where the scan is open, and coarsened to clusters of equal
    area. Vertices are then put on the points, by local quadrics that average the noise away. `topology_of` tells what
    came out.

    Args:
        scan: in mm. At most 40,000 of its points are looked at.
        faces: about how many.
        kind: "triangle"; or "quad", where an open mesh may keep a few triangles.
        closed: True bridges every gap, False cuts every large one open. None decides: open where over 20 % of the
            closed surface lies far from all points.

    Warns:
        UserWarning: other parts of the scan were left out; the text gives their shares. Or the scan is so small or
            large that its unit is hardly mm.

    Raises:
        ScanError: fewer than 50 points, all on a line or a plane, or no surface in them; contours in slices that lie
            far apart; faces too few for the topology.
        ImportError: the extra `mesh` is missing.

    Source: Kazhdan 2006 (Poisson), Hoppe 1992 and Hou 2022 (normals), Valette 2004 (clusters).
    """
    if kind not in get_args(FaceKind):
        raise ValueError(f"`kind` is one of {', '.join(get_args(FaceKind))}; got {kind!r}.")
    if faces < _LEAST_FACES:
        raise ValueError(f"`faces` must be {_LEAST_FACES} or more; got {faces}.")
    _need_extra()
    cloud = _cleaned(scan)
    _warn_of_unit(float(np.linalg.norm(np.ptp(cloud.points, axis=0))))
    cloud, dense, topology = _simplest(cloud if scan.normals is None else _outwards(cloud), closed)
    coarse = coarsen(dense, faces if kind == "triangle" else 2 * faces, topology)
    if coarse is None:
        raise ScanError(
            f"{faces} faces are too few for what the scan shows ({topology}). Ask for more faces; if there should be "
            "fewer handles or rims, the points are too sparse or noisy to tell the sheets apart."
        )
    coarse = relaxed(paired(coarse) if kind == "quad" else coarse, dense)
    vertices, normals = _onto_points(coarse, dense, cloud)
    return js.ControlMesh(vertices, {size: rows.astype(np.int32) for size, rows in coarse.faces.items()}, normals)


def _need_extra() -> None:
    try:
        import pyacvd  # noqa: F401
        import rustworkx  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f"a control mesh from a scan needs the extra `mesh`: pip install 'jaxsubdiv[mesh]' ({error})."
        ) from error


def _triangles(dense: Dense) -> dict[int, np.ndarray]:
    return {3: dense.faces, 4: np.zeros((0, 4), np.int64)}


# ------------------------------------------------------------------------------------------------------ reconstruction


def _outwards(cloud: _Cloud) -> _Cloud:
    """Normals of a closed scan that all point inwards are turned; an open one may well be seen from inside."""
    if np.sum(cloud.areas[:, None] * (cloud.points - cloud.points.mean(axis=0)) * cloud.normals) > 0:
        return cloud
    turned, implicit = _settled(cloud._replace(normals=-cloud.normals), 3 * cloud.spacing)
    if not _is_closed(turned, _contour(implicit, shut=True), KDTree(turned.points)):
        return cloud
    warnings.warn("the normals of the scan point inwards; they were turned.", stacklevel=3)
    return turned


def _simplest(cloud: _Cloud, closed: bool | None) -> tuple[_Cloud, Dense, MeshTopology]:
    """The surface at the least smoothing, or at more where that takes handles away.

    Noise and stray points make handles as narrow as the grid; a true one is wider.
    """
    cloud, cell = _settled_without_strays(cloud)
    best, left_out = None, []
    for factor in _SMOOTHER:
        settled, implicit = _settled(cloud, cell, factor)
        dense, others = _dense_surface(settled, implicit, closed)
        topology = face_topology(_triangles(dense))
        if best is None or topology.genus < best[2].genus:
            best, left_out = (settled, dense, topology), others
        if topology.genus == 0:
            break
    assert best is not None
    _tell_other_parts(left_out)
    return best


def _settled_without_strays(cloud: _Cloud) -> tuple[_Cloud, float]:
    """The cloud less what is far off its surface, and the grid's spacing for what is left."""
    cell = max(float(np.ptp(cloud.points, axis=0).max()) / _CELLS, 0.8 * cloud.spacing, 0.5 * cloud.noise)
    cloud, implicit = _settled(cloud, 2 * cell)
    # What was an outlier among outliers shows once there is a surface.
    slope = np.linalg.norm(implicit.outward(cloud.points), axis=1)
    off = np.abs(implicit.at(cloud.points)) / np.maximum(slope, 0.1 * np.median(slope))
    wrong = off > max(_FAR_OFF * _MAD * float(np.median(off)), cell)
    _, near = nearest_rows(KDTree(cloud.points), cloud.points, 2 * _NEIGHBOUR)
    keep = ~wrong | (wrong[near].mean(axis=1) > 0.5)  # many side by side are a place that is too sharp for this surface
    cloud = cloud._replace(points=cloud.points[keep], normals=cloud.normals[keep], reach=cloud.reach[keep])
    return cloud, cell


def _check_slices(points: Float[np.ndarray, "p 3"], slices: Int[np.ndarray, "p"]) -> None:
    """A surface is found among points whose neighbours lie around them, not along one contour."""
    numbers = np.unique(slices)
    if len(numbers) == 1 or not all(_is_flat(points[slices == number]) for number in numbers):
        return  # points on all sides are no contour
    nearest, within, between = contour_spacing(points, slices)
    alone = nearest == np.arange(len(points))
    apart, along = np.median(between), np.median(np.where(alone, np.inf, within))
    cell = np.ptp(points, axis=0).max() / _COARSE_CELLS
    if apart > max(_SLICES_APART * along, cell):
        raise ScanError(
            f"the scan is contours in slices {apart:.1f} mm apart, with a point every {along:.1f} mm: too far apart to "
            "make a control mesh of them. Give a template (--control, or `fit_scan(scan, mesh)`)."
        )


def _is_flat(points: Float[np.ndarray, "p 3"]) -> bool:
    if len(points) < 4:
        return True
    _, width, thickness = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(thickness <= _FLAT * width)


def _cleaned(scan: Scan) -> _Cloud:
    points = np.asarray(scan.points, np.float64)
    given = None if scan.normals is None else np.asarray(scan.normals, np.float64)
    used = np.ones(len(points), bool) if scan.weights is None else np.asarray(scan.weights) > 0
    rows = np.flatnonzero(used)
    if len(rows) > _AT_MOST:
        rows = np.sort(np.random.default_rng(0).choice(rows, _AT_MOST, replace=False))
    rows = rows[np.sort(np.unique(points[rows], axis=0, return_index=True)[1])]
    _check_extent(points[rows])
    if scan.slices is not None:
        _check_slices(points[rows], np.asarray(scan.slices)[rows])
    for _ in range(2):  # once the most are gone, the rest lies more thinly than it did
        _, off, _ = plane_fits(points[rows])
        reach = neighbour_distance(points[rows], _NEIGHBOUR)
        rows = rows[~((reach > _THIN * np.quantile(reach, 0.2)) & (off > _THICK * reach))]
        if len(rows) < _LEAST_POINTS:
            raise ScanError("no surface: the points are scattered in space. Was the right file read?")
    points = points[rows]
    reach = neighbour_distance(points, _NEIGHBOUR)
    _, off, _ = plane_fits(points)
    noise = float(np.median(off))
    # Neighbourhoods as wide as the noise needs: a plane through points that are as far off as apart has no direction.
    normals, _, near = plane_fits(points, int(np.clip(16 * (noise / (0.12 * np.median(reach))) ** 2, 16, 60)))
    if given is not None and (given[rows] != 0).any(axis=1).mean() > 0.9:
        normals = np.where(flipped(normals, given[rows])[:, None], -normals, normals)
        return _Cloud(points, normals, reach, noise)
    # A tree may turn all of what lies past a crease over, and no later step undoes that: of three ways to begin the one
    # whose surface follows its normals best is taken.
    away = points - points.mean(axis=0)
    starts = [orient(points, normals, near, across) for across in (True, False)]
    starts.append(np.where(flipped(normals, away)[:, None], -normals, normals))
    cell = max(float(np.ptp(points, axis=0).max()) / _COARSE_CELLS, noise)
    settled = [_settled(_Cloud(points, start, reach, noise), cell) for start in starts]
    return max(settled, key=_agreement)[0]


def _agreement(settled: tuple[_Cloud, Implicit]) -> float:
    """Mean cosine between the normals and what the surface has there."""
    cloud, implicit = settled
    out = implicit.outward(cloud.points)
    length = np.maximum(np.linalg.norm(out, axis=1), np.finfo(float).tiny)
    return float(np.mean(np.einsum("px,px->p", out, cloud.normals) / length))


def _check_extent(points: Float[np.ndarray, "p 3"]) -> None:
    if len(points) == 1:
        raise ScanError(f"all points lie on one spot, {np.round(points[0], 3).tolist()}: no surface follows.")
    if len(points) < _LEAST_POINTS:
        raise ScanError(
            f"{len(points)} points of different places are too few to make a control mesh of; {_LEAST_POINTS} are the "
            "least."
        )
    width = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if width[2] <= 1e-6 * width[0]:
        where = "a line" if width[1] <= 1e-6 * width[0] else "a plane"
        raise ScanError(f"all points lie on {where}: no surface follows. Was a coordinate lost when they were written?")


def _warn_of_unit(size: float) -> None:
    if not _SIZES[0] <= size <= _SIZES[1]:
        warnings.warn(
            f"the scan measures {size:.3g} across, which is taken as mm. If it is in another unit, read it with "
            "`scale=`: 1000 for metres, 0.001 for micrometres.",
            stacklevel=3,
        )


def _settled(cloud: _Cloud, cell: float, smoother: float = 1.0) -> tuple[_Cloud, Implicit]:
    """The Poisson surface, with normals turned that point against it, until hardly any does.

    Where the spanning tree took a wrong turn the surface averages it out, and says so. Hou et al. 2022, iterative
    Poisson surface reconstruction, which starts from normals at random even.
    """
    smoothing = smoother * max(0.8 * cell, 0.5 * cloud.spacing, cloud.noise)
    normals = cloud.normals
    implicit = poisson(cloud.points, normals, cloud.areas, cell, smoothing)
    for _ in range(_TURNS):
        wrong = flipped(normals, implicit.outward(cloud.points))
        if wrong.mean() < 1e-3:
            break
        normals = np.where(wrong[:, None], -normals, normals)
        implicit = poisson(cloud.points, normals, cloud.areas, cell, smoothing)
    return cloud._replace(normals=normals), implicit


# ------------------------------------------------------------------------------------------------- open or closed


def _dense_surface(cloud: _Cloud, implicit: Implicit, closed: bool | None) -> tuple[Dense, list[float]]:
    """The largest part of the surface, cut back to the points where it is open, and the shares of the other parts."""
    shut = _contour(implicit, shut=True)
    tree = KDTree(cloud.points)
    if closed or (closed is None and _is_closed(cloud, shut, tree)):
        return _largest(shut)
    dense = _contour(implicit, shut=False)
    return _largest(_cut_back(dense, cloud, tree))


def _is_closed(cloud: _Cloud, shut: Dense, tree: KDTree) -> bool:
    far = _made_up(shut, cloud, tree)[shut.faces].all(axis=1)
    return bool(shut.areas[far].sum() < _OPEN * shut.areas.sum())


def _contour(implicit: Implicit, shut: bool) -> Dense:
    import pyvista

    values = implicit.values
    if shut:  # what runs out of the box is capped there
        values = values.copy()
        low = -float(np.abs(values).max())
        for axis in range(3):
            sides = np.moveaxis(values, axis, 0)
            sides[0] = sides[-1] = low
    grid = pyvista.ImageData(dimensions=values.shape, spacing=(implicit.cell,) * 3, origin=tuple(implicit.origin))
    grid["value"] = values.ravel(order="F")
    found = grid.contour([0.0], "value", method="flying_edges")
    if found.n_cells == 0:
        raise ScanError("no surface: the points are scattered in space. Was the right file read?")
    vertices, faces = np.asarray(found.points, np.float64), np.asarray(found.regular_faces, np.int32)
    vertices, faces = _merged(vertices, faces)
    dense = Dense(vertices, faces)
    middle = vertices[faces].mean(axis=1)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    # Outwards is down: of the two windings of the library, the one that the function asks for.
    if np.sum(implicit.outward(middle) * np.cross(b - a, c - a)) < 0:
        dense = Dense(vertices, faces[:, ::-1])
    return dense


def _merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without doubled vertices and what falls flat with them."""
    _, first, at = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    faces = at.ravel()[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return vertices[first], faces


def _made_up(dense: Dense, cloud: _Cloud, tree: KDTree) -> Bool[np.ndarray, "v"]:
    """Vertices that no point is near to, by the density of the points there."""
    distance, row = tree.query(dense.vertices, workers=-1)
    return distance > _MADE_UP * np.maximum(cloud.reach[row], np.median(cloud.reach))


def _cut_back(dense: Dense, cloud: _Cloud, tree: KDTree) -> Dense:
    """Without what is made up in large pieces; small gaps stay bridged."""
    far = _made_up(dense, cloud, tree)
    piece = _pieces(dense, np.asarray(far[dense.faces].all(axis=1)))
    area = np.bincount(piece + 1, dense.areas)[1:]
    gone = np.isin(piece, np.flatnonzero(area > _BRIDGED * dense.areas[piece < 0].sum()))
    away = np.zeros(len(dense.vertices), bool)
    away[dense.faces[gone]] = True
    if not away.any():
        return dense
    # The rim goes back to where the points end: as far as it was let out to tell made up from gaps between points.
    distance, row = tree.query(dense.vertices, workers=-1)
    reach = np.maximum(cloud.reach[row], np.median(cloud.reach))
    to_gone = KDTree(dense.vertices[away]).query(dense.vertices, workers=-1)[0]
    out = away | ((to_gone < _MADE_UP * reach) & (distance > _RIM * reach + cloud.noise))
    kept = ~out[dense.faces].any(axis=1)
    piece = _pieces(dense, ~kept)
    area = np.bincount(piece + 1, dense.areas)[1:]
    kept |= np.isin(piece, np.flatnonzero(area <= _BRIDGED * dense.areas[kept].sum()))
    return Dense(dense.vertices, _without_pinches(dense.faces[kept]))


def _without_pinches(faces: Int[np.ndarray, "t 3"]) -> Int[np.ndarray, "s 3"]:
    """Faces less those at vertices where the rim touches itself, which is no manifold."""
    while True:
        sides = half_edges({3: faces, 4: np.zeros((0, 4), np.int64)})
        on_rim = np.bincount(sides.edge)[sides.edge] == 1
        pinched = np.bincount(sides.start[on_rim], minlength=int(faces.max(initial=0)) + 1) > 1
        if not pinched.any():
            return faces
        faces = faces[~pinched[faces].any(axis=1)]


def _pieces(dense: Dense, chosen: Bool[np.ndarray, "t"]) -> np.ndarray:
    """Of every chosen face the connected piece that it lies in, -1 of the rest."""
    sides = half_edges({3: dense.faces[chosen], 4: np.zeros((0, 4), np.int64)})
    n = int(chosen.sum())
    graph = coo_matrix((np.ones(len(sides.face)), (sides.face, n + sides.edge)), shape=(n + len(sides.edges),) * 2)
    piece = np.full(len(chosen), -1)
    piece[chosen] = np.unique(connected_components(graph, directed=False)[1][:n], return_inverse=True)[1]
    return piece


def _largest(dense: Dense) -> tuple[Dense, list[float]]:
    """The part that has the most area, and the shares of the others that are no specks."""
    piece = _pieces(dense, np.ones(len(dense.faces), bool))
    area = np.bincount(piece, dense.areas)
    order = np.argsort(area)[::-1]
    shares = [float(area[i] / area.sum()) for i in order[1:] if area[i] > _TOLD * area.sum()]
    used, at = np.unique(dense.faces[piece == order[0]], return_inverse=True)
    return Dense(dense.vertices[used], at.reshape(-1, 3)), shares


def _tell_other_parts(shares: list[float]) -> None:
    if shares:
        warnings.warn(
            f"the scan shows {1 + len(shares)} parts; the control mesh has the largest alone. Left out: "
            f"{', '.join(f'{100 * share:.0f} %' for share in shares)} of the surface.",
            stacklevel=4,
        )


# ------------------------------------------------------------------------------------------------------------ placing


def _onto_points(
    coarse: Coarse, dense: Dense, cloud: _Cloud
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
    """Vertices on the points and normals there, by a quadric through the points around each; where a hole is, the dense
    surface's own."""
    x = coarse.vertices
    sides = half_edges(coarse.faces)
    edge = float(np.linalg.norm(np.diff(x[sides.edges], axis=1), axis=2).mean())
    # Wide enough to average the noise, no wider than half the way to the next vertex: an edge would be rounded off.
    width = float(
        np.clip(1.6 * cloud.spacing + 2 * cloud.noise, 1.5 * cloud.spacing, max(0.4 * edge, 1.5 * cloud.spacing))
    )
    normal = dense.normals()[KDTree(dense.vertices).query(x)[1]]
    k = int(np.clip(np.pi * (2 * width / cloud.spacing) ** 2, 12, 150))
    distance, rows = nearest_rows(KDTree(cloud.points), x, min(k, len(cloud.points)))
    first, second = _tangents(normal)
    offset = cloud.points[rows] - x[:, None]
    u, v, h = (np.einsum("vkx,vx->vk", offset, axis) / width for axis in (first, second, normal))
    terms = np.stack([np.ones_like(u), u, v, u * u / 2, u * v, v * v / 2], axis=2)
    # The other side of a thin part lies as near as this one; its normals tell.
    near = np.exp(-((distance / width) ** 2)) * (np.einsum("vkx,vx->vk", cloud.normals[rows], normal) > 0.3)
    weight, found = near, np.zeros((len(x), 6))
    for _ in range(4):
        normal_matrix = np.einsum("vka,vkb,vk->vab", terms, terms, weight, optimize=True)
        # A little of a flat plane, which matters where points are few or lie to one side.
        ridge = 1e-3 * np.maximum(weight.sum(axis=1), 1e-9)[:, None] * np.array([1e-6, 1e-3, 1e-3, 1, 1, 1])
        right = np.einsum("vka,vk,vk->va", terms, h, weight, optimize=True)
        found = np.linalg.solve(normal_matrix + ridge[:, :, None] * np.eye(6), right[:, :, None])[:, :, 0]
        residual = np.abs(h - np.einsum("vka,va->vk", terms, found))
        scale = np.maximum(_MAD * np.median(np.where(near > 0.1, residual, np.nan_to_num(residual)), axis=1), 1e-6)
        weight = near * np.maximum(1 - (residual / (_CUT * scale[:, None])) ** 2, 0) ** 2
    # Enough points, on all sides, and no step that is larger than what the dense surface can be off.
    centre = (
        np.stack([(weight * u).sum(axis=1), (weight * v).sum(axis=1)], axis=1)
        / np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    )
    step = found[:, 0] * width
    sure = (weight.sum(axis=1) > 4) & (np.linalg.norm(centre, axis=1) < 0.5) & (np.abs(step) < 0.3 * edge)
    x = np.where(sure[:, None], x + step[:, None] * normal, x)
    turned = normal - found[:, 1:2] * first - found[:, 2:3] * second
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    turned = np.where((sure & (np.einsum("vx,vx->v", turned, normal) > 0.7))[:, None], turned, normal)
    return x, _agreeing(x, coarse, turned)


def _agreeing(
    x: Float[np.ndarray, "v 3"], coarse: Coarse, normals: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v 3"]:
    """The normals, but where a face would bend back on itself under one.

    In a fold narrower than the faces the middle of the faces' own normals serves better than the true one.
    """
    own, least = np.zeros_like(x), np.ones(len(x))
    for size in (3, 4):
        rows = coarse.faces[size]
        areas = js.vector_areas(x[rows])
        unit = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), np.finfo(float).tiny)
        for corner in rows.T:
            np.add.at(own, corner, areas)
            np.minimum.at(least, corner, np.einsum("fx,fx->f", unit, normals[corner]))
    length = np.linalg.norm(own, axis=1, keepdims=True)
    own = np.divide(own, length, out=normals.copy(), where=length > 0)
    return np.where((least < _BENT)[:, None], own, normals)


def _tangents(normal: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normal, first)
