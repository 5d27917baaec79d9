"""Surfaces of the MNI tools and CIVET, whose suffix is `.obj` too."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import MeshError
from ..tables import decode
from ._contents import Contents, as_indices, check_polygons, sort_by_size
from ._text import parse_rows

_BEGIN = re.compile(rb"\s*P\s+[-+.0-9]")


def is_mni(data: bytes) -> bool:
    """Whether the file is one of these: as text it begins with `P` and numbers, as binary with `p` and any byte."""
    return bool(_BEGIN.match(data[:200])) or (data[:1] == b"p" and b"\0" in data[:25])


def read(path: Path, data: bytes) -> Contents:
    """Vertices, their normals, and polygons of three or four corners; colours are left out."""
    values, n = _values(path, data)
    contents = _vertices(path, values, n)
    at = 6 + 6 * n
    n_faces, kind = as_indices(
        path, _part(path, values, at, 2, "the number of polygons and how they are coloured")
    ).tolist()
    if n_faces < 0 or kind not in (0, 1, 2):
        raise MeshError(f"{path.name}: {n_faces} polygons, coloured in the way {kind}, which must be 0, 1 or 2.")
    at += 2 + 4 * (1, n_faces, n)[kind]
    ends = as_indices(path, _part(path, values, at, n_faces, "ends of the polygons"))
    sizes = np.diff(ends, prepend=0)
    check_polygons(path, sizes)
    corners = as_indices(
        path, _part(path, values, at + n_faces, int(ends[-1]) if n_faces else 0, "corners of the polygons")
    )
    return contents._replace(faces=sort_by_size(corners, ends - sizes, sizes) if n_faces else None)


def read_points(path: Path, data: bytes) -> Contents:
    """Vertices, and their normals where the file goes on that far."""
    return _vertices(path, *_values(path, data))


def _values(path: Path, data: bytes) -> tuple[Float[np.ndarray, "n"], int]:
    """All numbers of the file, and how many vertices they announce."""
    if data[:1] == b"p":
        raise MeshError(f"{path.name}: a binary surface of the MNI tools. Turn it into text with `ascii_binary`.")
    values = parse_rows(path, decode(data).replace("P", " ", 1)).values
    n = _part(path, values, 5, 1, "the number of vertices")[0]
    if not 0 <= n <= len(values) or n != int(n):
        raise MeshError(
            f"{path.name}: a surface of the MNI tools that announces {n:g} vertices, but has {len(values)} numbers. "
            "The file is cut off, or its first line is wrong."
        )
    return values, int(n)


def _vertices(path: Path, values: Float[np.ndarray, "n"], n: int) -> Contents:
    points = _part(path, values, 6, 3 * n, "vertices").reshape(-1, 3)
    normals = values[6 + 3 * n : 6 + 6 * n]
    return Contents(points, None, normals.reshape(-1, 3) if len(normals) == 3 * n else None)


def _part(path: Path, values: Float[np.ndarray, "n"], at: int, n: int, what: str) -> Float[np.ndarray, "m"]:
    if at + n > len(values):
        raise MeshError(
            f"{path.name}: a surface of the MNI tools that ends before {what}: number {at + n} is needed, and there "
            f"are {len(values)}. It is cut off; for a Wavefront file, begin lines with v and f."
        )
    return values[at : at + n]
