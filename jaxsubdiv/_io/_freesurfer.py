"""Surfaces of FreeSurfer, binary and as text; other `.asc` files are tables of points.

Not by nibabel: it makes room for as many vertices as a damaged file announces.
"""

import re
from pathlib import Path

import numpy as np

from ..errors import MeshError
from ..tables import decode
from . import _table
from ._contents import Contents, VertexData, as_double, as_indices, round_to_single, split_quads, warn
from ._text import Rows, parse_rows

_MARK = "#!ascii"
_MAGIC, _OTHERS = b"\xff\xff\xfe", (b"\xff\xff\xff", b"\xff\xff\xfd")
_CENTRE = re.compile(rb"^cras\s*=\s*(\S{1,40})\s+(\S{1,40})\s+(\S{1,40})\s*$", re.MULTILINE)
_INVALID = re.compile(rb"valid\s*=\s*0")  # right after the bytes that begin these lines
_IN_SCANNER_SPACE = bytes((0, 0, 0, 2, 0, 0, 0, 1))  # begins what follows the faces
_MOST_VOLUME_INFO = 4000  # bytes of the lines that say which image a surface was made from


def is_binary(path: Path) -> bool:
    """Whether the file begins as a binary surface of FreeSurfer, whose names have no suffix of their own."""
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) in (_MAGIC, *_OTHERS)


def read_binary(path: Path) -> Contents:
    """Vertices as they are stored, and triangles.

    FreeSurfer stores surface RAS, whose origin is the middle of the image, and beside it where that middle lies in the
    scanner's RAS; a warning says so where the two differ.
    """
    data = path.read_bytes()
    if data[:3] != _MAGIC:
        raise MeshError(
            f"{path.name}: it is no binary surface of triangles of FreeSurfer, which begins with the bytes FF FF FE. "
            + (
                "It is a surface of quads, as old versions wrote, which mris_convert turns into one; or values on a "
                "surface, as thickness and curvature, which are no surface."
                if data[:3] in _OTHERS
                else "It is of another format, or damaged."
            )
        )
    begin = data.find(b"\n", 0, 1000) + 1
    begin += data[begin : begin + 1] == b"\n"  # a blank line follows the line that says who made it
    n_vertices, n_faces = np.frombuffer(data[begin : begin + 8].ljust(8, b"\xff"), ">i4").tolist()
    corners, end = begin + 8 + 12 * n_vertices, begin + 8 + 12 * (n_vertices + n_faces)
    if min(begin - 1, n_vertices, n_faces) < 0 or end > len(data):
        raise MeshError(
            f"{path.name}, byte {begin}: {n_vertices} vertices and {n_faces} triangles are announced, which is not "
            f"what its {len(data)} bytes hold. The file is cut off or damaged."
        )
    _warn_of_centre(path, data[end : end + _MOST_VOLUME_INFO])
    vertices = np.frombuffer(data, ">f4", 3 * n_vertices, begin + 8).reshape(-1, 3)
    faces = np.frombuffer(data, ">i4", 3 * n_faces, corners).reshape(-1, 3).astype(np.int64)
    return Contents(as_double(vertices), {3: faces} if n_faces else None)


def _warn_of_centre(path: Path, volume_info: bytes) -> None:
    found = _CENTRE.search(volume_info)
    if not found or _INVALID.search(volume_info) or volume_info.startswith(_IN_SCANNER_SPACE):
        return
    try:
        centre = [float(part) for part in found.groups()]
    except ValueError:
        return
    if any(centre):
        x, y, z = (f"{value:g}" for value in centre)
        warn(
            path,
            f"coordinates are surface RAS, as stored. Its image lies at c_ras = ({x}, {y}, {z}): add that to bring it "
            "to scanner RAS, where other data are.",
        )


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Binary, triangles in single precision; without the image's place, so that the coordinates are all there is."""
    vertices = round_to_single(path, "FreeSurfer", contents.vertices)
    triangles = split_quads(path, "FreeSurfer", contents)
    counts = np.array([len(vertices), len(triangles)], ">i4")
    parts = [_MAGIC, b"created by jaxsubdiv\n\n", counts, vertices.astype(">f4"), triangles.astype(">i4")]
    path.write_bytes(b"".join(part if isinstance(part, bytes) else part.tobytes() for part in parts))


def read_text(path: Path) -> Contents:
    """Vertices and triangles; the flag after each is left out."""
    rows, n_vertices, n_faces = _rows(path)
    faces = rows.part(1 + n_vertices, 1 + n_vertices + n_faces)
    _check(path, faces, n_faces, "faces")
    vertices = _vertices(path, rows, n_vertices)
    return Contents(vertices.vertices, {3: as_indices(path, faces.table(3))} if n_faces else None)


def read_points(path: Path) -> Contents:
    """The vertices; the points of a table where it is no surface."""
    with path.open("rb") as file:
        if not file.read(len(_MARK)) == _MARK.encode():
            return _table.read(path)
    rows, n_vertices, _ = _rows(path)
    return _vertices(path, rows, n_vertices)


def _rows(path: Path) -> tuple[Rows, int, int]:
    """All rows, the first of which announces how many vertices and faces there are."""
    text = decode(path.read_bytes())
    if not text.startswith(_MARK):
        raise MeshError(
            f"{path.name}: it holds points without faces, or no FreeSurfer surface, whose text begins with '{_MARK}'. "
            "Read it with `read_points`, or write it again with mris_convert."
        )
    rows = parse_rows(path, re.sub(r"#[^\n]*", "", text))
    if len(rows.counts) == 0 or rows.counts[0] != 2:
        raise MeshError(f"{path.name}: after '{_MARK}' the numbers of vertices and faces must follow.")
    n_vertices, n_faces = as_indices(path, rows.values[:2]).tolist()
    return rows, n_vertices, n_faces


def _vertices(path: Path, rows: Rows, n_vertices: int) -> Contents:
    vertices = rows.part(1, 1 + max(n_vertices, 0))
    _check(path, vertices, n_vertices, "vertices")
    return Contents(vertices.table(3))


def _check(path: Path, rows: Rows, n: int, what: str) -> None:
    """Raise where rows are missing or too short."""
    if n < 0 or len(rows.counts) < n:
        raise MeshError(
            f"{path.name}: {n} {what} are announced, but {len(rows.counts)} rows follow. The file is cut off, or its "
            "counts are wrong."
        )
    if (rows.counts < 3).any():
        line = rows.lines[rows.counts < 3][0]
        raise MeshError(f"{path.name}, line {line}: three numbers are needed, with or without a flag after them.")
