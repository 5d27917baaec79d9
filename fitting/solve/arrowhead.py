"""A symmetric matrix with a sparse part, a border and a small dense corner, [A B; B' C], and its factor."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from .cholesky import Factor, Symbolic

_SOLVED, _MOST_STEPS = 1e-2, 100  # of conjugate gradients: of the norm of what is left, in that of the near part


class Arrowhead(NamedTuple):
    """A symmetric matrix [A B; B' C]."""

    inner: Float[np.ndarray, "e"]
    """Values of A, in the pattern of a `Structure`."""
    border: Float[np.ndarray, "o k"]
    corner: Float[np.ndarray, "k k"]

    def add(self, other: "Arrowhead") -> "Arrowhead":
        """The sum of both."""
        return Arrowhead(*(a + b for a, b in zip(self, other, strict=True)))


class ArrowheadFactor(NamedTuple):
    """A factorised arrowhead: A by Cholesky, and the Schur complement of A, which is small and dense."""

    inner: Factor
    border: Float[np.ndarray, "o k"]
    solved_border: Float[np.ndarray, "o k"]
    """A^-1 B."""
    shared_covariance: Float[np.ndarray, "k k"]
    """(C - B' A^-1 B)^-1."""

    def solve(self, sides: Float[np.ndarray, "n *s"]) -> Float[np.ndarray, "n *s"]:
        """The solution for every right side."""
        n = len(self.border)
        own = self.inner.solve(sides[:n])
        shared = self.shared_covariance @ (sides[n:] - self.border.T @ own)
        return np.concatenate([own - self.solved_border @ shared, shared])

    def covariance_blocks(self, columns: Int[np.ndarray, "f d"]) -> Float[np.ndarray, "f d d"]:
        """Blocks of the inverse, for unknowns of vertices that are coupled, and shared ones; -1 is no unknown."""
        n, k = self.solved_border.shape
        border = np.concatenate([self.solved_border, -np.eye(k), np.zeros((1, k))])[columns]
        own = self.inner.inverse_blocks(np.where((columns >= 0) & (columns < n), columns, n))
        return own + border @ self.shared_covariance @ border.transpose(0, 2, 1)

    def sample(self, normal: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "n s"]:
        """Vectors with the inverse as their covariance, from standard normal numbers."""
        n = len(self.border)
        values, vectors = np.linalg.eigh(self.shared_covariance)
        shared = vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * normal[n:])
        return np.concatenate([self.inner.sample(normal[:n]) - self.solved_border @ shared, shared])


def factorise_arrowhead(matrix: Arrowhead, pattern: sp.csc_array, symbolic: Symbolic) -> ArrowheadFactor:
    """Factorise an arrowhead.

    Args:
        matrix: its values of A in `pattern`.
        symbolic: the order of elimination of that pattern.
    """
    inner = sp.csc_array((matrix.inner, pattern.indices, pattern.indptr), shape=pattern.shape)
    factor = symbolic.factorise(inner)
    solved = factor.solve(matrix.border) if matrix.border.shape[1] else matrix.border
    return ArrowheadFactor(factor, matrix.border, solved, invert(matrix.corner - matrix.border.T @ solved))


def invert(matrix: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """The inverse of a small symmetric matrix; what has no curvature (the plane of a mesh that is one point) stays."""
    if not len(matrix):
        return matrix
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(matrix)), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(scale[:, None] * (matrix + matrix.T) / 2 * scale)
    least = len(matrix) * np.finfo(float).eps * max(values.max(), 0)
    inverse = np.where(values > least, 1 / np.where(values > least, values, 1), 0)
    return scale[:, None] * (vectors * inverse) @ vectors.T * scale


def solve_preconditioned(
    multiply: Callable[[Float[np.ndarray, "n s"]], Float[np.ndarray, "n s"]],
    precondition: Callable[[Float[np.ndarray, "n s"]], Float[np.ndarray, "n s"]],
    sides: Float[np.ndarray, "n s"],
) -> Float[np.ndarray, "n s"]:
    """Solutions with a symmetric positive matrix that is given by its products, for all right sides at once, by
    conjugate gradients, with another such matrix that is near to it and easily solved with."""
    x, left = np.zeros_like(sides), sides.copy()
    way = precondition(left)
    along = np.sum(left * way, axis=0)
    target = _SOLVED**2 * along
    for _ in range(_MOST_STEPS):
        if np.all(along <= target):
            break
        there = multiply(way)
        pace = along / np.maximum(np.sum(way * there, axis=0), np.finfo(float).tiny)
        x += pace * way
        left -= pace * there
        next_way = precondition(left)
        new = np.sum(left * next_way, axis=0)
        way = next_way + new / np.maximum(along, np.finfo(float).tiny) * way
        along = new
    return x
