"""fTetWild, by pytetwild, in a process of its own: it writes into the folder that it runs in."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

_PROGRAM = """
import numpy, pytetwild
given = numpy.load("given.npz")
points, cells = pytetwild.tetrahedralize(
    given["vertices"], given["triangles"], edge_length_abs=float(given["edge"]), epsilon=float(given["tolerance"]),
    vtk_ordering=True, num_threads=1,
)
numpy.savez("made.npz", points=points, cells=cells)
"""


def run_tetwild(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"], edge: float, tolerance: float
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 4"]]:
    """Points and tetrahedra inside of triangles that point outwards.

    Args:
        vertices: of the triangles.
        triangles: their corners.
        edge: to aim at, in the unit of the vertices.
        tolerance: of the boundary, as a part of the diagonal of the bounding box.

    Raises:
        RuntimeError: fTetWild ended without a result.
    """
    with tempfile.TemporaryDirectory() as folder:
        given = {"vertices": vertices, "triangles": triangles.astype(np.int32), "edge": edge, "tolerance": tolerance}
        np.savez(Path(folder) / "given.npz", **given)  # pyright: ignore[reportArgumentType]
        command = [sys.executable, "-c", _PROGRAM]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace")
        if done.returncode:
            words = (done.stderr.strip() or done.stdout.strip() or "it said nothing").splitlines()[-1]
            raise RuntimeError(
                f"fTetWild ended with status {done.returncode} and made no tetrahedra ({words}). Try another `edge` "
                "or `tolerance`, or a finer or coarser surface."
            )
        with np.load(Path(folder) / "made.npz") as made:
            return made["points"], made["cells"].astype(np.int64)
