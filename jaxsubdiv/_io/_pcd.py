"""PCD files of the Point Cloud Library: text, binary, and binary packed by LZF.

Not by Open3D or PCL: both are heavy, and neither refuses what a damaged header announces.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Shaped

from ..errors import MeshError
from ..tables import decode
from ._contents import Contents, as_double, warn
from ._text import parse_rows

_POSITION, _NORMAL = ("x", "y", "z"), ("normal_x", "normal_y", "normal_z")
_TYPES = {
    **{("F", 4): "<f4", ("F", 8): "<f8"},
    **{(letter, n): f"<{letter.lower()}{n}" for letter in "IU" for n in (1, 2, 4, 8)},
}
_DATA = ("ascii", "binary", "binary_compressed")
_MOST_FIELDS, _MOST_LINE = 1000, 100_000
_UNMOVED = ["0", "0", "0", "1", "0", "0", "0"]


class _Header(NamedTuple):
    names: list[str]
    types: list[np.dtype]
    """Of each field, an array where it has several numbers."""
    n_points: int
    form: str
    n_bytes: int
    n_lines: int


def read(path: Path) -> Contents:
    """The fields x, y and z, and the normals where they are there; every other one is left out."""
    data = path.read_bytes()
    header = _read_header(path, data)
    columns = _read_text(path, data, header) if header.form == "ascii" else _read_binary(path, data, header)
    points, normals = (
        np.stack([as_double(columns[name]) for name in names], axis=1) if set(names) <= columns.keys() else None
        for names in (_POSITION, _NORMAL)
    )
    assert points is not None
    return Contents(points, None, normals)


def _read_header(path: Path, data: bytes) -> _Header:
    found: dict[str, list[str]] = {}
    at = number = 0
    while "DATA" not in found:
        end = data.find(b"\n", at, at + _MOST_LINE)
        if end < 0:
            raise MeshError(f"{path.name}, line {number + 1}: the header has no line 'DATA'. This is no PCD file.")
        words, at, number = data[at:end].decode("ascii", errors="replace").split(), end + 1, number + 1
        if words and not words[0].startswith("#"):
            found[words[0]] = words[1:]
            if not re.fullmatch("[A-Z]{1,20}", words[0]):
                raise MeshError(f"{path.name}, line {number}: '{words[0][:40]}' has no meaning in a PCD header.")
    names = found.get("FIELDS", found.get("COLUMNS", []))
    sizes, letters = found.get("SIZE", []), found.get("TYPE", [])
    repeats = found.get("COUNT", ["1"] * len(names))
    count = found.get("POINTS") or [str(_product(path, found))]
    if not 0 < len(names) == len(sizes) == len(letters) == len(repeats) <= _MOST_FIELDS:
        raise MeshError(f"{path.name}: FIELDS, SIZE, TYPE and COUNT of its header must have a word for each field.")
    types = []
    for name, size, letter, repeat in zip(names, sizes, letters, repeats, strict=True):
        known = _TYPES.get((letter, int(size))) if re.fullmatch("[1248]", size) else None
        if known is None or not re.fullmatch("[0-9]{1,6}", repeat):
            what = f"the field '{name[:40]}' has the type {letter[:9]} of {size[:9]} bytes, {repeat[:9]} times"
            raise MeshError(f"{path.name}: {what}, which is not known. The header is damaged.")
        types.append(np.dtype((known, (int(repeat),))) if repeat != "1" else np.dtype(known))
    missing = [name for name in _POSITION if name not in names]
    if missing or any(types[names.index(name)].shape for name in (*_POSITION, *_NORMAL) if name in names):
        raise MeshError(
            f"{path.name}: its fields must have x, y and z, one number each; it has {' '.join(names)[:80]}."
        )
    if not re.fullmatch("[0-9]{1,18}", count[0]) or found["DATA"][:1] not in [[form] for form in _DATA]:
        raise MeshError(f"{path.name}: POINTS must be a whole number, and DATA one of {', '.join(_DATA)}.")
    if found.get("VIEWPOINT", _UNMOVED) != _UNMOVED:
        warn(path, "it names the VIEWPOINT of the sensor, which was not applied: points are as stored.")
    return _Header(names, types, int(count[0]), found["DATA"][0], at, number)


def _product(path: Path, found: dict[str, list[str]]) -> int:
    """The number of points of a header without POINTS."""
    words = [found.get(name, ["1"])[:1] for name in ("WIDTH", "HEIGHT")]
    if "WIDTH" not in found or not all(word and re.fullmatch("[0-9]{1,9}", word[0]) for word in words):
        raise MeshError(f"{path.name}: its header must have POINTS, or WIDTH and HEIGHT, as whole numbers.")
    return int(words[0][0]) * int(words[1][0])


def _read_text(path: Path, data: bytes, header: _Header) -> dict[str, Shaped[np.ndarray, "n"]]:
    rows = parse_rows(path, decode(data[header.n_bytes :]), header.n_lines + 1)
    widths = [int(np.prod(type_.shape, dtype=int)) for type_ in header.types]
    if (rows.counts != sum(widths)).any():
        line = rows.lines[rows.counts != sum(widths)][0]
        raise MeshError(f"{path.name}, line {line}: a point needs {sum(widths)} numbers, as its fields have them.")
    _check_count(path, header, len(rows.counts))
    table = rows.table(sum(widths))[: header.n_points]
    places = np.cumsum([0, *widths])
    return {name: table[:, place] for name, place in zip(header.names, places, strict=False) if name != "_"}


def _read_binary(path: Path, data: bytes, header: _Header) -> dict[str, Shaped[np.ndarray, "n"]]:
    width, n, at = sum(type_.itemsize for type_ in header.types), header.n_points, header.n_bytes
    wanted = [(name, place) for place, name in enumerate(header.names) if name in (*_POSITION, *_NORMAL)]
    before = np.cumsum([0, *(type_.itemsize for type_ in header.types)])
    if header.form == "binary":
        _check_count(path, header, (len(data) - at) // width)
        rows = np.frombuffer(data, np.uint8, n * width, at).reshape(n, width)
        return {
            name: np.ascontiguousarray(rows[:, before[i] : before[i + 1]]).view(header.types[i])[:, 0]
            for name, i in wanted
        }
    packed, n_bytes = np.frombuffer(data[at : at + 8].ljust(8, b"\0"), "<u4").tolist()
    if n_bytes != n * width or packed > len(data) - at - 8:
        raise MeshError(
            f"{path.name}, byte {at}: {packed} bytes that unpack to {n_bytes} are announced, but {n} points take "
            f"{n * width}, and {max(len(data) - at - 8, 0)} bytes follow. The file is cut off or damaged."
        )
    try:
        unpacked = unpack_lzf(data[at + 8 : at + 8 + packed], n_bytes)
    except ValueError as error:
        raise MeshError(f"{path.name}, byte {at}: {error}. The file is damaged.") from None
    return {name: np.frombuffer(unpacked, header.types[i], n, n * int(before[i])) for name, i in wanted}


def _check_count(path: Path, header: _Header, n: int) -> None:
    if n < header.n_points:
        raise MeshError(f"{path.name}: {header.n_points} points are announced, but {n} are there. It is cut off.")


def unpack_lzf(packed: bytes, n_bytes: int) -> bytes:
    """`n_bytes` out of what LZF packed: runs of bytes as they are, and of bytes that came before.

    Source: M. Lehmann, liblzf, the layout in its `lzf_d.c`.

    Raises:
        ValueError: it is damaged, or of another length.
    """
    if n_bytes > 90 * len(packed):  # three bytes stand for 264 at most
        raise ValueError(f"{len(packed)} bytes cannot unpack to the {n_bytes} that are announced")
    found, at, end = bytearray(), 0, len(packed)
    while at < end and len(found) <= n_bytes:
        control, at = packed[at], at + 1
        if control < 32:
            found += packed[at : at + control + 1]
            at += control + 1
            continue
        length, low = control >> 5, 1 if control >> 5 < 7 else 2
        if at + low > end:
            raise ValueError("the packed bytes end within a run")
        length += packed[at] if low == 2 else 0
        begin = len(found) - ((control & 31) << 8) - packed[at + low - 1] - 1
        at += low
        if begin < 0:
            raise ValueError("a run begins before the first byte")
        run = found[begin : begin + length + 2]
        found += (run * (-(-(length + 2) // len(run))))[: length + 2]  # a run may overlap what it makes
    if at != end or len(found) != n_bytes:
        raise ValueError(f"{len(found)} bytes or more, where {n_bytes} are announced")
    return bytes(found)
