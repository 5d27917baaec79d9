"""A family of shapes as a prior: its member that a part of a scan shows, and fits that start there."""

import functools

import numpy as np
import pytest
import scans
from scipy.spatial.transform import Rotation

import fitting
import jaxsubdiv as js
from fitting.model.priors.shape_modes import find_scores
from fitting.start.family import place_member

SCORES = np.array([1.4, -1.0])


@functools.cache
def family() -> tuple[js.ControlMesh, np.ndarray]:
    """A body of 42 vertices, and two modes: a bulge on either side that grow together, and its length."""
    problem = scans.problem()
    surface = js.refine(js.Interpolating(), problem.topology, problem.truth)
    mean = np.asarray(surface.vertices, np.float64)
    mean = mean - mean.mean(axis=0)
    out = mean / np.linalg.norm(mean, axis=1)[:, None]
    bulge = np.exp(-(((np.abs(out) - (0.8, 0.0, 0.6)) ** 2).sum(axis=1)) / 0.4)[:, None] * out
    modes = np.stack([2.0 * bulge, 1.5 * out * (0, 1, 0)])
    return js.ControlMesh(mean, {3: surface.faces[3], 4: surface.faces[4]}, check=False), modes


def member() -> np.ndarray:
    mean, modes = family()
    return mean.vertices + np.tensordot(SCORES, modes, 1)


def half(turn: Rotation, noise: float = 0.05) -> tuple[fitting.Scan, np.ndarray]:
    """Points of the half of the member with x above 0, turned and shifted; and the whole member there."""
    mesh = js.ControlMesh(member(), family()[0].faces, check=False)
    corners = mesh.vertices[np.asarray(mesh.triangulate().faces[3])]
    rng = np.random.default_rng(0)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), 3000, p=areas / areas.sum())]
    points = np.einsum("pc,pcx->px", rng.dirichlet(np.ones(3), 3000), chosen)
    points = points[points[:, 0] > 0]
    points += rng.normal(scale=noise, size=points.shape)
    return fitting.Scan(turn.apply(points) + 5.0), turn.apply(member()) + 5.0


@pytest.mark.parametrize("degrees", [0, 20])
def test_half_a_member_shows_the_other_half(degrees):
    mean, modes = family()
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8]))
    scan, truth = half(turn)
    placed = js.ControlMesh(turn.apply(np.array(mean.vertices)) + 4.0, mean.faces, check=False)
    found = place_member(mean.vertices, modes, placed, scan)
    np.testing.assert_allclose(found.scores, SCORES, atol=0.2)
    off = np.linalg.norm(found.vertices - truth, axis=1)
    before = np.linalg.norm(placed.vertices - truth, axis=1)
    assert off.max() < 0.5 < 2 * before.mean()


def test_points_that_no_member_has_do_not_pull():
    mean, modes = family()
    scan, truth = half(Rotation.identity())
    stray = np.random.default_rng(1).normal(scale=15, size=(200, 3))
    whole = fitting.Scan(np.concatenate([scan.points, stray]))
    found = place_member(mean.vertices, modes, mean, whole)
    assert np.linalg.norm(found.vertices - truth, axis=1).max() < 0.8


def test_scores_are_those_of_the_nearest_member():
    mean, modes = family()
    moved = Rotation.from_rotvec([0.3, 0.2, -0.5]).apply(member()) + 40
    np.testing.assert_allclose(find_scores(mean.vertices, modes, moved), SCORES, atol=0.05)
    far = mean.vertices + 9 * modes[0]
    assert find_scores(mean.vertices, modes, far)[0] == 3.0


def test_a_cohort_is_a_family():
    rng = np.random.default_rng(0)
    mean, modes = family()
    shapes = mean.vertices + np.einsum("sk,kvx->svx", rng.normal(size=(6, 2)), modes)
    control = js.Control(js.strong_float(0.0) + shapes, js.strong_float(0.0) + shapes)

    class Fits:  # what a prior sees of a cohort
        pass

    fits = Fits()
    fits.control = control
    own, other = (fitting.Priors(shape=one).shape for one in (fits, fitting.shape_modes(shapes)))
    assert own is not None and other is not None
    np.testing.assert_allclose(own.modes, other.modes)
    np.testing.assert_allclose(own.rest, other.rest)


def test_a_fit_starts_from_the_member_that_the_scan_shows():
    mean, modes = family()
    scan, truth = half(Rotation.identity())
    shape = fitting.ShapeModes(
        mean.vertices,
        modes / np.linalg.norm(modes, axis=(1, 2))[:, None, None],
        np.linalg.norm(modes, axis=(1, 2)),
        rest=0.1,
    )
    places = fitting.Landmarks(truth[[0, 1]], mean.vertices[[0, 1]])
    found = fitting.fit_scan(
        scan, mean, pose="rigid", levels=1, priors=fitting.Priors(shape=shape), landmarks=places, throw=False
    )
    assert np.linalg.norm(found.start.vertices - truth, axis=1).max() < 0.6
    np.testing.assert_allclose(found.result.fit.y.shared["scores"], SCORES, atol=0.4)
    hidden = member()[:, 0] < -2
    assert np.linalg.norm(np.asarray(found.result.control.vertices) - truth, axis=1)[hidden].max() < 0.8
    anchors = found.result.fit.inputs["landmarks"]
    on = js.sum_corners(
        js.refine(found.result.scheme, found.result.fit.topology, found.result.start).vertices,
        anchors.corners,
        anchors.corner_weights,
    )
    np.testing.assert_allclose(on, found.start.vertices[[0, 1]], atol=0.1)  # where the mesh starts, not the template
