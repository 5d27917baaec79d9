"""Wavefront OBJ files.

Not by meshio: it loses which normal belongs to which vertex, and fails on negative indices and continued lines.
"""

import re
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int

from .._regions import Regions, as_regions
from ..errors import MeshError, name_rows
from ..tables import decode
from . import _mni
from ._contents import Contents, VertexData, sort_by_size, warn
from ._frame import space_words
from ._text import Rows, face_lines, number_lines, parse_rows, token_starts, tokens_per_line

_INDEX = r"[+-]?[0-9]{1,9}"  # a mesh of more vertices would not fit 32 bits
_CORNER = re.compile(f"{_INDEX}(/{_INDEX}|/({_INDEX})?/{_INDEX})?")


class _Lines(NamedTuple):
    """Statements without comments, each with the line of the file on which it begins."""

    text: list[str]
    numbers: Int[np.ndarray, "l"]

    def of(self, key: str) -> Int[np.ndarray, "s"]:
        """Places of the statements that begin with `key`."""
        return np.array([i for i, s in enumerate(self.text) if s.startswith(key + " ") or s == key], dtype=int)


class _Corners(NamedTuple):
    """Corners of all faces in a run, with the indices as the file has them: from one, or from the end if negative."""

    vertex: Int[np.ndarray, "c"]
    normal: Int[np.ndarray, "c"]
    """Zero where the corner names none."""
    sizes: Int[np.ndarray, "f"]
    """Corners of each face."""


def read(path: Path) -> Contents:
    """`v`, `vn`, `f` and `g`; every other statement is left out, and so are the numbers after `v x y z`."""
    data = path.read_bytes()
    if _mni.is_mni(data):
        return _mni.read(path, data)
    lines = _logical_lines(decode(data))
    vertices, normals, f = _vertices(path, lines)
    if len(f) == 0:
        return Contents(vertices, None, normals if len(normals) == len(vertices) > 0 else None)
    corners = _corners(path, lines, f)
    odd = (corners.sizes < 3) | (corners.sizes > 4)
    if odd.any():
        raise MeshError(
            f"{path.name}, line {name_rows(lines.numbers[f[odd]])}: a face of {corners.sizes[odd][0]} corners. Split "
            "larger faces into triangles and quads, and drop smaller ones."
        )
    vertex, per_vertex = _indices(path, lines, f, corners, normals, len(vertices))
    faces = sort_by_size(vertex, np.cumsum(corners.sizes) - corners.sizes, corners.sizes)
    return Contents(vertices, faces, per_vertex, regions=_groups(lines, f, corners.sizes))


def read_points(path: Path) -> Contents:
    """`v` and `vn`; faces, of any size, are read only for which normal belongs to which vertex."""
    data = path.read_bytes()
    if _mni.is_mni(data):
        return _mni.read_points(path, data)
    lines = _logical_lines(decode(data))
    vertices, normals, f = _vertices(path, lines)
    if len(normals) == len(vertices) or len(normals) == 0 or len(f) == 0:
        return Contents(vertices, None, normals if len(normals) == len(vertices) > 0 else None)
    try:
        _, per_vertex = _indices(path, lines, f, _corners(path, lines, f), normals, len(vertices))
    except MeshError as error:
        warn(path, f"the normals were left out, since the faces do not say whose they are: {error}")
        per_vertex = None
    return Contents(vertices, None, per_vertex)


def _vertices(
    path: Path, lines: _Lines
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "n 3"], Int[np.ndarray, "f"]]:
    """Vertices, normals, and where the faces stand."""
    return _triples(path, lines, lines.of("v"), "v"), _triples(path, lines, lines.of("vn"), "vn"), lines.of("f")


def _indices(
    path: Path,
    lines: _Lines,
    f: Int[np.ndarray, "f"],
    corners: _Corners,
    normals: Float[np.ndarray, "n 3"],
    n_vertices: int,
) -> tuple[Int[np.ndarray, "c"], Float[np.ndarray, "v 3"] | None]:
    """The vertex of every corner, and the normal of every vertex."""
    of_face = np.repeat(f, corners.sizes)  # the statement of every corner
    named = corners.normal != 0
    vertex = _resolve_indices(path, corners.vertex, lines.of("v"), lines, of_face, "v")
    normal = _resolve_indices(path, corners.normal[named], lines.of("vn"), lines, of_face[named], "vn")
    return vertex, _gather_per_vertex(path, vertex, named, normal, normals, n_vertices)


