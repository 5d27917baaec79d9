"""MetaImage. The library that keeps it, SimpleITK, takes 260 MB; a header of text and plain voxels take this page."""

import math
import os
import zlib
from pathlib import Path

import numpy as np

from ..scan.scan import ScanError
from .room import DEFLATED, check_room
from .volume import Volume

_MOST_HEADER = 1 << 16
_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}


def read(path: Path) -> Volume:
    """The volume, in LPS, as ITK has it. The voxels of an `.mhd` lie in the file that it names, beside it."""
    fields, rest = _read_header(path)
    if fields.get("NDims", "3") != "3":
        raise ScanError(f"it has {fields['NDims']} dimensions; three are read.")
    kind = _TYPES.get(fields.get("ElementType", "").upper())
    if kind is None or fields.get("ElementNumberOfChannels", "1") != "1":
        raise ScanError(f"its voxels are of the type '{fields.get('ElementType', '')}'; one number each is read.")
    shape = _numbers(fields, "DimSize", 3).astype(int)
    order = ">" if _is_set(fields, "BinaryDataByteOrderMSB") or _is_set(fields, "ElementByteOrderMSB") else "<"
    dtype = np.dtype(order + kind)
    data = _read_voxels(path, fields, rest, math.prod(int(n) for n in shape) * dtype.itemsize)
    values = np.frombuffer(data, dtype).reshape(shape, order="F").astype(dtype.newbyteorder("="))
    affine = np.eye(4)
    # A row of the file's matrix is the direction of an index.
    directions = _numbers(fields, "TransformMatrix", 9, "1 0 0 0 1 0 0 0 1", "Rotation", "Orientation").reshape(3, 3)
    spacing = _numbers(fields, "ElementSpacing", 3, "1 1 1", "ElementSize")
    affine[:3, :3] = (directions * spacing[:, None]).T
    affine[:3, 3] = _numbers(fields, "Offset", 3, "0 0 0", "Position", "Origin")
    return Volume((values,), affine, "LPS")


def _read_header(path: Path) -> tuple[dict[str, str], int]:
    """The fields, and where the voxels begin."""
    with path.open("rb") as file:
        begin = file.read(_MOST_HEADER)
    fields, at = {}, 0
    while at < len(begin):
        end = begin.find(b"\n", at)
        line = begin[at : end if end >= 0 else len(begin)]
        name, equal, value = line.decode("latin-1").partition("=")
        at = end + 1 if end >= 0 else len(begin)
        if not equal:
            if line.strip():
                break
            continue
        fields[name.strip()] = value.strip()
        if name.strip() == "ElementDataFile":
            return fields, at
    raise ScanError("its header has no line 'ElementDataFile = ...'. It is damaged, or no MetaImage.")


def _read_voxels(path: Path, fields: dict[str, str], start: int, n_bytes: int) -> bytes:
    where = fields["ElementDataFile"]
    if where.upper() == "LOCAL":
        file = path
    else:
        if where.upper() == "LIST" or Path(where).name != where or "%" in where:
            raise ScanError(f"its voxels are in '{where[:60]}'; one file beside it is read. Save it as .mha.")
        file, start = path.parent / where, 0
        if not os.path.isfile(file):  # also of a name that no file can have
            raise ScanError(f"its voxels are in '{where[:60]}', which is not beside it.")
    packed = _is_set(fields, "CompressedData")
    check_room(n_bytes, file.stat().st_size - start, DEFLATED if packed else 1)
    skipped = int(_numbers(fields, "HeaderSize", 1, "0")[0])
    with file.open("rb") as voxels:
        voxels.seek(file.stat().st_size - n_bytes if skipped == -1 and not packed else start + max(skipped, 0))
        data = voxels.read()
    if packed:
        try:
            data = zlib.decompressobj(47).decompress(data, n_bytes)
        except zlib.error as error:
            raise ScanError(f"its voxels cannot be unpacked: {error}.") from None
    if len(data) < n_bytes:
        raise ScanError(f"it ends after {len(data):,} of {n_bytes:,} bytes of voxels. Was it copied to its end?")
    return data[:n_bytes]


def _is_set(fields: dict[str, str], name: str) -> bool:
    return fields.get(name, "").lower() in ("true", "1")


def _numbers(fields: dict[str, str], name: str, n: int, default: str = "", *others: str) -> np.ndarray:
    """`n` finite numbers of a field, or of the first of its other names."""
    text = next((fields[key] for key in (name, *others) if key in fields), default)
    try:
        values = np.array(text.split(), float)
    except ValueError:
        values = np.zeros(0)
    if len(values) != n or not np.isfinite(values).all() or (np.abs(values) > 1e9).any():
        raise ScanError(f"its header needs {n} numbers in the line '{name} = ...'; got '{text[:60]}'.")
    if name == "DimSize" and ((values < 1).any() or (values != np.round(values)).any()):
        raise ScanError(f"its header has the size '{text[:60]}'; it must be three whole numbers, 1 or more.")
    return values
