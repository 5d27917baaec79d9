"""Contours in slices: how they were drawn, and how far they lie apart."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from .closest_points import nearest_rows
from .scan import Scan


class Strokes(NamedTuple):
    """The contours of a scan in slices, which a person drew with a few strokes: neighbours share their errors."""

    nearest: Int[Array | np.ndarray, "p"]
    """The row of the nearest point of the same slice."""
    most: Float[Array | np.ndarray, ""]
    """Points of a contour in a row, as many as make up the distance between slices."""

    def count_points_a_measurement(self, distances: Float[Array, "p"], weights: Float[Array, "p"]) -> Float[Array, ""]:
        """How many points of a contour tell as much as one measurement; 1 where their distances are independent.

        With the correlation r of the distances of neighbours, (1 + r) / (1 - r) points count as one: so it is with the
        variance of a mean (first-order autoregression). Where the surface is off they are correlated too: no more count
        as one than make up the distance between slices, so that the scan tells as much along as across.
        """
        both = jnp.sqrt(weights * weights[self.nearest])
        own, shared = jnp.sum(both * distances**2), jnp.sum(both * distances * distances[self.nearest])
        r = jnp.clip(shared / jnp.maximum(own, jnp.finfo(own.dtype).tiny), 0, 1)
        most = jnp.asarray(self.most, r.dtype)
        return jnp.where(r < 1, jnp.minimum((1 + r) / jnp.where(r < 1, 1 - r, 1.0), most), most)


def contour_spacing(
    points: Float[np.ndarray, "p 3"], numbers: Int[np.ndarray, "p"]
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Of every point in two or more slices: the row of the nearest one of its own slice, how far that is (itself, where
    it is alone), and how far the nearest one of another slice is."""
    nearest, along, across = np.arange(len(points)), np.zeros(len(points)), np.zeros(len(points))
    for number in np.unique(numbers):
        here = np.flatnonzero(numbers == number)
        tree = KDTree(points[here])
        away, rows = nearest_rows(tree, points[here], min(2, len(here)))
        nearest[here], along[here] = here[rows[:, -1]], away[:, -1]
        across[here] = nearest_rows(KDTree(points[numbers != number]), points[here], 1)[0][:, 0]
    return nearest, along, across


def find_strokes(scan: Scan) -> Strokes | None:
    """The contours of a scan; None where it has fewer than two slices."""
    if scan.slices is None or len(np.unique(np.asarray(scan.slices))) < 2:
        return None
    nearest, along, across = contour_spacing(np.asarray(scan.points, np.float64), np.asarray(scan.slices))
    spacing = float(np.median(along))
    most = max(float(np.median(across)) / spacing, 1.0) if spacing > 0 else 1.0
    return Strokes(nearest, np.asarray(most))
