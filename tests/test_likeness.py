"""The prior of likeness: holes are filled as the control mesh is shaped, where a fit is told that it should be."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting import Free, Priors
from fitting._problem import Problem

SCHEME = js.Interpolating(1.2)


@functools.cache
def template() -> js.Control:
    """The true anatomy, bent as another person's may be: by nothing that changes over a control edge."""
    truth = problem().truth
    x, normals = np.asarray(truth.vertices), np.asarray(truth.normals)
    bent = np.eye(3) + [[0.05, 0.03, 0.0], [0.0, -0.06, 0.02], [0.03, 0.0, 0.02]]
    return js.Control(jnp.asarray(x @ bent.T), jnp.asarray(normals @ np.linalg.inv(bent)))


def in_hole(points) -> np.ndarray:
    return np.asarray(points)[:, 0] < 0


@functools.cache
def fitted(likeness: float) -> fitting.FitResult:
    """To half of a noisy scan, from the bent anatomy."""
    there = ~in_hole(problem().points)
    points = problem().points + noise()
    return problem().fit(points, weights=there.astype(float), control=template(), priors=Priors(likeness=likeness))


def off(result: fitting.FitResult) -> float:
    """RMS distance in mm between the surface and the true points that were left out."""
    points = problem().points[in_hole(problem().points)]
    on = js.evaluate(result.surface, fitting.closest_points(result.surface, points)).points
    return float(np.sqrt(np.mean(np.sum((points - np.asarray(on)) ** 2, axis=1))))


def expected(priors: Priors, control: js.Control) -> np.ndarray | None:
    of = Problem(SCHEME, problem().topology, template(), Free(), priors)
    return of.start(SCHEME, control).expected


def test_hole_is_filled_as_the_control_mesh_is_shaped():
    assert off(fitted(0.7)) < 0.5 * off(fitted(0.0))


def test_likeness_is_a_share_of_the_bends_at_the_start():
    assert expected(Priors(), template()) is None
    whole, half = (expected(Priors(likeness=share), template()) for share in (1.0, 0.5))
    surface = js.refine(SCHEME, problem().topology, template())
    np.testing.assert_allclose(whole, fitting._residuals.bend_asymmetry(problem().topology, surface), atol=1e-5)
    np.testing.assert_allclose(half, 0.5 * np.asarray(whole), rtol=1e-5)
    assert np.abs(whole).max() > 0.1


def test_expected_bends_grow_with_the_mesh_and_not_with_its_place():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    control = template()
    larger = js.Control(3 * control.vertices @ turn.T + jnp.array([[5.0, 6.0, 7.0]]), control.normals @ turn.T)
    once, thrice = (np.asarray(expected(Priors(likeness=1.0), one)) for one in (control, larger))
    np.testing.assert_allclose(thrice, 3 * once, atol=1e-4)


def test_refit_and_saved_fit_know_the_likeness(tmp_path):
    found = fitted(0.7)
    points = jnp.asarray(found.scan.points)
    _, again = found.refit()(points)
    by = np.linalg.norm(np.asarray(again.vertices - found.control.vertices), axis=1)
    assert by.max() < 0.1 < np.abs(np.asarray(found.control.vertices - fitted(0.0).control.vertices)).max()
    found.save(tmp_path)
    loaded = fitting.load(tmp_path)
    assert float(loaded.recipe.priors.likeness) == pytest.approx(0.7)
    np.testing.assert_array_equal(loaded.uncertainty().control, found.uncertainty().control)
    _, third = loaded.refit()(points)
    np.testing.assert_allclose(third.vertices, again.vertices, atol=1e-3)


@pytest.mark.parametrize("share", [-0.1, 1.5, np.nan])
def test_refuses_what_is_no_share(share):
    with pytest.raises(ValueError, match=r"the likeness is a share, from 0 to 1"):
        Priors(likeness=share)


def test_cohort_says_that_it_has_none():
    with pytest.raises(ValueError, match=r"a cohort has no prior of likeness"):
        fitting.fit_cohort(
            SCHEME,
            problem().topology,
            template(),
            [fitting.Scan(problem().points)],
            priors=Priors(likeness=0.5),
        )


def test_likeness_needs_a_template_that_is_not_split():
    scan, priors = fitting.Scan(problem().points), Priors(likeness=0.5)
    with pytest.raises(ValueError, match=r"is to a template, and there is none: give one"):
        fitting.fit_scan(scan, priors=priors)
    with pytest.raises(ValueError, match=r"would be split for `tolerance_mm`: leave that out"):
        fitting.fit_scan(scan, problem().mesh, priors=priors, tolerance_mm=0.1)
