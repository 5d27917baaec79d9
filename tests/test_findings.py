"""What speaks against a fit: every finding has a case that deserves it, and one that does not."""

import dataclasses
import functools
import json
from importlib.util import find_spec
from pathlib import Path

import meshes
import numpy as np
import pytest
from optimistix import RESULTS
from scans import N_POINTS, noise, problem
from scipy.spatial import ConvexHull, KDTree
from trimesh import Trimesh

import fitting
import jaxsubdiv as js
from fitting import Scan
from fitting.__main__ import main
from fitting.finding import Finding, Origin, Pose
from fitting.report.evidence import Evidence, find_two_walls, gather_evidence, own_noise
from fitting.report.findings import CHECKS, check_jumps, check_noise, check_rest
from fitting.report.record import Fit
from fitting.start.align import mirror_image, sample_faces

TWO = Finding("parts_left_out", "the scan shows 2 parts", {"parts": 2, "share": 0.5})


@functools.cache
def good() -> fitting.FitResult:
    return problem().fit(problem().points + 0.3 * noise())


def evidence(result: fitting.FitResult) -> Evidence:
    covered = np.ones(len(result.surface.vertices), bool)
    return gather_evidence(result.fit, result.surface, np.ones(len(covered)), covered)


def names(result: fitting.FitResult) -> list[str]:
    return [finding.name for finding in result.warnings]


def test_nothing_speaks_against_a_good_fit():
    assert good().warnings == [] and good().trusted
    report = good().report()
    assert report.trusted and report.warnings == [] and report.pose is None
    assert "WARNING" not in str(report)


def test_a_fit_that_was_cut_short():
    found = problem().fit(max_sweeps=1)
    assert "not_converged" in names(found) and not found.trusted
    assert "in 1 sweeps" in found.warnings[0].text


def test_points_of_another_object():
    """A tenth of the points and more lie on a ball beside the object."""
    ball = np.random.default_rng(0).normal(size=(120, 3))
    ball = 4 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + (45, 0, 0)
    points = problem().points.copy()
    points[:120] = ball
    found = problem().fit(points)
    finding = next(one for one in found.warnings if one.name == "points_unexplained")
    assert 0.1 < finding.numbers["share"] < 0.3 and finding.numbers["median_distance"] > 10


def test_scattered_outliers_are_no_object():
    points = problem().points.copy()
    points[:100] = np.random.default_rng(0).uniform(-60, 60, (100, 3))
    assert "points_unexplained" not in names(problem().fit(points))


def test_a_surface_that_most_of_has_no_points():
    points = problem().points
    there = points[points[:, 0] > np.quantile(points[:, 0], 0.75)]
    some = there[np.random.default_rng(0).integers(len(there), size=N_POINTS)]
    found = problem().fit(some + 0.1 * noise())
    assert "surface_unsupported" in names(found)


def test_two_walls():
    """Points 0.5 mm on either side of the surface, with noise a tenth of that."""
    result = good()
    _, normals = js.evaluate(result.surface, result.at)
    sides = np.where(np.arange(N_POINTS) % 2, 1.0, -1.0)[:, None]
    on = np.asarray(js.evaluate(result.surface, result.at)[0])
    rng = np.random.default_rng(0)
    found = problem().fit(on + (sides * 0.5 + rng.normal(scale=0.05, size=(N_POINTS, 1))) * np.asarray(normals))
    finding = next(one for one in found.warnings if one.name == "two_walls")
    assert finding.numbers["share"] > 0.8 and 0.6 < finding.numbers["apart"] < 1.6


@pytest.mark.parametrize("spread", ["normal", "uniform", "laplace"])
def test_one_wall_is_not_two(spread):
    rng = np.random.default_rng(0)
    feet = np.append(rng.uniform(0, 100, (4000, 2)), np.zeros((4000, 1)), axis=1)
    up, draw = np.tile([0.0, 0, 1], (4000, 1)), getattr(rng, spread)
    assert find_two_walls(feet, up, draw(size=4000))[0] < 0.15
    assert find_two_walls(feet, up, np.zeros(4000), 1e-9)[0] == 0


