"""Steps without a matrix, wherever JAX computes: least squares by conjugate gradients, one product a step."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax import lax
from jaxtyping import Array, Bool, Float

from ..model.residual import Held, Model, Residual
from ..model.unknowns import Variables


class ConjugateGradients(lx.AbstractLinearSolver):
    """Least squares by conjugate gradients on the normal equations, which are never formed.

    lineax has this as `Normal(CG)`, which multiplies in three places: here it is one, which is compiled in a third of
    the time; and it stops where the gradient has fallen enough, or steps run out, which is no failure.

    Source: Hestenes and Stiefel 1952, as CGLS in Björck, Numerical methods for least squares problems, 1996, sec. 7.4.
    """

    rtol: float
    """Of the norm of the gradient."""
    max_steps: int = eqx.field(static=True)

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> lx.AbstractLinearOperator:
        return lx.linearise(operator)

    def compute(
        self, state: lx.AbstractLinearOperator, vector: Float[Array, "m"], options: dict[str, Any]
    ) -> tuple[Float[Array, "n"], lx.RESULTS, dict[str, Any]]:
        x, zero = jnp.zeros(state.in_size(), vector.dtype), jnp.zeros((), vector.dtype)

        def goes_on(carry: tuple) -> Bool[Array, ""]:
            k, _, _, _, gamma, first = carry
            return (k == 0) | ((k < self.max_steps) & (gamma > self.rtol**2 * first))

        def step(carry: tuple) -> tuple:
            k, x, left, direction, gamma, first = carry
            along = state.mv(direction)  # 0 in the first step, which only finds the gradient
            alpha = _divide(gamma, jnp.sum(along**2))
            x, left = x + alpha * direction, left - alpha * along
            gradient = state.T.mv(left)
            new = jnp.sum(gradient**2)
            direction = gradient + _divide(new, gamma) * direction
            return k + 1, x, left, direction, new, jnp.where(k == 0, new, first)

        k, x, *_ = lax.while_loop(goes_on, step, (jnp.int32(0), x, vector, x, zero, zero))
        return x, lx.RESULTS.successful, {"num_steps": k}

    def linearise(self, model: Model, y: Variables, held: Held) -> "OperatorEquations":
        """The rows of a fit about a place, for steps and solutions by conjugate gradients."""
        return OperatorEquations(self, model, y, held)

    def solve_normal(self, multiply: Callable, sides: Float[Array, "n s"]) -> Float[Array, "n s"]:
        """Solutions with a symmetric positive matrix that is given by its products, one for each side."""

        def solve(side: Float[Array, "n"]) -> Float[Array, "n"]:
            zero = jnp.zeros_like(side)

            def goes_on(carry: tuple) -> Bool[Array, ""]:
                k, _, _, _, gamma = carry
                return (k < self.max_steps) & (gamma > self.rtol**2 * jnp.sum(side**2))

            def step(carry: tuple) -> tuple:
                k, x, left, direction, gamma = carry
                along = multiply(direction)
                alpha = _divide(gamma, jnp.sum(direction * along))
                x, left = x + alpha * direction, left - alpha * along
                new = jnp.sum(left**2)
                return k + 1, x, left, left + _divide(new, gamma) * direction, new

            return lax.while_loop(goes_on, step, (jnp.int32(0), zero, side, side, jnp.sum(side**2)))[1]

        return jax.vmap(solve, 1, 1)(sides)

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state.T, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return lx.conj(state), options

    def assume_full_rank(self) -> bool:
        return True


class OperatorEquations:
    """Linearised rows about one place, as products with their derivatives; `SparseEquations` is the host's."""

    def __init__(self, solver: ConjugateGradients, model: Model, y: Variables, held: Held):
        self.model: Model = model
        self._solver, self._held = solver, held
        residual, layout = Residual(model), model.layout
        zero = jnp.zeros(layout.n, y.control.vertices.dtype)

        def rows(vector: Float[Array, "n"]) -> dict[str, Float[Array, "_"]]:
            return residual.rows(model.retract(y, layout.split(vector)), held)

        self.values: dict[str, Float[Array, "_"]]
        """Rows before they are weighed, by name."""
        self.values, self._derivative = jax.linearize(rows, zero)
        self._zero = zero
        self._transposed = jax.linear_transpose(self._derivative, zero)
        given = {"distance": held.distance_precisions} | held.precisions
        self._precisions = {
            name: jnp.broadcast_to(jnp.asarray(given[name], zero.dtype), row.shape) for name, row in self.values.items()
        }

    def step(self, damping: Float[Array, "n"], active: Bool[Array, "k"]) -> Float[Array, "n"]:
        """The most probable offset, to first order."""
        free = self._free_mask(active)
        roots = {name: jnp.sqrt(precision) for name, precision in self._precisions.items()}

        def weigh(vector: Float[Array, "n"]) -> Float[Array, "m"]:
            rows = self._derivative(free * vector)
            return jnp.concatenate([*(roots[name] * rows[name] for name in rows), self._damp(damping, free * vector)])

        right = [-roots[name] * row for name, row in self.values.items()]
        sides = jnp.concatenate([*right, jnp.zeros_like(self._damp(damping, self._zero))])
        operator = lx.FunctionLinearOperator(weigh, jax.eval_shape(lambda: self._zero))
        return free * lx.linear_solve(operator, sides, self._solver, throw=False).value

    def solver(self, which: str, damping: Float[Array, "n"], active: Bool[Array, "k"]) -> Callable:
        """Solves with the damped normal matrix of "all" rows, or of those of the "prior"s alone."""
        free = self._free_mask(active)
        names = [name for name in self.values if which == "all" or name != "distance"]

        def damp(vector: Float[Array, "n"]) -> Float[Array, "m"]:
            return self._damp(damping, vector)

        back = jax.linear_transpose(damp, self._zero)

        def multiply(vector: Float[Array, "n"]) -> Float[Array, "n"]:
            vector = free * vector
            return free * (self._normal(names, vector) + back(damp(vector))[0]) + (1 - free) * vector

        return lambda sides: free[:, None] * self._solver.solve_normal(multiply, free[:, None] * sides)

    def multiply_data(self, x: Float[Array, "n s"]) -> Float[Array, "n s"]:
        """The normal matrix of the distances times vectors."""
        free = jnp.asarray(self.model.is_free, x.dtype)
        return jax.vmap(lambda column: free * self._normal(["distance"], free * column), 1, 1)(x)

    def times(self, name: str, x: Float[Array, "n s"]) -> Float[Array, "m s"]:
        """The derivatives of a prior's rows times vectors."""
        return jax.vmap(lambda column: self._derivative(column)[name], 1, 1)(x)

    def transposed(self, name: str, x: Float[Array, "m s"]) -> Float[Array, "n s"]:
        """Their transposed derivatives times values a row."""
        return jax.vmap(lambda column: self._multiply_transposed({name: column}), 1, 1)(x)

    def _normal(self, names: list[str], vector: Float[Array, "n"]) -> Float[Array, "n"]:
        rows = self._derivative(vector)
        return self._multiply_transposed({name: self._precisions[name] * rows[name] for name in names})

    def _multiply_transposed(self, rows: dict[str, Float[Array, "_"]]) -> Float[Array, "n"]:
        return self._transposed({name: rows.get(name, jnp.zeros_like(row)) for name, row in self.values.items()})[0]

    def _free_mask(self, active: Bool[Array, "k"]) -> Float[Array, "n"]:
        free = jnp.asarray(self.model.is_free, self._zero.dtype)
        own = jnp.ones(self.model.layout.n_own, bool)
        return jnp.where(jnp.concatenate([own, active]), free, 0.0)

    def _damp(self, damping: Float[Array, "n"], vector: Float[Array, "n"]) -> Float[Array, "n"]:
        """How far the unknowns move, over what damps them; vertices about their common motion, where that is free."""
        layout = self.model.layout
        if "motion" in dict(layout.shared) and layout.has_vertices:
            table = vector[: layout.n_own].reshape(layout.n_vertices, layout.width)
            motion = jnp.pad(vector[layout.columns("motion")], (0, layout.width - 3))
            vector = jnp.concatenate([(table - motion[None]).reshape(-1), vector[layout.n_own :]])
        return jnp.sqrt(damping) * vector


def _divide(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(b > 0, a / jnp.where(b > 0, b, 1.0), 0.0)
