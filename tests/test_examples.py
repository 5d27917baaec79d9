"""The examples that ship, as the command line fits them."""

import json
import re

import meshio
import numpy as np
import pytest
from scans import rms

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fitting_command


def test_example_of_the_command_line_comes_back_within_a_third_of_a_millimetre(tmp_path, capsys, command_settings):
    status = fitting_command(["--example", "head_fragment", "-o", str(tmp_path / "out")])
    out = capsys.readouterr().out
    assert status == 0
    assert "moved by noise of 3 mm in each coordinate" in out
    assert re.search(r"^fit +converged after \d+ sweeps$", out, re.MULTILINE)
    start, end = (
        float(re.search(rf"^RMS distance .*?{part}([0-9.]+) mm", out, re.MULTILINE)[1]) for part in (r"from ", "")
    )
    assert start > 1.5 and 0 < end < 0.35
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "control.obj",
        "fit.html",
        "fit.npz",
        "fit.png",
        "recipe.json",
        "report.json",
        "surface.ply",
    ]

    _, original = fitting.example("head_fragment")
    control = js.read_mesh(tmp_path / "out" / "control.obj")
    assert len(control.vertices) == 165 and len(control.faces[4]) == 140 and len(control.faces[3]) == 0
    # A rim that a few points pull out far from the scan hardly shows in the distances.
    points = np.asarray(fitting.example("head_fragment")[0].points)
    assert np.all(np.ptp(control.vertices, axis=0) < np.ptp(points, axis=0) + 20)
    np.testing.assert_array_equal(control.faces[4], original.faces[4])
    np.testing.assert_allclose(np.linalg.norm(control.normals, axis=1), 1, atol=1e-6)

    surface = meshio.read(tmp_path / "out" / "surface.ply")
    assert surface.cells_dict["quad"].shape == (140 * 4**3, 4) and "triangle" not in surface.cells_dict
    known = surface.point_data["distance_mm"][~np.isnan(surface.point_data["distance_mm"])]
    assert len(known) > 0.9 * len(surface.points) and rms(known) < 0.35

    own = float(json.loads((tmp_path / "out" / "report.json").read_text())["rms"])
    np.testing.assert_allclose(own, end, atol=6e-4)
    assert (tmp_path / "out" / "fit.png").read_bytes().startswith(b"\x89PNG\r\n")
    assert (tmp_path / "out" / "fit.png").stat().st_size > 50_000


@pytest.mark.filterwarnings("ignore:faces of the control mesh that lie upside down")  # the noise of its start
def test_closed_example_comes_back_within_a_third_of_a_millimetre():
    scan, mesh = fitting.example("femur_distal")
    noise = np.random.default_rng(0).normal(scale=3.0, size=mesh.vertices.shape)
    start = js.ControlMesh(mesh.vertices + noise, mesh.faces, mesh.normals)
    topology = js.build_topology(start, js.Interpolating(), 2)
    found = fitting.fit(js.Interpolating(), topology, start.control(), scan)
    assert found.rms[0] > 1.5 and found.rms[-1] < 0.35
    assert f"{found.rms[-1]:.3f} mm" in str(found.report()) and "converged after" in str(found.report())
