"""Landmarks: places of the surface lie where the scan has them."""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js

from ...scan.closest_points import closest_points
from ...scan.landmarks import Landmarks, place_landmarks
from ..unknowns import AnyArray
from .base import AbstractFacePrior, Place, Start


class LandmarkPrior(AbstractFacePrior):
    """Places of the surface, found on the control mesh where the fit starts, and where the scan has them.

    Attributes:
        points: on the scan, in mm.
        face: the face of the surface of each.
        corners, corner_weights: the vertices of the surface around each, and their weights.
        deviations: standard deviations in mm.
        of_landmarks: the control face of each.
    """

    name: ClassVar[str] = "landmark"
    points: Float[Array, "l 3"]
    face: Int[Array | np.ndarray, "l"]
    corners: Int[Array, "l 4"]
    corner_weights: Float[Array, "l 4"]
    deviations: Float[Array, "l"]
    of_landmarks: Int[np.ndarray, "l"]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "LandmarkPrior | None":
        anchors: Anchors | None = start.inputs.get("landmarks")
        if anchors is None:
            return None
        return cls(*anchors, start.owner[np.asarray(anchors.face)])

    def rows(self, place: Place, held: None) -> Float[Array, "m"]:
        """Three a landmark, over its standard deviation."""
        assert place.surface is not None
        on = js.sum_corners(place.surface.vertices, self.corners, self.corner_weights)
        return ((on - self.points) / self.deviations[:, None]).reshape(-1)

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return 1.0

    def faces(self, held: Any) -> Int[AnyArray, "m"]:
        return np.repeat(self.of_landmarks, 3)


class Anchors(NamedTuple):
    """Landmarks with their places on the surface, as saved fits keep them."""

    points: Float[Array, "l 3"]
    face: Int[Array | np.ndarray, "l"]
    corners: Int[Array, "l 4"]
    corner_weights: Float[Array, "l 4"]
    deviations: Float[Array, "l"]


def anchor_landmarks(
    landmarks: Landmarks, deviation: float, topology: js.Topology, control: js.Control, surface: js.RefinedSurface
) -> Anchors:
    """Landmarks at the places of the surface that are closest to theirs on the control mesh."""
    placed = place_landmarks(landmarks, js.ControlMesh(control.vertices, topology.control_faces, check=False))
    counted = placed.weights > 0
    at = closest_points(surface, placed.mesh[counted])
    corners, weights = js.corner_weights(surface, at)
    dtype = control.vertices.dtype
    points = jnp.asarray(placed.scan[counted], dtype)
    deviations = jnp.asarray(deviation / np.sqrt(placed.weights[counted]), dtype)
    return Anchors(points, at.face, corners, weights, deviations)
