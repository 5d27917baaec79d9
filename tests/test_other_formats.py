"""Files of neuro-imaging, digitisers, scanners and VTK's grids: read as their own programs do, or refused by name."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from meshes import cube, mixed_closed, octahedron

from fitting import read_scan
from jaxsubdiv import ControlMesh, MeshError, read_mesh, read_points, write_mesh
from jaxsubdiv._io._pcd import unpack_lzf

ROWS = np.random.default_rng(0).normal(scale=0.1, size=(30, 3)).astype(np.float32)
SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)


def put(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def lines(rows) -> str:
    return "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in rows)


def turns(triangles) -> set[tuple[int, ...]]:
    """Triangles as they are turned, whichever corner is named first."""
    return {tuple(np.roll(row, -int(np.argmin(row))).tolist()) for row in np.asarray(triangles)}


# FreeSurfer


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


# GIfTI


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


# glTF


def parts_of(data: bytes) -> tuple[dict, bytes]:
    n = int.from_bytes(data[12:16], "little")
    return json.loads(data[20 : 20 + n]), data[20 + n + 8 :]


def joined(gltf: dict, binary: bytes) -> bytes:
    text = json.dumps(gltf).encode()
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def test_glb_is_read_by_others_in_metres_with_z_up(tmp_path):
    import pyvista
    import trimesh

    vertices, faces = octahedron()
    mesh = ControlMesh(np.float32(vertices * (10, 20, 30)), faces, np.float32(vertices))
    distance = np.array([-1.0, 2, np.nan, 0.5, -0.25, 0])
    write_mesh(tmp_path / "a.glb", mesh, vertex_data={"distance_mm": distance, "region": np.arange(6)})
    own = read_mesh(tmp_path / "a.glb")
    np.testing.assert_array_equal(own.vertices, mesh.vertices)  # mm again, without a word
    np.testing.assert_array_equal(own.faces[3], mesh.faces[3])
    np.testing.assert_allclose(own.normals, vertices, atol=1e-7)
    placed = np.asarray(mesh.vertices)[:, [0, 2, 1]] * (0.001, 0.001, -0.001)
    scene = trimesh.load_scene(tmp_path / "a.glb")
    np.testing.assert_allclose(scene.to_mesh().vertices, placed, atol=1e-9)
    (geometry,) = scene.geometry.values()
    np.testing.assert_array_equal(geometry.vertex_attributes["_REGION"].ravel(), np.arange(6))
    assert geometry.is_watertight and geometry.volume > 0
    (block,) = pyvista.read(tmp_path / "a.glb").recursive_iterator()
    np.testing.assert_allclose(block.points, placed, atol=1e-9)
    np.testing.assert_array_equal(block.point_data["_DISTANCE_MM"], np.nan_to_num(distance))
    np.testing.assert_array_equal(block.point_data["_DISTANCE_MM_KNOWN"], np.isfinite(distance))
    red, green, blue = block.point_data["COLOR_0"][:, :3].T
    assert (red > blue)[[1, 3]].all() and (red < blue)[[0, 4]].all()
    np.testing.assert_allclose((red[2], green[2], blue[2]), 0.214, atol=1e-3)  # grey, as light
    gltf, _ = parts_of((tmp_path / "a.glb").read_bytes())
    extras = gltf["meshes"][0]["extras"]
    assert extras["coloured_by"] == "distance_mm" and extras["first_colour"] == -extras["last_colour"]
    assert all(view["byteOffset"] % 4 == 0 for view in gltf["bufferViews"])


def test_glb_splits_quads_and_says_what_it_rounds(tmp_path):
    vertices, faces = mixed_closed()
    with pytest.warns(UserWarning) as told:
        write_mesh(tmp_path / "a.glb", ControlMesh(vertices / 3, faces))
    words = " ".join(str(one.message) for one in told)
    assert "glTF holds triangles only: 6 quads" in words and "glTF holds single precision" in words
    mesh = read_mesh(tmp_path / "a.glb")
    assert mesh.is_closed and mesh.normals is None


@pytest.mark.parametrize("place", [None, np.diag([2.0, 2, 2, 1])])
def test_glb_of_others_is_read_as_stored(tmp_path, place):
    import trimesh

    box = trimesh.creation.box((0.1, 0.2, 0.3))
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=place)
    path = put(tmp_path, "a.glb", scene.export(file_type="glb"))
    with pytest.warns(UserWarning) as told:
        mesh = read_mesh(path)
    assert any("are in metres as a rule; a scale of 1000" in str(one.message) for one in told)
    assert any("a matrix places its mesh, which was not applied" in str(one.message) for one in told) == (
        place is not None
    )
    np.testing.assert_allclose(mesh.vertices, box.vertices, atol=1e-7)
    assert turns(mesh.faces[3]) == turns(box.faces)
    if place is not None:
        scene.add_geometry(box, transform=place)
        with pytest.raises(MeshError, match=r"it is a scene of 2 meshes, each placed by a matrix\. Make one of them"):
            read_mesh(put(tmp_path, "b.glb", scene.export(file_type="glb")))


def change(*keys, to):
    """The description with another value at a place."""

    def changed(gltf: dict, binary: bytes) -> bytes:
        at = gltf
        for key in keys[:-1]:
            at = at[key]
        at[keys[-1]] = to
        return joined(gltf, binary)

    return changed


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda gltf, binary: b"hello", "does not begin as a binary file of glTF"),
        (lambda gltf, binary: joined(gltf, binary)[:-50], "bytes are announced, but .* follow; it is cut off"),
        (lambda gltf, binary: joined(gltf, binary)[:16], "its first part is not the description"),
        (lambda gltf, binary: joined([] * 3, binary), "stands where an object is expected"),
        (change("accessors", 0, "count", to=10**12), "the accessor 0 announces 1000000000000 times VEC3"),
        (change("accessors", 0, "count", to=-1), "`count` is -1, which is no whole number"),
        (change("accessors", 0, "count", to="6"), "`count` is 6"),
        (change("accessors", 0, "type", to="MAT4"), "of another kind than plain VEC3"),
        (change("accessors", 0, "componentType", to=[1]), "`componentType` is .1., which is no whole number"),
        (change("accessors", 0, "sparse", to={}), "of another kind than plain VEC3"),
        (change("accessors", 0, "bufferView", to=99), "`bufferViews` has no entry 99"),
        (change("bufferViews", 0, "byteStride", to=0), "which its bytes do not hold"),
        (change("bufferViews", 0, "byteOffset", to=10**9), "which its bytes do not hold"),
        (change("bufferViews", 0, "buffer", to=1), "within the file"),
        (change("meshes", 0, "primitives", 0, "mode", to=1), "is drawn in the mode 1"),
        (change("meshes", 0, "primitives", 0, "attributes", to={}), "POSITION"),
        (change("meshes", to=[]), "it holds no meshes"),
        (change("meshes", to=3), "`meshes` is no list"),
        (change("accessors", 1, "count", to=1), "a triangle names the vertex|corners are no triangles"),
        (change("extensionsRequired", to=["KHR_draco_mesh_compression"]), "packed by KHR_draco_mesh_compression"),
    ],
)
def test_glb_that_is_damaged(tmp_path, damage, words):
    vertices, faces = octahedron()
    write_mesh(tmp_path / "sound.glb", ControlMesh(np.float32(vertices), faces))
    path = put(tmp_path, "a.glb", damage(*parts_of((tmp_path / "sound.glb").read_bytes())))
    with pytest.raises(MeshError, match=words) as caught:
        read_mesh(path)
    assert str(caught.value).startswith("a.glb")


def test_glb_refuses_names_that_become_one(tmp_path):
    vertices, faces = octahedron()
    mesh = ControlMesh(np.float32(vertices), faces)
    with pytest.raises(MeshError, match=r"several names that glTF knows as '_A_B'\. Rename 'A b'"):
        write_mesh(tmp_path / "a.glb", mesh, vertex_data={"a-b": np.zeros(6), "A b": np.zeros(6)})
    write_mesh(tmp_path / "a.glb", mesh, vertex_data={"unknown": np.full(6, np.nan), "same": np.ones(6)})


# VTK's grids and strips


@pytest.mark.parametrize("name", ["a.vtu", "text.vtu", "a.vtk", "text.vtk"])
def test_unstructured_grids_of_faces(tmp_path, name):
    import pyvista

    vertices, faces = mixed_closed()
    mesh = ControlMesh(vertices, faces)
    cells = [[2, 0, 1], *([len(face), *face] for face in faces), [3, 0, 1, 2], [4, 0, 1, 3, 2], [4, 0, 1, 2, 3], [1, 5]]
    types = [3, *(5 if len(face) == 3 else 9 for face in faces), 7, 8, 6, 1]
    grid = pyvista.UnstructuredGrid(np.concatenate(cells), np.array(types, np.uint8), np.asarray(vertices, float))
    grid.point_data["Normals"] = vertices / 8
    grid.save(tmp_path / name, binary=not name.startswith("text"))
    read = read_mesh(tmp_path / name, check=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.normals, mesh.vertices / 8)
    np.testing.assert_array_equal(read.faces[3], [*mesh.faces[3], (0, 1, 2), (0, 1, 2), (1, 3, 2)])
    np.testing.assert_array_equal(read.faces[4], [*mesh.faces[4], (0, 1, 2, 3)])
    np.testing.assert_array_equal(read_points(tmp_path / name).points, mesh.vertices)


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk"])
def test_grids_of_volumes_are_refused_by_their_cells(tmp_path, name):
    import pyvista

    pyvista.UnstructuredGrid([4, 0, 1, 2, 3], [10], SQUARE + [(0, 0, 0), (0, 0, 0), (0, 0, 1), (0, 0, 0)]).save(
        tmp_path / name
    )
    with pytest.raises(MeshError, match=r"it holds 1 tetrahedra, .* Take its surface first: pyvista\.read"):
        read_mesh(tmp_path / name)
    assert len(read_points(tmp_path / name).points) == 4


@pytest.mark.parametrize("name", ["a.vtp", "text.vtp", "a.vtk", "text.vtk"])
def test_triangle_strips_are_turned_as_their_triangles(tmp_path, name):
    import pyvista

    sphere = pyvista.Icosphere(nsub=2)
    strip = sphere.strip()
    assert strip.n_strips and strip.n_cells < sphere.n_cells / 2
    strip.points = sphere.points
    strip.save(tmp_path / name, binary=not name.startswith("text"))
    mesh = read_mesh(tmp_path / name)
    assert mesh.is_closed and mesh.euler_number == 2
    assert turns(mesh.faces[3]) == turns(sphere.regular_faces)


VTU = (
    '<VTKFile type="UnstructuredGrid"><UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="1"><Points><DataArray '
)
VTU += 'type="Float32" NumberOfComponents="3" format="ascii">0 0 0 1 0 0 1 1 0 0 1 0</DataArray></Points><Cells>'
VTU += (
    '<DataArray type="Int32" Name="connectivity" format="ascii">{}</DataArray><DataArray type="Int32" Name="offsets" '
)
VTU += 'format="ascii">{}</DataArray>{}</Cells></Piece></UnstructuredGrid></VTKFile>'
TYPES = '<DataArray type="UInt8" Name="types" format="ascii">{}</DataArray>'
VTK = "# vtk DataFile Version 3\n\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n0 0 0 1 0 0 1 1 0 0 1 0\n"
POLYDATA = VTK.replace("UNSTRUCTURED_GRID", "POLYDATA")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.vtu", VTU.format("0 1 2 3", "4", ""), "the element 'Cells' needs the array 'types'"),
        ("a.vtu", VTU.format("0 1 2", "3", TYPES.format(9)), "a cell of 4 corners has 3"),
        ("a.vtu", VTU.format("0 1 2 3", "4", TYPES.format(12)), "it holds 1 hexahedra"),
        ("a.vtu", VTU.format("0 1 2 3", "4", TYPES.format(200)), "it holds 1 cells of the type 200"),
        ("a.vtu", VTU.format("", "-4", TYPES.format(9)), "do not ascend"),
        ("a.vtu", VTU.format("0 1", "2", TYPES.format(6)), "triangle strip 0, counted from zero, has 2 corners"),
        ("a.vtu", VTU.format("0 1 2 3 0", "5", TYPES.format(7)), "neither triangles nor quads"),
        ("a.vtu", VTU.replace("UnstructuredGrid", "ImageData"), "it holds a ImageData"),
        ("a.vtk", VTK + "CELLS 1 5\n4 0 1 2 3\n", "it has 1 CELLS, but 0 CELL_TYPES"),
        ("a.vtk", VTK + "CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 9000000000\n9\n", "9000000000 numbers are announced"),
        ("a.vtk", VTK + "CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n", "it holds 1 tetrahedra"),
        ("a.vtk", POLYDATA + "TRIANGLE_STRIPS 1 3\n2 0 1\n", "triangle strip 0, counted from zero, has 2 corners"),
        ("a.vtk", POLYDATA + "TRIANGLE_STRIPS 1 4\n3 0 1 9\n", "use vertex indices >= 4"),
        ("a.vtk", VTK, "it holds points but no faces"),
    ],
)
def test_grids_that_are_damaged(tmp_path, name, content, words):
    with pytest.raises(MeshError, match=words) as caught:
        read_mesh(put(tmp_path, name, content))
    assert str(caught.value).startswith(name)


# Point clouds of PCL

PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ normal_x normal_y normal_z rgb\nSIZE 4 4 4 1 4 4 4 4\n"
PCD += "TYPE F F F U F F F U\nCOUNT 1 1 1 4 1 1 1 1\nWIDTH 30\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 30\nDATA {}\n"
RECORD = np.dtype([("at", "<f4", 3), ("gap", "u1", 4), ("up", "<f4", 3), ("rgb", "<u4")])


def packed(data: bytes) -> bytes:
    """LZF with runs as they are, and of what came before where three bytes repeat."""
    found, at, plain = bytearray(), 0, bytearray()

    def put_plain() -> None:
        for i in range(0, len(plain), 32):
            part = plain[i : i + 32]
            found.extend(bytes([len(part) - 1]) + part)
        plain.clear()

    while at < len(data):
        before = data.rfind(data[at : at + 3], max(at - 8000, 0), at + 2)
        n = 0
        while 0 <= before and n < 264 and at + n < len(data) and data[before + n] == data[at + n]:
            n += 1
        if n < 3:
            plain.append(data[at])
            at += 1
            continue
        put_plain()
        back = at - before - 1
        length = bytes([(min(n - 2, 7) << 5) | back >> 8]) + (bytes([n - 9]) if n >= 9 else b"")
        found.extend(length + bytes([back & 255]))
        at += n
    put_plain()
    return bytes(found)


def pcd(form: str) -> bytes:
    table = np.zeros(30, RECORD)
    table["at"], table["up"], table["rgb"] = ROWS, -ROWS, 7
    table["at"][3] = np.nan
    head = PCD.format(form).encode()
    if form == "ascii":
        return head + b"".join(
            (" ".join(f"{v:.9g}" for v in (*row["at"], 0, 0, 0, 0, *row["up"], row["rgb"])) + "\n").encode()
            for row in table
        )
    if form == "binary":
        return head + table.tobytes()
    columns = (
        [table["at"][:, i] for i in range(3)] + [table["gap"]] + [table["up"][:, i] for i in range(3)] + [table["rgb"]]
    )
    data = b"".join(np.ascontiguousarray(column).tobytes() for column in columns)
    small = packed(data)
    return head + struct.pack("<II", len(small), len(data)) + small


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_in_every_form(tmp_path, form):
    with pytest.warns(UserWarning, match="1 of 30 points are not finite"):
        cloud = read_points(put(tmp_path, "a.pcd", pcd(form)))
    kept = np.delete(ROWS, 3, axis=0)
    np.testing.assert_allclose(cloud.points, kept, rtol=1e-8)
    np.testing.assert_allclose(cloud.normals, -kept, rtol=1e-8)


@pytest.mark.parametrize("data", [b"", b"a", b"abcabcabcabc" * 50, bytes(3000), bytes(range(256)) * 3])
def test_lzf_gives_what_was_packed(data):
    assert unpack_lzf(packed(data), len(data)) == data


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda data: data.replace(b"DATA binary\n", b""),
            "line 11: the header has no line 'DATA'|no meaning in a PCD",
        ),
        (lambda data: data.replace(b"POINTS 30", b"POINTS 3000000000"), "3000000000 points are announced, but 30 are"),
        (lambda data: data.replace(b"POINTS 30", b"POINTS -3"), "POINTS must be a whole number"),
        (lambda data: data.replace(b"FIELDS x y", b"FIELDS x u"), "its fields must have x, y and z"),
        (lambda data: data.replace(b"SIZE 4", b"SIZE 3"), "'x' has the type F of 3 bytes"),
        (lambda data: data.replace(b"COUNT 1", b"COUNT 2"), "its fields must have x, y and z, one number each"),
        (lambda data: data.replace(b"TYPE F F", b"TYPE F"), "must have a word for each field"),
        (lambda data: data.replace(b"DATA binary", b"DATA zip"), "DATA one of ascii, binary"),
        (lambda data: data[:-1], "30 points are announced, but 29 are there"),
        (lambda data: b"hello\n" + data, "line 1: 'hello' has no meaning in a PCD header"),
        (lambda data: pcd("binary_compressed")[:-9], "bytes follow. The file is cut off"),
        (lambda data: pcd("binary_compressed")[:-9] + bytes(9), "where 960 are announced|ends? within|before the"),
        (lambda data: pcd("ascii") + b"1 2 3\n", "line 42: a point needs 11 numbers"),
        (lambda data: pcd("ascii").replace(b"POINTS 30", b"POINTS 31"), "31 points are announced, but 30 are there"),
    ],
)
def test_pcd_that_is_damaged(tmp_path, change, words):
    with pytest.raises(MeshError, match=words) as caught:
        read_points(put(tmp_path, "a.pcd", change(pcd("binary"))))
    assert str(caught.value).startswith("a.pcd")


@pytest.mark.parametrize(
    ("data", "n"), [(b"\xff\xff\xff", 264), (b"\x20", 3), (b"\x05abc", 6), (b"\0a", 99), (b"\0a", 2)]
)
def test_lzf_that_is_damaged(data, n):
    with pytest.raises(ValueError, match=r"cannot unpack|within a run|before the first|are announced"):
        unpack_lzf(data, n)


def test_pcd_names_a_viewpoint_that_it_does_not_apply(tmp_path):
    data = pcd("binary").replace(b"VIEWPOINT 0 0", b"VIEWPOINT 0 1")
    with pytest.warns(UserWarning) as told:
        read_points(put(tmp_path, "a.pcd", data))
    assert any("VIEWPOINT of the sensor, which was not applied" in str(one.message) for one in told)


# Points as text


@pytest.mark.parametrize("count", ["", "30\n"])
def test_points_of_leica_with_intensity_and_colours(tmp_path, count):
    others = np.random.default_rng(1).integers(0, 255, (30, 4)) - [2000, 0, 0, 0]
    with pytest.warns(UserWarning, match=r"columns 4, 5, 6, 7 left out"):
        cloud = read_points(put(tmp_path, "a.pts", count + lines(np.hstack([ROWS.astype(float), others]))))
    np.testing.assert_allclose(cloud.points, ROWS, rtol=1e-6)
    assert cloud.normals is None


@pytest.mark.parametrize("name", ["digitised.pts", "a_local.particles", "a_world.particles"])
def test_bare_points(tmp_path, name):
    np.testing.assert_allclose(read_points(put(tmp_path, name, lines(ROWS))).points, ROWS, rtol=1e-6)


def test_points_of_leica_that_are_cut_off(tmp_path):
    with pytest.raises(MeshError, match=r"a\.pts: the first row announces 31 rows, but 30 follow"):
        read_points(put(tmp_path, "a.pts", "31\n" + lines(ROWS)))


GUIDE_POINTS = "x\ty\tz\tcontour type\tframeID\tweight\ttime frame\n1\t2\t3\tSAX_LV_ENDOCARDIAL\t2\t1.0\t0\n"
GUIDE_POINTS += "4\t5\t6\tSAX_RV_SEPTUM\t2\t0.5\t0\n7\t8\t9\tLAX_LV_ENDOCARDIAL\t11\t0.5\t{}\n"


def test_guide_points_of_biv_me_have_labels_slices_and_weights(tmp_path):
    scan = read_scan(put(tmp_path, "GPFile_000.txt", GUIDE_POINTS.format(0)), labels="LV_ENDO")
    np.testing.assert_array_equal(scan.points, [(1, 2, 3), (7, 8, 9)])
    np.testing.assert_array_equal(scan.slices, [2, 11])
    np.testing.assert_array_equal(scan.weights, [1, 0.5])
    with pytest.warns(UserWarning, match="the column 'time frame' has 2 different values: points of several moments"):
        read_scan(put(tmp_path, "GPFile_000.txt", GUIDE_POINTS.format(1)))


# Digitisers

HEAD = (
    "//Position of fiducials X+, Y+, Y- on the subject\n%F\t0.11\t0\t0\n%F\t-0.003\t0.0786\t0\n%F\t0.003\t-0.0801\t0\n"
)
SHAPE = "3\t200\n//Shape file\n//Minor revision number\n2\n//Subject Name\n%N\tName    \n////Shape code, number of "
SHAPE += (
    f"digitized points\n0\t30\n{HEAD}//No of rows, no of columns; position of digitized points\n30\t3\n{lines(ROWS)}"
)
FIDUCIALS = [(0.11, 0, 0), (-0.003, 0.0786, 0), (0.003, -0.0801, 0)]
PROBE = "3\t2\n//Probe file\n//Minor revision number\n1\n//ProbeName\n%N\tName\n//Probe type, number of sensors\n0\t2\n"
PROBE += (
    "//Position of fiducials X+, Y+, Y- on the subject\n%F\t0.11\t0\t0\n%F\t-0.003\t0.0786\t0\n%F\t0.003\t-0.0801\t0\n"
)
PROBE += (
    "//Sensor type\n%S\t4000\n//Sensor name and data for sensor # 1\n%N\tRED  \n0.09\t-0.01\t0.02\n%S\t4000\n%N\tBLUE\n"
)
PROBE += "-0.09\t1e-2\t0.03\n"
POS = "3\n1 4.5 6.1 7.8\n2 1 2 3\n3 4 5 6\nnasion 10.5 0 0\n"


def test_head_shapes_of_a_digitiser(tmp_path):
    with pytest.warns(
        UserWarning, match=r"a\.hsp: \.hsp files are in metres as a rule; a scale of 1000 takes these to mm"
    ):
        cloud = read_points(put(tmp_path, "a.hsp", SHAPE))
    np.testing.assert_allclose(cloud.points, [*FIDUCIALS, *ROWS], rtol=1e-6)
    np.testing.assert_allclose(
        read_scan(tmp_path / "a.hsp", scale=1000.0, labels="head").points, 1000 * ROWS, rtol=1e-6
    )
    np.testing.assert_allclose(read_scan(tmp_path / "a.hsp", scale=1000.0, labels="nasion").points, [(110, 0, 0)])


def test_probes_of_a_digitiser(tmp_path):
    path = put(tmp_path, "a.elp", PROBE)
    np.testing.assert_allclose(read_points(path, scale=1000).points[3:], [(90, -10, 20), (-90, 10, 30)])
    np.testing.assert_allclose(read_scan(path, scale=1000.0, labels="blue").points, [(-90, 10, 30)], rtol=1e-6)
    with pytest.warns(UserWarning, match=r"\.elp files are in metres"):
        np.testing.assert_allclose(read_points(path).points[:3], FIDUCIALS)


@pytest.mark.parametrize(
    "text", [POS, POS.replace("3\n1", "4\n1"), POS.removeprefix("3\n"), "1 E1 1 2 3\n2 E2 4 5 6\n"]
)
def test_places_of_a_digitiser(tmp_path, text):
    path = put(tmp_path, "a.pos", text)
    with pytest.warns(UserWarning, match=r"\.pos files are in centimetres as a rule; a scale of 10 takes"):
        points = read_points(path).points
    np.testing.assert_allclose(points[:2], [(4.5, 6.1, 7.8), (1, 2, 3)] if len(points) == 4 else [(1, 2, 3), (4, 5, 6)])
    label = "nasion" if len(points) == 4 else "E2"
    np.testing.assert_allclose(read_scan(path, scale=10.0, labels=label).points, 10 * points[-1:])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.hsp", SHAPE[:-20], "line 44: .* should be three numbers|30 points are announced, but 29 follow"),
        ("a.hsp", SHAPE.replace("30\t3\n", "200000000\t3\n"), "200000000 points are announced, but 30 follow"),
        ("a.hsp", SHAPE.replace("30\t3\n", "30\t4\n"), "line 14: the number of points must stand here"),
        ("a.hsp", SHAPE.replace("%F\t0.11", "%F\tnose"), "line 10: 'nose 0 0' should be three numbers"),
        ("a.hsp", SHAPE.partition("30\t3")[0], "line 14: the number of points"),
        ("a.hsp", SHAPE.partition("\n30\t3")[0], "line 14: the number of points"),
        ("a.hsp", lines(ROWS), "line 1: a head shape of a Polhemus digitiser begins with '3 200'"),
        ("a.elp", "EEG Fp1 -92 -72\n", "line 1: .* angles of BESA give no positions"),
        ("a.elp", PROBE + "1 2 3 4\n", "line 21: '1 2 3 4' should be three numbers"),
        ("a.elp", "3\t2\n", "it holds no points"),
        ("a.pos", POS + "1 2 3\n", "line 6: 3 words, where a number or a name"),
        ("a.pos", POS + "5 1 2 x\n", "line 6: '1 2 x' should be three numbers"),
        ("a.pos", "9" + POS, "93 points are announced, but 4 follow"),
    ],
)
def test_files_of_a_digitiser_that_are_damaged(tmp_path, name, content, words):
    with pytest.raises(MeshError, match=words) as caught:
        read_points(put(tmp_path, name, content), scale=1000)
    assert str(caught.value).startswith(name)


@pytest.mark.parametrize("name", ["a.pcd", "a.pts", "a.hsp", "a.elp", "a.pos", "a.particles"])
def test_points_are_no_mesh(tmp_path, name):
    with pytest.raises(MeshError, match=r"files hold points without faces. Read it with `read_points`"):
        read_mesh(put(tmp_path, name, "hello"))


def test_cube_for_good_measure(tmp_path):
    """Quads as VTK's own grid of them, from a program that names no normals."""
    import pyvista

    vertices, faces = cube()
    grid = pyvista.PolyData(np.asarray(vertices, float), np.concatenate([[4, *face] for face in faces]))
    grid.cast_to_unstructured_grid().save(tmp_path / "a.vtu")
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.vtu").faces[4], faces)
