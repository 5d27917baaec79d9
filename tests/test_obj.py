"""OBJ: indices and normals in all their forms."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from files import put
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import mixed_closed
from round_trips import SQUARE, UP, assert_same

from jaxsubdiv._io import read_mesh, read_points
from jaxsubdiv._mesh import ControlMesh


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3 4",
        "f 1/5 2/6 3/7 4/8",
        "f 1/5 2 3/6 4",
        "f -4 -3 -2 -1",
        "f -4/1 2 -2/-1 4",
        "f 1 2 \\\n  3 \\\r\n4",
        "\tf  1\t2  3 4  # the top",
        "o top\ng a b\ns off\nusemtl skin\nmtllib a.mtl\nvt 0 0\nf 1 2 3 4\n\nl 1 2\np 1",
    ],
)
def test_obj_index_forms(tmp_path, faces):
    mesh = read_mesh(put(tmp_path, "a.obj", SQUARE + faces + "\n"))
    np.testing.assert_array_equal(mesh.faces[4], [[0, 1, 2, 3]])
    assert mesh.normals is None


@pytest.mark.parametrize(
    "faces", ["f 1//1 2//1 3//1 4//1", "f 1/9/1 2//-1 3/9/-1 4//1", "f -4//1 2//1 3 4\nf 4//1 3//1 1\nf 3 2 1"]
)
def test_obj_corner_normals(tmp_path, faces):
    """One normal for all four vertices, named by at least one corner at each."""
    mesh = read_mesh(put(tmp_path, "a.obj", SQUARE + UP + faces), check=False)
    np.testing.assert_array_equal(mesh.normals, [[0, 0, 1]] * 4)


def test_obj_negative_indices_count_back_from_their_own_line(tmp_path):
    text = SQUARE + "f -4 -3 -2 -1\nv 5 0 0\nv 5 1 0\nf 3 2 -2 -1\n"
    mesh = read_mesh(put(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.faces[4], [[0, 1, 2, 3], [2, 1, 4, 5]])


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_obj_forms_in_any_mixture(data):
    """Every corner in a form of its own gives the same mesh as plain indices."""
    vertices, faces = mixed_closed()
    n = len(vertices)
    forms = st.sampled_from(["{v}", "{v}/3", "{v}//{n}", "{v}/3/{n}", "{w}", "{w}//{m}", "{w}/-1/{n}", "+{v}/+3/+{n}"])

    def corner(i: int) -> str:
        return data.draw(forms).format(v=i + 1, n=i + 1, w=i - n, m=i - n)

    lines = [f"v {x!r} {y!r} {z!r} 1.0" for x, y, z in vertices.tolist()]
    lines += [f"vn {x!r} {y!r} {z!r}" for x, y, z in (vertices / 3).tolist()]
    lines += ["f " + " ".join(map(corner, face)) for face in faces]
    with tempfile.TemporaryDirectory() as folder:
        mesh = read_mesh(put(Path(folder), "a.obj", "\n".join(lines)))
    assert_same(mesh, ControlMesh(vertices, faces, vertices / 3))


def test_obj_shared_and_repeated_normals_stay_exact(tmp_path):
    """Fewer or more `vn` than vertices, one value a vertex: nothing is averaged, nothing warned."""
    normals = "vn 0.1 0.2 0.3\nvn 0 0 2\nvn 0.1 0.2 0.3\n"
    text = SQUARE + normals + "f 1//1 2//2 3//2\nf 1//3 3//2 4//2\n"
    mesh = read_mesh(put(tmp_path, "a.obj", text))
    np.testing.assert_array_equal(mesh.normals, [[0.1, 0.2, 0.3], [0, 0, 2], [0, 0, 2], [0, 0, 2]])


def test_obj_several_normals_give_their_unit_mean(tmp_path):
    normals = "vn 0 0 1\nvn 0 5 0\nvn 0 0 -1\n"
    text = SQUARE + normals + "f 1//1 2//1 3//1\nf 1//2 3//3 4//1\n"
    with pytest.warns(
        UserWarning, match=r"a\.obj: 2 vertices have several different normals \(0, 2, counted from zero\)"
    ):
        mesh = read_mesh(put(tmp_path, "a.obj", text))
    half = np.sqrt(0.5)
    assert mesh.normals is not None
    np.testing.assert_allclose(mesh.normals, [[0, half, half], [0, 0, 1], [0, 0, 0], [0, 0, 1]], atol=1e-15)


def test_obj_missing_normals_are_zero_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"2 vertices have no normal while others have \(1, 3, counted"):
        mesh = read_mesh(put(tmp_path, "a.obj", SQUARE + UP + "f 1//1 2 3//1 4"))
    np.testing.assert_array_equal(mesh.normals, [[0, 0, 1], [0, 0, 0], [0, 0, 1], [0, 0, 0]])


def test_obj_normals_that_no_face_names(tmp_path):
    mesh = read_mesh(put(tmp_path, "a.obj", SQUARE + 4 * UP + "f 1 2 3 4"))
    np.testing.assert_array_equal(mesh.normals, [[0, 0, 1]] * 4)
    with pytest.warns(UserWarning, match="no face names any of the 3 normals; they were left out"):
        assert read_mesh(put(tmp_path, "a.obj", SQUARE + 3 * UP + "f 1 2 3 4")).normals is None


def test_obj_points(tmp_path):
    cloud = read_points(put(tmp_path, "a.obj", SQUARE + 4 * UP))
    assert cloud.points.shape == (4, 3) and cloud.normals is not None
    assert read_points(put(tmp_path, "a.obj", SQUARE + UP)).normals is None


def test_bytes_that_are_not_utf8_do_no_harm(tmp_path):
    mesh = read_mesh(
        put(tmp_path, "a.obj", b"\xef\xbb\xbf# Kopf, J\xfcrgen\n" + SQUARE.encode() + b"o \xff\xfe\nf 1 2 3 4\r\n")
    )
    assert mesh.n_faces == 1
