"""OFF and NOFF files.

Not by meshio: it reads triangles only, and no file whose counts stand beside the word OFF.
"""

import re
from pathlib import Path

import numpy as np

from ..errors import MeshError
from ..tables import decode
from ._contents import Contents, VertexData, as_indices, check_polygons, sort_by_size
from ._text import Rows, face_lines, number_lines, parse_rows

_HEADER = re.compile(r"((ST)?(C)?(N)?(4)?(n)?OFF|off)\b")  # N: normals; n: vertices of n dimensions


def read(path: Path) -> Contents:
    """Vertices, their normals where the header says NOFF, and faces. Colours and texture coordinates are left out."""
    rows, n_vertices, n_faces, has_normals = _rows(path)
    if len(rows.counts) < 1 + n_vertices + n_faces or n_faces < 0:
        raise _cut_off_error(path, rows, n_vertices, n_faces)
    vertices = _vertices(path, rows, n_vertices, has_normals)
    faces = rows.part(1 + n_vertices, 1 + n_vertices + n_faces)
    sizes = as_indices(path, faces.values[faces.starts])
    short = np.flatnonzero(faces.counts - 1 < sizes)
    if len(short):
        raise MeshError(
            f"{path.name}, line {faces.lines[short[0]]}: a face of {sizes[short[0]]} corners needs as many vertex "
            "indices after that number."
        )
    check_polygons(path, sizes)
    corners = sort_by_size(faces.values, faces.starts + 1, sizes)
    return vertices._replace(
        faces={size: as_indices(path, block) for size, block in corners.items()} if n_faces else None
    )


def read_points(path: Path) -> Contents:
    """Vertices, and their normals where the header says NOFF."""
    rows, n_vertices, n_faces, has_normals = _rows(path)
    if len(rows.counts) < 1 + n_vertices:
        raise _cut_off_error(path, rows, n_vertices, n_faces)
    return _vertices(path, rows, n_vertices, has_normals)


def _rows(path: Path) -> tuple[Rows, int, int, bool]:
    """All rows, the first of which announces how many vertices and faces there are; and whether there are normals."""
    text = re.sub(r"#[^\n]*", "", decode(path.read_bytes()))
    header = _HEADER.match(text.lstrip())
    if header is None:
        raise MeshError(f"{path.name}, line 1: an OFF file begins with OFF or NOFF; this one does not.")
    if header[5] or header[6]:
        raise MeshError(
            f"{path.name}, line 1: {header[0]} has vertices of more than three dimensions. Write it as OFF."
        )
    # Blanked and not cut, so that the lines keep their numbers.
    rows = parse_rows(path, text.replace(header[0], "", 1))
    if len(rows.counts) == 0 or rows.counts[0] < 2:
        raise MeshError(f"{path.name}: after OFF the numbers of vertices, faces and edges must follow.")
    n_vertices, n_faces = as_indices(path, rows.values[:2]).tolist()
    if n_vertices < 0:
        raise _cut_off_error(path, rows, n_vertices, n_faces)
    return rows, n_vertices, n_faces, bool(header[4])


def _cut_off_error(path: Path, rows: Rows, n_vertices: int, n_faces: int) -> MeshError:
    return MeshError(
        f"{path.name}, line {rows.lines[0]}: {n_vertices} vertices and {n_faces} faces are announced, but "
        f"{len(rows.counts) - 1} rows follow. The file is cut off, or its header is wrong."
    )


def _vertices(path: Path, rows: Rows, n: int, has_normals: bool) -> Contents:
    vertices, n_columns = rows.part(1, 1 + n), 6 if has_normals else 3
    short = np.flatnonzero(vertices.counts < n_columns)
    if len(short):
        raise MeshError(f"{path.name}, line {vertices.lines[short[0]]}: a vertex needs {n_columns} numbers.")
    table = vertices.table(n_columns)
    return Contents(table[:, :3], None, table[:, 3:] if has_normals else None)


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """OFF, or NOFF where there are normals."""
    vertices, faces, normals = contents.vertices, contents.faces or {}, contents.normals
    rows = vertices if normals is None else np.concatenate([vertices, normals], axis=1)
    n_faces = sum(map(len, faces.values()))
    text = f"{'OFF' if normals is None else 'NOFF'}\n{len(vertices)} {n_faces} 0\n"
    path.write_bytes((text + number_lines(rows) + face_lines(faces.values(), "{} ")).encode())
