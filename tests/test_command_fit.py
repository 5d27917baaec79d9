"""The command `jaxsubdiv-fit`, run in this process: what it writes, and that its options reach the fit."""

import csv
import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_files import GIVEN, RESULTS, names, open_pyramid, run, write_files
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit

pytestmark = pytest.mark.usefixtures("command_settings")


@pytest.fixture
def files(tmp_path, monkeypatch) -> Path:
    """The folder of a scan and a control mesh, in which the command runs."""
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_fit_of_files_is_that_of_the_library(files, capsys):
    assert run(fit, "scan.xyz", *GIVEN, "-o", "deep/folder") == 0
    found, out = problem().fit(problem().points + noise()), capsys.readouterr().out
    assert "scan     600 points, " in out and "control  12 vertices, 14 faces, " in out
    assert "now      fits 12 control vertices" in out
    assert str(found.report(uncertainty=True)) in out
    written = "control.obj, surface.ply, report.json, fit.html, fit.npz, recipe.json, fit.png"
    assert f"wrote    {written} in deep/folder" in out
    assert names(files / "deep" / "folder") == RESULTS
    control = js.read_mesh("deep/folder/control.obj")
    np.testing.assert_allclose(control.vertices, found.control.vertices, rtol=1e-9)
    np.testing.assert_allclose(control.normals, found.control.normals, rtol=1e-9, atol=1e-12)
    surface = js.read_mesh("deep/folder/surface.ply")
    np.testing.assert_allclose(surface.vertices, found.surface.vertices, rtol=1e-9, atol=1e-9)
    assert json.loads(Path("deep/folder/report.json").read_text()) == found.report(uncertainty=True).as_dict()


def test_surface_is_written_as_finely_and_in_the_formats_that_are_asked_for(files, capsys):
    import nibabel

    options = ("--max-sweeps", 2, "--surface", "glb", "vtp", "gii", "surf", "stl", "obj", "ply", "--surface-level", 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # quads are split, and coordinates rounded
        assert run(fit, "scan.xyz", *GIVEN, *options, "-o", "out") == 1
    files_of_it = ["glb", "vtp", "surf.gii", "shape.gii", "surf", "stl", "obj", "ply"]
    written = ", ".join(f"surface.{name}" for name in files_of_it)
    assert f"wrote    control.obj, {written}, report.json" in capsys.readouterr().out
    at = fitting.load("out").refine_to(2)
    surface = js.read_mesh("out/surface.ply")
    np.testing.assert_allclose(surface.vertices, at.surface.vertices, rtol=1e-9, atol=1e-9)
    n_triangles = len(surface.faces[3]) + 2 * len(surface.faces[4])
    assert surface.n_faces == 14 * 16
    for name in ("glb", "surf.gii", "surf", "stl"):
        mesh = js.read_mesh(f"out/surface.{name}")
        assert len(mesh.faces[3]) == n_triangles and not len(mesh.faces[4])
        np.testing.assert_allclose(np.sort(mesh.vertices, axis=0), np.sort(surface.vertices, axis=0), atol=1e-5)
    arrays = nibabel.load("out/surface.shape.gii").darrays
    assert [array.meta["Name"] for array in arrays] == ["distance_mm", "deviation_mm"]
    np.testing.assert_allclose(arrays[0].data, at.distances, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(arrays[1].data, at.deviations, rtol=1e-4)
    coarse = ("scan.xyz", *GIVEN, "--max-sweeps", 2, "-o", "out", "--surface-level", 0)
    assert run(fit, *coarse, "--resume") == 2
    assert "out holds a fit with another surface format or level" in capsys.readouterr().err
    assert run(fit, *coarse) == 1
    assert names(files / "out") == RESULTS  # those of the earlier fit are gone
    np.testing.assert_allclose(
        js.read_mesh("out/surface.ply").vertices, js.read_mesh("out/control.obj").vertices, rtol=1e-9
    )


def test_formats_that_cannot_be_written_are_told_before_the_fit(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "nibabel.gifti", None)
    monkeypatch.setattr("fitting.run.fit_scan.fit_scan", None)  # never called
    assert run(fit, "scan.xyz", *GIVEN, "--surface", "gii") == 2
    assert ".gii files need nibabel" in capsys.readouterr().err
    assert run(fit, "scan.xyz", *GIVEN, "--surface-level", 9) == 2
    assert "--surface-level: a surface is written at a level from 0, the control mesh, to 8; got 9" in (
        capsys.readouterr().err
    )
    with pytest.raises(SystemExit):
        run(fit, "scan.xyz", *GIVEN, "--surface", "fbx")
    assert "invalid choice: 'fbx'" in capsys.readouterr().err and not (files / "fit_scan").exists()


def test_fit_is_kept_where_its_surface_has_no_such_level(files, capsys, monkeypatch):
    def none(self):
        raise ValueError("more memory than there is")

    monkeypatch.setattr("fitting.report.at_level.SurfaceAtLevel.__post_init__", none)
    monkeypatch.setattr(
        "fitting.command.outputs.draw_fit", lambda *_, **__: (_ for _ in ()).throw(ImportError("left out"))
    )
    monkeypatch.setattr("fitting.command.outputs.write_page", lambda path, *_, **__: path.touch())
    assert run(fit, "scan.xyz", *GIVEN, "--max-sweeps", 1, "-o", "out", "--surface-level", 3) == 1
    assert "note     no surface: more memory than there is" in capsys.readouterr().out
    assert names(files / "out") == [name for name in RESULTS if name not in ("surface.ply", "fit.png")]


@pytest.mark.parametrize(
    ("options", "scheme", "levels", "max_sweeps"),
    [
        ("", js.Interpolating(1.0), 3, 60),
        ("--h 0.8 --levels 2", js.Interpolating(0.8), 2, 60),
        ("--scheme circle --h 1.1 --max-sweeps 7", js.CirclePreserving(1.1), 3, 7),
    ],
)
def test_options_of_a_fit_reach_it(files, monkeypatch, options, scheme, levels, max_sweeps):
    seen = []

    def told(scan, mesh, *, scheme, levels, max_sweeps, **how):
        seen.append((scheme, levels, max_sweeps))
        raise ValueError("seen enough")

    monkeypatch.setattr("fitting.run.fit_scan.fit_scan", told)
    assert run(fit, "scan.xyz", "--control", "control.obj", *options.split()) == 2
    [(found, *numbers)] = seen
    assert type(found) is type(scheme) and found.h == scheme.h and numbers == [levels, max_sweeps]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("", {"pose": "similarity", "tolerance_mm": None, "faces": 500, "kind": "triangle", "closed": None}),
        ("--align rigid --tolerance 0.3", {"pose": "rigid", "tolerance_mm": 0.3}),
        (
            "--align none --faces 80 --kind quad --no-closed",
            {"pose": None, "faces": 80, "kind": "quad", "closed": False},
        ),
        ("--closed", {"closed": True}),
    ],
)
def test_options_of_a_start_reach_it(files, monkeypatch, options, expected):
    seen = []

    def told(scan, mesh, **how):
        seen.append(how)
        raise ValueError("seen enough")

    monkeypatch.setattr("fitting.run.fit_scan.fit_scan", told)
    assert run(fit, "scan.xyz", "--control", "control.obj", *options.split()) == 2
    assert {name: seen[0][name] for name in expected} == expected


