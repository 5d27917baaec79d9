"""Files of neuro-imaging, read as their own programs do, or refused by name."""

import struct
from pathlib import Path

import numpy as np
import pytest
from files import put
from meshes import mixed_closed, octahedron

from fitting import read_scan
from jaxsubdiv import ControlMesh, MeshError, read_mesh, read_points, write_mesh


def freesurfer(path: Path, c_ras=(0.0, 0.0, 0.0), valid="1  # volume info valid") -> Path:
    from nibabel.freesurfer import write_geometry

    vertices, faces = octahedron()
    info = {"head": np.array([2, 0, 20]), "valid": valid, "filename": "a.mgz", "volume": np.array([256, 256, 256])}
    info |= {"voxelsize": np.ones(3), "xras": np.eye(3)[0], "yras": np.eye(3)[1], "zras": np.eye(3)[2]}
    write_geometry(path, vertices / 3, np.array(faces), "by nobody", info | {"cras": np.array(c_ras)})
    return path


@pytest.mark.parametrize("name", ["lh.white", "rh.pial", "lh.inflated", "lh.sphere.reg", "lh", "a.surf"])
def test_surfaces_of_freesurfer_whatever_their_names(tmp_path, name):
    vertices, faces = octahedron()
    mesh = read_mesh(freesurfer(tmp_path / name))
    np.testing.assert_array_equal(mesh.vertices, np.float32(vertices / 3))
    np.testing.assert_array_equal(mesh.faces[3], faces)
    np.testing.assert_array_equal(read_points(tmp_path / name).points, mesh.vertices)
    assert read_scan(tmp_path / name).faces is not None


def test_surfaces_of_freesurfer_say_where_their_image_lies(tmp_path):
    with pytest.warns(UserWarning, match=r"coordinates are surface RAS, as stored\. .* c_ras = \(1\.5, 0, -2\)"):
        mesh = read_mesh(freesurfer(tmp_path / "lh.white", (1.5, 0, -2)))
    np.testing.assert_array_equal(mesh.vertices, np.float32(octahedron()[0] / 3))
    read_mesh(freesurfer(tmp_path / "lh.orig", (1.5, 0, -2), valid="0  # volume info invalid"))
    data = (tmp_path / "lh.white").read_bytes().replace(struct.pack(">3i", 2, 0, 20), struct.pack(">3i", 2, 1, 20))
    read_mesh(put(tmp_path, "lh.scanner", data))  # coordinates that are scanner RAS already


def test_surfaces_of_freesurfer_without_the_blank_line(tmp_path):
    data = freesurfer(tmp_path / "lh.white").read_bytes().replace(b"\n\n", b"\n", 1)
    assert read_mesh(put(tmp_path, "lh.pial", data)).n_faces == 8


@pytest.mark.parametrize("name", ["lh.white", "a.surf"])
def test_surfaces_of_freesurfer_are_written_as_its_own_programs_read_them(tmp_path, name):
    from nibabel.freesurfer import read_geometry

    vertices, faces = mixed_closed()
    mesh = ControlMesh(vertices / 3, faces)
    with pytest.warns(UserWarning) as told:
        write_mesh(tmp_path / name, mesh)
    words = " ".join(str(one.message) for one in told)
    assert "FreeSurfer holds triangles only: 6 quads were split" in words
    assert "FreeSurfer holds single precision: coordinates were rounded, by up to" in words
    found, triangles = read_geometry(tmp_path / name)
    np.testing.assert_array_equal(found, np.float32(mesh.vertices))
    assert len(triangles) == len(mesh.faces[3]) + 12
    read = read_mesh(tmp_path / name)
    np.testing.assert_array_equal(read.faces[3], triangles)
    assert read.is_closed


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:100], r"lh\.white, byte 14: 6 vertices and 8 triangles are announced, .* its 100 bytes"),
        (lambda data: data.replace(b"\n\n\0\0\0", b"\n\n\x7f\xff\xff"), "2147483398 vertices"),
        (lambda data: data.replace(b"\n\n\0\0\0", b"\n\n\xff\xff\xff"), "cut off or damaged"),
        (lambda data: b"\xff\xff\xff" + data[3:], "a surface of quads, .* mris_convert .*; or values on a surface"),
        (lambda data: b"hello", r"FF FF FE\. It is of another format, or damaged"),
        (lambda data: data[:9], "are announced"),
    ],
)
def test_surfaces_of_freesurfer_that_are_damaged(tmp_path, change, words):
    path = put(tmp_path, "lh.white", change(freesurfer(tmp_path / "sound").read_bytes()))
    with pytest.raises(MeshError, match=words):
        read_mesh(path)


def test_measurements_go_beside_a_surface_of_gifti(tmp_path):
    import nibabel

    vertices, faces = octahedron()
    mesh = ControlMesh(vertices, faces)
    data = {"distance": np.array([0.5, -1, np.nan, 2, 3, 4]), "region": np.arange(6)}
    write_mesh(tmp_path / "a.surf.gii", mesh)
    write_mesh(tmp_path / "a.shape.gii", mesh, vertex_data=data)
    arrays = nibabel.load(tmp_path / "a.shape.gii").darrays
    assert [array.meta["Name"] for array in arrays] == list(data)
    for array, values in zip(arrays, data.values(), strict=True):
        assert array.intent == nibabel.nifti1.intent_codes["NIFTI_INTENT_SHAPE"]
        np.testing.assert_array_equal(array.data, np.float32(values))
    assert len(nibabel.load(tmp_path / "a.surf.gii").darrays) == 2  # as Connectome Workbench wants it
    with pytest.raises(MeshError, match=r"it holds 0 point sets .*\(\.func\.gii, \.label\.gii\) go with a \.surf\.gii"):
        read_mesh(tmp_path / "a.shape.gii")
    with pytest.raises(MeshError, match=r"a\.surf\.gii: \.gii files hold no vertex data\. Write .*\.shape\.gii"):
        write_mesh(tmp_path / "a.surf.gii", mesh, vertex_data=data)
    with pytest.raises(MeshError, match=r"b\.shape\.gii: such files hold vertex data alone\."):
        write_mesh(tmp_path / "b.shape.gii", mesh)
