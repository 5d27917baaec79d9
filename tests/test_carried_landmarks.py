"""Landmarks carried from a template to a fit, with standard deviations, by the library and by the command."""

import csv
import functools
import json
import warnings
from pathlib import Path

import jax
import meshes
import numpy as np
import pytest
from landmark_files import FLIP, PLACES, same
from scans import SIGMA, noise, problem
from scipy.spatial.transform import Rotation

import fitting
import jaxsubdiv as js
from fitting import Landmarks, Scan, ScanError, carry_landmarks, fit_scan, read_landmarks, write_landmarks
from fitting.__main__ import main

HOW = {"levels": 1, "throw": False}


def template() -> js.ControlMesh:
    p = problem()
    return js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals)


def on_surface(mesh: js.ControlMesh, n: int = 40) -> np.ndarray:
    return np.asarray(js.refine(js.Interpolating(), problem().topology, mesh.control()).vertices)[:n]


def named(places: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{i}": place for i, place in enumerate(places)}


@functools.cache
def known() -> tuple[fitting.FitResult, np.ndarray, js.SurfacePoint]:
    """A fit of a noisy scan, landmarks on its template, and where they are on the surface."""
    places = on_surface(template())
    found = fit_scan(Scan(problem().points + noise()), template(), pose=None, **HOW).result
    return found, places, carry_landmarks(template(), found, named(places)).at


def test_vertices_of_the_surface_go_where_the_fit_took_them():
    found, places, _ = known()
    carried = carry_landmarks(template(), found, named(places))
    np.testing.assert_allclose(carried.points, np.asarray(found.surface.vertices)[: len(places)], atol=1e-9)
    np.testing.assert_allclose(carried.offsets, 0, atol=1e-9)


def test_standard_deviations_are_as_large_as_the_errors():
    """Of the same places of the true surface: the start is off by what the priors expect, the scan by its noise."""
    found, places, at = known()
    p = problem()
    truth = js.evaluate(js.refine(js.Interpolating(p.h), p.topology, p.truth), at)
    carried = carry_landmarks(template(), found, named(places))
    off, across = carried.points - np.asarray(truth.points), np.asarray(truth.normals)
    deviations = np.array(list(carried.deviations.values()))
    assert np.isfinite(deviations).all() and (deviations > 0).all()
    assert 0.5 < np.sqrt(np.mean(np.sum(off**2, axis=1) / deviations**2)) < 2
    of_normal = np.sqrt(np.einsum("lx,lxy,ly->l", across, carried.covariances, across))
    assert 0.4 < np.sqrt(np.mean(np.sum(off * across, axis=1) ** 2 / of_normal**2)) < 2
    assert (of_normal < SIGMA).all() and (of_normal <= deviations).all()
    surface = found.uncertainty().surface[: len(places)]
    own = np.asarray(found.surface.normals)[: len(places)]
    np.testing.assert_allclose(np.sqrt(np.einsum("lx,lxy,ly->l", own, carried.covariances, own)), surface, rtol=1e-6)


def test_similar_shape_has_its_landmarks_where_the_similarity_takes_them():
    """Places on the surface, and 2 mm above and below it, which is scaled too."""
    p, mesh = problem(), problem().mesh
    turn, size, shift = Rotation.from_rotvec([0.2, -0.3, 0.4]).as_matrix(), 1.3, (30.0, -20.0, 50.0)
    surface = js.refine(js.Interpolating(), p.topology, mesh.control())
    points = js.sample(surface, 600, jax.random.key(1)).points
    away = np.array([0.0, 2.0, -2.0, 0.0])[np.arange(24) % 4]
    places = np.asarray(surface.vertices)[:24] + away[:, None] * np.asarray(surface.normals)[:24]
    pairs = Landmarks(size * mesh.vertices[:4] @ turn.T + shift, mesh.vertices[:4])
    scan = Scan(size * np.asarray(points) @ turn.T + shift)
    found = fit_scan(scan, mesh, landmarks=pairs, **HOW).result
    carried = carry_landmarks(mesh, found, named(places))
    np.testing.assert_array_equal(np.sign(carried.offsets), np.sign(away))
    np.testing.assert_allclose(carried.points, size * places @ turn.T + shift, atol=0.1)


def test_mirror_image_has_the_landmarks_of_its_template():
    flip, about = np.array([-1.0, 1.0, 1.0]), 2 * template().vertices.mean(axis=0) * (1, 0, 0)
    places = on_surface(template(), 20) * 1.05
    scan = Scan((problem().points + noise()) * flip + about)
    found = fit_scan(scan, template(), mirror=True, **HOW).result
    carried = carry_landmarks(template(), found, named(places))
    assert np.abs(carried.points - (places * flip + about)).max() < 4  # on its own side, of a body of 48 x 36 x 30 mm
    assert (carried.offsets > 0).all()


def test_split_control_mesh_has_the_landmarks_where_its_template_had_them():
    ripples = 0.4 * np.sin(problem().points[:, :1] / 3)
    scan = Scan(problem().points * (1 + ripples / np.linalg.norm(problem().points, axis=1, keepdims=True)))
    found = fit_scan(scan, template(), pose=None, tolerance_mm=0.05, max_sweeps=6, **HOW)
    assert found.splits >= 1
    places = on_surface(template(), 42)  # the vertices of the first split, which are control vertices now
    carried = carry_landmarks(template(), found.result, named(places))
    np.testing.assert_allclose(carried.points, np.asarray(found.result.control.vertices)[:42], atol=1e-6)


def test_scheme_that_does_not_interpolate_carries_by_its_surface():
    mesh = problem().mesh
    found = fit_scan(Scan(problem().points), mesh, scheme=js.CatmullClark(), pose=None, max_sweeps=1, **HOW).result
    start = js.refine(js.CatmullClark(), found.fit.topology, found.start)
    carried = carry_landmarks(mesh, found, named(np.asarray(start.vertices)[:30]))
    np.testing.assert_allclose(carried.points, np.asarray(found.surface.vertices)[:30], atol=1e-6)


def test_saved_fit_carries_the_same(tmp_path):
    found, places, _ = known()
    found.save(tmp_path)
    again = carry_landmarks(template(), fitting.load(tmp_path), named(places))
    first = carry_landmarks(template(), found, named(places))
    np.testing.assert_array_equal(again.points, first.points)
    np.testing.assert_allclose(again.covariances, first.covariances, rtol=1e-6, atol=1e-12)


def test_refuses_what_cannot_be_carried():
    found, places, _ = known()
    with pytest.raises(ScanError, match="the fit's control mesh of 14 faces is not that of the template, which has 4"):
        carry_landmarks(js.ControlMesh(*meshes.tetrahedron()), found, named(places))
    with pytest.raises(ScanError, match="the landmarks tip are not three finite numbers"):
        carry_landmarks(template(), found, {"tip": [np.nan, 0, 0]})
    with pytest.raises(ScanError, match="there are no landmarks to carry"):
        carry_landmarks(template(), found, {})
    with pytest.warns(UserWarning, match=r"1 of 2 landmarks lie farther .* a control edge, .* mm: tip; 'tip' by 7"):
        carry_landmarks(template(), found, {"tip": [100.0, 0, 0], "near": places[0]})


def ellipsoid(radii: np.ndarray, at: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Voxels of an ellipsoid, and the position of the first of them."""
    first = at - radii - 3 * spacing
    n = np.ceil((2 * radii + 6 * spacing) / spacing).astype(int)
    grid = np.moveaxis(np.indices(tuple(n)), 0, -1) * spacing + first
    return (np.sum(((grid - at) / radii) ** 2, axis=-1) < 1).astype(np.uint8), first


def write_label_map(folder: Path, frame: str, radii: np.ndarray, at: np.ndarray, spacing: float) -> Path:
    """An ellipsoid at a place that is given in the frame, as NIfTI, which is in RAS, or MetaImage, which is in LPS."""
    voxels, first = ellipsoid(radii, at, spacing)
    if frame == "RAS":
        nibabel = pytest.importorskip("nibabel")
        affine = np.diag([spacing] * 3 + [1.0])
        affine[:3, 3] = first
        nibabel.save(nibabel.Nifti1Image(voxels, affine), folder / "map.nii.gz")
        return folder / "map.nii.gz"
    head = f"ObjectType = Image\nNDims = 3\nDimSize = {' '.join(map(str, voxels.shape))}\nBinaryData = True\n"
    head += f"ElementSpacing = {spacing} {spacing} {spacing}\nOffset = {' '.join(map(repr, first.tolist()))}\n"
    head += "TransformMatrix = 1 0 0 0 1 0 0 0 1\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"
    (folder / "map.mha").write_bytes(head.encode() + voxels.tobytes(order="F"))
    return folder / "map.mha"


@pytest.mark.parametrize("frame", ["RAS", "LPS"])
@pytest.mark.parametrize("align", ["none", "rigid"])
def test_slicer_to_fit_and_back_without_a_sign_lost(tmp_path, capsys, command_settings, frame, align):
    """Template and landmarks in the other frame than the scan, whose middle is far from the origin."""
    other = "LPS" if frame == "RAS" else "RAS"
    radii, at = np.array([24.0, 18.0, 15.0]), np.array([40.0, -25.0, 60.0])
    body = write_label_map(tmp_path, frame, radii, at, 1.0)
    vertices, faces = meshes.mixed_closed()
    of_scan = js.ControlMesh(vertices / np.linalg.norm(vertices, axis=1, keepdims=True) * radii + at, faces)
    there = named(of_scan.vertices[:5])
    js.write_mesh(tmp_path / "template.ply", js.ControlMesh(of_scan.vertices * FLIP, of_scan.faces), frame=other)
    write_landmarks(tmp_path / "marks.mrk.json", {name: place * FLIP for name, place in there.items()}, frame=other)
    write_landmarks(tmp_path / "on_scan.csv", {name: place * FLIP for name, place in there.items()}, frame=other)
    command = [str(body), "--control", str(tmp_path / "template.ply"), "--carry", str(tmp_path / "marks.mrk.json")]
    if align == "rigid":  # half turns of an ellipsoid are alike but for these
        command += [
            "--landmarks",
            str(tmp_path / "on_scan.csv"),
            "--control-landmarks",
            str(tmp_path / "marks.mrk.json"),
        ]
    out = tmp_path / "out"
    command += ["--align", align, "--levels", "2", "--points", "600", "--max-sweeps", "4", "-o", str(out)]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert main(command) in (0, 1)
    assert not [one for one in told if "as the file says" in str(one.message)]
    assert f"was turned from {other}, as its file says, to the scan's {frame}" in capsys.readouterr().out
    # Between 600 voxels twelve control vertices slide and bulge by 3 mm. A sign that is lost moves them by 50 and more.
    same(read_landmarks(out / "landmarks.mrk.json", frame=frame), there, atol=4)
    assert json.loads((out / "landmarks.mrk.json").read_text())["markups"][0]["coordinateSystem"] == frame
    same(read_landmarks(out / "landmarks.csv", frame=other), {k: v * FLIP for k, v in there.items()}, atol=4)
    assert js.read_frame(out / "surface.ply") == js.read_frame(out / "control.obj") == frame


@pytest.fixture
def files(tmp_path, monkeypatch, command_settings):
    """Two scans, their template, and landmarks on it, in the working folder."""
    monkeypatch.chdir(tmp_path)
    for i in range(2):
        np.savetxt(f"scan{i}.xyz", problem().points + noise(i), fmt="%.17g")
    js.write_mesh("control.obj", template())
    write_landmarks("marks.csv", named(on_surface(template(), 3)))
    return tmp_path


GIVEN = ("--control", "control.obj", "--levels", "1", "--align", "none", "--max-sweeps", "2")


def rows(path: str) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_every_scan_gets_landmarks_and_all_of_them_a_table(files, capsys):
    command = ["scan0.xyz", "scan1.xyz", *GIVEN, "--carry", "marks.csv", "-o", "out"]
    assert main(command) in (0, 1)
    table = rows("out/landmarks.csv")
    assert [(row["scan"], row["name"]) for row in table] == [(f"scan{i}.xyz", f"{j}") for i in (0, 1) for j in range(3)]
    assert list(table[0]) == ["scan", "name", "x", "y", "z", "deviation_mm"]
    assert [{"scan": "scan1.xyz"} | row for row in rows("out/scan1/landmarks.csv")] == table[3:]
    same(read_landmarks("out/scan1/landmarks.mrk.json", frame="LPS"), read_landmarks("out/scan1/landmarks.csv"))
    before = Path("out/landmarks.csv").read_text()
    Path("out/landmarks.csv").unlink()
    capsys.readouterr()
    assert main([*command, "--resume"]) in (0, 1)
    assert capsys.readouterr().out.count("done     before") == 2 and Path("out/landmarks.csv").read_text() == before
    write_landmarks("marks.csv", named(on_surface(template(), 2)))
    assert main([*command, "--resume"]) == 2
    assert "holds a fit with another carried landmarks" in capsys.readouterr().err


def test_table_of_all_has_the_scans_that_ended_and_the_frames_of_those_that_say_theirs(files):
    points = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in (problem().points + noise(1)).tolist())
    Path("scan1.obj").write_text(f"# SPACE=RAS\n{points}")
    Path("bad.xyz").write_text("1 2\n")
    Path("out/bad").mkdir(parents=True)
    write_landmarks("out/bad/landmarks.csv", PLACES)  # of an earlier fit
    assert main(["scan0.xyz", "scan1.obj", "bad.xyz", *GIVEN, "--carry", "marks.csv", "-o", "out"]) == 2
    table = rows("out/landmarks.csv")
    assert [(row["scan"], row["frame"]) for row in table] == [("scan0.xyz", "")] * 3 + [("scan1.obj", "RAS")] * 3


def test_landmarks_of_an_earlier_fit_go_where_the_next_has_none(files):
    assert main(["scan0.xyz", *GIVEN, "--carry", "marks.csv", "-o", "out"]) in (0, 1)
    assert Path("out/landmarks.csv").exists()
    assert main(["scan0.xyz", *GIVEN, "-o", "out"]) in (0, 1)
    assert not Path("out/landmarks.csv").exists() and not Path("out/landmarks.mrk.json").exists()


def test_command_refuses_landmarks_that_it_cannot_carry(files, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["scan0.xyz", "--carry", "marks.csv"])
    assert "--carry takes landmarks of a template to the scan: give the template, --control" in capsys.readouterr().err
    assert main(["scan0.xyz", *GIVEN, "--carry", "none.csv", "-o", "out"]) == 2
    assert "landmarks cannot be read from none.csv" in capsys.readouterr().err
    Path("out").mkdir()
    write_landmarks("out/landmarks.csv", PLACES)
    assert main(["scan0.xyz", *GIVEN, "--carry", "out/landmarks.csv", "-o", "out"]) == 2
    assert "--carry out/landmarks.csv would be replaced" in capsys.readouterr().err


def test_landmarks_of_other_programs(shared_data, tmp_path):
    path = shared_data / "skulls" / "A_J.mrk.json"
    if not path.is_file():
        pytest.skip("the shared data have no skulls")
    marks = read_landmarks(path, frame="LPS")
    write_landmarks(tmp_path / "a.mrk.json", marks, frame="LPS")
    same(read_landmarks(tmp_path / "a.mrk.json", frame="RAS"), read_landmarks(path, frame="RAS"))
