"""The scan that an image is: points where the boundary of a label, or a grey value, crosses from voxel to voxel."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are used
from jaxtyping import Float, Int, Shaped

from jaxsubdiv.notices import warn

from ..scan.scan import Scan, ScanError
from .volume import Label, Volume, mask_of

MOST_POINTS = 400_000
_MOST_FITTED, _POINTS_A_FACE, _LEAST_FACES, _MOST_FACES = 40_000, 40, 300, 2000
# Standard deviation in voxels of the Gaussian that the indicator is smoothed with for its normals: less leaves
# stairs, more rounds the shape off (4.1, 3.1 and 3.1 degrees at 1, 1.5 and 2 on a head in voxels of 1 mm).
_SMOOTHING = 1.5
_REACH = 4  # standard deviations until the Gaussian is cut
_TURNED = 0.1  # the normals' own error, in radians: no point is surer than it says
_MOST_GREY = 1e30
_SLABS = 8  # of an image, of which the noise is estimated
_THIN, _MANY_THIN = 2.0, 0.02  # voxels; share of the boundary


class _Crossings(NamedTuple):
    """Where the boundary crosses between two voxels that are neighbours along an axis."""

    at: Float[np.ndarray, "p 3"]
    """Indices, between whole numbers along one axis."""
    middle: Int[np.ndarray, "p 3"]
    """Twice the index of the middle of each pair of voxels."""
    all: bool
    """False where these are a part of all."""

    @property
    def axis(self) -> Int[np.ndarray, "p"]:
        """The axis of each pair: along it the middle lies between whole numbers."""
        return (self.middle % 2).argmax(axis=1)


def scan_of_label(volume: Volume, label: Label, *, most_points: int = MOST_POINTS) -> Scan:
    """Points on the boundary of a label.

    Between a voxel inside and its neighbour outside the boundary may be anywhere: the point is the middle, and the
    uniform distribution of the boundary between the two has the standard deviation `spacing / sqrt(12)`. Across the
    surface that is as much less as the normal turns away from the axis. So a voxel's wide flat steps say little, and
    their edges say precisely where the surface passes: stairs are what such points look like, and no fit that weighs
    them so has stairs.

    Args:
        volume: a label map.
        label: which, see `choose_label`.
        most_points: an even part of them, drawn at random, where there are more.

    Returns:
        A scan with normals, from the smoothed indicator, and a standard deviation each; it knows where the image ends.

    Raises:
        ScanError: the label has no boundary within the image.
    """
    mask = mask_of(volume, label)
    if not mask.any():
        raise ScanError(f"no voxel has the label '{label}'.")
    low, cut = _cut_out(mask, volume)
    inside = mask[cut]
    found = _find_crossings(inside, 0.5, most_points)
    if not len(found.at):
        raise ScanError(f"the label '{label}' fills the image: it has no boundary in it.")
    slope = _slope(inside.astype(np.float32), found.at, _widths(volume))
    outward = _normals(slope, volume)
    _warn_if_thin(inside, found, outward, volume, str(label))
    axis = found.axis
    across = np.einsum("px,px->p", outward, _axes(volume)[axis])
    deviations = volume.spacing[axis] * np.sqrt((across**2 + _TURNED**2) / 12)
    return _scan(volume, low, inside, found, outward, deviations)


def suggest_settings(scan: Scan) -> dict[str, int]:
    """Settings of `fit_scan` that suit a scan from an image: `faces`, whose edges are about eight voxels long, and
    `most_points`.

    Finer faces would follow the stairs, coarser ones leave out what the image shows: see docs/images.md.
    """
    faces = min(max(scan.n_points // _POINTS_A_FACE, _LEAST_FACES), _MOST_FACES)
    return {"faces": faces, "most_points": _MOST_FITTED}


def scan_above(volume: Volume, threshold: float, *, most_points: int = MOST_POINTS) -> Scan:
    """Points where the values of a grey image pass a threshold, between the voxels by linear interpolation.

    A point's standard deviation is that of the image's noise over the slope of the values.

    Args:
        volume: an image.
        threshold: what is above it lies inside.
        most_points: as `scan_of_label`.

    Raises:
        ScanError: no value, or every value, is above; a value is not finite.
    """
    values, *others = volume.layers
    if others:
        raise ScanError(f"it has {len(volume.layers)} layers, and an image has one. Are they segments? Give a label.")
    if not (values.min() > -_MOST_GREY and values.max() < _MOST_GREY):  # also of NaN
        wrong = np.sum(~(np.abs(values) < _MOST_GREY))
        raise ScanError(f"{wrong:,} voxels of the image are not finite, or far too large.")
    low, cut = _cut_out(values > threshold, volume)
    grey = values[cut].astype(np.float32)
    found = _find_crossings(grey, threshold, most_points)
    if not len(found.at):
        raise ScanError(f"no surface at {threshold:g}: its voxels go from {values.min():g} to {values.max():g}.")
    slope = _slope(grey, found.at, _widths(volume) / 2)
    size = np.linalg.norm(_to_mm(slope, volume), axis=1)
    least = 0.02 * volume.spacing.min()  # linear interpolation is no better
    noise = _noise(grey)
    deviations = np.clip(noise / np.maximum(size, 1e-30), least, volume.spacing.max())
    return _scan(volume, low, grey > threshold, found, _normals(slope, volume), deviations)


def _scan(
    volume: Volume,
    low: Int[np.ndarray, "3"],
    inside: Shaped[np.ndarray, "i j k"],
    found: _Crossings,
    outward: Float[np.ndarray, "p 3"],
    deviations: Float[np.ndarray, "p"],
) -> Scan:
    """The scan of what was found in a part of the volume that begins at `low`."""
    last = np.array(volume.layers[0].shape) - 1
    view = np.linalg.inv(volume.affine)
    view[:3] /= np.maximum(last, 1)[:, None]
    points = volume.positions(found.at + low)
    faces = _outline(inside, found, outward, points)
    of_all = {"faces": faces, "frame": volume.frame, "outlined": faces is not None, "view": view}
    return Scan(points, outward, deviations=deviations, **of_all)


def _outline(
    inside: Shaped[np.ndarray, "i j k"],
    found: _Crossings,
    outward: Float[np.ndarray, "p 3"],
    points: Float[np.ndarray, "p 3"],
) -> Int[np.ndarray, "t 3"] | None:
    """Triangles between the points, wound outwards, open where the image ends; None where these are a part of all, or
    without the extra `mesh`.

    Those of marching cubes on the inside, whose vertices are the middles of the very same pairs of voxels.
    """
    if not found.all:
        return None
    try:
        import pyvista
    except ImportError:
        return None
    grid = pyvista.ImageData(dimensions=inside.shape)
    grid["inside"] = inside.astype(np.float32).ravel(order="F")
    stairs = grid.contour([0.5], "inside", method="flying_edges")
    halves = tuple(2 * np.array(inside.shape))
    keys = np.ravel_multi_index(tuple(found.middle.T), halves)
    wanted = np.ravel_multi_index(tuple(np.round(2 * np.asarray(stairs.points)).astype(np.int64).T), halves)
    order = np.argsort(keys)
    faces = order[np.searchsorted(keys, wanted, sorter=order)][np.asarray(stairs.regular_faces)]
    a, b, c = np.moveaxis(points[faces], 1, 0)
    out = np.einsum("tx,tx->", np.cross(b - a, c - a), outward[faces].sum(axis=1))
    return (faces if out > 0 else faces[:, ::-1]).astype(np.int32)


def _widths(volume: Volume) -> Float[np.ndarray, "3"]:
    """Of the Gaussian along each index, in voxels: as wide in mm along all."""
    return np.maximum(_SMOOTHING * volume.voxel_volume ** (1 / 3) / volume.spacing, 0.5)


def _cut_out(
    mask: Shaped[np.ndarray, "i j k"], volume: Volume
) -> tuple[Int[np.ndarray, "3"], tuple[slice, slice, slice]]:
    """The box of what is inside, with as much around as smoothing reaches: where it begins, and as slices."""
    margin = np.ceil(_REACH * _widths(volume)).astype(int) + 2
    box = []
    for axis in range(3):
        there = np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {axis})))
        first, last = (int(there[0]), int(there[-1])) if len(there) else (0, 0)
        box.append(slice(max(first - int(margin[axis]), 0), last + int(margin[axis]) + 1))
    return np.array([one.start for one in box]), (box[0], box[1], box[2])


def _find_crossings(values: Shaped[np.ndarray, "i j k"], threshold: float, most: int) -> _Crossings:
    """All of them, or an even part where there are more: of noise there may be more than voxels."""
    above = values > threshold
    pairs = [
        tuple(tuple(slice(*ends) if n == axis else slice(None) for n in range(3)) for ends in ((None, -1), (1, None)))
        for axis in range(3)
    ]
    changes = [above[first] != above[second] for first, second in pairs]
    counts = [int(np.count_nonzero(change)) for change in changes]
    n = sum(counts)
    rows = np.arange(n) if n <= most else np.sort(np.random.default_rng(0).choice(n, most, replace=False))
    indices, middles = [], []
    for axis, ((first, second), change) in enumerate(zip(pairs, changes, strict=True)):
        own = rows[(rows >= sum(counts[:axis])) & (rows < sum(counts[: axis + 1]))] - sum(counts[:axis])
        here = np.unravel_index(np.flatnonzero(change)[own], change.shape)
        a, b = (values[part][here].astype(np.float64) for part in (first, second))
        middles.append(2 * np.stack(here, axis=1) + np.eye(3, dtype=np.int64)[axis])
        index = np.stack(here, axis=1).astype(np.float64)
        index[:, axis] += (threshold - a) / (b - a)
        indices.append(index)
    return _Crossings(np.concatenate(indices), np.concatenate(middles), n <= most)


def _slope(
    values: Float[np.ndarray, "i j k"], index: Float[np.ndarray, "p 3"], widths: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "p 3"]:
    """How the smoothed values grow from index to index; past the image's end they go on as they are there."""
    smooth = scipy.ndimage.gaussian_filter(values, widths, mode="nearest", truncate=_REACH)
    steps = np.eye(3)
    places = [(index + sign * step).T for step in steps for sign in (1, -1)]
    ends = [scipy.ndimage.map_coordinates(smooth, place, order=1, mode="nearest") for place in places]
    return np.stack([(ahead - behind) / 2 for ahead, behind in zip(ends[::2], ends[1::2], strict=True)], axis=1)