def _groups(lines: _Lines, f: Int[np.ndarray, "f"], sizes: Int[np.ndarray, "f"]) -> Regions | None:
    """The group that each face is in, triangles first; None where no group has a name."""
    at = lines.of("g")
    words = np.array(["", *(" ".join(lines.text[i].split()[1:]) for i in at)])
    if not any(words):
        return None
    of_faces = words[np.searchsorted(at, f)]
    found = as_regions([str(word) for size in (3, 4) for word in of_faces[sizes == size]])
    return found if found is not None and found.names else None


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """`v`, `vn` where there are normals, `f` with equal indices for both, and `g` where there are regions."""
    one_based = [faces + 1 for faces in (contents.faces or {}).values()]
    text = f"# {space_words(contents.frame)}\n" if contents.frame else ""
    text += number_lines(contents.vertices, "v ")
    if contents.normals is None:
        faces = face_lines(one_based, "f ")
    else:
        text += number_lines(contents.normals, "vn ")
        faces = "".join(f"f {' '.join(f'{i}//{i}' for i in face)}\n" for block in one_based for face in block.tolist())
    if contents.regions is not None:
        faces = _write_groups(path, faces, contents.regions)
    path.write_bytes((text + faces).encode())


def _write_groups(path: Path, faces: str, regions: Regions) -> str:
    """The lines of the faces, with the name of their group before the first of each run."""
    for name in regions.names:
        if name != " ".join(name.split()) or "#" in name or name.endswith("\\"):
            raise MeshError(
                f"{path.name}: OBJ holds no group of the name {name!r}. Rename the region, or leave it out."
            )
    rows, lines = regions.rows.tolist(), faces.splitlines(keepends=True)
    before = [-1, *rows[:-1]]
    headings = [
        "" if row == last else f"g {regions.names[row]}\n" if row >= 0 else "g\n"
        for row, last in zip(rows, before, strict=True)
    ]
    return "".join(heading + line for heading, line in zip(headings, lines, strict=True))


def _logical_lines(text: str) -> _Lines:
    """Lines without comments and outer white space; a line that ends in a backslash takes in the next."""
    lines = text.replace("\t", " ").split("\n")
    if "#" in text:
        lines = [line.partition("#")[0] for line in lines]
    lines = [line.strip() for line in lines]
    numbers = np.arange(1, len(lines) + 1)
    if "\\" not in text:
        return _Lines(lines, numbers)
    joined: list[list[str]] = []
    begins: list[int] = []
    continues = False
    for number, line in zip(numbers.tolist(), lines, strict=True):
        part = line.removesuffix("\\")
        if continues:
            joined[-1].append(part)
        else:
            joined.append([part])
            begins.append(number)
        continues = line.endswith("\\")
    return _Lines([" ".join(parts) for parts in joined], np.array(begins))


def _triples(path: Path, lines: _Lines, at: Int[np.ndarray, "s"], key: str) -> Float[np.ndarray, "s 3"]:
    """The first three numbers of every statement that begins with `key`."""
    rows = _rows(path, lines, at, key)
    if len(rows.counts) < len(at) or (rows.counts < 3).any():
        short = next(i for i in at if len(lines.text[i].split()) < 4)
        raise MeshError(f"{path.name}, line {lines.numbers[short]}: '{key}' must be followed by three numbers.")
    return rows.table(3)


def _rows(path: Path, lines: _Lines, at: Int[np.ndarray, "s"], key: str) -> Rows:
    return parse_rows(path, "\n".join(lines.text[i][len(key) :] for i in at), lines.numbers[at])


