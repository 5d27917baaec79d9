"""Slices of a scan: read from files, shifted within their planes, and what the fit makes of it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scans import N_POINTS, assert_refit_knows_the_fit, noise, problem

import fitting
import jaxsubdiv as js
from fitting import Free, Priors, Scan, ScanError, read_scan
from fitting.model.priors.shifts import find_slice_planes
from fitting.scan.slices import find_strokes

N_SLICES = 10
PLANTED = 2.0  # mm: standard deviation of the shifts along each axis


@functools.cache
def sliced() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the known surface in parallel slices, the slice of each, and a shift for each slice within it."""
    p, rng = problem(), np.random.default_rng(4)
    surface = js.refine(js.Interpolating(p.h), p.topology, p.truth)
    points = np.asarray(js.sample(surface, 100_000, jax.random.key(1)).points)
    heights = np.linspace(-13, 13, N_SLICES)
    each = N_POINTS // N_SLICES
    rows = [rng.choice(np.flatnonzero(np.abs(points[:, 2] - z) < 0.1), each, replace=False) for z in heights]
    shifts = np.pad(rng.normal(scale=PLANTED, size=(N_SLICES, 2)), [(0, 0), (0, 1)])
    return points[np.concatenate(rows)], np.repeat(3 * np.arange(N_SLICES), each), shifts - shifts.mean(axis=0)


