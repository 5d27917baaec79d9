"""Loop's scheme for triangles."""

from typing import ClassVar, Literal, TypeAlias, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float

from .._masks import Matrix, entries
from .._stage import Sides, Stage
from .base import check_option
from .creased import AbstractCreasedScheme, Edge, border

Variant: TypeAlias = Literal["loop", "warren"]


class Loop(AbstractCreasedScheme):
    """Loop subdivision of triangles: approximating, smooth (C2, and C1 at extraordinary vertices).

    Args:
        variant: "loop", the weights of 1987, beta = (5/8 - (3/8 + cos(2 pi/k)/4)^2)/k; or "warren", beta = 3/(8 k), and
            3/16 for k = 3: cheaper and less round.
        boundary: "edge-and-corner" keeps vertices of a single face where they are, "edge-only" rounds them off. Either
            way a boundary is the cubic B-spline of its own vertices.

    Raises:
        ValueError: an option is not one of these.

    Source: C. Loop, Smooth subdivision surfaces based on triangles, 1987; J. Warren, Subdivision methods for geometric
    design, 1995. Creases as in OpenSubdiv, which has the weights of 1987; limit tangents: Biermann, Levin & Zorin 2000.
    """

    variant: Variant = eqx.field(static=True, default="loop")
    boundary: Edge = eqx.field(static=True, default="edge-and-corner")

    takes: ClassVar[tuple[int, ...]] = (3,)
    order: ClassVar[int] = 2

    def __check_init__(self):
        check_option("variant", self.variant, get_args(Variant))

    def _beta(self, stage: Stage, sides: Sides) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
        """Weight of every neighbour of a vertex, and the number of neighbours."""
        k = np.maximum(np.bincount(sides.start, minlength=stage.n_vertices), 1).astype(float)
        if self.variant == "warren":
            return np.where(k == 3, 3 / 16, 3 / (8 * k)), k
        return (5 / 8 - (3 / 8 + np.cos(2 * np.pi / k) / 4) ** 2) / k, k

    def smooth_vertices(self, stage: Stage, sides: Sides) -> Matrix:
        beta, k = self._beta(stage, sides)
        v = np.arange(len(k))
        return entries((len(k), len(k)), (v, v, 1 - k * beta), (sides.start, sides.end, beta[sides.start]))

    def smooth_edges(self, stage: Stage, sides: Sides) -> Matrix:
        e = np.arange(len(stage.edges))
        opposite = sides.start[sides.before]
        return entries((len(e), stage.n_vertices), (e[:, None], stage.edges, 3 / 8), (sides.edge, opposite, 1 / 8))

    def smooth_limit(self, stage: Stage, sides: Sides) -> Matrix:
        beta, k = self._beta(stage, sides)
        share = 1 / (k + 3 / (8 * beta))
        v = np.arange(len(k))
        return entries((len(k), len(k)), (v, v, 1 - k * share), (sides.start, sides.end, share[sides.start]))

    def limit_tangents(self, stage: Stage, sides: Sides, position: np.ndarray) -> tuple[Matrix, Matrix]:
        n = stage.n_vertices
        k = np.bincount(sides.start, minlength=n)[sides.start]
        after, before = border(stage, sides)
        edge = after[sides.start] >= 0
        angle = np.where(edge, np.pi * position / k, 2 * np.pi * position / k)
        v = np.arange(n)
        n_faces = np.maximum(np.bincount(sides.start, minlength=n), 1)
        theta = np.pi / n_faces
        # Inside: the first Fourier mode of the ring. On a boundary: along it, and across it.
        first = entries(
            (n, n), (sides.start, sides.end, np.where(edge, 0.0, np.cos(angle))), (v, after, 1.0), (v, before, -1.0)
        )
        inner = edge & (position > 0)
        across = np.where(inner, 2 * (1 - np.cos(theta[sides.start])) * np.sin(angle), 0.0)
        few = n_faces[sides.start] <= 2  # two triangles or one: the formula leaves the vertex itself out
        across = np.where(few, 1.0 * inner, across)
        at_end = np.where(n_faces == 1, 1.0, np.where(n_faces == 2, 0.0, -np.sin(theta)))
        itself = np.where(after < 0, 0.0, np.where(n_faces == 1, -2.0, np.where(n_faces == 2, -1.0, 0.0)))
        second = entries(
            (n, n),
            (sides.start, sides.end, np.where(edge, across, np.sin(angle))),
            (v, after, at_end),
            (v, before, at_end),
            (v, v, itself),
        )
        return first, second
