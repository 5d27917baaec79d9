"""Both command lines, run in this process: what they write and print, and what they refuse."""

import csv
import functools
import json
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import meshes
import numpy as np
import pytest
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit
from jaxsubdiv.__main__ import main as refine

pytestmark = pytest.mark.usefixtures("command_settings")

VERTICES, FACES = meshes.pyramid()
NORMALS = np.random.default_rng(1).normal(scale=0.3, size=VERTICES.shape) + VERTICES


@pytest.fixture
def pyramid(tmp_path) -> Path:
    """Four triangles and a quad, with normals that are not those of the faces."""
    js.write_mesh(tmp_path / "in.obj", js.ControlMesh(VERTICES, FACES, NORMALS))
    return tmp_path / "in.obj"


def run(command, *arguments) -> int:
    return command([str(argument) for argument in arguments])


# jaxsubdiv


REFINEMENTS = {
    "default": ("", js.Interpolating(), {}),
    "h": ("--h 0.6", js.Interpolating(0.6), {}),
    "h, one a level": ("--h 1.2 0.7", js.Interpolating([1.2, 0.7]), {}),
    "twist": ("--twist printed", js.Interpolating(twist="printed"), {}),
    "weights": ("--weights angle --ignore-normals", js.Interpolating(weights="angle"), {"ignore_normals": True}),
    "old normals": ("--old-normals recompute", js.Interpolating(old_normals="recompute"), {}),
    "boundary": ("--boundary chord", js.Interpolating(boundary="chord"), {}),
    "circle": ("--scheme circle", js.CirclePreserving(), {}),
    "circle and h": ("--scheme circle --h 0.9", js.CirclePreserving(0.9), {}),
    "circle, computed normals": ("--scheme circle --ignore-normals", js.CirclePreserving(), {"ignore_normals": True}),
    "ignore normals": ("--ignore-normals", js.Interpolating(), {"ignore_normals": True}),
    "mesh normals": ("--normals-out mesh", js.Interpolating(), {"mesh_normals": True}),
    "scale": ("--scale 1000", js.Interpolating(), {"scale": 1000}),
    "all": (
        "--h 1.2 0.7 --twist printed --weights uniform --old-normals recompute --boundary chord --normals-out mesh",
        js.Interpolating([1.2, 0.7], twist="printed", weights="uniform", old_normals="recompute", boundary="chord"),
        {"mesh_normals": True},
    ),
}


def open_pyramid() -> meshes.Mesh:
    """A quad and three triangles: a boundary too, for the rules there."""
    return VERTICES, FACES[:-1]


def expected(scheme, ignore_normals=False, mesh_normals=False, scale=1.0) -> js.RefinedSurface:
    vertices, faces = open_pyramid()
    mesh = js.ControlMesh(vertices * scale, faces, None if ignore_normals else NORMALS)
    topology = js.build_topology(mesh, scheme, 2, mesh_normals=mesh_normals)
    return js.refine(scheme, topology, mesh.control(weights=scheme.weights))


@pytest.fixture
def eager():
    """One operation after the other: these are compiled once for all options."""
    with jax.disable_jit():
        yield


@pytest.mark.parametrize("name", REFINEMENTS)
def test_options_are_those_of_the_library(tmp_path, eager, name):
    js.write_mesh(tmp_path / "in.obj", js.ControlMesh(*open_pyramid(), NORMALS))
    options, scheme, how = REFINEMENTS[name]
    assert run(refine, tmp_path / "in.obj", tmp_path / "out.ply", "--levels", 2, *options.split()) == 0
    written, surface = js.read_mesh(tmp_path / "out.ply"), expected(scheme, **how)
    np.testing.assert_allclose(written.vertices, surface.vertices, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(written.normals, surface.normals, rtol=1e-14, atol=1e-14)
    for size in (3, 4):
        np.testing.assert_array_equal(written.faces[size], surface.faces[size])
    plain = expected(js.Interpolating())
    changed = [np.abs(getattr(surface, part) - getattr(plain, part)).max() for part in ("vertices", "normals")]
    assert (max(changed) > 1e-3) == (name != "default")  # or the option would not have been tested


def test_three_levels_unless_told_otherwise(tmp_path, pyramid, capsys):
    assert run(refine, pyramid, tmp_path / "out.ply") == 0
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        f"read     {pyramid}: 5 vertices, 4 triangles, 1 quads, closed, Euler number 2, normals given",
        f"wrote    {tmp_path / 'out.ply'}: 194 vertices, 256 triangles, 64 quads",
    ]
    assert err == ""
    mesh = js.read_mesh(tmp_path / "out.ply")
    assert (len(mesh.vertices), len(mesh.faces[3]), len(mesh.faces[4])) == (194, 256, 64)


