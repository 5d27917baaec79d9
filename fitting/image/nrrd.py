"""NRRD: the header by pynrrd; the voxels here, never more of them than the header announces."""

import bz2
import math
import re
import warnings
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jaxsubdiv.extras import import_extra
from jaxsubdiv.frames import Frame

from ..scan.scan import ScanError
from .room import BZIPPED, DEFLATED, check_room
from .volume import Label, Volume

_MOST_HEADER = 1 << 22
_NAMES = {
    "i1": "signed char, int8, int8_t",
    "u1": "uchar, unsigned char, uint8, uint8_t",
    "i2": "short, short int, signed short, signed short int, int16, int16_t",
    "u2": "ushort, unsigned short, unsigned short int, uint16, uint16_t",
    "i4": "int, signed int, int32, int32_t",
    "u4": "uint, unsigned int, uint32, uint32_t",
    "i8": "longlong, long long, long long int, signed long long, signed long long int, int64, int64_t",
    "u8": "ulonglong, unsigned long long, unsigned long long int, uint64, uint64_t",
    "f4": "float",
    "f8": "double",
}
_TYPES = {name: kind for kind, names in _NAMES.items() for name in names.split(", ")}
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
    nrrd = import_extra("nrrd", "images", "NRRD files")
    lines, start = _read_header(path)
    try:
        header: Any = nrrd.read_header(lines)
    except MemoryError:
        raise
    except Exception as error:  # pynrrd has errors of its own, and lets through those of numpy and others
        raise ScanError(f"it is no NRRD file, or damaged: {error or type(error).__name__}.") from None
    if "data file" in header or "datafile" in header:
        raise ScanError("its voxels are in another file. Save header and voxels as one .nrrd.")
    return _place(_read_voxels(path, header, start), header)


def _read_header(path: Path) -> tuple[list[str], int]:
    """Its lines, and where the voxels begin: after an empty line."""
    with path.open("rb") as file:
        begin = file.read(_MOST_HEADER)
    end = re.search(rb"\n[ \t\r]*\n", begin)
    if not begin.startswith(b"NRRD0") or end is None:
        raise ScanError("it does not begin as a NRRD file does. It is damaged, or of another format.")
    return begin[: end.start()].decode("utf-8", "replace").split("\n"), end.end()


def _read_voxels(path: Path, header: Any, start: int) -> np.ndarray:
    sizes, encoding = [int(n) for n in header.get("sizes", ())], str(header.get("encoding", "")).lower()
    kind = _TYPES.get(str(header.get("type", "")).lower())
    if kind is None:
        raise ScanError(f"its voxels are of the type '{header.get('type')}'; numbers are read.")
    if not sizes or min(sizes) < 1 or len(sizes) != header.get("dimension"):
        raise ScanError(f"its header has the sizes {sizes} and the dimension {header.get('dimension')}. It is damaged.")
    text = encoding in ("ascii", "text", "txt")
    dtype, n = np.dtype(kind), math.prod(sizes)
    if dtype.itemsize > 1 and not text:
        if header.get("endian") not in ("little", "big"):
            raise ScanError(f"its header has the line 'endian: {header.get('endian')}'; it must be little or big.")
        dtype = dtype.newbyteorder(header["endian"])
    lines, skipped = (int(header.get(f"{word} skip", header.get(f"{word}skip", 0))) for word in ("line", "byte"))
    if lines < 0 or skipped < (-1 if encoding == "raw" else 0):
        raise ScanError(f"its header skips {lines} lines and {skipped} bytes. It is damaged.")
    n_bytes, size = n * dtype.itemsize, path.stat().st_size
    with path.open("rb") as file:
        file.seek(start)
        while lines and file.readline():
            lines -= 1
        if text:
            check_room(n, size, 1)
            data = _read_text(file, dtype, n).tobytes()
        elif encoding == "raw":
            check_room(n_bytes, size - start, 1)
            file.seek(*((size - n_bytes, 0) if skipped == -1 else (min(skipped, size), 1)))
            data = file.read(n_bytes)
        else:
            data = _unpack(file.read(), encoding, skipped, n_bytes)
    if len(data) < n_bytes:
        raise ScanError(f"it ends after {len(data):,} of {n_bytes:,} bytes of voxels. Was it copied to its end?")
    return np.frombuffer(data, dtype).reshape(sizes, order="F")


def _read_text(file: BinaryIO, dtype: np.dtype, n: int) -> np.ndarray:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # what numpy says of words among the numbers
            return np.fromfile(file, dtype, n, sep=" ")
    except (DeprecationWarning, ValueError, OSError) as error:
        raise ScanError(f"its voxels are no numbers: {error}.") from None


def _unpack(packed: bytes, encoding: str, skipped: int, n_bytes: int) -> bytes:
    """So many bytes after those that are skipped; never more than are wanted."""
    if encoding in ("gzip", "gz"):
        check_room(n_bytes + skipped, len(packed), DEFLATED)
        unpacker: Any = zlib.decompressobj(zlib.MAX_WBITS | 16)
    elif encoding in ("bzip2", "bz2"):
        check_room(n_bytes + skipped, len(packed), BZIPPED)
        unpacker = bz2.BZ2Decompressor()
    else:
        raise ScanError(f"its voxels have the encoding '{encoding}'; raw, gzip, bzip2 and ascii are read.")
    try:
        return unpacker.decompress(packed, n_bytes + skipped)[skipped:]
    except (zlib.error, OSError, EOFError, ValueError) as error:
        raise ScanError(f"its voxels cannot be unpacked: {error}.") from None


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
    return volume.pad((first, second, third), (1, 1, 1))


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
