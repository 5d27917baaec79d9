"""Results of the command: each scan's own, whole or marked as unfinished, whatever names, streams or runs do."""

import csv
import io
import os
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting.__main__ import main
from fitting.run.folder import RESULTS, fill_folder, reserve_folder
from fitting.run.names import find_scans, name_folder, name_folders
from jaxsubdiv.__main__ import main as refine
from jaxsubdiv.console import make_printable, survive_closed_streams

pytestmark = pytest.mark.usefixtures("command_settings")
QUICK = ("--control", "control.obj", "--levels", "1", "--align", "none", "--max-sweeps", "1")


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """A control mesh and a scan, in the folder that the command runs in."""
    p = problem()
    js.write_mesh(tmp_path / "control.obj", js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals))
    monkeypatch.chdir(tmp_path)
    write_scan("scan.xyz")
    return tmp_path


def write_scan(path: str, seed: int = 0, **how) -> None:
    Path(path).parent.mkdir(exist_ok=True)
    np.savetxt(path, problem().points + noise(seed), **({"fmt": "%.17g"} | how))


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def names(folder: str | Path) -> list[str]:
    return sorted(os.listdir(folder))


def rows(path: str) -> list[dict[str, str]]:
    return list(csv.DictReader(Path(path).read_text(encoding="utf-8").splitlines()))


@pytest.mark.parametrize(
    ("scans", "folders"),
    [
        (["a.ply", "b.ply"], ["a", "b"]),
        (["a.ply", "a.xyz", "b.ply"], ["a.ply", "a.xyz", "b"]),
        (["p1/scan.xyz", "p2/scan.xyz"], ["p1_scan.xyz", "p2_scan.xyz"]),
        (["x/p/scan.xyz", "y/p/scan.xyz"], ["x_p_scan.xyz", "y_p_scan.xyz"]),
        (["a.ply", "q/a.ply.xyz", "p/a.xyz"], ["a.ply", "a.ply.xyz", "a.xyz"]),
        (["...xyz", "a.xyz"], ["...xyz", "a"]),
        (["summary.csv.xyz", "a.xyz"], ["summary.csv.xyz", "a"]),
        (["A.xyz", "a.ply"], ["A.xyz", "a.ply"]),
        (["e\u0301.xyz", "p/\u00e9.xyz"], ["e\u0301.xyz", "p_\u00e9.xyz"]),
        (["a..xyz", "a.xyz"], ["a..xyz", "a.xyz"]),
        (["/p_q/a.xyz", "/p/q_a.xyz", "/b/a.xyz", "/b/q_a.xyz"], ["p_q_a.xyz", "p_q_a.xyz-2", "b_a.xyz", "b_q_a.xyz"]),
    ],
)
def test_no_two_scans_share_a_folder(monkeypatch, scans, folders):
    monkeypatch.chdir("/")
    assert name_folders([Path(scan) for scan in scans]) == folders


def test_folder_names_are_short_enough_for_a_disk():
    found = name_folders([Path("a" * 240 + ".xyz"), Path("a" * 240 + ".ply")])
    assert len(set(found)) == 2 and max(map(len, found)) < 210


def test_scans_of_a_folder_are_files_and_no_summary_and_each_counts_once(here):
    write_scan("scans/a.xyz")
    Path("scans/summary.csv").write_text("x,y,z\n1,2,3\n")
    Path("scans/b.xyz").mkdir()
    assert find_scans([Path("scans"), Path("scans/a.xyz"), Path("scan.xyz")]) == [Path("scans/a.xyz"), Path("scan.xyz")]


@pytest.mark.parametrize(
    ("scan", "folder"),
    [
        ("a.ply", "fit_a.ply"),
        ("a.xyz", "fit_a.xyz"),
        ("p/a.ply", "fit_p_a.ply"),
        ("./p/../q/a.ply", "fit_q_a.ply"),
        ("../p/a.ply", "fit_home_p_a.ply"),
        ("/home/u/a.ply", "fit_a.ply"),
        ("/disk/a.ply", "fit_disk_a.ply"),
    ],
)
def test_scan_fitted_alone_gets_a_folder_by_its_place(monkeypatch, scan, folder):
    monkeypatch.setattr(os, "getcwd", lambda: "/home/u")
    assert name_folder(Path(scan)) == folder


def test_fit_of_another_file_takes_no_place(here):
    write_scan("scan.txt", 1)
    for name in ("scan.xyz", "scan.txt"):
        assert run(name, *QUICK) == 1
    for i, name in enumerate(("scan.xyz", "scan.txt")):
        np.testing.assert_array_equal(fitting.load(f"fit_{name}").scan.points, np.float64(problem().points + noise(i)))


