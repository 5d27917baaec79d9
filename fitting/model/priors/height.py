"""Curvature: edges rise over the tangent planes at their ends as the template's do."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import take

from .base import AbstractFacePrior, Place, Start, backend
from .bend import compared_edges, expects_likeness, first_strengths, growth, project_edges, start_place


class Height(AbstractFacePrior):
    """The height of edges is that of the template, as closely as the scan shows, place by place.

    Attributes:
        edges: ends of the edges whose heights are expected.
        of_rows: the control face of each.
        template: their heights where the fit starts, in mm.
    """

    name: ClassVar[str] = "height"
    edges: Int[Array | np.ndarray, "g 2"]
    of_rows: Int[np.ndarray, "g"]
    template: Float[Array | np.ndarray, "g"]
    n_faces: int = eqx.field(static=True)

    @classmethod
    def make(cls, priors: Any, start: Start) -> "Height | None":
        edges, faces = compared_edges(start)
        # Where the strength of bends is given, nothing says how closely heights should be kept.
        rows = np.flatnonzero(expects_likeness(priors, start, faces) & (priors.bend is None))
        if not len(rows):
            return None
        edges = jnp.asarray(edges)[rows]
        heights = np.asarray(bend_height(start_place(start).mesh, edges), np.float64)
        return cls(edges, faces[rows], heights, start.topology.n_control_faces)

    @property
    def n_strengths(self) -> int:
        return self.n_faces

    def first_strengths(self) -> Float[Array | np.ndarray, "f"]:
        xp = backend(self.template)
        return first_strengths(xp.asarray(xp.mean(self.template**2)), self.n_faces)

    def strength_rows(self) -> Int[np.ndarray, "g"]:
        return self.of_rows

    def hold(self, place: Place, strengths: dict[str, Any]) -> Float[Array, "g"]:
        """What is expected, at the size that the mesh has here."""
        return growth(place) * jnp.asarray(self.template, place.edge.dtype)

    def rows(self, place: Place, held: Float[Array, "g"]) -> Float[Array, "g"]:
        return bend_height(place.mesh, self.edges) - held

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return strengths[self.name][self.of_rows]

    def faces(self, held: Any) -> Int[np.ndarray, "g"]:
        return self.of_rows


def bend_height(surface: js.RefinedSurface, edges: Int[Array | np.ndarray, "g 2"]) -> Float[Array, "g"]:
    """How high the ends of an edge lie over the tangent planes of each other, in mm, on average; below is negative.

    (n_a - n_b) . (x_b - x_a) / 2: half the curvature along the edge, times its length squared.
    """
    a, b = jnp.asarray(edges).T
    return 0.5 * project_edges(surface, a, b, take(surface.normals, a) - take(surface.normals, b))
