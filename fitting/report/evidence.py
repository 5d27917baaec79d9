"""What the scan itself says of its noise, and what of it the surface explains: numbers that findings are judged by."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

import jaxsubdiv as js

from ..model.pairing import Scene
from ..scan.closest_points import nearest_rows
from ..scan.layers import take_part
from ..scan.outliers import first_of_each
from ..start.cloud import are_on_lines, rows_on_surfaces
from ..start.orient import plane_fits
from .coverage import take_at_pairs, unit
from .record import Fit

_MOST = 20_000  # points that are looked at: an even part of more tells as much
_NEIGHBOURS = 12
_LEFT = (_NEIGHBOURS - 3) / _NEIGHBOURS  # of the variance: three numbers of a plane follow from its points
_PATCH = 40  # points beside each other on the surface that tell one wall from two
_LEAST_PATCHED = 400
# The kurtosis is 3 for one Gaussian wall, 1.8 for one that is evenly thick, and falls to 1 for two walls: 1.6 is that
# of walls 4.6 standard deviations apart.
_TWO_HUMPS = 1.6
# Each limit lies between the fits that are wrong and those that are right of tests/bench/fit_trust.py.
NOISE_OVER_OWN, NOISE_OVER_EDGE = 3.0, 0.12
_HARDLY_FELL = 0.8  # of the distances at the start


class OwnNoise(NamedTuple):
    """What the scan says of itself, without any surface."""

    sampled: Bool[np.ndarray, "p"]
    """Points that were looked at: those that count, and are not scattered."""
    noise: float
    """Median distance in mm of a point's twelve neighbours from their plane: the noise, or more where they lie so
    thinly that the surface is not flat between them. NaN where neighbours lie along lines, or are too few."""


def own_noise(points: Float[np.ndarray, "p 3"], counted: Bool[np.ndarray, "p"]) -> OwnNoise:
    """Noise of the points that are not scattered, each repeated point once.

    Args:
        points: in mm.
        counted: those that have a weight.
    """
    rows = np.flatnonzero(counted)
    if len(rows) > _MOST:
        rows = np.sort(np.random.default_rng(0).choice(rows, _MOST, replace=False))
    rows = rows[first_of_each(points[rows])]
    sampled = np.zeros(len(points), bool)
    if len(rows) > 2 * _NEIGHBOURS:
        rows = rows[rows_on_surfaces(points[rows])]
    sampled[rows] = True
    some = points[rows]
    if len(rows) <= 2 * _NEIGHBOURS or are_on_lines(some):
        return OwnNoise(sampled, np.nan)
    _, off, _ = plane_fits(some, _NEIGHBOURS)
    return OwnNoise(sampled, float(np.median(off)) / _LEFT**0.5)


def are_among_their_own(points: Float[np.ndarray, "p 3"], chosen: Bool[np.ndarray, "p"]) -> Bool[np.ndarray, "p"]:
    """Which of the chosen points have mostly others of them around: those of an object, not stray ones."""
    own = chosen.copy()
    if chosen.any():
        _, near = nearest_rows(KDTree(points), points[chosen], min(_NEIGHBOURS, len(points)))
        own[chosen] = chosen[near].mean(axis=1) > 0.5
    return own


def find_two_walls(
    feet: Float[np.ndarray, "p 3"],
    sides: Float[np.ndarray, "p 3"],
    distances: Float[np.ndarray, "p"],
    least: float = 0.0,
) -> tuple[float, float]:
    """Share of the patches of the surface whose distances have two humps, with hardly a point between them, and how far
    these are apart in mm.

    Args:
        feet: where on the surface each point is paired, in mm.
        sides: the surface's unit normals there.
        distances: signed, in mm.
        least: standard deviation in mm of distances that are no more than rounding.
    """
    if len(feet) < _LEAST_PATCHED:
        return 0.0, 0.0
    centres = np.arange(0, len(feet), max(1, len(feet) // 1000))
    _, near = nearest_rows(KDTree(feet), feet[centres], _PATCH)
    same = np.einsum("cpx,cx->cp", sides[near], sides[centres]) > 0.5
    of_patch = distances[near] - distances[near].mean(axis=1, keepdims=True)
    variance = np.mean(of_patch**2, axis=1)
    kurtosis = np.mean(of_patch**4, axis=1) / np.maximum(variance**2, np.finfo(float).tiny)
    two = (kurtosis < _TWO_HUMPS) & (same.mean(axis=1) > 0.8) & (variance > least**2)
    return float(two.mean()), float(2 * np.sqrt(np.median(variance[two]))) if two.any() else 0.0


class Evidence(NamedTuple):
    """What the checks look at; lengths in mm."""

    fit: Fit
    surface: js.RefinedSurface
    own: OwnNoise
    edge: float
    """Length of a control edge, in the middle."""
    noise: float
    distances: Float[np.ndarray, "p"]
    """Of the scan's points, signed."""
    inliers: Bool[np.ndarray, "p"]
    feet: Float[np.ndarray, "p 3"]
    """Where on the surface each point is paired."""
    sides: Float[np.ndarray, "p 3"]
    """The surface's unit normals there."""
    areas: Float[np.ndarray, "v"]
    """Of the surface's vertices, in mm^2."""
    covered: Bool[np.ndarray, "v"]
    """Vertices that the scan covers."""
    crossings: js.Crossings | None
    """Where the surface goes through itself, of layers each alone; None where that was not looked for."""
    layers: tuple[Bool[np.ndarray, "f"], ...]
    """The faces of each layer; none of other fits."""


