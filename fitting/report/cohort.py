"""What `fit_cohort` returns: many fits of one control mesh, and each of them as `fit` gives it."""

import dataclasses
import functools
from collections.abc import Callable
from typing import final

import numpy as np
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js

from ..finding import Finding
from ..scan.scan import Scan
from .record import Fit
from .result import FitResult


@final
@dataclasses.dataclass(frozen=True)
class Cohort:
    """Many scans fitted with one control mesh: row `i` of every array belongs to scan `i`, and vertices correspond.

    Attributes:
        control: control vertices (mm) and unit normals `[s, v, 3]`.
        h: the fitted tangent length coefficients, one row a scan; None where the scheme has none.
        surfaces: vertices and normals `[s, w, 3]` of the refined surfaces; the faces are those of all.
        converged: which fits came to rest, and not where they started far from the scan. The others are what there was
            when the sweeps ran out or went astray.
        sweeps: how many each took.
        rms, robust_rms: as in `FitResult`, at the start and after every sweep; NaN beyond the last.
        noise: standard deviation of the Gaussian part of each scan's distances, in mm.
        weights: how much each point counts at the end, `[s, p]`; 0 past a scan's last point.
        scans: what was fitted.
        names: of the scans, for files; default: their numbers.
    """

    control: js.Control
    h: Float[Array, "s ..."] | None
    surfaces: js.RefinedSurface
    converged: Bool[np.ndarray, "s"]
    sweeps: Int[np.ndarray, "s"]
    rms: Float[np.ndarray, "s sweeps"]
    robust_rms: Float[np.ndarray, "s sweeps"]
    noise: Float[np.ndarray, "s"]
    weights: Float[np.ndarray, "s p"]
    scans: tuple[Scan, ...]
    names: tuple[str, ...]
    _fits: Callable[[int], Fit]

    def __len__(self) -> int:
        return len(self.scans)

    def result(self, i: int) -> FitResult:
        """The fit of scan `i` as `fit` gives it, with report, uncertainty and `save`; made when it is asked for."""
        return FitResult(self._fits(i))

    @functools.cached_property
    def warnings(self) -> tuple[tuple[Finding, ...], ...]:
        """What speaks against the fit of each scan, as `FitResult.warnings` has it; made when first asked for."""
        return tuple(tuple(self.result(i).warnings) for i in range(len(self)))

    @property
    def trusted(self) -> Bool[np.ndarray, "s"]:
        """Which fits nothing speaks against."""
        return np.array([not found for found in self.warnings])
