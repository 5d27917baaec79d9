"""A linear solver for optimistix: least squares without a matrix, one product a step."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
from jax import lax
from jaxtyping import Array, Bool, Float


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
            alpha = _over(gamma, jnp.sum(along**2))
            x, left = x + alpha * direction, left - alpha * along
            gradient = state.T.mv(left)
            new = jnp.sum(gradient**2)
            direction = gradient + _over(new, gamma) * direction
            return k + 1, x, left, direction, new, jnp.where(k == 0, new, first)

        k, x, *_ = lax.while_loop(goes_on, step, (jnp.int32(0), x, vector, x, zero, zero))
        return x, lx.RESULTS.successful, {"num_steps": k}

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state.T, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return lx.conj(state), options

    def assume_full_rank(self) -> bool:
        return True


def _over(a: Float[Array, ""], b: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(b > 0, a / jnp.where(b > 0, b, 1.0), 0.0)
