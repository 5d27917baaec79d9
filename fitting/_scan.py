"""The scan: measured points, and what is known of each."""

import csv
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxsubdiv as js
from jaxsubdiv._control import strong_float
from jaxsubdiv._errors import name_rows

_LABELS = ("label", "contour")


class ScanError(ValueError):
    """A scan cannot be fitted as it is; the text names the rows and what to do."""


def _optional(value: object) -> Array | None:
    return None if value is None else strong_float(value)


class Scan(eqx.Module):
    """Measured points of a surface.

    Attributes:
        points: positions in mm.
        normals: outward normals of any length, or None.
        weights: how much each point counts, not negative, or None where all count alike.
        deviations: standard deviation of each point's distance, positive, or None where all are alike. Only their ratio
            counts: how large the noise is, the fit finds out.

    Raises:
        ScanError: there is no point, a value is not finite, a weight is negative, a deviation is not positive, or
            lengths differ.
    """

    points: Float[Array, "p 3"] = eqx.field(converter=strong_float)
    normals: Float[Array, "p 3"] | None = eqx.field(converter=_optional, default=None)
    weights: Float[Array, "p"] | None = eqx.field(converter=_optional, default=None)
    deviations: Float[Array, "p"] | None = eqx.field(converter=_optional, default=None)

    def __check_init__(self):
        if self.points.ndim != 2 or self.points.shape[-1] != 3 or len(self.points) == 0:
            raise ScanError(f"a scan needs points of the shape [p, 3], at least one; got {list(self.points.shape)}.")
        for name, values, shape in (
            ("points", self.points, self.points.shape),
            ("normals", self.normals, self.points.shape),
            ("weights", self.weights, self.points.shape[:1]),
            ("deviations", self.deviations, self.points.shape[:1]),
        ):
            if values is None:
                continue
            if values.shape != shape:
                raise ScanError(f"`{name}` must have the shape {list(shape)}; got {list(values.shape)}.")
            finite = np.isfinite(np.asarray(values)).reshape(len(values), -1).all(axis=1)
            if not finite.all():
                raise ScanError(f"`{name}` are not finite in rows {name_rows(np.flatnonzero(~finite))}. Drop the rows.")
        if self.weights is not None:
            negative = np.flatnonzero(np.asarray(self.weights) < 0)
            if len(negative):
                raise ScanError(f"`weights` are negative in rows {name_rows(negative)}. Give 0 to ignore a point.")
            if not float(self.weights.sum()) > 0:
                raise ScanError("all `weights` are 0: nothing is left to fit. Give None where all points count alike.")

        if self.deviations is not None:
            bad = np.flatnonzero(np.asarray(self.deviations) <= 0)
            if len(bad):
                raise ScanError(
                    f"`deviations` are not positive in rows {name_rows(bad)}. Give a weight of 0 to ignore a point."
                )

    @property
    def n_points(self) -> int:
        """Number of points."""
        return self.points.shape[0]

    def weights_or_ones(self) -> Float[Array, "p"]:
        """The weights, 1 each where there are none."""
        return jnp.ones_like(self.points[:, 0]) if self.weights is None else self.weights

    def relative_deviations(self) -> Float[Array, "p"]:
        """The deviations over their root mean square, 1 each where there are none."""
        if self.deviations is None:
            return jnp.ones_like(self.points[:, 0])
        return self.deviations / jnp.sqrt(jnp.mean(self.deviations**2))


def read_scan(path: str | Path, *, scale: float = 1.0, label: str | None = None) -> Scan:
    """A scan from a file of points: PLY, XYZ, CSV, TXT, NPZ, VTP, or any mesh file, whose vertices are then the points.

    Args:
        path: the file.
        scale: multiplies the coordinates. A file of points does not say its unit; 1000 takes metres to mm.
        label: only the rows of a CSV file whose column `label` or `contour` holds this text, in capitals or not.

    Raises:
        MeshError: the file cannot be read; the text names the file and the line.
        ScanError: it holds no points, or none of this label; the text lists the labels that there are.
    """
    cloud = js.read_points(path, scale=scale)
    if label is None:
        return Scan(*cloud)
    labels = _labels(Path(path))
    chosen = np.array([label.casefold() in one.casefold() for one in labels], bool)
    if len(labels) != len(cloud.points) or not chosen.any():
        there = ", ".join(sorted(set(labels))) or "no column `label` or `contour`"
        raise ScanError(f"{Path(path).name}: no row has a label that holds '{label}'. It has: {there}.")
    return Scan(*(None if rows is None else rows[chosen] for rows in cloud))


def _labels(path: Path) -> list[str]:
    """The label of every row of a CSV file with a header."""
    lines = [
        text
        for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
        if (text := line.partition("#")[0].strip())
    ]
    rows = csv.DictReader(lines, delimiter=";" if lines and ";" in lines[0] else ",")
    name = next((name for name in rows.fieldnames or () if name.strip().lower() in _LABELS), None)
    return [] if name is None else [(row[name] or "").strip() for row in rows]
