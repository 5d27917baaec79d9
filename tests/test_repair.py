"""ControlMesh.repair: sound meshes come back as they were, damaged ones sound, and everything done is said."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from meshes import Mesh, cube, fan, grid, icosahedron, mixed_closed, octahedron, tetrahedron, torus, two_components
from repairs import SQUARE, joined, repaired, shifted, touching_solids, volume

from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError

CLOSED = {
    "tetrahedron": (tetrahedron(), 2),
    "icosahedron": (icosahedron(), 2),
    "cube": (cube(), 2),
    "mixed": (mixed_closed(), 2),
    "fan": (fan(5), 2),
    "ring": (torus(6, 4, "mixed"), 0),
    "two": (two_components(), 4),
}


def assert_equal(mesh: ControlMesh, other: ControlMesh):
    np.testing.assert_array_equal(mesh.vertices, other.vertices)
    for size in (3, 4):
        np.testing.assert_array_equal(mesh.faces[size], other.faces[size])
    assert (mesh.normals is None) == (other.normals is None)
    if mesh.normals is not None and other.normals is not None:
        np.testing.assert_array_equal(mesh.normals, other.normals)


@pytest.mark.parametrize(
    "mesh",
    [*(mesh for mesh, _ in CLOSED.values()), octahedron(), grid(3, 2), grid(4, 3, "mixed", bumpy=0.4)],
)
@pytest.mark.parametrize("with_normals", [False, True])
def test_sound_meshes_come_back_equal(mesh: Mesh, with_normals: bool):
    vertices, faces = mesh
    # Two unused vertices at one place in the middle: neither merged nor moved.
    half = len(vertices) // 2
    vertices = np.insert(vertices, half, np.zeros((2, 3)), axis=0)
    faces = [tuple(c + 2 * (c >= half) for c in f) for f in faces]
    normals = np.random.default_rng(0).normal(size=vertices.shape) if with_normals else None
    sound = ControlMesh(vertices, faces, normals)
    again = sound.repair()
    assert again.repairs == ()
    assert_equal(again, sound)


def test_solids_that_touch_stay_apart():
    vertices, faces = touching_solids()
    mesh = ControlMesh(vertices, faces, np.random.default_rng(0).normal(size=vertices.shape))
    again = mesh.repair()
    assert again.repairs == ()
    assert_equal(again, mesh)


@st.composite
def damaged(draw: st.DrawFn):
    """A closed mesh with its Euler number and the vertices and faces of a damaged copy."""
    mesh, euler_number = CLOSED[draw(st.sampled_from(sorted(CLOSED)))]
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    damage = draw(st.sets(st.sampled_from(["turn", "flip", "double", "noise", "repeat", "collapse", "shuffle"])))
    vertices, faces = mesh[0], list(mesh[1])
    if "collapse" in damage:  # a quad is kept as two: one cut to a triangle stored as a quad, and the other triangle
        at = next((i for i, f in enumerate(faces) if len(f) == 4), None)
        if at is not None:
            a, b, c, d = faces[at]
            faces[at : at + 1] = [(a, b, c, c), (a, c, d)]
    if "turn" in damage:
        faces = [tuple(np.roll(f, rng.integers(4))) for f in faces]
    if "flip" in damage:
        faces = [f[::-1] if rng.random() < 0.5 else f for f in faces]
    if "repeat" in damage:
        again = [faces[i] for i in rng.integers(len(faces), size=3)]
        faces += [tuple(np.roll(f[:: rng.choice([1, -1])], rng.integers(4))) for f in again]
    if "double" in damage:  # some corners but not the first at a vertex get their own, a little away
        extra, seen = [], set()
        for i, face in enumerate(faces):
            old = face[rng.integers(len(face))]
            doubled = old in seen and rng.random() < 0.5
            seen.update(face)
            if doubled:
                faces[i] = tuple(len(vertices) + len(extra) if c == old else c for c in face)
                extra.append(vertices[old] + ("noise" in damage) * rng.uniform(-1e-9, 1e-9, 3))
        vertices = np.concatenate([vertices, np.reshape(extra, (-1, 3))])
    if "shuffle" in damage:
        faces = [faces[i] for i in rng.permutation(len(faces))]
    return mesh, euler_number, vertices, faces


@settings(deadline=None, max_examples=60)
@given(damaged())
def test_damaged_meshes_come_back_sound(case):
    mesh, euler_number, vertices, faces = case
    sound = ControlMesh(*mesh)
    made = repaired(vertices, faces)
    assert made.is_closed
    assert made.euler_number == euler_number
    assert volume(made) == pytest.approx(volume(sound))
    np.testing.assert_allclose(made.vertices, sound.vertices, atol=1e-8)  # the order of the vertices is kept
    assert made.repair().repairs == ()


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["quad", "triangle", "mixed"]))
@example(52, "quad")  # these two have sheets that cross at several edges and are cut more than once
@example(48, "mixed")
def test_any_heap_of_faces_comes_back_sound(seed: int, kind: str):
    """Random faces over a few vertices: crowded edges everywhere, at random orientation."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(6, 3))
    sizes = {"quad": [4], "triangle": [3], "mixed": [3, 4]}[kind]
    faces = [tuple(rng.integers(6, size=rng.choice(sizes))) for _ in range(rng.integers(1, 25))]
    try:
        repaired(vertices, faces)
    except MeshError as error:
        assert "one side" in str(error) or "nothing is left" in str(error)


