"""Files that cannot be read or written: each is refused by name, and what was there stays."""

import stat
import struct
import subprocess
import sys
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from files import put
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import cube, octahedron
from round_trips import FACE, QUAD, SQUARE, UP, XYZ, Bare, assert_same, mesh_of, ply

from jaxsubdiv import _io
from jaxsubdiv._io import read_mesh, read_points, write_mesh
from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError

BINARY = "ply\nformat binary_little_endian 1.0\n"
STL_TEXT = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex {}\nendloop\nendfacet\n"
PENTAGON = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv -1 1 0\n"
ASCII_PLY = ply("ascii", [("vertex", XYZ, QUAD), ("face", FACE, [[[0, 1, 2, 3]]])]).decode()
LITTLE_PLY = ply("binary_little_endian", [("vertex", XYZ, QUAD), ("face", FACE, [[[0, 1, 2, 3]], [[0, 2, 1]]])])
SOUND = [
    ("a.obj", SQUARE + UP + "f 1/2/1 -3//-1 3 \\\n 4//1\nf 1 2 3\n"),
    (
        "a.off",
        "NOFF 4 1 0\n" + "".join(f"{x} {y} 0 0 0 1\n" for x, y in ("00", "10", "11", "01")) + "4 0 1 2 3 255 0 0\n",
    ),
    ("a.ply", ASCII_PLY),
    ("a.ply", LITTLE_PLY),
    ("a.ply", ply("binary_big_endian", [("camera", ["list uchar float k"], [[[1.0]], [[]]]), ("vertex", XYZ, QUAD)])),
    ("a.stl", STL_TEXT.format("0 1 0") + "endsolid\n"),
    ("a.stl", bytes(80) + struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)),
    ("a.csv", 'z,label,y,weight,x\n2,"LV, ENDO",1.5,0.5,0\n5,,4,2,3\n'),
    ("a.xyz", "# a\n0 1.5 2 1 0 0\n3 4 5 0 2 0\n"),
]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.obj", SQUARE + "v 1 2\nf 1 2 3", "line 5: 'v' must be followed by three numbers"),
        ("a.obj", SQUARE + "v\nf 1 2 3", "line 5: 'v' must be followed by three numbers"),
        ("a.obj", "# a\n" + SQUARE + "v 1 2 tree\nf 1 2 3", r"a\.obj, line 6: 'tree' is not a number"),
        ("a.obj", SQUARE + UP + "vn 0 1\nf 1 2 3", "line 6: 'vn' must be followed by three numbers"),
        ("a.obj", PENTAGON + "f 1 2 3\n\nf 1 2 3 4 5\nf 1 2", "line 8, 9: a face of 5 corners. Split larger faces"),
        ("a.obj", SQUARE + "f", "line 5: a face of 0 corners"),
        ("a.obj", SQUARE + "f 1 2 3\nf 1 x 3", "line 6: 'x' is no corner of a face. Corners are written a, a/b"),
        ("a.obj", SQUARE + "f 1 2/1/ 3", "line 5: '2/1/' is no corner of a face"),
        ("a.obj", SQUARE + "f 1/2/3/4 2 3", "line 5: '1/2/3/4' is no corner of a face"),
        ("a.obj", SQUARE + "f 1.5 2 3", "line 5: '1.5' is no corner of a face"),
        ("a.obj", SQUARE + "f /1 2 3", "line 5: '/1' is no corner of a face"),
        ("a.obj", SQUARE + "f 1 2 3\x00", r"line 5: '3.x00' is no corner of a face"),
        ("a.obj", SQUARE + "f 1 2 " + 400 * "3", "line 5: '33333+' is no corner of a face"),
        ("a.obj", SQUARE + "v 1 2 3\x001\nf 1 2 3", r"line 5: '3.x001' is not a number"),
        ("a.obj", SQUARE + "f 1 2 3\nf 0 1 2\nf 3 4 5", "line 6, 7: a face uses the index 0 among 4 'v'"),
        ("a.obj", SQUARE + "f -5 2 3", "line 5: a face uses the index -5 among 4 'v' lines"),
        ("a.obj", SQUARE + UP + "f 1//1 2//2 3//1", "line 6: a face uses the index 2 among 1 'vn' lines"),
        ("a.obj", "hello\n", "it holds points but no faces"),
        ("a.off", "4 1 0\n", "line 1: an OFF file begins with OFF or NOFF"),
        ("a.off", "4OFF\n4 1 0\n", "line 1: 4OFF has vertices of more than three dimensions"),
        ("a.off", "nOFF\n4 1 0\n", "nOFF has vertices of more than three dimensions"),
        ("a.off", "OFF\n\n", "after OFF the numbers of vertices, faces and edges must follow"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "line 2: 3 vertices and 1 faces are announced, but 3"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "line 4: a vertex needs 3 numbers"),
        ("a.off", "NOFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "line 3: a vertex needs 6 numbers"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "line 6: a face of 3 corners needs as many"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 1.5\n", "vertex index 1.5, which is not a whole number"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", r"face 0 use vertex indices >= 3"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 # 1 0\n3 0 1 2\n", "line 5: a vertex needs 3 numbers"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0x10\n3 0 1 2\n", "line 5: '0x10' is not a number"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 1_0\n3 0 1 2\n", "line 5: '1_0' is not a number"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 nan\n3 0 1 2\n", r"a\.off: vertices 2 have coordinates that are not"),
        ("a.off", "OFF\n5 2 0\n" + "0 0 0\n" * 5 + "5 0 1 2 3 4\n2 0 1\n",
         r"faces 0, 1, counted from zero, are neither triangles nor quads \(face 0 has 5 corners\)"),
        ("a.ply", "solid\n", "line 1: a PLY file begins with the line 'ply'"),
        ("a.ply", "ply\nformat ascii 1.0\n", "the header has no line 'end_header'"),
        ("a.ply", "ply\nelement vertex 0\nend_header\n", "the header has no line 'format'. Known are ascii"),
        ("a.ply", "ply\nformat binary 1.0\nend_header\n", "line 2: 'format binary 1.0' has no meaning in a PLY header"),
        ("a.ply", BINARY + "property float x\nend_header\n", "line 3: 'property float x' has no meaning"),
        ("a.ply", BINARY + "element vertex 1\nproperty real x\nend_header\n", "line 4: 'property real x' has no"),
        ("a.ply", BINARY + "element vertex 0\nproperty float x\nproperty int x\nend_header\n", "'vertex' has two"),
        ("a.ply", BINARY + "element point 0\nend_header\n", "there is no element 'vertex'"),
        ("a.ply", BINARY + "element vertex 2\nend_header\n\n\n", "element 'vertex' needs the properties x, y and z"),
        ("a.ply", ASCII_PLY[:-10], "the header announces 1 rows of 'face', but only 0 are there"),
        ("a.ply", ASCII_PLY.replace("4 0 1 2 3", "4 0 1 2"), r"line 16: .* 'face' should have 5 .* but has 4"),
        ("a.ply", ASCII_PLY.replace("4 0 1 2 3", "nan 0 1 2"), "line 16: a row of 'face' should have 1 numbers"),
        ("a.ply", ASCII_PLY.replace("4 0 1 2 3", "4 0 1 2 inf"), "vertex index inf, which is not a whole number"),
        ("a.ply", ASCII_PLY.replace("4 0 1 2 3", "2 0 1"), r"faces 0, counted from zero, .* \(face 0 has 2 corners\)"),
        ("a.ply", ASCII_PLY.replace("1.0 1.0 0.0", "1.0 1.0 a"), "line 14: 'a' is not a number"),
        ("a.ply", LITTLE_PLY[:-1], "announces 2 rows of 'face', but the file ends before the last"),
        ("a.ply", LITTLE_PLY[:-14], "announces 2 rows of 'face', but the file ends before the last"),
        ("a.ply", LITTLE_PLY[:-40], "announces 4 rows of 'vertex', but the file ends before the last"),
        ("a.ply", LITTLE_PLY.replace(b"vertex 4", b"vertex 9999999999999"), "announces 9999999999999 rows of"),
        ("a.ply", LITTLE_PLY.replace(b"list uchar", b"list char").replace(b"\x03" + bytes(4), b"\xff" + bytes(4)),
         "announces 2 rows of 'face', but the file ends"),
        ("a.ply", ply("ascii", [("vertex", XYZ, QUAD), ("face", ["int vertex_index"], [[3]])]), "points but no faces"),
        ("a.stl", "hello", "it should begin with 'solid'. The file is cut off or of another format"),
        ("a.stl", bytes(80) + b"\x02\x00\x00\x00" + bytes(99), "should hold 2 triangles in 184 bytes, but it has 183"),
        ("a.stl", bytes(80) + b"\x01" + bytes(27) + b"\x01\x00\x80\x7f" + bytes(22), "vertices 1 have coordinates"),
        ("a.stl", STL_TEXT.format("0 1") + "endsolid", "line 6: 'vertex' must be followed by three numbers"),
        ("a.stl", STL_TEXT.format("") + "endsolid", "line 6: 'vertex' must be followed by three numbers"),
        ("a.stl", STL_TEXT.format("0 1 a") + "endsolid", "line 6: 'a' is not a number"),
        ("a.stl", STL_TEXT.format("0 1 0"), "1 facets with 3 corners up to line 8, .* closing 'endsolid' are expected"),
        ("a.stl", "solid a\nfacet\nvertex 0 0 0\nendsolid", "1 facets with 1 corners up to line 4"),
        ("a.stl", "solid a\nendsolid", "it holds points but no faces"),
        ("a.gii", "<a/>", "it is XML of 'a' and not of 'GIFTI'"),
        ("a.gii", "hello", "it cannot be read as XML"),
        ("a.gii", '<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="0"></GIFTI>', "it holds 0 point sets"),
        ("a.npz", "hello", "it begins neither as an .npz nor as an .npy file"),
        ("a.xyz", "0 0 0", r"\.xyz files hold points without faces. Read it with `read_points`"),
    ],
)  # fmt: skip
def test_meshes_that_cannot_be_read(tmp_path, name, content, words):
    with pytest.raises(MeshError, match=words) as caught:
        read_mesh(put(tmp_path, name, content))
    assert str(caught.value).startswith(name)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.data())
