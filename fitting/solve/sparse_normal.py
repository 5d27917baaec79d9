"""Normal equations of a sweep on the host: sparse in the unknowns of control vertices, bordered by shared ones.

The matrix is an arrowhead, [A B; B' C]. A couples the unknowns of control vertices that lie near each other, C those
that all rows share, as h, shifts of slices or scores of shape modes, and B both. One analysis serves all sweeps.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js

from ..model.priors import AbstractVertexPrior
from ..model.priors.shifts import ShiftPrior
from ..model.residual import Held, Model, signed_distances
from ..model.unknowns import Layout, Unknowns, Variables
from .cholesky import Factor, Symbolic
from .cholesky import analyse as analyse_pattern
from .elements import (
    Elements,
    Patches,
    are_many,
    colour,
    differentiate,
    distance_matrix,
    distances_transposed,
    find_elements,
    find_patches,
    forgets_some,
    jacobian,
    normal_matrix,
    slopes_of_distances,
    slopes_of_rows,
    times_transposed,
)

_MOST_RINGS = 3
_REGULAR = 1e-12  # of the largest entry: what no row determines stays


class Arrowhead(NamedTuple):
    """A symmetric matrix [A B; B' C]."""

    inner: Float[np.ndarray, "e"]
    """Values of A, in the pattern of a `Structure`."""
    border: Float[np.ndarray, "o k"]
    corner: Float[np.ndarray, "k k"]

    def plus(self, other: "Arrowhead") -> "Arrowhead":
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


class _Tied(NamedTuple):
    """Which unknowns the rows of a prior that ties vertices depend on."""

    prior: str
    seeds: Float[np.ndarray, "s n"]
    seeds_of: Int[np.ndarray, "m d"]
    columns: Int[np.ndarray, "m d"]
    """`n` where there are fewer than in other rows."""


@dataclass(frozen=True, eq=False)
class Structure:
    """What the analysis of a model finds: the same for all sweeps."""

    layout: Layout
    elements: Elements
    patches: Patches
    tied: list[_Tied]
    pattern: sp.csc_array
    """Of A."""
    symbolic: Symbolic
    diagonal: Int[np.ndarray, "o"]
    """Where in A's values its diagonal stands."""
    fixed_entries: Int[np.ndarray, "_"]
    """Where the rows and columns of fixed unknowns stand."""
    from_elements: tuple[Int[np.ndarray, "_"], Int[np.ndarray, "_"]]
    """Entries of the elements' pattern that belong to A, and where they stand there."""

    @property
    def n(self) -> int:
        """Number of unknowns of A."""
        return self.layout.n_own

    @property
    def corners(self) -> Int[np.ndarray, "g 4"]:
        """Vertices of every face of the surface; the last of a triangle twice."""
        patches = self.patches
        return patches.vertices[patches.owner[:, None], patches.slots]

    def arrange(self, values: Float[np.ndarray, "_"], n_shared: int) -> Arrowhead:
        """The arrowhead of values in the pattern of the elements, in which h stands after the unknowns of vertices."""
        of_elements, n = self.elements.pattern, self.n
        inner = np.zeros(self.pattern.nnz)
        source, place = self.from_elements
        inner[place] = values[source]
        border, corner = np.zeros((n, n_shared)), np.zeros((n_shared, n_shared))
        n_h = self.elements.n - n
        for j in range(n_h):
            run = slice(*of_elements.indptr[n + j : n + j + 2])
            rows = of_elements.indices[run]
            border[rows[rows < n], j] = values[run][rows < n]
            corner[rows[rows >= n] - n, j] = values[run][rows >= n]
        return Arrowhead(inner, border, corner)

    def arrange_sparse(self, matrix: sp.csc_array) -> Arrowhead:
        """The arrowhead of a sparse matrix of all unknowns, whose part in A lies in the pattern."""
        n = self.n
        own = sp.csc_array(matrix[:n, :n])
        inner = np.zeros(self.pattern.nnz)
        np.add.at(inner, np.searchsorted(_keys(self.pattern), _keys(own)), own.data)
        return Arrowhead(inner, matrix[:n, n:].toarray(), matrix[n:, n:].toarray())


def find_structure(model: Model, y: Variables, held: dict[str, Any]) -> Structure:
    """Find which unknowns belong to which rows: so few rings of faces that explain all derivatives.

    Args:
        held: what each prior holds where a fit starts.

    Raises:
        ValueError: a face of the scheme depends on too many control vertices.
    """
    model = model.bare()
    surface = model.refine(y)
    owner = js.control_faces_of(model.scheme, model.topology, surface, y.control)
    patches = find_patches(surface, owner, model.topology.n_control_faces)
    rows = row_faces(model, held)
    for rings in range(1, _MOST_RINGS + 1):
        elements = find_elements(model, rings)
        found = differentiate(model, y, held, elements.seeds)
        if not forgets_some(elements, patches, found, rows):
            break
    else:
        raise ValueError(
            f"a face of {type(model.scheme).__name__} depends on control vertices more than {_MOST_RINGS} rings of "
            "faces away: the fit has no sparse derivatives to work with."
        )
    layout, n = model.layout, model.layout.n_own
    tied = [_tie(model, prior) for prior in model.vertex_priors]
    pattern = sp.csc_array(abs(sp.csc_array(elements.pattern.astype(float))[:n, :n])) + sp.eye_array(n, format="csc")
    pattern.data[:] = 1
    for one in tied:
        by = _sparse(np.ones(one.columns.shape), one.columns, layout.n)
        pattern = pattern + abs(sp.csc_array((by.T @ by)[:n, :n]))
    pattern = sp.csc_array(pattern)
    pattern.sort_indices()
    keys, column = _keys(pattern), _columns(pattern)
    of_elements = elements.pattern
    source = np.flatnonzero((of_elements.indices < n) & (_columns(of_elements) < n))
    place = np.searchsorted(keys, _columns(of_elements)[source].astype(np.int64) * n + of_elements.indices[source])
    fixed = np.asarray(model.is_free)[:n] == 0
    return Structure(
        layout,
        elements,
        patches,
        tied,
        pattern,
        analyse_pattern(pattern),
        np.flatnonzero(pattern.indices == column),
        np.flatnonzero(fixed[pattern.indices] | fixed[column]),
        (source, place),
    )


def row_faces(model: Model, held: dict[str, Any]) -> Int[np.ndarray, "m"]:
    """The control face of every row of the face priors."""
    faces = [np.asarray(prior.faces(held[prior.name])) for prior in model.face_priors]
    return np.concatenate([np.zeros(0, int), *faces]).astype(int)


def _tie(model: Model, prior: AbstractVertexPrior) -> _Tied:
    layout, vertices = model.layout, prior.vertices()
    m, c = vertices.shape
    there = vertices >= 0
    incidence = sp.csr_array(
        (np.ones(there.sum(), np.int32), (np.nonzero(there)[0], vertices[there])), shape=(m, layout.n_vertices)
    )
    colours = colour(incidence) if c else np.zeros(layout.n_vertices, int)
    n_colours = int(colours.max(initial=-1)) + 1 if c else 0
    width, parts = layout.width, np.arange(layout.width)
    columns = np.where(there[..., None], vertices[..., None] * width + parts, layout.n).reshape(m, -1)
    seeds_of = np.where(there[..., None], colours[vertices][..., None] * width + parts, 0).reshape(m, -1)
    seeds = np.zeros((n_colours * width, layout.n))
    if c:
        own = np.arange(layout.n_own)
        seeds[colours[own // max(width, 1)] * width + own % max(width, 1), own] = 1
    for name in prior.uses:
        places = np.arange(layout.n)[layout.columns(name)]
        seeds_of = np.concatenate([seeds_of, np.tile(len(seeds) + np.arange(len(places)), (m, 1))], axis=1)
        columns = np.concatenate([columns, np.tile(places, (m, 1))], axis=1)
        seeds = np.concatenate([seeds, np.eye(layout.n)[places]])
    return _Tied(prior.name, seeds, seeds_of, columns)


@eqx.filter_jit
def _differentiate_tied(
    model: Model, prior: AbstractVertexPrior, y: Variables, held: Any, seeds: Float[Array | np.ndarray, "s n"]
) -> tuple[Float[Array, "m"], Float[Array, "s m"]]:
    """The rows of a prior that ties vertices, and their derivatives along the seeds."""
    dtype, split = y.control.vertices.dtype, model.layout.split

    def rows(vector: Float[Array, "n"]) -> Float[Array, "m"]:
        return prior.rows(model.place(model.retract(y, split(vector))), held)

    found, derivative = jax.linearize(rows, jnp.zeros(model.layout.n, dtype))
    return found, jax.lax.map(derivative, jnp.asarray(seeds, dtype))


_measure_distances = jax.jit(signed_distances)


class SparseEquations:
    """Linearised rows about one place on the host: what scan and priors say of the unknowns."""

    def __init__(self, structure: Structure, model: Model, y: Variables, held: Held):
        self.structure, self.model, self.y, self.held = structure, model, y, held
        self._bare = bare = model.bare()
        self.gradient = np.zeros(model.layout.n)
        self.values: dict[str, Float[np.ndarray, "m"]] = {}
        """Rows of each prior, before they are weighed."""
        self._row_faces = row_faces(model, held.priors)
        self.found = differentiate(bare, y, held.priors, structure.elements.seeds)
        self._by: dict[str, Float[np.ndarray, "m d"]] = {}
        self._tied_jacobians: dict[str, sp.csr_array] = {}
        self._known: dict[tuple[str, bytes], ArrowheadFactor] = {}
        self.data = self._add_distances()
        self.prior = self._add_face_priors()
        for tied in structure.tied:
            self.prior = self.prior.plus(self._add_tied(tied))

    def jacobian(self, name: str) -> sp.csr_array:
        """Derivatives of the rows of a prior by all unknowns; 0 by those that are fixed."""
        n = self.model.layout.n
        if name in self._tied_jacobians:
            by = self._tied_jacobians[name]
        else:
            faces = self._row_faces[self._rows_of[name]]
            by = jacobian(self.structure.elements, self._by[name], faces)
            by = sp.csr_array((by.data, by.indices, by.indptr), shape=(len(faces), n))
        return by if np.all(self.model.is_free) else sp.csr_array(by @ sp.diags_array(np.asarray(self.model.is_free)))

    def times(self, name: str, x: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "m s"]:
        """The derivatives of a prior's rows times vectors."""
        return self.jacobian(name) @ x

    def transposed(self, name: str, x: Float[np.ndarray, "m s"]) -> Float[np.ndarray, "n s"]:
        """Their transposed derivatives times values a row."""
        return self.jacobian(name).T @ x

    def solver(
        self, which: str, damping: Float[np.ndarray, "n"], active: Bool[np.ndarray, "k"] | None = None
    ) -> Callable[[Float[np.ndarray, "n s"]], Float[np.ndarray, "n s"]]:
        """Solves with the damped normal matrix of "all" rows, or of those of the "prior"s alone."""
        matrix = self.prior if which == "prior" else self.data.plus(self.prior)
        factor = self._known.get((which, damping.tobytes()))
        if factor is None:
            factor = self._known[which, damping.tobytes()] = self.factorise(matrix, damping, active)
        free = self._free(active)[:, None]
        return lambda sides: free * factor.solve(free * sides)

    def step(self, damping: Float[np.ndarray, "n"], active: Bool[np.ndarray, "k"]) -> Float[np.ndarray, "n"]:
        """The most probable offset, to first order."""
        return self.solver("all", damping, active)(-self.gradient[:, None])[:, 0]

    def multiply_data(self, x: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "n s"]:
        """The normal matrix of the distances times vectors."""
        return self.multiply(self.data, x)

    def _free(self, active: Bool[np.ndarray, "k"] | None) -> Float[np.ndarray, "n"]:
        free = np.array(self.model.is_free, float)
        if active is not None:
            free[self.structure.n :] *= active
        return free

    def factorise(
        self, matrix: Arrowhead, damping: Float[np.ndarray, "n"], active: Bool[np.ndarray, "k"] | None = None
    ) -> ArrowheadFactor:
        """Factorise a matrix with a diagonal.

        Args:
            damping: added to the diagonal. What damps the vertices damps them about their common motion, where that is
                an unknown.
            active: which shared unknowns take part; the others stay.
        """
        structure, layout, n = self.structure, self.model.layout, self.structure.n
        inner, border, corner = matrix.inner.copy(), matrix.border.copy(), matrix.corner + np.diag(damping[n:])
        inner[structure.diagonal] += damping[:n]
        if "motion" in dict(layout.shared) and layout.has_vertices:
            free = damping[:n] * np.asarray(self.model.is_free)[:n]
            at = layout.width * np.arange(layout.n_vertices)
            first = layout.columns("motion").start - n
            for axis in range(3):
                border[at + axis, first + axis] -= free[at + axis]
                corner[first + axis, first + axis] += free[at + axis].sum()
        fixed = np.asarray(self.model.is_free)[:n] == 0
        inner[structure.fixed_entries] = 0
        inner[structure.diagonal[fixed]] = 1
        border[fixed] = 0
        if active is not None:
            border[:, ~active] = 0
            corner[~active] = 0
            corner[:, ~active] = 0
            corner[~active, ~active] = 1
        pattern = structure.pattern
        factor = structure.symbolic.factorise(sp.csc_array((inner, pattern.indices, pattern.indptr), shape=(n, n)))
        solved = factor.solve(border) if border.shape[1] else border
        return ArrowheadFactor(factor, border, solved, _inverse(corner - border.T @ solved))

    def to_dense(self, damping: Float[np.ndarray, "n"], which: Int[np.ndarray, "u"]) -> Float[np.ndarray, "u u"]:
        """The damped normal matrix of some unknowns, the others held."""
        matrix, n, pattern = self.data.plus(self.prior), self.structure.n, self.structure.pattern
        inner = sp.csc_array((matrix.inner, pattern.indices, pattern.indptr), shape=(n, n)).toarray()
        whole = np.block([[inner, matrix.border], [matrix.border.T, matrix.corner]]) + np.diag(damping)
        return whole[np.ix_(which, which)]

    def multiply(self, matrix: Arrowhead, x: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "n s"]:
        """A matrix times vectors, without what is fixed."""
        n, pattern = self.structure.n, self.structure.pattern
        inner = sp.csc_array((matrix.inner, pattern.indices, pattern.indptr), shape=(n, n))
        free = np.asarray(self.model.is_free)[:, None]
        own, shared = (free * x)[:n], (free * x)[n:]
        product = [inner @ own + matrix.border @ shared, matrix.border.T @ own + matrix.corner @ shared]
        return free * np.concatenate(product)

    @property
    def _n_shared(self) -> int:
        return self.model.layout.n - self.structure.n

    def _add_distances(self) -> Arrowhead:
        """The scan's matrix; its gradient is added to that of all."""
        structure, held, n = self.structure, self.held, self.structure.n
        elements, n_h = structure.elements, structure.elements.n - n
        weights = np.asarray(held.distance_precisions, np.float64)
        distances = np.asarray(_measure_distances(self.found.surface, held.pairs), np.float64)
        self.values["distance"] = distances
        by_shifts = self._shift_derivatives()
        weighed = sp.csr_array(sp.diags_array(weights) @ by_shifts)
        sides = sp.csr_array(sp.hstack([(weights * distances)[:, None], weighed]))
        matrix, across = self._multiply_distances(weights, sides)
        self.gradient[: elements.n] += across[:, 0]
        found = structure.arrange(matrix, self._n_shared)
        if held.of_points is None:
            return found
        # How the shifts of slices and the other unknowns move distances together.
        across = across[:, 1:]
        columns = self.model.layout.columns("shifts")
        shifts = slice(columns.start - n, columns.stop - n)
        found.border[:, shifts] += across[:n]
        found.corner[:n_h, shifts] += across[n:]
        found.corner[shifts, :n_h] += across[n:].T
        found.corner[shifts, shifts] += (by_shifts.T @ weighed).toarray()
        self.gradient[columns] += weighed.T @ distances
        return found

    def _multiply_distances(
        self, weights: Float[np.ndarray, "p"], sides: sp.csr_array
    ) -> tuple[Float[np.ndarray, "_"], Float[np.ndarray, "n k"]]:
        """J' W J in the pattern of the elements and J' times values `[p, k]`, J being the distances' derivatives."""
        elements, patches, at = self.structure.elements, self.structure.patches, np.asarray(self.held.faces)
        of_pairs = elements, patches, self.found, self.held.pairs
        if are_many(elements, patches, len(at)):
            return distance_matrix(*of_pairs, weights, at), distances_transposed(*of_pairs, sides, at)
        face, by = patches.owner[at], slopes_of_distances(*of_pairs, at)
        return normal_matrix(elements, by, weights, face), (jacobian(elements, by, face).T @ sides).toarray()

    def _shift_derivatives(self) -> sp.csr_array:
        """Of the distances by the shifts, slice by slice; without columns where no slice may be shifted."""
        prior, held = self.model.prior("shift"), self.held
        if held.of_points is None:
            return sp.csr_array((len(held.distance_precisions), 0))
        assert isinstance(prior, ShiftPrior)
        of_points = np.asarray(held.of_points)
        moves = np.flatnonzero(of_points >= 0)
        row = of_points[moves]
        directions = np.asarray(held.pairs.directions, np.float64)[moves]
        along = -np.einsum("px,pjx->pj", directions, np.asarray(prior.planes)[row])
        columns = 2 * row[:, None] + np.arange(2)
        shape = len(of_points), 2 * len(prior.numbers)
        return sp.csr_array((along.ravel(), (np.repeat(moves, 2), columns.ravel())), shape=shape)

    def _add_face_priors(self) -> Arrowhead:
        elements, held = self.structure.elements, self.held
        rows = np.asarray(self.found.rows, np.float64)
        by = slopes_of_rows(elements, self.found.of_rows, self._row_faces)
        first, weights = 0, [np.zeros(0)]
        self._rows_of: dict[str, slice] = {}
        for prior in self.model.face_priors:
            count = len(prior.faces(held.priors[prior.name]))
            own = slice(first, first + count)
            self._by[prior.name], self._rows_of[prior.name] = by[own], own
            self.values[prior.name] = rows[own]
            weights.append(np.broadcast_to(np.asarray(held.precisions[prior.name], np.float64), (count,)))
            first += count
        weights = np.concatenate(weights)
        self.gradient[: elements.n] += times_transposed(elements, by, weights * rows, self._row_faces)
        return self.structure.arrange(normal_matrix(elements, by, weights, self._row_faces), self._n_shared)

    def _add_tied(self, tied: _Tied) -> Arrowhead:
        prior, layout = self._bare.prior(tied.prior), self.model.layout
        assert isinstance(prior, AbstractVertexPrior)
        rows, by = _differentiate_tied(self._bare, prior, self.y, self.held.priors[prior.name], tied.seeds)
        rows, by = np.asarray(rows, np.float64), np.asarray(by, np.float64)
        by = np.take_along_axis(by.T, tied.seeds_of, axis=1) if len(by) else np.zeros(tied.columns.shape)
        found = _sparse(by, tied.columns, layout.n)
        weights = np.broadcast_to(np.asarray(self.held.precisions[prior.name], np.float64), rows.shape)
        self._tied_jacobians[prior.name] = found
        self.values[prior.name] = rows
        self.gradient += found.T @ (weights * rows)
        return self.structure.arrange_sparse(sp.csc_array(found.T @ sp.csr_array(sp.diags_array(weights) @ found)))


class SparseNormal(lx.AbstractLinearSolver):
    """Least squares by sparse normal equations on the host, of the rows of a fit.

    A fit steps it by `linearise`. As a solver of lineax it takes any operator whose rows are those of a `Residual` in
    offsets, as optimistix makes it for `optx.GaussNewton(..., linear_solver=SparseNormal(structure, faces))`: the
    derivatives come from few products with the operator, many unknowns at once.

    Attributes:
        structure: which unknowns belong to which rows.
        faces: the control face of each distance and of each row of the face priors; None where only fits use it.
        names: of these rows, in the same order.
    """

    structure: Structure = eqx.field(static=True)
    faces: Int[Array | np.ndarray, "m"] | None = None
    names: tuple[str, ...] = eqx.field(static=True, default=())

    def linearise(self, model: Model, y: Variables, held: Held) -> SparseEquations:
        """The rows of a fit about a place."""
        return SparseEquations(self.structure, model, y, held)

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> lx.AbstractLinearOperator:
        if self.faces is None:
            raise ValueError("`SparseNormal` needs the control faces of the rows: take it from `sparse_solver`.")
        return lx.linearise(operator)

    def compute(
        self, state: lx.AbstractLinearOperator, vector: dict[str, Float[Array, "_"]], options: dict[str, Any]
    ) -> tuple[Unknowns, lx.RESULTS, dict[str, Any]]:
        structure = self.structure
        dtype = jax.tree.leaves(vector)[0].dtype

        def along(seeds: Float[np.ndarray, "s n"]) -> dict[str, Float[Array, "s m"]]:
            return jax.lax.map(lambda seed: state.mv(structure.layout.split(seed)), jnp.asarray(seeds, dtype))

        of_faces = along(structure.elements.seeds)
        rows = jnp.concatenate([vector[name] for name in self.names])
        by = jnp.concatenate([of_faces[name] for name in self.names], axis=1)
        of_ties = [(vector[one.prior], along(one.seeds)[one.prior]) for one in structure.tied]
        shape = jax.ShapeDtypeStruct((structure.layout.n,), dtype)
        solution = jax.pure_callback(functools.partial(_solve, structure), shape, self.faces, rows, by, of_ties)
        return structure.layout.split(solution), lx.RESULTS.successful, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        raise NotImplementedError("normal equations have no transpose that a fit would need.")

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


def _solve(
    structure: Structure, faces: Array, rows: Array, by: Array, of_ties: list[tuple[Array, Array]]
) -> Float[np.ndarray, "n"]:
    """Least squares from the derivatives along the seeds."""
    face, n = np.asarray(faces), structure.layout.n
    elements, n_shared = structure.elements, structure.layout.n - structure.n
    left, slopes = np.asarray(rows, np.float64), np.asarray(by, np.float64)
    local = slopes_of_rows(elements, slopes.T, face)
    gradient = np.zeros(n)
    gradient[: elements.n] = times_transposed(elements, local, left, face)
    matrix = structure.arrange(normal_matrix(elements, local, np.ones(len(left)), face), n_shared)
    for tied, (values, along) in zip(structure.tied, of_ties, strict=True):
        values, along = np.asarray(values, np.float64), np.asarray(along, np.float64)
        found = _sparse(np.take_along_axis(along.T, tied.seeds_of, axis=1), tied.columns, n)
        gradient += found.T @ values
        matrix = matrix.plus(structure.arrange_sparse(sp.csc_array(found.T @ found)))
    pattern = structure.pattern
    values = matrix.inner.copy()
    values[structure.diagonal] += _REGULAR * np.abs(values[structure.diagonal]).max()
    inner = sp.csc_array((values, pattern.indices, pattern.indptr), shape=(structure.n, structure.n))
    factor = structure.symbolic.factorise(inner)
    solved = factor.solve(matrix.border) if n_shared else matrix.border
    whole = ArrowheadFactor(factor, matrix.border, solved, _inverse(matrix.corner - matrix.border.T @ solved))
    return whole.solve(gradient).astype(jax.dtypes.canonicalize_dtype(np.float64))


def _sparse(by: Float[np.ndarray, "m d"], columns: Int[np.ndarray, "m d"], n: int) -> sp.csr_array:
    """A sparse matrix from its rows; columns of `n` are left out."""
    m, d = columns.shape
    table = sp.csr_array(
        (by.ravel(), columns.ravel(), np.arange(0, m * d + 1, d) if d else np.zeros(m + 1, int)), shape=(m, n + 1)
    )
    return sp.csr_array(table[:, :n])


def _columns(pattern: sp.csc_array) -> Int[np.ndarray, "e"]:
    """The column of every entry."""
    return np.repeat(np.arange(len(pattern.indptr) - 1), np.diff(pattern.indptr))


def _keys(pattern: sp.csc_array) -> Int[np.ndarray, "e"]:
    """A number for every entry, by column and row."""
    return _columns(pattern).astype(np.int64) * pattern.shape[0] + pattern.indices  # pyright: ignore[reportOptionalSubscript]


def _inverse(matrix: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """The inverse of a small symmetric matrix; what has no curvature (the plane of a mesh that is one point) stays."""
    if not len(matrix):
        return matrix
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(matrix)), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(scale[:, None] * (matrix + matrix.T) / 2 * scale)
    least = len(matrix) * np.finfo(float).eps * max(values.max(), 0)
    inverse = np.where(values > least, 1 / np.where(values > least, values, 1), 0)
    return scale[:, None] * (vectors * inverse) @ vectors.T * scale


def sparse_solver(model: Model, y: Variables, held: Held) -> SparseNormal:
    """The sparse normal equations of a residual's rows as a linear solver for `optx.GaussNewton`."""
    structure = find_structure(model, y, held.priors)
    faces = np.concatenate([structure.patches.owner[np.asarray(held.faces)], row_faces(model, held.priors)])
    return SparseNormal(structure, faces, ("distance", *(prior.name for prior in model.face_priors)))
