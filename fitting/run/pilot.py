"""The pilot of a cohort: one ordinary fit, whose strengths of the priors hold for all subjects."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import jaxsubdiv as js
from jaxsubdiv.notices import warn

from ..model.priors.boundary import BoundaryCurve
from ..report.result import FitResult
from ..scan.closest_points import closest_points
from ..scan.landmarks import Landmarks
from ..scan.regions import RegionMatch
from ..scan.scan import Scan
from ..solve.strengths import FromTargets
from .fit import fit

# A start that is the fit of the pilot's own scan is expected to return bit by bit, noise included: the scan is found
# to be as like the start as can be, and the deviations that are left are those of the sweeps, not of anatomy. Of such
# starts half of the surface moved by less than 0.4 of the noise, of templates by more than 0.6 in all cases tried.
_LIKE, _HARDLY_MOVED, _NOTHING_LEFT = 0.5, 0.5, 0.03  # the last in control edges


class Member(NamedTuple):
    """What belongs to one scan of a cohort, as `fit` takes it."""

    control: js.Control
    scan: Scan
    landmarks: Landmarks | None
    boundary: BoundaryCurve | None
    regions: RegionMatch | None


def make_pilot(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    subjects: Sequence[Member],
    settings: dict[str, Any],
    given: FitResult | None = None,
) -> FitResult:
    """An ordinary fit of one subject, to take the strengths of the priors from.

    It is the given one, or that of the first scan. Where the start is that subject's own fit, the strengths would say
    that nothing varies: then the scan that lies farthest from its start is fitted instead, and if there is no other,
    the same one without expecting the shape of the start.

    Args:
        settings: what else `fit` takes, the same for all.
        given: the pilot to use, if it is of use.

    Warns:
        UserWarning: the start was fitted to the pilot's own scan.
    """

    def fit_one(i: int, **other: Any) -> FitResult:
        return fit(scheme, topology, throw=False, **(subjects[i]._asdict() | settings | other))

    pilot = fit_one(0) if given is None else given
    if settings["priors"].likeness is not None or not is_its_own_start(pilot):
        return pilot
    if len(subjects) == 1:
        other = fit_one(0, priors=dataclasses.replace(settings["priors"], likeness=0.0))
        how = "nothing of the start's own shape was expected: as by Priors(likeness=0)"
    else:
        off = [_distance(scheme, topology, one.control, one.scan) for one in subjects]
        farthest = int(np.argmax(off))
        other = fit_one(farthest)
        how = f"that of scan {farthest} was taken instead, which lies farthest from its start"
    warn(
        "the control mesh was fitted to the pilot's own scan before, so that the pilot says nothing of how subjects "
        f"differ: {how}. Start from a template or a mean, or give a pilot of another scan.",
    )
    return other


def take_strengths(pilot: FitResult) -> FromTargets:
    """What a pilot tells of the fits of other scans of the kind."""
    values = dict(pilot.fit.strengths.values)
    likeness = values.pop("likeness")
    return FromTargets(values, likeness, pilot.fit.strengths.determined)


def is_its_own_start(pilot: FitResult) -> bool:
    """Whether a fit started from a surface that was fitted to the same scan, and expected that surface again."""
    values, topology = pilot.fit.strengths.values, pilot.fit.topology
    usual = float(np.median(np.asarray(values["bend"], np.float64))) ** -0.5
    if float(values["likeness"]) < _LIKE or usual > _NOTHING_LEFT * float(
        js.edge_length(topology, pilot.start.vertices)
    ):
        return False
    before = np.asarray(js.refine(pilot.scheme, topology, pilot.start).vertices)  # with the h that was found
    moved = np.einsum("vx,vx->v", np.asarray(pilot.surface.vertices) - before, np.asarray(pilot.surface.normals))
    return bool(np.median(np.abs(moved)) < _HARDLY_MOVED * pilot.noise)


def _distance(scheme: js.AbstractScheme, topology: js.Topology, control: js.Control, scan: Scan) -> float:
    """Median distance in mm of a scan's points from the surface where the fit starts."""
    surface = js.refine(scheme, topology, control)
    on = np.asarray(js.evaluate(surface, closest_points(surface, scan.points)).points)
    return float(np.median(np.linalg.norm(on - np.asarray(scan.points), axis=1)))
