"""PLY: text and both byte orders, faces among other things."""

import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from files import put
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from round_trips import FACE, QUAD, XYZ, assert_same, finite, ply

from jaxsubdiv._io import read_mesh, read_points
from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError

PLY_KINDS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("kind", PLY_KINDS)
@pytest.mark.parametrize(
    "list_type", ["uchar int vertex_indices", "uchar uint vertex_index", "int ushort vertex_index"]
)
def test_ply_mixed_faces_among_other_things(tmp_path, kind, list_type):
    """Extra elements before and after, extra numbers around x, y, z, and lists of other lengths beside the corners."""
    content = ply(
        kind,
        [
            ("camera", ["float f", "list uchar float k"], [[35.0, [1.0, 2.0]], [50.0, []]]),
            ("vertex", ["uchar red", "double z", "float nx", "float ny", "float nz", "double y", "double x"],
             [[200, z, 0.5, -1.0, 0.25, y, x] for x, y, z in QUAD]),
            ("face", ["uchar part", f"list {list_type}", "list uchar float texcoord", "short group"],
             [[1, [0, 1, 2], [0.5], -7], [2, [0, 1, 2, 3], [], 9], [3, [0, 2, 3], [1.0, 2.0], 9],
              [4, [3, 2, 0], [], 1]]),
            ("edge", ["int a", "int b"], [[0, 1]]),
        ],
    )  # fmt: skip
    mesh = read_mesh(put(tmp_path, "a.ply", content), check=False)
    np.testing.assert_array_equal(mesh.vertices, QUAD)
    np.testing.assert_array_equal(mesh.normals, [[0.5, -1, 0.25]] * 4)
    np.testing.assert_array_equal(mesh.faces[3], [[0, 1, 2], [0, 2, 3], [3, 2, 0]])
    np.testing.assert_array_equal(mesh.faces[4], [[0, 1, 2, 3]])


@settings(max_examples=20, deadline=None)
@given(
    rows=arrays(np.float64, (6, 3), elements=finite),
    faces=st.lists(
        st.permutations(range(6)).flatmap(lambda p: st.sampled_from([p[:3], p[:4]])), min_size=1, max_size=12
    ),
    length=st.sampled_from(["uchar", "char", "short", "uint"]),
)
def test_ply_text_and_both_byte_orders_agree(rows, faces, length):
    elements = [
        ("vertex", XYZ, rows.tolist()),
        ("face", [f"list {length} int vertex_indices"], [[face] for face in faces]),
    ]
    with tempfile.TemporaryDirectory() as folder:
        for kind in PLY_KINDS:
            mesh = read_mesh(put(Path(folder), "a.ply", ply(kind, elements)), check=False)
            assert_same(mesh, ControlMesh(rows, faces, check=False))


def test_ply_big_endian_byte_by_byte(tmp_path):
    header = b"ply\r\nformat binary_big_endian 1.0\r\nelement vertex 3\r\n" + b"".join(
        b"property float %c\r\n" % axis for axis in b"xyz"
    )
    header += b"element face 1\r\nproperty list uchar int vertex_indices\r\nend_header\r\n"
    body = struct.pack(">9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack(">Biii", 3, 0, 1, 2)
    mesh = read_mesh(put(tmp_path, "a.ply", header + body))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces[3], [[0, 1, 2]])


@pytest.mark.parametrize("kind", PLY_KINDS)
def test_ply_points_alone(tmp_path, kind):
    path = put(tmp_path, "a.ply", ply(kind, [("vertex", XYZ, QUAD), ("face", FACE, [])]))
    assert read_points(path).points.shape == (4, 3)
    with pytest.raises(MeshError, match=r"a\.ply: it holds points but no faces. Read it with `read_points`"):
        read_mesh(path)
