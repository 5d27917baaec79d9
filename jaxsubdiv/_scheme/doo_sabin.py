"""The scheme of Doo and Sabin, which cuts corners."""

from typing import ClassVar

import equinox as eqx
import numpy as np

from .._masks import Matrix, Term, as_masks, entries, stack
from .._normals import Weights
from .._stage import Stage, dual_split, ring_positions, sides_of
from .._topology import LimitMasks
from .base import AbstractLinearScheme


class DooSabin(AbstractLinearScheme):
    """Doo-Sabin subdivision: approximating, smooth (C1), dual. A level makes a face of every face, edge and vertex.

    Vertices of finer levels are new throughout. On a boundary the boundary vertices run through Chaikin's rule, so that
    the surface ends in the quadratic B-spline of its boundary. Faces of five or more corners, around extraordinary
    vertices, are put out as triangles.

    Source: D. Doo & M. Sabin, Behaviour of recursive division surfaces near extraordinary points, 1978, with their
    weights (k + 5)/(4 k) and (3 + 2 cos(2 pi j/k))/(4 k). Boundary: A. Nasri, Polyhedral subdivision methods for
    free-form surfaces, 1987.
    """

    h: None = eqx.field(init=False, default=None)
    weights: Weights = eqx.field(static=True, default="area", init=False)

    interpolates: ClassVar[bool] = False
    is_primal: ClassVar[bool] = False
    order: ClassVar[int] = 2

    def masks(self, stage: Stage) -> Matrix:
        """A vertex a corner of every face, in the order of the sides, then two a boundary edge."""
        sides, n = sides_of(stage), stage.n_vertices
        terms: list[Term] = []
        first = 0
        for k, faces in sorted(stage.faces.items()):
            corner = first + np.arange(faces.size).reshape(-1, k)
            first += faces.size
            for j in range(k):
                weight = (k + 5) / (4 * k) if j == 0 else (3 + 2 * np.cos(2 * np.pi * j / k)) / (4 * k)
                terms.append((corner, np.roll(faces, -j, axis=1), weight))
        a, b = stage.edges[stage.right < 0].T
        row = 2 * np.arange(len(a))
        along = [(row, a, 3 / 4), (row, b, 1 / 4), (row + 1, a, 1 / 4), (row + 1, b, 3 / 4)]
        return stack([entries((len(sides.start), n), *terms), entries((2 * len(a), n), *along)])

    def split(self, stage: Stage) -> Stage:
        return dual_split(stage)

    def limit(self, stage: Stage) -> LimitMasks:
        # The middle of a face stays where it is from level to level, and so lies on the limit surface: at a vertex the
        # middle of the face that the next level makes there. Its tangents are the first Fourier mode of that face.
        sides, n = sides_of(stage), stage.n_vertices
        corners = self.masks(stage)
        k = np.maximum(np.bincount(sides.start, minlength=n), 1)
        on_border = np.zeros(n, bool)
        on_border[stage.edges[stage.right < 0]] = True
        inside = ~on_border[sides.start]
        side, start = np.flatnonzero(inside), sides.start[inside]
        angle = 2 * np.pi * ring_positions(sides)[inside] / k[start]
        unused = np.flatnonzero(np.bincount(sides.start, minlength=n) == 0)
        points = entries((n, corners.shape[0]), (start, side, 1 / k[start])) @ corners + entries(
            (n, n), (unused, unused, 1.0)
        )
        # On the boundary the limit is the quadratic B-spline of the boundary: the middle of the two points beside.
        a, b = stage.edges[stage.right < 0].T
        n_ends = np.bincount(a, minlength=n)
        ends = entries((n, n), (a, a, 3 / 8), (a, b, 1 / 8), (b, b, 3 / 8), (b, a, 1 / 8))
        share = entries((n, n), (np.arange(n), np.arange(n), 1 / np.maximum(n_ends, 1)))
        waves = [
            entries((n, corners.shape[0]), (start, side, wave)) @ corners for wave in (np.cos(angle), np.sin(angle))
        ]
        return LimitMasks(as_masks(points + share @ ends), (as_masks(waves[0]), as_masks(waves[1])))
