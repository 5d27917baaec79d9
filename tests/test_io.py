"""Reading and writing: round trips bit for bit, the dialects of every format, and every refusal by its words."""

import os
import stat
import struct
import subprocess
import sys
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from meshes import cube, grid, mixed_closed, octahedron, two_components

from jaxsubdiv import _io, tables
from jaxsubdiv._io import PointCloud, read_mesh, read_points, write_mesh
from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError

SUFFIXES = (".obj", ".ply", ".off", ".vtp", ".vtk", ".npz")
"""Formats that hold everything a mesh has."""

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


def put(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# Round trips


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


finite = st.floats(allow_nan=False, allow_infinity=False)


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


# OBJ

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UP = "vn 0 0 1\n"


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


# PLY

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


PLY_KINDS = ("ascii", "binary_little_endian", "binary_big_endian")
XYZ = ["double x", "double y", "double z"]
QUAD = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 1 / 3]]
FACE = ["list uchar int vertex_indices"]


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


# VTK, STL, OFF, NPZ


@pytest.mark.parametrize("suffix", [".ply", ".vtp", ".vtk"])
def test_vertex_data_is_kept(tmp_path, suffix):
    import meshio
    import pyvista

    mesh = mesh_of("mixed", True)
    n = len(mesh.vertices)
    distance = np.random.default_rng(1).normal(size=n)
    distance[3] = np.nan
    data = {
        "distance": distance,
        "label": np.arange(n),
        "half": np.arange(n, dtype=np.float16),
        "single": distance.astype(np.float32),
        "inside": distance > 0,
        "byte": np.arange(n, dtype=np.uint8),
    }
    write_mesh(tmp_path / f"a{suffix}", mesh, vertex_data=data)
    assert_same(read_mesh(tmp_path / f"a{suffix}"), mesh)
    peer = meshio.read if suffix == ".ply" else pyvista.read  # VTK's PLY reader drops what it does not know
    kept = peer(tmp_path / f"a{suffix}").point_data
    for name, column in data.items():
        np.testing.assert_array_equal(kept[name], column, err_msg=name)


@pytest.mark.parametrize(
    ("suffix", "data", "words"),
    [
        (".obj", {"d": np.zeros(8)}, r"a\.obj: \.obj files hold no vertex data\. Write \.ply, \.vtp, \.vtk"),
        (".npz", {"d": np.zeros(8)}, "hold no vertex data"),
        (".ply", {"d": np.zeros(7)}, r"`vertex_data\['d'\]` must be one number a vertex, shape \[8\]; got .* \[7\]"),
        (".ply", {"d": np.array(["a"] * 8)}, "must be one number a vertex"),
        (".ply", {"two words": np.zeros(8)}, "'two words'; PLY needs one ASCII word"),
        (".ply", {"nx": np.zeros(8)}, "'nx'; PLY needs one ASCII word other than x, y, z"),
        (".ply", {"d": np.full(8, 2**40)}, r"`vertex_data\['d'\]` has integers beyond the 32 bits of PLY"),
        (".surf", {"d": np.zeros(8)}, r"hold no vertex data\. Write \.ply, \.vtp, \.vtk, \.glb, \.shape\.gii"),
        (".vtp", {"Normals": np.zeros(8)}, "'Normals', which the normals of the mesh take"),
    ],
)  # fmt: skip
def test_vertex_data_that_cannot_be_kept(tmp_path, suffix, data, words):
    mesh = ControlMesh(*cube())
    with pytest.raises(MeshError, match=words):
        write_mesh(tmp_path / f"a{suffix}", mesh, vertex_data=data)
    assert list(tmp_path.iterdir()) == []


def test_vtk_normals_under_another_name_and_ascii(tmp_path):
    import pyvista

    vertices, faces = mixed_closed()
    polydata = pyvista.PolyData(vertices, np.concatenate([[len(face), *face] for face in faces]))
    polydata.point_data["up"] = vertices / 8
    polydata.point_data.active_normals_name = "up"
    polydata.field_data["names"] = ["a", "of a scan" * 20]
    polydata.cell_data["Normals"] = np.ones((len(faces), 3))
    for suffix in (".vtp", ".vtk"):
        for binary in (False, True):
            polydata.save(tmp_path / f"a{suffix}", binary=binary)
            assert_same(read_mesh(tmp_path / f"a{suffix}"), ControlMesh(vertices, faces, vertices / 8))


