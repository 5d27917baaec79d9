"""What the commands write for other programs."""

import argparse
import sys
from pathlib import Path
from unittest.mock import Mock

import meshes
import numpy as np
import pytest
import trimesh
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit
from fitting.command import outputs
from jaxsubdiv import _exports, _tetwild
from jaxsubdiv.__main__ import main as refine

pytestmark = pytest.mark.usefixtures("command_settings")
pyvista = pytest.importorskip("pyvista")
pytest.importorskip("pytetwild")


def run(command, *arguments) -> int:
    return command([str(argument) for argument in arguments])


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    vertices, faces = meshes.cube()
    for name, size in (("bone", 10), ("marrow", 4), ("hole", 3)):
        js.write_mesh(tmp_path / f"{name}.obj", js.ControlMesh(size * vertices, faces))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_surface_within_a_tolerance_is_watertight(folder, capsys):
    assert run(refine, "bone.obj", "bone.stl", "--tolerance", 1) == 0
    mesh = js.read_mesh("bone.obj")
    found = js.refine_within(js.Interpolating(), mesh, mesh.control(), 1.0)
    said = f"refined  {found.levels} times: the limit is within {found.largest:.3g} of the faces, RMS {found.rms:.3g}"
    assert said in capsys.readouterr().out and found.largest < 1
    printed = trimesh.load("bone.stl")
    assert printed.is_watertight and len(printed.vertices) == len(found.surface.vertices)
    assert run(refine, "bone.obj", "bone.stl", "--tolerance", 0) == 2
    with pytest.raises(SystemExit):
        run(refine, "bone.obj", "bone.stl", "--tolerance", 1, "--levels", 3)


def test_tetrahedra_of_surfaces_in_one_another(folder, capsys):
    assert run(refine, "tetrahedra", "bone.obj", "marrow.obj", "out.vtu", "--edge", 8) == 0
    out = capsys.readouterr().out
    assert "inverted: 0" in out and "wrote    out.vtu" in out
    grid = pyvista.read("out.vtu").compute_cell_sizes()
    assert f"{grid.n_cells:,} tetrahedra of {grid.n_points:,} points: bone " in out
    assert (grid.field_data["bone"], grid.field_data["marrow"]) == ([1], [2])
    of_bone, of_marrow = np.bincount(grid["region"], grid["Volume"])[1:]
    np.testing.assert_allclose([of_bone, of_marrow], [8000 - 512, 512], rtol=0.01)
    assert run(refine, "tetrahedra", "bone.obj", "--edge", 8, "--cavity", "hole.obj", "out.vtu") == 0
    assert "of the surface 7784" in capsys.readouterr().out
    assert run(refine, "tetrahedra", "bone.obj", "bone.obj", "out.vtu") == 2
    assert "two surfaces have the same name" in capsys.readouterr().err


def test_options_stand_anywhere_and_a_failure_is_told(folder, capsys, monkeypatch):
    monkeypatch.setattr(_tetwild, "_PROGRAM", "raise SystemExit('out of luck')")
    given = ("bone.obj", "--cavity", "hole.obj", "marrow.obj", "--edge", 8, "--cavity", "other.obj", "out.vtu")
    js.write_mesh("other.obj", js.ControlMesh(meshes.cube()[0] + [7, 0, 0], meshes.cube()[1]))
    js.write_mesh("marrow.obj", js.ControlMesh(meshes.cube()[0] - [7, 0, 0], meshes.cube()[1]))
    assert run(refine, "tetrahedra", *given) == 2
    assert "error: fTetWild ended with status 1 and made no tetrahedra (out of luck)" in capsys.readouterr().err


def test_what_cannot_be_written_is_told_before_anything_is_made(folder, capsys, monkeypatch):
    monkeypatch.setattr(_exports, "read_mesh", None)  # never called
    for command in ("tetrahedra", "patches"):
        assert run(refine, command, "bone.obj", "out.stl") == 2
        assert "go to .vtu files" in capsys.readouterr().err
        assert run(refine, command, "bone.obj", "lost/out.vtu") == 2
        assert "the folder does not exist" in capsys.readouterr().err
    assert run(refine, "patches", "bone.obj", "lost/out.xml") == 2
    assert "the folder does not exist" in capsys.readouterr().err


def test_patches_of_a_control_mesh(folder, capsys):
    assert run(refine, "patches", "bone.obj", "out.vtu", "--scheme", "catmull-clark", "--levels", 2) == 0
    assert "patches  96, of these 72 exact" in capsys.readouterr().out
    assert set(pyvista.read("out.vtu").celltypes) == {77}


def test_a_fit_is_exported(folder, capsys, monkeypatch):
    p = problem()
    np.savetxt("scan.xyz", p.points + noise(), fmt="%.17g")
    js.write_mesh("control.obj", js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals))
    given = ("scan.xyz", "--control", "control.obj", "--levels", 1, "--align", "none", "--max-sweeps", 2, "-o", "out")
    exports = ("--tetrahedra", 30, "--patches", "--surface-tolerance", 2)
    assert run(fit, *given, *exports) == 1
    out = capsys.readouterr().out
    assert "surface.ply, tetrahedra.vtu, patches.vtu, report.json" in out
    result = fitting.load("out")
    found = js.refine_within(result.scheme, result.control_mesh, result.control, 2.0)
    assert f"refined  {found.levels} times: the limit is within {found.largest:.3g} mm" in out
    assert js.read_mesh("out/surface.ply").n_faces == found.surface.n_faces
    grid = pyvista.read("out/tetrahedra.vtu")
    triangles = np.asarray(found.surface.triangles())
    volume = trimesh.Trimesh(np.asarray(found.surface.vertices), triangles).volume
    np.testing.assert_allclose(grid.volume, volume, rtol=0.01)
    assert pyvista.read("out/patches.vtu").n_cells == 14 * 4
    assert run(fit, *given, *exports[:2], "--resume") == 2
    assert "another patches, another surface tolerance" in capsys.readouterr().err
    options = argparse.Namespace(
        surface=["ply"], surface_tolerance=None, surface_level=1, tetrahedra=30.0, patches=1, details=False
    )
    for error, words in ((RuntimeError("no luck"), "no luck"), (OSError("full"), "full"), (MemoryError(), "memory")):
        for name in ("fill_with_tetrahedra", "make_patches"):
            monkeypatch.setattr(js, name, Mock(side_effect=error))
        assert outputs._write_surface(folder, result, options, None) == ["surface.ply"]
        out = capsys.readouterr().out
        assert all(f"note     no {what}: " in out for what in ("tetrahedra", "patches")) and out.count(words) == 2


def test_what_cannot_be_exported_is_told_before_the_fit(folder, capsys, monkeypatch):
    monkeypatch.setattr("fitting.run.fit_scan.fit_scan", None)  # never called
    for option, words in (
        (("--tetrahedra", -1), "--tetrahedra: it is a length in mm"),
        (("--patches", 6), "--patches: there is a patch a face of the surface at a level from 0 to 5; got 6"),
        (("--surface-tolerance", 1, "--surface-level", 2), "leave --surface-level out"),
    ):
        assert run(fit, "bone.obj", *option) == 2
        assert words in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    assert run(fit, "bone.obj", "--tetrahedra") == 2
    assert "need pytetwild, which cannot be imported" in capsys.readouterr().err
    assert run(refine, "tetrahedra", "bone.obj", "out.vtu") == 2
    assert "pip install 'jaxsubdiv[simulation]'" in capsys.readouterr().err