def _corners(path: Path, lines: _Lines, at: Int[np.ndarray, "f"]) -> _Corners:
    """Corners of the forms a, a/b, a//c and a/b/c, in any mixture."""
    text = "\n".join(lines.text[i][1:] for i in at).replace("//", "/0/")  # now the normal, if any, is always third
    raw = np.frombuffer(text.encode(), np.uint8)
    starts = token_starts(raw)
    sizes = tokens_per_line(raw, starts)
    if not sizes.any():
        none = np.zeros(0, int)
        return _Corners(none, none, sizes)
    slashes = np.flatnonzero(raw == ord("/"))
    parts = 1 + np.diff(np.searchsorted(slashes, np.append(starts[1:], len(raw))), prepend=0)
    try:
        values = parse_rows(path, text.replace("/", " "), lines.numbers[at]).values
    except MeshError:
        values = np.zeros(0)
    # An index left out, as in `1/` or `/1`, makes fewer numbers than parts, never more.
    are_indices = (np.abs(values) < 1e9) & (np.rint(values) == values)
    if len(values) != parts.sum() or (parts > 3).any() or not are_indices.all():
        _raise_bad_corner(path, lines, at)
    first = np.cumsum(parts) - parts
    normal = np.where(parts == 3, values[np.minimum(first + 2, len(values) - 1)], 0)
    return _Corners(values[first].astype(int), normal.astype(int), sizes)


def _raise_bad_corner(path: Path, lines: _Lines, at: Int[np.ndarray, "f"]) -> NoReturn:
    corners = ((i, corner.decode()) for i in at for corner in lines.text[i].encode().split()[1:])
    i, bad = next((i, corner) for i, corner in corners if not _CORNER.fullmatch(corner))
    raise MeshError(
        f"{path.name}, line {lines.numbers[i]}: {bad[:40]!r} is no corner of a face. Corners are written a, a/b, a//c "
        "or a/b/c, with whole numbers: vertex, texture coordinate, normal."
    )


def _resolve_indices(
    path: Path,
    indices: Int[np.ndarray, "c"],
    at: Int[np.ndarray, "s"],
    lines: _Lines,
    of_face: Int[np.ndarray, "c"],
    key: str,
) -> Int[np.ndarray, "c"]:
    """Places in the list of `key` statements, which stand at `at`; a negative index counts back from its face."""
    places = np.where(indices < 0, indices + np.searchsorted(at, of_face), indices - 1)
    wrong = (places < 0) | (places >= len(at))
    if wrong.any():
        raise MeshError(
            f"{path.name}, line {name_rows(np.unique(lines.numbers[of_face[wrong]]))}: a face uses the index "
            f"{indices[wrong][0]} among {len(at)} '{key}' lines. Indices count from one, or from -1 backwards; correct "
            "them or add the missing lines."
        )
    return places


def _gather_per_vertex(
    path: Path,
    vertex: Int[np.ndarray, "c"],
    named: Bool[np.ndarray, "c"],
    normal: Int[np.ndarray, "n"],
    normals: Float[np.ndarray, "s 3"],
    n_vertices: int,
) -> Float[np.ndarray, "v 3"] | None:
    """One normal a vertex out of one a corner; `normal` belongs to the corners that are `named`.

    Normals that number the vertices are taken as they stand, also where no face names them.
    """
    if len(normals) == n_vertices and (vertex[named] == normal).all():
        return normals
    if len(normal) == 0:
        if len(normals):
            warn(path, f"no face names any of the {len(normals)} normals; they were left out.")
        return None
    owner, value = vertex[named], normals[normal]
    result = np.zeros((n_vertices, 3))
    result[owner[::-1]] = value[::-1]  # the last assignment stays, so backwards for the first
    several = np.unique(owner[(result[owner] != value).any(axis=1)])
    if len(several):
        warn(
            path,
            f"{len(several)} vertices have several different normals ({name_rows(several)}, counted from zero); each "
            "got their unit mean.",
        )
        distinct = np.unique(np.column_stack([owner, value])[np.isin(owner, several)], axis=0)
        sums = np.zeros_like(result)
        np.add.at(sums, distinct[:, 0].astype(int), _unit(distinct[:, 1:]))
        result[several] = _unit(sums[several])
    without = np.setdiff1d(vertex, owner)
    if len(without):
        warn(
            path,
            f"{len(without)} vertices have no normal while others have ({name_rows(without)}, counted from zero); they "
            "got zero.",
        )
    return result


def _unit(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Rows of length one; a zero row stays."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite then is named later by its row
        length = np.linalg.norm(rows, axis=1, keepdims=True)
        return rows / np.where(length > 0, length, 1)
