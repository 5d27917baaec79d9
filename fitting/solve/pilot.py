"""Strengths of priors for a fit of many frames: those that a pilot fit found, and that of the tie between frames."""

from collections.abc import Callable
from typing import Any

import equinox as eqx

from ..model.residual import Model
from ..model.unknowns import AnyArray
from .strengths import Family, FromTargets, Linearised, Solve, Strengths, clip_strengths, next_precisions

_PROBES = 1  # of a trace over so many rows: all those of a series have one strength
_SETTLED = 0.05  # change of the logarithm of a strength in a sweep: from then on it stays


class FromPilot(eqx.Module):
    """Strengths of one frame's priors are those of a pilot; that of the change from frame to frame follows the scans.

    Attributes:
        targets: what the pilot found.
    """

    targets: FromTargets

    def start(self, strengths: Strengths) -> Strengths:
        """Those of the first sweep: what the pilot found, for the fit starts where the pilot ended."""
        values = strengths.values | self.targets.values | {"likeness": self.targets.likeness}
        return Strengths(values, self.targets.determined, strengths.annealed)

    def update(
        self,
        model: Model,
        strengths: Strengths,
        rows: Linearised,
        step: AnyArray,
        solve_prior: Callable[[], Solve],
        solve_posterior: Callable[[], Solve],
        xp: Any,
    ) -> Strengths:
        """Those of the next sweep; see `FromScan.update`."""
        new = self.targets.update(model, strengths, xp)
        prior = model.prior("series")
        if prior is None or prior.given_strengths() is not None or strengths.annealed:
            return new
        name = prior.name
        left = rows.values[name] + rows.times(name, step[:, None])[:, 0]
        family = Family(name, strengths.values[name], left, prior.strength_rows(), None)
        (found,) = next_precisions([family], rows, solve_prior(), solve_posterior(), xp, _PROBES)
        found = clip_strengths(model, found, xp)
        settled = xp.all(xp.abs(xp.log(found / strengths.values[name])) < _SETTLED)
        return Strengths(new.values | {name: found}, new.determined, new.annealed & settled)
