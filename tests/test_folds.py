"""Faces upside down: found, turned back before a fit, and not made by its steps."""

import functools

import jax
import meshes
import numpy as np
import pytest

import fitting
import jaxsubdiv as js
from fitting.run.fit import sound_start
from fitting.solve import sweeps
from fitting.start.folds import Folds, unfold_start

INSIDE = 2  # of the sheet's faces: a vertex with three neighbours stands in it


def sheet(kind: str = "triangle") -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """A bent sheet, 36 mm by 30 mm."""
    vertices, faces = meshes.grid(6, 5, kind)
    x, y, _ = (6 * np.asarray(vertices, float) - (18, 15, 0)).T
    return np.stack([x, y, 4 * np.sin(x / 8) * np.cos(y / 9)], axis=1), [tuple(map(int, face)) for face in faces]


@functools.cache
def with_three_neighbours() -> js.ControlMesh:
    """The sheet with a vertex more, the last, in the middle of an inner face."""
    vertices, faces = sheet()
    on_boundary = np.isin(np.abs(vertices[:, 0]), 18) | np.isin(np.abs(vertices[:, 1]), 15)
    inner = [face for face in faces if not on_boundary[list(face)].any()]
    a, b, c = inner[INSIDE]
    faces.remove((a, b, c))
    new = len(vertices)
    vertices = np.concatenate([vertices, [vertices[[a, b, c]].mean(axis=0)]])
    return js.ControlMesh(vertices, [*faces, (a, b, new), (b, c, new), (c, a, new)])


def pushed_out(mesh: js.ControlMesh) -> np.ndarray:
    """Vertices, the last beyond the far side of the triangle of its neighbours."""
    vertices = mesh.vertices.copy()
    ring = vertices[mesh.faces[3][-3]][:2]
    vertices[-1] += 1.6 * (ring.mean(axis=0) - vertices[-1])
    return vertices


def folds(mesh: js.ControlMesh) -> Folds:
    return Folds(js.build_topology(mesh, js.Interpolating(), 1))


@pytest.mark.parametrize("kind", ["triangle", "quad", "mixed"])
def test_no_face_of_a_sound_mesh_is_upside_down(kind):
    mesh = js.ControlMesh(*sheet(kind))
    assert not folds(mesh).find_turned_over(mesh.vertices).any()


def test_vertex_beyond_the_triangle_of_its_neighbours_turns_one_face():
    mesh = with_three_neighbours()
    turned = folds(mesh).find_turned_over(pushed_out(mesh))
    assert np.flatnonzero(turned).tolist() == [len(mesh.faces[3]) - 3]
    assert np.flatnonzero(folds(mesh).corners_of(turned)).tolist() == sorted(mesh.faces[3][-3])


def test_quad_of_a_strip_that_is_laid_in_a_z_is_found():
    x = np.array([0.0, 2.0, 1.0, 3.0])
    strip = np.concatenate([np.stack([x, np.full(4, y), 0.1 * np.arange(4)], axis=1) for y in (0, 2)])
    mesh = js.ControlMesh(strip, [(i, i + 1, i + 5, i + 4) for i in range(3)])
    assert folds(mesh).find_turned_over(strip).tolist() == [False, True, False]


def test_face_without_area_is_not_upside_down():
    mesh = js.ControlMesh(*sheet())
    vertices = mesh.vertices.copy()
    vertices[mesh.faces[3][20]] = vertices[mesh.faces[3][20][0]]
    assert not folds(mesh).find_turned_over(vertices)[20]


def test_only_the_vertices_of_faces_upside_down_move_and_none_stays():
    mesh = with_three_neighbours()
    start = pushed_out(mesh)
    found = folds(mesh).unfold(start, np.ones(len(start), bool))
    assert not folds(mesh).find_turned_over(found).any()
    moved = np.flatnonzero(np.any(found != start, axis=1))
    assert set(moved) <= set(mesh.faces[3][-3]) and len(start) - 1 in moved


def test_vertices_that_are_fixed_or_on_the_boundary_are_not_unfolded():
    mesh = with_three_neighbours()
    start = pushed_out(mesh)
    np.testing.assert_array_equal(folds(mesh).unfold(start, np.zeros(len(start), bool)), start)
    corner = mesh.vertices.copy()
    corner[0] += 8 * np.sign(corner[20] - corner[0])  # over its face's far side
    found = folds(mesh).unfold(corner, np.ones(len(start), bool))
    np.testing.assert_array_equal(found[0], corner[0])


def lens(rings: int = 4, spokes: int = 16) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    """A closed thin disc with a sharp rim; its faces, those of the upper side first, begin in the middle."""
    angle = 2 * np.pi * np.arange(spokes) / spokes
    radius = np.repeat(np.arange(1.0, rings + 1), spokes)
    x, y = radius * np.tile(np.cos(angle), rings), radius * np.tile(np.sin(angle), rings)
    height = 0.04 * (rings**2 - radius**2)
    upper = np.concatenate([[(0, 0, 0.04 * rings**2)], np.stack([x, y, height], axis=1)])
    faces = [(0, 1 + i, 1 + (i + 1) % spokes) for i in range(spokes)]
    for ring in range(rings - 1):
        for i in range(spokes):
            a, b = (1 + ring * spokes + j % spokes for j in (i, i + 1))
            faces += [(a, a + spokes, b + spokes), (a, b + spokes, b)]
    inner = 1 + (rings - 1) * spokes
    down = np.arange(len(upper))
    down[:inner] += len(upper)
    vertices = np.concatenate([upper, upper[:inner] * (1, 1, -1)])
    return vertices, faces + [tuple(down[list(face)][::-1]) for face in faces]


