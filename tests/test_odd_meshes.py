"""Meshes with faces and bytes of other programs: each is read, or refused by what it is."""

from pathlib import Path

import numpy as np
import pytest
from files import put
from odd_files import FIVE, FREESURFER, LINES, PLY, SQUARE, XML, table

from jaxsubdiv import MeshError, read_mesh, read_points


def case(name: str) -> Path:
    """A file of others that is not ours to copy."""
    path = Path(__file__).parents[2] / "shared" / "cases" / name
    if not path.exists():
        pytest.skip(f"{path} is not there: it belongs to others, and lies beside the checkout where it is at hand")
    return path


PENTAGONS = {
    "a.obj": "".join(f"v {line}\n" for line in LINES.splitlines()) + "f 1 2 3 4 5\nf 1 2\n",
    "a.off": f"OFF\n5 1 0\n{LINES}5 0 1 2 3 4\n",
    "a.ply": f"{PLY}{LINES}5 0 1 2 3 4\n",
    "a.vtk": f"# vtk DataFile Version 3\n\nASCII\nDATASET POLYDATA\nPOINTS 5 float\n{LINES}POLYGONS 1 6\n5 0 1 2 3 4\n",
    "a.vtp": XML,
}


@pytest.mark.parametrize("name", PENTAGONS)
def test_faces_do_not_matter_for_points(tmp_path, name):
    path = put(tmp_path, name, PENTAGONS[name])
    np.testing.assert_array_equal(read_points(path).points, FIVE)
    with pytest.raises(MeshError, match=r"a face of 5 corners|neither triangles nor quads"):
        read_mesh(path)


def test_normals_of_corners_survive_odd_faces_and_are_left_out_with_damaged_ones(tmp_path):
    text = PENTAGONS["a.obj"].split("f ")[0] + "vn 0 0 2\n"
    cloud = read_points(put(tmp_path, "a.obj", text + "f 1//1 2//1 3//1 4//1 5//1\n"))
    np.testing.assert_array_equal(cloud.normals, [(0, 0, 2)] * 5)
    with pytest.warns(UserWarning, match="the normals were left out, since the faces do not say whose they are"):
        assert read_points(put(tmp_path, "a.obj", text + "f 1//1 2//7 3\n")).normals is None


def test_stl_with_bytes_after_its_last_triangle(tmp_path):
    facet = np.zeros(2, [("numbers", "<f4", 12), ("attributes", "<u2")])
    facet["numbers"][:, 3:] = [(0, 0, 0, 1, 0, 0, 0, 1, 0), (1, 0, 0, 1, 1, 0, 0, 1, 0)]
    data = b"solid by a scanner".ljust(80) + (2).to_bytes(4, "little") + facet.tobytes()
    with pytest.warns(UserWarning, match=r"a\.stl: 2 bytes after the last of 2 triangles were left out"):
        assert read_mesh(put(tmp_path, "a.stl", data + b"\r\n")).n_faces == 2
    with pytest.raises(MeshError, match="as binary STL it should hold 2 triangles in 184 bytes, but it has 150"):
        read_mesh(put(tmp_path, "a.stl", data[:150]))


def test_stl_of_text_with_lines_after_its_end(tmp_path):
    corners = "".join(f"vertex {x} {y} {z}\n" for x, y, z in SQUARE[:3])
    text = f"solid a\nfacet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\nendsolid a\n"
    with pytest.warns(UserWarning, match=r"a\.stl: 1 lines after the last 'endsolid' were left out"):
        assert read_mesh(put(tmp_path, "a.stl", text + "\x1a")).n_faces == 1


MNI = "P 0.3 0.3 0.4 10 1 4\n" + "".join(f" {x:g} {y:g} {z:g}\n" for x, y, z in SQUARE)
MNI_REST = "\n" + 4 * " 0 0 1\n" + "\n 2\n {}\n\n 3 6\n\n 0 1 2 0 2 3\n"


@pytest.mark.parametrize("colours", ["0 1 1 1 1", "1" + 2 * " 1 0 0 1", "2" + 4 * "\n 1 0 0 1"])
def test_mni_surface_is_read(tmp_path, colours):
    mesh = read_mesh(put(tmp_path, "a.obj", MNI + MNI_REST.format(colours)))
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces[3], [(0, 1, 2), (0, 2, 3)])
    np.testing.assert_array_equal(mesh.normals, [(0, 0, 1)] * 4)


def test_mni_surface_that_is_cut_off_or_binary_is_named(tmp_path):
    path = put(tmp_path, "a.obj", MNI)
    np.testing.assert_array_equal(read_points(path).points, SQUARE)
    with pytest.raises(MeshError, match="a surface of the MNI tools that ends before the number of polygons"):
        read_mesh(path)
    for n, words in (("2000000000", "announces 2e.09 vertices, but has 18 numbers"), ("-1", "announces -1 vertices")):
        with pytest.raises(MeshError, match=words):
            read_points(put(tmp_path, "a.obj", MNI.replace("1 4\n", f"1 {n}\n")))
    with pytest.raises(MeshError, match=r"a binary surface of the MNI tools. Turn it into text with `ascii_binary`"):
        read_points(put(tmp_path, "a.obj", b"p" + bytes(40)))


def test_freesurfer_surface_of_text(tmp_path):
    path = put(tmp_path, "lh.white.asc", FREESURFER)
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces[3], [(0, 1, 2), (0, 2, 3)])
    np.testing.assert_array_equal(read_points(path).points, SQUARE)
    cut = put(tmp_path, "cut.asc", FREESURFER[:-10])
    np.testing.assert_array_equal(read_points(cut).points, SQUARE)
    with pytest.raises(MeshError, match=r"cut\.asc: 2 faces are announced, but 1 rows follow"):
        read_mesh(cut)
    with pytest.raises(MeshError, match=r"a\.asc: it holds points without faces, or no FreeSurfer surface"):
        read_mesh(put(tmp_path, "a.asc", table(SQUARE)))


def test_freesurfer_surface_of_others():
    mesh = read_mesh(case("lh.pial.asc"))
    assert (len(mesh.vertices), mesh.n_faces, mesh.is_closed) == (250, 496, True)
