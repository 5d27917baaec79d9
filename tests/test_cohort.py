"""Many scans at once: each fit as a fit of its own, whatever the others are; and the modes of the shapes found."""

import dataclasses
import functools
import json
import warnings

import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import scans

import fitting
import jaxsubdiv as js
from fitting.run.buckets import find_size_class, sort_into_classes
from fitting.run.pilot import is_its_own_start

N_SUBJECTS, SIZES = 3, (600, 500, 550)
PRIORS = fitting.Priors(bend=0.5)


@functools.cache
def start() -> js.Control:
    return js.Control(scans.problem().start.vertices, scans.problem().truth.normals)


@functools.cache
def truths() -> list[js.RefinedSurface]:
    """Surfaces of three sizes."""
    problem = scans.problem()
    stretches = [np.array(row) for row in ((1.0, 1.0, 1.0), (1.05, 0.97, 1.0), (0.96, 1.0, 1.06))]
    controls = [
        js.Control(np.asarray(problem.truth.vertices) * row, np.asarray(problem.truth.normals) / row)
        for row in stretches
    ]
    return [js.refine(js.Interpolating(problem.h), problem.topology, control) for control in controls]


@functools.cache
def subjects() -> tuple[fitting.Scan, ...]:
    """Noisy, of different lengths, the second with outliers."""
    found, rng = [], np.random.default_rng(3)
    for i, (surface, n) in enumerate(zip(truths(), SIZES, strict=True)):
        points = np.array(js.sample(surface, n, jnp.array([0, i], jnp.uint32)).points)
        points += rng.normal(scale=scans.SIGMA, size=points.shape)
        if i == 1:
            points[::20] += rng.normal(scale=8.0, size=points[::20].shape)
        found.append(fitting.Scan(points))
    return tuple(found)


def fitted(chosen=None, **options) -> fitting.Cohort:
    """All options that change the compiled program stay the same from test to test."""
    problem = scans.problem()
    chosen = subjects() if chosen is None else chosen
    given = {"priors": PRIORS, "max_sweeps": 40, "tolerance": 0.01} | options
    return fitting.fit_cohort(js.Interpolating(), problem.topology, start(), chosen, **given)


@functools.cache
def cohort() -> fitting.Cohort:
    return fitted()


def off(surface: js.RefinedSurface, other: js.RefinedSurface) -> float:
    """Root mean square distance from vertices to a surface."""
    points = np.asarray(surface.vertices)
    away = np.asarray(js.evaluate(other, fitting.closest_points(other, points)).points) - points
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def surface(found: fitting.Cohort, i: int) -> js.RefinedSurface:
    return js.RefinedSurface(found.surfaces.vertices[i], found.surfaces.normals[i], found.surfaces.faces)


def test_every_fit_is_as_one_of_its_own():
    found, topology = cohort(), scans.problem().topology
    assert found.converged.all() and len(found) == N_SUBJECTS
    options = {"priors": PRIORS, "tolerance": 0.01, "throw": False}
    for i, scan in enumerate(subjects()[:2]):
        single = fitting.fit(js.Interpolating(), topology, start(), scan, **options)
        of_single, of_cohort = off(truths()[i], single.surface), off(truths()[i], surface(found, i))
        assert of_cohort < 1.1 * of_single + 0.01
        assert off(single.surface, surface(found, i)) < 0.3 * of_single
        assert found.noise[i] == pytest.approx(single.noise, rel=0.1)
        assert found.rms[i][found.sweeps[i]] == pytest.approx(single.rms[-1], rel=0.02)


def test_outliers_lose_their_weight_and_padding_has_none():
    weights = cohort().weights
    assert np.median(weights[1][: SIZES[1] : 20]) < 0.2 < 0.8 < np.median(weights[1][: SIZES[1]])
    for i, n in enumerate(SIZES):
        assert np.all(weights[i][n:] == 0) and np.sum(weights[i][:n] > 0) > 0.9 * n


