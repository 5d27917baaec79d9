"""Robust losses as weights: how much a point counts that lies far off, in units of the noise."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsubdiv import strong_float

from .limits import check_numbers

# Truncation of the scale estimate, in sigma, and the standard deviation that a Gaussian of sigma 1 has within it.
_CUT, _STD_WITHIN_CUT = 2.5, 0.9546
# A quarter of a Gaussian lies within this many sigma: a start that even a majority of outliers leaves finite.
_QUARTER = 0.3186
_SCALE_STEPS = 30


class AbstractLoss(eqx.Module):
    """A loss by its weight, psi(r) / r: the weighted least squares that have the same gradient at `r`."""

    @abstractmethod
    def weight(self, r: Float[Array, "*p"]) -> Float[Array, "*p"]:
        """Weight of a residual that is `r` sigma long: 1 at 0, falling."""


class LeastSquares(AbstractLoss):
    """Every point counts in full: for scans without outliers."""

    def weight(self, r: Float[Array, "*p"]) -> Float[Array, "*p"]:
        return jnp.ones_like(r)


class Huber(AbstractLoss):
    """Quadratic up to `c` sigma, linear beyond: an outlier never loses its pull. Huber 1964."""

    c: Float[Array, ""] = eqx.field(converter=strong_float, default=1.345)

    def __check_init__(self) -> None:
        check_numbers({"c": self.c})

    def weight(self, r: Float[Array, "*p"]) -> Float[Array, "*p"]:
        c = self.c.astype(r.dtype)
        return c / jnp.maximum(jnp.abs(r), c)


class Barron(AbstractLoss):
    """The general loss rho(r, alpha, c): 2 is least squares, 1 pseudo-Huber, 0 Cauchy, -2 Geman-McClure, -inf Welsch.

    Source: J. Barron, A general and adaptive robust loss function, 2019, eqs. (8) and (9).
    """

    alpha: Float[Array, ""] = eqx.field(converter=strong_float, default=-2.0)
    c: Float[Array, ""] = eqx.field(converter=strong_float, default=3.0)

    def __check_init__(self) -> None:
        check_numbers({"alpha": self.alpha, "c": self.c})

    def weight(self, r: Float[Array, "*p"]) -> Float[Array, "*p"]:
        alpha, squared = self.alpha.astype(r.dtype), (r / self.c.astype(r.dtype)) ** 2
        # Welsch is the limit, and 2 has no power to take: both branches stay finite.
        finite = jnp.maximum(alpha, -1e3)
        b = jnp.maximum(jnp.abs(finite - 2), jnp.finfo(r.dtype).eps)
        general = (squared / b + 1) ** (finite / 2 - 1)
        return jnp.where(alpha == -jnp.inf, jnp.exp(-squared / 2), general)


def cauchy(c: float = 2.385) -> Barron:
    """Cauchy's loss, log(1 + r^2 / 2 c^2)."""
    return Barron(0.0, c)


def geman_mcclure(c: float = 3.0) -> Barron:
    """Geman and McClure's loss, 2 r^2 / (r^2 + 4 c^2): an outlier loses its pull altogether."""
    return Barron(-2.0, c)


class Tukey(AbstractLoss):
    """Tukey's biweight: nothing beyond `c` sigma counts at all."""

    c: Float[Array, ""] = eqx.field(converter=strong_float, default=4.685)

    def __check_init__(self) -> None:
        check_numbers({"c": self.c})

    def weight(self, r: Float[Array, "*p"]) -> Float[Array, "*p"]:
        return jnp.maximum(1 - (r / self.c.astype(r.dtype)) ** 2, 0.0) ** 2


def noise_scale(r: Float[Array, "p"], weights: Float[Array, "p"]) -> Float[Array, ""]:
    """Standard deviation of the Gaussian part of residuals, in their unit, whatever lies far beyond it.

    A truncated standard deviation, corrected for the truncation and repeated to its fixed point from above. Outliers
    count only as far as they happen to lie within 2.5 sigma: spread over a volume, most of a scan may be outliers.

    Args:
        r: residuals; those with weight 0 have no say.
        weights: not negative.
    """
    r = jnp.abs(r)
    counted = weights > 0
    start = jnp.nanquantile(jnp.where(counted, r, jnp.nan), 0.25) / _QUARTER

    def step(sigma: Float[Array, ""], _: None) -> tuple[Float[Array, ""], None]:
        within = jnp.where(counted & (r <= _CUT * sigma), weights, 0.0)
        spread = jnp.sqrt(jnp.sum(within * r**2) / jnp.sum(within))
        return spread / _STD_WITHIN_CUT, None

    sigma, _ = lax.scan(step, start, None, length=_SCALE_STEPS)
    return sigma
