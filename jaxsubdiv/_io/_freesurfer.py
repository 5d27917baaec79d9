"""Surfaces of FreeSurfer as text; other `.asc` files are tables of points."""

import re
from pathlib import Path

from ..errors import MeshError
from ..tables import decode
from . import _table
from ._contents import Contents, whole
from ._text import Rows, parse_rows

_MARK = "#!ascii"


def read(path: Path) -> Contents:
    """Vertices and triangles; the flag after each is left out."""
    rows, n_vertices, n_faces = _rows(path)
    faces = rows.part(1 + n_vertices, 1 + n_vertices + n_faces)
    _check(path, faces, n_faces, "faces")
    vertices = _vertices(path, rows, n_vertices)
    return Contents(vertices.vertices, {3: whole(path, faces.table(3))} if n_faces else None)


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
    n_vertices, n_faces = whole(path, rows.values[:2]).tolist()
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
