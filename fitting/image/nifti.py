"""NIfTI, by nibabel, which gets a file only where its header is one that the file has room for."""

import gzip
import math
import re
import struct
import zlib
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

from jaxsubdiv.extras import import_extra

from ..scan.scan import ScanError
from .room import DEFLATED, check_room
from .volume import Label, Volume

_UNITS = {1: 1000.0, 2: 1.0, 3: 0.001}  # of NIfTI: m, mm, micrometres
_MOST_TEXT = 1 << 22  # bytes before the voxels: headers and tables
# Names of labels, as Connectome Workbench, and TotalSegmentator after it, write them into a header extension.
_NAMED, _KEY = re.compile(r"<Label\b([^<>]*)>(?:<!\[CDATA\[)?([^<\]]*)"), re.compile(r'\bKey="(\d{1,9})"')


def read(path: Path) -> Volume:
    """The volume; a fourth dimension must be of length 1."""
    nibabel = import_extra("nibabel", "images", "NIfTI files")
    kinds: Any = nibabel.nifti1.data_type_codes.dtype
    _check_header(
        path, {code: kinds[code].itemsize for code in kinds if isinstance(code, int) and kinds[code].kind in "iuf"}
    )
    try:
        image: Any = nibabel.load(path)
        values = np.asarray(image.dataobj)
        affine = np.asarray(image.affine, np.float64)
        header = image.header
        unit = _UNITS.get(int(header["xyzt_units"]) & 7, 1.0)
        placed = int(header["sform_code"]) > 0 or int(header["qform_code"]) > 0
        text = b"".join(content for one in header.extensions if isinstance(content := one.get_content(), bytes))
    except MemoryError:
        raise
    except Exception as error:  # nibabel lets through those of zlib, numpy, and of what reads its extensions
        raise ScanError(f"it is no NIfTI file, or damaged: {error or type(error).__name__}.") from None
    while values.ndim > 3 and values.shape[-1] == 1:
        values = values[..., 0]
    if values.ndim != 3:
        raise ScanError(f"it has the shape {list(values.shape)}; one volume [i, j, k] is read. Split it first.")
    if not placed:
        raise ScanError(
            "it does not say where its voxels lie (sform and qform codes are 0), nor which side is left. Set them in "
            "the program that wrote it."
        )
    affine[:3] *= unit
    return Volume((values,), affine, "RAS", tuple(_labels(text.decode("utf-8", "replace"))))


def _labels(text: str) -> Iterator[Label]:
    for attributes, name in _NAMED.findall(text):
        if key := _KEY.search(attributes):
            yield Label(int(key[1]), unescape(name))


def _check_header(path: Path, sizes: dict[int, int]) -> None:
    """See that a file's header is one that the file has room for.

    Args:
        path: the file.
        sizes: of a voxel in bytes, by the code of its type.
    """
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    if packed != path.name.lower().endswith(".gz"):
        raise ScanError(
            "it is packed by gzip: rename it to .nii.gz." if packed else "it is not packed by gzip: rename it to .nii."
        )
    try:
        with gzip.open(path) if packed else path.open("rb") as file:
            head = file.read(540)
    except (OSError, EOFError, zlib.error) as error:
        raise ScanError(f"it is damaged: {error}.") from None
    for order in "<>":
        if head[:4] == struct.pack(order + "i", 348) and len(head) >= 348:
            dims, kind = struct.unpack_from(order + "8h", head, 40), struct.unpack_from(order + "h", head, 70)[0]
            start, magic = struct.unpack_from(order + "f", head, 108)[0], head[344:347]
            break
        if head[:4] == struct.pack(order + "i", 540) and len(head) >= 540:
            dims, kind = struct.unpack_from(order + "8q", head, 16), struct.unpack_from(order + "h", head, 12)[0]
            start, magic = struct.unpack_from(order + "q", head, 168)[0], head[4:7]
            break
    else:
        raise ScanError("it does not begin as a NIfTI file does. It is damaged, or of another format.")
    if magic not in (b"n+1", b"n+2"):
        raise ScanError("its header is that of another file with the voxels, .img. Save both as one .nii.")
    if not 3 <= dims[0] <= 7 or min(dims[1 : dims[0] + 1]) < 1:
        raise ScanError(f"its header has the dimensions {list(dims)}; one volume [i, j, k] is read.")
    shape = [int(dim) for dim in dims[1 : dims[0] + 1]]
    if math.prod(shape[3:]) > 1:
        raise ScanError(f"it has the shape {shape}; one volume [i, j, k] is read. Split it first.")
    if min(shape[:3]) < 2:
        raise ScanError(f"it has {shape[:3]} voxels, which is no volume.")
    if not 0 <= start <= _MOST_TEXT:  # also of NaN
        raise ScanError(f"its header announces {start:g} bytes before the voxels. It is damaged.")
    if kind not in sizes:
        raise ScanError(f"its voxels are of the type {kind}; those with one number each are read.")
    check_room(math.prod(shape) * sizes[kind], path.stat().st_size, DEFLATED if packed else 1)