def test_merging_says_how_many_and_keeps_quads():
    vertices, faces = cube()
    soup = np.concatenate([vertices[list(f)] for f in faces])
    made = repaired(soup, np.arange(24).reshape(6, 4))
    assert made.repairs == ("Merged 16 doubled vertices into others no further than 3.46e-08 away.",)
    assert made.euler_number == 2
    assert len(made.faces[4]) == 6
    np.testing.assert_array_equal(made.vertices[made.faces[4]], vertices[np.array(faces)])


def test_merging_takes_the_first_of_each_and_follows_chains():
    vertices = [*SQUARE, (1.05, 0, 0), (1.1, 0, 0), (2, 0, 0)]
    made = repaired(vertices, [(0, 1, 2), (0, 2, 3), (4, 6, 2), (5, 6, 2)], merge_within=0.06)
    np.testing.assert_array_equal(made.vertices, [*SQUARE, (2, 0, 0)])
    np.testing.assert_array_equal(made.faces[3], [(0, 1, 2), (0, 2, 3), (1, 4, 2)])


def test_nothing_is_merged_further_away():
    vertices, faces = joined(grid(1, 1), shifted(grid(1, 1), (1.001, 0, 0), 4))
    assert len(repaired(vertices, faces).vertices) == 8
    assert len(repaired(vertices, faces, merge_within=0.01).vertices) == 6


@pytest.mark.parametrize("within", [-1.0, np.nan, np.inf])
def test_merging_needs_a_length(within: float):
    with pytest.raises(MeshError, match=r"`merge_within` must be a length, zero or more; got"):
        ControlMesh(*cube()).repair(within)


def test_merging_exact_copies_only():
    vertices, faces = joined(grid(1, 1), shifted(grid(1, 1), (1, 0, 0), 4))
    vertices[4] += 1e-12
    assert len(repaired(vertices, faces, merge_within=0.0).vertices) == 7


def test_a_quad_with_a_repeated_corner_becomes_a_triangle():
    made = repaired(SQUARE, [(0, 2, 3), (1, 1, 2, 0), (0, 0, 0, 1), (0, 1, 0, 1)])
    np.testing.assert_array_equal(made.faces[3], [(0, 2, 3), (1, 2, 0)])
    assert made.repairs == (
        "Made 1 triangle of quads with a repeated corner.",
        "Dropped 2 faces with fewer than three distinct corners.",
    )


def test_a_quad_collapsed_by_merging_becomes_a_triangle():
    vertices = np.array([*SQUARE, (1, 1e-3, 0), (2, 0, 0)])
    made = repaired(vertices, [(0, 4, 2, 3), (1, 5, 2, 4)], merge_within=0.01)
    np.testing.assert_array_equal(made.faces[4], [(0, 1, 2, 3)])
    np.testing.assert_array_equal(made.faces[3], [(1, 4, 2)])


