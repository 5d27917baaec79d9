"""The surface among oriented points: a Poisson surface, open or closed, in its pieces."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jaxsubdiv.half_edges import half_edges

from ..scan.closest_points import nearest_rows
from ..scan.scan import ScanError
from .cloud import NEIGHBOUR, Cloud, settle
from .mesh_topology import MeshTopology
from .poisson import Implicit
from .remesh import Dense

_CELLS = 160  # along the longest side: a cortex needs them, or its folds grow together
_SMOOTHER = (1.0, 1.5, 2.5)
_SMOOTHEST = 4.0  # a handle that is true may go, too: only where no mesh of so few faces has room for those found
_FAR_OFF = 5.0  # robust standard deviations from the surface
_MAD = 1.4826
# What is made up: farther from a point than this many times the distance to its tenth neighbour.
_MADE_UP = 1.5
_RIM = 0.45  # of that distance: at a rim the surface ends this far past the last points
_OPEN = 0.2  # part of the closed surface that is made up: a face lacks half; a head with a hole of 80 mm up to 0.17
_BRIDGED = 0.03  # part of the surface: smaller gaps of an open scan are bridged too
_BEYOND = 0.002  # part of the surface: of a scan from an image, smaller ones past its end are bridged
_SPECK = 0.01  # part of the surface: smaller pieces are none


class Reconstruction(NamedTuple):
    """A surface among points."""

    cloud: Cloud
    """The points less those far off, with normals that agree with the surface."""
    pieces: list[Dense]
    """What hangs together, the largest first, without specks; never empty."""
    topology: MeshTopology
    """Of the first."""


def reconstruct(cloud: Cloud, closed: bool | None) -> Reconstruction:
    """The surface at the least smoothing, or at more where that takes handles away.

    Noise and stray points make handles as narrow as the grid; a true one is wider.
    """
    return _smooth_by(_SMOOTHER, cloud, closed)


def reconstruct_smoothly(cloud: Cloud, closed: bool | None) -> Reconstruction:
    """The surface at so much smoothing that hardly a handle is left."""
    return _smooth_by((_SMOOTHEST,), cloud, closed)


def _smooth_by(factors: tuple[float, ...], cloud: Cloud, closed: bool | None) -> Reconstruction:
    cloud, cell = _drop_strays(cloud)
    best = None
    for factor in factors:
        settled, implicit = settle(cloud, cell, factor)
        pieces = _pieces_of_surface(settled, implicit, closed)
        if not pieces:
            raise ScanError("no surface: the points are scattered in space. Was the right file read?")
        topology = pieces[0].topology()
        if best is None or topology.genus < best.topology.genus:
            best = Reconstruction(settled, pieces, topology)
        if topology.genus == 0:
            break
    assert best is not None
    return best


def is_closed(cloud: Cloud) -> bool:
    """Whether the points, with the normals that they have, show something closed."""
    settled, implicit = settle(cloud, 3 * cloud.spacing)
    return _is_closed(settled, _contour(implicit, shut=True), KDTree(settled.points))


def _drop_strays(cloud: Cloud) -> tuple[Cloud, float]:
    """The cloud less what is far off its surface, and the grid's spacing for what is left."""
    cell = max(float(np.ptp(cloud.points, axis=0).max()) / _CELLS, 0.8 * cloud.spacing, 0.5 * cloud.noise)
    cloud, implicit = settle(cloud, 2 * cell)
    # What was an outlier among outliers shows once there is a surface.
    slope = np.linalg.norm(implicit.outward_vectors(cloud.points), axis=1)
    off = np.abs(implicit.evaluate(cloud.points)) / np.maximum(slope, 0.1 * np.median(slope))
    wrong = off > max(_FAR_OFF * _MAD * float(np.median(off)), cell)
    _, near = nearest_rows(KDTree(cloud.points), cloud.points, min(2 * NEIGHBOUR, len(cloud.points)))
    keep = ~wrong | (wrong[near].mean(axis=1) > 0.5)  # many side by side are a place that is too sharp for this surface
    cloud = cloud._replace(points=cloud.points[keep], normals=cloud.normals[keep], reach=cloud.reach[keep])
    return cloud, cell