def test_damage_raises_nothing_else(data):
    """Cut, changed or with something put in, a file reads or is refused; nothing else comes through."""
    name, content = data.draw(st.sampled_from(SOUND))
    content = bytearray(content.encode() if isinstance(content, str) else content)
    at = data.draw(st.integers(0, len(content) - 1))
    until = data.draw(st.sampled_from([at, at + 1, at + 7, len(content)]))
    content[at:until] = data.draw(
        st.binary(max_size=4) | st.sampled_from([b"-", b"/", b" 0 ", b"1e999", b"\n", b"\\\n"])
    )
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of normals that do not fit
        with suppress(MeshError):
            read_points(put(Path(folder), name, bytes(content) or b"0"))


@pytest.mark.parametrize(
    ("saved", "read", "words"),
    [
        ({"points": np.zeros((4, 2))}, read_points, r"`points` must be .* shape \[n, 3\]; got float64 .* \[4, 2\]"),
        ({"points": np.zeros((4, 3)), "normals": np.zeros((3, 3))}, read_points, r"`normals` must be .* \[4, 3\]"),
        ({"points": np.zeros((4, 3)), "weights": np.zeros((4, 1))}, read_points, r"`weights` must be .* shape \[4\]"),
        ({"points": np.zeros((0, 3))}, read_points, "it holds no points"),
        ({"scan": np.zeros((4, 3))}, read_points, "the array `points` is missing, .* It has scan"),
        ({"points": np.zeros((4, 3))}, read_mesh, r"needs the arrays .* It has points\. Read it with `read_points`"),
        ({}, read_mesh, "a mesh needs the arrays .* It has none"),
        ({"vertices": np.zeros((4, 3))}, read_mesh, "it holds points but no faces"),
        ({"vertices": np.zeros((4, 3)), "faces": np.zeros((4, 5), int)}, read_mesh, r"whole numbers .* \[4, 5\]"),
        ({"vertices": np.zeros((4, 3)), "faces": np.zeros((4, 3))}, read_mesh, "must be whole numbers .* got float64"),
        ({"points": np.array([None])}, read_points, "the array 'points': it holds objects, where plain numbers are"),
        ({"points": np.array(["2020-01-01"], "M8[D]")}, read_points, "the array 'points': it holds dates"),
        ({"vertices": np.zeros((4, 3), complex)}, read_mesh, "the array 'vertices': it holds complex numbers"),
        ({"vertices": np.zeros((4, 3)), "normals": np.full((4, 3), "a")}, read_mesh, "'normals': it holds text"),
        ({"vertices": np.zeros(4, "f4,f4")}, read_mesh, "the array 'vertices': it holds '"),
    ],
)  # fmt: skip
def test_npz_that_cannot_be_read(tmp_path, saved, read, words):
    np.savez(tmp_path / "a.npz", **saved)
    with pytest.raises(MeshError, match=words):
        read(tmp_path / "a.npz")


