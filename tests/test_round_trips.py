"""Reading what was written: bit for bit where the format allows, with a warning where it does not."""

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from files import put
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from meshes import grid, octahedron
from round_trips import SHAPES, Bare, assert_same, finite, mesh_of

from jaxsubdiv._io import read_mesh, read_points, write_mesh
from jaxsubdiv._mesh import ControlMesh

SUFFIXES = (".obj", ".ply", ".off", ".vtp", ".vtk", ".npz")
"""Formats that hold everything a mesh has."""


@pytest.mark.parametrize("with_normals", [False, True], ids=["bare", "normals"])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_round_trip_is_exact(tmp_path, suffix, shape, with_normals):
    mesh = mesh_of(shape, with_normals)
    write_mesh(tmp_path / f"first{suffix}", mesh)
    once = read_mesh(tmp_path / f"first{suffix}")
    assert_same(once, mesh)
    write_mesh(tmp_path / f"second{suffix.upper()}", once)
    assert_same(read_mesh(str(tmp_path / f"second{suffix.upper()}")), mesh)
    cloud = read_points(tmp_path / f"first{suffix}")
    np.testing.assert_array_equal(cloud.points, mesh.vertices)
    assert (cloud.normals is None) == (not with_normals)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"first{suffix}", f"second{suffix.upper()}"]


def test_gifti_round_trip(tmp_path):
    mesh = mesh_of("triangles", True, np.float32)
    write_mesh(tmp_path / "a.surf.gii", mesh)
    assert_same(read_mesh(tmp_path / "a.surf.gii"), ControlMesh(mesh.vertices, mesh.faces))


def test_gifti_has_normals_where_an_array_is_called_so(tmp_path):
    from nibabel.gifti import gifti

    mesh = mesh_of("triangles", True, np.float32)
    arrays = [
        gifti.GiftiDataArray(np.float32(mesh.vertices), "NIFTI_INTENT_POINTSET"),
        gifti.GiftiDataArray(np.int32(mesh.faces[3]), "NIFTI_INTENT_TRIANGLE"),
        gifti.GiftiDataArray(
            np.float32(mesh.normals), "NIFTI_INTENT_VECTOR", meta=gifti.GiftiMetaData({"Name": "Normals"})
        ),
    ]
    assert_same(read_mesh(put(tmp_path, "a.gii", gifti.GiftiImage(darrays=arrays).to_bytes())), mesh)


def test_gifti_says_what_it_rounds(tmp_path):
    mesh = mesh_of("triangles", False)
    with pytest.warns(UserWarning, match=r"a\.gii: GIfTI holds single precision: .* rounded, by up to \d\.\de-0\d"):
        write_mesh(tmp_path / "a.gii", mesh)
    np.testing.assert_allclose(read_mesh(tmp_path / "a.gii").vertices, mesh.vertices, atol=1e-6)


def test_gifti_splits_quads_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"a\.gii: GIfTI holds triangles only: 6 quads were split in two"):
        write_mesh(tmp_path / "a.gii", mesh_of("quads", False, np.float32))
    assert read_mesh(tmp_path / "a.gii").is_closed


@pytest.mark.parametrize(("dtype", "start"), [(np.float32, b"jaxsubdiv "), (np.float64, b"solid")])
def test_stl_round_trip(tmp_path, dtype, start):
    mesh = mesh_of("triangles", True, dtype)
    write_mesh(tmp_path / "a.stl", mesh)
    assert (tmp_path / "a.stl").read_bytes().startswith(start)
    read = read_mesh(tmp_path / "a.stl")
    assert read.is_closed and len(read.vertices) == 6 and read.normals is None
    np.testing.assert_array_equal(read.vertices[read.faces[3]], mesh.vertices[mesh.faces[3]])
    write_mesh(tmp_path / "b.stl", read)
    assert_same(read_mesh(tmp_path / "b.stl"), read)


def test_stl_splits_quads_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"a\.stl: STL holds triangles only: 6 quads were split"):
        write_mesh(tmp_path / "a.stl", mesh_of("mixed", False))
    mesh = read_mesh(tmp_path / "a.stl")
    assert (len(mesh.faces[3]), len(mesh.faces[4]), mesh.euler_number) == (8 + 12, 0, 2)


def test_small_unsigned_indices_do_not_overflow(tmp_path):
    vertices, faces = grid(15, 15, "quad", bumpy=0.1)
    write_mesh(tmp_path / "a.obj", Bare(vertices=vertices, normals=None, faces={4: np.array(faces, np.uint8)}))
    assert_same(read_mesh(tmp_path / "a.obj"), ControlMesh(vertices, faces))