def test_results_of_a_fit_are_no_scans(here):
    write_scan("scans/a.xyz")
    assert run("scans/a.xyz", *QUICK, "-o", "scans") == 1
    assert {"surface.ply", "control.obj", "fit.npz"} <= set(names("scans"))
    assert find_scans([Path("scans")]) == [Path("scans/a.xyz")]
    Path("scans/fit.npz").rename("scans/checkpoint_start.npz")  # as a run that was stopped leaves them
    assert find_scans([Path("scans")]) == [Path("scans/a.xyz")]
    Path("scans/checkpoint_start.npz").unlink()  # then nothing marks them
    assert find_scans([Path("scans")]) == [Path(f"scans/{name}") for name in ("a.xyz", "control.obj", "surface.ply")]


def test_scans_of_one_name_get_their_own_results(here):
    write_scan("p1/scan.xyz", 1)
    write_scan("p2/scan.xyz", 2)
    assert run("p1/scan.xyz", "p2/scan.xyz", *QUICK, "-o", "out") == 1
    assert names("out") == ["p1_scan.xyz", "p2_scan.xyz", "summary.csv"]
    for i in (1, 2):
        np.testing.assert_array_equal(
            fitting.load(f"out/p{i}_scan.xyz").scan.points, np.float64(problem().points + noise(i))
        )
    assert [row["scan"] for row in rows("out/summary.csv")] == ["p1/scan.xyz", "p2/scan.xyz"]


ODD = ["$x_{$.xyz", "...xyz", "50% %s {0}.xyz", "caf\udce9.xyz", "\u4e2d\u6587 \u05d0.xyz", "<b>&.xyz", "-o.xyz"]


def test_odd_names_work_everywhere_and_none_leaves_the_output(here):
    for name in ODD:
        write_scan(f"scans/{name}")
    Path("sub").mkdir()
    assert run("scans", *QUICK, "-o", "sub/out") == 1
    assert names("sub") == ["out"]
    folders = [name if name == "...xyz" else name.removesuffix(".xyz") for name in ODD]
    assert names("sub/out") == sorted([*folders, "summary.csv"])
    for folder in folders:
        assert names(f"sub/out/{folder}") == sorted(RESULTS)
    titles = [row["scan"] for row in rows("sub/out/summary.csv")]
    assert sorted(titles) == sorted(map(make_printable, ODD)) and "caf\\xe9.xyz" in titles
    assert "caf\\xe9.xyz" in Path("sub/out/caf\udce9/fit.html").read_text(encoding="utf-8")


def test_fit_takes_the_place_of_another_as_a_whole(here, monkeypatch):
    assert run("scan.xyz", *QUICK, "-o", "out") == 1
    Path("out/notes.txt").write_text("my own")
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert run("scan.xyz", *QUICK, "--h", "1.1", "-o", "out") == 1
    assert names("out") == sorted({*RESULTS, "notes.txt"} - {"fit.png"})  # the picture was of the other fit


def test_fit_that_cannot_be_written_leaves_the_one_before_and_goes_on_from_its_last_sweep(here, monkeypatch, capsys):
    assert run("scan.xyz", *QUICK, "-o", "out") == 1
    before = {name: Path("out", name).read_bytes() for name in RESULTS}
    command = ("scan.xyz", *QUICK[:-1], "3", "-o", "out")
    with monkeypatch.context() as patch:
        patch.setattr("fitting.command.outputs.save_fit", lambda *_: 1 / 0)
        assert run(*command) == 2
    assert names("out") == sorted([*RESULTS, "checkpoint.npz", "checkpoint_start.npz"])
    assert before == {name: Path("out", name).read_bytes() for name in RESULTS}
    sweeps = []
    monkeypatch.setattr("fitting.command.progress.Progress.update", lambda self, sweep: sweeps.append(sweep.number))
    assert run(*command, "--resume") == 1
    assert sweeps == [3] and names("out") == sorted(RESULTS)
    assert len(fitting.load("out").rms) == 4
    assert run("scan.xyz", *QUICK[:-1], "3", "-o", "undisturbed") == 1
    for name in ("control.obj", "surface.ply", "report.json", "fit.html"):
        assert Path("out", name).read_bytes() == Path("undisturbed", name).read_bytes()


