"""The prior of likeness: holes are filled as the control mesh is shaped, as far as the rest of the scan is like it."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scans import SIGMA, analysed, assert_refit_knows_the_fit, problem

import fitting
import jaxsubdiv as js
from fitting import Priors
from fitting.model.priors.bend import bend_asymmetry
from fitting.model.priors.height import bend_height
from fitting.model.unknowns import Variables
from fitting.solve.strengths import first_strengths, next_likeness

SCHEME = js.Interpolating(1.2)


class Anatomy(NamedTuple):
    """With details of its own, which a scan shows but for a hole."""

    mesh: js.ControlMesh
    topology: js.Topology
    template: js.Control
    """The same anatomy of another person: bent, by nothing that changes over a control edge."""
    points: np.ndarray
    """Exact ones."""
    scan: fitting.Scan

    def fit(self, **options) -> fitting.FitResult:
        given = {"scheme": SCHEME, "topology": self.topology, "control": self.template, "scan": self.scan}
        return fitting.fit(**(given | {"throw": False} | options))


@functools.cache
def anatomy() -> Anatomy:
    rng = np.random.default_rng(0)
    smooth = js.refine(SCHEME, problem().topology, problem().truth)
    mesh = js.ControlMesh(np.asarray(smooth.vertices) + rng.normal(scale=0.8, size=(42, 3)), smooth.faces)
    topology, truth = js.build_topology(mesh, SCHEME, 1), mesh.control()
    points = np.asarray(js.sample(js.refine(SCHEME, topology, truth), 1500, jax.random.key(0)).points)
    bent = np.eye(3) + [[0.01, 0.01, 0.0], [0.0, -0.01, 0.0], [0.01, 0.0, 0.01]]
    template = js.Control(truth.vertices @ bent.T, truth.normals @ np.linalg.inv(bent))
    there = ~in_hole(points)
    scan = fitting.Scan(points + rng.normal(scale=SIGMA, size=points.shape), weights=there.astype(float))
    return Anatomy(mesh, topology, template, points, scan)


def in_hole(points) -> np.ndarray:
    return np.asarray(points)[:, 0] < -12


@functools.cache
def fitted(likeness: float | None) -> fitting.FitResult:
    return anatomy().fit(priors=Priors(likeness=likeness))


def off(result: fitting.FitResult) -> float:
    """RMS distance in mm between the surface and the true points that were left out."""
    points = anatomy().points[in_hole(anatomy().points)]
    on = js.evaluate(result.surface, fitting.closest_points(result.surface, points)).points
    return float(np.sqrt(np.mean(np.sum((points - np.asarray(on)) ** 2, axis=1))))


class Expected(NamedTuple):
    """What a sweep would expect of a control mesh, of a fit that started from the template."""

    bends: np.ndarray
    heights: np.ndarray | None
    edges: np.ndarray


def expected(priors: Priors, control: js.Control) -> Expected:
    model, y = analysed(SCHEME, anatomy().topology, anatomy().template, priors=priors)
    y = Variables(control, y.shared)
    held = model.hold(model.place(y, model.refine(y)), first_strengths(model).values)
    heights = held.get("height")
    return Expected(
        np.asarray(held["bend"]),
        None if heights is None else np.asarray(heights),
        np.asarray(model.prior("bend").edges),
    )


def test_hole_is_filled_as_the_control_mesh_is_shaped():
    assert off(fitted(0.7)) < 0.6 * off(fitted(0.0))
    assert off(fitted(None)) < 0.85 * off(fitted(0.0))


def test_likeness_is_found():
    """About 1 of the same anatomy, bent; less, the more its bends have nothing to do with the scan's."""
    assert 0.8 < fitted(None).likeness <= 1
    template, leans = anatomy().template, np.random.default_rng(0).normal(size=(42, 3))
    others = (js.Control(template.vertices, template.normals + part * leans) for part in (0.2, 0.6))
    likenesses = [anatomy().fit(control=other).likeness for other in others]
    assert likenesses[1] < 0.3 < likenesses[0] < 0.8


def test_likeness_that_makes_measured_bends_most_probable():
    """Of bends that are measured one by one, against the weighted regression that this then is."""
    rng, n = np.random.default_rng(0), 300
    expected, precision, data = rng.normal(size=n), rng.uniform(1, 4, n), rng.uniform(0.5, 2, n)
    measured = 0.6 * expected + rng.normal(size=n) * np.sqrt(1 / precision + 1 / data)
    likeness = 0.0
    for _ in range(30):
        # The most probable departures from what is expected, given the likeness.
        left = (measured - likeness * expected) * data / (data + precision)
        likeness = next_likeness(
            likeness,
            expected,
            precision,
            left,
            lambda rows: rows,
            lambda sides: sides / (precision + data)[:, None],
        )
    weights = 1 / (1 / precision + 1 / data)
    curvature = np.sum(weights * expected**2) + 1
    assert abs(likeness - np.sum(weights * expected * measured) / curvature) < curvature**-0.5 < 0.1
    assert 0.5 < likeness < 0.7


