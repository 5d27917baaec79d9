"""Thickness: what lies between two layers changes little from a control vertex to the next."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import dot, take

from ...scan.layers import find_opposite
from ...scan.regions import RegionMatch
from ..unknowns import AnyArray
from .base import AbstractVertexPrior, Place, Start, backend
from .bend import start_place

_FIRST = 0.02  # of a control edge: standard deviation of a difference in the first sweep, where that is to be found


class _Held(NamedTuple):
    """Of every place, as one sweep holds it."""

    directions: Float[Array, "m 3"]
    """Normals of the other layer, where that is closest."""
    beyond: Float[Array, "m"]
    """Thickness in mm, less what the control vertices alone say of it."""


class ThicknessPrior(AbstractVertexPrior):
    """Places that neighbour each other along a layer are as far from the other layer, by little more or less.

    A place is a control vertex of one layer. Its thickness is the distance across the other layer's surface to the
    closest place of that. Each sweep looks for that place anew, and holds it. How a step changes the thickness follows
    from the vertex and from the corners of the control face that was closest where the fit started.

    Attributes:
        own: the control vertex of every place.
        corners, corner_weights: of the control face that was closest, and where in it.
        edges: places that are neighbours.
        of_edges: the control face of each.
        choice: the faces of the layer that each is measured to.
        deviation: standard deviation of a difference in mm, or None where it is found from the scan.
        edge: length of a control edge in mm.
    """

    name: ClassVar[str] = "thickness"
    own: Int[Array | np.ndarray, "m"]
    corners: Int[Array | np.ndarray, "m 4"]
    corner_weights: Float[Array | np.ndarray, "m 4"]
    edges: Int[Array | np.ndarray, "e 2"]
    of_edges: Int[np.ndarray, "e"]
    choice: js.FaceChoice
    deviation: Float[Array | np.ndarray, ""] | None
    edge: Float[Array | np.ndarray, ""]
    n_faces: int = eqx.field(static=True)

    @classmethod
    def make(cls, priors: Any, start: Start) -> "ThicknessPrior | None":
        layers: tuple[str, ...] = start.inputs.get("layers") or ()
        regions: RegionMatch | None = start.inputs.get("regions")
        left_out = priors.thickness is not None and not np.isfinite(priors.thickness)
        if len(layers) < 2 or regions is None or left_out:
            return None
        region = regions.faces.rows
        numbers = [regions.faces.names.index(name) for name in layers]
        mesh, owner = start_place(start).mesh, start.owner
        if len(owner) != mesh.n_faces:  # of a dual scheme, whose surface does not have the control vertices
            owner = np.arange(start.topology.n_control_faces)
        of_surface = np.stack([region[owner] == number for number in numbers])
        flat = js.RefinedSurface(start.control.vertices, start.control.normals, start.topology.control_faces)
        of_control = np.stack([region == number for number in numbers])
        ends, of_ends = js.control_edges(start.topology)
        found: list[tuple] = []
        next_ = [(k, k + 1) for k in range(len(layers) - 1)]
        for a, b in next_ + [(b, a) for a, b in next_]:
            to = find_opposite(flat, of_control[a], of_control[b])
            found.append((to.vertices, np.full(len(to.vertices), b), to.corners, to.weights))
        own, other, corners, weights = (np.concatenate(parts) for parts in zip(*found, strict=True))
        edges, of_edges = _neighbours(own, other, ends, of_ends)
        if not len(edges):
            return None
        choice = js.FaceChoice(other.astype(np.int32), of_surface)
        edge = np.asarray(js.edge_length(start.topology, start.control.vertices))
        of_places = own, corners, weights.astype(np.float64), edges, of_edges
        return cls(*of_places, choice, priors.thickness, edge, start.topology.n_control_faces)

    def strip_strengths(self) -> "ThicknessPrior":
        return dataclasses.replace(self, deviation=None)

    @property
    def n_strengths(self) -> int:
        return self.n_faces

    def first_strengths(self) -> Float[AnyArray, "f"]:
        xp = backend(self.deviation)
        usual = xp.asarray(_FIRST * self.edge if self.deviation is None else self.deviation)
        return xp.full(self.n_faces, usual**-2.0)

    def given_strengths(self) -> Float[AnyArray, "f"] | None:
        return None if self.deviation is None else self.first_strengths()

    def strength_rows(self) -> Int[AnyArray, "e"]:
        return self.of_edges

    def hold(self, place: Place, strengths: dict[str, Any]) -> _Held:
        mesh = place.mesh
        here = take(mesh.vertices, jnp.asarray(self.own))
        choice = js.FaceChoice(jnp.asarray(self.choice.of_points), jnp.asarray(self.choice.faces))
        on, directions = js.evaluate(mesh, js.search_closest(mesh, here, choice))
        return _Held(directions, dot(directions, on - here)[:, 0] - self._between(place, directions))

    def thickness(self, place: Place, held: _Held) -> Float[Array, "m"]:
        """Of every place, in mm, with the sign of the direction held."""
        return self._between(place, held.directions) + held.beyond

    def rows(self, place: Place, held: _Held) -> Float[Array, "e"]:
        """Differences between neighbours, in mm."""
        thickness = self.thickness(place, held)
        return thickness[self.edges[:, 0]] - thickness[self.edges[:, 1]]

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return strengths[self.name][self.of_edges]

    def vertices(self) -> Int[AnyArray, "e 10"]:
        a, b = np.asarray(self.edges).T
        own, corners = np.asarray(self.own), np.asarray(self.corners)
        every = np.sort(np.concatenate([own[a][:, None], own[b][:, None], corners[a], corners[b]], axis=1), axis=1)
        again = np.pad(every[:, 1:] == every[:, :-1], ((0, 0), (1, 0)))
        return np.where(again, -1, every)  # each once

    def _between(self, place: Place, directions: Float[Array, "m 3"]) -> Float[Array, "m"]:
        """What the control vertices say: from each to the held place of its control face, along the direction."""
        vertices = place.control.vertices
        weights = jnp.asarray(self.corner_weights, vertices.dtype)
        there = js.sum_corners(vertices, jnp.asarray(self.corners), weights)
        return dot(directions, there - take(vertices, jnp.asarray(self.own)))[:, 0]


def _neighbours(
    own: Int[np.ndarray, "m"], other: Int[np.ndarray, "m"], ends: Int[np.ndarray, "s 2"], of_ends: Int[np.ndarray, "s"]
) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "e"]]:
    """Places that an edge of the control mesh joins, measured to the same layer, and the control face of each edge."""
    edges, faces = [], []
    for layer in np.unique(other):
        place = np.full(max(ends.max(initial=0), own.max(initial=0)) + 1, -1)
        rows = np.flatnonzero(other == layer)
        place[own[rows]] = rows
        both = place[ends]
        joined = (both >= 0).all(axis=1)
        edges.append(both[joined])
        faces.append(of_ends[joined])
    return np.concatenate([np.zeros((0, 2), int), *edges]), np.concatenate([np.zeros(0, int), *faces])
