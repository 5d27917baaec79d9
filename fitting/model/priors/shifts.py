"""Shifts of slices: a scan of contours in slices, each of which breathing displaced within its plane."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int

from ...scan.scan import Scan

_FEWEST = 10  # points of a slice that may move
_STRAIGHT = 0.1  # of its length: the least width of a slice that has a plane
_THICK = 0.3  # of its width: the most thickness


class Shifts(NamedTuple):
    """Which points move together, in which plane, and by how much."""

    slices: Int[np.ndarray, "s"]
    """Those that may move, as `Scan.slices` numbers them."""
    of_point: Int[np.ndarray, "p"]
    """The row of each point's slice; -1 where it stays."""
    planes: Float[np.ndarray, "s 2 3"]
    """Two unit vectors in the plane of each slice, at right angles."""
    within: Float[np.ndarray, "s 2"]
    """The shifts along these, in mm."""
    step: Float[np.ndarray, "s 2"]
    """The last change of these."""
    hold: Float[np.ndarray, "s"]
    """1 / variance of the next: a slice that turns back is held faster, as control vertices are."""

    @property
    def vectors(self) -> Float[np.ndarray, "s 3"]:
        """The shifts in space, in mm: from where the scan has a slice to where it was."""
        return np.einsum("sj,sjx->sx", self.within, self.planes)

    def of_points(self) -> Float[np.ndarray, "p 3"]:
        """The shift of every point in mm."""
        return np.append(self.vectors, np.zeros((1, 3)), axis=0)[self.of_point]

    def at(self, vectors: Float[np.ndarray, "s 3"]) -> "Shifts":
        """The same slices, shifted by these."""
        return self._replace(within=np.einsum("sx,sjx->sj", vectors, self.planes))

    def of(self, scan: Scan) -> "Shifts":
        """The same shifts, of the slices of another scan that have the same numbers."""
        row = {number: i for i, number in enumerate(self.slices.tolist())}
        return self._replace(of_point=np.array([row.get(number, -1) for number in np.asarray(scan.slices).tolist()]))

    def memory(self) -> dict[str, np.ndarray]:
        """What `recalled` needs, to go on from here."""
        return {"within": self.within, "shift_step": self.step, "shift_hold": self.hold}

    def recalled(self, memory: Mapping[str, np.ndarray]) -> "Shifts":
        """The same slices, where others were."""
        return self._replace(within=memory["within"], step=memory["shift_step"], hold=memory["shift_hold"])

    def put_on(self, scan: Scan) -> Scan:
        """The scan's points where they were, no longer in slices."""
        points = scan.points + jnp.asarray(self.of_points(), scan.points.dtype)
        return eqx.tree_at(lambda s: s.points, scan.without_slices(), points)

    def derivatives(self, directions: Float[Array | np.ndarray, "p 3"]) -> sp.csr_array:
        """Of the distances from the points to the surface, along these directions, by the shifts: slice by slice."""
        moves = np.flatnonzero(self.of_point >= 0)
        row = self.of_point[moves]
        along = -np.einsum("px,pjx->pj", np.asarray(directions, np.float64)[moves], self.planes[row])
        columns = 2 * row[:, None] + np.arange(2)
        shape = len(self.of_point), 2 * len(self.slices)
        return sp.csr_array((along.ravel(), (np.repeat(moves, 2), columns.ravel())), shape=shape)


def find_shifts(scan: Scan) -> Shifts | None:
    """The slices of a scan that have a plane to move in, with shifts of zero; None where there are none.

    A slice has none where it is too straight, has points on all sides of it, or has fewer than ten points that count.
    """
    if scan.slices is None:
        return None
    points, numbers = np.asarray(scan.points, np.float64), np.asarray(scan.slices)
    counted = np.asarray(scan.weights_or_ones()) > 0
    planes = {number: _plane(points[counted & (numbers == number)]) for number in np.unique(numbers)}
    planes = {number: plane for number, plane in planes.items() if plane is not None}
    if not planes:
        return None
    row = {number: i for i, number in enumerate(planes)}
    return Shifts(
        slices=np.array(list(planes)),
        of_point=np.array([row.get(number, -1) for number in numbers]),
        planes=np.stack(list(planes.values())),
        within=np.zeros((len(planes), 2)),
        step=np.zeros((len(planes), 2)),
        hold=np.zeros(len(planes)),
    )


def _plane(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 3"] | None:
    if len(points) < _FEWEST:
        return None
    _, (length, width, thickness), axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    return axes[:2] if width > _STRAIGHT * length and thickness < _THICK * width else None


class Border(NamedTuple):
    """What the shifts add to the normal equations of the other unknowns.

    A common motion of all vertices is three unknowns more. What damps the vertices in a sweep damps them about it: all
    slices together may be shifted with the surface, and nothing but the prior on shifts may say by how much.
    """

    across: sp.csr_array
    """Of the other unknowns, a row each, with the shifts, a column each."""
    among: sp.csr_array
    """Of the shifts among themselves, without their prior."""
    gradient: Float[np.ndarray, "k"]

    def plus(self, other: "Border") -> "Border":
        """Of both."""
        across, among = sp.csr_array(self.across + other.across), sp.csr_array(self.among + other.among)
        return Border(across, among, self.gradient + other.gradient)

    def around(
        self,
        matrix: sp.csc_array,
        precision: float | Float[np.ndarray, "k"],
        hold: Float[np.ndarray, "n 3"],
        motion: float,
    ) -> sp.csc_array:
        """The matrix of the other unknowns, and after them the shifts and the common motion.

        Args:
            matrix: with the holds.
            precision: of the prior on shifts.
            hold: how much of the matrix's diagonal holds a vertex along each axis.
            motion: the same for the common motion, where neither scan nor prior says anything of it.
        """
        shifts = self.among + sp.diags_array(np.broadcast_to(precision, self.gradient.shape))
        held, common = sp.csr_array(-hold), sp.diags_array(hold.sum(axis=0) + motion)
        blocks = [[matrix, self.across, held], [self.across.T, shifts, None], [held.T, None, common]]
        return sp.csc_array(sp.block_array(blocks, format="csc"))


def border_of(
    jacobian: sp.csr_array, by_shifts: sp.csr_array, precisions: Float[np.ndarray, "m"], distances: np.ndarray
) -> Border:
    """Of some rows of distances: their derivatives by the other unknowns and by the shifts, and 1 / their variances."""
    weighed = sp.csr_array(sp.diags_array(precisions) @ by_shifts)
    among, across = sp.csr_array(by_shifts.T @ weighed), sp.csr_array(jacobian.T @ weighed)
    return Border(across, among, weighed.T @ np.asarray(distances, np.float64))