def test_normals_that_face_against():
    result = good()
    normals = np.array(js.evaluate(result.surface, result.at)[1])
    scan = Scan(problem().points, normals)
    assert names(problem().fit(scan=scan)) == []
    assert "points_face_against" not in names(
        problem().fit(scan=Scan(problem().points, -normals))
    )  # as files have them
    normals[::4] *= -1
    found = problem().fit(scan=Scan(problem().points, normals))
    finding = next(one for one in found.warnings if one.name == "points_face_against")
    assert finding.numbers["share"] == pytest.approx(0.25, abs=0.02)
    ignored = np.where(np.arange(N_POINTS) % 4, 1.0, 0.0)
    assert names(problem().fit(scan=Scan(problem().points, normals, ignored))) == []


def test_distances_that_jump():
    seen = evidence(good())
    assert check_jumps(seen) is None
    jumping = sweeps(seen.fit, [9, 3, 1, 2, 1, 2, 1.0])
    assert check_jumps(seen._replace(fit=jumping)).numbers == {"rises": 2, "largest": 2.0}
    assert check_jumps(seen._replace(fit=sweeps(seen.fit, [9, 3, 1, 2, 0.5, 0.3, 0.2]))) is None


def sweeps(found: Fit, rms: list[float]) -> Fit:
    return dataclasses.replace(found, rms=np.array(rms), robust_rms=np.array(rms))


def test_noise_above_the_scans_own():
    """Noise that neighbouring points do not show is a surface that is wrong; what a fine mesh leaves is not."""
    seen = evidence(good())
    assert check_noise(seen) is None
    wrong = seen._replace(noise=0.2 * seen.edge, own=seen.own._replace(noise=0.02 * seen.edge))
    assert check_noise(wrong).numbers["own_noise"] == pytest.approx(0.02 * seen.edge)
    assert check_noise(wrong._replace(own=seen.own._replace(noise=0.1 * seen.edge))) is None  # as noisy as it seems
    assert check_noise(wrong._replace(noise=0.06 * seen.edge)) is None  # detail that the control mesh is too coarse for


def test_a_surface_that_rests_where_it_started():
    seen = evidence(good())
    far = seen._replace(noise=10 * seen.edge, fit=sweeps(seen.fit, [9, 8.9, 8.9]))
    assert check_rest(far).name == "rests_where_it_started"
    assert check_rest(far._replace(fit=sweeps(seen.fit, [19, 8.9, 8.9]))) is None  # it was moved
    assert check_rest(far._replace(noise=0.06 * seen.edge)) is None  # it is not far off
    assert check_rest(far._replace(fit=dataclasses.replace(far.fit, result=RESULTS.nonfinite))) is None  # nor at rest


def test_own_noise_is_that_of_points_about_their_planes():
    rng = np.random.default_rng(0)
    flat = np.append(rng.uniform(0, 100, (5000, 2)), rng.normal(scale=0.3, size=(5000, 1)), axis=1)
    apart = np.concatenate([flat, flat[:2000], rng.uniform(0, 100, (500, 3))])  # repeats and outliers change nothing
    for points in (flat, apart):
        own = own_noise(points, np.ones(len(points), bool))
        assert own.noise == pytest.approx(0.3, rel=0.1)
    assert np.isnan(own_noise(flat[:1], np.ones(1, bool)).noise)
    lines = np.append(np.linspace(0, 100, 3000)[:, None], np.tile([[0, 0], [9, 0], [0, 9]], (1000, 1)), axis=1)
    assert np.isnan(own_noise(lines + rng.normal(scale=0.01, size=(3000, 3)), np.ones(3000, bool)).noise)


def test_every_check_is_told_once():
    assert len({check.__name__ for check in CHECKS}) == len(CHECKS) == 9


# ------------------------------------------------------------------------------------------------ how the fit began


def with_origin() -> fitting.FitResult:
    pose = Pose(12.0, 1.25, 3.5, 0.9, 0.8)
    return fitting.FitResult(dataclasses.replace(good().fit, origin=Origin(pose, (TWO,))), recipe=good().recipe)


def test_what_spoke_against_the_start_is_told():
    found = with_origin()
    assert found.warnings == [TWO] and not found.trusted
    text = str(found.report())
    assert "NOT TO BE TRUSTED" in text and text.endswith("WARNING: the scan shows 2 parts")
    assert "turned by 12 degrees, scaled by 1.250, moved by 3.5 mm; near there 90% of the points and 80%" in text
    values = json.loads(found.report().as_json())
    assert values["warnings"] == [TWO._asdict()] and values["trusted"] is False and values["pose"]["scaled"] == 1.25