def test_npz_of_one_bare_array_is_no_mesh(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 3)))
    with pytest.raises(MeshError, match=r"\.npy files hold points without faces"):
        read_mesh(tmp_path / "a.npy")
    (tmp_path / "a.npy").rename(tmp_path / "a.npz")
    with pytest.raises(MeshError, match=r"it holds one array without a name"):
        read_mesh(tmp_path / "a.npz")


def test_gifti_of_two_surfaces_or_with_a_transform(tmp_path):
    from nibabel.gifti import gifti

    vertices, faces = octahedron()
    point_set = gifti.GiftiDataArray(np.float32(vertices), "NIFTI_INTENT_POINTSET")
    triangles = gifti.GiftiDataArray(np.array(faces, np.int32), "NIFTI_INTENT_TRIANGLE")
    image = gifti.GiftiImage(darrays=[point_set, point_set, triangles])
    with pytest.raises(MeshError, match=r"a\.gii: it holds 2 point sets and 1 triangle arrays; one of each"):
        read_mesh(put(tmp_path, "a.gii", image.to_bytes()))
    point_set.coordsys = gifti.GiftiCoordSystem(0, 1, np.diag([2.0, 2, 2, 1]))
    image = gifti.GiftiImage(darrays=[point_set, triangles])
    with pytest.warns(UserWarning, match=r"a\.gii: it carries a coordinate transform, which was not applied"):
        mesh = read_mesh(put(tmp_path, "a.gii", image.to_bytes()))
    np.testing.assert_array_equal(mesh.vertices, vertices)