def test_files_are_put_in_place_together_with_the_mark_to_the_end(here):
    Path("out").mkdir()
    Path("out/checkpoint_start.npz").touch()
    with pytest.raises(ZeroDivisionError), fill_folder(Path("out")) as new:
        (new / "control.obj").touch()
        raise ZeroDivisionError
    assert names("out") == ["checkpoint_start.npz"]
    with fill_folder(Path("out")) as new:
        (new / "control.obj").touch()
        assert "control.obj" not in names("out")
    assert names("out") == ["control.obj"]


def test_layers_take_their_places_with_the_fit_and_go_with_it(here):
    Path("out").mkdir()
    with fill_folder(Path("out")) as new:
        (new / "layers").mkdir()
        for name in ("endo_control.obj", "endo.ply", "endo.surf.gii", "endo_thickness.png"):
            (new / "layers" / name).touch()
        assert names("out") == [new.name]
    Path("out/layers/own.txt").touch()
    with fill_folder(Path("out")) as new:
        (new / "layers").mkdir()
        (new / "layers" / "epi_control.obj").touch()
    assert names("out/layers") == ["epi_control.obj", "own.txt"]
    with fill_folder(Path("out")):
        pass
    assert names("out/layers") == ["own.txt"]
    Path("out/layers/own.txt").unlink()
    with fill_folder(Path("out")):
        pass
    assert names("out") == []


def test_what_killed_runs_left_goes_and_what_is_somebody_elses_stays(here):
    for left in (".unfinished-killed/fit.npz", ".unfinished-mine/letter.txt", ".unfinished-file", "checkpoint.npz"):
        Path("out", left).parent.mkdir(parents=True, exist_ok=True)
        Path("out", left).touch()
    with reserve_folder(Path("out")):
        pass
    assert names("out") == [".unfinished-file", ".unfinished-mine"]


def test_two_runs_do_not_work_in_one_folder(here, capsys):
    pytest.importorskip("fcntl")
    with reserve_folder(Path("out")):
        assert run("scan.xyz", *QUICK, "-o", "out") == 2
    assert "another run is working in out" in capsys.readouterr().err
    assert run("scan.xyz", *QUICK, "-o", "out") == 1


@pytest.mark.parametrize("scans", [["scan.xyz"], ["scan.xyz", "other.xyz"]])
def test_folder_is_tried_before_the_work_starts(here, monkeypatch, capsys, scans):
    write_scan("other.xyz")
    monkeypatch.setattr("fitting.command.inputs.read_scan", lambda *_, **__: pytest.fail("began to work"))
    assert run(*scans, *QUICK, "-o", "control.obj/out") == 2
    assert "control.obj" in capsys.readouterr().err


def test_failed_run_leaves_no_folders(here):
    assert run("none.xyz", *QUICK, "-o", "deep/er/out") == 2
    assert not Path("deep").exists()


def with_weights(path: str) -> None:
    np.savez(path, points=problem().points, weights=np.linspace(1, 2, 600))


def test_resume_compares_all_that_went_in(here, capsys):
    p = problem()
    js.write_mesh("other.obj", js.ControlMesh(p.start.vertices * 1.01, p.mesh.faces, p.start.normals))
    js.write_mesh("bare.obj", js.ControlMesh(p.start.vertices, p.mesh.faces))
    np.savetxt(
        "normals.xyz",
        np.hstack([p.points + noise(), p.points / np.linalg.norm(p.points, axis=1, keepdims=True)]),
        fmt="%.17g",
    )
    Path("on_scan.json").write_text('{"a": [1, 2, 3], "b": [4, 9, 6], "c": [7, 8, 1], "d": [0, 1, 9]}')
    marks = ("--landmarks", "on_scan.json", "--control-landmarks", "on_scan.json")
    command = ("scan.xyz", *QUICK, "-o", "out", "--resume")
    assert run(*command) == 1
    capsys.readouterr()
    others = {
        "another control mesh": ("scan.xyz", *command[1:], "--control", "other.obj"),
        "another control mesh.": ("scan.xyz", *command[1:], "--control", "bare.obj"),
        "another normals of the scan": ("normals.xyz", *command[1:]),
        "another landmarks": (*command, *marks),
        "another priors": (*command, "--symmetry", "1"),
        "another points of the scan": (*command, "--scale", "1.01"),
        "another scheme": (*command, "--h", "1.2"),
    }
    for words, other in others.items():
        assert run(*other) == 2
        assert f"out holds a fit with {words}" in capsys.readouterr().err
    assert run(*command) == 1
    assert "done     before, in out" in capsys.readouterr().out


