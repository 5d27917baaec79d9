"""The points that a control mesh is made of: without what is scattered, evenly dense, with normals that agree."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from ..scan.closest_points import nearest_rows
from ..scan.outliers import covariances, first_of_each, neighbour_distance, one_a_cell
from ..scan.scan import Scan, ScanError
from ..scan.slices import contour_spacing
from .mesh_topology import component_labels
from .orient import find_flipped, orient, plane_fits
from .poisson import Implicit, poisson
from .remesh import Dense

LEAST_POINTS = 50
NEIGHBOUR = 10  # the one whose distance tells the density
COARSE_CELLS = 50
_AT_MOST = 40_000  # points that are looked at: more change no coarse mesh
_TURNS = 6
_SLICES_APART = 4.0  # times the spacing of the points in them: ten neighbours lie on one contour
_FLAT = 0.3  # thickness of a slice over its width
# A point is dropped where it lies thinly and its neighbours make no plane: sparse but smooth parts stay.
_THIN, _THICK = 1.7, 0.15
_ALONE = 8.0  # times what nine tenths of the points keep: through a far point and a small object goes a plane, too
# Neighbours on lines, or so much denser in one place than in another, tell of no surface: the points are thinned.
_LINES, _UNEVEN = 0.1, 6.0
_THINNINGS, _WIDER = 12, 1.4
_LARGE, _MOST_OF_IT = 0.05, 0.8  # shares of the points: of a component, and of all large ones


class Cloud(NamedTuple):
    """Points on the surface, oriented."""

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    reach: Float[np.ndarray, "p"]
    """Distance to the tenth neighbour."""
    noise: float
    given: bool
    """Whether the normals are the scan's own."""
    label: Int[np.ndarray, "p"] | None = None
    """Of scans with faces the component that each point lies in, where there are several large ones; -1 in a small one.
    None of all others."""
    view: Float[np.ndarray, "4 4"] | None = None
    """Of scans from images: see `Scan.view`."""

    @property
    def spacing(self) -> float:
        return float(np.median(self.reach) * np.sqrt(np.pi / NEIGHBOUR))

    @property
    def areas(self) -> Float[np.ndarray, "p"]:
        # Capped: what is left of the outliers lies thinly, and would count for much.
        return np.pi * np.minimum(self.reach, 3 * np.median(self.reach)) ** 2 / NEIGHBOUR


def clean(scan: Scan) -> Cloud:
    """The points of a scan that may lie on a surface, with normals: its own where it has any, else found from all."""
    points = np.asarray(scan.points, np.float64)
    given = None if scan.normals is None else np.asarray(scan.normals, np.float64)
    used = np.ones(len(points), bool) if scan.weights is None else np.asarray(scan.weights) > 0
    if scan.faces is not None:
        used &= np.bincount(scan.faces.ravel(), minlength=len(points)) > 0
        given = Dense(points, scan.faces).normals() if given is None else given
    rows = np.flatnonzero(used)
    rows = rows[first_of_each(points[rows])]
    if len(rows) > _AT_MOST:
        rows = np.sort(np.random.default_rng(0).choice(rows, _AT_MOST, replace=False))
    _check_extent(points[rows])
    if scan.slices is not None:
        _check_slices(points[rows], np.asarray(scan.slices)[rows])
    rows = rows[_even_rows(points[rows])]
    label = None if scan.faces is None else _large_components(scan.faces, points, used)
    found = clean_points(points[rows], None if given is None else given[rows], None if label is None else label[rows])
    return found._replace(view=scan.view)


def _large_components(
    faces: Int[np.ndarray, "t 3"], points: Float[np.ndarray, "p 3"], used: Bool[np.ndarray, "p"]
) -> Int[np.ndarray, "p"] | None:
    """Which points hang together by faces; points that were written twice are one."""
    _, same = np.unique(points, axis=0, return_inverse=True)
    corners = same.ravel()[faces]
    label = component_labels(np.concatenate([corners[:, :2], corners[:, 1:]]), len(points))[same.ravel()]
    counts = np.bincount(label[used], minlength=label.max() + 1)
    large = np.flatnonzero(counts > _LARGE * used.sum())
    if len(large) < 2 or counts[large].sum() < _MOST_OF_IT * used.sum():
        return None
    return np.where(np.isin(label, large), label, -1)


def clean_points(
    points: Float[np.ndarray, "p 3"],
    given: Float[np.ndarray, "p 3"] | None,
    label: Int[np.ndarray, "p"] | None = None,
) -> Cloud:
    """The same of points that lie about evenly.

    Args:
        points: in mm.
        given: outward normals of any length; used where nine tenths of the points have one.
        label: see `Cloud`.
    """
    rows = rows_on_surfaces(points)
    if len(rows) < LEAST_POINTS:
        raise ScanError("no surface: the points are scattered in space. Was the right file read?")
    points, label = points[rows], None if label is None else label[rows]
    reach = neighbour_distance(points, NEIGHBOUR)
    _, off, _ = plane_fits(points)
    noise = float(np.median(off))
    # Neighbourhoods as wide as the noise needs: a plane through points that are as far off as apart has no direction.
    normals, _, near = plane_fits(points, int(np.clip(16 * (noise / (0.12 * np.median(reach))) ** 2, 16, 60)))
    if given is not None and (given[rows] != 0).any(axis=1).mean() > 0.9:
        normals = np.where(find_flipped(normals, given[rows])[:, None], -normals, normals)
        return Cloud(points, normals, reach, noise, True, label)
    # A tree may turn all of what lies past a crease over, and no later step undoes that: of three ways to begin the one
    # whose surface follows its normals best is taken.
    away = points - points.mean(axis=0)
    starts = [orient(points, normals, near, across) for across in (True, False)]
    starts.append(np.where(find_flipped(normals, away)[:, None], -normals, normals))
    cell = max(float(np.ptp(points, axis=0).max()) / COARSE_CELLS, noise)
    settled = [settle(Cloud(points, start, reach, noise, False, label), cell) for start in starts]
    return max(settled, key=_agreement)[0]


