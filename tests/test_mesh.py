"""ControlMesh: the forms that it takes, what it says of itself, and every refusal by its words."""

import numpy as np
import pytest
from meshes import (
    Mesh,
    cube,
    fan,
    grid,
    icosahedron,
    mixed_closed,
    octahedron,
    tetrahedron,
    torus,
    two_components,
)

from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


@pytest.mark.parametrize(
    ("mesh", "euler_number", "n_open"),
    [
        (tetrahedron(), 2, 0),
        (octahedron(), 2, 0),
        (icosahedron(), 2, 0),
        (cube(), 2, 0),
        (mixed_closed(), 2, 0),
        (fan(3), 2, 0),
        (fan(9), 2, 0),
        (two_components(), 4, 0),
        (torus(5, 3, "quad"), 0, 0),
        (torus(5, 3, "triangle"), 0, 0),
        (torus(4, 6, "mixed"), 0, 0),
        (grid(3, 2, "quad"), 1, 10),
        (grid(3, 2, "triangle", bumpy=0.3), 1, 10),
        (grid(4, 4, "mixed", bumpy=0.3, seed=1), 1, 16),
    ],
)
def test_topology(mesh: Mesh, euler_number: int, n_open: int):
    made = ControlMesh(*mesh)
    assert made.euler_number == euler_number
    assert len(made.boundary_edges) == n_open
    assert made.is_closed == (n_open == 0)
    assert made.n_faces == len(mesh[1])


def test_boundary_edges_of_one_face():
    mesh = ControlMesh(SQUARE, [(0, 1, 2, 3)])
    np.testing.assert_array_equal(mesh.boundary_edges, [(0, 1), (0, 3), (1, 2), (2, 3)])


# ---------------------------------------------------------------------------------------------------------- input forms


def test_forms_of_faces_are_equal():
    vertices, faces = mixed_closed()
    triangles = np.array([f for f in faces if len(f) == 3])
    quads = np.array([f for f in faces if len(f) == 4], dtype=np.uint8)
    forms = [
        faces,
        [np.array(f) for f in faces],
        [list(f) for f in reversed(faces)][::-1],
        (triangles, quads),
        [quads, triangles],
        {3: triangles, 4: quads},
        {4: quads.tolist(), 3: triangles.tolist()},
    ]
    for form in forms:
        mesh = ControlMesh(vertices, form)
        np.testing.assert_array_equal(mesh.faces[3], triangles)
        np.testing.assert_array_equal(mesh.faces[4], quads)
        assert mesh.faces[3].dtype == mesh.faces[4].dtype == np.int32
        assert mesh.vertices.dtype == np.float64
        assert mesh.normals is None
        assert mesh.repairs == ()


@pytest.mark.parametrize("form", [np.array, list, lambda faces: {len(faces[0]): faces}])
@pytest.mark.parametrize("mesh", [cube(), octahedron()])
def test_faces_of_one_size(mesh: Mesh, form):
    vertices, faces = mesh
    made = ControlMesh(vertices.tolist(), form(faces))
    size = len(faces[0])
    np.testing.assert_array_equal(made.faces[size], faces)
    assert made.faces[7 - size].shape == (0, 7 - size)


def test_an_empty_part_of_a_pair():
    vertices, faces = cube()
    for empty in (np.zeros((0, 3), int), np.array([])):
        np.testing.assert_array_equal(ControlMesh(vertices, (empty, np.array(faces))).faces[4], faces)


def test_unused_vertices_and_components_are_legal():
    vertices, faces = two_components()
    mesh = ControlMesh(np.concatenate([vertices, [(9, 9, 9), (9, 9, 9)]]), faces)
    assert len(mesh.vertices) == len(vertices) + 2
    assert mesh.euler_number == 4


def test_vertices_where_two_cones_touch_are_legal():
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)]
    assert ControlMesh(vertices, [(0, 1, 2), (0, 3, 4)]).n_faces == 2


