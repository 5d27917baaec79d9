"""Templates from many scans: means that rest, whichever subject came first; and meshes made symmetric."""

import functools

import meshes
import numpy as np
import pytest
import test_cohort

import fitting
import jaxsubdiv as js
from fitting.start.symmetric_mesh import find_mirror_plane, make_symmetric

PRIORS = fitting.Priors(bend=0.5)


def test_the_mean_does_not_depend_on_where_the_first_fits_started():
    others = fitting.fit_cohort(
        js.Interpolating(),
        test_cohort.scans.problem().topology,
        test_cohort.cohort().result(2).control,  # another subject's shape
        test_cohort.subjects(),
        priors=PRIORS,
        max_sweeps=40,
        tolerance=0.01,
    )
    found = [fitting.regroup(one, rounds=3) for one in (test_cohort.cohort(), others)]
    assert all(one.at_rest and one.cohort.converged.all() for one in found)
    assert found[0].moved[-1] < 0.1 and found[0].cohort.names == ("0", "1", "2")
    vertices = [np.asarray(one.mesh.vertices) for one in found]
    aligned = fitting.shape_modes(np.stack(vertices)).aligned
    assert np.sqrt(np.mean(np.sum((aligned[1] - aligned[0]) ** 2, axis=1))) < 0.3
    stretch = np.mean([[1.0, 1.0, 1.0], [1.05, 0.97, 1.0], [0.96, 1.0, 1.06]], axis=0)
    truth = np.asarray(test_cohort.scans.problem().truth.vertices) * stretch
    off = fitting.shape_modes(np.stack([truth, vertices[0]])).aligned
    assert np.sqrt(np.mean(np.sum((off[1] - off[0]) ** 2, axis=1))) < 0.8


@functools.cache
def bodies() -> tuple[fitting.Scan, ...]:
    """Three bodies with a bulge on either side, turned."""
    rng, found = np.random.default_rng(0), []
    for i, length in enumerate((24.0, 26.0, 28.0)):
        directions = rng.normal(size=(900, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        bulge = np.exp(-np.sum((np.abs(directions) - (0.7, 0, 0.7)) ** 2, axis=1) / 0.2) * (directions[:, 2] > 0)
        points = directions * (length, 18, 14) * (1 + 0.15 * bulge)[:, None]
        turn, _ = np.linalg.qr(np.eye(3) + 0.2 * i * rng.normal(size=(3, 3)))
        found.append(fitting.Scan(points @ (turn * np.sign(np.linalg.det(turn))).T + 30 * i))
    return tuple(found)


def test_a_template_of_scans_that_lie_anywhere_is_symmetric():
    stages = []
    found = fitting.make_template(
        bodies(), faces=80, symmetric=True, rounds=2, priors=PRIORS, on_stage=stages.append, names=("a", "b", "c")
    )
    symmetry = fitting.find_symmetry(found.mesh, tolerance=1e-6)
    assert np.sum(symmetry.partner != np.arange(len(found.mesh.vertices))) > 20
    assert found.cohort.converged.all() and found.cohort.names == ("a", "b", "c")
    assert np.max(found.cohort.noise) < 0.5
    size = np.sort(np.ptp(found.mesh.vertices @ np.linalg.svd(found.mesh.vertices)[2].T, axis=0))
    np.testing.assert_allclose(size, [30, 37, 53], atol=3.0)  # of the mean body
    assert stages[0] == "makes a control mesh of scan 0" and stages[-1].startswith("fits all from their mean, round")


@pytest.mark.parametrize("option", [{"checkpoint": "folder"}, {"skip_bad": True}])
def test_options_of_one_cohort_are_refused(option):
    with pytest.raises(ValueError, match=f"`{next(iter(option))}` is of one cohort"):
        fitting.make_template(bodies(), **option)


def test_a_template_needs_scans():
    with pytest.raises(ValueError, match="two scans or more, and landmarks of all or none; got 1 and none"):
        fitting.make_template(bodies()[:1])
    with pytest.raises(ValueError, match="got 3 and 1"):
        fitting.make_template(bodies(), landmarks=[{"a": np.zeros(3)}])


@pytest.mark.parametrize("turned", [False, True])
def test_a_mesh_is_made_symmetric(turned):
    vertices, faces = meshes.torus(14, 9)
    vertices = 10 * np.asarray(vertices) + (0.3, 0.1, 0.2)
    vertices = vertices * (1.3, 1, 1) + np.random.default_rng(0).normal(scale=0.1, size=vertices.shape)
    vertices[:, 2] += 0.02 * vertices[:, 1] ** 2 + 0.3 * vertices[:, 1]  # one mirror plane is left, across x
    if turned:
        turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
        vertices = vertices @ (turn * np.sign(np.linalg.det(turn)))
    mesh = js.ControlMesh(vertices, faces)
    middle, normal = find_mirror_plane(mesh)
    made = make_symmetric(mesh)
    symmetry = fitting.find_symmetry(made, tolerance=1e-9)
    assert abs(np.dot(symmetry.plane.normal, normal)) > 1 - 1e-5
    assert fitting.topology_of(made).euler_number == fitting.topology_of(mesh.triangulate()).euler_number
    assert abs((np.asarray(made.vertices).mean(axis=0) - middle) @ normal) < 0.05