def test_likeness_of_no_bends_stays_nothing():
    nothing = np.zeros(4)
    assert next_likeness(0.0, nothing, np.ones(4), np.ones(4), lambda rows: rows, lambda sides: sides) == 0


def test_smoothness_that_is_given_has_nothing_to_be_like():
    given = anatomy().fit(priors=Priors(bend=1.0), max_sweeps=3)
    assert given.likeness == 0 and fitted(0.0).likeness == 0
    both = expected(Priors(bend=1.0, likeness=0.5), anatomy().template)
    of_half = expected(Priors(likeness=0.5), anatomy().template)
    np.testing.assert_array_equal(both.bends, of_half.bends)
    assert both.heights is None and len(of_half.heights)


def test_template_without_bends_does_not_fix_the_size():
    """A sphere of half the curvature, whose bends are all alike: what is expected gives way to the scan."""
    x = np.asarray(anatomy().mesh.vertices)
    directions = x / np.linalg.norm(x, axis=1, keepdims=True)
    sphere = js.Control(jnp.asarray(16 * directions), jnp.asarray(directions))
    points = 15 * directions[np.arange(1500) % 42] + np.random.default_rng(0).normal(scale=1.0, size=(1500, 3))
    points = fitting.Scan(18 * points / np.linalg.norm(points, axis=1, keepdims=True))
    found = anatomy().fit(control=sphere, scan=points)
    assert found.rms[-1] < 0.1 < 1 < found.rms[0]


def test_likeness_is_a_share_of_the_bends_at_the_start():
    template = anatomy().template
    nothing = expected(Priors(likeness=0.0), template)
    assert not np.any(nothing.bends) and nothing.heights is None
    whole, half = (expected(Priors(likeness=share), template) for share in (1.0, 0.5))
    surface = js.refine(SCHEME, anatomy().topology, template)
    np.testing.assert_allclose(whole.bends, bend_asymmetry(surface, whole.edges), atol=1e-5)
    np.testing.assert_allclose(half.bends, 0.5 * whole.bends, rtol=1e-5)
    assert np.abs(whole.bends).max() > 0.1
    for share in (whole, half):
        np.testing.assert_allclose(share.heights, bend_height(surface, share.edges), atol=1e-5)


def test_height_of_an_edge_is_half_its_curvature_times_the_squared_length():
    """On a sphere, below the tangent planes of both ends."""
    x = np.array([(1.0, 0, 0), (np.cos(0.1), np.sin(0.1), 0)])
    surface = js.RefinedSurface(
        jnp.asarray(5 * x), jnp.asarray(x), {3: jnp.zeros((0, 3), int), 4: jnp.zeros((0, 4), int)}
    )
    length = np.linalg.norm(5 * (x[1] - x[0]))
    np.testing.assert_allclose(bend_height(surface, np.array([(0, 1), (1, 0)])), -0.5 / 5 * length**2)


def test_expected_bends_grow_with_the_mesh_and_not_with_its_place():
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    control = anatomy().template
    larger = js.Control(3 * control.vertices @ turn.T + jnp.array([[5.0, 6.0, 7.0]]), control.normals @ turn.T)
    once, thrice = (expected(Priors(likeness=1.0), one) for one in (control, larger))
    np.testing.assert_allclose(thrice.bends, 3 * once.bends, atol=1e-4)
    np.testing.assert_allclose(thrice.heights, 3 * once.heights, atol=1e-4)


@pytest.mark.parametrize("likeness", [0.7, None])
def test_refit_and_saved_fit_know_the_likeness(tmp_path, likeness):
    found = fitted(likeness)
    points = jnp.asarray(found.scan.points)
    assert_refit_knows_the_fit(found)
    along = jnp.asarray([[0.0, 0.0, 0.5]])
    _, again = found.refit()(points + along)
    np.testing.assert_allclose(jnp.mean(again.vertices - found.control.vertices, axis=0), along[0], atol=0.05)
    found.save(tmp_path)
    loaded = fitting.load(tmp_path)
    assert loaded.recipe.priors.likeness == (None if likeness is None else pytest.approx(0.7))
    assert loaded.likeness == found.likeness > 0.5
    np.testing.assert_array_equal(loaded.uncertainty().control, found.uncertainty().control)
    _, third = loaded.refit()(points + along)
    np.testing.assert_allclose(third.vertices, again.vertices, atol=1e-3)