@pytest.mark.parametrize("read", [read_mesh, read_points])
def test_files_that_are_not_there_or_unknown(tmp_path, read):
    with pytest.raises(FileNotFoundError, match=r"no such file: .*a\.obj"):
        read(tmp_path / "a.obj")
    with pytest.raises(MeshError, match=r"this is a folder. Name a file in it"):
        read(tmp_path)
    with pytest.raises(MeshError, match=r"a\.obj: the file is empty"):
        read(put(tmp_path, "a.obj", ""))
    with pytest.raises(
        MeshError,
        match=r"a\.fbx: the suffix '\.fbx' is not known\. Meshes: \.obj, .*\.asc, .*\. Points, besides: .*\.csv",
    ):
        read(put(tmp_path, "a.fbx", "a"))


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("a.fbx", MeshError, r"the suffix '\.fbx' is not known"),
        ("a.xyz", MeshError, r"\.xyz files hold points without faces\. Meshes go to \.obj"),
        (".", MeshError, "this is a folder"),
        ("none/a.obj", FileNotFoundError, "the folder does not exist, create it first: .*none"),
    ],
)
def test_places_that_cannot_be_written(tmp_path, name, error, words):
    with pytest.raises(error, match=words):
        write_mesh(tmp_path / name, ControlMesh(*cube()))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vertices": np.full((8, 3), np.nan)}, r"a\.obj: vertices 0, 1, 2, 3, 4 \(\+3 more\), .* are not finite"),
        ({"vertices": np.zeros((2, 8, 3))}, r"`vertices` must be .* shape \[n, 3\]; got float64 .* \[2, 8, 3\]"),
        ({"normals": np.zeros((7, 3))}, r"`normals` must be numbers of the shape \[8, 3\]"),
        ({"faces": {4: np.array([[0, 1, 2, 8]])}}, "nothing is written, since .* outside of its 8 vertices"),
        ({"faces": {}}, "nothing is written, since the mesh has no faces"),
        ({"faces": {5: np.zeros((1, 5), int)}}, r"`faces` must be whole numbers, \{3: \[t, 3\], 4: \[q, 4\]\}"),
        ({"faces": {3: np.zeros((1, 3))}}, "`faces` must be whole numbers"),
        ({"faces": {3: np.zeros((1, 4), int)}}, "`faces` must be whole numbers"),
    ],
)  # fmt: skip
def test_meshes_that_cannot_be_written(tmp_path, change, words):
    mesh = ControlMesh(*cube())
    surface = {"vertices": mesh.vertices, "normals": None, "faces": mesh.faces} | change
    with pytest.raises(MeshError, match=words):
        write_mesh(tmp_path / "a.obj", Bare(**surface))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".obj", ".off", ".stl", ".gii", ".glb", ".surf"])
