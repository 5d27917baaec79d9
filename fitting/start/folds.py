"""Faces that lie upside down on their neighbours: a fit does not begin with them, and shortens steps that make them.

Remeshing leaves such faces, where a vertex with three neighbours has come to lie outside of their triangle. A surface
that lies in three layers takes its points from all of them in turn, and what no point holds rises to a fin.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.closest import AnyArray
from jaxsubdiv.errors import name_rows
from jaxsubdiv.half_edges import HalfEdges, half_edges
from jaxsubdiv.notices import warn

from .remesh import averages

_FOLDED = -0.5  # cosine between the normals of two faces that are folded onto each other; -1/3 in a tetrahedron
_TURNED = -0.2  # mean cosine between a face upside down and those at its corners; 0 at the rim of a thin part
_ROUNDS = 50  # half of the way to the middle of its neighbours each: more than a vertex needs to come home


class Folds(eqx.Module):
    """Which faces of a control mesh lie beside which, to tell those that lie upside down; triangles, then quads.

    Attributes:
        corners: of every face; the last of a triangle twice.
        beside: the two faces at every edge that has two.
        edges_of: the rows in `beside` of each face's edges; -1 where an edge has one face alone.
        sides: half-edges of the mesh.
    """

    corners: Int[Array | np.ndarray, "f 4"]
    beside: Int[Array | np.ndarray, "e 2"]
    edges_of: Int[Array | np.ndarray, "f 4"]
    sides: HalfEdges
    n_vertices: int = eqx.field(static=True)

    def __init__(self, topology: js.Topology):
        faces = {size: np.asarray(topology.control_faces[size]) for size in (3, 4)}
        self.corners = np.concatenate([faces[3][:, [0, 1, 2, 2]], faces[4]])
        self.n_vertices = topology.n_control_vertices
        self.sides = sides = half_edges(faces)
        order = np.argsort(sides.edge, kind="stable")
        first = np.flatnonzero(sides.edge[order][1:] == sides.edge[order][:-1])
        self.beside = sides.face[order][np.stack([first, first + 1], axis=1)]
        row_of_edge = np.full(len(sides.edges), -1)
        row_of_edge[sides.edge[order][first]] = np.arange(len(first))
        self.edges_of = np.full(self.corners.shape, -1)
        slot = np.arange(len(sides.face)) - np.searchsorted(sides.face, sides.face)
        self.edges_of[sides.face, slot] = row_of_edge[sides.edge]

    def find_turned_over(self, vertices: Float[AnyArray, "v 3"], xp: Any = np) -> Bool[AnyArray, "f"]:
        """Faces that are folded onto the faces beside them at most of their edges.

        Of faces that meet at one edge only, either may be the one.
        """
        back = self._count_per_face(self._find_folded(vertices, xp), xp)
        return (back >= 2) & (2 * back > (self.edges_of >= 0).sum(axis=1))

    def find_upside_down(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "f"]:
        """Those of them that most of the faces at their corners are turned away from, as at no rim of a thin part."""
        normals, sides = self._normals(vertices, np), self.sides
        own = normals[sides.face]
        at_corner = np.stack([np.bincount(sides.start, axis, self.n_vertices) for axis in own.T], axis=1)
        others = np.bincount(sides.start, minlength=self.n_vertices) - 1
        agree = np.bincount(sides.face, np.sum((at_corner[sides.start] - own) * own, axis=1))
        return self.find_turned_over(vertices) & (agree < _TURNED * np.bincount(sides.face, others[sides.start]))

    def _normals(self, vertices: Float[AnyArray, "v 3"], xp: Any) -> Float[AnyArray, "f 3"]:
        a, b, c, d = (vertices[self.corners[:, i]] for i in range(4))
        normals = xp.cross(c - a, d - b)  # of a triangle, whose last corners are one, cross(c - a, c - b)
        return normals / xp.maximum(xp.sqrt(xp.sum(normals**2, axis=1, keepdims=True)), np.finfo(normals.dtype).tiny)

    def _find_folded(self, vertices: Float[AnyArray, "v 3"], xp: Any) -> Bool[AnyArray, "e"]:
        """Edges at which two faces are folded onto each other."""
        normals = self._normals(vertices, xp)
        one, other = normals[self.beside[:, 0]], normals[self.beside[:, 1]]
        return xp.sum(one * other, axis=1) < _FOLDED

    def _count_per_face(self, edges: Bool[AnyArray, "e"], xp: Any = np) -> Int[AnyArray, "f"]:
        """How many of these edges each face has."""
        edges = xp.concatenate([edges, xp.zeros(1, bool)])  # the last, for edges that have one face alone
        return edges[self.edges_of].sum(axis=1)

    def corners_of(self, faces: Bool[AnyArray, "f"], xp: Any = np) -> Bool[AnyArray, "v"]:
        """The vertices of these faces."""
        if xp is np:
            corners = np.zeros(self.n_vertices, bool)
            corners[self.corners[faces]] = True
            return corners
        marks = jnp.broadcast_to(faces[:, None], self.corners.shape)
        return jnp.zeros(self.n_vertices, bool).at[jnp.asarray(self.corners)].max(marks)

    def unfold(self, vertices: Float[np.ndarray, "v 3"], may_move: Bool[np.ndarray, "v"]) -> Float[np.ndarray, "v 3"]:
        """The vertices; those of faces upside down between their neighbours, where that leaves fewer such faces.

        Those beside them follow where they have to: a vertex may lie on the far side of a thin triangle that is itself
        turned. Edges that are folded elsewhere, of a rim, stay.
        """
        around = averages(self.sides.edges, self.n_vertices)
        on_boundary = np.zeros(self.n_vertices, bool)
        on_boundary[self.sides.edges[np.bincount(self.sides.edge) == 1]] = True  # its middles lie within the mesh
        turned = self.find_upside_down(vertices)
        of_rims = self._find_folded(vertices, np) & ~turned[self.beside].any(axis=1)

        def folds_of(x: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "v"]:
            return self.corners_of(self._count_per_face(self._find_folded(x, np) & ~of_rims) > 0)

        x = best = vertices
        hurt, moving, fewest = self.corners_of(turned), np.zeros(self.n_vertices, bool), np.sum(folds_of(vertices))
        for _ in range(_ROUNDS):
            moving |= hurt & may_move & ~on_boundary
            if not (hurt & moving).any():
                break
            x = np.where(moving[:, None], 0.5 * (x + around @ x), x)
            folded = folds_of(x)
            if np.sum(folded) < fewest:
                best, fewest = x, np.sum(folded)
            hurt = folded & (moving | (around @ moving > 0))
        return best if np.sum(self.find_upside_down(best)) < np.sum(turned) else vertices


def unfold_start(topology: js.Topology, control: js.Control, may_move: Bool[np.ndarray, "v"] | bool) -> js.Control:
    """The control mesh without faces upside down, as far as vertices that are free can mend it; it warns of them."""
    folds, given = Folds(topology), np.asarray(control.vertices, np.float64)
    turned = folds.find_upside_down(given)
    if not turned.any():
        return control
    mended = folds.unfold(given, np.broadcast_to(may_move, len(given)))
    n_stay = np.sum(turned & folds.find_upside_down(mended))
    unmended = n_stay == np.sum(turned)
    if unmended:
        done = "They stay, as their vertices are fixed, on a boundary, or in a knot: look at the surface there."
    else:
        but = f", but {n_stay} of them stay" if n_stay else ""
        done = f"The fit starts with their vertices moved between their neighbours{but}."
    warn(
        "faces of the control mesh that lie upside down on those beside them where the fit starts: "
        f"{name_rows(np.flatnonzero(turned))} ({np.sum(turned)} of {len(turned)}, triangles counted before quads). "
        f"{done} Mend them in the control mesh, or make it again.",
    )
    return control if unmended else js.Control(jnp.asarray(mended, control.vertices.dtype), control.normals)
