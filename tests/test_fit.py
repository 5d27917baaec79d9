"""Fits of a surface that is known: what is found again, what is ignored, and how a fit says that it failed."""

import dataclasses
import functools
import json
import re

import jax
import meshes
import numpy as np
import optimistix as optx
import pytest
from scans import N_POINTS, SIGMA, noise, problem, rms
from schemes import control_mesh

import fitting
import jaxsubdiv as js
from fitting import Free, Priors, Scan, ScanError
from fitting.solve.derivatives import differentiate
from fitting.solve.sparse_normal import SparseEquations

LOOSE = Priors(bend=10.0, stretch=10.0, h=10.0)
"""Priors that leave everything to the scan; where it says nothing they still hold the fit together."""
CONVERGED, NONFINITE = optx.RESULTS.successful, optx.RESULTS.nonfinite


@pytest.fixture(scope="module")
def noisy() -> fitting.FitResult:
    return problem().fit(problem().points + noise())


def to_truth(result: fitting.FitResult) -> float:
    """RMS distance of the fitted surface from the points without their noise."""
    points = problem().points
    at = fitting.closest_points(result.surface, points)
    return rms(np.linalg.norm(js.evaluate(result.surface, at).points - points, axis=1))


def test_exact_scan_of_a_refined_surface_is_met_and_its_control_mesh_found():
    p = problem()
    found = p.fit(priors=LOOSE, loss=fitting.LeastSquares(), tolerance=1e-6, max_sweeps=100)
    assert found.rms[0] > 0.7 and found.rms[-1] < 3e-3
    np.testing.assert_allclose(found.scheme.h, p.h, atol=1e-3)
    np.testing.assert_allclose(found.control.vertices, p.truth.vertices, atol=0.2)
    np.testing.assert_allclose(found.control.normals, p.truth.normals, atol=0.01)


def test_noise_of_the_scan_is_smoothed(noisy):
    assert noisy.result == CONVERGED
    np.testing.assert_allclose(noisy.rms[-1], SIGMA, rtol=0.15)
    assert to_truth(noisy) < 0.6 * SIGMA


