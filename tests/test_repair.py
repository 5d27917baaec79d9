"""ControlMesh.repair: sound meshes come back as they were, damaged ones sound, and everything done is said."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
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

CLOSED = {
    "tetrahedron": (tetrahedron(), 2),
    "icosahedron": (icosahedron(), 2),
    "cube": (cube(), 2),
    "mixed": (mixed_closed(), 2),
    "fan": (fan(5), 2),
    "ring": (torus(6, 4, "mixed"), 0),
    "two": (two_components(), 4),
}
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def volume(mesh: ControlMesh) -> float:
    """Of triangles fanned from the first corner of every face."""
    total = 0.0
    for faces in mesh.faces.values():
        a = mesh.vertices[faces]
        for i in range(1, faces.shape[1] - 1):
            total += np.einsum("fx,fx->", a[:, 0], np.cross(a[:, i], a[:, i + 1])) / 6
    return total


def repaired(vertices, faces, normals=None, merge_within: float | None = None) -> ControlMesh:
    mesh = ControlMesh(vertices, faces, normals, check=False).repair(merge_within)
    ControlMesh(mesh.vertices, mesh.faces, mesh.normals)  # checked anew
    return mesh


def assert_equal(mesh: ControlMesh, other: ControlMesh):
    np.testing.assert_array_equal(mesh.vertices, other.vertices)
    for size in (3, 4):
        np.testing.assert_array_equal(mesh.faces[size], other.faces[size])
    assert (mesh.normals is None) == (other.normals is None)
    if mesh.normals is not None and other.normals is not None:
        np.testing.assert_array_equal(mesh.normals, other.normals)


def shifted(mesh: Mesh, by, n: int) -> Mesh:
    """A mesh beside another of `n` vertices."""
    return mesh[0] + by, [tuple(c + n for c in f) for f in mesh[1]]


def joined(*meshes: Mesh) -> Mesh:
    return np.concatenate([v for v, _ in meshes]), [f for _, faces in meshes for f in faces]


# --------------------------------------------------------------------------------------------------------- sound meshes


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


def touching_solids() -> Mesh:
    """Two cubes that share the place of an edge, but no vertex."""
    return joined(cube(), shifted(cube(), (2, 2, 0), 8))


def test_solids_that_touch_stay_apart():
    vertices, faces = touching_solids()
    mesh = ControlMesh(vertices, faces, np.random.default_rng(0).normal(size=vertices.shape))
    again = mesh.repair()
    assert again.repairs == ()
    assert_equal(again, mesh)


# ------------------------------------------------------------------------------------------------------- damaged meshes


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


# --------------------------------------------------------------------------------------------------------- single steps


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


# ------------------------------------------------------------------------------------------------------------ splitting


def test_a_fin_is_cut_off():
    """Two flat faces and a third that stands on their edge: the flat ones belong together.

    A fourth touches one end of the edge with a corner only, and goes on doing so.
    """
    vertices = [(0, 0, 0), (0, 1, 0), (1, 0, 0), (-1, 0, 0), (0, 0.5, 1), (1, -1, 0), (-1, -1, 0)]
    for fin in [(0, 1, 4), (1, 0, 4)]:
        made = repaired(vertices, [(0, 2, 1), (1, 3, 0), fin, (0, 6, 5)])
        assert made.repairs[0] == (
            "Split the surface at 1 edge with more than two faces: copied 2 vertices, which opened 1 boundary edge."
        )
        np.testing.assert_array_equal(made.faces[3][[0, 1, 3]], [(0, 2, 1), (1, 3, 0), (0, 6, 5)])
        assert set(made.faces[3][2]) == {4, 7, 8}
        np.testing.assert_array_equal(made.vertices[made.faces[3][2]], np.array(vertices)[list(fin)])
        assert made.repair().repairs == ()


def test_a_book_of_pages():
    """Five half-planes about one axis, all oriented alike: none belongs to another."""
    angles = np.arange(5)
    outer = np.stack([np.cos(angles), np.sin(angles), 0.5 + 0 * angles], axis=1)
    faces = [(0, i + 2, 1) for i in range(5)]
    made = repaired([(0, 0, 0), (0, 0, 1), *outer], faces)
    assert made.euler_number == 5
    assert made.n_faces == 5
    assert made.repair().repairs == ()


@pytest.mark.parametrize("flip", [0, 1, 2])
def test_solids_joined_along_an_edge_come_apart(flip: int):
    vertices, faces = touching_solids()
    first = [int(np.flatnonzero((vertices == v).all(axis=1))[0]) for v in vertices]
    faces = [tuple(first[c] for c in f) for f in faces]
    if flip == 1:  # one of the two inside out
        faces = [f[::-1] if i < 6 else f for i, f in enumerate(faces)]
    if flip == 2:
        faces = [f[::-1] if i % 3 else f for i, f in enumerate(faces)]
    made = repaired(vertices, faces)
    assert made.is_closed
    assert made.euler_number == 4
    assert volume(made) == pytest.approx(16)
    assert any("Split the surface at 1 edge with more than two faces: copied 2" in note for note in made.repairs)
    assert made.repair().repairs == ()


def test_a_pinched_ring_is_a_ring_again():
    """Two edges on opposite sides of a ring are made one."""
    vertices, faces = torus(8, 5)
    pinch = {20: 0, 25: 5}
    made = repaired(vertices, [tuple(pinch.get(c, c) for c in f) for f in faces])
    assert made.is_closed
    assert made.euler_number == 0
    assert "Split the surface at 1 edge with more than two faces: copied 2 vertices." in made.repairs


def test_the_sheet_that_runs_round_a_crease_is_cut_from_itself():
    """A strip that starts on an edge, goes round, and ends on the same edge between two flat faces."""
    vertices = [(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (-1, 0, 0), (-1, 1, 0), (1, 0, 1), (1, 1, 1), (0, 0.5, 2)]
    faces = [(0, 2, 3, 1), (0, 1, 5, 4), (2, 6, 7, 3), (0, 1, 7, 6), (0, 6, 2), (1, 3, 7)]
    made = repaired(vertices, faces)
    assert made.n_faces == 6
    assert any(note.startswith("Split the surface at 1 edge") for note in made.repairs)


def test_cones_that_touch_stay_joined():
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)]
    assert repaired(vertices, [(0, 1, 2), (0, 3, 4)]).repairs == ()


# ---------------------------------------------------------------------------------------------------------- orientation


def test_inward_solids_are_turned():
    vertices, faces = two_components()
    made = repaired(vertices, [f[::-1] if len(f) == 4 else f for f in faces])
    assert made.repairs == ("Turned 1 closed component (6 faces) outwards.",)
    assert volume(made) == pytest.approx(volume(ControlMesh(vertices, faces)))


def test_a_single_face_is_reversed_and_keeps_its_first_corner():
    vertices, faces = cube()
    made = repaired(vertices, [faces[0], faces[1][::-1], *faces[2:]])
    assert made.repairs == ("Reversed 1 face to agree with the rest of the surface.",)
    np.testing.assert_array_equal(made.faces[4][1], np.roll(faces[1], 1))


@pytest.mark.parametrize("down", [False, True])
def test_open_sheets_follow_the_greater_area(down: bool):
    vertices, faces = grid(3, 3, "mixed")
    vertices = vertices @ np.diag([10, 1, -1 if down else 1])
    sheet = [f[::-1] for f in faces] if down else faces
    made = repaired(vertices, [sheet[0][::-1], sheet[1][::-1], *sheet[2:]])
    assert made.repairs == ("Reversed 2 faces to agree with the rest of the surface.",)
    a = made.vertices[made.faces[3]]
    assert (np.sign(np.cross(a[:, 1] - a[:, 0], a[:, 2] - a[:, 0])[:, 2]) == (-1 if down else 1)).all()


def test_moebius_bands_are_refused_by_the_callers_count():
    angles = 2 * np.pi * np.arange(7) / 7
    direction = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    width = 0.3 * np.stack([*(direction[:, :2] * np.cos(angles / 2)[:, None]).T, np.sin(angles / 2)], axis=1)
    band = [(i, i + 1, i + 8, i + 7) for i in range(6)] + [(6, 7, 0, 13)]
    vertices = np.concatenate([direction - width, direction + width, np.array(SQUARE) + 9])
    with pytest.raises(MeshError, match=r"^faces 1, 2, 3, 4, 5 \(\+2 more\) cannot be oriented alike.*Moebius band"):
        repaired(vertices, [(14, 15, 16), *band, (14, 16, 17)])
    with pytest.raises(MeshError, match=r"^quad 0, quad 1, .* cannot be oriented alike"):
        repaired(vertices, {3: [(14, 15, 16)], 4: band})


# -------------------------------------------------------------------------------------------------------------- normals


def test_merged_normals_become_their_unit_mean():
    vertices, faces = joined(grid(1, 1), shifted(grid(1, 1), (1, 0, 0), 4))
    normals = np.tile([0.0, 0, 3], (8, 1))
    normals[4:6] = 5, 0, 0
    made = repaired(vertices, faces, normals)
    assert made.normals is not None
    np.testing.assert_allclose(made.normals[2:4], [[0.5**0.5, 0, 0.5**0.5]] * 2)
    np.testing.assert_array_equal(made.normals[[0, 1, 4, 5]], [[0, 0, 3]] * 4)  # not touched, not made unit


def test_opposed_normals_are_computed_anew_when_merged():
    vertices, faces = joined(grid(1, 1), shifted(grid(1, 1), (1, 0, 0), 4))
    normals = np.repeat([[0, 1.0, 0], [0, -1, 0]], 4, axis=0)
    made = repaired(vertices, faces, normals)
    assert made.normals is not None
    np.testing.assert_allclose(made.normals[2:4], [[0, 0, 1]] * 2)
    assert made.repairs[1] == "Computed 2 normals from the faces: not finite, or opposed when merged."


def test_normals_that_are_not_finite_are_computed():
    vertices, faces = cube()
    normals = vertices.copy()
    normals[3] = np.nan
    made = repaired(vertices, faces, normals)
    assert made.normals is not None
    np.testing.assert_allclose(made.normals[3], vertices[3] / 3**0.5)
    np.testing.assert_array_equal(np.delete(made.normals, 3, 0), np.delete(vertices, 3, 0))
    assert made.repairs == ("Computed 1 normal from the faces: not finite, or opposed when merged.",)


def test_normals_turn_with_the_faces_that_they_pointed_along():
    vertices, faces = cube()
    made = repaired(vertices, [f[::-1] for f in faces], -vertices)
    assert made.normals is not None
    np.testing.assert_array_equal(made.normals, vertices)
    assert made.repairs[1] == "Reversed 8 normals along with the faces."


def test_normals_that_were_right_stay():
    vertices, faces = cube()
    made = repaired(vertices, [f[::-1] if i % 2 else f for i, f in enumerate(faces)], vertices)
    assert made.normals is not None
    np.testing.assert_array_equal(made.normals, vertices)
    assert len(made.repairs) == 1


def test_zero_normals_stay_zero():
    vertices, faces = cube()
    made = repaired(vertices, [f[::-1] for f in faces], np.zeros((8, 3)))
    assert made.normals is not None
    assert not made.normals.any()


# ------------------------------------------------------------------------------------------------------------- refusals


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