def test_arrays_are_copies_that_cannot_be_written():
    vertices, faces = np.array(SQUARE, dtype=float), np.array([(0, 1, 2, 3)], dtype=np.int32)
    normals = np.tile([0.0, 0, 1], (4, 1))
    mesh = ControlMesh(vertices, faces, normals)
    vertices[:], faces[:], normals[:] = 7, 7, 7
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces[4], [(0, 1, 2, 3)])
    assert mesh.normals is not None
    np.testing.assert_array_equal(mesh.normals[:, 2], 1)
    for array in (mesh.vertices, mesh.normals, mesh.faces[3], mesh.faces[4]):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_text_of_a_mesh():
    vertices, faces = mixed_closed()
    assert repr(ControlMesh(vertices, faces)) == "ControlMesh(12 vertices, 8 triangles, 6 quads, no normals)"
    assert repr(ControlMesh(vertices, faces, vertices)).endswith("6 quads, normals)")


def test_zero_normals_are_legal():
    assert ControlMesh(SQUARE, [(0, 1, 2, 3)], np.zeros((4, 3))).normals is not None


# ------------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("vertices", "normals", "words"),
    [
        ([(0, 0), (1, 0), (0, 1)], None, r"`vertices` must be rows of three coordinates.*got shape \[3, 2\]"),
        ([0, 1, 2], None, r"`vertices`.*got shape \[3\]"),
        (SQUARE, [(0, 0)] * 4, r"`normals` must be rows.*\[4, 2\]"),
    ],
)
def test_shapes_of_rows(vertices, normals, words: str):
    with pytest.raises(MeshError, match=words):
        ControlMesh(vertices, [(0, 1, 2)], normals, check=False)


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        (
            [(0, 1, 2), (0, 1), (0, 1, 2, 3, 1)],
            r"faces 1, 2 are neither triangles nor quads \(face 1 has 2 corners\)\. Split",
        ),
        ([0, 1, 2], r"faces 0, 1, 2 are neither .*\(face 0 has 1 corners\)"),
        (np.array([(0, 1, 2, 3, 1)]), r"must be arrays \[t, 3\] or \[q, 4\]; got shapes \[\[1, 5\]\]. Split larger"),
        (np.array([0, 1, 2]), r"must be arrays .*got shapes \[\[3\]\]"),
        ((np.zeros((1, 3), int), np.zeros((2, 5), int)), r"got shapes \[\[1, 3\], \[2, 5\]\]"),
        ({3: [(0, 1, 2)], 5: []}, r"the keys \[3, 5\]; only 3 \(triangles\) and 4 \(quads\)"),
        ({4: [(0, 1, 2)]}, r"faces of 4 corners must have the shape \[n, 4\]; got \[1, 3\]"),
        (np.array([(0.0, 1.0, 2.0)]), r"faces must hold whole numbers.*got dtype float64"),
        ([(0, 1, 1.5)], r"faces must hold whole numbers"),
        ([(0, 1, 2**31)], r"beyond 32 bits"),
        ([(0, 1, -(2**40))], r"beyond 32 bits"),
    ],
)
def test_shapes_of_faces(faces, words: str):
    with pytest.raises(MeshError, match=words):
        ControlMesh(SQUARE, faces, check=False)


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        ([], [], r"the mesh is empty: 0 vertices, 0 faces"),
        (SQUARE, [], r"the mesh is empty: 4 vertices, 0 faces\..*`read_points`"),
        (SQUARE, np.array([]), r"the mesh is empty"),
        (SQUARE, {}, r"the mesh is empty"),
        (np.zeros((0, 3)), [(0, 1, 2)], r"the mesh is empty: 0 vertices, 1 faces"),
        ([*SQUARE[:3], (0, np.nan, 0)], [(0, 1, 2)], r"vertices 3 have coordinates that are not finite"),
        ([(np.inf, 0, 0), *SQUARE[1:]], [(0, 1, 2)], r"vertices 0 have coordinates that are not finite"),
        (SQUARE, [(0, 1, 2), (0, 2, 4)], r"face 1 use vertex indices >= 4, but there are 4 vertices.*OBJ"),
        (SQUARE, [(0, 1, 2), (0, 2, -1)], r"face 1 use negative vertex indices\. Vertices are counted from zero"),
        (SQUARE, [(0, 1, 1, 2), (0, 2, 3)], r"face 0 name a corner twice\..*`repair\(\)`"),
        (SQUARE, [(0, 1, 2, 0)], r"face 0 name a corner twice"),
        ([*SQUARE, (0, 0, 1)], [(0, 1, 2), (1, 0, 3), (0, 1, 4)], r"edges \(0, 1\) have more than two faces.*0, 1, 2"),
        (SQUARE, [(0, 1, 2), (0, 3, 2)], r"faces at edges \(0, 2\) are oriented oppositely \(faces 0, 1\)"),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], r"face 0 have no area"),
        (SQUARE, [(0, 2, 1, 3)], r"face 0 have no area.*or the sides of a quad cross"),
        ([(0, 0, 0), (0, 0, 0), (1, 1, 0)], [(0, 1, 2)], r"face 0 have no area"),
    ],
)
def test_refusals(vertices, faces, words: str):
    late = ControlMesh(vertices, faces, check=False)
    for check in (late.check, lambda: ControlMesh(vertices, faces)):
        with pytest.raises(MeshError, match=words):
            check()