def test_it_is_saved(tmp_path):
    with_origin().save(tmp_path)
    assert fitting.load(tmp_path).warnings == [TWO]
    assert fitting.load(tmp_path).report().pose == with_origin().report().pose


def test_the_page_shows_it(tmp_path):
    fitting.write_page(tmp_path / "fit.html", with_origin(), uncertainty=False)
    page = (tmp_path / "fit.html").read_text()
    assert '<p class="bad">the scan shows 2 parts</p>' in page and "NOT TO BE TRUSTED" in page


# --------------------------------------------------------------------------------------------------------- alignments


def template() -> js.ControlMesh:
    """Without a symmetry: every pose is another."""
    vertices, faces = meshes.mixed_closed()
    x, y, z = vertices.T * ((30,), (20,), (12,)) + 6 * np.maximum(vertices.T, 0) ** 2
    turn = 0.6 * y / 20  # a screw: its mirror image turns the other way
    x, z = np.cos(turn) * x - np.sin(turn) * z, np.sin(turn) * x + np.cos(turn) * z
    return js.ControlMesh(np.stack([x, y, z], axis=1), sorted(faces, key=len))


def points_on(mesh: js.ControlMesh, n: int = 1500, seed: int = 0) -> np.ndarray:
    return sample_faces(mesh, n).points + np.random.default_rng(seed).normal(scale=0.1, size=(n, 3))


def test_a_template_in_its_place_among_two_objects_stays():
    mesh = template()
    points = points_on(mesh)
    found = fitting.align(mesh, Scan(np.concatenate([points, points + (90, 0, 0)])))
    assert found.pose.turned < 3 and found.pose.scaled == pytest.approx(1, abs=0.03) and found.pose.moved < 1
    assert found.pose.share_of_points == pytest.approx(0.5, abs=0.05) and found.pose.share_of_template > 0.95


def test_a_scale_that_no_two_people_differ_by_is_told():
    mesh = template()
    with pytest.warns(UserWarning, match="the template was scaled by 2.0"):
        found = fitting.align(mesh, Scan(2 * points_on(mesh)))
    assert [doubt.name for doubt in found.doubts] == ["scaled_far"]
    assert fitting.align(mesh, Scan(1.2 * points_on(mesh))).doubts == ()


def test_the_other_side_of_the_body():
    """A mirrored scan is told; with the template's mirror image it is fitted, and its control mesh is sound."""
    mesh = template()
    scan = Scan(points_on(mesh) * (-1, 1, 1) + (50, 0, 0))
    with pytest.warns(UserWarning, match="give --mirror"):
        assert "mirrored" in [doubt.name for doubt in fitting.align(mesh, scan).doubts]
    image, _ = mirror_image(mesh)
    image.check()
    assert fitting.align(image, scan).doubts == ()
    marks = fitting.Landmarks(np.zeros((1, 3)), mesh.vertices[:1])
    _, moved = mirror_image(mesh, marks)
    assert moved is not None
    np.testing.assert_allclose(moved.on_mesh, image.vertices[:1])


def test_mirroring_needs_a_template_to_align():
    with pytest.raises(ValueError, match="`mirror` is of a template, and there is none"):
        fitting.fit_scan(Scan(points_on(template())), mirror=True)
    with pytest.raises(ValueError, match="let it be aligned by a `pose`"):
        fitting.fit_scan(Scan(points_on(template())), template(), mirror=True, pose=None)


# ------------------------------------------------------------------------------------------- scans of several objects

CASES = Path(__file__).parents[2] / "shared" / "cases"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} is not there: these scans are not ours to ship")
needs_extra = pytest.mark.skipif(find_spec("pyacvd") is None, reason="the extra `mesh` is not installed")


def ball(n: int = 1200, radius: float = 20.0, seed: int = 0) -> np.ndarray:
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return radius * x / np.linalg.norm(x, axis=1, keepdims=True)


@functools.cache
def two_objects() -> Scan:
    return Scan(np.concatenate([ball() * (1, 1, 2), ball(700, 15, 1) + (60, 0, 0)]))


