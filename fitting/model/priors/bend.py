"""Smoothness: edges bend at both ends alike, or as unevenly as the template's do."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import dot, take

from ..procrustes import align_shape, size_ratio
from ..unknowns import AnyArray
from .base import AbstractFacePrior, Place, Start, backend

_STIFFER = 10.0  # the strength in the first sweep, over that of the template's own bends


class Bend(AbstractFacePrior):
    """The bend asymmetry of edges is small, or as large as that of the template times its likeness.

    Attributes:
        edges: ends of the edges that are compared.
        of_rows: the control face of each.
        template: their bend asymmetry where the fit starts, in mm; 0 where nothing is expected.
        given: standard deviation in mm, or None where it is found from the scan, a strength for each control face.
    """

    name: ClassVar[str] = "bend"
    edges: Int[Array | np.ndarray, "b 2"]
    of_rows: Int[np.ndarray, "b"]
    template: Float[Array | np.ndarray, "b"]
    given: Float[Array | np.ndarray, ""] | None
    likeness: Float[Array | np.ndarray, ""] | None
    """How much of the template's asymmetry is expected, or None where that is found from the scan too."""
    usual: Float[Array | np.ndarray, ""]
    """Mean square of the template's asymmetry, in mm^2."""
    n_faces: int = eqx.field(static=True)

    @classmethod
    def make(cls, priors: Any, start: Start) -> "Bend":
        edges, faces = compared_edges(start)
        bends = np.asarray(bend_asymmetry(start_place(start).mesh, edges), np.float64)
        expected = np.where(expects_likeness(priors, start, faces), bends, 0.0)
        likeness = np.zeros(()) if priors.likeness is None and priors.bend is not None else priors.likeness
        usual, n_faces = np.mean(bends**2), start.topology.n_control_faces
        return cls(edges, faces, expected, priors.bend, likeness, np.asarray(usual), n_faces)

    def strip_strengths(self) -> "Bend":
        nothing = np.zeros(())
        return dataclasses.replace(self, given=nothing, likeness=nothing, usual=nothing)

    @property
    def n_strengths(self) -> int:
        return self.n_faces

    def first_strengths(self) -> Float[AnyArray, "f"]:
        return first_strengths(self.usual, self.n_faces)

    def given_strengths(self) -> Float[AnyArray, "f"] | None:
        if self.given is None:
            return None
        xp = backend(self.given)
        return xp.full(self.n_faces, xp.asarray(self.given) ** -2.0)

    @property
    def finds_likeness(self) -> bool:
        """Whether the likeness is found from the scan."""
        return self.likeness is None

    def strength_rows(self) -> Int[AnyArray, "b"]:
        return self.of_rows

    def hold(self, place: Place, strengths: dict[str, Any]) -> Float[Array, "b"]:
        """What is expected, at the size that the mesh has here."""
        by = growth(place) * jnp.asarray(strengths["likeness"], place.edge.dtype)
        return by * jnp.asarray(self.template, place.edge.dtype)

    def rows(self, place: Place, held: Float[Array, "b"]) -> Float[Array, "b"]:
        return bend_asymmetry(place.mesh, self.edges) - held

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return strengths[self.name][self.of_rows]

    def faces(self, held: Any) -> Int[AnyArray, "b"]:
        return self.of_rows


def first_strengths(usual: Float[Array | np.ndarray, ""], n_faces: int) -> Float[AnyArray, "f"]:
    """Stiffer than the template is; `usual` is the mean square of its rows."""
    xp = backend(usual)
    least = np.finfo(np.float64 if xp is np else usual.dtype).tiny
    return xp.full(n_faces, 1 / xp.maximum(usual / _STIFFER, least))


def bend_asymmetry(surface: js.RefinedSurface, edges: Int[Array | np.ndarray, "b 2"]) -> Float[Array, "b"]:
    """By how much the surface bends more at one end of an edge than at the other, in mm, edge by edge.

    It is half of the height of each end over the tangent plane at the other, one less the other:
    (n_a + n_b) . (x_b - x_a) / 2. It vanishes on spheres, on cylinders and for every circular arc, so that it smooths
    without shrinking; and it ties normals to the geometry, for a normal that leans bends its edges unevenly.
    """
    a, b = jnp.asarray(edges).T
    return 0.5 * project_edges(surface, a, b, take(surface.normals, a) + take(surface.normals, b))


def project_edges(
    surface: js.RefinedSurface, a: Int[Array, "b"], b: Int[Array, "b"], vectors: Float[Array, "b 3"]
) -> Float[Array, "b"]:
    """The edges from `a` to `b` along vectors."""
    return dot(vectors, take(surface.vertices, b) - take(surface.vertices, a))[:, 0]


def compared_edges(start: Start) -> tuple[Int[Array | np.ndarray, "b 2"], Int[np.ndarray, "b"]]:
    """The edges whose bends are compared, and the control face of each: those of the first level, or the control edges
    where there is one level alone."""
    edges, faces = js.control_edges(start.topology)
    if len(start.topology.levels) == 1 or not js.splits_in_four(start.scheme, start.topology):
        return edges, faces
    return start.topology.levels[1].edges, js.child_edge_faces(start.topology)


def expects_likeness(priors: Any, start: Start, faces: Int[np.ndarray, "b"]) -> AnyArray:
    """Which rows are expected to be as the template has them, by the control face of each."""
    alike = start.inputs.get("alike")
    there = np.ones(len(faces), bool) if alike is None else np.asarray(alike)[faces]
    return there & (priors.bend is None if priors.likeness is None else bool(priors.likeness > 0))


def start_place(start: Start) -> Place:
    """The place where a fit starts."""
    control = start.control
    edge = js.edge_length(start.topology, control.vertices)
    return Place(start.scheme, start.topology, control, {}, start.surface, control.vertices, edge)


def growth(place: Place) -> Float[Array, ""]:
    """How many times as large as the template the mesh is here."""
    return size_ratio(place.template, align_shape(place.template, place.control.vertices, jnp), jnp)