def test_no_levels_write_the_input_again(tmp_path, pyramid):
    assert run(refine, pyramid, tmp_path / "out.obj", "--levels", 0) == 0
    np.testing.assert_array_equal(js.read_mesh(tmp_path / "out.obj").vertices, VERTICES)


def test_repairs_are_told_and_done(tmp_path, capsys):
    doubled = "".join(f"v {x} {y} {z}\n" for x, y, z in [*VERTICES, VERTICES[0]])
    (tmp_path / "in.obj").write_text(doubled + "f 6 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\nf 4 3 2 1\nf 1 1 2\n")
    refused = run(refine, tmp_path / "in.obj", tmp_path / "out.obj", "--levels", 0)
    assert refused == 2 and not (tmp_path / "out.obj").exists()
    capsys.readouterr()
    assert run(refine, tmp_path / "in.obj", tmp_path / "out.obj", "--levels", 0, "--repair") == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("repaired: ") for line in lines) >= 2 and "5 vertices" in "".join(lines[-2:])
    assert js.read_mesh(tmp_path / "out.obj").is_closed


def test_sound_mesh_needs_no_repair(tmp_path, pyramid, capsys):
    assert run(refine, pyramid, tmp_path / "out.obj", "--levels", 0, "--repair") == 0
    assert "repaired" not in capsys.readouterr().out


