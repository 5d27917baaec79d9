"""What the scan leaves uncertain.

To first order the surface, given the scan, is Gaussian about the fit; its precision is the normal matrix of scan and
priors. With the strength of the bend prior found from the scan, its bands hold as much of the truth as they say on
average over the surface. Source: D. Nychka, Bayesian confidence intervals for smoothing splines, 1988.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import jaxsubdiv as js

from ._look import Look
from ._problem import Problem, factorise

_DENSE = 4000  # unknowns whose covariance is kept whole, in 130 MB
_DRAWS = 200
_ROWS_AT_ONCE = 1024


class Uncertainty(NamedTuple):
    """How well a fit determines its surface: posterior standard deviations in mm, across the surface."""

    control: Float[np.ndarray, "v"]
    """Of every control vertex."""
    surface: Float[np.ndarray, "w"]
    """Of every vertex of the refined surface."""


class Posterior:
    """The surfaces that the scan and the priors leave probable: a Gaussian about the fit, to first order."""

    def __init__(self, problem: Problem, scheme: js.AbstractScheme, control: js.Control, seen: Look):
        self.problem, self.scheme, self.control, self.seen = problem, scheme, control, seen
        self.matrix = problem.precision_matrix(scheme, control, seen)

    def uncertainty(self) -> Uncertainty:
        """Exact for up to a few thousand unknowns; beyond, from random draws, to about 5 %."""
        problem, columns = self.problem, self.problem.elements.columns
        face, by = problem.across(self.scheme, self.control)
        n = problem.elements.n
        if np.sum(problem.is_free) <= _DENSE:
            covariance = np.zeros((n + 1, n + 1))
            free = np.append(problem.is_free, False)
            covariance[np.ix_(free, free)] = np.linalg.inv(self.matrix.toarray())
            variance = np.empty(len(by))
            for first in range(0, len(by), _ROWS_AT_ONCE):
                rows = slice(first, first + _ROWS_AT_ONCE)
                at = columns[face[rows]]
                block = covariance[at[:, :, None], at[:, None, :]]
                variance[rows] = np.sum(np.matmul(block, by[rows][..., None])[..., 0] * by[rows], axis=1)
        else:
            draws = np.append(self.draws(_DRAWS), np.zeros((1, _DRAWS)), axis=0)
            variance = np.empty(len(by))
            for first in range(0, len(by), _ROWS_AT_ONCE):
                rows = slice(first, first + _ROWS_AT_ONCE)
                moved = np.einsum("md,mdk->mk", by[rows], draws[columns[face[rows]]])
                variance[rows] = np.mean(moved**2, axis=1)
        deviation = np.sqrt(np.maximum(variance, 0))
        return Uncertainty(deviation[: self.control.vertices.shape[0]], deviation)

    def draws(self, n: int, seed: int = 0) -> Float[np.ndarray, "u n"]:
        """Random offsets of the unknowns, as probable as the posterior has them."""
        factor = factorise(self.matrix)
        # Without pivoting L U is L D L': P' L sqrt(D) z has the covariance A, and its solution that of A's inverse.
        normal = np.random.default_rng(seed).normal(size=(int(self.problem.is_free.sum()), n))
        sides = np.empty_like(normal)
        sides[:] = (factor.L @ (np.sqrt(factor.U.diagonal())[:, None] * normal))[factor.perm_r]
        offsets = np.zeros((self.problem.elements.n, n))
        offsets[self.problem.is_free] = factor.solve(sides)
        return offsets
