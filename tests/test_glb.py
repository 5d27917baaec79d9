"""glTF: metres with z up, and files of others."""

import json
import struct

import numpy as np
import pytest
from files import put
from meshes import mixed_closed, octahedron, turns

from jaxsubdiv import ControlMesh, MeshError, read_mesh, write_mesh


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
