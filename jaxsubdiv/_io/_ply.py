"""PLY files: text, binary little-endian and binary big-endian.

Not by meshio: it knows no `vertex_index`, misreads numbers beside a face's list, and ends the interpreter on bad files.
"""

import re
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, Shaped

from ..errors import MeshError
from ._contents import Contents, VertexData, as_double, as_indices, check_polygons
from ._frame import space_words
from ._text import Rows, parse_rows

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_LENGTHS = {name for name, type_ in _TYPES.items() if type_[0] in "iu"}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"} | {
    "f4": "float",
    "f8": "double",
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")


class _Property(NamedTuple):
    """One number of every row, or a list of them where `length` is the type of the list's length."""

    name: str
    type: str
    length: str | None


class _Element(NamedTuple):
    name: str
    n_rows: int
    properties: list[_Property]


class _Header(NamedTuple):
    order: str
    """Byte order for numpy and struct; empty for text."""
    elements: list[_Element]
    n_bytes: int
    n_lines: int


class _Lists(NamedTuple):
    """A list property, by the length of the lists: the rows that have it, ascending, and their values."""

    rows: dict[int, Int[np.ndarray, "_"]]
    values: dict[int, Shaped[np.ndarray, "_ _"]]


_Columns = dict[str, Shaped[np.ndarray, "n"] | _Lists]


def read(path: Path) -> Contents:
    """Vertices, their normals where all of nx, ny and nz are there, and faces. Everything else is left out."""
    columns = _read_columns(path, {"vertex", "face"})
    return _vertices(path, columns)._replace(faces=_faces(path, columns.get("face", {})))


def read_points(path: Path) -> Contents:
    """Vertices and their normals; what comes after the vertices is not read."""
    return _vertices(path, _read_columns(path, {"vertex"}))


def _read_columns(path: Path, wanted: set[str]) -> dict[str, _Columns]:
    """Columns by element, up to the last of those that are wanted."""
    data = path.read_bytes()
    header = _read_header(path, data)
    last = max((i for i, element in enumerate(header.elements) if element.name in wanted), default=-1)
    header = header._replace(elements=header.elements[: last + 1])
    return _read_binary(path, data, header) if header.order else _read_text(path, data, header)


