"""The engine of a fit: its sweeps as a solver, its rows for other solvers, shapes seen before, and derivatives."""

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import meshes
import numpy as np
import optimistix as optx
import pytest
from scans import N_POINTS, SIGMA, analysed, assert_refit_knows_the_fit, noise, problem

import fitting
import jaxsubdiv as js
from fitting import (
    Free,
    Landmarks,
    Priors,
    Recipe,
    Residual,
    Scan,
    Sweeps,
    closest_points,
    find_symmetry,
    sparse_solver,
)
from fitting.model.pairing import make_scene
from fitting.model.priors import REGISTER
from fitting.model.priors.boundary import BoundaryCurve
from fitting.model.priors.contact import Contacts
from fitting.model.priors.landmarks import anchor_landmarks
from fitting.model.priors.shifts import SlicePlanes
from fitting.model.priors.valves import ValvePoints
from fitting.model.procrustes import align_shape
from fitting.run.fit import sound_start
from fitting.scan.frames import Frames
from fitting.scan.layers import stack_meshes
from fitting.scan.regions import RegionMatch
from fitting.solve import sweeps
from fitting.solve.conjugate_gradients import ConjugateGradients
from fitting.solve.strengths import FromScan, first_strengths
from fitting.solve.sweeps import Subject, subject_residual
from fitting.start.folds import Folds

# Sweeps


SWEEPS = {
    "plain": {},
    "likeness": {"priors": Priors(likeness=0.5)},
    "nonormals": {"free": Free(normals=False)},
    "maskn": {"free": Free(vertices=np.arange(12) % 3 != 0)},
}


@pytest.mark.parametrize("name", SWEEPS)
def test_one_sweep_goes_where_it_always_went(name, monkeypatch):
    """To the last digits: from stored pairs, for the closest point of an edge may lie on either face."""
    with np.load(Path(__file__).with_name("one_sweep.npz")) as file:
        stored = dict(file)
    calls = []

    def find(surface, points, *of_regions):
        calls.append(1)
        first = js.SurfacePoint(jnp.asarray(stored["face"], jnp.int32), jnp.asarray(stored["coordinates"]))
        return first if len(calls) == 1 else closest_points(surface, points, *of_regions)

    monkeypatch.setattr(sweeps, "closest_points", find)
    found = problem().fit(max_sweeps=1, **SWEEPS[name])
    assert len(calls) == 2
    for part, value in (
        ("vertices", found.control.vertices),
        ("normals", found.control.normals),
        ("h", found.scheme.h),
    ):
        np.testing.assert_allclose(value, stored[f"{name}_{part}"], rtol=0, atol=1e-12, err_msg=part)


@functools.cache
def noisy() -> fitting.FitResult:
    return problem().fit(problem().points + noise())


@pytest.fixture
def search_of_the_device(monkeypatch):
    """One search for both linear solvers: of two triangles that are equally near, each search may take another."""
    monkeypatch.setattr(sweeps, "closest_points", eqx.filter_jit(js.search_closest))


def test_sweeps_are_a_solver_that_runs_as_one_program(search_of_the_device):
    p, loss, n_sweeps = problem(), fitting.geman_mcclure(), 3
    control = sound_start(js.Interpolating(), p.topology, p.start, Free())
    model, y = analysed(js.Interpolating(), p.topology, control)
    subject = Subject(model, make_scene(Scan(p.points + noise()), model.refine(y)))
    solver = Sweeps(ConjugateGradients(1e-8, 1000), FromScan(), loss, 0.1, n_sweeps, Folds(p.topology))

    @eqx.filter_jit
    def solve(solver, y, subject):
        return optx.least_squares(subject_residual, solver, y, subject, max_steps=None, throw=False)

    found, expected = solve(solver, y, subject), p.fit(p.points + noise(), max_sweeps=n_sweeps)
    state = found.stats["state"]
    assert found.result == expected.result == optx.RESULTS.nonlinear_max_steps_reached
    np.testing.assert_allclose(state.rms, expected.rms, atol=1e-6)
    np.testing.assert_allclose(found.value.control.vertices, expected.control.vertices, atol=1e-5)
    np.testing.assert_allclose(found.value.shared["h"], expected.scheme.h, atol=1e-5)
    for name in ("bend", "height", "likeness"):
        np.testing.assert_allclose(state.strengths.values[name], expected.fit.strengths.values[name], rtol=1e-4)


