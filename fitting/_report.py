"""A fit in numbers, for people and for files."""

import dataclasses
import json


@dataclasses.dataclass(frozen=True)
class Report:
    """The numbers of a fit; distances in mm, between scan points and the fitted surface.

    Attributes:
        converged: whether the last sweeps left the fit where it was.
        reason: why not, in words; empty where it did.
        rms_start, rms: root mean square distance before and after.
        mean, median, percentile_95, maximum: of the absolute distance.
        bias: mean signed distance, positive where the points lie outside.
        noise: standard deviation of the Gaussian part of the distances.
        inlier_share: share of the points within three times the noise.
        rms_inliers: root mean square distance of these.
        h: fitted tangent length coefficient, one or one a level; None where the scheme has none.
        rms_per_sweep: at the start, then after every sweep.
    """

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
    rms_per_sweep: list[float]

    def __str__(self) -> str:
        state = f"converged after {self.sweeps} sweeps" if self.converged else f"NOT CONVERGED: {self.reason}"
        h = [] if self.h is None else self.h if isinstance(self.h, list) else [self.h]
        rows = [
            ("fit", state),
            ("RMS distance", f"{self.rms:.3f} mm (from {self.rms_start:.3f} mm)"),
            ("mean / median", f"{self.mean:.3f} / {self.median:.3f} mm"),
            ("95th percentile / maximum", f"{self.percentile_95:.3f} / {self.maximum:.3f} mm"),
            ("bias (outside is positive)", f"{self.bias:+.3f} mm"),
            ("scan points", f"{self.n_points:,}, {self.inlier_share:.1%} within 3 x the noise of {self.noise:.3f} mm"),
            ("RMS of these", f"{self.rms_inliers:.3f} mm"),
            ("control vertices", f"{self.n_control_vertices:,}"),
            ("faces of the surface", f"{self.n_faces:,}"),
        ]
        if h:
            rows.append(("tangent length h", ", ".join(f"{value:.4f}" for value in h)))
        if self.rms > self.rms_start:
            rows.append(("note", "worse than the start: is the control mesh too coarse, or fairness too strong?"))
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)

    def as_dict(self) -> dict[str, object]:
        """The same as plain values."""
        return dataclasses.asdict(self)

    def as_json(self) -> str:
        """The same as JSON text; refuses values that JSON does not have."""
        return json.dumps(self.as_dict(), indent=2, allow_nan=False)