@pytest.mark.parametrize("packer", ["None", "ZLib", "LZMA", "LZ4"])
@pytest.mark.parametrize("mode", ["Ascii", "Binary", "Appended"])
@pytest.mark.parametrize("header", ["UInt32", "UInt64"])
def test_vtp_in_every_encoding(tmp_path, packer, mode, header):
    import pyvista
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    vertices, faces = mixed_closed()
    polydata = pyvista.PolyData(np.tile(vertices, (200, 1)), np.concatenate([[len(face), *face] for face in faces]))
    writer = vtkXMLPolyDataWriter()
    writer.SetFileName(str(tmp_path / "a.vtp"))
    writer.SetInputData(polydata)
    getattr(writer, f"SetDataModeTo{mode}")()
    getattr(writer, f"SetCompressorTypeTo{packer}")()
    getattr(writer, f"SetHeaderTypeTo{header}")()
    writer.SetBlockSize(1024)
    for encode in (False, True) if mode == "Appended" else (True,):
        writer.SetEncodeAppendedData(encode)
        writer.SetByteOrder(int(encode))
        writer.Write()
        if packer == "LZ4" and mode != "Ascii":
            with pytest.raises(MeshError, match=r"it is packed by vtkLZ4DataCompressor. Save it with zlib"):
                read_mesh(tmp_path / "a.vtp")
            continue
        assert_same(read_mesh(tmp_path / "a.vtp"), ControlMesh(np.tile(vertices, (200, 1)), faces))


def test_gifti_in_every_encoding(tmp_path):
    from nibabel.gifti import gifti

    vertices, faces = octahedron()
    for encoding in ("ASCII", "B64BIN", "B64GZ"):
        for order in ("RowMajorOrder", "ColumnMajorOrder"):
            arrays = [
                gifti.GiftiDataArray(np.float32(vertices), "NIFTI_INTENT_POINTSET", encoding=encoding, ordering=order),
                gifti.GiftiDataArray(np.array(faces, np.int32), "NIFTI_INTENT_TRIANGLE", encoding=encoding),
            ]
            path = put(tmp_path, "a.gii", gifti.GiftiImage(darrays=arrays).to_bytes())
            assert_same(read_mesh(path), ControlMesh(vertices, faces))


