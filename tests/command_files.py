"""Files that the tests of the commands work on."""

from pathlib import Path

import meshes
import numpy as np
from scans import noise, problem

import jaxsubdiv as js

VERTICES, FACES = meshes.pyramid()


def run(command, *arguments) -> int:
    return command([str(argument) for argument in arguments])


def open_pyramid() -> meshes.Mesh:
    """A quad and three triangles: a boundary too, for the rules there."""
    return VERTICES, FACES[:-1]


def write_files(folder: Path) -> None:
    """A scan and a control mesh as files."""
    p = problem()
    np.savetxt(folder / "scan.xyz", p.points + noise(), fmt="%.17g")
    np.savetxt(folder / "metres.xyz", (p.points + noise()) / 1000, fmt="%.17g")
    start = js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals)
    js.write_mesh(folder / "control.obj", start)
    js.write_mesh(folder / "centimetres.obj", js.ControlMesh(start.vertices / 10, start.faces, start.normals))


RESULTS = ["control.obj", "fit.html", "fit.npz", "fit.png", "recipe.json", "report.json", "surface.ply"]
GIVEN = ("--control", "control.obj", "--levels", 1, "--align", "none")
"""A control mesh where it is, and one level: what the fits of `scans` run."""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