def test_a_bare_surface_can_be_written(tmp_path):
    """Anything with the three attributes, in single precision and with one kind of faces."""
    vertices, faces = octahedron()
    surface = Bare(vertices=np.float32(vertices) / 3, normals=None, faces={3: np.array(faces)})
    write_mesh(tmp_path / "a.obj", surface)
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.obj").vertices, np.float32(vertices) / 3)


@settings(max_examples=25, deadline=None)
@given(
    vertices=arrays(np.float64, (9, 3), elements=finite),
    normals=st.none() | arrays(np.float64, (9, 3), elements=finite),
)
def test_every_number_survives(vertices, normals):
    mesh = ControlMesh(vertices, grid(2, 2, "mixed")[1], normals, check=False)
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".obj", ".ply", ".off", ".npz"):
            path = Path(folder, "a" + suffix)
            write_mesh(path, mesh)
            assert_same(read_mesh(path, check=False), mesh)


def shared(name: str) -> Path:
    folder = Path(os.environ.get("JAXSUBDIV_SHARED", Path(__file__).parents[2] / "shared" / "data"))
    if not (folder / name).exists():
        pytest.skip(f"{folder / name} is not there; JAXSUBDIV_SHARED names the folder of the scans")
    return folder / name


@pytest.mark.parametrize(
    ("name", "n_vertices", "n_triangles", "n_quads", "euler_number", "has_normals"),
    [
        ("head_colin27.ply", 30002, 60000, 0, 2, True),
        ("head_fragment_ct.stl", None, 41210, 0, -12, False),
        ("face_laser.vtp", 2205, 4224, 0, 1, False),
        ("cortex_left_colin27.surf.gii", 30002, 60000, 0, 2, False),
        ("control/head_fragment_quad.obj", 165, 0, 140, 1, True),
        ("control/head_quad.obj", 296, 0, 294, 2, True),
        ("control/head_tri.obj", 330, 656, 0, 2, True),
        ("control/head_mixed.obj", 330, 142, 257, 2, True),
        ("control/head_fragment_mixed.obj", 420, 126, 322, 0, True),
        ("control/face_quad.obj", 156, 0, 132, 1, True),
        ("control/femur_tri.obj", 250, 496, 0, 2, True),
        ("control/heart_lv_quad.obj", 105, 0, 96, 0, False),
        ("control/heart_wall_quad.obj", 388, 0, 390, -2, False),
        ("control/cortex_tri.obj", 498, 992, 0, 2, True),
        ("ship/head_fragment.npz", 165, 0, 140, 1, True),
        ("ship/femur_distal.npz", 250, 496, 0, 2, True),
    ],
)
def test_real_meshes(name, n_vertices, n_triangles, n_quads, euler_number, has_normals):
    mesh = read_mesh(shared(name))
    assert len(mesh.vertices) == (n_vertices or len(mesh.vertices))
    assert (len(mesh.faces[3]), len(mesh.faces[4]), mesh.euler_number) == (n_triangles, n_quads, euler_number)
    assert (mesh.normals is not None) == has_normals


@pytest.mark.parametrize(
    ("name", "n_points"),
    [
        ("head_digitised_a.xyz", 3560),
        ("head_fragment_points.npz", 8000),
        ("femur_distal_points.npz", 5000),
        ("heart_guidepoints_a.csv", 15333),
        ("ship/head_fragment.npz", 8000),
        ("ship/femur_distal.npz", 5000),
        ("face_laser.vtp", 2205),
    ],
)
def test_real_points(name, n_points):
    cloud = read_points(shared(name))
    assert cloud.points.shape == (n_points, 3) and cloud.normals is None
    assert (cloud.weights is not None) == name.endswith(".csv")


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".vtk", ".vtp", ".stl"])
def test_peers_read_what_we_write(tmp_path, suffix):
    """meshio and VTK keep quads; of a mesh with normals they must find the same vertices and faces."""
    import meshio
    import pyvista

    mesh = mesh_of("triangles" if suffix == ".stl" else "mixed", True, np.float32)
    write_mesh(tmp_path / f"a{suffix}", mesh)
    if suffix in (".obj", ".ply"):
        peer = meshio.read(tmp_path / f"a{suffix}")
        np.testing.assert_array_equal(peer.points, mesh.vertices)
        np.testing.assert_array_equal(peer.cells_dict["triangle"], mesh.faces[3])
        np.testing.assert_array_equal(peer.cells_dict["quad"], mesh.faces[4])
    peer = pyvista.read(tmp_path / f"a{suffix}")
    assert peer.n_cells == mesh.n_faces
    assert peer.volume == pytest.approx(pyvista.PolyData(mesh.vertices, _flat(mesh)).volume, rel=1e-6)


def _flat(mesh: ControlMesh) -> np.ndarray:
    return np.concatenate([np.insert(block, 0, size, axis=1).ravel() for size, block in mesh.faces.items()])
