"""Shifts of slices: a scan of contours in slices, each of which breathing displaced within its plane."""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...scan.scan import Scan
from ..unknowns import AnyArray, Shared
from .base import AbstractVertexPrior, Place, Start

_FEWEST = 10  # points of a slice that may move
_STRAIGHT = 0.1  # of its length: the least width of a slice that has a plane
_THICK = 0.3  # of its width: the most thickness
_FARTHEST = 1e3  # mm: standard deviation of a shift without a prior, so that a slice without weight has an equation


class SlicePlanes(NamedTuple):
    """The slices of a scan that may be shifted, and the plane of each."""

    numbers: Int[np.ndarray, "s"]
    """As `Scan.slices` has them."""
    planes: Float[np.ndarray, "s 2 3"]
    """Two unit vectors in the plane of each, at right angles."""

    def rows_of(self, scan: Scan) -> Int[np.ndarray, "p"]:
        """The row of the slice of each point of a scan; -1 where that stays."""
        row = {number: i for i, number in enumerate(self.numbers.tolist())}
        return np.array([row.get(number, -1) for number in np.asarray(scan.slices).tolist()], np.int32)


class ShiftPrior(AbstractVertexPrior):
    """Every slice is shifted within its plane, by not much more than breathing does.

    A common motion of all vertices goes along in each step: what damps the vertices damps them about that motion. All
    slices together may be shifted with the surface, and nothing but this prior may say by how much.

    Attributes:
        numbers: of the slices that may be shifted.
        planes: two unit vectors in the plane of each.
        deviation: standard deviation of a shift along each, in mm.
    """

    name: ClassVar[str] = "shift"
    uses: ClassVar[tuple[str, ...]] = ("shifts",)
    numbers: Int[Array | np.ndarray, "s"]
    planes: Float[Array | np.ndarray, "s 2 3"]
    deviation: Float[Array | np.ndarray, ""]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "ShiftPrior | None":
        slices = start.inputs.get("slices")
        if slices is None:
            return None
        return cls(slices.numbers, slices.planes, np.asarray(min(float(priors.shift), _FARTHEST)))

    def shared_unknowns(self) -> dict[str, Shared]:
        return {"shifts": Shared((len(self.numbers), 2)), "motion": Shared((3,), lasting=False, common=True)}

    def initial_values(self) -> dict[str, Array]:
        return {"shifts": jnp.zeros((len(self.numbers), 2))}

    def rows(self, place: Place, held: None) -> Float[Array, "m"]:
        """The shifts in mm, slice by slice."""
        return place.shared["shifts"].reshape(-1)

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return self.deviation**-2

    def vertices(self) -> Int[AnyArray, "m 0"]:
        return np.zeros((2 * len(self.numbers), 0), int)


def find_slice_planes(scan: Scan) -> SlicePlanes | None:
    """The slices of a scan that have a plane to move in; None where there are none.

    A slice has none where it is too straight, has points on all sides of it, or has fewer than ten points that count.
    """
    if scan.slices is None:
        return None
    points, numbers = np.asarray(scan.points, np.float64), np.asarray(scan.slices)
    counted = np.asarray(scan.weights_or_ones()) > 0
    planes = {number: _plane(points[counted & (numbers == number)]) for number in np.unique(numbers)}
    planes = {number: plane for number, plane in planes.items() if plane is not None}
    return SlicePlanes(np.array(list(planes)), np.stack(list(planes.values()))) if planes else None


def _plane(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 3"] | None:
    if len(points) < _FEWEST:
        return None
    _, (length, width, thickness), axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    return axes[:2] if width > _STRAIGHT * length and thickness < _THICK * width else None
