"""Faces that lie upside down on their neighbours: a fit does not begin with them, and shortens steps that make them.

Remeshing leaves such faces, where a vertex with three neighbours has come to lie outside of their triangle. A surface
that lies in three layers takes its points from all of them in turn, and what no point holds rises to a fin.
"""

import warnings

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.errors import name_rows
from jaxsubdiv.half_edges import half_edges

from ..model.unknowns import Free
from .remesh import averages

_FOLDED = -0.5  # cosine between the normals of two faces that are folded onto each other; -1/3 in a tetrahedron
_TURNED = -0.2  # mean cosine between a face upside down and those at its corners; 0 at the rim of a thin part
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
        self._n_edges = self._per_face(np.ones(len(self._beside), bool))

    def turned_over(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "f"]:
        """Faces that are folded onto the faces beside them at most of their edges; triangles, then quads.

        Of faces that meet at one edge only, either may be the one.
        """
        back = self._per_face(self._folded(vertices))
        return (back >= 2) & (2 * back > self._n_edges)

    def upside_down(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "f"]:
        """Those of them that most of the faces at their corners are turned away from, as at no rim of a thin part."""
        normals, sides = self._normals(vertices), self._sides
        own = normals[sides.face]
        at_corner = np.stack([np.bincount(sides.start, axis, self._n_vertices) for axis in own.T], axis=1)
        others = np.bincount(sides.start, minlength=self._n_vertices) - 1
        agree = np.bincount(sides.face, np.sum((at_corner[sides.start] - own) * own, axis=1))
        return self.turned_over(vertices) & (agree < _TURNED * np.bincount(sides.face, others[sides.start]))

    def _normals(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "f 3"]:
        a, b, c = (vertices[corners] for corners in self._faces[3].T)
        p, q, r, s = (vertices[corners] for corners in self._faces[4].T)
        normals = np.concatenate([np.cross(b - a, c - a), np.cross(r - p, s - q)])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)

    def _folded(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "e"]:
        """Edges at which two faces are folded onto each other."""
        one, other = self._normals(vertices)[self._beside.T]
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
        """The vertices; those of faces upside down between their neighbours, where that leaves fewer such faces.

        Those beside them follow where they have to: a vertex may lie on the far side of a thin triangle that is itself
        turned. Edges that are folded elsewhere, of a rim, stay.
        """
        around = averages(self._sides.edges, self._n_vertices)
        on_boundary = np.zeros(self._n_vertices, bool)
        on_boundary[self._sides.edges[np.bincount(self._sides.edge) == 1]] = True  # its middles lie within the mesh
        turned = self.upside_down(vertices)
        of_rims = self._folded(vertices) & ~turned[self._beside].any(axis=1)

        def folds_of(x: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "v"]:
            return self.corners_of(self._per_face(self._folded(x) & ~of_rims) > 0)

        x = best = vertices
        hurt, moving, fewest = self.corners_of(turned), np.zeros(self._n_vertices, bool), np.sum(folds_of(vertices))
        for _ in range(_ROUNDS):
            moving |= hurt & may_move & ~on_boundary
            if not (hurt & moving).any():
                break
            x = np.where(moving[:, None], 0.5 * (x + around @ x), x)
            folded = folds_of(x)
            if np.sum(folded) < fewest:
                best, fewest = x, np.sum(folded)
            hurt = folded & (moving | (around @ moving > 0))
        return best if np.sum(self.upside_down(best)) < np.sum(turned) else vertices


def unfolded_start(scheme: js.AbstractScheme, topology: js.Topology, control: js.Control, free: Free) -> js.Control:
    """The control mesh without faces upside down, as far as vertices that are free can mend it; it warns of them."""
    folds, given = Folds(topology), np.asarray(control.vertices, np.float64)
    turned = folds.upside_down(given)
    if not turned.any():
        return control
    masks = free.of(scheme, len(given))
    may_move = np.zeros(len(given), bool) if masks.vertices is None else np.asarray(masks.vertices)[:, 0]
    mended = folds.unfolded(given, may_move)
    n_stay = np.sum(turned & folds.upside_down(mended))
    unmended = n_stay == np.sum(turned)
    if unmended:
        done = "They stay, as their vertices are fixed, on a boundary, or in a knot: look at the surface there."
    else:
        but = f", but {n_stay} of them stay" if n_stay else ""
        done = f"The fit starts with their vertices moved between their neighbours{but}."
    warnings.warn(
        "faces of the control mesh that lie upside down on those beside them where the fit starts: "
        f"{name_rows(np.flatnonzero(turned))} ({np.sum(turned)} of {len(turned)}, triangles counted before quads). "
        f"{done} Mend them in the control mesh, or make it again.",
        stacklevel=4,
    )
    return control if unmended else js.Control(jnp.asarray(mended, control.vertices.dtype), control.normals)