def rows_on_surfaces(points: Float[np.ndarray, "p 3"]) -> Int[np.ndarray, "q"]:
    """Rows of points that are not scattered in space: their neighbours are near, or lie in a plane, and not far off."""
    rows = np.arange(len(points))
    for _ in range(2):  # once the most are gone, the rest lies more thinly than it did
        _, off, _ = plane_fits(points[rows])
        reach = neighbour_distance(points[rows], NEIGHBOUR)
        thin, alone = np.quantile(reach, [0.2, 0.9]) * (_THIN, _ALONE)
        rows = rows[~((reach > thin) & (off > _THICK * reach) | (reach > alone))]
        if len(rows) < LEAST_POINTS:
            break
    return rows


def _even_rows(points: Float[np.ndarray, "p 3"]) -> Int[np.ndarray, "q"]:
    """Rows of points that are about as dense everywhere, and whose neighbours lie around them.

    Along contours, ten neighbours lie on one line, and no plane follows from them: one point is left in every cell of a
    grid, whose cells grow until neighbours on the next contour are as near. Likewise where one place is far denser.
    """
    rows = np.arange(len(points))
    reach = neighbour_distance(points, NEIGHBOUR)
    cell = max(float(np.quantile(reach, 0.1)), 1e-6 * float(np.ptp(points, axis=0).max())) / 2
    for _ in range(_THINNINGS):
        low, high = np.quantile(reach, [0.1, 0.9])
        if high <= _UNEVEN * low and not are_on_lines(points[rows]):
            return rows
        thinner = one_a_cell(points, cell)
        if len(thinner) < 10 * LEAST_POINTS:
            break
        rows, cell = thinner, _WIDER * cell
        reach = neighbour_distance(points[rows], NEIGHBOUR)
    return rows


def are_on_lines(points: Float[np.ndarray, "p 3"]) -> bool:
    """Whether most points have their neighbours on a line, as those of contours do."""
    _, near = nearest_rows(KDTree(points), points, min(NEIGHBOUR + 1, len(points)))
    spread = np.linalg.eigvalsh(covariances(points, near))
    return bool(np.median(spread[:, 1] / np.maximum(spread[:, 2], np.finfo(float).tiny)) < _LINES)


def _agreement(settled: tuple[Cloud, Implicit]) -> float:
    """Mean cosine between the normals and what the surface has there."""
    cloud, implicit = settled
    out = implicit.outward_vectors(cloud.points)
    length = np.maximum(np.linalg.norm(out, axis=1), np.finfo(float).tiny)
    return float(np.mean(np.einsum("px,px->p", out, cloud.normals) / length))


def settle(cloud: Cloud, cell: float, smoother: float = 1.0) -> tuple[Cloud, Implicit]:
    """The Poisson surface, with normals turned that point against it, until hardly any does.

    Where the spanning tree took a wrong turn the surface averages it out, and says so. Hou et al. 2022, iterative
    Poisson surface reconstruction, which starts from normals at random even.
    """
    smoothing = smoother * max(0.8 * cell, 0.5 * cloud.spacing, cloud.noise)
    normals = cloud.normals
    implicit = poisson(cloud.points, normals, cloud.areas, cell, smoothing)
    for _ in range(_TURNS):
        wrong = find_flipped(normals, implicit.outward_vectors(cloud.points))
        if wrong.mean() < 1e-3:
            break
        normals = np.where(wrong[:, None], -normals, normals)
        implicit = poisson(cloud.points, normals, cloud.areas, cell, smoothing)
    return cloud._replace(normals=normals), implicit


def _check_slices(points: Float[np.ndarray, "p 3"], slices: Int[np.ndarray, "p"]) -> None:
    """A surface is found among points whose neighbours lie around them, not along one contour."""
    numbers = np.unique(slices)
    if len(numbers) == 1 or not all(_is_flat(points[slices == number]) for number in numbers):
        return  # points on all sides are no contour
    nearest, within, between = contour_spacing(points, slices)
    alone = nearest == np.arange(len(points))
    apart, along = np.median(between), np.median(np.where(alone, np.inf, within))
    cell = np.ptp(points, axis=0).max() / COARSE_CELLS
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


def _check_extent(points: Float[np.ndarray, "p 3"]) -> None:
    if len(points) == 1:
        raise ScanError(f"all points lie on one spot, {np.round(points[0], 3).tolist()}: no surface follows.")
    if len(points) < LEAST_POINTS:
        raise ScanError(
            f"{len(points)} points of different places are too few to make a control mesh of; {LEAST_POINTS} are the "
            "least."
        )
    width = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if width[2] <= 1e-6 * width[0]:
        where = "a line" if width[1] <= 1e-6 * width[0] else "a plane"
        raise ScanError(f"all points lie on {where}: no surface follows. Was a coordinate lost when they were written?")