def rests_far_off(scene: Scene, noise: float, edge: float, robust_rms: Float[np.ndarray, "sweeps"]) -> bool:
    """Whether a surface that came to rest did so far from the scan, hardly nearer than it started.

    Args:
        scene: the scan.
        noise: of the distances at the end, in mm.
        edge: length of a control edge in mm.
        robust_rms: at the start and after every sweep, in mm.
    """
    if noise < NOISE_OVER_EDGE * edge or robust_rms[-1] < _HARDLY_FELL * robust_rms[0]:
        return False
    own = own_noise(np.asarray(scene.scan.points, np.float64), _find_counted(scene)).noise
    return not noise < NOISE_OVER_OWN * own  # of points along lines nothing is known, and nothing explains it


def _find_counted(scene: Scene) -> Bool[np.ndarray, "p"]:
    """Points that have a weight, and are not scattered."""
    return (np.asarray(scene.scan.weights_or_ones()) > 0) & ~np.asarray(scene.around.scattered)


def gather_evidence(
    fit: Fit,
    surface: js.RefinedSurface,
    areas: Float[np.ndarray, "v"],
    covered: Bool[np.ndarray, "v"],
    crossings: js.Crossings | None = None,
    layers: Sequence[Bool[np.ndarray, "f"]] = (),
) -> Evidence:
    """All that the checks look at."""
    look, counted = fit.look, _find_counted(fit.scene)
    return Evidence(
        fit=fit,
        surface=surface,
        own=own_noise(np.asarray(look.pairs.points, np.float64), counted),
        edge=float(js.edge_length(fit.topology, fit.y.control.vertices)),
        noise=float(look.noise),
        distances=np.asarray(look.distances, np.float64),
        inliers=fit.inliers,
        feet=take_at_pairs(np.asarray(surface.vertices, np.float64), look),
        sides=unit(take_at_pairs(np.asarray(surface.normals, np.float64), look)),
        areas=areas,
        covered=covered,
        crossings=crossings,
        layers=tuple(layers),
    )


def find_own_crossings(surface: js.RefinedSurface, layers: Sequence[Bool[np.ndarray, "f"]]) -> js.Crossings:
    """Where a surface goes through itself; of layers each is looked at alone.

    Layers that touch, as bone and cartilage where there is no cartilage, go through each other, and are not wrong.

    Args:
        surface: of all layers.
        layers: the faces of each, triangles first; none where the surface is one.

    Raises:
        ImportError: ipctk, of the extra `contact`, is not installed.
    """
    if not layers:
        return js.find_crossings(surface)
    n = len(surface.faces[3])
    found = [js.find_crossings(take_part(surface, layer)) for layer in layers]
    rows = [np.flatnonzero(np.append(layer[:n], np.repeat(layer[n:], 2))) for layer in layers]
    return js.Crossings(
        np.sort(np.concatenate([own[one.triangles] for own, one in zip(rows, found, strict=True)])),
        np.concatenate([one.places for one in found]),
        len(surface.triangles()),
    )
