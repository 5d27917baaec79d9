"""The paper's scheme in C++, built on the spot: the peer that says how far from the machine's limit `refine` is."""

import ctypes
import functools
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import jaxsubdiv as js

FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC")


@functools.cache
def built(source: Path, *libraries: str) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        shared = Path(folder) / "shared.so"
        subprocess.run(["g++", *FLAGS, str(source), "-o", str(shared), *libraries], check=True)
        return ctypes.CDLL(str(shared))


def library() -> ctypes.CDLL:
    return built(Path(__file__).with_suffix(".cpp"))


def _at(table: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(table.ctypes.data)


class Gathers:
    """`refine` for float32 and h = 1, on the tables of a topology, into arrays that stay."""

    def __init__(self, topology: js.Topology, control: js.Control):
        self.levels = [
            [np.ascontiguousarray(getattr(level, name)) for name in ("edges", "wings", "quads", "quad_edges")]
            for level in topology.levels
        ]
        n = len(control.vertices)
        total = n + sum(len(edges) + len(quads) for edges, _, quads, _ in self.levels)
        self.vertices, self.normals = (np.zeros((total, 3), np.float32) for _ in range(2))
        self.vertices[:n] = control.vertices
        self.normals[:n] = np.asarray(control.normals) / np.linalg.norm(control.normals, axis=1, keepdims=True)
        self.n_control = n

    def run(self, last_normals: bool) -> None:
        """All levels; the normals of the last one where they are asked for."""
        n_old = self.n_control
        for i, (edges, wings, quads, quad_edges) in enumerate(self.levels):
            library().refine_level(
                n_old,
                len(edges),
                len(quads),
                wings.shape[1],
                *map(_at, (edges, wings, quads, quad_edges)),
                ctypes.c_float(1.0),
                last_normals or i < len(self.levels) - 1,
                *map(_at, (self.vertices, self.normals)),
            )
            n_old += len(edges) + len(quads)
