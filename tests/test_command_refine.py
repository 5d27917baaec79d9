"""The command `jaxsubdiv`, run in this process: what it writes and prints, and what it refuses."""

import subprocess
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
from command_files import FACES, VERTICES, open_pyramid, run

import jaxsubdiv as js
from fitting.__main__ import main as fit
from jaxsubdiv.__main__ import main as refine

pytestmark = pytest.mark.usefixtures("command_settings")
NORMALS = np.random.default_rng(1).normal(scale=0.3, size=VERTICES.shape) + VERTICES


@pytest.fixture
def pyramid(tmp_path) -> Path:
    """Four triangles and a quad, with normals that are not those of the faces."""
    js.write_mesh(tmp_path / "in.obj", js.ControlMesh(VERTICES, FACES, NORMALS))
    return tmp_path / "in.obj"


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
