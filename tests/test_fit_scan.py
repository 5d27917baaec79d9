"""From a scan to a fit in one call: alignment, a control mesh from the scan, splitting, landmarks, every scheme."""

import numpy as np
import optimistix as optx
import pytest
from scans import N_POINTS, SIGMA, noise, problem
from scipy.spatial.transform import Rotation

import fitting
import jaxsubdiv as js
from fitting import Landmarks, Scan, fit_scan, misfit
from fitting.run.fit import CHECKPOINT
from fitting.run.fit_scan import CHECKPOINT_START, _outcome


def mesh_and_scan(**scan) -> tuple[js.ControlMesh, Scan]:
    p = problem()
    mesh = js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals)
    return mesh, Scan(**({"points": p.points + noise()} | scan))


def test_template_is_aligned_before_it_is_fitted():
    scan, mesh = fitting.example("femur_distal")
    turn = Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix()
    points, told = np.asarray(scan.points) @ turn.T + (30, -20, 50), []
    found = fit_scan(Scan(points), mesh, levels=1, throw=False, max_sweeps=0, on_stage=told.append)
    assert found.alignment is not None and found.result.rms[-1] < 0.6
    np.testing.assert_allclose(found.alignment.transform[:3, :3], turn, atol=0.05)
    assert told == ["aligns the control mesh with the scan", "fits 250 control vertices, in about 0.9 GB of memory"]
    with pytest.warns(UserWarning, match="Align the control mesh"):
        there = fit_scan(Scan(points), mesh, levels=1, pose=None, max_sweeps=0, throw=False)
    assert there.alignment is None and there.result.rms[-1] > 20


def rippled() -> Scan:
    """What twelve control vertices cannot follow."""
    points = problem().points
    ripples = 0.4 * np.sin(points[:, :1] / 3) * points / np.linalg.norm(points, axis=1, keepdims=True)
    return Scan(points + ripples + 0.1 * noise())


def test_splitting_goes_on_until_the_tolerance_is_met():
    (mesh, _), scan = mesh_and_scan(), rippled()
    coarse = fit_scan(scan, mesh, levels=1, pose=None, throw=False, max_sweeps=12)
    assert coarse.outcome is None and misfit(coarse.result) > 0.1
    fine = fit_scan(scan, mesh, levels=1, pose=None, tolerance_mm=0.08, throw=False, max_sweeps=12)
    assert fine.outcome == "tolerance met" and fine.splits >= 1 and misfit(fine.result) <= 0.08
    assert fine.start.n_faces == mesh.n_faces * 4**fine.splits
    stopped = fit_scan(scan, mesh, levels=1, pose=None, tolerance_mm=0.001, most_faces=50, throw=False, max_sweeps=12)
    assert stopped.outcome == "no more faces" and stopped.splits == 0


def test_fit_that_was_stopped_after_a_split_goes_on_there(tmp_path):
    """Without alignment and first fit, to the same end as one that was not stopped, in a hole of the scan too."""
    (mesh, _), points = mesh_and_scan(), np.asarray(rippled().points)
    scan = Scan(points[points[:, 2] < 9])
    how = {"levels": 1, "tolerance_mm": 0.08, "max_sweeps": 6, "throw": False}
    stages, more_stages, numbers = [], [], []
    whole = fit_scan(scan, mesh, **how)

    def stop(sweep: fitting.Sweep) -> None:
        if len(stages) == 3 and sweep.number > 2:  # the alignment, a fit, and the one after the split
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_scan(scan, mesh, checkpoint=tmp_path, on_stage=stages.append, on_sweep=stop, **how)
    assert sorted(path.name for path in tmp_path.iterdir()) == [CHECKPOINT, CHECKPOINT_START]
    with np.load(tmp_path / CHECKPOINT_START) as kept:
        assert 0 < kept["unseen"].sum() < len(kept["unseen"])  # faces in the hole, which stay as they were filled
    tell = {"on_stage": more_stages.append, "on_sweep": lambda sweep: numbers.append(sweep.number)}
    again = fit_scan(scan, mesh, checkpoint=tmp_path, **tell, **how)
    assert more_stages[:2] == ["goes on where it was stopped", stages[2]] and numbers[0] == 3
    assert again.splits == whole.splits >= 1 and again.outcome == whole.outcome
    assert again.result.recipe.to_json() == whole.result.recipe.to_json()
    assert again.alignment[2:] == whole.alignment[2:] and not list(tmp_path.iterdir())
    for found, expected in (
        (again.result.control.vertices, whole.result.control.vertices),
        (again.result.rms, whole.result.rms),
        (again.start.vertices, whole.start.vertices),
        (again.alignment.transform, whole.alignment.transform),
        (again.alignment.mesh.vertices, whole.alignment.mesh.vertices),
        (again.alignment.mesh.normals, whole.alignment.mesh.normals),
    ):
        np.testing.assert_array_equal(found, expected)


