"""Warnings name the line of the user that led to them."""

from pathlib import Path

import meshes
import numpy as np
import pytest
from scans import problem

import fitting
import jaxsubdiv as js

CUBE = js.ControlMesh(*meshes.cube())
BALL = np.random.default_rng(0).normal(size=(3000, 3))
BALL /= np.linalg.norm(BALL, axis=1, keepdims=True)

CALLS = {
    "a reader": lambda: js.read_points("a.xyz"),
    "a reader behind another": lambda: fitting.read_scan("a.xyz"),
    "a topology": lambda: js.build_topology(
        js.ControlMesh(CUBE.vertices, CUBE.faces, -CUBE.vertices), js.Interpolating(), 1
    ),
    "a recipe": lambda: fitting.Recipe(js.Interpolating(), max_sweeps=0, pose=None).fit_scan(
        fitting.Scan(problem().points + (25, 0, 0)), problem().mesh, throw=False
    ),
    "creases": lambda: js.split_normals(CUBE, [(0, 1)]),
    "a control mesh": lambda: fitting.control_mesh(fitting.Scan(BALL * 50, -BALL), faces=80),
}


@pytest.mark.parametrize("name", CALLS)
def test_warning_is_at_the_line_of_the_call(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path("a.xyz").write_text("1 2 3\n4 5 6\nnan 1 2\n")
    with pytest.warns(UserWarning) as told:
        CALLS[name]()
    first = CALLS[name].__code__.co_firstlineno
    assert {one.filename for one in told} == {__file__}
    assert all(first <= one.lineno < first + 4 for one in told)
