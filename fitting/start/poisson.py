"""The surface of oriented points: where a function whose gradient follows their normals passes its middle.

Every library that does this well is either heavy (Open3D: 900 MB, with a web server) or GPL (PoissonRecon in MeshLab).
On a regular grid the Poisson equation is diagonal in cosines, so that scipy alone solves it, in a fraction of a second;
the octree that those libraries need for detail has no use here, where the surface is coarsened right after.
"""

from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are used
from jaxtyping import Float
from scipy.fft import dctn, idctn

_PAD = 0.12  # of the longest side: room for what bulges out of a hole


class Implicit(NamedTuple):
    """A function on a grid, positive inside."""

    values: Float[np.ndarray, "x y z"]
    origin: Float[np.ndarray, "3"]
    cell: float

    def evaluate(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p"]:
        """Values between the nodes, trilinear."""
        return scipy.ndimage.map_coordinates(
            self.values, ((points - self.origin) / self.cell).T, order=1, mode="nearest"
        )

    def outward_vectors(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
        """Down the gradient, by differences over a cell; not of unit length."""
        steps = self.cell * np.eye(3)
        falls = [self.evaluate(points - step) - self.evaluate(points + step) for step in steps]
        return np.stack(falls, axis=1) / (2 * self.cell)


def poisson(
    points: Float[np.ndarray, "p 3"],
    normals: Float[np.ndarray, "p 3"],
    areas: Float[np.ndarray, "p"],
    cell: float,
    smoothing: float,
) -> Implicit:
    """The function that is about 1 inside of the points, 0 outside, and shifted so that it vanishes at them.

    Args:
        points: positions.
        normals: unit, outward.
        areas: part of the surface that each point stands for, in the square of their unit.
        cell: spacing of the grid's nodes.
        smoothing: standard deviation of the Gaussian that points are spread with.

    Source: Kazhdan 2005 and Kazhdan, Bolitho & Hoppe 2006, without the octree; no flow through the box, so that an open
    surface runs straight into its sides.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    pad = _PAD * (high - low).max() + 2 * cell
    shape = np.ceil((high - low + 2 * pad) / cell).astype(int) + 1
    origin = low - pad
    field = _spread(points, normals * areas[:, None], origin, cell, shape)
    divergence = np.sum([np.gradient(field[axis], cell, axis=axis) for axis in range(3)], axis=0)
    waves = [np.pi * np.arange(n) / n for n in shape]
    x, y, z = np.meshgrid(*waves, indexing="ij", sparse=True)
    laplacian = (2 * np.cos(x) + 2 * np.cos(y) + 2 * np.cos(z) - 6) / cell**2
    blur = np.exp(-(x**2 + y**2 + z**2) / 2 * (smoothing / cell) ** 2)
    laplacian[0, 0, 0] = 1
    spectrum = np.asarray(dctn(divergence.astype(np.float32))) * (blur / laplacian).astype(np.float32)
    spectrum[0, 0, 0] = 0
    values = -np.asarray(idctn(spectrum))
    found = Implicit(values, origin, cell)
    return found._replace(values=values - np.float32(_median(found.evaluate(points), areas)))


def _spread(
    points: Float[np.ndarray, "p 3"],
    vectors: Float[np.ndarray, "p 3"],
    origin: Float[np.ndarray, "3"],
    cell: float,
    shape: np.ndarray,
) -> Float[np.ndarray, "3 x y z"]:
    """Vectors shared out among the eight nodes around their points, a density."""
    place = (points - origin) / cell
    node = np.floor(place).astype(int)
    part = place - node
    field = np.zeros((3, int(np.prod(shape))))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, part, 1 - part), axis=1)
        at = np.ravel_multi_index(tuple((node + corner).T), tuple(shape))
        for axis in range(3):
            field[axis] += np.bincount(at, weight * vectors[:, axis], minlength=field.shape[1])
    return field.reshape(3, *shape) / cell**3


def _median(values: Float[np.ndarray, "p"], weights: Float[np.ndarray, "p"]) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])