def test_symmetry_and_boundary_reach_the_fit(files, monkeypatch, capsys):
    seen = []

    def told(scan, mesh, **how):
        seen.append((how["priors"], how["boundary"]))
        raise ValueError("seen enough")

    monkeypatch.setattr("fitting.run.fit_scan.fit_scan", told)
    rim = np.array([(1.0, 2, 3), (4, 5, 6)])
    np.savetxt("rim.xyz", rim)
    js.write_mesh("open.ply", js.ControlMesh(*open_pyramid()))
    for options in ("", "--symmetry 0.5 --likeness 0.7", "--boundary rim.xyz --scale 10", "--boundary scan --scale 10"):
        run(fit, "open.ply", "--control", "control.obj", *options.split())
    assert np.isinf(seen[0][0].symmetry) and seen[0][1] is None
    assert float(seen[1][0].symmetry) == 0.5 and seen[1][1] is None
    assert float(seen[1][0].likeness) == pytest.approx(0.7) and seen[0][0].likeness is None
    np.testing.assert_allclose(seen[2][1].points, 10 * rim)
    np.testing.assert_allclose(seen[3][1].points, 10 * np.asarray(open_pyramid()[0])[[0, 3, 4]])
    capsys.readouterr()
    assert run(fit, "scan.xyz", "--control", "control.obj", "--boundary", "scan") == 2
    assert run(fit, "scan.xyz", "--control", "control.obj", "--symmetry", "-1") == 2
    assert run(fit, "scan.xyz", "--symmetry", "1") == 2
    assert run(fit, "scan.xyz", "--likeness", "1") == 2
    words = capsys.readouterr().err
    assert "scan.xyz" in words and "a standard deviation must be positive" in words
    assert "give --control MESH to --symmetry" in words and "give --control MESH to --likeness" in words


