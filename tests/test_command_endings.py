"""How the command `jaxsubdiv-fit` ends: interrupted, resumed, not converged, or refused."""

import csv
import functools
import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from command_files import GIVEN, RESULTS, names, run, write_files
from scans import noise, problem

import jaxsubdiv as js
from fitting.__main__ import main as fit

pytestmark = pytest.mark.usefixtures("command_settings")


@pytest.fixture
def files(tmp_path, monkeypatch) -> Path:
    """The folder of a scan and a control mesh, in which the command runs."""
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


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
