"""Meshes that tests write and read, and pieces of files."""

import struct
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st
from meshes import cube, grid, mixed_closed, octahedron, two_components

from jaxsubdiv._mesh import ControlMesh

SHAPES = {
    "triangles": octahedron(),
    "quads": cube(),
    "mixed": mixed_closed(),
    "open": grid(3, 2, "mixed", bumpy=0.3),
    "two parts": two_components(),
}


class Bare(NamedTuple):
    """The least that can be written."""

    vertices: Any
    normals: Any
    faces: Any


def mesh_of(shape: str, with_normals: bool, dtype: type = np.float64) -> ControlMesh:
    """A mesh whose coordinates need all their digits, with an unused vertex in front and one at the end."""
    vertices, faces = SHAPES[shape]
    rng = np.random.default_rng(7)
    vertices = np.concatenate([[(9, 9, 9)], vertices + rng.uniform(-0.05, 0.05, vertices.shape), [(-9, 9, 9)]])
    normals = rng.normal(size=vertices.shape).astype(dtype) if with_normals else None
    return ControlMesh(vertices.astype(dtype), [tuple(i + 1 for i in face) for face in faces], normals)


def assert_same(a: ControlMesh, b: ControlMesh) -> None:
    np.testing.assert_array_equal(a.vertices, b.vertices)
    assert (a.normals is None) == (b.normals is None)
    if a.normals is not None:
        np.testing.assert_array_equal(a.normals, b.normals)
    for size in (3, 4):
        np.testing.assert_array_equal(a.faces[size], b.faces[size])


finite = st.floats(allow_nan=False, allow_infinity=False)
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UP = "vn 0 0 1\n"
TYPES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}


def ply(kind: str, elements: list[tuple[str, list[str], list[list]]]) -> bytes:
    """A PLY file; each element is its name, its properties as in the header, and its rows, lists as Python lists."""
    header = ["ply", f"format {kind} 1.0", "comment made for a test", "obj_info none"]
    body = b""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    for name, properties, rows in elements:
        header += [f"element {name} {len(rows)}", *(f"property {item}" for item in properties)]
        for row in rows:
            words = []
            for item, value in zip(properties, row, strict=True):
                types = item.split()[:-1]
                if types[0] == "list":
                    words += [(types[1], len(value)), *((types[2], x) for x in value)]
                else:
                    words.append((types[0], value))
            if order:
                body += b"".join(struct.pack(order + TYPES[type_], x) for type_, x in words)
            else:
                body += (" ".join(repr(x) for _, x in words) + "\n").encode()
    return "\n".join([*header, "end_header\n"]).encode() + body


XYZ = ["double x", "double y", "double z"]
QUAD = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1 / 3]]
FACE = ["list uchar int vertex_indices"]