def test_saved_fit_that_does_not_say_what_it_is_of_is_not_taken_for_done(here, capsys):
    problem().fit(max_sweeps=0).save("out")
    assert run("scan.xyz", *QUICK, "-o", "out", "--resume") == 2
    assert "out holds a fit that does not say of what. Without --resume" in capsys.readouterr().err


@pytest.mark.parametrize("error", [ZeroDivisionError("oh"), SystemExit(3), MemoryError(), RecursionError("deep")])
def test_scan_that_fails_in_whatever_way_does_not_end_a_batch(here, monkeypatch, capsys, error):
    def read(path, **how):
        if path.name == "bad.xyz":
            raise error
        return fitting.read_scan(path, **how)

    write_scan("bad.xyz")
    monkeypatch.setattr("fitting.command.inputs.read_scan", read)
    assert run("bad.xyz", "scan.xyz", *QUICK, "-o", "out") == 2
    assert names("out") == ["scan", "summary.csv"]
    assert [row["status"] for row in rows("out/summary.csv")] == ["2", "1"]
    assert f"error: {str(error) or type(error).__name__}" in capsys.readouterr().err


def test_summary_that_cannot_be_written_does_not_end_a_batch(here, capsys):
    write_scan("other.xyz")
    Path("out/summary.csv").mkdir(parents=True)
    assert run("other.xyz", "scan.xyz", *QUICK, "-o", "out") == 1
    assert names("out") == ["other", "scan", "summary.csv"]
    assert "summary.csv" in capsys.readouterr().err


def test_works_without_a_home_folder(here, monkeypatch):
    def unknown():
        raise RuntimeError("Could not determine home directory.")

    for name in ("HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", unknown)
    before = jax.config.jax_compilation_cache_dir
    assert run("scan.xyz", *QUICK, "-o", "out") == 1
    assert jax.config.jax_compilation_cache_dir == before
    assert names("out") == sorted(RESULTS)


class Broken(io.StringIO):
    """A pipe whose reader has left."""

    def write(self, text: str) -> int:
        raise BrokenPipeError


@pytest.mark.parametrize("stream", [None, Broken()])
def test_closed_streams_lose_words_and_no_results(here, monkeypatch, stream):
    with monkeypatch.context() as patch:
        patch.setattr("sys.stdout", stream)
        patch.setattr("sys.stderr", stream)
        assert run("scan.xyz", "none.xyz", *QUICK, "-o", "out") == 2
        assert sys.stdout is stream
    assert names("out") == ["scan", "summary.csv"] and names("out/scan") == sorted(RESULTS)


@pytest.mark.parametrize("stream", [None, Broken()])
def test_closed_streams_lose_words_and_no_refined_mesh(here, monkeypatch, stream):
    with monkeypatch.context() as patch:
        patch.setattr("sys.stdout", stream)
        patch.setattr("sys.stderr", stream)
        assert refine(["control.obj", "out.obj", "--levels", "1"]) == 0
        assert refine(["none.obj", "out.obj"]) == 2
    assert js.read_mesh("out.obj").n_faces


def test_refinement_says_names_in_letters_that_the_terminal_has(here, monkeypatch):
    raw = io.BytesIO()
    Path("control.obj").rename("caf\u00e9.obj")
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(raw, encoding="ascii"))
    assert refine(["caf\u00e9.obj", "out.obj", "--levels", "1"]) == 0
    assert b"read     caf\\xe9.obj" in raw.getvalue()


def test_letters_that_a_terminal_lacks_are_escaped(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(raw, encoding="ascii"))
    with survive_closed_streams():
        print("caf\u00e9 \udce9")
    assert raw.getvalue() == b"caf\\xe9 \\udce9\n"


SENSELESS = {
    "--levels": ["0", "9"],
    "--max-sweeps": ["-1"],
    "--faces": ["3", "-80"],
    "--points": ["0", "-1"],
    "--tolerance": ["nan", "0", "-1", "inf"],
    "--symmetry": ["nan", "0", "-1"],
    "--likeness": ["nan", "-0.1", "1.1"],
    "--h": ["nan", "inf", "-1"],
    "--scale": ["nan", "0", "-1", "1e30"],
    "--control-scale": ["nan", "0", "inf"],
}


@pytest.mark.parametrize("option", SENSELESS)
def test_senseless_options_of_the_command_are_refused_by_name(here, capsys, option):
    before = names(here)
    for value in SENSELESS[option]:
        assert run("scan.xyz", *QUICK, f"{option}={value}") == 2
        words = capsys.readouterr().err
        assert words.startswith(f"error: {option}: ") and "; got " in words
    assert names(here) == before
