"""Faces that lie upside down on their neighbours: a fit does not begin with them, and its steps make none.

Remeshing leaves such faces, where a vertex with three neighbours has come to lie outside of their triangle. A surface
that lies in three layers takes its points from all of them in turn, and what no point holds rises to a fin.
"""

import warnings

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv._errors import name_rows
from jaxsubdiv._half_edges import half_edges

from ._free import Free
from ._remesh import averages

_FOLDED = -0.5  # cosine between the normals of two faces that are folded onto each other; -1/3 in a tetrahedron
_ROUNDS = 50  # half of the way to the middle of its neighbours each: more than a vertex needs to come home


class Folds:
    """Which faces of a control mesh lie beside which, to tell those that lie upside down."""

    def __init__(self, topology: js.Topology):
        self._faces = {size: np.asarray(topology.control_faces[size]) for size in (3, 4)}
        self._n_vertices = topology.n_control_vertices
        self._sides = sides = half_edges(self._faces)
        order = np.argsort(sides.edge, kind="stable")
        first = np.flatnonzero(sides.edge[order][1:] == sides.edge[order][:-1])
        self._beside = sides.face[order][np.stack([first, first + 1], axis=1)]

    def turned_over(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "f"]:
        """Faces that are folded onto the faces beside them at most of their edges; triangles, then quads."""
        edges, back = (self._per_face(which) for which in (np.ones(len(self._beside), bool), self._folded(vertices)))
        return (back >= 2) & (2 * back > edges)  # of two faces that meet at one edge, either may be the one

    def _folded(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "e"]:
        """Edges at which two faces are folded onto each other."""
        a, b, c = (vertices[corners] for corners in self._faces[3].T)
        p, q, r, s = (vertices[corners] for corners in self._faces[4].T)
        normals = np.concatenate([np.cross(b - a, c - a), np.cross(r - p, s - q)])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
        one, other = normals[self._beside.T]
        return np.sum(one * other, axis=1) < _FOLDED

    def _per_face(self, edges: Bool[np.ndarray, "e"]) -> Int[np.ndarray, "f"]:
        """How many of these edges each face has."""
        return np.bincount(self._beside[edges].ravel(), minlength=sum(map(len, self._faces.values())))

    def corners_of(self, faces: Bool[np.ndarray, "f"]) -> Bool[np.ndarray, "v"]:
        """The vertices of these faces."""
        corners = np.zeros(self._n_vertices, bool)
        corners[self._sides.start[faces[self._sides.face]]] = True
        return corners

    def unfolded(self, vertices: Float[np.ndarray, "v 3"], may_move: Bool[np.ndarray, "v"]) -> Float[np.ndarray, "v 3"]:
        """The vertices; those of faces upside down between their neighbours, as far as that turns faces back."""
        around = averages(self._sides.edges, self._n_vertices)
        on_boundary = np.zeros(self._n_vertices, bool)
        on_boundary[self._sides.edges[np.bincount(self._sides.edge) == 1]] = True  # its middles lie within the mesh
        x = best = vertices
        hurt, moving = self.corners_of(self.turned_over(x)), np.zeros(self._n_vertices, bool)
        fewest = np.sum(self._corners_of_folds(x))
        for _ in range(_ROUNDS):
            moving |= hurt & may_move & ~on_boundary
            if not (hurt & moving).any():
                break
            x = np.where(moving[:, None], 0.5 * (x + around @ x), x)
            folded = self._corners_of_folds(x)
            if np.sum(folded) < fewest:
                best, fewest = x, np.sum(folded)
            # Those beside them too: a vertex may lie on the far side of a thin triangle that is itself turned.
            hurt = folded & (moving | (around @ moving > 0))
        return best

    def _corners_of_folds(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "v"]:
        """The vertices of all faces that have a folded edge."""
        return self.corners_of(self._per_face(self._folded(vertices)) > 0)


def unfolded_start(topology: js.Topology, control: js.Control, free: Free) -> js.Control:
    """The control mesh without faces upside down, as far as vertices that are free can mend it; it warns of them."""
    folds, given = Folds(topology), np.asarray(control.vertices, np.float64)
    turned = folds.turned_over(given)
    if not turned.any():
        return control
    mended = folds.unfolded(given, np.broadcast_to(free.vertices, len(given)))
    left = folds.turned_over(mended)
    doubt = f" {np.sum(left)} of them stay: look at the surface there." if left.any() else ""
    warnings.warn(
        "faces of the control mesh that lie upside down on those beside them where the fit starts: "
        f"{name_rows(np.flatnonzero(turned))} ({np.sum(turned)} of {len(turned)}, triangles counted before quads). "
        f"The fit starts with their vertices moved between their neighbours.{doubt} Mend them in the control mesh, "
        "or make it again.",
        stacklevel=4,
    )
    return js.Control(jnp.asarray(mended, control.vertices.dtype), control.normals)
