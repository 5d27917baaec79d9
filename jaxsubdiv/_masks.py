"""Sparse weights of new vertices over old ones, for linear schemes: built by scipy on the host, applied by JAX."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._fans import as_table
from .linalg import take

Matrix: TypeAlias = Any
"""A `scipy.sparse.csr_array`: a row a new vertex, a column an old one. scipy is loaded by the first linear scheme."""

Term: TypeAlias = tuple[Any, Any, Any]
"""Rows, columns and weights of some entries, each of which may be broadcast against the others."""

# Rows are padded to these lengths, so that few groups are compiled. They are those of the regular rules: 2 and 3 on
# boundaries, 4 in a face, 6 (Catmull-Clark), 7 (Loop), 8 (butterfly), 9 (Catmull-Clark, Doo-Sabin), 16 (Kobbelt).
_LENGTHS = np.array([1, 2, 4, 7, 9, 13, 16, 24, 32])


def entries(shape: tuple[int, int], *terms: Term) -> Matrix:
    """A matrix from its entries; those on one place add up, and those of a negative column are left out.

    Args:
        shape: of the matrix.
        terms: `(rows, columns, weights)`.
    """
    import scipy.sparse  # here and not above: the schemes of points and normals never need it

    rows, columns, weights = (
        np.concatenate(parts)
        for parts in zip(*([np.ravel(a) for a in np.broadcast_arrays(*term)] for term in terms), strict=True)
    )
    there = columns >= 0
    triplets = (weights[there].astype(np.float64), (rows[there], columns[there]))
    return scipy.sparse.coo_array(triplets, shape=shape).tocsr()


def scale_rows(weights: Float[np.ndarray, "n"], matrix: Matrix) -> Matrix:
    """Every row of a matrix times its weight."""
    return entries((len(weights), len(weights)), (np.arange(len(weights)), np.arange(len(weights)), weights)) @ matrix


def identity(n: int) -> Matrix:
    """The matrix that leaves `n` vertices where they are."""
    return entries((n, n), (np.arange(n), np.arange(n), 1.0))


def stack(matrices: Sequence[Matrix]) -> Matrix:
    """The rows of several matrices below one another."""
    import scipy.sparse

    return scipy.sparse.vstack(list(matrices), format="csr")


class MaskGroup(eqx.Module):
    """Rows of `k` weights."""

    index: Int[Array, "k m"] = eqx.field(converter=as_table)
    weight: Float[Array, "k m"] = eqx.field(converter=jnp.asarray)


class Masks(eqx.Module):
    """The rows of a sparse matrix, grouped by their length, so that each group is a dense table."""

    groups: tuple[MaskGroup, ...]
    order: Int[Array, "w"] = eqx.field(converter=as_table)
    """Where each row stands in the groups laid end to end."""
    n_columns: int = eqx.field(static=True)

    def __call__(self, x: Float[Array, "v 3"]) -> Float[Array, "w 3"]:
        """Weighted sums of the rows of `x`."""
        parts = []
        for group in self.groups:
            weight = jax.lax.stop_gradient(group.weight).astype(x.dtype)
            parts.append((take(x, group.index) * weight[..., None]).sum(axis=0))
        return take(jnp.concatenate(parts), self.order)

    def matrix(self) -> Matrix:
        """The same as a sparse matrix."""
        order = np.asarray(self.order)
        row_at = np.argsort(order)
        terms, first = [], 0
        for group in self.groups:
            rows = row_at[first : first + group.index.shape[1]]
            terms.append((rows[None], np.asarray(group.index), np.asarray(group.weight, np.float64)))
            first += len(rows)
        matrix = entries((len(order), self.n_columns), *terms)
        matrix.eliminate_zeros()
        return matrix


def as_masks(matrix: Matrix) -> Masks:
    """A finished sparse matrix as tables on the device."""
    matrix.eliminate_zeros()
    counts = np.diff(matrix.indptr)
    steps = np.append(_LENGTHS, 2 ** np.arange(6, 32))
    lengths = steps[np.searchsorted(steps, counts)]
    groups, members = [], []
    for length in np.unique(lengths):
        rows = np.flatnonzero(lengths == length)
        within = np.arange(length)[:, None]
        there = within < counts[rows]
        at = np.where(there, matrix.indptr[rows] + within, 0)
        groups.append(MaskGroup(np.where(there, matrix.indices[at], 0), np.where(there, matrix.data[at], 0.0)))
        members.append(rows)
    order = np.empty(len(counts), dtype=np.int64)
    order[np.concatenate(members)] = np.arange(len(counts))
    return Masks(tuple(groups), order, matrix.shape[1])