@pytest.mark.parametrize(
    ("normals", "words"),
    [
        (np.ones((3, 3)), r"there are 3 normals for 4 vertices"),
        (np.array([[0, 0, 1]] * 3 + [[0, 0, np.nan]]), r"the normals of vertices 3 are not finite\. Give normals=None"),
        ([[0, 0, 1], [0, 0, np.inf]] * 2, r"the normals of vertices 1, 3 are not finite"),
    ],
)
def test_refused_normals(normals, words: str):
    with pytest.raises(MeshError, match=words):
        ControlMesh(SQUARE, [(0, 1, 2, 3)], normals)


def test_first_few_rows_are_named_and_the_rest_counted():
    with pytest.raises(MeshError, match=r"faces 0, 1, 2, 3, 4 \(\+2 more\) use vertex indices >= 4"):
        ControlMesh(SQUARE, [(0, 1, 9)] * 7)


# A triangle (places 1 and 3 of the list, rows 0 and 1 among triangles) and a quad (place 2, row 1 among quads) are bad.
MIXED = [(0, 1, 2, 3), (0, 1, 9), (0, 9, 2, 3), (0, 2, 9)]
TRIANGLES, QUADS = [f for f in MIXED if len(f) == 3], [f for f in MIXED if len(f) == 4]


@pytest.mark.parametrize(
    ("faces", "of_triangles", "of_quads"),
    [
        (MIXED, "faces 1, 3", "face 2"),
        ({3: TRIANGLES, 4: QUADS}, "triangle 0, triangle 1", "quad 1"),
        ((np.array(QUADS), np.array(TRIANGLES)), "triangle 0, triangle 1", "quad 1"),
        ({3: TRIANGLES}, "faces 0, 1", None),
        (np.array(TRIANGLES), "faces 0, 1", None),
        (np.array(QUADS), None, "face 1"),
        ({4: QUADS}, None, "face 1"),
    ],
)
def test_faces_are_named_as_the_caller_counts(faces, of_triangles: str | None, of_quads: str | None):
    mesh = ControlMesh(SQUARE, faces, check=False)
    n_triangles = len(mesh.faces[3])
    if of_triangles:
        with pytest.raises(MeshError, match=f"^{of_triangles} use"):
            mesh.check()
        assert mesh.name_faces([1, 0]) == of_triangles
    if of_quads:
        assert mesh.name_faces([n_triangles + 1]) == of_quads
    if of_quads and not of_triangles:
        with pytest.raises(MeshError, match=f"^{of_quads} use"):
            mesh.check()


def test_names_across_triangles_and_quads_follow_the_list():
    assert ControlMesh(SQUARE, MIXED, check=False).name_faces([0, 1, 2, 3]) == "faces 0, 1, 2, 3"
    named = ControlMesh(SQUARE, {3: TRIANGLES, 4: QUADS}, check=False).name_faces([3, 0])
    assert named == "triangle 0, quad 1"


def test_check_is_put_off():
    mesh = ControlMesh(SQUARE, [(0, 1, 1, 2)], check=False)
    assert mesh.n_faces == 1
    with pytest.raises(MeshError):
        mesh.check()
    with pytest.raises(MeshError):  # a failed check is not remembered as passed
        mesh.check()