def test_histories_end_where_the_fits_did():
    found = cohort()
    for i, n in enumerate(found.sweeps):
        for rows in (found.rms[i], found.robust_rms[i]):
            assert np.isfinite(rows[: n + 1]).all() and np.isnan(rows[n + 1 :]).all()
        assert found.robust_rms[i][n] < found.robust_rms[i][0] / 2


def test_one_subject_does_not_affect_another():
    wild = np.array(subjects()[1].points)
    wild[: len(wild) // 2] = np.random.default_rng(0).uniform(-200, 200, (len(wild) // 2, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whether the wild one converges is not what is asked
        found = fitted((subjects()[0], fitting.Scan(wild), subjects()[2]))
    for i in (0, 2):
        np.testing.assert_allclose(found.control.vertices[i], cohort().control.vertices[i], atol=1e-9)
        assert found.sweeps[i] == cohort().sweeps[i]


def test_several_at_once_are_fitted_as_one_by_one():
    found = fitted(at_once=2)
    np.testing.assert_array_equal(found.sweeps, cohort().sweeps)
    # Rounding decides when a sweep is solved well enough: equal as far as the tolerance goes.
    np.testing.assert_allclose(found.robust_rms, cohort().robust_rms, rtol=1e-3)
    for i in range(N_SUBJECTS):
        assert off(surface(cohort(), i), surface(found, i)) < 0.05 * scans.SIGMA


def test_what_did_not_converge_is_told():
    with pytest.warns(UserWarning, match="3 of 3 fits did not converge, of the scans 0, 1, 2"):
        found = fitted(tolerance=0.0)
    assert not found.converged.any() and np.all(found.sweeps == 40)
    assert not found.result(0).report().converged


class Stopped(Exception):
    """As if by Ctrl-C."""


def test_a_cohort_that_was_stopped_goes_on(tmp_path):
    """Bucket by bucket, to the same result bit for bit; and the folder holds the fits alone in the end."""

    def stop_at(words: str, told: list[str]):
        def stop(stage: str) -> None:
            told.append(stage)
            if stage.startswith(words):
                raise Stopped

        return stop

    options = {"priors": None, "pilot": pilot(), "checkpoint": tmp_path}
    whole, told = fitted(priors=None, pilot=pilot()), []
    for words in ("finds", "fits", "1 of 3", "2 of 3"):
        with pytest.raises(Stopped):
            fitted(on_stage=stop_at(words, told), **options)
    assert sum(stage.startswith("fits 3 scans of up to 1,024 points, 1 at once, in ") for stage in told) == 3
    found = fitted(on_stage=told.append, **options)
    assert told[-4:] == ["1 of 3 scans are fitted", "2 of 3 scans are fitted", told[-2], "3 of 3 scans are fitted"]
    for name in ("converged", "sweeps", "noise", "rms", "robust_rms", "weights", "h"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    np.testing.assert_array_equal(found.control.vertices, whole.control.vertices)
    np.testing.assert_array_equal(found.result(2).distances, whole.result(2).distances)
    for other in ({"tolerance": 0.02}, {"chosen": subjects()[:2]}):
        with pytest.raises(ValueError, match=r"of another fit, with another (tolerance|scan or what belongs to it)"):
            fitted(**(options | other))
    found.save(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"cohort.json", *found.names}


def test_scans_of_other_sizes_are_fitted_in_classes_of_their_own(monkeypatch):
    assert [find_size_class(n) for n in (3, 1024, 1025, 1280, 1281)] == [1024, 1024, 1280, 1280, 1600]
    assert sort_into_classes([1500, 900, 1300, 5000]) == [(1600, [1, 0, 2]), (6102, [3])]  # few scans join a class
    assert [size for size, _ in sort_into_classes([900] * 8 + [1300])] == [1024, 1600]
    chain = [1000, 1900, 3600, 6500, 12000]  # each twice the one before: none is filled up by more than that
    assert [rows for _, rows in sort_into_classes(chain)] == [[0, 1], [2, 3], [4]]
    monkeypatch.setattr("fitting.run.buckets._FEW", 1)
    points = np.array(js.sample(truths()[2], 1100, jnp.array([1, 1], jnp.uint32)).points)
    points += np.random.default_rng(1).normal(scale=scans.SIGMA, size=points.shape)
    told = []
    found = fitted((fitting.Scan(points), subjects()[0]), on_stage=told.append)
    assert [words.split(",")[0] for words in told if words.startswith("fits")] == ["fits 1 scans of up to 1"] * 2
    np.testing.assert_array_equal(found.control.vertices[1], cohort().control.vertices[0])
    assert found.weights.shape == (2, 1280) and not found.weights[1, SIZES[0] :].any()
    assert off(truths()[2], surface(found, 0)) < scans.SIGMA


def test_a_bad_scan_is_left_out_and_named():
    few = fitting.Scan(np.eye(3))
    with pytest.warns(UserWarning, match=r"1 of 3 scans are left out\. b: the scan has 3 points for 12"):
        found = fitted((subjects()[0], few, subjects()[2]), names="abc", skip_bad=True)
    assert found.names == ("a", "c") and len(found) == 2 and "3 points" in found.failed["b"]
    np.testing.assert_array_equal(found.control.vertices[1], cohort().control.vertices[2])
    with pytest.raises(fitting.ScanError, match="none of the scans can be fitted"):
        fitted((few,), skip_bad=True)


def test_result_is_that_of_a_fit(tmp_path):
    result = cohort().result(1)
    report = result.report()
    assert report.converged and report.sweeps == cohort().sweeps[1]
    np.testing.assert_allclose(result.distances, result.distances)
    np.testing.assert_allclose(result.weights, cohort().weights[1][: SIZES[1]], atol=1e-6)
    assert result.rms[-1] == pytest.approx(np.sqrt(np.mean(result.distances**2)))
    assert np.median(result.uncertainty().surface) < scans.SIGMA
    result.save(tmp_path)
    np.testing.assert_array_equal(fitting.load(tmp_path).control.vertices, result.control.vertices)


def test_a_cohort_that_was_saved_is_the_same(tmp_path):
    named = dataclasses.replace(cohort(), names=("c", "a", "b"))
    named.save(tmp_path)
    again = fitting.load_cohort(tmp_path)
    assert again.names == ("c", "a", "b")  # in their order, not that of the alphabet
    for name in ("converged", "sweeps", "noise", "rms", "robust_rms", "weights"):
        own, new = np.asarray(getattr(named, name)), np.asarray(getattr(again, name))
        np.testing.assert_array_equal(own[..., : new.shape[-1]], new)
    np.testing.assert_array_equal(again.control.vertices, named.control.vertices)
    np.testing.assert_array_equal(again.h, named.h)
    np.testing.assert_allclose(again.surfaces.vertices, named.surfaces.vertices, atol=1e-12)
    np.testing.assert_array_equal(again.scans[2].points, subjects()[2].points)
    assert again.warnings == named.warnings
    (tmp_path / "cohort.json").unlink()
    assert fitting.load_cohort(tmp_path).names == ("a", "b", "c")


def test_what_is_no_saved_cohort_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="no folders with saved fits"):
        fitting.load_cohort(tmp_path)
    (tmp_path / "cohort.json").write_text('{"names": ["../a"]}')
    with pytest.raises(ValueError, match=r"cohort\.json: '\.\./a' cannot name a scan"):
        fitting.load_cohort(tmp_path)
    with pytest.raises(ValueError, match="fit 1 has another control mesh"):
        fitting.Cohort.of([cohort().result(0), plates()[1].result(0)])
    with pytest.raises(ValueError, match="one fit or more"):
        fitting.Cohort.of([])


def test_smoothness_is_that_of_the_pilot():
    found = fitted(priors=None, pilot=pilot())
    assert found.converged.all()
    assert off(pilot().surface, surface(found, 0)) < 0.3 * off(truths()[0], pilot().surface)


@functools.cache
def pilot() -> fitting.FitResult:
    return fitting.fit(js.Interpolating(), scans.problem().topology, start(), subjects()[0], throw=False)


def test_a_pilot_that_is_its_own_start_is_replaced():
    """Its strengths would say that no subject differs from the first, and hold all at its shape."""
    topology, control = scans.problem().topology, pilot().control
    own = fitting.fit(js.Interpolating(), topology, control, subjects()[0], throw=False)
    assert is_its_own_start(own) and not is_its_own_start(pilot())
    with pytest.warns(UserWarning, match="fitted to the pilot's own scan before.*that of scan 2 was taken instead"):
        found = fitting.fit_cohort(
            js.Interpolating(), topology, control, subjects(), pilot=own, max_sweeps=40, tolerance=0.01
        )
    assert found.converged.all()
    for i in range(N_SUBJECTS):
        assert off(truths()[i], surface(found, i)) < 0.5


def test_a_subject_that_the_priors_hold_far_off_has_not_converged():
    flat = np.array([1.4, 0.6, 1.0])
    chosen = [subjects()[0], *(fitting.Scan(np.asarray(scan.points) * flat) for scan in subjects()[1:])]
    with pytest.warns(UserWarning, match="of the scans 1, 2"):
        found = fitting.fit_cohort(
            js.Interpolating(),
            scans.problem().topology,
            cohort().result(0).control,
            chosen,
            priors=fitting.Priors(bend=1e-7, stretch=1e-7),
            max_sweeps=40,
            tolerance=0.01,
        )
    np.testing.assert_array_equal(found.converged, [True, False, False])
    assert "rests_where_it_started" in [finding.name for finding in found.warnings[1]]
    assert not found.trusted[1:].any()
    report = found.result(2).report()
    assert not report.converged and report.reason == "at rest where it started, far from the scan"


def test_every_subject_has_the_warnings_of_a_fit():
    found = cohort()
    single = fitting.fit(
        js.Interpolating(), scans.problem().topology, start(), subjects()[0], priors=PRIORS, tolerance=0.01, throw=False
    )
    assert [finding.name for finding in found.warnings[0]] == [finding.name for finding in single.warnings]
    np.testing.assert_array_equal(found.trusted, [not of_one for of_one in found.warnings])


def test_every_prior_holds_as_in_a_fit():
    """Landmarks, symmetry, shifts of slices and shape modes together; of other numbers from subject to subject."""
    problem, rng = scans.problem(), np.random.default_rng(5)
    shapes = np.asarray(problem.truth.vertices) * (1 + rng.normal(scale=0.04, size=(6, 1, 3)))
    priors = fitting.Priors(bend=0.5, symmetry=1.0, shape=fitting.ShapeModes.of(fitting.shape_modes(shapes)))
    own_scans, places = [], []
    for i, scan in enumerate(subjects()[::2]):
        points = np.array(scan.points)
        slices = np.digitize(points[:, 2], np.linspace(-12, 12, 5 - i))
        points[slices == 2, :2] += 1.0
        own_scans.append(fitting.Scan(points, slices=slices))
        rows = np.arange(3 - i)
        places.append(fitting.Landmarks(np.asarray(truths()[2 * i].vertices)[rows], rows))
    options = {"priors": priors, "landmark_deviation": 0.5}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few slices, and many unknowns: some are still on their way
        found = fitted(own_scans, landmarks=places, **options)
    for i, scan in enumerate(own_scans):
        single = fitting.fit(
            js.Interpolating(), problem.topology, start(), scan, landmarks=places[i], throw=False, **options
        )
        result = found.result(i)
        assert off(single.surface, result.surface) < 0.3 * off(truths()[2 * i], single.surface)
        assert result.shifts.shape == single.shifts.shape
        # The shift that all slices have in common moves with the surface, by less than the noise.
        own, others = (rows - rows.mean(axis=0) for rows in (result.shifts, single.shifts))
        np.testing.assert_allclose(own, others, atol=0.1)
        np.testing.assert_allclose(result.fit.y.shared["scores"], single.fit.y.shared["scores"], atol=0.1)


def test_boundary_curves_hold_as_in_a_fit():
    vertices, faces = meshes.grid(2, 2, "quad")
    mesh = js.ControlMesh(10 * vertices, faces)
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 22, (300, 2)), rng.normal(scale=0.1, size=300)])
    t = np.arange(-1, 21) + 0.5
    low = np.full(len(t), -1.0)
    sides = [(t, low), (t, low + 22), (low, t), (low + 22, t)]
    square = np.concatenate([np.column_stack([*side, 0 * t]) for side in sides])
    curves = [fitting.BoundaryCurve(square, 0.2), fitting.BoundaryCurve(square[::2], 0.2)]
    options = {"free": fitting.Free(normals=False, h=False), "priors": PRIORS}
    found = fitting.fit_cohort(
        js.Interpolating(), topology, mesh.control(), [fitting.Scan(points)] * 2, boundary=curves, **options
    )
    for i, curve in enumerate(curves):
        single = fitting.fit(
            js.Interpolating(), topology, mesh.control(), fitting.Scan(points), boundary=curve, throw=False, **options
        )
        own, others = np.asarray(found.control.vertices[i]), np.asarray(single.control.vertices)
        np.testing.assert_allclose(own[:, 2], others[:, 2], atol=0.01)
        outside = np.abs(own[:, :2] - 10).max(axis=1) > 5  # on the boundary, along which control vertices slide
        for rows in (own, others):
            np.testing.assert_allclose(np.abs(rows[outside, :2] - 10).max(axis=1), 11, atol=0.05)


