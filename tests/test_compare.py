"""The command that compares schemes."""

import subprocess
import sys

import meshes
import pytest
from meshes import Mesh
from schemes import CASES

import jaxsubdiv as js
from jaxsubdiv import _compare
from jaxsubdiv.__main__ import main


def mesh_file(folder, name: str, mesh: Mesh) -> str:
    js.write_mesh(folder / name, js.ControlMesh(*mesh))
    return str(folder / name)


@pytest.mark.usefixtures("command_settings")
def test_compare_measures_every_scheme(tmp_path, capsys, monkeypatch):
    some = {name: _compare.SCHEMES[name] for name in ("interpolating", "kobbelt", "loop")}
    assert set(_compare.SCHEMES.values()) == {type(case.scheme) for case in CASES}
    monkeypatch.setattr(_compare, "SCHEMES", some)  # each costs some seconds to compile
    quads, triangles = (mesh_file(tmp_path, f"{k}.obj", meshes.torus(8, 4, k)) for k in ("quad", "triangle"))
    truth = mesh_file(tmp_path, "truth.obj", meshes.torus(64, 32))
    picture = tmp_path / "all.png"
    assert main(["compare", quads, "--truth", truth, "--levels", "1", "--picture", str(picture)]) == 0
    printed = capsys.readouterr().out
    rows = {line[:22].strip(): line[22:].replace("°", "").split() for line in printed.splitlines()[1:5]}
    assert list(rows) == ["interpolating", "kobbelt", "loop", "loop, solved"]
    assert all(int(row[0].replace(",", "")) == 256 for row in rows.values())
    rms = {name: float(row[1]) for name, row in rows.items()}
    assert rms["interpolating"] < rms["loop"] and rms["loop, solved"] < rms["loop"] / 5
    assert picture.stat().st_size > 10_000
    assert main(["compare", triangles, "--truth", truth, "--levels", "0"]) == 0
    assert "left out: kobbelt takes quads only" in capsys.readouterr().out
    assert main(["compare", quads, "--truth", str(tmp_path / "none.obj")]) == 2
    assert "error: " in capsys.readouterr().err


def test_compare_has_a_help_of_its_own():
    run = subprocess.run(
        [sys.executable, "-m", "jaxsubdiv", "compare", "--help"], capture_output=True, text=True, check=True
    )
    assert "--truth SURFACE" in run.stdout
