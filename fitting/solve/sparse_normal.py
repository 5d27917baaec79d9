"""Normal equations of a sweep on the host: sparse in the unknowns of control vertices, bordered by shared ones.

The matrix is an arrowhead, [A B; B' C]. A couples the unknowns of control vertices that lie near each other, C those
that all rows share, as h, shifts of slices or scores of shape modes, and B both. One analysis serves all sweeps.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int

from ..model.priors import AbstractVertexPrior
from ..model.priors.shifts import ShiftPrior
from ..model.residual import Held, Model, signed_distances
from ..model.unknowns import Unknowns, Variables
from .arrowhead import Arrowhead, ArrowheadFactor, factorise_arrowhead, solve_preconditioned
from .derivatives import Derivatives, differentiate
from .elements import (
    are_many,
    distance_matrix,
    distances_transposed,
    jacobian,
    normal_matrix,
    slopes_of_distances,
    slopes_of_rows,
    times_transposed,
)
from .structure import Structure, Tied, find_structure, row_faces, sparse_rows

_REGULAR = 1e-12  # of the largest entry: what no row determines stays


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
        self.structure: Structure = structure
        self.model: Model = model
        self.y: Variables = y
        self.held: Held = held
        self._bare = bare = model.strip_strengths()
        self.gradient: Float[np.ndarray, "n"] = np.zeros(model.layout.n)
        self.values: dict[str, Float[np.ndarray, "m"]] = {}
        """Rows of each prior, before they are weighed."""
        self._row_faces = row_faces(model, held.priors)
        self.found: Derivatives = differentiate(bare, y, held.priors, structure.elements.seeds)
        self._by: dict[str, Float[np.ndarray, "m d"]] = {}
        self._tied_jacobians: dict[str, sp.csr_array] = {}
        self._known: dict[tuple[str, bytes], ArrowheadFactor] = {}
        self.data: Arrowhead = self._add_distances()
        self.prior: Arrowhead = self._add_face_priors()
        for tied in structure.tied:
            self.prior = self.prior.add(self._add_tied(tied))

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
        """Solves with the damped normal matrix of "all" rows, or of those of the "prior"s alone: exactly, or where
        priors couple vertices far from each other by conjugate gradients, the near part of the matrix going before."""
        matrix = self.prior if which == "prior" else self.data.add(self.prior)
        factor = self._known.get((which, damping.tobytes()))
        is_near = self.structure.near is not None
        if factor is None:
            factor = self._known[which, damping.tobytes()] = self.factorise(matrix, damping, active, near=is_near)
        free = self._free_mask(active)[:, None]
        if not is_near:
            return lambda sides: free * factor.solve(free * sides)
        whole = self._add_damping(matrix, damping, active)

        def multiply(x: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "n s"]:
            return free * self.multiply(whole, x)

        return lambda sides: solve_preconditioned(multiply, lambda x: free * factor.solve(x), free * sides)

    def step(self, damping: Float[np.ndarray, "n"], active: Bool[np.ndarray, "k"]) -> Float[np.ndarray, "n"]:
        """The most probable offset, to first order."""
        return self.solver("all", damping, active)(-self.gradient[:, None])[:, 0]

    def multiply_data(self, x: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "n s"]:
        """The normal matrix of the distances times vectors."""
        return self.multiply(self.data, x)

    def _free_mask(self, active: Bool[np.ndarray, "k"] | None) -> Float[np.ndarray, "n"]:
        free = np.array(self.model.is_free, float)
        if active is not None:
            free[self.structure.n :] *= active
        return free

    def factorise(
        self,
        matrix: Arrowhead,
        damping: Float[np.ndarray, "n"],
        active: Bool[np.ndarray, "k"] | None = None,
        near: bool = False,
    ) -> ArrowheadFactor:
        """Factorise a matrix with a diagonal.

        Args:
            damping: added to the diagonal. What damps the vertices damps them about their common motion, where that is
                an unknown.
            active: which shared unknowns take part; the others stay.
            near: without the entries of priors that couple vertices far from each other, which take time.
        """
        structure, damped = self.structure, self._add_damping(matrix, damping, active)
        if not near:
            return factorise_arrowhead(damped, structure.pattern, structure.symbolic)
        assert structure.near is not None
        symbolic, place = structure.near_symbolic
        return factorise_arrowhead(damped._replace(inner=damped.inner[place]), structure.near, symbolic)

    def _add_damping(
        self, matrix: Arrowhead, damping: Float[np.ndarray, "n"], active: Bool[np.ndarray, "k"] | None
    ) -> Arrowhead:
        """A matrix with a diagonal, and 1 on that of what is fixed; see `factorise`."""
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
        return Arrowhead(inner, border, corner)

    def to_dense(self, damping: Float[np.ndarray, "n"], which: Int[np.ndarray, "u"]) -> Float[np.ndarray, "u u"]:
        """The damped normal matrix of some unknowns, the others held."""
        matrix, n, pattern = self.data.add(self.prior), self.structure.n, self.structure.pattern
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
        structure, held = self.structure, self.held
        weights = np.asarray(held.distance_precisions, np.float64)
        distances = np.asarray(_measure_distances(self.found.surface, held.pairs), np.float64)
        self.values["distance"] = distances
        by_shifts = self._shift_derivatives()
        weighed = sp.csr_array(sp.diags_array(weights) @ by_shifts)
        sides = sp.csr_array(sp.hstack([(weights * distances)[:, None], weighed]))
        matrix, across = self._multiply_distances(weights, sides)
        self.gradient[: structure.elements.n] += across[:, 0]
        found = structure.arrange(matrix, self._n_shared)
        if held.of_points is not None:
            self._couple_shifts(found, across[:, 1:], by_shifts, weighed, distances)
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
        found = self.structure.arrange(normal_matrix(elements, by, weights, self._row_faces), self._n_shared)
        for prior in self.model.face_priors:
            by_shifts = prior.differentiate_shifts(held.priors[prior.name])
            if by_shifts is not None and "shifts" in dict(self.model.layout.shared):
                own = self._rows_of[prior.name]
                weighed = sp.csr_array(sp.diags_array(weights[own]) @ by_shifts)
                across = (self.jacobian(prior.name).T @ weighed).toarray()[: elements.n]
                self._couple_shifts(found, across, by_shifts, weighed, rows[own])
        return found

    def _couple_shifts(
        self,
        matrix: Arrowhead,
        across: Float[np.ndarray, "e k"],
        by_shifts: sp.csr_array,
        weighed: sp.csr_array,
        rows: Float[np.ndarray, "m"],
    ) -> None:
        """Add to a matrix, and to the gradient, how shifts move rows, by themselves and with the other unknowns.

        Args:
            across: J' W S, of the unknowns of the elements.
            by_shifts: S, the derivatives of the rows by the shifts.
            weighed: W S.
        """
        n, columns = self.structure.n, self.model.layout.columns("shifts")
        shifts, lengths = slice(columns.start - n, columns.stop - n), slice(len(across) - n)
        matrix.border[:, shifts] += across[:n]
        matrix.corner[lengths, shifts] += across[n:]
        matrix.corner[shifts, lengths] += across[n:].T
        matrix.corner[shifts, shifts] += (by_shifts.T @ weighed).toarray()
        self.gradient[columns] += weighed.T @ rows

    def _add_tied(self, tied: Tied) -> Arrowhead:
        prior, layout = self._bare.prior(tied.prior), self.model.layout
        assert isinstance(prior, AbstractVertexPrior)
        rows, by = _differentiate_tied(self._bare, prior, self.y, self.held.priors[prior.name], tied.seeds)
        rows, by = np.asarray(rows, np.float64), np.asarray(by, np.float64)
        by = np.take_along_axis(by.T, tied.seeds_of, axis=1) if len(by) else np.zeros(tied.columns.shape)
        found = sparse_rows(by, tied.columns, layout.n)
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

        def differentiate_along(seeds: Float[np.ndarray, "s n"]) -> dict[str, Float[Array, "s m"]]:
            return jax.lax.map(lambda seed: state.mv(structure.layout.split(seed)), jnp.asarray(seeds, dtype))

        of_faces = differentiate_along(structure.elements.seeds)
        rows = jnp.concatenate([vector[name] for name in self.names])
        by = jnp.concatenate([of_faces[name] for name in self.names], axis=1)
        of_ties = [(vector[one.prior], differentiate_along(one.seeds)[one.prior]) for one in structure.tied]
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
    local = slopes_of_rows(elements, slopes, face)
    gradient = np.zeros(n)
    gradient[: elements.n] = times_transposed(elements, local, left, face)
    matrix = structure.arrange(normal_matrix(elements, local, np.ones(len(left)), face), n_shared)
    for tied, (values, along) in zip(structure.tied, of_ties, strict=True):
        values, along = np.asarray(values, np.float64), np.asarray(along, np.float64)
        found = sparse_rows(np.take_along_axis(along.T, tied.seeds_of, axis=1), tied.columns, n)
        gradient += found.T @ values
        matrix = matrix.add(structure.arrange_sparse(sp.csc_array(found.T @ found)))
    values = matrix.inner.copy()
    values[structure.diagonal] += _REGULAR * np.abs(values[structure.diagonal]).max()
    factor = factorise_arrowhead(matrix._replace(inner=values), structure.pattern, structure.symbolic)
    return factor.solve(gradient).astype(jax.dtypes.canonicalize_dtype(np.float64))


def sparse_solver(model: Model, y: Variables, held: Held) -> SparseNormal:
    """The sparse normal equations of a residual's rows as a linear solver for `optx.GaussNewton`."""
    structure = find_structure(model, y, held.priors)
    faces = np.concatenate([structure.patches.owner[np.asarray(held.faces)], row_faces(model, held.priors)])
    return SparseNormal(structure, faces, ("distance", *(prior.name for prior in model.face_priors)))
