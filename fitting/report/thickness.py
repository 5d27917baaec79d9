"""How thick is what lies between two layers, at every vertex, with standard deviations from the posterior."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js

from ..scan.layers import find_opposite, take_part
from .posterior import Posterior

_DRAWS, _DRAWS_AT_ONCE = 512, 64  # a standard deviation of so many is right to 3 %


class Gap(NamedTuple):
    """Where thickness is measured from one layer to another, as one surface has it."""

    vertices: Int[np.ndarray, "w"]
    """Of the surface, on the one layer; none on the other, nor where that ends."""
    corners: Int[np.ndarray, "w 4"]
    corner_weights: Float[np.ndarray, "w 4"]
    """Of the place on the other layer that is closest to each."""
    faces: Int[np.ndarray, "w"]
    """Of the surface, where that place lies."""
    directions: Float[np.ndarray, "w 3"]
    """Unit normals of the other layer, all turned towards it from the one."""
    shares: Float[np.ndarray, "w"]
    """Of the one layer's area there."""


class Thickness(NamedTuple):
    """How thick what lies between two layers is, at every vertex of the surface.

    Attributes:
        layer, other: from which layer it is measured, and to which.
        values: distance across the other layer to its closest place in mm; negative where it lies on the wrong side.
            NaN at vertices of other layers, and where the other layer ends.
        deviations: standard deviations in mm; NaN likewise. Posterior to scan and priors, to first order, from 512
            random draws, with the misfit of the control mesh on both layers (see `Uncertainty.misfit`).
        shares: of the area over which the thickness is known; 0 elsewhere.
    """

    layer: str
    other: str
    values: Float[np.ndarray, "v"]
    deviations: Float[np.ndarray, "v"]
    shares: Float[np.ndarray, "v"]

    @property
    def mean(self) -> float:
        """Over the area, in mm."""
        known = self.shares > 0
        return float(self.shares[known] @ self.values[known])


def find_gap(surface: js.RefinedSurface, layer: Bool[np.ndarray, "f"], other: Bool[np.ndarray, "f"]) -> Gap:
    """The closest places of one layer to the vertices of another.

    Args:
        surface: of all layers.
        layer, other: the faces of each, triangles first.
    """
    vertices, to = np.asarray(surface.vertices, np.float64), find_opposite(surface, layer, other)
    directions = np.asarray(js.evaluate(surface, to.at).normals, np.float64)
    away = np.sum(to.weights[..., None] * vertices[to.corners], axis=1) - vertices[to.vertices]
    directions = np.where(np.sum(directions * away) < 0, -1.0, 1.0) * directions
    areas = np.asarray(take_part(surface, layer).vertex_areas(), np.float64)[to.vertices]
    shares = areas / max(areas.sum(), np.finfo(float).tiny)
    return Gap(to.vertices, to.corners, to.weights.astype(np.float64), np.asarray(to.at.face), directions, shares)


def measure_thickness(
    posterior: Posterior, names: tuple[str, str], layer: Bool[np.ndarray, "f"], other: Bool[np.ndarray, "f"]
) -> Thickness:
    """The thickness between two layers of a fit.

    Args:
        posterior: of the fit.
        names: of the layers.
        layer, other: the faces of each on the refined surface, triangles first.
    """
    surface = posterior.fit.surface()
    vertices, gap = np.asarray(surface.vertices, np.float64), find_gap(surface, layer, other)
    n = len(vertices)
    values, deviations, shares = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n)
    beyond = np.sum(gap.corner_weights[..., None] * vertices[gap.corners], axis=1)
    values[gap.vertices] = np.sum(gap.directions * (beyond - vertices[gap.vertices]), axis=1)
    structure = posterior.equations.structure
    there = gap.corners, gap.corner_weights, gap.directions, structure.patches.owner[gap.faces]
    ones, of_own = np.ones((len(gap.vertices), 1)), structure.faces_of_vertices(n)[gap.vertices]
    slopes = posterior.find_slopes(*there) - posterior.find_slopes(gap.vertices[:, None], ones, gap.directions, of_own)
    total = np.zeros(len(gap.vertices))
    for seed in range(_DRAWS // _DRAWS_AT_ONCE):
        total += np.sum((slopes @ posterior.draws(_DRAWS_AT_ONCE, seed)) ** 2, axis=1)
    misfit = posterior.uncertainty().misfit ** 2
    of_both = misfit[gap.vertices] + np.sum(gap.corner_weights * misfit[gap.corners], axis=1)
    deviations[gap.vertices] = np.sqrt(total / _DRAWS + of_both)
    shares[gap.vertices] = gap.shares
    return Thickness(*names, values, deviations, shares)