def test_faces_without_area_are_dropped_and_holes_said():
    vertices = [*SQUARE, (0.5, 0.5, 0)]
    made = repaired(vertices, [(0, 1, 2), (0, 2, 4), (0, 4, 3), (4, 2, 3)])
    assert made.n_faces == 3
    assert made.repairs == ("Dropped 1 face without area, which opened 3 boundary edges.",)
    alone = repaired([*SQUARE, (2, 1, 0)], [(0, 1, 2, 3), (3, 2, 4)])
    assert alone.repairs == ("Dropped 1 face without area, which opened 1 boundary edge.",)


def test_a_folded_quad_is_dropped():
    made = repaired(SQUARE, [(0, 1, 2), (0, 1, 0, 3)])
    np.testing.assert_array_equal(made.faces[3], [(0, 1, 2)])
    assert made.repairs == ("Dropped 1 face without area.",)


def test_repeated_faces_are_dropped_and_the_first_kept():
    made = repaired(SQUARE, [(0, 1, 2, 3), (2, 3, 0, 1), (3, 2, 1, 0)])
    np.testing.assert_array_equal(made.faces[4], [(0, 1, 2, 3)])
    assert made.repairs == ("Dropped 2 faces with the same corners as an earlier one.",)


def test_vertices_that_are_not_finite_go_with_their_faces():
    vertices, faces = grid(2, 2)
    vertices[8] = np.nan
    made = repaired(np.concatenate([vertices, [(np.inf, 0, 0), (5, 5, 5)]]), faces)
    np.testing.assert_array_equal(made.vertices, [*vertices[:8], (5, 5, 5)])
    assert made.n_faces == 3
    assert made.repairs == (
        "Dropped 2 vertices whose coordinates are not finite.",
        "Dropped 1 face with a corner that is not finite, which opened 2 boundary edges.",
    )


def test_unused_vertices_keep_their_place():
    made = repaired([(9, 9, 9), *SQUARE, (9, 9, 9)], [(1, 2, 3, 4), (1, 1, 2)])
    np.testing.assert_array_equal(made.vertices, [(9, 9, 9), *SQUARE, (9, 9, 9)])


@pytest.mark.parametrize(
    ("vertices", "faces", "normals", "words"),
    [
        (SQUARE, [], None, "the mesh is empty"),
        (SQUARE, [(0, 1, 2), (0, 2, 4)], None, "face 1 use vertex indices >= 4"),
        (SQUARE, [(0, 1, -2)], None, "face 0 use negative vertex indices"),
        (SQUARE, [(0, 1, 2)], np.ones((3, 3)), "there are 3 normals for 4 vertices"),
        (SQUARE, [(0, 1, 1), (2, 2, 2)], None, "nothing is left of the mesh: .*2 faces, with fewer than three"),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], None, "nothing is left .*last 1 face, without area"),
        (np.full((3, 3), np.nan), [(0, 1, 2)], None, "nothing is left .*with a corner that is not finite"),
    ],
)
def test_what_no_repair_mends(vertices, faces, normals, words: str):
    with pytest.raises(MeshError, match=words):
        repaired(vertices, faces, normals)


def random_mesh(seed: int) -> ControlMesh:
    """Few vertices, many of them doubled, and faces of any corners among them."""
    rng = np.random.default_rng(seed)
    n = rng.integers(4, 12)
    vertices = (rng.normal(size=(n, 3)), np.round(rng.normal(size=(n, 3))))[rng.integers(2)]
    faces = {3: rng.integers(0, n, (rng.integers(1, 14), 3)), 4: rng.integers(0, n, (rng.integers(0, 7), 4))}
    return ControlMesh(vertices, faces, rng.normal(size=(n, 3)) if rng.random() < 0.5 else None, check=False)


def test_what_was_repaired_needs_no_repair():
    changed = 0
    for seed in range(200):
        try:
            made = random_mesh(seed).repair()
        except MeshError:  # nothing is left, or it has one side only
            continue
        made.check()
        again = made.repair()
        changed += bool(made.repairs)
        assert again.repairs == (), seed
        np.testing.assert_array_equal(again.vertices, made.vertices)
        for size in (3, 4):
            np.testing.assert_array_equal(again.faces[size], made.faces[size])
    assert changed > 100