@functools.cache
def plates() -> tuple[fitting.RegionMatch, fitting.Cohort]:
    """A plate whose lower wall lies nearer to where its upper one starts: labels alone tell upper from lower."""
    corners = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 0.1), (0, 0, -0.1)]
    faces = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (1, 0, 5), (2, 1, 5), (3, 2, 5), (0, 3, 5)]
    walls = js.Regions(np.repeat([0, 1], 4), ("upper", "lower"))
    mesh = js.ControlMesh(10 * np.array(corners), faces, regions=walls)
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    rng = np.random.default_rng(0)
    flat = rng.uniform(-4, 4, (400, 2))
    chosen = []
    for shift in (1.0, 1.2):
        height = np.where(np.arange(400) < 200, shift + 0.5, shift - 0.5) + rng.normal(scale=0.05, size=400)
        labels = js.Regions(np.repeat([0, 1], 200), ("upper", "lower"))
        chosen.append(fitting.Scan(np.column_stack([flat, height]), regions=labels))
    chosen[1] = chosen[1].rows(np.arange(10, 400))
    match = fitting.match_regions(chosen[0], mesh)
    found = fitting.fit_cohort(
        js.Interpolating(), topology, mesh.control(), chosen, priors=PRIORS, regions=[match, match]
    )
    return match, found


