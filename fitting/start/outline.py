"""The parts of a scan whose faces are all of the surface that was seen: the outline of a label."""

import numpy as np
from scipy.spatial import KDTree

from ..scan.scan import Scan
from .cloud import LEAST_POINTS, Cloud
from .parts import Part, nearest_piece, take_points
from .reconstruct import separate
from .remesh import Dense

_ROUNDS, _PASS_BAND = 30, 0.05  # of windowed sinc: stairs go, and a coarse mesh has no finer detail
_OFF = 2.0  # spacings of the points
_OFTEN = 0.95


def parts_of_outline(scan: Scan, cloud: Cloud) -> list[Part]:
    """The pieces of the outline without its stairs, the largest first, each with the points near it."""
    import pyvista

    assert scan.faces is not None
    stairs = pyvista.PolyData.from_regular_faces(np.asarray(scan.points, np.float64), scan.faces)
    smooth = stairs.smooth_taubin(
        n_iter=_ROUNDS, pass_band=_PASS_BAND, boundary_smoothing=False, normalize_coordinates=True
    )
    pieces = separate(Dense(np.asarray(smooth.points, np.float64), np.asarray(scan.faces)))
    nearest = nearest_piece(cloud.points, np.full(len(cloud.points), np.inf), pieces)
    parts: list[Part] = []
    for i, dense in enumerate(pieces):
        own = nearest == i
        if own.sum() >= LEAST_POINTS or not parts:
            parts.append(Part(take_points(cloud, own), dense, dense.topology()))
    return parts


def is_better(scan: Scan, cloud: Cloud, parts: list[Part]) -> bool:
    """Whether the outline serves better than the parts of a surface that was reconstructed from the points.

    Where the scan is thin, that surface is rounded off, so that points lie off it, or has holes that the outline lacks.
    """
    if not scan.outlined or scan.faces is None:
        return False
    own = Dense(np.asarray(scan.points), scan.faces).topology()
    if sum(part.topology.genus for part in parts) > own.genus:
        return True
    tree = KDTree(np.concatenate([part.dense.vertices for part in parts]))
    return bool(np.quantile(tree.query(cloud.points, workers=-1)[0], _OFTEN) > _OFF * cloud.spacing)