@pytest.mark.parametrize("suffix", [".vtp", ".vtk"])
def test_vtk_that_is_damaged_or_something_else(tmp_path, suffix, capfd):
    import pyvista

    with pytest.raises(MeshError, match=rf"a\{suffix}.*(cannot be read as XML|begins with '# vtk DataFile Version')"):
        read_mesh(put(tmp_path, f"a{suffix}", "hello"))
    write_mesh(tmp_path / f"b{suffix}", mesh_of("mixed", True))
    whole = (tmp_path / f"b{suffix}").read_bytes()
    with pytest.raises(MeshError, match=rf"b\{suffix}.*(cannot be read as XML|file is cut off)"):
        read_mesh(put(tmp_path, f"b{suffix}", whole[: len(whole) // 2]))
    quoted = whole.replace(b"POLYGONS", b"P\xffLYGONS").replace(b"<Polys", b"<\xffolys")
    with pytest.raises(MeshError, match=rf"c\{suffix}.*(cannot be read as XML|no faces)"):
        read_mesh(put(tmp_path, f"c{suffix}", quoted))
    pyvista.PolyData(np.array(QUAD)).save(tmp_path / f"d{suffix}")
    assert len(read_points(tmp_path / f"d{suffix}").points) == 4
    assert capfd.readouterr().err == ""  # what VTK says is in the error


def test_vtk_of_another_kind(tmp_path):
    import pyvista

    pyvista.ImageData(dimensions=(2, 2, 2)).save(tmp_path / "a.vtk")
    with pytest.raises(MeshError, match=r"it holds a STRUCTURED_POINTS, not faces. Take its surface first"):
        read_mesh(tmp_path / "a.vtk")


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


# Points as text


@pytest.mark.parametrize(
    ("text", "has_normals", "has_weights"),
    [
        ("0 1.5 2\n3 4 5\n", False, False),
        ("# a\n  0\t1.5   2 # b\r\n\r\n3 4 5", False, False),
        ("0,1.5, 2\n3,4,5\n", False, False),
        ("0; 1.5;2\n3;4;5\n", False, False),
        ("0 1.5 2\r3 4 5\r", False, False),
        ("0;1,5;2\n3;4;5\n", False, False),
        ("0,0 1,5 2,0\n3,0 4,0 5,0\n", False, False),
        ("2\n0 1.5 2\n3 4 5\n", False, False),
        ("// a comment\n; another\n0 1.5 2\n3 4 5\n", False, False),
        ("//X Y Z Nx Ny Nz\n0 1.5 2 1 0 0\n3 4 5 0 2 0\n", True, False),
        ("x [mm] y [mm] z [mm] nx ny nz\n0 1.5 2 1 0 0\n3 4 5 0 2 0\n", True, False),
        ("x (mm);y (mm);z (mm)\n0;1,5;2\n3;4;5\n", False, False),
        (
            '"Point ID","Points:0","Points:1","Points:2","Normals:0","Normals:1","Normals:2"\n0,0,1.5,2,1,0,0\n'
            "1,3,4,5,0,2,0\n",
            True,
            False,
        ),
        ("x\ty\tz\tcontour type\tslice\n0\t1.5\t2\tLV ENDO\t0\n3\t4\t5\tLV ENDO\t0\n", False, False),
        ('x,y,z,label\n0,1.5,2,"#1"\n3,4,5,"a\nb, c"\n', False, False),
        ("x,y,z,label\n0,1.5,2,#1\n3,4,5,#2\n", False, False),
        (";x;y;z\n0;0;1,5;2\n1;3;4;5\n", False, False),
        ("x,y,z,nx,ny,nz\n0,1.5,2,1,0,0\n3,4,5,0,2,0\n", True, False),
        ("X Y Z\n0 1.5 2\n3 4 5\n", False, False),
        ("z,label,y,weight,x\n2,LV ENDO,1.5,0.5,0\n5,,4,2,3\n", False, True),
        ('"x";"y";"z";"name"\n0;1.5;2;"a;b"\n3;4;5;c\n', False, False),
        ("\ufeffnx,ny,nz,x,y,z,weight\n1,0,0,0,1.5,2,0.5\n0,2,0,3,4,5,2\n", True, True),
    ],
)
@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".txt", ".ASC"])
def test_point_tables(tmp_path, suffix, text, has_normals, has_weights):
    cloud = read_points(put(tmp_path, "a" + suffix, text))
    np.testing.assert_array_equal(cloud.points, [[0, 1.5, 2], [3, 4, 5]])
    assert (cloud.normals is not None, cloud.weights is not None) == (has_normals, has_weights)
    if has_normals:
        np.testing.assert_array_equal(cloud.normals, [[1, 0, 0], [0, 2, 0]])
    if has_weights:
        np.testing.assert_array_equal(cloud.weights, [0.5, 2])


@settings(max_examples=25, deadline=None)
@given(arrays(np.float64, st.tuples(st.integers(1, 5), st.sampled_from([3, 6])), elements=finite))
def test_point_tables_keep_every_digit(rows):
    with tempfile.TemporaryDirectory() as folder:
        for separator in (" ", ",", ";", "\t"):
            names = separator.join(("x", "y", "z", "nx", "ny", "nz")[: rows.shape[1]])
            text = "\n".join([names, *(separator.join(map(repr, row)) for row in rows.tolist())])
            cloud = read_points(put(Path(folder), "a.xyz", text))
            np.testing.assert_array_equal(cloud.points, rows[:, :3])
            assert (cloud.normals is None) == (not rows[:, 3:].any())
            if cloud.normals is not None:
                np.testing.assert_array_equal(cloud.normals, rows[:, 3:])


CELLS = [
    *("1", "+2.", "-.5", "1e3", "nan", "-inf", "1 ", "0x10", "1_0", "1d5", "1,5", "", " ", "\t", "\x0c3", "3\x0b", "."),
    *("1e400", "1e-400", "4\x00", "\x1c5", "abc", "1+2j", "1e", "--1", "1.#QNAN", "-", "NA", "7\r", '"8"', "9#", "//"),
]


def test_plain_tables_are_read_as_any_others(tmp_path, monkeypatch):
    read_plain, n_plain = tables._plain_numbers, 0

    def outcome() -> tuple:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                contents = _io._table.read(tmp_path / "a.csv")
                words = None
            except MeshError as error:
                contents, words = _io._table.Contents(np.zeros((0, 3))), str(error)
        arrays = [None if values is None else values.tolist() for values in (*contents[:1], *contents[2:4])]
        return repr(arrays), contents.texts, words, [str(warning.message) for warning in told]

    for seed in range(400):
        rng = np.random.default_rng(seed)
        n, delimiter = rng.integers(3, 8), rng.choice([" ", ",", ";", "\t", "  ", ", "])
        rows = [[f"{value:.3g}" for value in row] for row in rng.normal(size=(rng.integers(1, 5), n))]
        if seed % 3:
            rows[rng.integers(len(rows))][rng.integers(n)] = str(rng.choice(CELLS))
        if seed % 5 < 2:
            rows.insert(0, ["x", "y", "z", "nx", "ny", "nz", "weight"][:n])
        if seed % 7 == 0:
            rows.insert(0, [str(rng.integers(1, 5))])
        put(tmp_path, "a.csv", "\n".join(delimiter.join(row) for row in rows) + "\n" * int(rng.integers(3)))
        monkeypatch.setattr(tables, "_plain_numbers", lambda *_: None)
        expected = outcome()
        monkeypatch.setattr(tables, "_plain_numbers", read_plain)
        assert outcome() == expected, seed
        n_plain += tables.read_table(tmp_path / "a.csv")._plain is not None if expected[2] is None else 0
    assert n_plain > 100


# Refusals

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
    ("content", "words"),
    [
        ("# nothing\n\n", r"a\.csv: it has no line of numbers"),
        ("x y z\n", r"a\.csv: it holds no points"),
        ("# a\n1 2\n", r"a\.csv, line 2: 2 columns. A point needs at least x, y and z"),
        ("a,b,c\n1,2,3\n", "line 1: a header row must name x, y and z, .* this one has a, b, c"),
        ("x,y,z,nx\n1,2,3,4\n", "must name x, y and z, all of nx, ny, nz or none, and none twice"),
        ("x,y,z,x\n1,2,3,4\n", "must name x, y and z, all of nx, ny, nz or none, and none twice"),
        ("1 2 3\n\n1 2 3 4\n", "line 3: 4 columns, where the first row has 3"),
        ("x,y,z,l\n1,2,3,a\n1,2,3\n", "line 3: 3 columns, where the first row has 4"),
        ("1,2,3\n1,b,3\n", "line 2: 'b' is not a number. Write decimals with a point"),
        ("1;2,5;3\n1;2.5;3\n", "line 1: the column has both commas and points. Write decimals with a point"),
        ("x,y,z\n1,,3\n", "it holds no points. All 1 rows have coordinates that are not finite"),
        ("250\n1 2 3\n4 5 6\n", "the first row announces 250 rows, but 2 follow. The file is cut off"),
        ('x,y,z,l\n1,2,3,"a\n', "line 2: the row cannot be parsed .*Close its quotes"),
        ("x,y,z\n1,5,2,5,3,5\n", "line 2: 6 columns, where the first row has 3. Write decimals with a point"),
        ("1,257,-29,868,12,079\n2,257,-29,868,12,079\n", "6 columns of whole numbers, .*: decimal commas, it seems"),
        ("1 2 3\n1 2 3_0\n", "line 2: '3_0' is not a number"),
        ("1,2,3\n1,2,3" + 200000 * "3" + ",4\n", "line 2: the row cannot be parsed .field larger"),
        ("1 2 3\n1 2 \uff13\n", "line 2: '\uff13' is not a number"),
    ],
)
def test_point_tables_that_cannot_be_read(tmp_path, content, words):
    with pytest.raises(MeshError, match=words):
        read_points(put(tmp_path, "a.csv", content))


