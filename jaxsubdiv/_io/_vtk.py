"""Legacy VTK files of surfaces; and how VTK writes these and VTP files.

Not read by VTK: counts that a file only announces end the interpreter there.
"""

import re
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Int, Shaped

from ..errors import MeshError, name_rows
from ..extras import import_extra
from ._cells import append_triangles, polygons, strips, surface_cells
from ._contents import Contents, VertexData, as_double
from ._frame import space_words
from ._text import parse_numbers, token_starts

_NORMALS = "Normals"
_TYPES = {
    **{"unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4"},
    **{"unsigned_long": "u8", "long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4"},
    **{f"vtktype{sign}int{8 * n}": f"{'u' if sign else 'i'}{n}" for sign in ("", "u") for n in (1, 2, 4, 8)},
}
_CELLS = ("vertices", "lines", "polygons", "triangle_strips", "cells")
_VECTORS = {
    "normals": 3,
    "vectors": 3,
    "tensors": 9,
    "tensors6": 6,
    "global_ids": 1,
    "pedigree_ids": 1,
    "edge_flags": 1,
}
_MOST_WORDS = 1000  # bytes of one line of words


class _Cursor:
    """Where reading stands in the file, and the ways to go on."""

    def __init__(self, path: Path, data: bytes):
        self.path, self.data, self.at, self.is_text = path, data, 0, True

    def line(self) -> str:
        """The rest of the line."""
        end = self.data.find(b"\n", self.at)
        end = len(self.data) if end < 0 else end
        text, self.at = self.data[self.at : min(end, self.at + _MOST_WORDS)], end + 1
        return text.decode("utf-8", errors="replace").strip()

    def words(self) -> list[str]:
        """The next line that is not blank, as words in small letters; none at the end of the file."""
        while self.at < len(self.data):
            if words := self.line().lower().split():
                return words
        return []

    def next_begins(self, word: str) -> bool:
        """Whether the next line that is not blank begins so."""
        here = self.at
        words, self.at = self.words(), here
        return words[:1] == [word]

    def numbers(self, n: int, kind: str) -> Shaped[np.ndarray, "n"]:
        """The next `n` numbers of a type; the error where there are not so many says where they should begin."""
        dtype = np.dtype(f">{_TYPES.get(kind) or self.refuse(f'the type {kind[:40]!r} is not read')}")
        if not 0 <= n <= len(self.data) - self.at:
            self.refuse(f"{n} numbers are announced, but {max(len(self.data) - self.at, 0)} bytes follow")
        if self.is_text:
            return self._text_numbers(n)
        values = np.frombuffer(self.data, dtype, min(n, (len(self.data) - self.at) // dtype.itemsize), self.at)
        if len(values) < n:
            self.refuse(f"{n} numbers are announced, but the file ends after {len(values)}")
        self.at += values.nbytes
        return values.astype(dtype.newbyteorder("="))

    def _text_numbers(self, n: int) -> Shaped[np.ndarray, "n"]:
        size, left = 16 * n + 100, len(self.data) - self.at
        starts = token_starts(np.frombuffer(self.data, np.uint8, min(size, left), self.at))
        while len(starts) <= n and size < left:
            size *= 2
            starts = token_starts(np.frombuffer(self.data, np.uint8, min(size, left), self.at))
        if len(starts) < n:
            self.refuse(f"{n} numbers are announced, but the file ends after {len(starts)}")
        end = self.at + int(starts[n]) if len(starts) > n else len(self.data)
        text = self.data[self.at : end].decode("ascii", errors="replace")
        values = parse_numbers(text)
        if len(values) < n:
            wrong = next((word for word in text.split() if len(parse_numbers(word)) != 1), text)
            self.refuse(f"'{wrong[:40]}' is not a number")
        self.at = end
        return values

    def skip_string(self) -> None:
        """Leave out a line, or in a binary file what its first two bits give the length of."""
        if self.is_text:
            self.line()
            return
        n_bytes = 8 >> (self.data[self.at] >> 6) if self.at < len(self.data) else 1
        length = int.from_bytes(self.data[self.at : self.at + n_bytes], "big") & ((1 << (8 * n_bytes - 2)) - 1)
        self.at += n_bytes + length

    def count(self, words: list[str], place: int) -> int:
        """The whole number at a place of a line of words."""
        if len(words) <= place or not re.fullmatch("[0-9]{1,18}", words[place]):
            self.refuse(f"'{' '.join(words)[:60]}' must have a whole number as word {place + 1}")
        return int(words[place])

    def refuse(self, what: str) -> NoReturn:
        """Raise with the line, or the byte of a binary file."""
        where = f"line {self.data.count(10, 0, self.at) + 1}" if self.is_text else f"byte {self.at}"
        raise MeshError(f"{self.path.name}, {where}: {what}. The file is cut off or damaged: save it again.")


def read(path: Path) -> Contents:
    """Points, faces, and the point normals: the array marked as such, or the one called Normals."""
    contents, cells, types = _read(path)
    if "cells" in cells:
        n = len(cells["cells"][0])
        if len(types) != n:
            raise MeshError(f"{path.name}: it has {n} CELLS, but {len(types)} CELL_TYPES. It is cut off or damaged.")
        return contents._replace(faces=surface_cells(path, types, *cells["cells"]))
    none = np.zeros(0, int), np.zeros(0, int)
    more = strips(path, *cells.get("triangle_strips", none))
    return contents._replace(faces=append_triangles(polygons(path, *cells.get("polygons", none)), more))


def read_points(path: Path) -> Contents:
    """Points and their normals, whatever cells they have."""
    return _read(path)[0]


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Double precision, binary; `path` ends in .vtp or .vtk."""
    pyvista = import_extra("pyvista", "io", ".vtp and .vtk files")
    rows = [np.insert(corners, 0, size, axis=1).ravel() for size, corners in (contents.faces or {}).items()]
    polydata = pyvista.PolyData(contents.vertices, np.concatenate(rows))
    if contents.normals is not None:
        polydata.point_data[_NORMALS] = contents.normals
        polydata.point_data.active_normals_name = _NORMALS
    for name, column in data.items():
        if name == _NORMALS:
            raise MeshError(f"`vertex_data` has the name '{_NORMALS}', which the normals of the mesh take.")
        polydata.point_data[name] = column
    if path.suffix.lower() == ".vtp":
        writer = import_extra("vtkmodules.vtkIOXML", "io", ".vtp files").vtkXMLPolyDataWriter()
    else:
        writer = import_extra("vtkmodules.vtkIOLegacy", "io", ".vtk files").vtkPolyDataWriter()
        writer.SetFileTypeToBinary()
        writer.SetHeader(f"jaxsubdiv {space_words(contents.frame)}".strip())
    writer.SetInputData(polydata)
    writer.SetFileName(str(path))
    done, messages = watch(writer.Write)
    if not done or messages:
        raise OSError(f"{path.name}: VTK could not write the file: {messages or 'it gives no reason'}")


def _read(
    path: Path,
) -> tuple[Contents, dict[str, tuple[Int[np.ndarray, "f"], Int[np.ndarray, "c"]]], Int[np.ndarray, "n"]]:
    """Points with their normals; by the kind of the cells where the corners of each end, and the corners; and the type
    of each cell of an unstructured grid."""
    cursor = _Cursor(path, path.read_bytes())
    if not cursor.line().lower().startswith("# vtk datafile version"):
        raise MeshError(
            f"{path.name}, line 1: a legacy VTK file begins with '# vtk DataFile Version'; this one does not."
        )
    cursor.line()  # the title, which may be blank
    kind = cursor.words()
    if kind not in (["ascii"], ["binary"]):
        cursor.refuse("the third line must be ASCII or BINARY")
    cursor.is_text = kind == ["ascii"]
    points, normals, cells, of_points = None, {}, {}, False
    n_tuples, types = 0, np.zeros(0, int)
    while words := cursor.words():
        match words[0]:
            case "dataset":
                if words[1:] not in (["polydata"], ["unstructured_grid"]):
                    raise MeshError(
                        f"{path.name}: it holds a {' '.join(words[1:])[:40].upper()}, not faces. Take its surface "
                        "first: pyvista.read(...).extract_surface().save(...)."
                    )
            case "points":
                points = cursor.numbers(3 * cursor.count(words, 1), words[-1]).reshape(-1, 3)
            case name if name in _CELLS:
                cells[name] = _read_cells(cursor, words)
            case "cell_types":
                types = _check_whole(cursor, cursor.numbers(cursor.count(words, 1), "int"))
            case "cell_data" | "point_data":
                n_tuples, of_points = cursor.count(words, 1), words[0] == "point_data"
            case "metadata":
                while cursor.at < len(cursor.data) and cursor.line():
                    pass
            case _:
                found = _read_attribute(cursor, words, n_tuples)
                if found is None:
                    break  # how long the rest is nobody knows; only attributes come this late
                normals |= found if of_points else {}
    if points is None:
        raise MeshError(f"{path.name}: it has no POINTS. It is cut off, or no file of a surface.")
    fitting = [rows for _, rows in sorted(normals.items()) if rows.shape == points.shape]
    return Contents(as_double(points), None, as_double(fitting[0]) if fitting else None), cells, types


def _read_cells(cursor: _Cursor, words: list[str]) -> tuple[Int[np.ndarray, "f"], Int[np.ndarray, "c"]]:
    n, size = cursor.count(words, 1), cursor.count(words, 2)
    if cursor.next_begins("offsets"):  # since version 5.1: one offset more than there are cells
        offsets = _check_whole(cursor, cursor.numbers(n, cursor.words()[-1]))
        if not cursor.next_begins("connectivity"):
            cursor.refuse("CONNECTIVITY must follow OFFSETS")
        corners = _check_whole(cursor, cursor.numbers(size, cursor.words()[-1]))
        return offsets[1:], corners
    values, ends, at = _check_whole(cursor, cursor.numbers(size, "int")), np.zeros(min(n, size), int), 0
    is_corner = np.ones(size, bool)
    for i in range(n):
        if at >= size or values[at] < 0:
            cursor.refuse(f"{n} cells are announced, but the {size} numbers hold {i}")
        is_corner[at] = False
        at += 1 + int(values[at])
        ends[i] = at - i - 1
    return ends, values[is_corner]


def _read_attribute(cursor: _Cursor, words: list[str], n: int) -> dict[int, np.ndarray] | None:
    """Rows that may be the normals of points, the surest with the smallest key; None where it is not known."""
    match words:
        case ["normals", *_]:
            return {0: cursor.numbers(3 * n, words[-1]).reshape(-1, 3)}
        case [kind, name, type_] if kind in _VECTORS:
            return _find_normals(name, cursor.numbers(_VECTORS[kind] * n, type_), _VECTORS[kind])
        case ["scalars", name, type_, *width]:
            n_columns = cursor.count(width, 0) if width else 1
            if cursor.next_begins("lookup_table"):
                cursor.words()
            return _find_normals(name, cursor.numbers(n_columns * n, type_), n_columns)
        case ["color_scalars", _, width]:
            cursor.numbers(cursor.count([width], 0) * n, "unsigned_char")
        case ["lookup_table", _, size]:
            cursor.numbers(4 * cursor.count([size], 0), "unsigned_char")
        case ["texture_coordinates", _, width, type_]:
            cursor.numbers(cursor.count([width], 0) * n, type_)
        case ["field", _, n_arrays]:
            return _read_field(cursor, cursor.count([n_arrays], 0))
        case _:
            return None
    return {}


def _read_field(cursor: _Cursor, n_arrays: int) -> dict[int, np.ndarray] | None:
    found = {}
    for _ in range(n_arrays):
        while (words := cursor.words()) and words[0] == "metadata":
            while cursor.at < len(cursor.data) and cursor.line():
                pass
        if not words:
            return found
        n_columns, n = cursor.count(words, 1), cursor.count(words, 2)
        if words[-1] == "string":
            for _ in range(min(n_columns * n, len(cursor.data))):
                cursor.skip_string()
        elif words[-1] not in _TYPES:
            return None
        else:
            found |= _find_normals(words[0], cursor.numbers(n_columns * n, words[-1]), n_columns)
    return found


def _find_normals(name: str, values: np.ndarray, n_columns: int) -> dict[int, np.ndarray]:
    return {1: values.reshape(-1, 3)} if name == _NORMALS.lower() and n_columns == 3 else {}


def _check_whole(cursor: _Cursor, values: Shaped[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    with np.errstate(invalid="ignore"):
        indices = values.astype(np.int64)
    if (wrong := np.flatnonzero(indices != values)).size:
        cursor.refuse(f"cells hold what is no whole number at their places {name_rows(wrong)}")
    return indices


def watch(act: Any) -> tuple[Any, str]:
    """What `act` returns and what VTK says meanwhile, which would otherwise go to the terminal."""
    core = import_extra("vtkmodules.vtkCommonCore", "io", ".vtp and .vtk files")
    window, window_before = core.vtkStringOutputWindow(), core.vtkOutputWindow.GetInstance()
    logged_before = core.vtkLogger.GetCurrentVerbosityCutoff()
    core.vtkOutputWindow.SetInstance(window)
    core.vtkLogger.SetStderrVerbosity(core.vtkLogger.VERBOSITY_OFF)
    try:
        result = act()
    finally:
        core.vtkOutputWindow.SetInstance(window_before)
        core.vtkLogger.SetStderrVerbosity(logged_before)
    said = window.GetOutput()
    text = said.decode("utf-8", errors="replace") if isinstance(said, bytes) else said  # it may quote a damaged file
    return result, " ".join(text.split())