def displaced() -> Scan:
    points, slices, shifts = sliced()
    return Scan(points - shifts[slices // 3] + 0.3 * noise(), slices=slices)


@functools.cache
def shifted() -> fitting.FitResult:
    return fit_slices()


@functools.cache
def unshifted() -> fitting.FitResult:
    return fit_slices(free=Free(shifts=False))


def fit_slices(scan: Scan | None = None, **options) -> fitting.FitResult:
    p = problem()
    return fitting.fit(js.Interpolating(), p.topology, p.start, scan or displaced(), throw=False, **options)


def off_truth(result: fitting.FitResult) -> float:
    p = problem()
    surface = js.refine(js.Interpolating(p.h), p.topology, p.truth)
    points = js.sample(surface, 2000, jax.random.key(5)).points
    at = fitting.closest_points(result.surface, np.asarray(points))
    return float(jnp.sqrt(jnp.mean((js.evaluate(result.surface, at).points - points) ** 2) * 3))


def rms(rows: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


# Shifts


def test_planted_shifts_are_found():
    planted, result = sliced()[2], shifted()
    np.testing.assert_array_equal(result.slices, 3 * np.arange(N_SLICES))
    assert rms(planted) > 2.5 and rms(result.shifts - planted) < 0.3
    np.testing.assert_allclose(result.shifts[:, 2], 0, atol=0.02)  # within the slices, which lie in z
    # Nearly all that is left is a shift and a shear of the whole, which the slices alone cannot tell.
    height = np.stack([np.ones(N_SLICES), np.arange(N_SLICES)], axis=1)
    left = result.shifts - planted
    assert rms(left - height @ np.linalg.lstsq(height, left, rcond=None)[0]) < 0.08


def test_surface_is_nearer_the_truth_with_shifts_than_without():
    assert off_truth(shifted()) < 0.2 < 0.8 < off_truth(unshifted())
    assert shifted().rms[-1] < 0.12 < 0.5 < unshifted().rms[-1]
    assert unshifted().shifts.shape == (0, 3) and unshifted().slices.shape == (0,)
    assert shifted().report().converged


def test_distances_are_those_of_the_shifted_points():
    result, slices = shifted(), sliced()[1]
    np.testing.assert_allclose(result.points - result.scan.points, result.shifts[slices // 3], atol=1e-12)
    at = fitting.closest_points(result.surface, result.points)
    away = np.linalg.norm(js.evaluate(result.surface, at).points - result.points, axis=1)
    np.testing.assert_allclose(np.abs(result.distances), away, atol=1e-9)
    np.testing.assert_array_equal(result.scan.points, displaced().points)


def test_contour_that_no_shift_mends_is_an_outlier():
    points, slices, _ = sliced()
    middle = points[slices == 15].mean(axis=0)
    grown = np.where((slices == 15)[:, None], middle + 1.4 * (points - middle), points) + 0.1 * noise()
    result = fit_slices(Scan(grown, slices=slices))
    # Its points have in common that they are off, which elsewhere is the surface's error: then it is off by 0.57.
    assert off_truth(result) < 0.15 and result.weights[slices == 15].max() < 0.01


def test_points_of_a_stroke_count_as_few(monkeypatch):
    points, slices, _ = sliced()
    middle, rng = points.mean(axis=0), np.random.default_rng(7)
    across = (points - middle) * (1, 1, 0)
    angle, waves = np.arctan2(across[:, 1], across[:, 0]), np.arange(3, 12)
    phases = rng.uniform(0, 2 * np.pi, size=(3 * N_SLICES, len(waves)))[slices]
    stroke = 0.8 * np.cos(waves * angle[:, None] + phases).sum(axis=1, keepdims=True)  # about 1.7 mm
    drawn = Scan(points + stroke * across / np.linalg.norm(across, axis=1, keepdims=True), slices=slices)
    how = {"free": Free(shifts=False), "priors": Priors(likeness=0.0)}
    few = fit_slices(drawn, **how)
    monkeypatch.setattr("fitting.model.pairing.find_strokes", lambda scan: None)
    many = fit_slices(drawn, **how)
    assert off_truth(few) < 0.9 * off_truth(many)
    deviations = [found.uncertainty() for found in (few, many)]
    posterior = [np.sqrt(of.surface**2 - of.misfit**2).mean() for of in deviations]
    assert posterior[0] > 1.3 * posterior[1]


def test_prior_holds_the_shifts():
    tight, loose = (rms(fit_slices(priors=Priors(shift=sd)).shifts) for sd in (0.01, jnp.inf))
    assert tight < 0.5 < 2.5 < rms(shifted().shifts) < 3.5
    assert loose > 5  # nothing holds a shear of the whole


def test_scan_without_slices_has_no_shifts():
    p = problem()
    result = fit_slices(Scan(p.points + noise()), max_sweeps=2)
    assert result.shifts.shape == (0, 3) and not result.report().shifts
    assert "slices" not in str(result.report())
    np.testing.assert_array_equal(result.points, result.scan.points)


def test_report_has_the_shifts():
    report = shifted().report()
    assert [one.slice for one in report.shifts] == shifted().slices.tolist()
    np.testing.assert_allclose([one.shift for one in report.shifts], shifted().shifts)
    lengths = np.linalg.norm(shifted().shifts, axis=1)
    assert f"10, by RMS {rms(shifted().shifts):.2f} mm and {lengths.max():.2f} mm at most" in str(report)
    assert report.n_unknowns == unshifted().report().n_unknowns + 2 * N_SLICES


def test_uncertainty_knows_that_the_shifts_are_unknown():
    """The surface's covariance is a block of the inverse of the whole: it is wider than if the shifts were known."""
    fit, posterior = shifted().fit, shifted().posterior
    layout, equations = fit.model.layout, posterior.equations
    n = layout.columns("shifts").start
    names = [name for name, of in layout.shared for _ in range(int(np.prod(of.shape, dtype=int)))]
    others = ~np.isin(names, ["shifts", "motion"])  # a motion of the whole goes with the shifts
    with_known = equations.factorise(equations.data.add(equations.prior), fit.loose, others)
    free, known = (of.solve(np.eye(layout.n))[:n, :n] for of in (posterior.factor, with_known))
    assert np.linalg.eigvalsh(free - known).min() > -1e-9
    # As a whole the surface is where the mean of the slices is, to PLANTED or so over their root.
    axis = 5 * np.arange(12)
    place = np.mean(free[np.ix_(axis, axis)]) ** 0.5
    assert 0.7 < place / (3.0 / N_SLICES**0.5) < 1.1
    assert np.mean(known[np.ix_(axis, axis)]) ** 0.5 < 0.2 * place
    np.testing.assert_allclose(np.std(posterior.draws(2000)[axis].mean(axis=0)), place, rtol=0.1)


def test_refit_holds_the_shifts():
    result = shifted()
    assert_refit_knows_the_fit(result)
    _, control = result.refit()(result.scan.points)
    np.testing.assert_allclose(control.vertices, result.control.vertices, atol=1e-6)
    along = jnp.zeros_like(result.scan.points).at[:, 0].set(1.0)
    _, moved = result.refit()(result.scan.points + along)
    np.testing.assert_allclose(jnp.mean(moved.vertices - control.vertices, axis=0), (1, 0, 0), atol=0.1)


def test_saved_fit_has_its_shifts(tmp_path):
    result = shifted()
    result.save(tmp_path)
    again = fitting.load(tmp_path)
    for name in ("shifts", "slices", "points", "distances"):
        np.testing.assert_allclose(getattr(again, name), getattr(result, name), atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(again.scan.slices, result.scan.slices)
    np.testing.assert_allclose(again.uncertainty().surface, result.uncertainty().surface, rtol=1e-9)
    assert again.recipe.free.shifts and float(again.recipe.priors.shift) == 3.0
    with np.load(tmp_path / "fit.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "fit.npz", **(arrays | {"shared_shifts": np.zeros((N_SLICES - 1, 2))}))
    with pytest.raises(ValueError, match=r"fit\.npz: 'shared_shifts' has the shape \[9, 2\] and not \[10, 2\]"):
        fitting.load(tmp_path)


@pytest.mark.parametrize("sweeps", [1, 3])
def test_fit_that_was_stopped_goes_on_with_its_shifts(tmp_path, sweeps):
    def stop(sweep):
        if sweep.number > sweeps:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        fit_slices(checkpoint=tmp_path, on_sweep=stop)
    numbers = []
    again = fit_slices(checkpoint=tmp_path, on_sweep=lambda sweep: numbers.append(sweep.number))
    assert numbers == list(range(sweeps + 1, len(shifted().rms)))
    np.testing.assert_array_equal(again.shifts, shifted().shifts)
    np.testing.assert_array_equal(again.control.vertices, shifted().control.vertices)


def test_cohort_leaves_slices_where_they_are_where_they_are_not_free():
    p = problem()
    options = {"free": Free(shifts=False), "priors": Priors(bend=0.5), "max_sweeps": 1}
    with pytest.warns(UserWarning, match="did not converge"):
        cohort = fitting.fit_cohort(js.Interpolating(), p.topology, p.start, [displaced()], **options)
    assert cohort.result(0).slices.shape == (0,)


# Slices


def test_as_many_points_make_a_measurement_as_share_their_errors():
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    circle = 20 * np.stack([np.cos(angle), np.sin(angle), np.zeros(400)], axis=1)
    points, slices = np.concatenate([circle + (0, 0, z) for z in (0, 8, 16)]), np.repeat([4, 2, 7], 400)
    strokes = find_strokes(Scan(points, slices=slices))
    np.testing.assert_allclose(strokes.most, 8 / (40 * np.sin(np.pi / 400)), rtol=1e-3)
    np.testing.assert_array_equal(slices[strokes.nearest], slices)
    one, r = np.ones(1200), 0.8

    def count(distances, weights):
        return float(strokes.count_points_a_measurement(jnp.asarray(distances), jnp.asarray(weights)))

    assert 1 <= count(rng.normal(size=1200), one) < 1.2
    shared = rng.normal(size=1200)
    for i in range(1, 1200):
        shared[i] = r * shared[i - 1] + (1 - r**2) ** 0.5 * shared[i]
    np.testing.assert_allclose(count(shared, one), (1 + r) / (1 - r), rtol=0.2)
    assert count(one, one) == strokes.most  # a surface that is off
    half = np.where(slices == 4, 0.0, 1.0)  # what does not count has no say
    far = np.where(slices == 4, 100.0, rng.normal(size=1200))
    assert count(far, half) < 1.2 and count(0 * one, one) == 1
    assert find_strokes(Scan(points)) is None and find_strokes(Scan(points, slices=0 * slices)) is None


def test_slices_that_are_short_of_points_or_straight_or_thick_stay():
    rng = np.random.default_rng(0)
    circle = np.stack([np.cos(np.arange(12)), np.sin(np.arange(12)), np.zeros(12)], axis=1)
    parts = {7: circle, 2: circle[:9], 5: circle * (1, 0.05, 1), 9: rng.normal(size=(40, 3)), -1: circle[:, [2, 0, 1]]}
    points = np.concatenate(list(parts.values()))
    slices = np.repeat(list(parts), [len(rows) for rows in parts.values()])
    found = find_slice_planes(Scan(points, slices=slices))
    np.testing.assert_array_equal(found.numbers, [-1, 7])
    np.testing.assert_array_equal(found.rows_of(Scan(points, slices=slices)) >= 0, np.isin(slices, [-1, 7]))
    np.testing.assert_allclose(found.planes[0, :, 0], 0, atol=1e-12)
    np.testing.assert_allclose(found.planes @ found.planes.swapaxes(1, 2), np.tile(np.eye(2), (2, 1, 1)), atol=1e-12)
    ignored = np.where(slices == 7, 0.0, 1.0)
    np.testing.assert_array_equal(find_slice_planes(Scan(points, weights=ignored, slices=slices)).numbers, [-1])
    assert find_slice_planes(Scan(points)) is None
    assert find_slice_planes(Scan(points, slices=np.arange(len(points)))) is None


def test_slices_of_another_scan_have_the_shifts_of_their_numbers():
    scan, result = displaced(), shifted()
    some = np.isin(np.arange(N_POINTS) // 60, [1, 4, 5])
    number = np.where(scan.slices[some] == 12, 100, scan.slices[some])  # which the fit did not see
    part = result.compare_with(Scan(scan.points[some], slices=number))
    by = np.where((number == 100)[:, None], 0.0, result.shifts[scan.slices[some] // 3])
    np.testing.assert_allclose(part.points - scan.points[some], by, atol=1e-12)
    np.testing.assert_allclose(part.distances[number < 100], result.distances[some][number < 100], atol=1e-12)


@pytest.mark.parametrize(
    ("slices", "words"),
    [
        (np.arange(5), r"`slices` must have the shape \[8\]; got \[5\]"),
        (np.full(8, 0.5), "`slices` must be whole numbers below .*, one a point: number the slices"),
        (np.full(8, np.nan), "`slices` must be whole numbers"),
        (["base"] * 8, "`slices` must be whole numbers"),
    ],
)
def test_slices_that_are_no_whole_numbers_or_too_few_are_refused(slices, words):
    with pytest.raises(ScanError, match=words):
        Scan(np.ones((8, 3)), slices=slices)


# Files

TABLE = """x,y,z,contour,slice,weight
0,0,0,SAX_LV_ENDOCARDIAL,3,1
1,0,0,SAX_LV_EPICARDIAL,3,0.5
2,0,0,"LAX_LV_ENDOCARDIAL",1,0.25
3,0,0,MITRAL_VALVE,1,1
"""


def test_tables_have_labels_slices_and_weights(tmp_path):
    path = tmp_path / "heart.csv"
    path.write_text(TABLE)
    for labels, rows in (
        ((), [0, 1, 2, 3]),
        ("lv_endo", [0, 2]),
        (["LV_ENDOCARDIAL"], [0, 2]),
        (("LV_EPI", "valve"), [1, 3]),
    ):
        scan = read_scan(path, labels=labels)
        np.testing.assert_array_equal(scan.points[:, 0], rows)
        np.testing.assert_array_equal(scan.slices, np.array([3, 3, 1, 1])[rows])
        np.testing.assert_array_equal(scan.weights, np.array([1, 0.5, 0.25, 1])[rows])
    path.write_text(TABLE.replace(",slice", ",place").replace(",", ";"))
    assert read_scan(path, labels="valve").slices is None and read_scan(path, labels="valve").n_points == 1
    (tmp_path / "heart.txt").write_text("x y z slice\n1 2 3 -4\n")
    assert read_scan(tmp_path / "heart.txt").slices.tolist() == [-4]


def test_labels_and_slices_that_there_are_not_are_named(tmp_path):
    path = tmp_path / "heart.csv"
    path.write_text(TABLE)
    with pytest.raises(ScanError, match=r"heart\.csv: no row has a label that holds 'RV' or 'AORTA'. It has: LAX_LV_E"):
        read_scan(path, labels=["RV", "AORTA"])
    path.write_text(TABLE.replace(",1,1", ",base,1"))
    with pytest.raises(ScanError, match=r"heart\.csv: the column `slice` has 'base', which is no whole number"):
        read_scan(path)
    np.save(tmp_path / "a.npy", np.zeros((2, 3)))
    with pytest.raises(ScanError, match=r"a\.npy: no row has a label that holds 'x'. It has: no column `label`"):
        read_scan(tmp_path / "a.npy", labels="x")


def test_contours_of_a_heart(shared_data):
    scan = read_scan(shared_data / "heart_guidepoints_a.csv", labels="LV_ENDOCARDIAL")
    assert scan.n_points == 5200 and scan.weights.shape == (5200,)
    np.testing.assert_array_equal(find_slice_planes(scan).numbers, np.arange(1, 21))