def test_points_are_paired_within_their_regions():
    match, found = plates()
    for i, scan in enumerate(found.scans):
        result = found.result(i)
        owner = js.control_faces_of(result.scheme, result.fit.topology, result.surface, result.control)
        np.testing.assert_array_equal(match.faces.rows[owner[result.at.face]], scan.regions.rows)
        assert np.median(np.abs(result.distances)) < 0.25  # of walls 1 mm apart
        assert [one.region for one in result.report().regions] == ["upper", "lower"]
    with pytest.raises(ValueError, match="`regions` are of 8 control faces, and the topology has"):
        fitted(regions=match)


def test_bad_scans_are_named(as_users_run):
    few = fitting.Scan(np.eye(3))
    with pytest.raises(fitting.ScanError, match=r"^scan 1: the scan has 3 points for 12"):
        fitted((subjects()[0], few))
    with_normals = fitting.Scan(subjects()[0].points, subjects()[0].points)
    with pytest.raises(fitting.ScanError, match="scan 1 has no normals and others have"):
        fitted((with_normals, subjects()[1]))
    with pytest.raises(ValueError, match="there are 0 scans"):
        fitted(())
    with pytest.raises(ValueError, match="2 scans and 1 controls"):
        fitting.fit_cohort(js.Interpolating(), scans.problem().topology, [start()], subjects()[:2])