def _pieces_of_surface(cloud: Cloud, implicit: Implicit, closed: bool | None) -> list[Dense]:
    """The pieces of the surface, the largest first, cut back to the points where it is open."""
    shut = _contour(implicit, shut=True)
    tree = KDTree(cloud.points)
    if closed or (closed is None and _is_closed(cloud, shut, tree)):
        return separate(shut)
    dense = _contour(implicit, shut=False)
    return separate(_cut_back(dense, cloud, tree))


def _is_closed(cloud: Cloud, shut: Dense, tree: KDTree) -> bool:
    if shut.areas[_find_beyond_view(cloud, shut)].sum() > _BEYOND * shut.areas.sum():
        return False
    far = _find_made_up(shut, cloud, tree)[shut.faces].all(axis=1)
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
    vertices, faces = _merge_doubled(vertices, faces)
    dense = Dense(vertices, faces)
    middle = vertices[faces].mean(axis=1)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    # Outwards is down: of the two windings of the library, the one that the function asks for.
    if np.sum(implicit.outward_vectors(middle) * np.cross(b - a, c - a)) < 0:
        dense = Dense(vertices, faces[:, ::-1])
    return dense


def _merge_doubled(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without doubled vertices and what falls flat with them."""
    _, first, at = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    faces = at.ravel()[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return vertices[first], faces


def _find_made_up(dense: Dense, cloud: Cloud, tree: KDTree) -> Bool[np.ndarray, "v"]:
    """Vertices that no point is near to, by the density of the points there."""
    distance, row = tree.query(dense.vertices, workers=-1)
    return distance > _MADE_UP * np.maximum(cloud.reach[row], np.median(cloud.reach))


def _find_beyond_view(cloud: Cloud, dense: Dense) -> Bool[np.ndarray, "t"]:
    """Faces past the end of the image that the scan was made of."""
    if cloud.view is None:
        return np.zeros(len(dense.faces), bool)
    there = dense.vertices[dense.faces].mean(axis=1) @ cloud.view[:3, :3].T + cloud.view[:3, 3]
    return ((there < 0) | (there > 1)).any(axis=1)


def _cut_back(dense: Dense, cloud: Cloud, tree: KDTree) -> Dense:
    """Without what is made up in large pieces; small gaps stay bridged."""
    far, beyond = _find_made_up(dense, cloud, tree), _find_beyond_view(cloud, dense)
    gone = _find_large(dense, np.asarray(far[dense.faces].all(axis=1)), _BRIDGED) | _find_large(dense, beyond, _BEYOND)
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
    off = _find_large(dense, ~kept, _BRIDGED, always=gone)
    return Dense(dense.vertices, _drop_pinches(dense.faces[~off]))


def _find_large(
    dense: Dense, chosen: Bool[np.ndarray, "t"], share: float, always: Bool[np.ndarray, "t"] | None = None
) -> Bool[np.ndarray, "t"]:
    """Those of the chosen faces whose piece has more than a share of the area of the rest, or some of `always`."""
    piece = _pieces(dense, chosen)
    area = np.bincount(piece + 1, dense.areas, minlength=1)[1:]
    large = np.flatnonzero(area > share * dense.areas[~chosen].sum())
    return np.isin(piece, large if always is None else np.concatenate([large, piece[always]]))


def _drop_pinches(faces: Int[np.ndarray, "t 3"]) -> Int[np.ndarray, "s 3"]:
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


def separate(dense: Dense) -> list[Dense]:
    """The pieces of a surface, the largest first, without specks."""
    if not len(dense.faces):
        return []
    piece = _pieces(dense, np.ones(len(dense.faces), bool))
    area = np.bincount(piece, dense.areas)
    largest_first = [i for i in np.argsort(area)[::-1] if area[i] > _SPECK * area.sum() or area[i] == area.max()]
    separate = []
    for i in largest_first:
        used, at = np.unique(dense.faces[piece == i], return_inverse=True)
        separate.append(Dense(dense.vertices[used], at.reshape(-1, 3)))
    return separate
