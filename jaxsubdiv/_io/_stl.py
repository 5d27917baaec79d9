"""STL files, text and binary.

Not by trimesh: of a damaged text file it returns the part before the damage without a word.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..errors import MeshError, name_rows
from ..tables import decode
from ._contents import Contents, VertexData, as_double, split_quads, warn
from ._frame import space_words
from ._text import parse_rows

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_HEADER = 84  # 80 bytes of anything, then the number of facets


def read(path: Path) -> Contents:
    """Triangles whose corners are merged where they are equal; the normals of the facets are left out.

    Vertices are in the order in which the file first names them.
    """
    data = path.read_bytes()
    n_facets = int.from_bytes(data[80:_HEADER], "little")
    trailing = len(data) - _HEADER - n_facets * _FACET.itemsize
    # Binary files may begin with "solid" too, so only their length tells: four letters of text announce more facets
    # than any such file has.
    if trailing == 0 or (trailing > 0 and n_facets > 0):
        corners = as_double(np.frombuffer(data, _FACET, n_facets, _HEADER)["corners"]).reshape(-1, 3)
        if trailing:
            warn(path, f"{trailing} bytes after the last of {n_facets} triangles were left out.")
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:_HEADER]:
        corners = _text_corners(path, decode(data))
    else:
        raise MeshError(
            f"{path.name}: as binary STL it should hold {n_facets} triangles in {_HEADER + 50 * n_facets} bytes, but "
            f"it has {len(data)}; as text it should begin with 'solid'. The file is cut off or of another format."
        )
    vertices, indices = _merge(corners)
    return Contents(vertices, {3: indices.reshape(-1, 3)} if len(indices) else None)


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Triangles, without rounding: binary where single precision holds every coordinate, otherwise text."""
    corners = contents.vertices[split_quads(path, "STL", contents)]
    with np.errstate(over="ignore", invalid="ignore"):
        single = corners.astype(np.float32)
    title = f"jaxsubdiv {space_words(contents.frame)}".strip()
    path.write_bytes(_binary(single, title) if (single == corners).all() else _text(corners, title).encode())


def _text_corners(path: Path, text: str) -> Float[np.ndarray, "c 3"]:
    lines = [line.strip() for line in text.lower().rstrip().split("\n")]
    ends = [i for i, line in enumerate(lines) if line.startswith("endsolid")]
    rest = lines[ends[-1] + 1 :] if ends else []
    if rest and not any(line.startswith(("facet", "vertex")) for line in rest):
        warn(path, f"{len(rest)} lines after the last 'endsolid' were left out.")
        lines = lines[: ends[-1] + 1]
    at = np.array([i for i, line in enumerate(lines) if line.startswith("vertex")], dtype=int)
    rows = parse_rows(path, "\n".join(lines[i][len("vertex") :] for i in at), at + 1)
    if len(rows.counts) < len(at) or (rows.counts != 3).any():
        wrong = np.setdiff1d(at + 1, rows.lines[rows.counts == 3])
        raise MeshError(f"{path.name}, line {name_rows(wrong)}: 'vertex' must be followed by three numbers.")
    n_facets = sum(line.startswith("facet") for line in lines)
    if len(at) != 3 * n_facets or not lines[-1].startswith("endsolid"):
        raise MeshError(
            f"{path.name}: {n_facets} facets with {len(at)} corners up to line {len(lines)}, where three each and a "
            "closing 'endsolid' are expected. The file is cut off."
        )
    return rows.table(3)


def _merge(corners: Float[np.ndarray, "c 3"]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "c"]]:
    """Equal corners as one vertex, in order of first appearance, and the vertex of every corner."""
    order = np.lexsort(corners.T)  # stable: the first of equal corners comes first
    ordered = corners[order]
    is_new = np.ones(len(corners), bool)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    group = np.empty(len(corners), int)
    group[order] = np.cumsum(is_new) - 1
    first = order[is_new]
    by_appearance = np.argsort(first)
    place = np.empty_like(by_appearance)
    place[by_appearance] = np.arange(len(first))
    return corners[first[by_appearance]], place[group]


def _binary(corners: Float[np.ndarray, "t 3 3"], title: str) -> bytes:
    facets = np.zeros(len(corners), _FACET)
    facets["corners"], facets["normal"] = corners, _facet_normals(corners)
    return title.encode().ljust(80) + len(facets).to_bytes(4, "little") + facets.tobytes()


def _text(corners: Float[np.ndarray, "t 3 3"], title: str) -> str:
    facet = "facet normal {!r} {!r} {!r}\nouter loop\n" + 3 * "vertex {!r} {!r} {!r}\n" + "endloop\nendfacet\n"
    rows = np.concatenate([_facet_normals(corners), corners.reshape(-1, 9)], axis=1)
    return f"solid {title}\n" + "".join(facet.format(*row) for row in rows.tolist()) + f"endsolid {title}\n"


def _facet_normals(corners: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3"]:
    corners = corners.astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return across / np.where(length > 0, length, 1)
