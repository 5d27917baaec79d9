"""What `fit_cohort` returns: many fits of one control mesh, and each of them as `fit` gives it."""

import dataclasses
from typing import final

import equinox as eqx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js

from ..model.recipe import Recipe
from ..model.view import View
from ..scan.scan import Scan
from ..solve.problem import Problem
from .result import FitResult


@final
@dataclasses.dataclass(frozen=True)
class Cohort:
    """Many scans fitted with one control mesh: row `i` of every array belongs to scan `i`, and vertices correspond.

    Attributes:
        control: control vertices (mm) and unit normals `[s, v, 3]`.
        h: the fitted tangent length coefficients, one row a scan; None where the scheme has none.
        surfaces: vertices and normals `[s, w, 3]` of the refined surfaces; the faces are those of all.
        converged: which fits came to rest. The others are what there was when the sweeps ran out or went astray.
        sweeps: how many each took.
        rms, robust_rms: as in `FitResult`, at the start and after every sweep; NaN beyond the last.
        noise: standard deviation of the Gaussian part of each scan's distances, in mm.
        weights: how much each point counts at the end, `[s, p]`; 0 past a scan's last point.
        scans: what was fitted.
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
    _recipe: Recipe
    _problem: Problem
    _starts: js.Control
    _finite: Bool[np.ndarray, "s"]

    def __len__(self) -> int:
        return len(self.scans)

    def result(self, i: int) -> FitResult:
        """The fit of scan `i` as `fit` gives it, with report, uncertainty and `save`; made when it is asked for."""
        recipe, topology, scan = self._recipe, self._problem.topology, self.scans[i]
        control, start, surface = (
            js.Control(part.vertices[i], part.normals[i]) for part in (self.control, self._starts, self.surfaces)
        )
        surface = js.RefinedSurface(surface.vertices, surface.normals, topology.faces)
        scheme = recipe.scheme if self.h is None else eqx.tree_at(lambda s: s.h, recipe.scheme, self.h[i])
        edge = float(js.edge_length(topology, control.vertices))
        seen = View(scan, surface, edge, recipe.loss).seen_from(surface)
        problem = Problem(recipe.scheme, topology, start, recipe.free, recipe.priors)
        own, of_all = problem.found(), self._problem.found()  # the template and its bends, and the strengths
        expected = own.expected.only(of_all.expected)
        problem.tell(of_all._replace(template=own.template, expected=expected, hold=own.hold))
        counted, ends = slice(None, int(self.sweeps[i]) + 1), optx.RESULTS
        stopped = ends.nonlinear_max_steps_reached if self._finite[i] else ends.nonfinite
        return FitResult(
            control=control,
            scheme=scheme,
            surface=surface,
            scan=scan,
            rms=self.rms[i][counted],
            robust_rms=self.robust_rms[i][counted],
            result=ends.successful if self.converged[i] else stopped,
            problem=problem,
            seen=seen,
            recipe=recipe,
            start=start,
        )
