"""What the scan leaves uncertain.

To first order the surface, given the scan, is Gaussian about the fit; its precision is the normal matrix of scan and
priors. With the strength of the bend prior found from the scan, its bands hold as much of the truth as they say on
average over the surface. Source: D. Nychka, Bayesian confidence intervals for smoothing splines, 1988.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

import jaxsubdiv as js

from ..model.pairing import Look, on_boundary
from ..model.priors.shifts import Shifts
from ..model.residual import splits_in_four
from ..scan.closest_points import boundary_vertices
from ..solve.problem import Problem, factorise
from .misfit import misfit_variances

DENSE = 4000  # unknowns whose covariance is kept whole, 130 MB a copy
_DRAWS = 200
_ROWS_AT_ONCE = 1024


class Uncertainty(NamedTuple):
    """How well a fit determines its surface: standard deviations in mm, across the surface."""

    control: Float[np.ndarray, "v"]
    """Of every control vertex, posterior to scan and priors."""
    surface: Float[np.ndarray, "w"]
    """Of every vertex of the refined surface from the anatomy: posterior, with the misfit."""
    misfit: Float[np.ndarray, "w"]
    """The part of it that the control mesh cannot follow, as residuals that points have in common show it."""


class Posterior:
    """The surfaces that the scan and the priors leave probable: a Gaussian about the fit, to first order."""

    def __init__(
        self,
        problem: Problem,
        scheme: js.AbstractScheme,
        control: js.Control,
        seen: Look,
        shifts: Shifts | None = None,
    ):
        self.problem, self.scheme, self.control, self.seen, self.shifts = problem, scheme, control, seen, shifts
        self.matrix = problem.precision_matrix(scheme, control, seen, shifts)
        """Of the free unknowns, of which there are `n_free`, and after them of what shifts of slices add."""
        self.n_free = int(problem.is_free.sum())

    def uncertainty(self) -> Uncertainty:
        """The posterior part is exact for up to a few thousand unknowns; beyond, from random draws, to about 5 %."""
        problem = self.problem
        face, by_surface = problem.across(self.scheme, self.control)
        columns, by_control = problem.across_control(self.control)
        variance = self._variances()
        surface, control = variance(problem.elements.columns[face], by_surface), variance(columns, by_control)
        surface, control = np.maximum(surface, 0), np.maximum(control, 0)
        misfit = self._misfit_variances(surface)
        return Uncertainty(np.sqrt(control), np.sqrt(surface + misfit), np.sqrt(misfit))

    def _misfit_variances(self, variances: Float[np.ndarray, "w"]) -> Float[np.ndarray, "w"]:
        """Of the vertices of the surface, means of the control faces that they lie on."""
        seen, corners, owner = self.seen, self.problem.corners, self.problem.owner
        surface = js.refine(self.scheme, self.problem.topology, self.control)
        pairs, open_vertices = seen.pairs, boundary_vertices(surface)
        # Where a surface ends, distances run along it.
        counted = ~np.asarray(on_boundary(open_vertices, pairs.corners, pairs.corner_weights))
        at_points = np.sum(np.asarray(pairs.corner_weights, np.float64) * variances[np.asarray(pairs.corners)], axis=1)
        weights = np.asarray(seen.precisions, np.float64) * counted
        distances, face = np.asarray(seen.distances, np.float64), np.asarray(seen.at.face)
        nested = splits_in_four(self.scheme, self.problem.topology)
        finer = range(len(self.problem.topology.levels) - 1, -1, -1) if nested else []
        patches = [owner[face]] + [face // 4**level for level in finer]
        of_faces = misfit_variances(distances, weights, at_points, patches, self.problem.around)
        once = np.append(np.ones((len(corners), 3)), corners[:, 3:] != corners[:, 2:3], axis=1)  # triangles repeat one
        sums, counts = (
            np.bincount(corners.ravel(), (once * of).ravel(), len(variances)) for of in (of_faces[owner][:, None], 1)
        )
        return sums / np.maximum(counts, 1)

    def _variances(self) -> Callable[[Int[np.ndarray, "m d"], Float[np.ndarray, "m d"]], Float[np.ndarray, "m"]]:
        """Variances of sums of unknowns, given by their columns and factors."""
        n, free = self.problem.elements.n, np.append(self.problem.is_free, False)  # one more, which nothing moves
        covariance = draws = np.zeros((n + 1, 0))
        exact = free.sum() <= DENSE
        if exact:
            covariance = np.zeros((n + 1, n + 1))
            covariance[np.ix_(free, free)] = np.linalg.inv(self.matrix.toarray())[: self.n_free, : self.n_free]
        else:
            draws = np.append(self.draws(_DRAWS), np.zeros((1, _DRAWS)), axis=0)

        def of(columns: Int[np.ndarray, "k d"], by: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k"]:
            if not exact:
                return np.mean(np.einsum("md,mdk->mk", by, draws[columns]) ** 2, axis=1)
            block = covariance[columns[:, :, None], columns[:, None, :]]
            return np.sum(np.matmul(block, by[..., None])[..., 0] * by, axis=1)

        def of_all(columns: Int[np.ndarray, "m d"], by: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m"]:
            runs = range(0, len(by), _ROWS_AT_ONCE)
            return np.concatenate([of(columns[i : i + _ROWS_AT_ONCE], by[i : i + _ROWS_AT_ONCE]) for i in runs])

        return of_all

    def draws(self, n: int, seed: int = 0) -> Float[np.ndarray, "u n"]:
        """Random offsets of the unknowns, as probable as the posterior has them."""
        factor = factorise(self.matrix)
        # Without pivoting L U is L D L': P' L sqrt(D) z has the covariance A, and its solution that of A's inverse.
        normal = np.random.default_rng(seed).normal(size=(factor.shape[0], n))
        sides = np.empty_like(normal)
        sides[:] = (factor.L @ (np.sqrt(factor.U.diagonal())[:, None] * normal))[factor.perm_r]
        offsets = np.zeros((self.problem.elements.n, n))
        offsets[self.problem.is_free] = factor.solve(sides)[: self.n_free]
        return offsets