def test_landmarks_and_shapes_are_written(tmp_path):
    template = js.ControlMesh(start().vertices, scans.problem().mesh.faces)
    places = {"top": np.asarray(start().vertices)[0], "side": np.asarray(start().vertices)[3]}
    carried = fitting.carry_to_cohort(template, cohort(), places)
    for i, own in enumerate(carried):
        np.testing.assert_allclose(own.points, np.asarray(cohort().control.vertices)[i, [0, 3]], atol=1e-6)
        assert all(0 < deviation < 10 for deviation in own.deviations.values())
    modes = fitting.shape_modes(cohort().surfaces.vertices)
    quality = fitting.measure_modes(cohort().surfaces.vertices)
    fitting.write_shapes(tmp_path, cohort(), modes, quality=quality, landmarks=carried)
    with np.load(tmp_path / "shapes.npz") as arrays:
        np.testing.assert_array_equal(arrays["scores"], modes.scores)
        np.testing.assert_array_equal(arrays["landmarks"][2], carried[2].points)
    rows = (tmp_path / "scores.csv").read_text().splitlines()
    assert rows[0] == "name,converged,centroid_size_mm,mode_1,mode_2" and rows[2].startswith("1,1,")
    assert len((tmp_path / "modes.csv").read_text().splitlines()) == 3
    assert len((tmp_path / "landmarks.csv").read_text().splitlines()) == 7
    mean = js.read_mesh(tmp_path / "mean.vtp")
    np.testing.assert_array_equal(mean.vertices, modes.mean)
    place = json.loads((tmp_path / "2.mrk.json").read_text())["markups"][0]["controlPoints"][0]["position"]
    np.testing.assert_allclose(place, carried[2].points[0])
    with pytest.raises(ValueError, match="the modes are of 3 shapes of 5 vertices"):
        fitting.write_shapes(tmp_path, cohort(), fitting.shape_modes(np.random.default_rng(0).normal(size=(3, 5, 3))))


