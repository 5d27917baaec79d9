"""STL, OFF and NPZ in their dialects; scales."""

import struct

import numpy as np
import pytest
from files import put
from meshes import mixed_closed
from round_trips import SQUARE, assert_same, mesh_of

from jaxsubdiv._io import PointCloud, read_mesh, read_points, write_mesh
from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError


def test_stl_text_of_two_solids(tmp_path):
    facet = "  facet normal 0 0 1\n OUTER loop\nvertex 0 0 {z}\n\tvertex 1e0 0 {z}\nVertex 0 1 {z}\nendloop\nendfacet\n"
    text = "".join(f"solid vertex {z}\r\n{facet.format(z=z)}endsolid\n" for z in (0, 1))
    mesh = read_mesh(put(tmp_path, "a.STL", text))
    np.testing.assert_array_equal(mesh.faces[3], [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])


def test_stl_binary_that_begins_with_solid(tmp_path):
    facet = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 77)
    mesh = read_mesh(put(tmp_path, "a.stl", b"solid".ljust(80) + struct.pack("<I", 1) + facet))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("text", "has_normals"),
    [
        ("OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n", False),
        ("OFF 4 1 0 # counts\n# a comment\n0 0 0\n\n1 0 0 # corner\n1 1 0\n0 1 0\n4 0 1 2 3 255 0 0\n", False),
        ("off\n4 1\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4  0 1 2 3  0.5 0.5 0.5\n", False),
        ("# made by hand\nCOFF\n4 1 4\n" + "".join(f"{x} {y} 0 255 0 0 255\n" for x, y in "00 10 11 01".split())
         + "4 0 1 2 3\n", False),
        ("NOFF\n4 1 0\n" + "".join(f"{x} {y} 0 0 0 1\n" for x, y in "00 10 11 01".split()) + "4 0 1 2 3\n", True),
        ("STCNOFF\n4 1 0\n" + "".join(f"{x} {y} 0 0 0 1 9 9 9 9 .5 .5\n" for x, y in "00 10 11 01".split())
         + "4 0 1 2 3\n", True),
    ],
)  # fmt: skip
def test_off_dialects(tmp_path, text, has_normals):
    mesh = read_mesh(put(tmp_path, "a.off", text))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces[4], [[0, 1, 2, 3]])
    assert (mesh.normals is not None) == has_normals


def test_npz_names(tmp_path):
    vertices, faces = mixed_closed()
    triangles = np.array([face for face in faces if len(face) == 3])
    quads = np.array([face for face in faces if len(face) == 4], np.uint16)
    scan = np.ones((7, 3), np.float32)
    np.savez(tmp_path / "a.npz", control_points=vertices, control_faces=triangles, points=scan, weights=np.arange(7))
    mesh, cloud = read_mesh(tmp_path / "a.npz"), read_points(tmp_path / "a.npz")
    assert (len(mesh.vertices), mesh.n_faces, mesh.normals) == (12, 8, None)
    np.testing.assert_array_equal(cloud.points, scan)
    np.testing.assert_array_equal(cloud.weights, np.arange(7.0))
    np.savez(tmp_path / "b.npz", vertices=vertices, faces=quads, triangles=triangles, normals=vertices)
    assert_same(read_mesh(tmp_path / "b.npz"), ControlMesh(vertices, {3: triangles, 4: quads}, vertices))
    np.save(tmp_path / "c.npy", scan)
    cloud = read_points(tmp_path / "c.npy")
    assert isinstance(cloud, PointCloud) and cloud.normals is None and cloud.weights is None
    np.testing.assert_array_equal(cloud.points, scan)


def test_scale(tmp_path):
    mesh = mesh_of("quads", True)
    write_mesh(tmp_path / "a.ply", mesh)
    read = read_mesh(tmp_path / "a.ply", scale=1000)
    np.testing.assert_array_equal(read.vertices, mesh.vertices * 1000)
    np.testing.assert_array_equal(read.normals, mesh.normals)
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply", scale=1000).points, mesh.vertices * 1000)
    for scale in (0, -1, np.nan, np.inf):
        for read in (read_mesh, read_points):
            with pytest.raises(
                ValueError, match=r"`scale` must be positive and finite; got .*1000 turns metres into mm"
            ):
                read(tmp_path / "a.ply", scale=scale)


def test_unchecked_for_repair(tmp_path):
    path = put(tmp_path, "a.obj", SQUARE + "f 1 2 3\nf 1 3 4\nf 1 1 3\n")
    with pytest.raises(MeshError, match=r"a\.obj: face 2 name a corner twice.*check=False"):
        read_mesh(path)
    assert read_mesh(path, check=False).n_faces == 3