def _to_mm(slope: Float[np.ndarray, "p 3"], volume: Volume) -> Float[np.ndarray, "p 3"]:
    """From growth an index to growth a mm: a gradient changes by the inverse of the axes."""
    return slope @ np.linalg.inv(volume.affine[:3, :3])


def _normals(slope: Float[np.ndarray, "p 3"], volume: Volume) -> Float[np.ndarray, "p 3"]:
    """Outward unit normals, zero where the smoothed values are flat."""
    down = -_to_mm(slope, volume)
    length = np.linalg.norm(down, axis=1, keepdims=True)
    return np.divide(down, length, out=np.zeros_like(down), where=length > 1e-6 * length.max(initial=0.0))


def _axes(volume: Volume) -> Float[np.ndarray, "3 3"]:
    """Unit vectors along the indices, as rows."""
    return (volume.affine[:3, :3] / volume.spacing).T


def _noise(values: Float[np.ndarray, "i j k"]) -> float:
    """Standard deviation of the noise of an image, from second differences, which smooth values have hardly any of."""
    some = [slab[:, :, :3] for slab in np.array_split(values, _SLABS, axis=2) if slab.size]
    of_axes = [np.diff(slab, 2, axis=axis).ravel() for slab in some for axis in range(3) if slab.shape[axis] > 2]
    second = np.concatenate([rows[rows != 0] for rows in of_axes]) if of_axes else np.zeros(0)
    return float(np.median(np.abs(second)) * 1.4826 / np.sqrt(6)) if len(second) else 0.0


def _warn_if_thin(
    mask: Shaped[np.ndarray, "i j k"], found: _Crossings, outward: Float[np.ndarray, "p 3"], volume: Volume, label: str
) -> None:
    """Warn of parts that are hardly thicker than a voxel: their two walls cannot be told apart well."""
    step = volume.voxel_volume ** (1 / 3)
    per_mm = np.linalg.inv(volume.affine[:3, :3]).T
    within = found.at - (_THIN * step * outward) @ per_mm
    inside = scipy.ndimage.map_coordinates(mask.astype(np.uint8), np.round(within).T, order=0, mode="nearest")
    thin = (inside == 0) & (outward != 0).any(axis=1)
    if thin.mean() > _MANY_THIN:
        warn(
            f"label {label}: {thin.mean():.0%} of the boundary is of parts that are thinner than two voxels "
            f"({_THIN * step:.2g} mm). Look at them in the picture: they may have grown together or broken off.",
        )
