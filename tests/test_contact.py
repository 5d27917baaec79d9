"""Fits whose surface does not pass through itself."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scans import analysed, hold_everything, noise, problem

import fitting
import jaxsubdiv as js
from fitting import Landmarks, Priors, Residual
from fitting.model.pairing import make_scene
from fitting.solve.collision_free import make_guard
from fitting.solve.sparse_normal import SparseEquations
from fitting.solve.strengths import first_strengths
from fitting.solve.structure import find_structure
from fitting.solve.sweeps import measure_look

pytest.importorskip("ipctk")

FLAT = jnp.asarray([[1, 1, 0.02]])


def n_crossing(result: fitting.FitResult) -> int:
    return len(js.find_crossings(result.surface).triangles)


def top_and_below() -> tuple[int, np.ndarray]:
    """A control vertex at the top, and a place below the bottom."""
    vertices = np.asarray(problem().start.vertices)
    top = int(np.argmax(vertices[:, 2]))
    return top, vertices[top] * (1, 1, -1.6)


# Fits


@functools.cache
def pulled(contact: float) -> fitting.FitResult:
    """Whose landmark has the top below the bottom."""
    top, below = top_and_below()
    marks = Landmarks([below], [top])
    return problem().fit(landmarks=marks, landmark_deviation=0.02, priors=Priors(contact=contact), max_sweeps=8)


def test_a_surface_that_is_pulled_through_itself_stops_before():
    free, guarded = pulled(0.0), pulled(0.25)
    assert free.fit.model.prior("contact") is None and guarded.fit.model.prior("contact") is not None
    assert n_crossing(free) > 5 and n_crossing(guarded) == 0
    finding = next(one for one in free.warnings if one.name == "surface_crosses_itself")
    assert finding.numbers["triangles"] == n_crossing(free) and finding.numbers["at_start"] == 0
    assert finding.text.endswith("The surface did not where the fit started.")
    assert "surface_crosses_itself" not in [one.name for one in guarded.warnings]
    top, _ = top_and_below()
    went = np.linalg.norm(np.asarray(guarded.control.vertices)[top] - np.asarray(problem().start.vertices)[top])
    assert went > 5  # mm, as far as it could


def test_where_nothing_is_near_a_fit_is_the_same_bit_for_bit():
    found, expected = (problem().fit(problem().points + noise(), priors=Priors(contact=c)) for c in (0.25, 0.0))
    for one, other in zip(jax.tree.leaves(found.fit.y), jax.tree.leaves(expected.fit.y), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found.rms, expected.rms)
    assert found.report().crossing_triangles == 0


def test_the_report_names_what_crosses_where_the_fit_starts():
    crossed = pulled(0.0)
    found = problem().fit(scheme=crossed.scheme, control=crossed.control, max_sweeps=0)
    triangles = js.find_crossings(found.surface).triangles
    finding = next(one for one in found.warnings if one.name == "surface_crosses_itself")
    assert finding.numbers["at_start"] == len(triangles) > 0
    assert f"{len(triangles)} did already, rows {triangles[0]}, {triangles[1]}," in finding.text
    assert found.report().crossing_triangles == len(triangles)


def test_without_ipctk_the_report_says_that_nothing_was_looked_for(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ipctk", None)
    with pytest.raises(ImportError, match="fits whose surface must not cross itself need ipctk"):
        problem().fit(priors=Priors(contact=0.25), max_sweeps=1)
    found = problem().fit(max_sweeps=1)
    report = found.report()
    assert report.crossing_triangles is None
    assert dict(report.as_rows())["triangles that cross others"].startswith("not looked for")


def test_contacts_without_a_guard_are_refused():
    p, asked = problem(), Priors(contact=0.25)
    with pytest.raises(ValueError, match="takes the sparse solver"):
        p.fit(priors=asked, linear_solver="conjugate gradients")
    scans = [fitting.Scan(p.points)] * 2
    with pytest.raises(ValueError, match="a cohort is fitted without"):
        fitting.fit_cohort(js.Interpolating(), p.topology, p.start, scans, priors=asked)


def test_reach_out_of_range_is_refused():
    with pytest.raises(ValueError, match=r"`contact`: the reach of contacts is a part of a triangle's height"):
        Priors(contact=0.6)


# Contacts


@functools.cache
def flat():
    """The mesh of the problem, so flat that its top and its bottom are near, and the scan as seen from it."""
    p = problem()
    control = js.Control(p.truth.vertices * FLAT, p.truth.normals)
    model, y = analysed(js.Interpolating(), p.topology, control, priors=Priors(contact=0.25))
    guard, surface = make_guard(model, y), model.refine(y)
    assert guard is not None
    scene = make_scene(fitting.Scan(p.points * np.asarray(FLAT)), surface)
    look = measure_look(model, y, surface, scene, fitting.geman_mcclure(), first_strengths(model).values)
    guard.reach = 2.0  # the triangles of the rim are no higher than the mesh
    look = look._replace(distances=np.full(len(look.distances), 9.0), weights=np.ones(len(look.weights)))
    return model, y, guard, surface, look, np.zeros(model.topology.n_control_faces, bool)


def test_contacts_are_places_that_lie_near_each_other():
    *_, guard, surface, look, none = flat()
    held, x = guard.find_contacts(surface, look, none), np.asarray(surface.vertices)
    assert len(held.reach) > 5 and (held.gap < held.reach).all()
    np.testing.assert_allclose(held.weights.sum(axis=1), 0, atol=1e-12)
    apart = np.einsum("ci,cix->cx", held.weights, x[held.corners])
    np.testing.assert_allclose(apart, held.gap[:, None] * held.directions, atol=1e-9)
    # Nearest places of two edges are at right angles to both, and those of a vertex and a triangle to its sides.
    inside = (np.abs(held.weights) > 1e-6).all(axis=1)
    side = x[held.corners[inside, 3]] - x[held.corners[inside, 2]]
    assert inside.any()
    np.testing.assert_allclose(np.sum(side * held.directions[inside], axis=1), 0, atol=1e-6)
    assert not len(guard.find_contacts(surface, look, ~none).reach)  # of faces that cross, none


def test_the_reach_gives_way_to_layers_of_the_scan():
    *_, guard, surface, look, none = flat()
    usual = guard.find_contacts(surface, look, none)  # the scan's layers lie far outside of the surface
    near = guard.find_contacts(surface, look._replace(distances=np.full(len(look.distances), 0.4)), none)
    assert len(near.reach) < len(usual.reach) and near.reach.max() < usual.reach.max()
    # Top and bottom are 0.6 mm apart, the layers of the scan 0.4 mm farther out on both sides: half of 1.4 mm.
    between = np.isclose(near.gap, 0.6, atol=0.05)
    assert between.any() and near.reach[between].max() < 0.75


def test_equations_know_the_derivatives_of_contacts_and_couple_both_sides():
    model, y, guard, surface, look, none = flat()
    alone = hold_everything(model, y, look.pairs, np.asarray(look.at.face))
    held = alone._replace(priors=alone.priors | {"contact": guard.find_contacts(surface, look, none)})
    structure = find_structure(model, y, alone.priors)
    found, before = (SparseEquations(structure, model, y, one) for one in (held, alone))

    def rows(vector):
        return Residual(model).rows(model.retract(y, model.layout.split(vector)), held)["contact"]

    zero = jnp.zeros(model.layout.n)
    expected = np.asarray(jax.jit(jax.jacfwd(rows))(zero))
    by, size = found.jacobian("contact").toarray(), np.abs(expected).max()
    np.testing.assert_allclose(found.values["contact"], rows(zero), rtol=1e-9)
    np.testing.assert_allclose(by, expected, atol=1e-9 * size)
    np.testing.assert_allclose(found.gradient - before.gradient, by.T @ found.values["contact"], atol=1e-9 * size**2)
    unit = np.eye(model.layout.n)
    change = found.multiply(found.prior, unit) - before.multiply(before.prior, unit)
    np.testing.assert_allclose(change, by.T @ by, atol=1e-9 * size**2)
    with pytest.raises(ValueError, match="the rows of 'contact' depend on unknowns far apart"):
        fitting.sparse_solver(model, y, held)


# Steps


def test_a_step_is_shortened_where_it_crosses_and_elsewhere_taken():
    p, (top, below) = problem(), top_and_below()
    model, y = analysed(js.Interpolating(), p.topology, p.start, priors=Priors(contact=0.25))
    guard = make_guard(model, y)
    assert guard is not None
    step, asked = np.zeros(model.layout.n), []
    table = step[: model.layout.n_own].reshape(-1, model.layout.width)
    table[:, 0] = 0.1
    table[top, :3] += below - np.asarray(p.start.vertices)[top]

    def refine(offset):
        return model.refine(model.retract(y, model.layout.split(jnp.asarray(offset))))

    def solve_again(corners):
        asked.append(corners)
        return step

    none = np.zeros(model.topology.n_control_faces, bool)
    assert guard.crossing_faces(refine(step)).any()
    found, whole = guard.shorten(step, none, model.layout, refine, solve_again)
    assert not guard.crossing_faces(refine(found)).any()
    assert asked[0][top] and whole > 0
    taken = found[: model.layout.n_own].reshape(-1, model.layout.width)
    assert 0 < np.linalg.norm(taken[top]) < np.linalg.norm(table[top])
    # Where nothing helps, no step is taken; where that crossed before, all of it.
    crossed = refine(step)
    assert not guard.shorten(step, none, model.layout, lambda _: crossed, solve_again)[0].any()
    np.testing.assert_array_equal(guard.shorten(step, ~none, model.layout, refine, solve_again)[0], step)