def test_many_scans_get_a_folder_each_and_a_summary_though_one_fails(files, capsys):
    folder = files / "scans"
    folder.mkdir()
    np.savetxt(folder / "first.xyz", problem().points + noise())
    (folder / "second.csv").write_text("x,y,z\n1,2\n")
    (folder / "notes.md").write_text("no scan")
    np.savetxt(folder / "third.xyz", problem().points + noise(1))
    assert run(fit, "scans", *GIVEN, "-o", "out") == 2
    captured = capsys.readouterr()
    assert "second.csv, line 2" in captured.err and "1 of 3 did not end well: second.csv" in captured.err
    assert names(files / "out") == ["first", "summary.csv", "third"] and names(files / "out" / "first") == RESULTS
    rows = list(csv.DictReader((files / "out" / "summary.csv").read_text().splitlines()))
    assert [(row["scan"], row["status"]) for row in rows] == [
        ("first.xyz", "0"),
        ("second.csv", "2"),
        ("third.xyz", "0"),
    ]
    own = json.loads((files / "out" / "third" / "report.json").read_text())
    np.testing.assert_allclose(float(rows[2]["rms_mm"]), own["rms"], atol=6e-5)
    assert rows[1]["rms_mm"] == ""


def test_scans_of_one_name_keep_their_suffix(files):
    np.savetxt("scan.csv", problem().points + noise(), delimiter=",")
    assert run(fit, "scan.xyz", "scan.csv", *GIVEN, "--max-sweeps", 0, "-o", "out") == 1
    assert names(files / "out") == ["scan.csv", "scan.xyz", "summary.csv"]


def test_rows_of_one_label_are_fitted_alone(files, capsys):
    points = problem().points + noise()
    rows = [f"{x},{y},{z},{'Left inside' if i % 2 else 'valve'}" for i, (x, y, z) in enumerate(points)]
    Path("heart.csv").write_text("\n".join(["x,y,z,contour", *rows]))
    assert run(fit, "heart.csv", *GIVEN, "--labels", "outside", "left", "--max-sweeps", 0, "-o", "out") == 1
    assert "scan     300 points, " in capsys.readouterr().out
    assert run(fit, "heart.csv", *GIVEN, "--labels", "right", "-o", "out") == 2
    assert "no row has a label that holds 'right'. It has: Left inside, valve." in capsys.readouterr().err


def test_landmarks_of_both_sides_are_kept_together(files, capsys):
    p = problem()
    at = np.asarray(p.truth.vertices)
    mesh = {name: at[i].tolist() for i, name in enumerate(["top", "left", "front", "back"])}
    scan = {name: (np.asarray(place) + (0.0, 0.0, 2.0)).tolist() for name, place in mesh.items()}
    Path("scan.json").write_text(json.dumps(scan))
    Path("mesh.json").write_text(json.dumps(mesh))
    both = ("--landmarks", "scan.json", "--control-landmarks", "mesh.json")
    assert run(fit, "scan.xyz", *GIVEN, *both, "--max-sweeps", 8, "-o", "with") in (0, 1)
    assert run(fit, "scan.xyz", *GIVEN, "--max-sweeps", 8, "-o", "without") in (0, 1)
    z_with, z_without = (js.read_mesh(f"{folder}/control.obj").vertices[:4, 2] for folder in ("with", "without"))
    assert np.mean(z_with - z_without) > 0.08
    capsys.readouterr()
    assert run(fit, "scan.xyz", *GIVEN, *both[:2]) == 2
    assert "landmarks are places on both sides" in capsys.readouterr().err


def test_recipe_of_a_fit_has_the_settings_and_options_come_before_it(files, monkeypatch):
    first = ("--levels", 1, "--h", 1.1, "--max-sweeps", 1, "--align", "none", "--closed", "--faces", 77)
    assert run(fit, "scan.xyz", "--control", "control.obj", *first, "-o", "first") == 1
    np.savetxt("next.xyz", problem().points + noise(1), fmt="%.17g")
    again = ("--control", "control.obj", "--recipe", "first/recipe.json")
    assert run(fit, "next.xyz", *again, "-o", "recipe") == 1
    assert run(fit, "next.xyz", "--control", "control.obj", *first, "-o", "options") == 1
    for name in ("control.obj", "recipe.json"):
        assert Path("recipe", name).read_text() == Path("options", name).read_text()
    seen = []

    def told(scan, mesh, **how):
        seen.append(how)
        raise ValueError("seen enough")

    monkeypatch.setattr("fitting.run.fit_scan.fit_scan", told)
    assert run(fit, "next.xyz", *again, "--levels", 2, "--align", "rigid", "--no-closed", "--scheme", "circle") == 2
    changed = {"levels": 2, "pose": "rigid", "closed": False, "max_sweeps": 1, "faces": 77}
    assert {name: seen[0][name] for name in changed} == changed and isinstance(seen[0]["scheme"], js.CirclePreserving)