# ------------------------------------------------------------------------------------------------------------- modes


def planted(n: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shapes of two modes, turned and shifted; the modes, and their scores."""
    rng = np.random.default_rng(0)
    mean = meshes.torus(12, 8)[0] * 10
    mean -= mean.mean(axis=0)
    z = mean[:, 2:]
    raw = np.stack([mean * (1, -1, 0), np.sin(mean[:, :1] / 4) * (0, 0, 1) + 0 * z]).reshape(2, -1)
    modes = np.linalg.qr(raw.T)[0].T.reshape(2, *mean.shape)
    scores = rng.normal(size=(n, 2))
    shapes = mean + np.einsum("sk,kvx->svx", scores * (12.0, 4.0), modes)
    turns = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    return np.einsum("svx,sxy->svy", shapes, turns) + 100 * rng.normal(size=(n, 1, 3)), modes, scores


@pytest.mark.parametrize("size", [False, True])
def test_planted_modes_are_found(size):
    shapes, _, scores = planted()
    found = fitting.shape_modes(shapes, size=size)
    np.testing.assert_allclose(found.share.sum(), 1)
    assert found.share[:2].sum() > 0.98
    np.testing.assert_allclose(found.deviations[:2], (12, 4), rtol=0.25)
    for k in range(2):
        assert abs(np.corrcoef(found.scores[:, k], scores[:, k])[0, 1]) > 0.95


def test_shapes_come_back_from_their_scores():
    shapes, _, _ = planted(6)
    found = fitting.shape_modes(shapes)
    for row, one in zip(found.scores, found.aligned, strict=True):
        np.testing.assert_allclose(found.shape(row), one, atol=1e-9)
    np.testing.assert_allclose(found.shape([]), found.mean)
    np.testing.assert_allclose(found.scores.std(axis=0, ddof=1), 1)
    edges = [np.linalg.norm(rows[:, 0] - rows[:, 1], axis=-1) for rows in (shapes, found.aligned)]
    np.testing.assert_allclose(*edges)  # turned and shifted alone


@pytest.mark.parametrize("vertices", [np.zeros((1, 5, 3)), np.zeros((5, 3)), np.full((3, 4, 3), np.nan)])
def test_modes_need_shapes(vertices):
    with pytest.raises(ValueError, match="two shapes or more"):
        fitting.shape_modes(vertices)
