"""The fit as a differentiable function of the scan, at the correspondences, weights and priors that it ended with."""

from typing import NamedTuple, final

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

import jaxsubdiv as js

from ._elements import to_unknowns
from ._free import Unknowns, apply_offset, no_offset
from ._posterior import Posterior
from ._residuals import Pairs, Rows, Start, residuals

_MOST_STEPS = 30
_TOLERANCE = 1e-8  # of the solution and of its derivative, in posterior standard deviations
_DENSE = 4000  # unknowns whose posterior is whitened whole, in 130 MB


class _Fixed(NamedTuple):
    """What does not depend on the scan."""

    start: Start
    pairs: Pairs
    zero: Unknowns
    precisions: Float[Array, "p"]
    prior_precisions: Rows
    hold: Float[Array, "n"]
    whitening: Float[Array, "n u"] | Float[Array, "n"]
    """Takes unknowns of variance 1, as the posterior has them, to offsets: then every solver converges at once."""


@final
class Refit(eqx.Module):
    """Solves a fit again for other points or weights, differentiably, by optimistix and its implicit adjoint.

    Build it from a fit: `refit = result.refit()`. Then `refit(points)` is a smooth function for `jax.grad`, `jax.jvp`,
    `jax.jit` and `jax.vmap`: the control that the fit would find from these points if every point kept its surface
    point, its direction and its robust weight. What the noise and the strength of the priors were, they stay.

    The derivative is that of the solution, not of the steps to it: the volume of a fitted organ, say, by each of the
    scan points that it came from.
    """

    _fixed: _Fixed

    def __call__(
        self, points: Float[Array, "p 3"], weights: Float[Array, "p"] | None = None
    ) -> tuple[js.AbstractScheme, js.Control]:
        """Scheme with its h, and control, fitted to `points`.

        Args:
            points: as many as the scan has, in mm, each near the one of the scan in its row.
            weights: factors of the weights that the points had in the fit; default: 1 each.

        Raises:
            ValueError: another number of points or weights than the scan has.
        """
        fixed = self._fixed
        if points.shape != fixed.pairs.points.shape:
            raise ValueError(f"the fit had points {list(fixed.pairs.points.shape)}; got {list(points.shape)}.")
        weights = jnp.ones_like(points[:, 0]) if weights is None else weights
        if weights.shape != points.shape[:1]:
            raise ValueError(f"`weights` must have the shape [{points.shape[0]}]; got {list(weights.shape)}.")
        whitening = fixed.whitening
        found = optx.least_squares(
            _whitened,
            optx.GaussNewton(rtol=_TOLERANCE, atol=_TOLERANCE, linear_solver=lx.LSMR(rtol=1e-6, atol=1e-6)),
            jnp.zeros(whitening.shape[-1], points.dtype),
            args=(points, weights, fixed),
            # The Hessian is nearly the identity in these unknowns.
            adjoint=optx.ImplicitAdjoint(linear_solver=lx.BiCGStab(rtol=_TOLERANCE, atol=_TOLERANCE)),
            max_steps=_MOST_STEPS,
            throw=False,
        )
        start = fixed.start
        return apply_offset(
            start.topology, start.scheme, start.control, to_unknowns(_vector(found.value, fixed), fixed.zero)
        )


def _vector(z: Float[Array, "u"], fixed: _Fixed) -> Float[Array, "n"]:
    return fixed.whitening @ z if fixed.whitening.ndim == 2 else fixed.whitening * z


def _whitened(z: Float[Array, "u"], args: tuple[Array, Array, _Fixed]) -> tuple[Array, ...]:
    points, weights, fixed = args
    vector = _vector(z, fixed)
    rows = residuals(to_unknowns(vector, fixed.zero), fixed.start, fixed.pairs._replace(points=points))
    precisions = fixed.prior_precisions._replace(distance=fixed.precisions * weights)
    scaled = [jnp.sqrt(precision) * row for precision, row in zip(precisions, rows, strict=True)]
    return (*scaled, jnp.sqrt(fixed.hold) * vector)


def make_refit(posterior: Posterior) -> Refit:
    """The differentiable fit about a posterior."""
    problem, dtype = posterior.problem, posterior.control.vertices.dtype
    n, free = problem.elements.n, problem.is_free
    if free.sum() <= _DENSE:
        lower = np.linalg.cholesky(posterior.matrix.toarray())
        whitening = np.zeros((n, int(free.sum())))
        whitening[free] = np.linalg.inv(lower).T
    else:
        whitening = np.where(free, 1.0, 0.0)
        whitening[free] /= np.sqrt(posterior.matrix.diagonal())

    def on_device(values: np.ndarray) -> Array:
        return jnp.asarray(values, dtype)

    prior = Rows(*(on_device(np.asarray(values)) for values in problem.prior_precisions()))
    return Refit(
        _Fixed(
            start=problem.start(posterior.scheme, posterior.control),
            pairs=posterior.seen.pairs,
            zero=no_offset(problem.free, posterior.scheme, posterior.control),
            precisions=on_device(problem.distance_precisions(posterior.seen)),
            prior_precisions=prior,
            hold=on_device(problem.loose),
            whitening=on_device(whitening),
        )
    )
