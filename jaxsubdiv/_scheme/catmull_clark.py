"""The scheme of Catmull and Clark for any faces."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._masks import Matrix, entries, scaled
from .._stage import Sides, Stage, quad_split
from .creased import AbstractCreasedScheme, Edge, border


class CatmullClark(AbstractCreasedScheme):
    """Catmull-Clark subdivision: approximating, smooth (C2, and C1 at extraordinary vertices); all quads after a level.

    Args:
        boundary: "edge-and-corner" keeps vertices of a single face where they are, "edge-only" rounds them off. Either
            way a boundary is the cubic B-spline of its own vertices.

    Raises:
        ValueError: `boundary` is not one of these.

    Source: E. Catmull & J. Clark, Recursively generated B-spline surfaces on arbitrary topological meshes, 1978. Limit
    masks: Halstead, Kass & DeRose 1993; on boundaries Biermann, Levin & Zorin 2000. Creases as in OpenSubdiv.
    """

    boundary: Edge = eqx.field(static=True, default="edge-and-corner")

    order: ClassVar[int] = 2

    def split(self, stage: Stage) -> Stage:
        return quad_split(stage)

    def face_masks(self, stage: Stage, sides: Sides) -> Matrix:
        n_faces = sum(map(len, stage.faces.values()))
        return entries((n_faces, stage.n_vertices), (sides.face, sides.start, 1 / sides.size))

    def smooth_edges(self, stage: Stage, sides: Sides) -> Matrix:
        e, centres = np.arange(len(stage.edges)), self.face_masks(stage, sides)
        beside = entries((len(e), centres.shape[0]), (sides.edge, sides.face, 1 / 4))
        return entries((len(e), stage.n_vertices), (e[:, None], stage.edges, 1 / 4)) + beside @ centres

    def smooth_vertices(self, stage: Stage, sides: Sides) -> Matrix:
        centres, k, n = self.face_masks(stage, sides), _valence(stage, sides), stage.n_vertices
        v = np.arange(n)
        around = entries((n, centres.shape[0]), (sides.start, sides.face, 1.0)) @ centres
        neighbours = entries((n, n), (sides.start, sides.end, 1.0))
        return entries((n, n), (v, v, 1 - 2 / k)) + scaled(1 / k**2, neighbours + around)

    def smooth_limit(self, stage: Stage, sides: Sides) -> Matrix:
        # Of the level after this one, where all faces are quads: (k v + 4 sum e + sum f) / (k (k + 5)). With the edge
        # points e = (v + neighbour + f + f')/4 the rows of one level give those of the mesh itself, whatever its faces.
        k, n = _valence(stage, sides), stage.n_vertices
        centres, edges, vertices = (
            rule(stage, sides) for rule in (self.face_masks, self.smooth_edges, self.smooth_vertices)
        )
        to_faces = entries((n, centres.shape[0]), (sides.start, sides.face, 1.0))
        to_edges = entries((n, edges.shape[0]), (sides.start, sides.edge, 4.0))
        return scaled(1 / (k * (k + 5)), scaled(k**2, vertices) + to_edges @ edges + to_faces @ centres)

    def limit_tangents(self, stage: Stage, sides: Sides, position: np.ndarray) -> tuple[Matrix, Matrix]:
        # Of the quads that the next level has, for the reason given above.
        centres, edges, vertices = (
            rule(stage, sides) for rule in (self.face_masks, self.edge_masks, self.vertex_masks)
        )
        n, k = stage.n_vertices, _valence(stage, sides)
        edge = border(stage, sides).next[sides.start] >= 0
        theta = np.where(edge, np.pi, 2 * np.pi) / k[sides.start]
        here, ahead = position * theta, (position + 1) * theta
        c = np.cos(theta)
        eigenvalue = 5 / 16 + (c + np.cos(theta / 2) * np.sqrt(2 * (9 + c))) / 16
        of_face = np.where(edge, 1.0, 1 / (4 * eigenvalue - 1))
        outer = sides.twin < 0  # the boundary edge that leaves a vertex; the one that comes in is this side's other end
        v = np.arange(n)
        cosine, sine = np.where(edge, 0.0, 1.0) * np.cos(here), np.sin(here)
        pairs = []
        for wave, next_wave, along in ((cosine, np.where(edge, 0.0, np.cos(ahead)), 1.0), (sine, np.sin(ahead), None)):
            r = 1 / np.tan(np.pi / (2 * k))
            at_border = np.where(k == 1, 3.0, -r * (1 + 2 * np.cos(np.pi / k)))
            edge_terms = [(sides.start, sides.edge, 4 * wave)]
            if along is not None:
                edge_terms += [
                    (sides.start[outer], sides.edge[outer], along),
                    (sides.end[outer], sides.edge[outer], -along),
                ]
                of_vertex = np.zeros(n)
            else:
                edge_terms += [
                    (sides.start[outer], sides.edge[outer], at_border[sides.start[outer]]),
                    (sides.end[outer], sides.edge[outer], at_border[sides.end[outer]]),
                ]
                of_vertex = np.where(k == 1, -6.0, 4 * r * (np.cos(np.pi / k) - 1))
                of_vertex[np.setdiff1d(v, sides.start[outer])] = 0
            pairs.append(
                entries((n, edges.shape[0]), *edge_terms) @ edges
                + entries((n, centres.shape[0]), (sides.start, sides.face, of_face * (wave + next_wave))) @ centres
                + entries((n, n), (v, v, of_vertex)) @ vertices
            )
        return pairs[0], pairs[1]


def _valence(stage: Stage, sides: Sides) -> Float[np.ndarray, "v"]:
    """Number of faces of every vertex, at least 1."""
    return np.maximum(np.bincount(sides.start, minlength=stage.n_vertices), 1).astype(float)