def test_rim_of_a_thin_part_is_no_fold_and_stays_beside_one():
    vertices, faces = lens()
    mesh = js.ControlMesh(vertices, faces)
    assert folds(mesh)._find_folded(mesh.vertices, np).sum() == 16
    assert not folds(mesh).find_upside_down(mesh.vertices).any()
    a, b, c = faces[-1]  # at the rim, on the lower side
    new = len(vertices)
    middle = vertices[[a, b, c]].mean(axis=0)
    with_one = np.concatenate([vertices, [middle + 1.6 * (vertices[[a, b]].mean(axis=0) - middle)]])
    mesh = js.ControlMesh(
        with_one, [face for face in faces if face != (a, b, c)] + [(a, b, new), (b, c, new), (c, a, new)]
    )
    assert folds(mesh).find_upside_down(with_one).sum() == 1
    found = folds(mesh).unfold(with_one, np.ones(len(with_one), bool))
    moved = np.flatnonzero(np.any(found != with_one, axis=1))
    assert not folds(mesh).find_upside_down(found).any() and len(moved) <= 6


def test_warning_says_what_could_not_be_mended():
    mesh = with_three_neighbours()
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    control = js.ControlMesh(pushed_out(mesh), mesh.faces).control()
    with pytest.warns(UserWarning, match=r"They stay, as their vertices are fixed"):
        assert unfold_start(topology, control, False) is control
    with pytest.raises(ValueError, match=r"`Free.vertices` has 5 rows for 43 control vertices"):
        sound_start(js.Interpolating(), topology, control, fitting.Free(vertices=np.ones(5, bool)))


def test_start_is_left_as_it_is_without_faces_upside_down(recwarn):
    mesh = with_three_neighbours()
    control = mesh.control()
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    assert unfold_start(topology, control, True) is control and not recwarn.list


@functools.cache
def scan_of_the_sheet() -> fitting.Scan:
    mesh = with_three_neighbours()
    surface = js.refine(js.Interpolating(), js.build_topology(mesh, js.Interpolating(), 1), mesh.control())
    return fitting.Scan(js.sample(surface, 600, jax.random.key(0)).points)


def fit_from(vertices: np.ndarray, **options) -> fitting.FitResult:
    mesh = with_three_neighbours()
    control = js.ControlMesh(vertices, mesh.faces).control()
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    return fitting.fit(js.Interpolating(), topology, control, scan_of_the_sheet(), throw=False, **options)


def test_fit_from_a_face_upside_down_warns_and_finds_the_surface():
    mesh = with_three_neighbours()
    with pytest.warns(UserWarning, match=rf"lie upside down .*: {len(mesh.faces[3]) - 3} \(1 of"):
        found = fit_from(pushed_out(mesh))
    assert not folds(mesh).find_turned_over(np.asarray(found.control.vertices)).any()
    assert found.distances.std() < 0.1 * float(np.abs(pushed_out(mesh) - mesh.vertices).max())


@pytest.mark.filterwarnings("ignore:2 of 2 fits did not converge")
def test_cohort_starts_without_faces_upside_down_too():
    mesh = with_three_neighbours()
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    control = js.ControlMesh(pushed_out(mesh), mesh.faces).control()
    with pytest.warns(UserWarning, match="upside down") as told:
        found = fitting.fit_cohort(
            js.Interpolating(),
            topology,
            control,
            [scan_of_the_sheet()] * 2,
            priors=fitting.Priors(bend=0.3),
            max_sweeps=2,
        )
    assert sum("upside down" in str(warning.message) for warning in told) == 1
    for vertices in np.asarray(found.control.vertices):
        assert not folds(mesh).find_turned_over(vertices).any()


@pytest.mark.filterwarnings("ignore:faces of the control mesh that lie upside down")
def test_step_that_turns_faces_over_is_taken_again_and_shorter(monkeypatch):
    mesh, turned = with_three_neighbours(), []
    start = mesh.vertices + np.random.default_rng(1).normal(scale=(1.5, 1.5, 3), size=mesh.vertices.shape)
    retract = sweeps._retract

    def watched(*arguments):
        found = retract(*arguments)
        turned.append(int(folds(mesh).find_turned_over(np.asarray(found.control.vertices)).sum()))
        return found

    monkeypatch.setattr(sweeps, "_retract", watched)
    rough = {"priors": fitting.Priors(likeness=0.0)}  # the noise of the start's shape is not to be expected
    fit_from(start, **rough)
    with_care = max(turned)
    turned.clear()
    monkeypatch.setattr(sweeps, "_TRIES", 1)
    fit_from(start, **rough)
    assert with_care == 0 < max(turned)
