"""NIfTI, by nibabel, which gets a file only where its header is one that the file has room for."""

import gzip
import re
import struct
import zlib
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

from ..scan.scan import ScanError
from .need import check_room, need
from .volume import Label, Volume

_UNITS = {1: 1000.0, 2: 1.0, 3: 0.001}  # of NIfTI: m, mm, micrometres
_MOST_TEXT = 1 << 22  # bytes before the voxels: headers and tables
# Names of labels, as Connectome Workbench, and TotalSegmentator after it, write them into a header extension.
_NAMED = re.compile(r'<Label\b[^>]*\bKey="(\d{1,9})"[^>]*>(?:<!\[CDATA\[)?([^<\]]*)')


def read(path: Path) -> Volume:
    """The volume; a fourth dimension must be of length 1."""
    nibabel = need("nibabel")
    _check_header(path)
    try:
        image: Any = nibabel.load(path)
        values = np.asarray(image.dataobj)
        affine = np.asarray(image.affine, np.float64)
        header = image.header
        unit = _UNITS.get(int(header["xyzt_units"]) & 7, 1.0)
        placed = int(header["sform_code"]) > 0 or int(header["qform_code"]) > 0
        text = b"".join(one.get_content() if isinstance(one.get_content(), bytes) else b"" for one in header.extensions)
    except (nibabel.filebasedimages.ImageFileError, nibabel.spatialimages.HeaderDataError) as error:
        raise ScanError(f"it is no NIfTI file, or damaged: {error}.") from None
    except (
        OSError,
        EOFError,
        ValueError,
        TypeError,
        LookupError,
        OverflowError,
        zlib.error,
        struct.error,
    ) as error:
        raise ScanError(f"it is damaged: {error or type(error).__name__}.") from None
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
    names = _NAMED.findall(text.decode("utf-8", "replace"))
    return Volume((values,), affine, "RAS", tuple(Label(int(key), unescape(name)) for key, name in names))


def _check_header(path: Path) -> None:
    """See that the sizes in the header are those of a file as large as this."""
    with path.open("rb") as file:
        packed = file.read(2) == b"\x1f\x8b"
    try:
        with gzip.open(path) if packed else path.open("rb") as file:
            head = file.read(540)
    except (OSError, EOFError, zlib.error) as error:
        raise ScanError(f"it is damaged: {error}.") from None
    for order in "<>":
        if head[:4] == struct.pack(order + "i", 348) and len(head) >= 348:
            dims, bits = struct.unpack_from(order + "8h", head, 40), struct.unpack_from(order + "h", head, 72)[0]
            start = struct.unpack_from(order + "f", head, 108)[0]
            break
        if head[:4] == struct.pack(order + "i", 540) and len(head) >= 540:
            dims, bits = struct.unpack_from(order + "8q", head, 16), struct.unpack_from(order + "h", head, 14)[0]
            start = struct.unpack_from(order + "q", head, 168)[0]
            break
    else:
        raise ScanError("it does not begin as a NIfTI file does. It is damaged, or of another format.")
    if not 3 <= dims[0] <= 7 or min(dims[1 : dims[0] + 1]) < 1:
        raise ScanError(f"its header has the dimensions {list(dims)}; one volume [i, j, k] is read.")
    if not 0 <= start <= _MOST_TEXT:  # also of NaN
        raise ScanError(f"its header announces {start:g} bytes before the voxels. It is damaged.")
    n = 1
    for dim in dims[1 : dims[0] + 1]:
        n *= int(dim)
    check_room(n * bits // 8, path.stat().st_size, packed)