def _vertices(path: Path, columns: dict[str, _Columns]) -> Contents:
    if "vertex" not in columns:
        raise MeshError(f"{path.name}: there is no element 'vertex', so no coordinates to read.")
    vertices = _triple(columns["vertex"], _POSITION)
    if vertices is None:
        raise MeshError(f"{path.name}: the element 'vertex' needs the properties x, y and z.")
    return Contents(vertices, None, _triple(columns["vertex"], _NORMAL))


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Binary little-endian; coordinates and normals in double precision."""
    columns = dict(zip(_POSITION, contents.vertices.T, strict=True))
    if contents.normals is not None:
        columns |= zip(_NORMAL, contents.normals.T, strict=True)
    columns |= _convert_data(data)
    table = np.zeros(len(contents.vertices), [(name, c.dtype.newbyteorder("<")) for name, c in columns.items()])
    for name, column in columns.items():
        table[name] = column
    faces = contents.faces or {}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(["comment " + space_words(contents.frame)] if contents.frame else []),
        f"element vertex {len(table)}",
        *(f"property {_NAMES[column.dtype.str[1:]]} {name}" for name, column in columns.items()),
        f"element face {sum(map(len, faces.values()))}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    with path.open("wb") as file:
        file.write("\n".join(header).encode())
        file.write(table.tobytes())
        for size, corners in faces.items():
            rows = np.zeros(len(corners), [("size", "u1"), ("corners", "<i4", size)])
            rows["size"], rows["corners"] = size, corners
            file.write(rows.tobytes())


def _convert_data(data: VertexData) -> VertexData:
    """Vertex data in the types and under the names that PLY knows."""
    stored = {}
    for name, column in data.items():
        if not name.isascii() or name in _POSITION + _NORMAL or len(name.split()) != 1 or name != name.strip():
            raise MeshError(
                f"`vertex_data` has the name '{name}'; PLY needs one ASCII word other than x, y, z, nx, ny, nz."
            )
        if column.dtype.kind in "iu" and column.dtype.itemsize == 8:
            stored[name] = column.astype(np.int32)
            if (stored[name] != column).any():
                raise MeshError(f"`vertex_data['{name}']` has integers beyond the 32 bits of PLY. Give it as float64.")
        else:
            stored[name] = column
    return stored


def _read_header(path: Path, data: bytes) -> _Header:
    order, elements, at, number = None, [], 0, 0
    while True:
        end = data.find(b"\n", at)
        if end < 0:
            raise MeshError(f"{path.name}: the header has no line 'end_header'. This is no PLY file, or it is cut off.")
        words = data[at:end].decode("utf-8", errors="replace").split()
        at, number = end + 1, number + 1
        if number == 1 and words != ["ply"]:
            raise MeshError(f"{path.name}, line 1: a PLY file begins with the line 'ply'; this one does not.")
        match words:
            case ["format", kind, _] if kind in _BYTE_ORDERS:
                order = _BYTE_ORDERS[kind]
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count):
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, type_, name] if elements and length in _LENGTHS and type_ in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[type_], _TYPES[length]))
            case ["property", type_, name] if elements and type_ in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[type_], None))
            case ["end_header"] if order is not None:
                _check_elements(path, elements, len(data) - at)
                return _Header(order, elements, at, number)
            case ["end_header"]:
                raise MeshError(f"{path.name}: the header has no line 'format'. Known are {', '.join(_BYTE_ORDERS)}.")
            case ["ply" | "comment" | "obj_info", *_] | []:
                pass
            case _:
                raise MeshError(
                    f"{path.name}, line {number}: '{' '.join(words)[:60]}' has no meaning in a PLY header. Expected "
                    "are format, comment, element, property and end_header."
                )


def _check_elements(path: Path, elements: list[_Element], n_bytes: int) -> None:
    """Raise where names come twice, or more rows are announced than the rest of the file has bytes."""
    if len({element.name for element in elements}) < len(elements):
        raise MeshError(f"{path.name}: the header has two elements of one name. Rename one.")
    for element in elements:
        if element.n_rows > n_bytes:
            raise MeshError(
                f"{path.name}: the header announces {element.n_rows} rows of '{element.name}', but only {n_bytes} "
                "bytes follow. The file is cut off, or its header is wrong."
            )
        names = [item.name for item in element.properties]
        if len(set(names)) < len(names):
            raise MeshError(f"{path.name}: the element '{element.name}' has two properties of one name. Rename one.")


def _triple(columns: _Columns, names: tuple[str, str, str]) -> np.ndarray | None:
    found = [columns.get(name) for name in names]
    if not all(isinstance(column, np.ndarray) for column in found):
        return None
    return as_double(np.stack(found, axis=1))  # type: ignore[arg-type]


def _faces(path: Path, columns: _Columns) -> dict[int, Int[np.ndarray, "_ _"]] | None:
    corners = columns.get("vertex_indices", columns.get("vertex_index"))
    if not isinstance(corners, _Lists):
        return None
    sizes = np.zeros(sum(map(len, corners.rows.values())), int)
    for size, rows in corners.rows.items():
        sizes[rows] = size
    check_polygons(path, sizes)
    return {size: as_indices(path, values) for size, values in corners.values.items()} or None


def _read_text(path: Path, data: bytes, header: _Header) -> dict[str, _Columns]:
    text = data[header.n_bytes :].decode("utf-8", errors="replace")
    rows = parse_rows(path, text, header.n_lines + 1)
    columns, at = {}, 0
    for element in header.elements:
        part = rows.part(at, at + element.n_rows)
        if len(part.counts) < element.n_rows:
            raise MeshError(
                f"{path.name}: the header announces {element.n_rows} rows of '{element.name}', but only "
                f"{len(part.counts)} are there. The file is cut off, or its header is wrong."
            )
        columns[element.name] = _text_columns(path, part, element)
        at += element.n_rows
    return columns


def _text_columns(path: Path, rows: Rows, element: _Element) -> _Columns:
    at, begins, lengths = rows.starts, {}, {}
    for item in element.properties:
        begins[item.name] = at
        if item.length is None:
            at = at + 1
        else:
            # A row that is too short must not read past the end: it is found out below.
            length = np.nan_to_num(rows.values.take(at, mode="clip"), nan=-1, posinf=-1, neginf=-1)
            lengths[item.name] = np.clip(length, 0, len(rows.values)).astype(int)
            at = at + 1 + lengths[item.name]
    wrong = np.flatnonzero(at - rows.starts != rows.counts)
    if len(wrong):
        expected, found = (at - rows.starts)[wrong[0]], rows.counts[wrong[0]]
        raise MeshError(
            f"{path.name}, line {rows.lines[wrong[0]]}: a row of '{element.name}' should have {expected} numbers by "
            f"the header, but has {found}."
        )
    columns: _Columns = {}
    for name, begin in begins.items():
        if name not in lengths:
            columns[name] = rows.values[begin]
            continue
        places = {int(n): np.flatnonzero(lengths[name] == n) for n in np.unique(lengths[name])}
        values = {n: rows.values[begin[at][:, None] + 1 + np.arange(n)] for n, at in places.items()}
        columns[name] = _Lists(places, values)
    return columns


def _read_binary(path: Path, data: bytes, header: _Header) -> dict[str, _Columns]:
    columns, at = {}, header.n_bytes
    for element in header.elements:
        try:
            columns[element.name], at = _binary_columns(data, at, element, header.order)
        except (struct.error, ValueError):
            raise MeshError(
                f"{path.name}: the header announces {element.n_rows} rows of '{element.name}', but the file ends "
                "before the last. It is cut off, or its header is wrong."
            ) from None
    return columns


def _binary_columns(data: bytes, at: int, element: _Element, order: str) -> tuple[_Columns, int]:
    """Columns of one element that begins at byte `at`, and where it ends."""
    lists = [item for item in element.properties if item.length is not None]
    if element.n_rows == 0 or not element.properties:
        return {item.name: _Lists({}, {}) if item.length else np.zeros(0) for item in element.properties}, at
    _, lengths, _ = _walk(data, at, element._replace(n_rows=1), order)
    layout = _layout(element, lengths[0], order)
    table = np.frombuffer(data, layout, min(element.n_rows, (len(data) - at) // layout.itemsize), at)
    if not lists and len(table) < element.n_rows:
        raise ValueError("past the end")
    # Most files have faces of one size: then every row looks like the first, and nothing need be walked.
    if len(table) == element.n_rows and all(
        (table[f"{item.name} length"] == n).all() for item, n in zip(lists, lengths[0], strict=True)
    ):
        return _gather(element, [(np.arange(element.n_rows), table)]), at + table.nbytes
    starts, lengths, end = _walk(data, at, element, order)
    raw, groups = np.frombuffer(data, np.uint8), []
    for row in np.unique(lengths, axis=0):
        rows = np.flatnonzero((lengths == row).all(axis=1))
        layout = _layout(element, row, order)
        groups.append((rows, raw[starts[rows][:, None] + np.arange(layout.itemsize)].view(layout)[:, 0]))
    return _gather(element, groups), end


def _walk(
    data: bytes, at: int, element: _Element, order: str
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n l"], int]:
    """Where every row begins, the lengths of its lists, and where the last row ends.

    Only the row itself tells how long it is, so this is a loop in Python, kept to a few operations a row.
    """
    steps, skip = [], 0
    for item in element.properties:
        width = np.dtype(item.type).itemsize
        if item.length is None:
            skip += width
        else:
            length = np.dtype(order + item.length)
            steps.append((skip, struct.Struct(order + length.char).unpack_from, length.itemsize, width))
            skip = 0
    starts, lengths = [], []
    for _ in range(element.n_rows):
        starts.append(at)
        for before, unpack, own, width in steps:
            (n,) = unpack(data, at + before)
            at += before + own + n * width
            lengths.append(n)
        at += skip
    if at > len(data) or min(lengths, default=0) < 0:
        raise ValueError("past the end")
    return np.array(starts), np.array(lengths, int).reshape(element.n_rows, len(steps)), at


def _layout(element: _Element, lengths: Int[np.ndarray, "l"], order: str) -> np.dtype:
    """A row whose lists have these lengths, as a numpy record."""
    fields, left = [], list(lengths)
    for item in element.properties:
        if item.length is None:
            fields.append((item.name, order + item.type))
        else:
            fields.append((f"{item.name} length", order + item.length))
            fields.append((item.name, order + item.type, (int(left.pop(0)),)))
    return np.dtype(fields)


def _gather(element: _Element, groups: list[tuple[Int[np.ndarray, "_"], np.ndarray]]) -> _Columns:
    """Columns out of groups of rows, each group with one layout."""
    columns: _Columns = {}
    for item in element.properties:
        if item.length is None:
            column = np.zeros(element.n_rows, item.type)
            for rows, table in groups:
                column[rows] = table[item.name]
            columns[item.name] = column
            continue
        places: dict[int, list[np.ndarray]] = {}
        values: dict[int, list[np.ndarray]] = {}
        for rows, table in groups:
            n = table.dtype[item.name].shape[0]
            places.setdefault(n, []).append(rows)
            values.setdefault(n, []).append(table[item.name])
        orders = {n: np.argsort(np.concatenate(places[n])) for n in places}
        columns[item.name] = _Lists(
            {n: np.concatenate(places[n])[order] for n, order in orders.items()},
            {n: np.concatenate(values[n])[order] for n, order in orders.items()},
        )
    return columns
