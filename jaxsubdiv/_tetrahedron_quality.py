"""How good tetrahedra are for finite elements, and how near their boundary is to the surfaces that they fill."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ._distance import closest_on_mesh
from ._regions import Regions

_SHARES = (0.0, 0.05, 0.5)
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # of a tetrahedron, outwards; face i lacks corner i


class TetrahedronQuality(NamedTuple):
    """How well a finite element calculation can trust some tetrahedra, and how near their boundary is to the surface.

    Attributes:
        angles: smallest dihedral angle of a tetrahedron, in degrees: the minimum over all, the 5th percentile and the
            median. 70.5 is that of the regular one.
        scaled_jacobians: the same of the scaled Jacobian, VTK's: 1 for the regular tetrahedron, 0 for a flat one.
        n_inverted: tetrahedra of no or negative volume. A calculation needs none of these.
        rms, largest: distance of the vertices of the given surfaces from the faces that bound the regions of the
            tetrahedra, and of the vertices of these faces from the surfaces; in the unit of the surfaces.
        volume: of all tetrahedra.
        enclosed_volume: of the given surfaces, cavities taken away.
    """

    angles: tuple[float, float, float]
    scaled_jacobians: tuple[float, float, float]
    n_inverted: int
    rms: float
    largest: float
    volume: float
    enclosed_volume: float

    def __str__(self) -> str:
        angles, jacobians = (
            f"minimum {values[0]:.3g}, 5 % below {values[1]:.3g}, median {values[2]:.3g}"
            for values in (self.angles, self.scaled_jacobians)
        )
        return (
            f"smallest dihedral angle, degrees: {angles}\nscaled Jacobian: {jacobians}\ninverted: {self.n_inverted}\n"
            f"distance from the surface: RMS {self.rms:.3g}, largest {self.largest:.3g}\n"
            f"volume: {self.volume:.6g}, of the surface {self.enclosed_volume:.6g}"
        )


def measure_shapes(
    points: Float[np.ndarray, "n 3"], cells: Int[np.ndarray, "m 4"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Smallest dihedral angle in degrees, scaled Jacobian and signed volume of every tetrahedron."""
    corners = points[cells]
    a, b, c, d = (corners[:, i] for i in range(4))
    six_volumes = np.einsum("mx,mx->m", np.cross(b - a, c - a), d - a)
    sides = corners[:, _FACES]
    normals = np.cross(sides[:, :, 1] - sides[:, :, 0], sides[:, :, 2] - sides[:, :, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), np.finfo(float).tiny)
    first, second = np.triu_indices(4, 1)
    cosines = -np.einsum("mkx,mkx->mk", normals[:, first], normals[:, second])
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1))).min(axis=1)
    lengths = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=3)
    lengths[:, range(4), range(4)] = 1.0
    largest = lengths.prod(axis=2).max(axis=1)  # of the products of the three edges at a corner
    largest = np.maximum(largest, np.abs(six_volumes))  # no tetrahedron of no size is divided by nothing
    jacobians = np.sqrt(2) * six_volumes / np.where(largest > 0, largest, 1.0)
    return angles, jacobians, six_volumes / 6


def measure_tetrahedra(
    points: Float[np.ndarray, "n 3"],
    cells: Int[np.ndarray, "m 4"],
    regions: Regions,
    x: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    enclosed_volume: float,
) -> TetrahedronQuality:
    """Measure tetrahedra against the triangles of the surfaces that they fill."""
    angles, jacobians, volumes = measure_shapes(points, cells)
    bounding = _find_bounding_faces(cells, regions.rows)
    there, back = (x, points[bounding]), (points[np.unique(bounding)], x[triangles])
    away = np.concatenate([closest_on_mesh(*pair)[0] for pair in (there, back)])
    smallest, jacobian = (tuple(np.quantile(values, _SHARES).tolist()) for values in (angles, jacobians))
    n_inverted = int(np.sum(volumes <= 0))
    rms, largest = float(np.sqrt(np.mean(away**2))), float(away.max())
    return TetrahedronQuality(smallest, jacobian, n_inverted, rms, largest, float(volumes.sum()), enclosed_volume)


def _find_bounding_faces(cells: Int[np.ndarray, "m 4"], regions: Int[np.ndarray, "m"]) -> Int[np.ndarray, "b 3"]:
    """Faces with a tetrahedron of one region on one side only."""
    faces = cells[:, _FACES].reshape(-1, 3)
    ordered, region = np.sort(faces, axis=1), np.repeat(regions, 4)
    order = np.lexsort(ordered.T)
    same = (ordered[order[1:]] == ordered[order[:-1]]).all(axis=1) & (region[order[1:]] == region[order[:-1]])
    inner = np.zeros(len(faces), bool)
    inner[order[1:][same]] = inner[order[:-1][same]] = True
    return faces[~inner]
