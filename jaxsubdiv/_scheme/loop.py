"""Loop's scheme for triangles."""

from typing import ClassVar, Literal, TypeAlias, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._masks import Matrix, entries
from .._stage import Sides, Stage
from .base import check_option
from .creased import AbstractCreasedScheme, Edge, border, border_tangent_weights

Variant: TypeAlias = Literal["loop", "warren"]


class Loop(AbstractCreasedScheme):
    """Loop subdivision of triangles: approximating, smooth (C2, and C1 at extraordinary vertices).

    Args:
        variant: "loop", the weights of 1987, beta = (5/8 - (3/8 + cos(2 pi/k)/4)^2)/k; or "warren", beta = 3/(8 k), and
            3/16 for k = 3: cheaper and less round.
        boundary: "edge-and-corner" keeps vertices of a single face where they are, "edge-only" rounds them off. Either
            way a boundary is the cubic B-spline of its own vertices.

    Peers: OpenSubdiv, VTK (1987, "edge-only") and libigl (Warren, "edge-only") agree to rounding, open meshes included;
    trimesh (1987) on closed meshes, while on open ones it moves some boundary vertices off their boundary, by up to
    half an edge. OpenSubdiv's limit normals at boundary vertices of other than three triangles are of other rules.

    Raises:
        ValueError: an option is not one of these.

    Source: C. Loop, Smooth subdivision surfaces based on triangles, 1987; J. Warren, Subdivision methods for geometric
    design, 1995. Creases as in OpenSubdiv, which has the weights of 1987.
    """

    variant: Variant = eqx.field(static=True, default="loop")
    boundary: Edge = eqx.field(static=True, default="edge-and-corner")

    takes: ClassVar[tuple[int, ...]] = (3,)
    order: ClassVar[int] = 2

    def __check_init__(self) -> None:
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

    def limit_tangents(self, stage: Stage, sides: Sides, position: Int[np.ndarray, "s"]) -> tuple[Matrix, Matrix]:
        n, v = stage.n_vertices, np.arange(stage.n_vertices)
        k = np.maximum(np.bincount(sides.start, minlength=n), 1).astype(float)
        after, before = border(stage, sides)
        on_border = after[sides.start] >= 0
        # Inside: the first Fourier mode of the ring. On a boundary: along it, and across it.
        angle = np.where(on_border, np.pi, 2 * np.pi) * position / k[sides.start]
        theta = np.pi / k
        total = 1 / np.tan(theta / 2)  # of sin(i theta), i = 1 to k - 1
        itself, neighbour = border_tangent_weights(k, 3 / 8 + np.cos(theta) / 4, np.sin(theta) / 8, 3 / 8 * total)
        along = entries(
            (n, n),
            (sides.start, sides.end, np.where(on_border, 0.0, np.cos(angle))),
            (v, after, 1.0),
            (v, before, -1.0),
        )
        across = entries(
            (n, n),
            (sides.start, sides.end, np.sin(angle)),
            (v, after, neighbour),
            (v, before, neighbour),
            (v, v, np.where(after < 0, 0.0, itself)),
        )
        return along, across