def test_conjugate_gradients_come_to_the_surface_of_the_sparse_equations(search_of_the_device):
    found, expected = (
        problem().fit(problem().points + noise(), linear_solver=solver) for solver in ("conjugate gradients", "sparse")
    )
    assert found.result == optx.RESULTS.successful
    on = js.evaluate(expected.surface, closest_points(expected.surface, np.asarray(found.surface.vertices))).points
    assert np.linalg.norm(np.asarray(on) - found.surface.vertices, axis=1).max() < 1e-3 * SIGMA
    # The misfit counts points face by face, and the closest point of an edge may lie on either face.
    np.testing.assert_allclose(found.uncertainty().control, expected.uncertainty().control, rtol=1e-4)


@pytest.mark.parametrize("change", ["shuffled", "moved by rounding"])
def test_surface_does_not_depend_on_order_or_rounding(change):
    """On a scan that has points at the control vertices where the fit starts: no direction leads to these."""
    rng, start = np.random.default_rng(2), np.asarray(problem().start.vertices)
    points = np.asarray(problem().points + noise())
    points[: len(start)] = start
    order = rng.permutation(N_POINTS)
    others = points[order] if change == "shuffled" else points * (1 + 1e-13 * rng.normal(size=points.shape))
    first, other = problem().fit(points), problem().fit(others)
    across = np.sum((np.asarray(other.surface.vertices) - first.surface.vertices) * first.surface.normals, axis=1)
    assert np.percentile(np.abs(across), 95) < 0.1 * np.median(first.uncertainty().surface)
    off = np.linalg.norm(np.asarray(other.control.vertices) - first.control.vertices, axis=1)
    assert np.percentile(off, 95) < 0.02 * float(first.fit.model.edge)


def test_directions_to_points_much_nearer_than_the_noise_are_normals():
    rng, start = np.random.default_rng(2), problem().start
    points = np.asarray(problem().points + noise())
    n = len(start.vertices)
    points[:n] = np.asarray(start.vertices) + 1e-3 * rng.normal(size=(n, 3))
    found = problem().fit(points, max_sweeps=0)
    directions = np.asarray(found.fit.look.pairs.directions)[:n]
    normals = np.asarray(js.evaluate(found.surface, found.at).normals)[:n]
    assert np.abs(np.sum(directions * normals, axis=1)).min() > 0.99


# Other solvers


def test_rows_of_a_fit_are_for_any_solver_of_least_squares():
    fit = problem().fit(problem().points + noise(), tolerance=0.01).fit  # at rest, as the others will be
    model = fit.model
    held, of_offsets = fit.gather_held(), Residual(model).recentre(fit.y)
    solvers = {
        "Levenberg-Marquardt": optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9),
        "Gauss-Newton": optx.GaussNewton(rtol=1e-9, atol=1e-9, linear_solver=sparse_solver(model, fit.y, held)),
    }

    @eqx.filter_jit
    def cost(offset, held):
        return 0.5 * sum(jnp.sum(rows**2) for rows in of_offsets(offset, held).values())

    costs = {}
    for name, solver in solvers.items():
        found = optx.least_squares(of_offsets, solver, of_offsets.zero, held, max_steps=100, throw=False)
        assert found.result == optx.RESULTS.successful, name
        costs[name] = float(cost(found.value, held))
    at_fit, least = float(cost(of_offsets.zero, held)), min(costs.values())
    assert costs["Levenberg-Marquardt"] == pytest.approx(costs["Gauss-Newton"], rel=1e-7)
    # Half a squared standard deviation would be 0.5 for each of 61 unknowns.
    assert least <= at_fit < least + 0.5


def test_rows_for_other_solvers_do_not_depend_on_what_is_fixed():
    fixed = np.arange(12) % 3 == 0
    model, y = analysed(js.Interpolating(), problem().topology, problem().truth, free=Free(vertices=~fixed))
    rows = eqx.filter_jit(Residual(model).recentre(y))
    held, zero = problem().fit(max_sweeps=0).fit.gather_held(), Residual(model).recentre(y).zero
    at_zero, moved, others = (
        rows(eqx.tree_at(lambda one: one.vertices, zero, zero.vertices.at[which].set(1.0)), held)["stretch"]
        for which in (fixed & ~fixed, fixed, ~fixed)
    )
    np.testing.assert_array_equal(moved, at_zero)
    assert np.abs(others - at_zero).max() > 0.01


