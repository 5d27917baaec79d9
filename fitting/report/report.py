"""A fit in numbers, for people and for files."""

import dataclasses
import json
import math

from jaxsubdiv.frames import AXES

from ..finding import Finding, Pose
from .fit_measures import Measure

_RECORDS = "warnings", "measures"  # fields that hold named tuples, which `asdict` would write as lists


@dataclasses.dataclass(frozen=True)
class WorstPlace:
    """A place where the scan lies far from the fitted surface.

    Attributes:
        position: x, y, z on the surface, in mm.
        distance: signed distance in mm, positive where the scan lies outside: the median of the nearest points, nine or
            as many as lie within a quarter of a control edge on average, so that neither outliers nor noise make it.
        n_points: how many scan points lie within half a control edge.
    """

    position: list[float]
    distance: float
    n_points: int


@dataclasses.dataclass(frozen=True)
class SliceShift:
    """How far a slice of the scan was shifted.

    Attributes:
        slice: its number, as `Scan.slices` has it.
        shift: x, y, z in mm.
    """

    slice: int
    shift: list[float]


@dataclasses.dataclass(frozen=True)
class RegionDistance:
    """How far the points of a region lie from the surface.

    Attributes:
        region: the template's group that they were paired within, or groups; "any region" of points with no group.
        n_points: how many.
        rms, median: of their absolute distance, in mm.
    """

    region: str
    n_points: int
    rms: float
    median: float


