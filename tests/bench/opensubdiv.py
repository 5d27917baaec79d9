"""OpenSubdiv on the same control meshes, built on the spot; its headers come with Debian's libosd-dev."""

import ctypes
import weakref
from pathlib import Path

import numpy as np
from gathers import built

import jaxsubdiv as js


class OpenSubdiv:
    """Refined vertices of a mesh of triangles by Loop's scheme, of one of quads by Catmull and Clark's.

    Raises:
        OSError, subprocess.CalledProcessError: there is no compiler, or no OpenSubdiv.
    """

    def __init__(self, mesh: js.ControlMesh, levels: int, *, stencils: bool):
        self._library = built(Path(__file__).with_suffix(".cpp"), "-losdCPU")
        self._library.build.restype = ctypes.c_void_p
        triangles = len(mesh.faces[3]) > 0
        self._faces = np.ascontiguousarray(mesh.faces[3 if triangles else 4], np.int32)
        self._control = np.ascontiguousarray(mesh.vertices, np.float32)
        sizes = (triangles, len(mesh.vertices), len(self._faces))
        self._tables = ctypes.c_void_p(self._library.build(*sizes, _at(self._faces), levels, stencils))
        weakref.finalize(self, self._library.discard, self._tables)
        self.vertices = np.zeros((self._library.n_refined(self._tables), 3), np.float32)
        self._run = self._library.run_stencils if stencils else self._library.run_levels

    def run(self) -> None:
        self._run(self._tables, _at(self._control), _at(self.vertices))


def _at(rows: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(rows.ctypes.data)