def test_part_of_the_points_is_fitted_and_all_are_measured():
    mesh, scan = mesh_and_scan()
    how, told = {"levels": 1, "pose": None, "throw": False, "max_sweeps": 12}, []
    part = fit_scan(scan.draw(N_POINTS // 2), mesh, **how).result
    found = fit_scan(scan, mesh, most_points=N_POINTS // 2, on_stage=told.append, **how).result
    assert told[-1] == f"measures all {N_POINTS:,} points" and part.scan.n_points == N_POINTS // 2
    np.testing.assert_array_equal(found.control.vertices, part.control.vertices)
    assert found.report().n_points == len(found.distances) == len(found.inliers) == N_POINTS
    np.testing.assert_array_equal(found.scan.points, scan.points)
    rows = np.flatnonzero(np.isin(np.asarray(scan.points)[:, 0], np.asarray(part.scan.points)[:, 0]))
    np.testing.assert_allclose(found.distances[rows], part.distances, atol=1e-12)
    # Every point of the whole scan tells something of the surface.
    assert np.median(found.uncertainty().control) < 0.85 * np.median(part.uncertainty().control)
    assert found.recipe.most_points == N_POINTS // 2
    assert fitting.Recipe.from_json(found.recipe.to_json()).most_points == N_POINTS // 2
    again = found.compare_with(part.scan)
    np.testing.assert_allclose(again.distances, part.distances, atol=1e-12)
    np.testing.assert_allclose(again.uncertainty().surface, part.uncertainty().surface, rtol=1e-6)
    assert scan.draw(10**6) is scan and len(np.unique(scan.draw(50).points, axis=0)) == 50


def test_splitting_stops_at_the_noise():
    mesh, scan = mesh_and_scan()
    found = fit_scan(scan, mesh, levels=1, pose=None, max_sweeps=0, throw=False).result
    found.distances, found.noise = np.full(N_POINTS, 0.04), SIGMA
    assert _outcome(found, mesh, 1e-6, most_faces=10_000) == "noise reached"
    found.distances = 0.5 + noise()[:, 0]
    assert _outcome(found, mesh, 1e-6, most_faces=10_000) is None
    assert _outcome(found, mesh, 0.7, most_faces=10_000) == "tolerance met"
    assert _outcome(found, mesh, None, most_faces=10_000) is None


def test_misfit_is_what_neighbours_have_in_common():
    mesh, scan = mesh_and_scan()
    found = fit_scan(scan, mesh, levels=1, pose=None, max_sweeps=0, throw=False).result
    shared = 0.5 * np.sign(np.asarray(scan.points)[:, 0])
    for distances, expected in ((shared, 0.5), (noise()[:, 0], 0.0), (shared + noise()[:, 0], 0.5)):
        found.distances, found.noise = distances, 10.0
        np.testing.assert_allclose(misfit(found), expected, atol=0.12)


def test_landmarks_pull_the_fit_to_them():
    mesh, scan = mesh_and_scan()
    on_mesh = np.arange(4)
    there = np.asarray(problem().truth.vertices)[:4] + (0, 0, 1.5)
    options = {"levels": 1, "pose": None, "throw": False, "max_sweeps": 12}

    def off(landmarks, **how):
        found = fit_scan(scan, mesh, landmarks=landmarks, **options, **how).result
        return np.linalg.norm(np.asarray(found.control.vertices)[:4] - there, axis=1).mean()

    free, near, firm = (
        off(None),
        off(Landmarks(there, on_mesh), landmark_deviation=0.3),
        off(Landmarks(there, on_mesh), landmark_deviation=0.05),
    )
    assert firm < 0.3 * near and near < 0.8 * free
    heavy = off(Landmarks(there, on_mesh, np.full(4, 400.0)))
    np.testing.assert_allclose(heavy, firm, rtol=1e-6)


@pytest.mark.parametrize(
    "scheme",
    [js.Loop(), js.CatmullClark(), js.ModifiedButterfly(), js.Kobbelt(), js.DooSabin(), js.BezierTriangle()],
    ids=lambda scheme: type(scheme).__name__,
)
def test_every_scheme_is_fitted_by_the_same_call(scheme):
    _, scan = mesh_and_scan()
    mesh = problem().mesh
    mesh = mesh.triangulate() if scheme.takes == (3,) else mesh
    if scheme.takes == (4,):
        mesh = js.ControlMesh(*cube())
    # The control mesh is that of another scheme, whose curvature this one need not have.
    priors = fitting.Priors(likeness=0.0 if isinstance(scheme, js.BezierTriangle) else None)
    found = fit_scan(scan, mesh, scheme=scheme, levels=2, pose=None, throw=False, max_sweeps=25, priors=priors)
    assert found.result.result == optx.RESULTS.successful
    assert found.result.rms[-1] < min(0.8, 0.9 * found.result.rms[0])  # few vertices, and not all can bend at will
    assert np.all(found.result.uncertainty().surface > 0)


def cube() -> tuple[np.ndarray, list]:
    vertices = 0.8 * np.array([(x, y, z) for x in (-24, 24) for y in (-18, 18) for z in (-15, 15)], float)
    return vertices, [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def test_control_mesh_is_made_from_the_scan_where_none_is_given():
    pytest.importorskip("pyacvd", reason="the extra `mesh` is not installed")
    scan, _ = fitting.example("femur_distal")
    found = fit_scan(scan, faces=120, levels=2, throw=False, max_sweeps=8)
    assert found.alignment is None and 80 < found.start.n_faces < 160
    assert found.result.rms[-1] < 0.4 < found.result.rms[0]
