"""glTF 2.0 in one file, as web pages, slides and office programs show surfaces.

Not by trimesh: beside colours of vertices it writes no material, so that viewers show dark metal; and it reads files of
any size that a header announces.
"""

import json
import re
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from ..errors import MeshError
from ._colours import colours_of, to_linear
from ._contents import Contents, VertexData, as_double, round_to_single, split_quads, warn

_TYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_CODES = {np.dtype(type_): code for code, type_ in _TYPES.items()}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _VERTICES, _INDICES = 4, 34962, 34963  # codes of the standard
_JSON, _BINARY = b"JSON", b"BIN\0"
_METRES = ("metres", 1000.0)
_MM = {"unit": "mm"}
_SCALE = 0.001
_TO_METRES = [_SCALE, 0, 0, 0, 0, 0, -_SCALE, 0, 0, _SCALE, 0, 0, 0, 0, 0, 1]
"""Column by column: mm with z up to metres with y up, x staying x."""
_IDENTITY = np.eye(4).ravel().tolist()


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Vertices in mm, in a node whose matrix takes them to glTF's metres and z up to its y up.

    The first vertex data colour the vertices; all are there as numbers too, each as an attribute of its own.
    """
    vertices = round_to_single(path, "glTF", contents.vertices)
    triangles = split_quads(path, "glTF", contents)
    columns: dict[str, Shaped[np.ndarray, "v *c"]] = {"POSITION": vertices}
    if contents.normals is not None:
        columns["NORMAL"] = _normalise(contents.normals).astype("<f4")
    extras: dict[str, Any] = dict(_MM)
    for name, values in data.items():
        known, values = np.isfinite(values), values.astype(np.float64)
        if "COLOR_0" not in columns:
            colours = colours_of(values)
            linear = np.append(to_linear(colours.srgb), np.ones((len(values), 1)), axis=1)
            columns["COLOR_0"] = np.round(65535 * linear).astype("<u2")
            extras |= {"coloured_by": name, "first_colour": colours.first, "last_colour": colours.last}
        attribute = "_" + re.sub("[^A-Z0-9_]", "_", name.upper())
        if attribute in columns:
            raise MeshError(f"`vertex_data` has several names that glTF knows as '{attribute}'. Rename '{name}'.")
        columns[attribute] = np.where(known, values, 0).astype("<f4")
        if not known.all():  # the standard has no NaN
            columns[f"{attribute}_KNOWN"] = known.astype("<f4")
    _write_chunks(path, columns, triangles.astype("<u4").ravel(), extras)


def _normalise(normals: Shaped[np.ndarray, "v 3"]) -> Shaped[np.ndarray, "v 3"]:
    """As the standard has them; those of no length point up."""
    scaled = normals / np.maximum(np.abs(normals).max(axis=1, keepdims=True), np.finfo(float).tiny)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    return np.where(length > 0, scaled / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))


def _write_chunks(
    path: Path, columns: dict[str, Shaped[np.ndarray, "v *c"]], corners: Shaped[np.ndarray, "n"], extras: dict[str, Any]
) -> None:
    views, accessors, binary = [], [], b""
    for name, column in [*columns.items(), ("", corners)]:
        raw = column.tobytes()  # of four bytes a number, or eight a colour: all begin where they may
        target = _VERTICES if name else _INDICES
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(raw), "target": target})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[1 if column.ndim == 1 else column.shape[1]]
        accessor = {"bufferView": len(views) - 1, "componentType": _CODES[column.dtype], "type": kind}
        accessor |= {"count": len(column)}
        if name == "POSITION":
            accessor |= {"min": column.min(axis=0).tolist(), "max": column.max(axis=0).tolist()}
        accessors.append(accessor | ({"normalized": True} if name == "COLOR_0" else {}))
        binary += raw
    primitive = {"attributes": {name: i for i, name in enumerate(columns)}, "indices": len(columns), "material": 0}
    paint = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 0.7}
    gltf = {
        "asset": {"version": "2.0", "generator": "jaxsubdiv"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "surface", "mesh": 0, "matrix": _TO_METRES, "extras": _MM}],
        "meshes": [{"name": "surface", "primitives": [primitive], "extras": extras}],
        "materials": [{"pbrMetallicRoughness": paint, "doubleSided": True}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(gltf, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I", len(text)) + _JSON + text + struct.pack("<I", len(binary)) + _BINARY + binary
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)


class _File(NamedTuple):
    gltf: dict[str, Any]
    binary: bytes


def read(path: Path) -> Contents:
    """Triangles of all meshes, as they are stored there; normals where all parts have some.

    The matrix that places a mesh is not applied, and a warning says so, unless it is ours, which only changes the unit.
    """
    try:
        file = _read_chunks(path.read_bytes())
        meshes = _list(file.gltf, "meshes")
        is_ours = any(_dict(mesh).get("extras", {}) == _MM for mesh in _list(file.gltf, "nodes"))
        parts = [_read_part(file, _dict(part)) for mesh in meshes for part in _list(_dict(mesh), "primitives")]
        moved = not is_ours and _is_moved(file)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise MeshError(f"{path.name}: {str(error)[:300]}. It is no sound glTF file of triangles.") from None
    if not parts:
        raise MeshError(f"{path.name}: it holds no meshes.")
    if moved and len(meshes) > 1:
        raise MeshError(
            f"{path.name}: it is a scene of {len(meshes)} meshes, each placed by a matrix. Make one of them first: "
            "trimesh.load_scene(...).to_mesh().export(...)."
        )
    if moved:
        warn(path, "a matrix places its mesh, which was not applied: vertices are as stored.")
    ends = np.cumsum([0, *(len(part.vertices) for part in parts)])
    triangles = [part.faces[3] + end for part, end in zip(parts, ends, strict=False) if part.faces is not None]
    normals = [part.normals for part in parts if part.normals is not None]
    return Contents(
        np.concatenate([part.vertices for part in parts]),
        {3: np.concatenate(triangles)},
        np.concatenate(normals) if len(normals) == len(parts) else None,
        usual_unit=None if is_ours else _METRES,
    )


def _read_chunks(data: bytes) -> _File:
    if data[:4] != b"glTF" or data[4:8] != struct.pack("<I", 2):
        raise ValueError("it does not begin as a binary file of glTF 2.0 does")
    chunks, at = [], 12
    while at + 8 <= len(data) and len(chunks) < 2:
        (length,) = struct.unpack_from("<I", data, at)
        if at + 8 + length > len(data):
            raise ValueError(f"{length} bytes are announced, but {len(data) - at - 8} follow; it is cut off")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 8 + length
    if not chunks or chunks[0][0] != _JSON:
        raise ValueError("its first part is not the description in JSON")
    try:
        gltf = _dict(json.loads(chunks[0][1].decode("utf-8")))
    except RecursionError:
        raise ValueError("its description is no JSON: too deep") from None
    needed = [str(name)[:60] for name in _list(gltf, "extensionsRequired")]
    if packed := [name for name in needed if "compression" in name or "quantization" in name]:
        raise ValueError(f"its numbers are packed by {packed[0]}; save it without compression")
    return _File(gltf, chunks[1][1] if len(chunks) > 1 and chunks[1][0] == _BINARY else b"")


def _read_part(file: _File, part: dict[str, Any]) -> Contents:
    if part.get("mode", _TRIANGLES) != _TRIANGLES:
        raise ValueError(f"a part is drawn in the mode {str(part['mode'])[:20]}, where 4, triangles, is read")
    attributes = _dict(part.get("attributes"))
    vertices = as_double(_numbers(file, attributes["POSITION"], "VEC3", "f"))
    normals = as_double(_numbers(file, attributes["NORMAL"], "VEC3", "f")) if "NORMAL" in attributes else None
    if normals is not None and len(normals) != len(vertices):
        raise ValueError(f"it has {len(normals)} normals for {len(vertices)} vertices")
    corners = np.arange(len(vertices))
    if "indices" in part:
        corners = _numbers(file, part["indices"], "SCALAR", "u").astype(np.int64)
        if len(corners) and corners.max() >= len(vertices):
            raise ValueError(f"a triangle names the vertex {corners.max()} of {len(vertices)}")
    if len(corners) % 3:
        raise ValueError(f"{len(corners)} corners are no triangles")
    return Contents(vertices, {3: corners.reshape(-1, 3)}, normals)


def _numbers(file: _File, place: Any, kind: str, letter: str) -> Shaped[np.ndarray, "n *c"]:
    """The numbers of an accessor."""
    accessor = _entry(file.gltf, "accessors", place)
    view = _entry(file.gltf, "bufferViews", accessor["bufferView"])
    dtype = np.dtype(_TYPES.get(_read_whole(accessor, "componentType"), "V"))
    if accessor.get("type") != kind or dtype.kind != letter or "sparse" in accessor or view.get("buffer") != 0:
        raise ValueError(f"the accessor {place} is of another kind than plain {kind} within the file")
    width = dtype.itemsize * _WIDTHS[kind]
    count, stride = _read_whole(accessor, "count"), _read_whole(view, "byteStride", width)
    begin, within = _read_whole(view, "byteOffset", 0), _read_whole(accessor, "byteOffset", 0)
    end = begin + min(_read_whole(view, "byteLength"), len(file.binary))
    if stride < width or begin + within + stride * max(count - 1, 0) + width * (count > 0) > min(end, len(file.binary)):
        raise ValueError(f"the accessor {place} announces {count} times {kind}, which its bytes do not hold")
    shape = (count,) if kind == "SCALAR" else (count, _WIDTHS[kind])
    strides = (stride, dtype.itemsize)[: len(shape)]
    return np.ndarray(shape, dtype, file.binary, begin + within, strides) if count else np.zeros(shape, dtype)


def _is_moved(file: _File) -> bool:
    """Whether a node, with a mesh or above one, has a place of its own."""
    usual = {"matrix": _IDENTITY, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
    nodes = [_dict(node) for node in _list(file.gltf, "nodes")]
    return any(node.get(name, value) != value for node in nodes for name, value in usual.items())


def _entry(gltf: dict[str, Any], name: str, place: Any) -> dict[str, Any]:
    entries = _list(gltf, name)
    if not isinstance(place, int) or isinstance(place, bool) or not 0 <= place < len(entries):
        raise ValueError(f"`{name}` has no entry {str(place)[:20]}")
    return _dict(entries[place])


def _read_whole(entry: dict[str, Any], name: str, default: int | None = None) -> int:
    value = entry.get(name, default)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
        raise ValueError(f"`{name}` is {str(value)[:20]}, which is no whole number")
    return value


def _list(entry: dict[str, Any], name: str) -> list[Any]:
    found = entry.get(name, [])
    if not isinstance(found, list):
        raise ValueError(f"`{name}` is no list")
    return found


def _dict(entry: Any) -> dict[str, Any]:
    if not isinstance(entry, dict):
        raise ValueError(f"{str(entry)[:40]!r} stands where an object is expected")
    return entry
