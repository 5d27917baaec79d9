"""The table of a series: every measure of every frame, with its standard deviation from the posterior.

To first order a measure is Gaussian about that of the fit. Its variance follows from the derivative of the measure by
the unknowns of its frame, and from the covariance of the unknowns of all frames.
"""

import csv
import dataclasses
import os
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxsubdiv as js
from jaxsubdiv.files import replace_file

from ..model.unknowns import Layout, Variables
from .measures import Column, Measures, Walls
from .result import FitResult


@dataclasses.dataclass(frozen=True)
class SeriesTable:
    """Measures of the frames of a series.

    Attributes:
        names: of the frames.
        columns: what is measured, and in which unit.
        values: of every frame.
        deviations: their standard deviations, posterior to scans and priors.
        ejection: of every cavity the part of its largest volume that it gives out, and its standard deviation.
    """

    names: tuple[str, ...]
    columns: tuple[Column, ...]
    values: Float[np.ndarray, "f m"]
    deviations: Float[np.ndarray, "f m"]
    ejection: dict[str, tuple[float, float]]

    def column(self, name: str) -> tuple[Float[np.ndarray, "f"], Float[np.ndarray, "f"]]:
        """Values and standard deviations of one measure.

        Raises:
            KeyError: there is none of that name; the text lists those that there are.
        """
        for i, column in enumerate(self.columns):
            if column.name == name:
                return self.values[:, i], self.deviations[:, i]
        raise KeyError(f"no measure '{name}'; there are {', '.join(column.name for column in self.columns)}.")

    def write_csv(self, path: str | os.PathLike[str]) -> None:
        """Write a line a frame: every measure, with its unit in the header, and its standard deviation."""
        heads = [head for name, unit in self.columns for head in (f"{name} [{unit}]", f"{name} sd [{unit}]")]
        with replace_file(path) as there, there.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["frame", *heads])
            for name, values, deviations in zip(self.names, self.values, self.deviations, strict=True):
                both = np.stack([values, deviations], axis=1).ravel()
                writer.writerow([name, *(f"{value:.6g}" for value in both)])

    def __str__(self) -> str:
        heads = [f"{column.name} [{column.unit}]" for column in self.columns]
        lines = ["frame | " + " | ".join(heads)]
        for name, values, deviations in zip(self.names, self.values, self.deviations, strict=True):
            cells = [f"{value:.4g} +- {sd:.2g}" for value, sd in zip(values, deviations, strict=True)]
            lines.append(" | ".join([name, *cells]))
        ejected = (f"ejection fraction {name}: {value:.3f} +- {sd:.2g}" for name, (value, sd) in self.ejection.items())
        return "\n".join([*lines, *ejected])


def measure_series(
    result: FitResult,
    topology: js.Topology,
    measures: Measures,
    controls: Sequence[js.Control],
    surfaces: Sequence[js.RefinedSurface],
    names: Sequence[str],
) -> SeriesTable:
    """Measure every frame of a series.

    Args:
        result: the fit of all frames.
        topology: tables of the control mesh of one frame.
        controls, surfaces: of the frames, in their places.
    """
    fit = result.fit
    n, layout = len(controls), fit.model.layout
    v = layout.n_vertices // n
    kept = tuple((name, of) for name, of in layout.shared if name == "h")
    own = Layout(v, layout.has_vertices, layout.has_normals, kept)
    edge = js.edge_length(fit.topology, fit.y.control.vertices)
    shared = {name: value for name, value in fit.y.shared.items() if name == "h"}
    of_frames = [Variables(control, shared) for control in controls]

    def refine(vector: Float[Array, "n"], y: Variables) -> js.RefinedSurface:
        moved = own.retract(y, own.split(vector), edge)
        return js.refine(fit.model.scheme_at(moved), topology, moved.control)

    def measure_frame(vector: Float[Array, "n"], y: Variables, walls: list[Walls]) -> Float[Array, "m"]:
        return measures.measure(refine(vector, y), walls)

    def change(both: Float[Array, "2 n"], y: Variables, first: Variables) -> Float[Array, ""]:
        return measures.displacement(refine(both[0], y), refine(both[1], first), shares)

    shares = measures.shares(surfaces[0])
    zero = jnp.zeros(own.n, edge.dtype)
    value_of, derivative_of = eqx.filter_jit(measure_frame), eqx.filter_jit(jax.jacrev(measure_frame))
    change_of = eqx.filter_jit(jax.value_and_grad(change))
    values, sides = [], []
    m = len(measures.columns)

    def place(derivative: Float[np.ndarray, "c n"], k: int) -> Float[np.ndarray, "u c"]:
        """Derivatives by the unknowns of a frame as those by all."""
        whole = np.zeros((layout.n, len(derivative)))
        whole[k * own.n_own : (k + 1) * own.n_own] = derivative[:, : own.n_own].T
        if kept:
            whole[layout.columns("h")] = derivative[:, own.n_own :].T
        return whole

    for k, (y, surface) in enumerate(zip(of_frames, surfaces, strict=True)):
        walls = measures.walls(surface)
        found = np.asarray(value_of(zero, y, walls), np.float64)
        by = place(np.asarray(derivative_of(zero, y, walls), np.float64), k)
        away, by_both = change_of(jnp.stack([zero, zero]), y, of_frames[0])
        by_both = np.asarray(by_both, np.float64)
        values.append([*found, float(away)])
        sides.append(np.concatenate([by, place(by_both[:1], k) + place(by_both[1:], 0)], axis=1))
    values = np.array(values)
    covariance = result.posterior.covariance_by_unknowns(np.concatenate(sides, axis=1))
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0)).reshape(n, m + 1)
    columns = (*measures.columns, Column("displacement", "mm"))
    ejection = {}
    for name, column in measures.volumes.items():
        at = column + (m + 1) * np.arange(n)
        ejection[name] = _ejection_fraction(values[:, column], covariance[np.ix_(at, at)])
    return SeriesTable(tuple(names), columns, values, deviations, ejection)


def _ejection_fraction(volumes: Float[np.ndarray, "f"], covariance: Float[np.ndarray, "f f"]) -> tuple[float, float]:
    """The part of the largest volume that the smallest lacks, and its standard deviation."""
    most, least = int(np.argmax(volumes)), int(np.argmin(volumes))
    slope = np.zeros(len(volumes))
    slope[least] -= 1 / volumes[most]
    slope[most] += volumes[least] / volumes[most] ** 2
    return float(1 - volumes[least] / volumes[most]), float(np.sqrt(max(slope @ covariance @ slope, 0)))