# Shapes seen before


MODES = np.array([(0.10, -0.06, 0.0), (0.0, 0.05, -0.12)])
"""By what part of its size, in each direction, a mode scales a member of the family."""


REST = 0.3
"""Of what a member has beside the modes, in mm: they are nearly the whole family."""


def member(scores, bend: float = 0.0) -> js.Control:
    """One of the family: scaled along two modes, and bent about y by so much."""
    p = problem()
    vertices = p.truth.vertices * (1 + jnp.asarray(scores) @ MODES)[None]
    vertices = vertices.at[:, 2].add(bend * vertices[:, 0] ** 2 / 24)
    mesh = js.ControlMesh(vertices, p.mesh.faces)
    return mesh.control()


MEMBER = [1.2, -1.5], 0.25
"""That the family was not made from."""


@functools.cache
def family() -> fitting.ShapeModes:
    rng = np.random.default_rng(0)
    scores, bends = rng.normal(size=(12, 2)), rng.normal(scale=0.2, size=12)
    found = fitting.shape_modes([member(*one).vertices for one in zip(scores, bends, strict=True)])
    return fitting.ShapeModes(found.mean, found.modes[:3], found.deviations[:3], REST)


@functools.cache
def lacking() -> tuple[np.ndarray, np.ndarray]:
    """Points of a member that the family was not made from, and which of them the scan lacks."""
    p = problem()
    surface = js.refine(js.Interpolating(p.h), p.topology, member(*MEMBER))
    points = np.asarray(js.sample(surface, N_POINTS, jax.random.key(3)).points)
    return points, points[:, 2] > 4


@functools.cache
def filled(with_shape: bool) -> fitting.FitResult:
    p, (points, hole) = problem(), lacking()
    priors = Priors(shape=family()) if with_shape else Priors()
    weights = np.where(hole, 0.0, 1.0)
    return p.fit(points + 0.3 * noise(), weights=weights, control=p.truth, priors=priors)


def off_hole(found: fitting.FitResult) -> float:
    points = lacking()[0][lacking()[1]]
    away = js.evaluate(found.surface, closest_points(found.surface, points)).points - points
    return float(np.sqrt(np.mean(np.sum(np.asarray(away) ** 2, axis=1))))


def test_shapes_seen_before_fill_what_a_scan_lacks():
    with_shape, without = filled(True), filled(False)
    assert 100 < lacking()[1].sum() < 400
    assert off_hole(with_shape) < 0.5 * off_hole(without)
    mean, truth = np.asarray(family().mean), np.asarray(member(*MEMBER).vertices)
    along = np.einsum("kvx,vx->k", np.asarray(family().modes), align_shape(truth, mean, scale=False) - mean)
    np.testing.assert_allclose(with_shape.fit.y.shared["scores"], along / np.asarray(family().deviations), atol=0.15)
    assert with_shape.report().n_unknowns == without.report().n_unknowns + 3


def test_shapes_seen_before_make_a_hole_more_certain():
    deviations = [filled(with_shape).uncertainty().control for with_shape in (True, False)]
    in_hole = np.asarray(problem().truth.vertices)[:, 2] > 10
    assert np.all(deviations[0][in_hole] < 0.6 * deviations[1][in_hole])
    assert_refit_knows_the_fit(filled(True))


def test_saved_fit_and_recipe_know_the_shapes(tmp_path):
    found = filled(True)
    found.save(tmp_path)
    again = fitting.load(tmp_path)
    np.testing.assert_array_equal(again.fit.y.shared["scores"], found.fit.y.shared["scores"])
    np.testing.assert_allclose(again.uncertainty().surface, found.uncertainty().surface, rtol=1e-9)
    for recipe in (again.recipe, Recipe.from_json(found.recipe.to_json())):
        for name in ("mean", "modes", "deviations"):
            np.testing.assert_array_equal(getattr(recipe.priors.shape, name), getattr(family(), name))
        assert float(recipe.priors.shape.rest) == REST


def test_shapes_of_another_mesh_are_refused():
    other = fitting.ShapeModes(np.zeros((5, 3)), np.ones((1, 5, 3)), np.ones(1))
    with pytest.raises(ValueError, match=r"`Priors\.shape` is of meshes of 5 control vertices; this one has 12"):
        problem().fit(priors=Priors(shape=other))


