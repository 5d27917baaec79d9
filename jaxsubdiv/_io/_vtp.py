"""VTP and VTU files: VTK's polygons and unstructured grids as XML. VTK writes the first, see `_vtk`.

Not read by VTK: counts that a file only announces end the interpreter there.
"""

import re
from bisect import bisect_right
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Int, Shaped

from ..errors import MeshError
from . import _xml
from ._cells import append_triangles, polygons, strips, surface_cells
from ._contents import Contents, as_double, as_indices
from ._text import parse_rows

_TYPES = {
    **{f"{sign}Int{8 * n}": f"{'u' if sign else 'i'}{n}" for sign in ("", "U") for n in (1, 2, 4, 8)},
    "Float32": "f4",
    "Float64": "f8",
}
_APPENDED = re.compile(rb"<AppendedData[^>]{0,200}>\s{0,200}_")
_COUNT = re.compile("[0-9]{1,18}")
_PACKERS = {None: None, "vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}


class _File(NamedTuple):
    path: Path
    kind: str
    """PolyData or UnstructuredGrid."""
    root: Element
    appended: bytes
    """What follows the underscore of the appended data."""
    is_raw: bool
    """Whether the appended data are bytes, not base64."""
    offsets: list[int]
    """Where arrays begin in the appended data, and where these end, ascending."""


def read(path: Path) -> Contents:
    """Points, faces, and the point normals: the array marked as such, or the one called Normals."""
    file = _open(path)
    contents, faces, n_before = [], [], 0
    for piece in _pieces(file):
        contents.append(_points(file, piece))
        blocks = _grid_faces(file, piece) if file.kind == "UnstructuredGrid" else _faces(file, piece)
        faces += [{size: block + n_before for size, block in blocks.items()}] if blocks else []
        n_before += len(contents[-1].vertices)
    joined = {size: np.concatenate([blocks[size] for blocks in faces]) for size in (3, 4)} if faces else None
    return _join(contents)._replace(faces=joined)


def read_points(path: Path) -> Contents:
    """Points and their normals, whatever cells they have."""
    file = _open(path)
    return _join([_points(file, piece) for piece in _pieces(file)])


def _open(path: Path) -> _File:
    data, appended, is_raw = path.read_bytes(), b"", False
    if found := _APPENDED.search(data):  # raw bytes are no XML
        appended, is_raw = data[found.end() :], b'"raw"' in found[0]
        data = data[: found.start()] + b"</VTKFile>"
        appended = appended[: max(appended.rfind(b"</AppendedData"), 0) or None]
    root = _xml.parse(path, data, "VTKFile")
    kind = root.get("type", "")
    if kind not in ("PolyData", "UnstructuredGrid"):
        raise MeshError(
            f"{path.name}: it holds a {kind[:40]}, not polygons. Take its surface first: "
            "pyvista.read(...).extract_surface().save(...)."
        )
    found = [array.get("offset", "") for array in root.iter("DataArray")]
    offsets = sorted({int(offset) for offset in found if _COUNT.fullmatch(offset)} | {len(appended)})
    return _File(path, kind, root, appended, is_raw, offsets)


def _pieces(file: _File) -> list[Element]:
    pieces = file.root.findall(f"{file.kind}/Piece")
    if not pieces:
        raise MeshError(f"{file.path.name}: it has no element 'Piece', so no points. It is damaged.")
    return pieces


def _points(file: _File, piece: Element) -> Contents:
    n = _count(file, piece, "NumberOfPoints")
    array = piece.find("Points/DataArray")
    if array is None:
        if n:
            raise MeshError(f"{file.path.name}: {n} points are announced, but the element 'Points' has no array.")
        return Contents(np.zeros((0, 3)))
    points = _array(file, array, 3 * n).reshape(-1, 3)
    data = piece.find("PointData")
    if data is None:
        return Contents(as_double(points))
    arrays = [array for array in data.findall("DataArray") if array.get("NumberOfComponents") == "3"]
    marked = [array for array in arrays if array.get("Name") == data.get("Normals")]
    marked += [array for array in arrays if (array.get("Name") or "").lower() == "normals"]
    return Contents(
        as_double(points),
        None,
        as_double(_array(file, marked[0], 3 * n).reshape(-1, 3)) if marked else None,
    )


def _faces(file: _File, piece: Element) -> dict[int, Int[np.ndarray, "_ _"]] | None:
    """Polygons and the triangles of strips, of a piece of polygons."""
    faces = polygons(file.path, *_cells(file, piece, "Polys", _count(file, piece, "NumberOfPolys")))
    more = strips(file.path, *_cells(file, piece, "Strips", _count(file, piece, "NumberOfStrips")))
    return append_triangles(faces, more)


def _grid_faces(file: _File, piece: Element) -> dict[int, Int[np.ndarray, "_ _"]] | None:
    """Triangles and quads of a piece of an unstructured grid."""
    n = _count(file, piece, "NumberOfCells")
    if not n:
        return None
    types = next((array for array in piece.findall("Cells/DataArray") if array.get("Name") == "types"), None)
    if types is None:
        raise MeshError(f"{file.path.name}: the element 'Cells' needs the array 'types'.")
    return surface_cells(file.path, as_indices(file.path, _array(file, types, n)), *_cells(file, piece, "Cells", n))


def _cells(file: _File, piece: Element, name: str, n: int) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "c"]]:
    """Where the corners of each of the `n` cells end, and the corners."""
    arrays = {array.get("Name"): array for array in piece.findall(f"{name}/DataArray")}
    if not n:
        return np.zeros(0, int), np.zeros(0, int)
    if not {"offsets", "connectivity"} <= arrays.keys():
        raise MeshError(f"{file.path.name}: the element '{name}' needs the arrays 'connectivity' and 'offsets'.")
    ends = as_indices(file.path, _array(file, arrays["offsets"], n))
    return ends, as_indices(file.path, _array(file, arrays["connectivity"], max(int(ends[-1]), 0)))


