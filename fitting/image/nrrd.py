"""NRRD, by pynrrd, which reads the voxels only where the header is one that the file has room for."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from jaxsubdiv.frames import Frame

from ..scan.scan import ScanError
from .need import check_room, need
from .volume import Label, Volume

_MOST_HEADER = 1 << 22
# Spaces by the signs that take them to one of the two frames.
_SPACES: dict[str, tuple[Frame, tuple[int, int, int]]] = {
    "right-anterior-superior": ("RAS", (1, 1, 1)),
    "ras": ("RAS", (1, 1, 1)),
    "left-posterior-superior": ("LPS", (1, 1, 1)),
    "lps": ("LPS", (1, 1, 1)),
    "left-anterior-superior": ("RAS", (-1, 1, 1)),
    "las": ("RAS", (-1, 1, 1)),
}
_UNITS = {"mm": 1.0, "m": 1000.0, "cm": 10.0, "um": 0.001, "µm": 0.001}


def read(path: Path) -> Volume:
    """The volume, of as many layers as a segmentation of 3D Slicer has."""
    nrrd = need("nrrd")
    _check_text(path)
    try:
        with path.open("rb") as file:
            header: Any = nrrd.read_header(file)
            if "data file" in header or "datafile" in header:
                raise ScanError("its voxels are in another file. Save header and voxels as one .nrrd.")
            packed = str(header.get("encoding")).lower() not in ("raw",)
            n = math.prod(int(size) for size in header["sizes"])
            check_room(n, path.stat().st_size, packed)
            values = nrrd.read_data(header, file)
    except ScanError:
        raise
    except Exception as error:  # pynrrd has errors of its own, and lets through those of zlib, bz2 and numpy
        raise ScanError(f"it is no NRRD file, or damaged: {error or type(error).__name__}.") from None
    return _place(values, header)


def _check_text(path: Path) -> None:
    """A header ends at an empty line: where there is none, the whole file would be read as text."""
    with path.open("rb") as file:
        begin = file.read(_MOST_HEADER)
    if not begin.startswith(b"NRRD0") or not (b"\n\n" in begin or b"\r\n\r\n" in begin):
        raise ScanError("it does not begin as a NRRD file does. It is damaged, or of another format.")


def _place(values: np.ndarray, header: Any) -> Volume:
    directions = header.get("space directions")
    if directions is None and "spacings" in header:
        directions = np.diag(np.asarray(header["spacings"], float)[-3:])
    rows = [] if directions is None else [_vector(row) for row in directions]
    spatial = [axis for axis, row in enumerate(rows) if row is not None]
    if len(spatial) != 3 or len(rows) != values.ndim or values.ndim > 4:
        raise ScanError(
            f"it has {values.ndim} axes, of which {len(spatial)} have a direction in space; three are read, and layers "
            "of a segmentation beside them. Write 'space directions' into it."
        )
    others = [axis for axis in range(values.ndim) if axis not in spatial]
    layers = np.moveaxis(values, others[0], 0) if others else values[None]
    affine = np.eye(4)
    for column, axis in enumerate(spatial):
        affine[:3, column] = rows[axis]
    origin = _vector(header.get("space origin", np.zeros(3)))
    affine[:3, 3] = 0 if origin is None else origin
    units = {_UNITS.get(str(unit).strip('"').lower(), 1.0) for unit in header.get("space units", ["mm"])}
    frame, signs = _SPACES.get(str(header.get("space", "")).lower(), (None, (1, 1, 1)))
    affine[:3] *= np.array(signs)[:, None] * (units.pop() if len(units) == 1 else 1.0)
    volume = Volume(tuple(layers), affine, frame, tuple(_labels(header, len(layers))))
    offset = _vector(str(header.get("Segmentation_ReferenceImageExtentOffset", "")).split())
    if offset is None:
        return volume
    # 3D Slicer stores no more than the box of all segments: past it there is nothing, but where the image begins.
    first, second, third = (int(n > 0) for n in offset)
    return volume.padded((first, second, third), (1, 1, 1))


def _vector(row: Any) -> np.ndarray | None:
    """Three numbers; None for the direction of an axis that is none of space."""
    try:
        values = np.asarray(row, dtype=float).ravel() if row is not None else np.zeros(0)
    except ValueError:
        return None
    return values if values.shape == (3,) and np.isfinite(values).all() else None


def _labels(header: Any, n_layers: int) -> list[Label]:
    """Segments as 3D Slicer names them, each in its layer."""
    labels, number = [], 0
    while f"Segment{number}_Name" in header or f"Segment{number}_LabelValue" in header:
        own = {key: header.get(f"Segment{number}_{key}") for key in ("Name", "LabelValue", "Layer")}
        try:
            value, layer = int(own["LabelValue"] or number + 1), int(own["Layer"] or 0)
        except ValueError:
            raise ScanError(
                f"Segment{number} has the value {own['LabelValue']!r} and the layer {own['Layer']!r}."
            ) from None
        if not 0 <= layer < n_layers:
            raise ScanError(f"Segment{number} is in layer {layer}, and there are {n_layers}, counted from zero.")
        labels.append(Label(value, str(own["Name"] or ""), layer))
        number += 1
    return labels