# Derivatives


@functools.cache
def derivatives() -> tuple[dict, dict, dict, dict]:
    """Of the rows of all priors at a random place: in forward mode, by differences, the weights of sums of rows, and
    the gradients of these sums in reverse mode."""
    sheet = js.ControlMesh(*meshes.grid(3, 2, "quad"))
    above = js.ControlMesh(sheet.vertices + [0.0, 0.0, 0.5], sheet.faces)
    stacked = stack_meshes({"lower": sheet, "upper": above})
    vertices, regions = stacked.vertices, stacked.regions
    mesh, rng = js.ControlMesh(10.0 * vertices, stacked.faces), np.random.default_rng(0)
    scheme, n = js.Interpolating(), len(vertices)
    topology = js.build_topology(mesh, scheme, 1)
    start = mesh.control()
    control = js.Control(start.vertices + rng.normal(size=(n, 3)), unit(start.normals + 0.2 * rng.normal(size=(n, 3))))
    family = fitting.shape_modes(10 * vertices + rng.normal(size=(4, n, 3)))
    landmarks = Landmarks(rng.normal(size=(2, 3)), np.asarray([0, 4]))
    inputs = {
        "landmarks": anchor_landmarks(landmarks, 1.0, topology, start, js.refine(scheme, topology, start)),
        "boundary": BoundaryCurve(np.asarray(start.vertices)[:5] + rng.normal(size=(5, 3)), 0.5),
        "symmetry": find_symmetry(mesh),
        "slices": SlicePlanes(np.arange(2), np.tile(np.eye(3)[:2], (2, 1, 1))),
        "frames": Frames(rng.normal(size=(3, 3)), np.ones(3, int), True),
    }
    assert regions is not None
    inputs |= {"regions": RegionMatch(regions, ()), "layers": regions.names}
    upper, lower = (np.isin(np.arange(12), rows) for rows in ((0, 1, 2), (3, 4, 5)))
    slices = np.array([0, 1, -1])
    inputs["valves"] = ValvePoints(rng.normal(size=(3, 3)), slices, np.zeros(3, int), upper[None], lower)
    model, y = analysed(scheme, topology, control, priors=Priors(shape=family, symmetry=1.0, contact=0.25), **inputs)
    assert [prior.name for prior in model.priors] == [kind.name for kind in REGISTER]
    held = model.hold(model.place(y, model.refine(y)), first_strengths(model).values | {"likeness": jnp.asarray(0.5)})
    weights = np.array([[-1, 0.3, 0.3, 0.4], [-0.5, -0.5, 0.2, 0.8]])
    corners, away = np.array([[0, 3, 4, 7], [1, 2, 8, 9]]), unit(rng.normal(size=(2, 3)))
    held["contact"] = Contacts(corners, weights, away, np.full(2, 1e3), np.array([0.5, 2.0]))
    place = jnp.asarray(0.1 * rng.normal(size=model.layout.n))

    def rows(vector):
        moved = model.retract(y, model.layout.split(vector))
        there = model.place(moved, model.refine(moved))
        return {prior.name: prior.rows(there, held[prior.name]) for prior in model.priors}

    weights = {name: rng.normal(size=row.shape) for name, row in jax.eval_shape(rows, place).items()}

    def sums(vector):
        return {name: jnp.sum(weights[name] * row) for name, row in rows(vector).items()}

    step = 1e-5 * np.eye(model.layout.n)
    beside = jax.jit(jax.vmap(rows))(place[None] + np.concatenate([step, -step]))
    by_differences = {name: np.subtract(*np.split(np.asarray(beside[name]), 2)).T / 2e-5 for name in weights}
    return jax.jit(jax.jacfwd(rows))(place), by_differences, weights, jax.jit(jax.jacrev(sums))(place)


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.mark.parametrize("name", [kind.name for kind in REGISTER])
def test_derivatives_of_a_prior_are_those_of_differences(name):
    forward, by_differences, weights, reverse = (of[name] for of in derivatives())
    size = np.abs(forward).max()
    assert size > 0
    np.testing.assert_allclose(forward, by_differences, rtol=0, atol=1e-8 * size)
    np.testing.assert_allclose(reverse, weights @ np.asarray(forward), rtol=0, atol=1e-12 * size * len(weights))