def test_result_is_consistent(noisy):
    scan = problem().points + noise()
    np.testing.assert_array_equal(noisy.scan.points, scan)
    surface = js.refine(noisy.scheme, problem().topology, noisy.control)
    np.testing.assert_array_equal(noisy.surface.vertices, surface.vertices)
    np.testing.assert_array_equal(noisy.at.face, fitting.closest_points(surface, scan).face)
    on, normals = js.evaluate(noisy.surface, noisy.at)
    # Coordinates of ten are rounded by more than that share of the smallest distances.
    np.testing.assert_allclose(np.abs(noisy.distances), np.linalg.norm(scan - on, axis=1), rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(noisy.distances > 0, np.sum((scan - on) * normals, axis=1) > 0)
    np.testing.assert_allclose(noisy.rms[-1], rms(noisy.distances), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(noisy.control.normals, axis=1), 1, atol=1e-14)


def test_points_outside_have_positive_distances():
    p = problem()
    for factor, sign in ((1.02, 1), (0.98, -1)):
        found = p.fit(p.points * factor, control=p.truth, scheme=js.Interpolating(p.h), max_sweeps=0)
        assert np.all(sign * found.distances > 0)


def test_same_fit_twice_is_the_same_bit_for_bit(noisy):
    again = problem().fit(problem().points + noise())
    np.testing.assert_array_equal(again.control.vertices, noisy.control.vertices)
    np.testing.assert_array_equal(again.rms, noisy.rms)


def test_points_without_weight_have_no_influence():
    scan, weights = problem().points + noise(), np.ones(N_POINTS)
    weights[::5] = 0
    elsewhere = scan.copy()
    elsewhere[::5] *= 1.05
    a, b = (problem().fit(points, weights=weights, max_sweeps=4) for points in (scan, elsewhere))
    for one, other in zip(jax.tree.leaves((a.control, a.scheme)), jax.tree.leaves((b.control, b.scheme)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-7)  # sums in another order
    assert not np.any(a.weights[::5])
    everywhere = problem().fit(elsewhere, max_sweeps=4)
    assert np.abs(everywhere.control.vertices - b.control.vertices).max() > 0.05


def test_heavier_points_are_met_more_closely():
    p, heavy = problem(), np.arange(N_POINTS) % 2 == 1
    away = p.points / np.linalg.norm(p.points, axis=1, keepdims=True)
    scan = p.points + np.where(heavy, 0.2, -0.2)[:, None] * away
    even, uneven = (p.fit(scan, weights=weights) for weights in (None, np.where(heavy, 20.0, 1.0)))
    assert abs(even.distances.mean()) < 0.03
    assert even.distances[heavy].mean() > 0.12 > 0.06 > uneven.distances[heavy].mean()


def outliers() -> np.ndarray:
    """A noisy scan, a tenth of it off by several millimetres to one side."""
    points = problem().points + noise()
    points[::10] += np.random.default_rng(2).uniform(3, 6, (N_POINTS // 10, 3))
    return points


def test_outliers_lose_weight_and_pull():
    found = problem().fit(outliers())
    far = np.abs(found.distances) > 3
    assert 20 < far.sum() < 70
    assert found.weights[far].max() < 0.35 < 0.8 < found.weights[np.abs(found.distances) < SIGMA].min()
    assert to_truth(found) < SIGMA


def test_control_vertices_without_normals_get_them():
    p = problem()
    normals = np.array(p.start.normals)
    normals[[0, 7]] = 0
    found = p.fit(p.points, control=js.Control(p.start.vertices, normals))
    np.testing.assert_allclose(np.linalg.norm(found.control.normals, axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(found.control.normals, p.truth.normals, atol=0.1)


def test_control_normals_of_any_length_serve(noisy):
    p = problem()
    double = js.Control(p.start.vertices, 2 * p.start.normals)
    np.testing.assert_array_equal(p.fit(p.points + noise(), control=double).rms, noisy.rms)


def test_every_sweep_is_told():
    told = []
    found = problem().fit(problem().points + noise(), on_sweep=told.append)
    assert [sweep.number for sweep in told] == list(range(1, len(found.rms)))
    assert [sweep.rms for sweep in told] == found.robust_rms[1:].tolist()


def test_perfect_start_stays_finite():
    p = problem()
    scan = np.resize(np.asarray(js.refine(js.Interpolating(), p.topology, p.truth).vertices), (N_POINTS, 3))
    found = p.fit(scan, control=p.truth, tolerance=1e-3)
    assert found.result == CONVERGED and found.rms[-1] < 1e-3


def test_too_few_sweeps_are_an_error_in_words():
    with pytest.raises(RuntimeError, match=r"did not converge in 2 sweeps \(RMS 0\.\d+ -> 0\.\d+ mm\): .*`max_sweeps`"):
        problem().fit(max_sweeps=2, throw=True)


@pytest.mark.parametrize("max_sweeps", [0, 2])
def test_too_few_sweeps_are_a_result_where_nothing_is_thrown(max_sweeps):
    found = problem().fit(max_sweeps=max_sweeps)
    assert found.result == optx.RESULTS.nonlinear_max_steps_reached
    assert len(found.rms) == max_sweeps + 1


def broken_from(sweep: int, monkeypatch: pytest.MonkeyPatch, value: float) -> None:
    """Let a sweep and those after it find a value that is not finite."""
    sound, calls = SparseEquations.step, []

    def broken(self, damping, active):
        calls.append(1)
        step = sound(self, damping, active)
        if len(calls) >= sweep:
            step[self.model.layout.width * 3 + 1] = value
        return step

    monkeypatch.setattr(SparseEquations, "step", broken)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_end_the_fit_at_the_last_sound_sweep(monkeypatch, value):
    sound = problem().fit(max_sweeps=2)
    broken_from(3, monkeypatch, value)
    found = problem().fit()
    assert found.result == NONFINITE
    np.testing.assert_array_equal(found.rms, sound.rms)
    np.testing.assert_array_equal(found.control.vertices, sound.control.vertices)
    np.testing.assert_array_equal(found.surface.vertices, sound.surface.vertices)
    json.loads(found.report().as_json())
    assert "NOT CONVERGED: Nonfinite" in str(found.report())


def test_values_that_are_not_finite_are_an_error_in_words(monkeypatch):
    broken_from(1, monkeypatch, np.nan)
    with pytest.raises(RuntimeError, match=r"did not converge in 0 sweeps .* Nonfinite"):
        problem().fit(throw=True)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_no_unit_brings_out_values_that_are_not_finite(unit):
    p = problem()
    found = p.fit(p.points * unit, control=js.Control(p.start.vertices * unit, p.start.normals), max_sweeps=5)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((found.control, found.scheme, found.surface)))
    assert np.isfinite(found.rms).all() and np.isfinite(found.distances).all()


def refused(**options) -> dict:
    return options


def test_refuses_what_cannot_be_fitted():
    p = problem()
    flat = js.build_topology(p.mesh, js.Interpolating(), 0)
    single = js.Control(p.start.vertices.astype(np.float32), p.start.normals.astype(np.float32))
    x, n = p.start.vertices, p.start.normals
    for error, words, options in (
        (ValueError, r"one level or more; this one has none", refused(topology=flat)),
        (
            ValueError,
            r"has 12 control vertices, so .* \[12, 3\]; got \[5, 3\]",
            refused(control=js.Control(x[:5], n[:5])),
        ),
        (ValueError, r"1 levels, so `h` must be .* \[1\]; got \[2\]", refused(scheme=js.Interpolating([1.0, 1.0]))),
        (ValueError, r"default floating dtype, float64; got float32 and float64", refused(control=single)),
        (ValueError, r"got float64 and float32", refused(points=p.points.astype(np.float32))),
        (ValueError, r"vertices or h are not finite", refused(control=js.Control(x.at[0].set(np.nan), n))),
        (ValueError, r"vertices or h are not finite", refused(scheme=js.Interpolating(np.inf))),
        (ValueError, r"control vertices lie on one spot", refused(control=js.Control(0 * x, n))),
        (ScanError, r"11 points for 12 control vertices\. Fit a coarser", refused(points=p.points[:11])),
        (ScanError, r"points lie on one spot", refused(points=np.ones((20, 3)))),
        (
            ScanError,
            r"scan measures 0\.0\d+ across .* mesh 6\d\.\d+: their units differ",
            refused(points=p.points / 1000),
        ),
        (ScanError, r"their units differ.*`scale=` \(1000 for metres\)", refused(points=p.points * 1000)),
    ):
        with pytest.raises(error, match=words):
            p.fit(**options)


def test_start_that_is_far_off_is_warned_of():
    p = problem()
    with pytest.warns(UserWarning, match=r"half of the scan lies over 8\.\d+ mm from the surface.*Align"):
        p.fit(p.points + (25, 0, 0), max_sweeps=0)


def test_sweeps_and_scans_share_one_compiled_program():
    """Whatever the scheme's h, the priors, the weights and the values are; and scans of nearly equal sizes."""
    mesh = control_mesh(meshes.tetrahedron())
    scheme = js.CirclePreserving([1.0])
    topology = js.build_topology(mesh, scheme, 1)
    control = mesh.control(weights="sphere")
    points = np.asarray(
        js.sample(js.refine(js.CirclePreserving([1.1]), topology, control), 100, jax.random.key(0)).points
    )
    before = differentiate._cached._cache_size()
    fit = functools.partial(fitting.fit, topology=topology, control=control, throw=False)
    found = fit(scheme, scan=Scan(points), priors=LOOSE, loss=fitting.LeastSquares(), max_sweeps=9)
    assert len(found.rms) > 3 and found.rms[-1] < 0.1 * found.rms[0]
    assert found.scheme.h.shape == (1,) and isinstance(found.scheme, js.CirclePreserving)
    smooth = {"priors": Priors(likeness=0.0)}  # one that expects the template's curvature has rows more
    fit(js.CirclePreserving([0.9]), scan=Scan(points[:99], weights=np.linspace(0.5, 1, 99)), max_sweeps=2, **smooth)
    assert differentiate._cached._cache_size() == before + 1


@pytest.mark.parametrize("name", ["vertices", "normals", "h"])
def test_only_what_is_free_moves_and_it_is_found(name):
    p, free = problem(), Free(**{other: other == name for other in ("vertices", "normals", "h")})
    vertices = p.start.vertices if free.vertices else p.truth.vertices
    control = js.Control(vertices, p.start.normals if free.normals else p.truth.normals)
    scheme = js.Interpolating(1.0 if free.h else p.h)
    options = {"scheme": scheme, "control": control, "free": free, "priors": LOOSE}
    begin, found = p.fit(**options, max_sweeps=0), p.fit(**options)
    assert found.rms[0] > 0.05 and found.rms[-1] < 3e-3
    for part, truth in (("vertices", p.truth.vertices), ("normals", p.truth.normals), ("h", p.h)):
        before, after = (getattr(r.scheme if part == "h" else r.control, part) for r in (begin, found))
        if part == name:
            assert np.abs(before - truth).max() > 0.1
            np.testing.assert_allclose(after, truth, atol=0.06)
        else:
            np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize("n_far", [0, 60])
def test_points_beyond_an_open_boundary_pull_it_only_when_near(n_far):
    """A sheet of 20 mm grows to a scan that reaches 2 mm beyond it, and leaves a patch that is farther off alone."""
    vertices, faces = meshes.grid(2, 2, "quad")
    mesh, rng = js.ControlMesh(10 * vertices, faces), np.random.default_rng(0)
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    flat = np.concatenate([rng.uniform(-2, 22, (400 - n_far, 2)), rng.uniform(35, 45, (n_far, 2))])
    scan = Scan(np.column_stack([flat, rng.normal(scale=0.1, size=400)]))
    free = Free(normals=False, h=False)
    found = fitting.fit(js.Interpolating(), topology, mesh.control(), scan, free=free)
    assert not np.any(found.weights[400 - n_far :])
    assert found.weights[: 400 - n_far].mean() > 0.9
    x, y = np.asarray(found.control.vertices)[:, :2].T
    for ends in (x.min(), y.min(), 20 - x.max(), 20 - y.max()):
        assert -4.5 < ends < -1.2


def test_report_has_the_numbers_of_the_distances(noisy):
    report, d = noisy.report(), np.abs(noisy.distances)
    assert report.converged and report.reason == "" and report.sweeps == len(noisy.rms) - 1
    assert report.rms_start == noisy.rms[0] and report.rms_per_sweep == noisy.rms.tolist()
    expected = {
        "rms": np.sqrt((d**2).mean()),
        "mean": d.mean(),
        "median": np.sort(d)[[299, 300]].mean(),
        "percentile_95": np.quantile(d, 0.95),
        "maximum": d.max(),
        "bias": noisy.distances.mean(),
        "inlier_share": (d <= 3 * noisy.noise).mean(),
        "rms_inliers": np.sqrt((d[d <= 3 * noisy.noise] ** 2).mean()),
        "noise": noisy.noise,
        "h": float(noisy.scheme.h),
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(report, name), value, rtol=1e-12, err_msg=name)
    assert (report.n_points, report.n_control_vertices, report.n_faces) == (N_POINTS, 12, 8 * 4 + 6 * 4)


def test_report_is_the_same_as_values_and_as_json(noisy):
    report = noisy.report()
    assert set(report.as_dict()) == {field.name for field in dataclasses.fields(report)}
    assert json.loads(report.as_json()) == report.as_dict()


def test_report_in_words(noisy):
    text = str(noisy.report())
    lines = dict(re.split("  +", line, maxsplit=1) for line in text.splitlines())
    assert lines["fit"] == f"converged after {len(noisy.rms) - 1} sweeps"
    assert lines["RMS distance"] == f"{noisy.rms[-1]:.3f} mm (from {noisy.rms[0]:.3f} mm)"
    assert lines["scan points"].startswith("600, ") and lines["tangent length h"] == f"{float(noisy.scheme.h):.4f}"
    cut_off = str(problem().fit(max_sweeps=1).report())
    assert re.match(r"fit +NOT CONVERGED: .*max_sweeps reached", cut_off)


def test_report_of_a_fit_with_one_h_a_level_lists_them():
    report = dataclasses.replace(problem().fit(max_sweeps=0).report(), h=[1.25, 0.5])
    assert "1.2500, 0.5000" in str(report) and json.loads(report.as_json())["h"] == [1.25, 0.5]


def test_report_refuses_numbers_that_json_does_not_have():
    report = dataclasses.replace(problem().fit(max_sweeps=0).report(), rms=float("nan"))
    with pytest.raises(ValueError, match="not JSON compliant"):
        report.as_json()
