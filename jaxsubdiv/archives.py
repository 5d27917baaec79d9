"""Arrays from `.npz` and `.npy` files: read only where their own headers say what the file has room for."""

import math
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_ZIP, _NPY = b"PK\x03\x04", b"\x93NUMPY"
_NO_ZIP = b"PK\x05\x06"  # an archive without a member
_KINDS = {"O": "objects", "S": "bytes", "U": "text", "M": "dates", "m": "spans of time", "c": "complex numbers"}
_NUMBERS = "biuf"
# What random points pack to is far from it; an archive of equal numbers may pass it while it is small.
_MOST_PACKED, _SMALL = 100, 1 << 28


def read_arrays(
    path: Path, wanted: Callable[[str], bool] = lambda name: True, *, text: bool = False
) -> dict[str, np.ndarray | None]:
    """The arrays of an archive by name, None for those that are not wanted; a bare array has the name "".

    Args:
        path: an `.npz` or `.npy` file, told apart by how it begins.
        wanted: which arrays are read, by name.
        text: True where arrays may hold text too.

    Raises:
        ValueError: the file is damaged or another, or an array is not of plain numbers; the text names the array.
    """
    kinds = _NUMBERS + "U" * text
    size = path.stat().st_size
    with path.open("rb") as file:
        begin = file.read(len(_NPY))
        file.seek(0)
        if begin == _NPY:
            return {"": _read_array(file, size, kinds)}
        if begin[:4] not in (_ZIP, _NO_ZIP):
            raise ValueError("it begins neither as an .npz nor as an .npy file. It is damaged, or of another format")
        try:
            return _read_members(file, size, wanted, kinds)
        except ValueError:
            raise
        except Exception as error:  # zipfile and zlib have a dozen of their own
            raise ValueError(f"the archive is damaged ({error or type(error).__name__})") from None


def _read_members(file: BinaryIO, size: int, wanted: Callable[[str], bool], kinds: str) -> dict[str, np.ndarray | None]:
    arrays: dict[str, np.ndarray | None] = {}
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        unpacked = sum(member.file_size for member in members)
        if unpacked > max(_SMALL, _MOST_PACKED * size):
            raise ValueError(
                f"{size} bytes are announced to unpack to {unpacked}. It is damaged, or made to fill memory"
            )
        for member in members:
            name = member.filename.removesuffix(".npy")
            arrays[name] = None
            if not wanted(name):
                continue
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"the array '{name}' is packed in a way that numpy does not write. Save it with numpy")
            try:
                with archive.open(member) as stream:
                    arrays[name] = _read_array(stream, member.file_size, kinds)
            except ValueError as error:
                raise ValueError(f"the array '{name}': {error}") from None
    return arrays


def _read_array(stream: Any, size: int, kinds: str) -> np.ndarray:
    """One array in numpy's format, where its header agrees with the `size` of the stream in bytes."""
    shape, by_columns, dtype = _read_header(stream)
    if dtype.kind not in kinds or dtype.hasobject or dtype.subdtype is not None:
        held = _KINDS.get(dtype.kind, f"'{str(dtype)[:40]}'")
        raise ValueError(f"it holds {held}, where plain numbers are expected. Save it as numbers")
    n_bytes = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or len(shape) > 32 or n_bytes != size - stream.tell():
        raise ValueError(
            f"its header announces {dtype} of the shape {list(shape[:32])}, but {size - stream.tell()} bytes follow. "
            "The file is cut off or damaged"
        )
    array = np.frombuffer(bytearray(stream.read(n_bytes)), dtype)  # of a bytearray, so that it can be written to
    if array.nbytes != n_bytes or stream.read(1):
        raise ValueError("it ends before its last number. The file is cut off")
    if dtype.kind == "U" and array.size and array.view(f"{dtype.byteorder}u4").max() > sys.maxunicode:
        raise ValueError("it holds what is no text. The file is damaged")
    return array.reshape(shape, order="F" if by_columns else "C")


def _read_header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy evaluates the header as Python, which warns of what is odd in it
            version = np.lib.format.read_magic(stream)
            read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            # Version 3 differs from 2 by names of fields, which plain numbers do not have.
            return read[version](stream)
    except Exception as error:
        raise ValueError(f"its header cannot be read ({str(error)[:80] or type(error).__name__})") from None
