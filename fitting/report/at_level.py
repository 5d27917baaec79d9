"""The fitted surface, refined by more or fewer levels than it was fitted with, and what is known at its vertices."""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

import jaxsubdiv as js

from ..scan.closest_points import closest_points, nearest_rows
from .posterior import Posterior
from .record import Fit

_MOST_DERIVATIVES = 1 << 26
"""Of vertices across the surface, held at once: 256 MiB in single precision."""
_AT_ONCE = 1 << 20  # vertices whose closest places are looked for
_NEAREST = 8


@dataclasses.dataclass(frozen=True)
class SurfaceAtLevel:
    """A fitted surface at a level of refinement.

    Attributes:
        surface: refined so often.
        distances: signed distance of the scan at every vertex in mm, positive outside: the mean of the nearest points'
            distances. NaN farther from the scan than its points are from one another, many times over: there is nothing
            to tell there.
        deviations: standard deviation across the surface of every vertex from the anatomy in mm, as
            `FitResult.uncertainty` has it: the same posterior, evaluated at this level. Of surfaces of more than about
            half a million vertices it is interpolated from a coarser level (on the head fragment, from level 5 to 6, by
            1 % off at the 95th percentile).

    Raises:
        ValueError: the surface has no such level.
    """

    fit: Fit
    levels: int
    posterior: Callable[[], Posterior]

    def __post_init__(self) -> None:
        _ = self.topology  # raises where there is none

    @functools.cached_property
    def topology(self) -> js.Topology:
        """Tables of the control mesh."""
        return _topology(self.fit, self.levels)

    @functools.cached_property
    def surface(self) -> js.RefinedSurface:
        return dataclasses.replace(self.fit.model, topology=self.topology).refine(self.fit.y)

    @functools.cached_property
    def distances(self) -> Float[np.ndarray, "v"]:
        points, measured = np.asarray(self.fit.look.pairs.points), np.asarray(self.fit.look.distances)
        tree = KDTree(points)
        spacing = np.median(nearest_rows(tree, points, min(2, len(points)))[0][:, -1])
        away, nearest = nearest_rows(tree, np.asarray(self.surface.vertices), min(_NEAREST, len(points)))
        known = away[:, 0] <= 5 * spacing + np.abs(measured)[nearest[:, 0]]
        return np.where(known, measured[nearest].mean(axis=1), np.nan)

    @functools.cached_property
    def deviations(self) -> Float[np.ndarray, "v"]:
        own, posterior = len(self.fit.topology.levels), self.posterior()
        if self.levels == own:
            return posterior.uncertainty().surface
        n_seeds = len(posterior.equations.structure.elements.seeds)
        if self.levels < own or len(self.surface.vertices) * n_seeds <= _MOST_DERIVATIVES:
            return posterior.deviations_of(self.topology)
        coarser = SurfaceAtLevel(self.fit, self.levels - 1, self.posterior)
        return _interpolate(coarser.surface, coarser.deviations, self.surface)


def _topology(fit: Fit, levels: int) -> js.Topology:
    own, settings = len(fit.topology.levels), fit.settings
    if levels == own:
        return fit.topology
    mesh = js.ControlMesh(fit.model.template, fit.topology.control_faces)
    if not eqx.tree_equal(settings.topology(mesh), fit.topology):
        raise ValueError(f"this surface has no other level than {own}, that of the fit: its control mesh has creases.")
    if settings.scheme.h is not None and np.ndim(settings.scheme.h):
        raise ValueError(f"this surface has no other level than {own}, that of the fit: it has an h for each level.")
    return js.build_topology(mesh, fit.model.scheme, levels, mesh_normals=settings.mesh_normals, limit=settings.limit)


def _interpolate(
    coarse: js.RefinedSurface, values: Float[np.ndarray, "v"], fine: js.RefinedSurface
) -> Float[np.ndarray, "w"]:
    """Values of the vertices of a surface at those of a finer one, from where these are closest."""
    vertices, found = np.asarray(fine.vertices), []
    for first in range(0, len(vertices), _AT_ONCE):
        corners, weights = js.corner_weights(coarse, closest_points(coarse, vertices[first : first + _AT_ONCE]))
        found.append(np.sum(values[np.asarray(corners)] * np.asarray(weights, np.float64), axis=1))
    return np.concatenate(found)