@needs_extra
def test_what_is_left_out_is_a_choice():
    with pytest.warns(UserWarning, match=r"the scan shows 2 parts; .* Left out: 3\d% of the points. Choose by --part"):
        largest = fitting.control_mesh(two_objects(), faces=40)
    assert np.abs(largest.vertices[:, 0]).max() < 25
    assert np.array_equal(fitting.control_mesh(two_objects(), faces=40, part="largest").vertices, largest.vertices)
    nearest = fitting.control_mesh(two_objects(), faces=40, part="nearest")  # to the middle of the points: x = 22
    assert np.abs(nearest.vertices[:, 0]).max() < 25
    both = fitting.control_mesh(two_objects(), faces=80, part="all")
    both.check()
    assert fitting.topology_of(both).parts == 2 and fitting.topology_of(both).is_closed


@needs_extra
def test_faces_of_a_scan_tell_its_parts_apart():
    """Two balls that touch, which points alone show as one; and a vertex that no face uses."""
    faces = ConvexHull(ball()).simplices
    both = np.concatenate([ball(), ball() + (40.2, 0, 0), [[20.0, 500, 0]]])
    scan = Scan(both, faces=np.concatenate([faces, faces + 1200]))
    mesh = fitting.control_mesh(scan, faces=40, part="largest")
    assert np.ptp(mesh.vertices[:, 0]) < 42 and np.abs(mesh.vertices[:, 1]).max() < 22
    assert scan.rows(np.arange(1200)).faces.shape == faces.shape
    with pytest.raises(fitting.ScanError, match="`faces` name points that there are not: the scan has 1200"):
        Scan(ball(), faces=faces + 1)


@needs_extra
def test_too_few_faces_for_what_the_scan_shows():
    arm = np.random.default_rng(0).uniform(size=(3000, 2)) * (2 * np.pi, 100)
    tube = np.stack([2 * np.cos(arm[:, 0]), 2 * np.sin(arm[:, 0]), arm[:, 1]], axis=1)
    with pytest.raises(fitting.ScanError, match=r"faces (leaves out a part of the scan|are too few)"):
        fitting.control_mesh(Scan(np.concatenate([tube, tube[:, [2, 0, 1]], tube[:, [1, 2, 0]]])), faces=16)


@needs_extra
def test_a_lone_far_point_repeats_and_zeros_change_nothing():
    points = ball() + (300, 0, 0)
    odd = np.concatenate([points, points[:400], np.zeros((300, 3)), [[9000.0, 0, 0]]])
    mesh = fitting.control_mesh(Scan(odd), faces=40)
    assert np.abs(np.linalg.norm(mesh.vertices - (300, 0, 0), axis=1) - 20).max() < 1.5


@needs_extra
@needs_cases
@pytest.mark.parametrize("name", ["tibia_table", "tibia_two"])
def test_of_two_objects_none_is_left_out_without_a_word(name):
    with pytest.warns(UserWarning, match=r"the scan shows 2 parts; .* Left out: [45]\d% of the points"):
        mesh = fitting.control_mesh(fitting.read_scan(CASES / f"{name}.xyz"), faces=150)
    assert not mesh.is_closed or Trimesh(mesh.vertices, mesh.faces[3], process=False).volume > 0


@needs_extra
@needs_cases
def test_dense_contours_are_the_whole_bone():
    scan = fitting.read_scan(CASES / "tibia_slices5.xyz")
    mesh = fitting.control_mesh(scan, faces=300)
    off = KDTree(sample_faces(mesh, 20_000).points).query(np.asarray(scan.points))[0]
    assert np.median(off) < 2 and np.quantile(off, 0.95) < 8  # flat faces over round ends, of a bone of 350 mm
    assert fitting.topology_of(mesh) == (1, 0, 0, 2)


@needs_extra
@pytest.mark.filterwarnings("default:the scan shows 2 parts")
def test_the_command_tells_last_what_it_left_out(tmp_path, capsys):
    np.savetxt(tmp_path / "two.xyz", np.asarray(two_objects().points))
    words = [str(tmp_path / "two.xyz"), "--faces", "30", "--levels", "1", "-o", str(tmp_path / "out")]
    assert main(words) == 1
    text = capsys.readouterr().out
    assert "NOT TO BE TRUSTED" in text
    assert text.splitlines()[-1].startswith("WARNING  the scan shows 2 parts")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [finding["name"] for finding in report["warnings"]] == ["parts_left_out"]
    assert report["n_points"] == 1200  # those of the other part are not fitted
    assert main([*words, "--part", "largest"]) == 0
    assert "WARNING" not in capsys.readouterr().out
