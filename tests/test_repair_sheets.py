"""ControlMesh.repair where surfaces touch or are turned: splitting, orientation and normals."""

import numpy as np
import pytest
from meshes import cube, grid, torus, two_components
from repairs import SQUARE, joined, repaired, shifted, touching_solids, volume

from jaxsubdiv._mesh import ControlMesh
from jaxsubdiv.errors import MeshError


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
