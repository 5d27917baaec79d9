"""What the command prints."""

import sys

import numpy as np

import jaxsubdiv as js
from jaxsubdiv.console import colour

from ..report.result import FitResult
from ..run.fit_scan import ScanFit
from ..scan.regions import Groups, match_regions
from ..scan.scan import Scan


def report_failure(error: BaseException) -> int:
    """Tell why an input cannot be used: exit status 2."""
    print(f"error: {str(error) or type(error).__name__}", file=sys.stderr)
    return 2


def print_regions(scan: Scan, mesh: js.ControlMesh, groups: Groups | None) -> None:
    """Tell of each label of the scan how many points it has, and which of the template's groups it is of."""
    match = match_regions(scan, mesh, groups)
    if match is None or scan.regions is None:
        return
    found = dict(match.groups)
    for label, n in zip(scan.regions.names, scan.regions.counts(), strict=True):
        where = f"on {' and '.join(found[label])}" if label in found else "no group's, paired with any face"
        print(f"region   {label}: {n:,} points, {where}")


def print_warnings(result: FitResult) -> None:
    for finding in result.warnings:
        print(colour(f"WARNING  {finding.text}"))


def describe_ending(found: ScanFit, off: float) -> str:
    if found.outcome is None:
        return ""
    return f"; split {found.splits} times, {found.outcome}: the surface is {off:.3f} mm off the scan beside the noise"


def describe_size(points: np.ndarray) -> str:
    return " x ".join(f"{extent:.0f}" for extent in np.ptp(points, axis=0)) + " mm"