def test_refuses_another_number_of_faces():
    with pytest.raises(ValueError, match=r"`alike` must say it of each of the 56 control faces; got \[3\]"):
        anatomy().fit(alike=np.ones(3, bool))


@pytest.mark.parametrize("share", [-0.1, 1.5, np.nan])
def test_refuses_what_is_no_share(share):
    with pytest.raises(ValueError, match=r"the likeness is a share, from 0 to 1"):
        Priors(likeness=share)


@functools.cache
def cohort(likeness: float | None) -> fitting.Cohort:
    tables = SCHEME, anatomy().topology, anatomy().template
    return fitting.fit_cohort(*tables, [anatomy().scan] * 2, priors=Priors(likeness=likeness), pilot=fitted(likeness))


def test_cohort_fills_holes_as_a_fit_does():
    alone, like, smooth = fitted(None), cohort(None).result(1), cohort(0.0).result(1)
    assert like.likeness == alone.likeness and smooth.likeness == 0
    assert off(like) < 1.2 * off(alone) and off(like) < 0.6 * off(smooth)


def test_cohort_is_as_like_as_it_is_told_to_be_whatever_its_pilot_found():
    tables = SCHEME, anatomy().topology, anatomy().template
    found = fitting.fit_cohort(*tables, [anatomy().scan], priors=Priors(likeness=0.0), pilot=fitted(None))
    assert found.result(0).likeness == 0 and not np.any(found.result(0).fit.gather_held().priors["bend"])


def test_cohort_expects_no_heights_of_which_its_pilot_knows_no_strength():
    tables = SCHEME, anatomy().topology, anatomy().template
    found = fitting.fit_cohort(*tables, [anatomy().scan] * 2, pilot=fitted(0.0))
    smooth = cohort(0.0)
    np.testing.assert_allclose(found.control.vertices, smooth.control.vertices, atol=0.01)


def test_only_faces_that_are_said_to_are_like_the_start():
    none = np.zeros(anatomy().mesh.n_faces, bool)
    of_none, of_all = (anatomy().fit(alike=of, priors=Priors(likeness=0.7)) for of in (none, ~none))
    assert off(of_none) == pytest.approx(off(fitted(0.0))) and off(of_all) == pytest.approx(off(fitted(0.7)))


def test_split_mesh_is_expected_to_stay_as_it_is_where_there_are_no_points(monkeypatch, tmp_path):
    fits = []

    def fit_and_tell(scheme, topology, control, scan, **options):
        found = fitting.fit(scheme, topology, control, scan, **options)
        fits.append((control, options, found))
        return found

    monkeypatch.setattr(fitting.run.fit_scan, "fit", fit_and_tell)
    mesh = js.ControlMesh(anatomy().template.vertices, anatomy().mesh.faces, anatomy().template.normals)
    options = {"levels": 1, "pose": None, "tolerance_mm": 1e-3, "most_faces": 4 * mesh.n_faces, "max_sweeps": 8}
    result = fitting.fit_scan(anatomy().scan, mesh, scheme=SCHEME, throw=False, **options).result
    (_, first, coarse), (start, then, _) = fits
    result.save(tmp_path)
    again = fitting.load(tmp_path)
    np.testing.assert_allclose(again.uncertainty().surface, result.uncertainty().surface, rtol=1e-9)
    assert again.likeness == result.likeness == np.mean(np.asarray(result.fit.gather_held().priors["bend"]) != 0)
    assert first["priors"].likeness is None and "alike" not in first
    assert then["priors"].likeness == 1 and result.recipe.priors.likeness is None
    # Points that count lie on the parts of faces that are not to stay as they are, and those lie where the points do.
    counted = coarse.inliers & (coarse.weights > 0)
    of_points = np.unique(np.asarray(coarse.at.face)[counted] // 4)
    np.testing.assert_array_equal(np.flatnonzero(~then["alike"].reshape(-1, 4).all(axis=1)), of_points)
    faces = np.concatenate(
        [np.asarray(start.vertices)[rows].mean(axis=1) for rows in result.control_mesh.faces.values()]
    )
    assert 20 <= then["alike"].sum() <= 80
    assert faces[then["alike"], 0].max() < faces[~then["alike"], 0].mean()


def test_mesh_made_from_the_scan_is_like_nothing():
    scan = fitting.Scan(anatomy().points)
    made = fitting.fit_scan(scan, faces=40, levels=2, throw=False, max_sweeps=2).result
    assert made.likeness == 0 and made.recipe.priors.likeness is None
    with pytest.raises(ValueError, match=r"is to a template, and there is none: give one"):
        fitting.fit_scan(scan, priors=Priors(likeness=0.5))