def test_whole_numbers_in_named_columns_are_what_the_names_say(tmp_path):
    cloud = read_points(put(tmp_path, "a.csv", "x,y,z,nx,ny,nz\n1,257,-29,868,12,79\n"))
    np.testing.assert_array_equal(cloud.normals, [(868, 12, 79)])


def test_not_finite_points_are_named_by_row(tmp_path):
    points = np.zeros((9, 3))
    points[[2, 5], 1] = np.nan
    np.savez(tmp_path / "a.npz", points=points, weights=np.arange(9.0))
    with pytest.warns(UserWarning, match=r"a\.npz: 2 of 9 points are not finite \(rows 2, 5, .*they were dropped"):
        np.testing.assert_array_equal(read_points(tmp_path / "a.npz").weights, [0, 1, 3, 4, 6, 7, 8])
    np.savez(tmp_path / "a.npz", points=np.zeros((2, 3)), normals=[(0, 0, 1), (0, 0, np.nan)])
    with pytest.warns(UserWarning, match="1 of 2 normals are not finite; these points count as without one"):
        np.testing.assert_array_equal(read_points(tmp_path / "a.npz").normals, [(0, 0, 1), (0, 0, 0)])
    np.savez(tmp_path / "a.npz", points=np.zeros((2, 3)), weights=[np.inf, 1])
    with pytest.raises(MeshError, match="weights 0, counted from zero, are not finite"):
        read_points(tmp_path / "a.npz")


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


# Safe writing


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


# Libraries


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


# Files of others


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