@dataclasses.dataclass(frozen=True)
class Report:
    """The numbers of a fit; distances in mm. They are from the scan's points to the surface where nothing else is said.

    Attributes:
        trusted: whether nothing speaks against the fit.
        warnings: what does.
        pose: how the template was moved to the scan; None where there was none, or where it stayed.
        frame: of all positions, RAS or LPS, where the scan's file says; else None.
        converged: whether the last sweeps left the fit where it was.
        reason: why not, in words; empty where it did.
        rms_start, rms: root mean square distance before and after.
        mean, median, percentile_95, maximum: of the absolute distance.
        bias: mean signed distance, positive where the points lie outside.
        noise: standard deviation of the Gaussian part of the distances.
        inlier_share: share of the points within three times the noise.
        rms_inliers: root mean square distance of these.
        h: fitted tangent length coefficient, one or one a level; None where the scheme has none.
        likeness: how much of the template's shape was expected, as given or as found; see `Priors.likeness`.
        rms_per_sweep: at the start, then after every sweep.
        coverage: share of the surface's area that the scan covers: where an inlier is paired with a place nearer
            than five times the median distance from such a place to the next, and not on the other side.
        mean_to_scan, rms_to_scan, percentile_95_to_scan, maximum_to_scan: the other direction, of the absolute distance
            from the surface to the scan where the scan covers it, every part of the surface by its area. It is a mean
            over the eight nearest inliers, so that their noise mostly cancels and the misfit is left. None where the
            scan covers nothing.
        n_unknowns: numbers that the fit was free to change.
        determined: about how many of these the scan determines, the rest being left to the priors.
        least_margin: the least `admissible_margin` of the control normals: the surface is smooth above 0.05, and folds
            below -0.2. None where the scheme does not look at normals.
        measures: volume, area and so on, with standard deviations; empty where these were not asked for.
        crossing_triangles: how many triangles of the surface go through others of it, a quad being two; of layers
            through others of their own layer. None where that was not looked for: the extra `contact` is not
            installed, or the fit is of a series.
        crossings_at: x, y, z in mm, the middle of the crossings; None where there are none.
        uncertainty_median, uncertainty_95: median and 95th percentile, over the covered area, of the surface's standard
            deviation; None where it was not asked for.
        shifts: of the slices of the scan, which the distances have been measured after; empty where none was free.
        regions: the distances within each region; empty where points are paired with any face.
        worst: up to five places where the scan lies farthest from the surface, one control edge apart.
    """

    trusted: bool
    warnings: list[Finding]
    pose: Pose | None
    frame: str | None
    converged: bool
    reason: str
    sweeps: int
    rms_start: float
    rms: float
    mean: float
    median: float
    percentile_95: float
    maximum: float
    bias: float
    n_points: int
    noise: float
    inlier_share: float
    rms_inliers: float
    n_control_vertices: int
    n_faces: int
    h: float | list[float] | None
    likeness: float
    rms_per_sweep: list[float]
    coverage: float
    mean_to_scan: float | None
    rms_to_scan: float | None
    percentile_95_to_scan: float | None
    maximum_to_scan: float | None
    n_unknowns: int
    determined: float
    least_margin: float | None
    measures: list[Measure]
    crossing_triangles: int | None
    crossings_at: list[float] | None
    uncertainty_median: float | None
    uncertainty_95: float | None
    shifts: list[SliceShift]
    regions: list[RegionDistance]
    worst: list[WorstPlace]

    def __str__(self) -> str:
        rows = self.as_rows()
        width = max(len(name) for name, _ in rows)
        table = [f"{name:<{width}}  {value}" for name, value in rows]
        return "\n".join([*table, *(f"WARNING: {finding.text}" for finding in self.warnings)])

    def as_rows(self) -> list[tuple[str, str]]:
        """The same, less the warnings, as names and values in words: a table of two columns."""
        state = f"converged after {self.sweeps} sweeps" if self.converged else f"NOT CONVERGED: {self.reason}"
        if self.converged and not self.trusted:
            state += ", but NOT TO BE TRUSTED: see the warnings"
        h = [] if self.h is None else self.h if isinstance(self.h, list) else [self.h]
        rows = [("fit", state)]
        if self.pose is not None:
            rows.append(("template", str(self.pose)))
        if self.frame is not None:
            rows.append(("positions", f"in mm, {self.frame} ({AXES[self.frame]})"))
        rows += [
            ("RMS distance", f"{self.rms:.3f} mm (from {self.rms_start:.3f} mm)"),
            ("mean / median", f"{self.mean:.3f} / {self.median:.3f} mm"),
            ("95th percentile / maximum", f"{self.percentile_95:.3f} / {self.maximum:.3f} mm"),
            ("bias (outside is positive)", f"{self.bias:+.3f} mm"),
            ("scan points", f"{self.n_points:,}, {self.inlier_share:.1%} within 3 x the noise of {self.noise:.3f} mm"),
            ("RMS of these", f"{self.rms_inliers:.3f} mm"),
            ("surface covered by the scan", f"{self.coverage:.1%}"),
        ]
        to_scan = self.rms_to_scan, self.mean_to_scan, self.percentile_95_to_scan, self.maximum_to_scan
        if None not in to_scan:
            rows.append(
                ("there, surface to scan", "RMS {:.3f}, mean {:.3f}, 95th {:.3f}, maximum {:.3f} mm".format(*to_scan))
            )
        if self.uncertainty_median is not None:
            rows.append(
                (
                    "there, standard deviation",
                    f"median {self.uncertainty_median:.3f}, 95th {self.uncertainty_95:.3f} mm",
                )
            )
        rows += [
            ("control vertices", f"{self.n_control_vertices:,}"),
            ("faces of the surface", f"{self.n_faces:,}"),
            ("unknowns", f"{self.n_unknowns:,}, about {self.determined:,.0f} determined by the scan"),
        ]
        if h:
            rows.append(("tangent length h", ", ".join(f"{value:.4f}" for value in h)))
        if self.likeness:
            rows.append(("likeness to the template", f"{self.likeness:.2f}"))
        if self.least_margin is not None:
            rows.append(("least margin of a normal", f"{self.least_margin:+.2f}"))
        rows += [(one.name, str(one)) for one in self.measures]
        if self.crossing_triangles is None:
            rows.append(("triangles that cross others", "not looked for: it takes the extra `contact`, and no series"))
        else:
            where = ""
            if self.crossings_at is not None:
                where = f", around ({', '.join(f'{x:.1f}' for x in self.crossings_at)})"
            rows.append(("triangles that cross others", f"{self.crossing_triangles:,}{where}"))
        if self.shifts:
            far = [math.hypot(*one.shift) for one in self.shifts]
            root = math.sqrt(sum(length**2 for length in far) / len(far))
            rows.append(("slices shifted", f"{len(far)}, by RMS {root:.2f} mm and {max(far):.2f} mm at most"))
        for one in self.regions:
            rows.append((f"RMS in {one.region}", f"{one.rms:.3f} mm, median {one.median:.3f}, {one.n_points:,} points"))
        for i, place in enumerate(self.worst):
            at = ", ".join(f"{x:.1f}" for x in place.position)
            rows.append((f"worst place {i + 1}", f"{place.distance:+.3f} mm at ({at}), {place.n_points:,} points"))
        if self.rms_inliers > self.rms_start:
            rows.append(("note", "worse than the start: is the control mesh too coarse for the scan?"))
        return rows

    def as_dict(self) -> dict[str, object]:
        """The same as plain values."""
        pose = None if self.pose is None else self.pose._asdict()
        records: dict[str, object] = {name: [one._asdict() for one in getattr(self, name)] for name in _RECORDS}
        return dataclasses.asdict(self) | {"pose": pose} | records

    def as_json(self) -> str:
        """The same as JSON text; refuses values that JSON does not have."""
        return json.dumps(self.as_dict(), indent=2, allow_nan=False)
