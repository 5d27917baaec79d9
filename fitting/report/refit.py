"""The fit as a differentiable function of the scan, at the correspondences, weights and priors that it ended with."""

import math
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

import jaxsubdiv as js

from ..model.residual import Held, Model, Residual
from ..model.unknowns import Variables
from ..solve.sweeps import shift_points
from .posterior import Posterior

_MOST_STEPS = 40
_RESTART, _MOST_RESTARTS = 60, 10  # of GMRES, in products with the Hessian
_MOST_UNKNOWNS = 8000  # whose posterior is whitened, in 512 MB


class _Fixed(NamedTuple):
    """What does not depend on the scan."""

    model: Model
    y: Variables
    held: Held
    shifts: Float[Array, "p 3"] | None
    """Of every point, in mm, where slices were free to move."""
    hold: Float[Array, "n"]
    whitening: Float[Array, "n u"]
    """Takes unknowns of variance 1, as the posterior has them, to offsets."""
    left: Float[Array, "u"]
    """Slope of the cost where the fit ended, which the solution keeps: not all of a surface comes to rest."""


@final
class Refit(eqx.Module):
    """Solves a fit again for other points or weights, differentiably, by optimistix and its implicit adjoint.

    Get it from a fit: `refit = result.refit()`. Then `refit(points)` is a smooth function for `jax.grad`, `jax.jvp`,
    `jax.jit` and `jax.vmap`: the control that the fit would find from these points if every point kept its surface
    point, its direction and its robust weight, and if the noise, the strength of the priors, the plane of symmetry and
    the shifts of slices stayed what they were.

    From the scan's own points it is the fit's own control: where the fit was not quite at rest, the slope of the cost
    that it left stays. The derivative is that of the solution, not of the steps to it: of the volume of a fitted organ,
    say, by each of the scan points that it came from. Control vertices that turned back from sweep to sweep, as where
    they cannot follow an ear, are held a little: they slip less along the surface than they would.
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
            ValueError: another number of points than the scan has.
            EquinoxRuntimeError: the solve does not converge: the points are too far from the scan's.
        """
        fixed = self._fixed
        if points.shape != fixed.held.pairs.points.shape:
            raise ValueError(f"the fit had points {list(fixed.held.pairs.points.shape)}; got {list(points.shape)}.")
        dtype = fixed.whitening.dtype
        points = jnp.asarray(points, dtype)
        weights = jnp.ones_like(points[:, 0]) if weights is None else jnp.asarray(weights, dtype)
        of_solution, of_derivative = _tolerances(points)
        found = optx.root_find(
            _slope,
            optx.Newton(rtol=0.0, atol=of_solution, linear_solver=_linear(of_solution / 10)),
            jnp.zeros(fixed.whitening.shape[1], dtype),
            args=(points, weights, fixed),
            adjoint=optx.ImplicitAdjoint(linear_solver=_linear(of_derivative)),
            max_steps=_MOST_STEPS,
        )
        y = fixed.model.retract(fixed.y, fixed.model.layout.split(fixed.whitening @ found.value))
        return fixed.model.scheme_at(y), y.control


def _slope(z: Float[Array, "u"], args: tuple[Array, Array, _Fixed]) -> Float[Array, "u"]:
    return jax.grad(_cost)(z, *args) - args[-1].left


def _linear(tolerance: float) -> lx.AbstractLinearSolver:
    # In whitened unknowns the Hessian is nearly the identity, but for the curvature that the posterior leaves out: that
    # is several times as much where residuals are large.
    return lx.GMRES(rtol=tolerance, atol=tolerance, restart=_RESTART, max_steps=_MOST_RESTARTS)


def _tolerances(points: Float[Array, "p 3"]) -> tuple[float, float]:
    """Of the solution, in posterior standard deviations, and, as a part, of its derivative."""
    eps = float(jnp.finfo(points.dtype).eps)
    return max(1e-8, 3e5 * eps), max(1e-8, 1e3 * eps)


def _cost(
    z: Float[Array, "u"], points: Float[Array, "p 3"], weights: Float[Array, "p"], fixed: _Fixed
) -> Float[Array, ""]:
    vector, held = fixed.whitening @ z, fixed.held
    points = points if fixed.shifts is None else points + fixed.shifts
    held = held._replace(
        pairs=held.pairs._replace(points=points), distance_precisions=held.distance_precisions * weights
    )
    y = fixed.model.retract(fixed.y, fixed.model.layout.split(vector))
    rows, precisions = Residual(fixed.model).rows(y, held), {"distance": held.distance_precisions} | held.precisions
    terms = [jnp.sum(jnp.asarray(precisions[name], row.dtype) * row**2) for name, row in rows.items()]
    return 0.5 * (jnp.sum(jnp.stack(terms)) + jnp.sum(fixed.hold * vector**2))


def make_refit(posterior: Posterior) -> Refit:
    """The differentiable fit about a posterior.

    Raises:
        ValueError: there are too many unknowns to whiten.
    """
    fit, equations = posterior.fit, posterior.equations
    layout, dtype = fit.model.layout, fit.y.control.vertices.dtype
    # The plane of symmetry and the shifts of slices are held: what a sweep moves along with it stays.
    moves = [of.lasting and name != "shifts" for name, of in layout.shared for _ in range(math.prod(of.shape))]
    which = np.flatnonzero(np.append(np.asarray(fit.model.is_free)[: layout.n_own] > 0, np.array(moves, bool)))
    if len(which) > _MOST_UNKNOWNS:
        raise ValueError(
            f"the fit has {len(which)} unknowns; its derivative is for up to {_MOST_UNKNOWNS}. "
            "Fit a coarser control mesh."
        )
    whitening = np.zeros((layout.n, len(which)))
    # Where control vertices turned back from sweep to sweep the cost need not be convex, unless they are held.
    whitening[which] = np.linalg.inv(np.linalg.cholesky(equations.to_dense(fit.last_hold, which))).T

    def put_on_device(values: Any) -> Any:
        is_float = isinstance(values, (np.ndarray, Array)) and jnp.issubdtype(values.dtype, jnp.floating)
        return jnp.asarray(values, dtype if is_float else None)

    held = jax.tree.map(put_on_device, equations.held._replace(of_points=None, shifts=None))
    shifts = None
    if fit.shifting and fit.scene.of_points is not None:
        shifts = put_on_device(shift_points(fit.model, fit.y.shared["shifts"], fit.scene.of_points))
    fixed = _Fixed(
        model=fit.model,
        y=fit.y,
        held=held,
        shifts=shifts,
        hold=put_on_device(fit.last_hold),
        whitening=put_on_device(whitening),
        left=jnp.zeros(len(which), dtype),
    )
    points = held.pairs.points if shifts is None else held.pairs.points - shifts  # the scan's own
    left = eqx.filter_jit(jax.grad(_cost))(fixed.left, points, jnp.ones_like(points[:, 0]), fixed)
    return Refit(fixed._replace(left=left))