def _join(parts: list[Contents]) -> Contents:
    """The pieces as one; normals only where all have some."""
    normals = [part.normals for part in parts if part.normals is not None]
    vertices = np.concatenate([part.vertices for part in parts])
    return Contents(vertices, None, np.concatenate(normals) if len(normals) == len(parts) else None)


def _count(file: _File, piece: Element, name: str) -> int:
    text = piece.get(name, "0").strip()
    if not _COUNT.fullmatch(text):
        raise MeshError(f"{file.path.name}: '{name}' is '{text[:40]}', which is no count. The file is damaged.")
    return int(text)


def _array(file: _File, array: Element, n: int) -> Shaped[np.ndarray, "n"]:
    """The `n` numbers of a data array."""
    name = array.get("Name", "without a name")[:40]
    try:
        kind, form = _TYPES.get(array.get("type", "")), array.get("format")
        if kind is None:
            raise ValueError(f"the type '{array.get('type')}' is not read")
        if form == "ascii":
            # Not more numbers than announced are an error too: text in the array's elements comes after them.
            values = parse_rows(file.path, array.text or "").values
        elif form in ("binary", "appended"):
            order = ">" if file.root.get("byte_order") == "BigEndian" else "<"
            values = np.frombuffer(_bytes(file, array, form), np.dtype(order + kind))
        else:
            raise ValueError(f"the format '{form}' is not known")
        if len(values) != n:
            raise ValueError(f"{n} numbers are announced, but there are {len(values)}")
    except ValueError as error:
        text = str(error).removeprefix(f"{file.path.name}, ")
        raise MeshError(f"{file.path.name}: the array '{name}': {text}. The file is cut off or damaged.") from None
    return values


def _bytes(file: _File, array: Element, form: str) -> bytes:
    """What a data array holds, unpacked."""
    packer = file.root.get("compressor")
    if packer not in _PACKERS:
        raise ValueError(f"it is packed by {packer}. Save it with zlib, by VTK's SetCompressorTypeToZLib")
    if form == "appended":
        offset = array.get("offset", "")
        if not _COUNT.fullmatch(offset) or int(offset) >= len(file.appended):
            raise ValueError(f"the offset '{offset[:40]}' lies outside of the appended data")
        end = file.offsets[bisect_right(file.offsets, int(offset))]  # where the next array begins
        data = file.appended[int(offset) : end]
        if not file.is_raw:
            data = _xml.from_base64(data.decode("ascii", errors="replace"))
    else:
        data = _xml.from_base64(array.text or "")
    header = np.dtype(
        (">" if file.root.get("byte_order") == "BigEndian" else "<")
        + {"UInt64": "u8"}.get(file.root.get("header_type", ""), "u4")
    )
    if _PACKERS[packer] is None:
        n_bytes = _counts(data, header, 0, 1)[0]
        found = data[header.itemsize : header.itemsize + n_bytes]
        if len(found) < n_bytes:
            raise ValueError(f"{n_bytes} bytes are announced, but {len(found)} are there")
        return found
    n_blocks, block, last = _counts(data, header, 0, 3)
    sizes, at, blocks = _counts(data, header, 3, n_blocks), (3 + n_blocks) * header.itemsize, []
    for i, size in enumerate(sizes):
        n_bytes = last if last and i == n_blocks - 1 else block
        blocks.append(_xml.unpack(data[at : at + size], n_bytes, str(_PACKERS[packer])))
        at += size
    return b"".join(blocks)


def _counts(data: bytes, header: np.dtype, first: int, n: int) -> list[int]:
    """Whole numbers of the header before the data."""
    if (first + n) * header.itemsize > len(data):
        raise ValueError("it ends before its own header does")
    return np.frombuffer(data, header, n, first * header.itemsize).tolist()
