"""The scheme of Catmull and Clark for any faces."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._masks import Matrix, entries, scale_rows
from .._stage import Sides, Stage, quad_split
from .creased import AbstractCreasedScheme, Edge, border, border_tangent_weights


class CatmullClark(AbstractCreasedScheme):
    """Catmull-Clark subdivision: approximating, smooth (C2, and C1 at extraordinary vertices); all quads after a level.

    Args:
        boundary: "edge-and-corner" keeps vertices of a single face where they are, "edge-only" rounds them off. Either
            way a boundary is the cubic B-spline of its own vertices.

    Peers: OpenSubdiv agrees to rounding, creases and limit positions included. Its limit normals at boundary vertices
    of other than two quads are those of other rules, off by up to 0.01 in the tests; ours are of the rules themselves.

    Raises:
        ValueError: `boundary` is not one of these.

    Source: E. Catmull & J. Clark, Recursively generated B-spline surfaces on arbitrary topological meshes, 1978. Limit
    masks: Halstead, Kass & DeRose 1993. Creases as in OpenSubdiv.
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
        return entries((n, n), (v, v, 1 - 2 / k)) + scale_rows(1 / k**2, neighbours + around)

    def smooth_limit(self, stage: Stage, sides: Sides) -> Matrix:
        # Of the level after this one, where all faces are quads: (k v + 4 sum e + sum f) / (k (k + 5)). With the edge
        # points e = (v + neighbour + f + f')/4 the rows of one level give those of the mesh itself, whatever its faces.
        k, n = _valence(stage, sides), stage.n_vertices
        centres, edges, vertices = (
            rule(stage, sides) for rule in (self.face_masks, self.smooth_edges, self.smooth_vertices)
        )
        to_faces = entries((n, centres.shape[0]), (sides.start, sides.face, 1.0))
        to_edges = entries((n, edges.shape[0]), (sides.start, sides.edge, 4.0))
        return scale_rows(1 / (k * (k + 5)), scale_rows(k**2, vertices) + to_edges @ edges + to_faces @ centres)

    def limit_tangents(self, stage: Stage, sides: Sides, position: Int[np.ndarray, "s"]) -> tuple[Matrix, Matrix]:
        # Of the quads that the next level has, for the reason given above. A vertex at the end of a single sharp edge
        # is taken for smooth, as in OpenSubdiv.
        smooth = stage._replace(edge_sharpness=None, vertex_sharpness=None)
        centres, edges, vertices = (
            rule(smooth, sides) for rule in (self.face_masks, self.edge_masks, self.vertex_masks)
        )
        n, v, k = stage.n_vertices, np.arange(stage.n_vertices), _valence(stage, sides)
        after = border(stage, sides).next
        on_border, outer = after[sides.start] >= 0, sides.twin < 0
        # Inside: the first Fourier mode of the ring. On a boundary: along it, and across it.
        theta = np.where(after >= 0, np.pi, 2 * np.pi) / k
        c, total = np.cos(theta), 1 / np.tan(theta / 2)  # the sum of sin(i theta), i = 1 to k - 1
        eigenvalue = 5 / 16 + (c + np.cos(theta / 2) * np.sqrt(2 * (9 + c))) / 16
        eigenvalue = np.where(k == 1, 1 / 2, eigenvalue)  # of no meaning there: a single face has no inner edges
        face = np.where(k == 1, 0.0, 1 / (16 * eigenvalue - 4))
        itself, neighbour = border_tangent_weights(
            k, eigenvalue, (1 / 16 + face / 4) * np.sin(theta), (3 / 8 + face / 2) * total
        )
        here, ahead = position * theta[sides.start], (position + 1) * theta[sides.start]
        start, end, edge = sides.start[outer], sides.end[outer], sides.edge[outer]
        tangents = []
        for wave, next_wave, of_vertex, of_start, of_end in (
            (np.where(on_border, 0.0, np.cos(here)), np.where(on_border, 0.0, np.cos(ahead)), 0.0, 1.0, -1.0),
            (np.sin(here), np.sin(ahead), np.where(after < 0, 0.0, itself), neighbour[start], neighbour[end]),
        ):
            of_edges = [(sides.start, sides.edge, wave), (start, edge, of_start), (end, edge, of_end)]
            of_faces = (sides.start, sides.face, face[sides.start] * (wave + next_wave))
            tangents.append(
                entries((n, edges.shape[0]), *of_edges) @ edges
                + entries((n, centres.shape[0]), of_faces) @ centres
                + entries((n, n), (v, v, of_vertex)) @ vertices
            )
        return tangents[0], tangents[1]


def _valence(stage: Stage, sides: Sides) -> Float[np.ndarray, "v"]:
    """Number of faces of every vertex, at least 1."""
    return np.maximum(np.bincount(sides.start, minlength=stage.n_vertices), 1).astype(float)
