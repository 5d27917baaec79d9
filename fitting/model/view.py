"""A scan as a fit looks at it: what of it stays the same while the surface moves."""

import numpy as np

import jaxsubdiv as js

from ..scan.closest_points import boundary_vertices
from ..scan.scan import Scan
from ..scan.slices import find_strokes
from .pairing import Look, look, surroundings
from .priors.boundary import BoundaryCurve, held_vertices
from .priors.shifts import Shifts
from .robust import AbstractLoss

LEAST_NOISE = 1e-4  # in control edges: a perfect scan would have none, and its points infinite weight


class View:
    """A scan, and how its points count."""

    def __init__(
        self,
        scan: Scan,
        surface: js.RefinedSurface,
        edge: float,
        loss: AbstractLoss,
        curve: BoundaryCurve | None = None,
    ):
        """
        Args:
            surface: any that has the faces of those to come.
            edge: length of a control edge in mm.
            loss: how a point loses weight with its distance.
            curve: that the surface ends at.
        """
        self._scan, self._edge, self._loss, self._curve = scan, edge, loss, curve
        self._open, self._around, self._strokes = boundary_vertices(surface), surroundings(scan), find_strokes(scan)

    @property
    def least_scale(self) -> float:
        """The least scale of the loss, in mm."""
        return LEAST_NOISE * self._edge

    def seen_from(self, surface: js.RefinedSurface, floor: float = 0.0, shifts: Shifts | None = None) -> Look:
        """Pairs and weights of the points, their slices shifted.

        Args:
            floor: the least scale of the loss in mm.
        """
        here = self._scan.without_slices() if shifts is None else shifts.put_on(self._scan)
        held = None if self._curve is None else held_vertices(self._curve, surface, self._edge)
        floor = max(floor, self.least_scale)
        seen = look(surface, here, self._open, self._around, self._edge, self._loss, floor, held)
        if self._strokes is None:
            return seen
        alike = self._strokes.points_a_measurement(np.asarray(seen.distances), np.asarray(seen.weights))
        return seen._replace(precisions=seen.precisions / alike)
