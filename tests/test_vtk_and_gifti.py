"""VTK, VTP and GIfTI: every encoding, vertex data, and files that are damaged."""

import numpy as np
import pytest
from files import put
from meshes import cube, mixed_closed, octahedron
from round_trips import QUAD, assert_same, mesh_of

from jaxsubdiv._io import read_mesh, read_points, write_mesh
from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError


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