def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"a{suffix}"
    mesh = mesh_of("triangles", False, np.float32)
    write_mesh(path, mesh)
    old = path.read_bytes()

    def stop_halfway(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        assert len(list(tmp_path.iterdir())) == 2
        raise OSError("no space left")

    monkeypatch.setattr(Path, "write_bytes", stop_halfway)
    with pytest.raises(OSError, match="no space left"):
        write_mesh(path, ControlMesh(mesh.vertices * 2, mesh.faces))
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_a_failing_vtk_writer_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.vtp"
    write_mesh(path, mesh_of("mixed", False))
    old = path.read_bytes()
    monkeypatch.setattr(_io._vtk, "watch", lambda act: (act() and 0, "ERROR: Ran out of disk space"))
    with pytest.raises(OSError, match=r"a\.vtp: VTK could not write the file: ERROR: Ran out"):
        write_mesh(path, mesh_of("quads", False))
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_links_and_permissions_stay(tmp_path):
    (tmp_path / "real").mkdir()
    real, link = tmp_path / "real" / "a.obj", tmp_path / "link.obj"
    write_mesh(real, mesh_of("quads", False))
    real.chmod(0o640)
    link.symlink_to(real)
    write_mesh(link, mesh_of("mixed", False))
    assert link.is_symlink() and stat.S_IMODE(real.stat().st_mode) == 0o640
    assert_same(read_mesh(real), mesh_of("mixed", False))


@pytest.mark.parametrize(("module", "suffix"), [("pyvista", ".vtp"), ("pyvista", ".vtk"), ("nibabel.gifti", ".gii")])
def test_a_missing_library_is_named(tmp_path, monkeypatch, module, suffix):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match="pip install 'jaxsubdiv\\[io\\]'"):
        write_mesh(tmp_path / f"b{suffix}", mesh_of("triangles", False, np.float32))
    assert not (tmp_path / f"b{suffix}").exists()


def test_import_loads_no_heavy_library():
    code = "import sys, {}; print(*(m for m in sys.argv[1:] if m in sys.modules))"
    extras = ["pyvista", "vtkmodules", "nibabel", "meshio", "matplotlib", "tqdm", "pyacvd", "rustworkx"]
    for package, heavy in (("jaxsubdiv._io", ["trimesh", "scipy", *extras]), ("fitting, fitting.command.main", extras)):
        command = [sys.executable, "-c", code.format(package), *heavy]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stdout.split() == [], package