def test_warnings_are_plain_words_on_stderr(tmp_path, pyramid, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run(refine, pyramid, tmp_path / "out.stl", "--levels", 0) == 0
    assert capsys.readouterr().err.endswith(  # the mesh's normals are warned of too
        "warning: out.stl: STL holds triangles only: 1 quads were split in two along their first diagonal.\n"
    )


REFUSED = {
    "no such file": ("none.obj out.ply", r"none.obj"),
    "not a mesh": ("text.obj out.ply", r"text.obj"),
    "unknown format": ("in.obj out.xyz", r".xyz"),
    "no such folder": ("in.obj none/out.ply", r"none"),
    "levels": ("in.obj out.ply --levels 9", "`levels` must lie between 0 and 8; got 9."),
    "h": ("in.obj out.ply --levels 3 --h 1 1", "`h` must be a scalar or have the shape [3]; got [2]."),
    "circle with an option": (
        "in.obj out.ply --scheme circle --weights area --old-normals keep",
        "--weights, --old-normals: only the scheme 'interpolating' has this choice.",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_used_is_status_2_with_words_and_without_a_file(tmp_path, pyramid, capsys, monkeypatch, name):
    arguments, words = REFUSED[name]
    (tmp_path / "text.obj").write_text("hello\n")
    (tmp_path / "out.ply").write_text("an older file")
    monkeypatch.chdir(tmp_path)
    files = sorted(tmp_path.iterdir())
    assert run(refine, *arguments.split()) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and words in err and "Traceback" not in err
    assert sorted(tmp_path.iterdir()) == files and (tmp_path / "out.ply").read_text() == "an older file"


@pytest.mark.parametrize(
    "arguments", ["", "in.obj", "in.obj out.ply --scheme loop", "in.obj out.ply --levels x", "in.obj out.ply --twist 0"]
)
def test_misspelt_arguments_are_status_2_with_the_usage(capsys, arguments):
    with pytest.raises(SystemExit) as caught:
        run(refine, *arguments.split())
    assert caught.value.code == 2 and "usage: jaxsubdiv" in capsys.readouterr().err


@pytest.mark.parametrize(("command", "name"), [(refine, "jaxsubdiv"), (fit, "jaxsubdiv-fit")])
def test_help_names_every_option(capsys, command, name):
    with pytest.raises(SystemExit) as caught:
        command(["--help"])
    out = capsys.readouterr().out
    assert caught.value.code == 0 and out.startswith(f"usage: {name} ")
    assert "--levels" in out and "--scheme" in out and "Exit status" in out


@pytest.mark.parametrize("package", ["jaxsubdiv", "fitting"])
def test_runs_as_a_module(package):
    done = subprocess.run([sys.executable, "-m", package, "--help"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.startswith("usage: ") and done.stderr == ""


# jaxsubdiv-fit


@pytest.fixture
def files(tmp_path, monkeypatch) -> Path:
    """A scan and a control mesh as files, in the folder that the command runs in."""
    p = problem()
    np.savetxt(tmp_path / "scan.xyz", p.points + noise(), fmt="%.17g")
    np.savetxt(tmp_path / "metres.xyz", (p.points + noise()) / 1000, fmt="%.17g")
    start = js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals)
    js.write_mesh(tmp_path / "control.obj", start)
    js.write_mesh(tmp_path / "centimetres.obj", js.ControlMesh(start.vertices / 10, start.faces, start.normals))
    monkeypatch.chdir(tmp_path)
    return tmp_path


RESULTS = ["control.obj", "fit.html", "fit.npz", "fit.png", "recipe.json", "report.json", "surface.ply"]


GIVEN = ("--control", "control.obj", "--levels", 1, "--align", "none")
"""A control mesh where it is, and one level: what the fits of `scans` run."""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


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


def stop_after(monkeypatch, sweeps: float) -> None:
    """Ctrl-C once a fit has made so many sweeps."""

    def stop(self, sweep):
        if sweep.number > sweeps:
            raise KeyboardInterrupt

    monkeypatch.setattr("fitting.command.progress.Progress.update", stop)


def test_ctrl_c_leaves_a_checkpoint_and_the_same_command_goes_on(files, capsys, monkeypatch):
    command = ("scan.xyz", *GIVEN, "-o")
    assert run(fit, *command, "whole") == 0
    stop_after(monkeypatch, 2)
    assert run(fit, *command, "out") == 130
    captured = capsys.readouterr()
    assert "stopped  the same command goes on from the last sweep\n" in captured.err and "Traceback" not in captured.err
    assert names(files / "out") == ["checkpoint.npz", "checkpoint_start.npz"]
    assert run(fit, *command, "out", "--faces", 80) == 2
    assert "checkpoint_start.npz is of another fit, with another faces" in capsys.readouterr().err
    stop_after(monkeypatch, np.inf)
    assert run(fit, *command, "out") == 0
    assert "now      goes on where it was stopped" in capsys.readouterr().out
    assert names(files / "out") == RESULTS
    for name in ("control.obj", "report.json", "surface.ply"):
        assert Path("out", name).read_bytes() == Path("whole", name).read_bytes()


def test_resume_skips_what_is_done_and_goes_on_with_the_rest(files, capsys, monkeypatch):
    Path("scans").mkdir()
    for i in range(3):
        np.savetxt(f"scans/{i}.xyz", problem().points + noise(i), fmt="%.17g")
    command = ("scans", *GIVEN, "--max-sweeps", 2, "-o", "out")
    first = functools.partial(run, fit, *command)
    done = []

    def stop_in_second(self, sweep):
        done.append(sweep.number)
        if len(done) == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr("fitting.command.progress.Progress.update", stop_in_second)
    assert first() == 130
    assert "with --resume it skips the scans that are done" in capsys.readouterr().err
    assert names(files / "out") == ["0", "1", "summary.csv"] and "checkpoint.npz" in names(files / "out" / "1")
    before = (files / "out" / "0" / "fit.npz").stat().st_mtime_ns
    assert first("--resume") == 1
    assert len(done) == 4 + 1 + 2  # the second from its second sweep on, and the third
    assert "done     before, in out/0" in capsys.readouterr().out
    assert (files / "out" / "0" / "fit.npz").stat().st_mtime_ns == before
    rows = list(csv.DictReader((files / "out" / "summary.csv").read_text().splitlines()))
    assert [row["scan"] for row in rows] == ["0.xyz", "1.xyz", "2.xyz"] and rows[0]["seconds"] == "" != rows[1][
        "seconds"
    ]
    own = json.loads((files / "out" / "0" / "report.json").read_text())
    np.testing.assert_allclose(float(rows[0]["rms_mm"]), own["rms"], atol=6e-5)
    np.savetxt("scans/0.xyz", problem().points, fmt="%.17g")
    capsys.readouterr()
    assert first("--resume", "--max-sweeps", 3) == 2
    err = capsys.readouterr().err
    assert "out/0 holds a fit with another max_sweeps, another points of the scan. Without --resume" in err
    assert "out/2 holds a fit with another max_sweeps. Without" in err


def test_fit_that_did_not_converge_is_status_1_and_written_all_the_same(files, capsys):
    assert run(fit, "scan.xyz", *GIVEN, "--max-sweeps", 2) == 1
    assert "NOT CONVERGED" in capsys.readouterr().out
    assert names(files / "fit_scan.xyz") == RESULTS
    assert json.loads((files / "fit_scan.xyz" / "report.json").read_text())["converged"] is False


def test_scales_bring_both_files_to_mm(files):
    options = (
        "--levels",
        1,
        "--align",
        "none",
        "--max-sweeps",
        0,
    )  # the start itself: a sweep's solver lets the last digits grow
    assert run(fit, "scan.xyz", "--control", "control.obj", "-o", "a", *options) == 1
    scaled = ("metres.xyz", "--scale", 1000, "--control", "centimetres.obj", "--control-scale", 10)
    assert run(fit, *scaled, "-o", "b", *options) == 1
    a, b = (js.read_mesh(f"{folder}/control.obj").vertices for folder in "ab")
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)
    a, b = (json.loads(Path(folder, "report.json").read_text())["rms"] for folder in "ab")
    np.testing.assert_allclose(a, b, rtol=1e-4)  # rounding decides between two bent quads that are equally near


def test_without_matplotlib_there_is_no_picture_but_all_the_rest(files, capsys, monkeypatch):
    for module in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, module, None)
    assert run(fit, "scan.xyz", *GIVEN, "--max-sweeps", 1, "-o", "out") == 1
    assert names(files / "out") == [name for name in RESULTS if name != "fit.png"]
    assert "note     no picture: " in capsys.readouterr().out


def test_without_tqdm_every_sweep_is_a_line(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert run(fit, "scan.xyz", *GIVEN, "--max-sweeps", 2, "-o", "out") == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("sweep")]
    assert [line[:9] for line in lines] == ["sweep   1", "sweep   2"]


def test_far_start_is_a_warning_in_plain_words(files, capsys):
    np.savetxt("off.xyz", problem().points + (25, 0, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run(fit, "off.xyz", *GIVEN, "--max-sweeps", 0) == 1
    assert "\nwarning: half of the scan lies over " in "\n" + capsys.readouterr().err


FIT_REFUSED = {
    "no such scan": ("none.xyz --control control.obj", "none.xyz"),
    "scan that is no numbers": ("text.xyz --control control.obj", "text.xyz, line 1"),
    "no such control mesh": ("scan.xyz --control none.obj", "none.obj"),
    "no levels": ("scan.xyz --control control.obj --levels 0", "a topology of one level or more"),
    "scan in metres": ("metres.xyz --control control.obj --levels 1 --align none", "their units differ"),
    "scan in metres, to be aligned": ("metres.xyz --control control.obj --levels 1", "m and mm"),
    "folder without scans": (".git", "holds no scan"),
    "empty file": ("empty.xyz", "empty.xyz: the file is empty"),
    "one spot": ("spot.xyz --control control.obj", "all points of the scan lie on one spot"),
    "one spot, not aligned": ("spot.xyz --control control.obj --align none --levels 1", "lie on one spot"),
    "control mesh without faces": ("scan.xyz --control points.obj", "points.obj: it holds points but no faces"),
    "h of a scheme without one": ("scan.xyz --scheme loop --h 1", "the scheme Loop has no h: leave --h out."),
    "no such recipe": ("scan.xyz --recipe none.json", "none.json"),
    "recipe that is none": ("scan.xyz --recipe points.obj", "points.obj: no JSON text"),
    "too few points": (
        "few.xyz --control control.obj --levels 1 --align none",
        "the scan has 2 points for 12 control vertices",
    ),
}


@pytest.mark.parametrize("name", FIT_REFUSED)
def test_fit_of_what_cannot_be_used_is_status_2_with_words_and_without_files(files, capsys, name):
    arguments, words = FIT_REFUSED[name]
    Path("text.xyz").write_text("hello world\n")
    Path("few.xyz").write_text("1 2 3\n4 5 6\n")
    Path("empty.xyz").touch()
    Path("spot.xyz").write_text("1 2 3\n" * 20)
    Path("points.obj").write_text("v 1 2 3\nv 4 5 6\n")
    Path(".git").mkdir()
    assert run(fit, *arguments.split()) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and words in err and "Traceback" not in err
    assert not list(files.glob("fit_*/*"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--control control.obj", "give SCAN to --control"),
        ("--example head", "invalid choice: 'head'"),
        ("scan.xyz --control control.obj --scheme lop", "invalid choice: 'lop'"),
    ],
)
def test_misspelt_arguments_of_a_fit_are_status_2_with_the_usage(files, capsys, arguments, words):
    before = names(files)
    with pytest.raises(SystemExit) as caught:
        run(fit, *arguments.split())
    err = capsys.readouterr().err
    assert caught.value.code == 2 and "usage: jaxsubdiv-fit" in err and words in err
    assert names(files) == before
