"""Images and label maps from files: the format by its suffix, and scans of what they show."""

import errno
import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsubdiv.errors import check_scale
from jaxsubdiv.notices import warn

from ..scan.scan import Scan, ScanError
from ..scan.scan import read_scan as read_points
from . import dicom_seg, meta_image, nifti, nrrd
from .boundary import scan_above, scan_of_label
from .volume import Label, Volume, choose_label, find_labels

_READERS: dict[str, Callable[[Path], Volume]] = {
    ".nii.gz": nifti.read,
    ".nii": nifti.read,
    ".nrrd": nrrd.read,
    ".mha": meta_image.read,
    ".mhd": meta_image.read,
    ".dcm": dicom_seg.read,
}


_FARTHEST, _LEAST = 1e9, 1e-6  # mm: of any voxel from the origin, and from voxel to voxel
_FLATTEST = 1e-3  # a voxel's volume, to that of a box of the same sides


class Seen(NamedTuple):
    """A scan, and the image that it was seen in."""

    scan: Scan
    volume: Volume
    label: Label | None
    """None of a grey image."""


def stem(path: Path) -> str:
    """The name of a file without the suffix of its format."""
    suffix = _suffix(path)
    return path.stem if suffix is None else path.name[: -len(suffix)] or path.name


def is_image(path: str | os.PathLike[str]) -> bool:
    """Whether a file's suffix is that of an image or a label map."""
    return _suffix(path) is not None


def _suffix(path: str | os.PathLike[str]) -> str | None:
    name = os.fspath(path).lower()
    return next((suffix for suffix in _READERS if name.endswith(suffix)), None)


def read_volume(path: str | os.PathLike[str], *, scale: float = 1.0) -> Volume:
    """An image or a label map from a file.

    Known suffixes, in any case: `.nii` and `.nii.gz` (NIfTI, in RAS; names of labels from a table of Connectome
    Workbench, as TotalSegmentator writes), `.nrrd` (in the frame that it names; names and layers of a segmentation of
    3D Slicer), `.mha` and `.mhd` (MetaImage, in LPS), `.dcm` (a DICOM segmentation, in LPS, with its names). The whole
    affine is used: oblique, flipped, with any spacing.

    Args:
        path: the file.
        scale: multiplies the positions; 1000 takes metres to mm. What a NIfTI file says of its unit is used before.

    Raises:
        FileNotFoundError: there is no such file.
        ScanError: the file is damaged, is not what its suffix says, or lies in no three dimensions.
        ImportError: the extra `images` is missing.
        ValueError: `scale` is not positive and finite.
    """
    path = Path(path)
    suffix = _suffix(path)
    if suffix is None:
        raise ScanError(f"{path.name}: images have one of the suffixes {', '.join(_READERS)}.")
    if not path.is_file():
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path))
    check_scale(scale)
    try:
        volume = _READERS[suffix](path)
        volume = volume._replace(
            layers=tuple(layer.astype(layer.dtype.newbyteorder("="), copy=False) for layer in volume.layers),
            labels=tuple(label._replace(name=_shorten_name(label.name)) for label in volume.labels),
        ).rescale(scale)
        _check(volume)
    except ScanError as error:
        raise ScanError(f"{path.name}: {error}") from None
    return volume


def _shorten_name(name: str) -> str:
    """A name as it can be printed: on one line, and not longer than a line."""
    return "".join(c if c.isprintable() else " " for c in name).strip()[:100]


def _check(volume: Volume) -> None:
    affine = volume.affine
    sound = bool(np.isfinite(affine).all() and np.abs(affine).max() < _FARTHEST and volume.spacing.min() > _LEAST)
    if not sound or volume.voxel_volume < _FLATTEST * np.prod(volume.spacing):
        axes = "; ".join(" ".join(f"{x:g}" for x in axis) for axis in affine[:3, :3].T)
        raise ScanError(
            f"its voxels have no size: the axes are {axes}. Set spacing and directions in the program that wrote it."
        )
    if min(volume.layers[0].shape) < 2:
        raise ScanError(f"it has {list(volume.layers[0].shape)} voxels, which is no volume.")
    if any(layer.dtype.kind not in "biuf" for layer in volume.layers):
        raise ScanError(f"its voxels are of the type {volume.layers[0].dtype}; they must be numbers.")


def read_scan(
    path: str | Path,
    *,
    scale: float = 1.0,
    labels: str | Sequence[str] = (),
    label: str | int | None = None,
    above: float | None = None,
) -> Scan:
    """A scan from a file: of points or a mesh, see `jaxsubdiv.read_points`; or of a label map or an image, see
    `read_volume`.

    Faces of a mesh file are kept, see `Scan.faces`. A column `slice` of a CSV file, or another table with a header row,
    numbers the slices. Points that are not finite are dropped, with a warning.

    Args:
        path: the file.
        scale: multiplies the coordinates. A file of points does not say its unit; 1000 takes metres to mm.
        labels: only the rows of a table whose column `label` or `contour` holds one of these texts, in capitals or not.
        label: of a label map, the value or the name of the structure; default: the only one.
        above: of a grey image, the value at the surface; what is above it lies inside.

    Raises:
        MeshError: the file cannot be read; the text names the file and the line.
        ScanError: it holds no points, or none of these labels, and the text lists those that there are; a slice has no
            whole number; or an image is damaged, has no such boundary, or is one of points.
        ImportError: a label map needs the extra `images`.
    """
    path = Path(path)
    if not is_image(path):
        if label is not None or above is not None:
            asked = "--label (`label=`)" if label is not None else "--above (`above=`)"
            raise ScanError(f"{path.name}: {asked} is for images and label maps, {', '.join(_READERS)}.")
        return read_points(path, scale=scale, labels=labels)
    if labels:
        raise ScanError(f"{path.name}: --labels (`labels=`) is for tables; a label map takes --label (`label=`).")
    return read_seen(path, scale=scale, label=label, above=above).scan


def read_labels(path: str | os.PathLike[str]) -> list[Label]:
    """The labels of a label map that have voxels.

    Raises:
        ScanError, FileNotFoundError, ImportError: as `read_volume` and `find_labels` do.
    """
    volume = read_volume(path)
    try:
        return [one.label for one in find_labels(volume)]
    except ScanError as error:
        raise ScanError(f"{Path(path).name}: {error}") from None


def read_seen(
    path: Path, *, scale: float = 1.0, label: Label | str | int | None = None, above: float | None = None
) -> Seen:
    """The scan of an image file, see `read_scan`, and what it was made of."""
    if label is not None and above is not None:
        raise ScanError(f"{path.name}: give a label of a label map or the grey value of an image, not both.")
    volume = read_volume(path, scale=scale)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            if above is not None:
                seen = Seen(scan_above(volume, above), volume, None)
            else:
                one = label if isinstance(label, Label) else choose_label(volume, label)
                seen = Seen(scan_of_label(volume, one), volume, one)
    except ScanError as error:
        raise ScanError(f"{path.name}: {error}") from None
    for one in told:
        warn(f"{path.name}: {one.message}")
    return seen
