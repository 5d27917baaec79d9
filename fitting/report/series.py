"""A series as it was fitted: its surfaces frame by frame, and what is measured of them through time."""

import dataclasses
import functools
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import jaxsubdiv as js
from jaxsubdiv.files import replace_file

from ..scan.frames import Frames
from ..scan.scan import Scan
from .measures import Measures
from .result import FitResult
from .saved import load_fit, save_fit
from .series_table import SeriesTable, measure_series

_SERIES = "series.json"


@dataclasses.dataclass(frozen=True)
class SeriesFit:
    """The fit of a series.

    Attributes:
        result: of all frames, as one fit of copies of the control mesh that stand side by side.
        names: of the frames.
        valves: the template's groups that close the openings of cavities.
    """

    result: FitResult
    names: tuple[str, ...]
    valves: tuple[str, ...] = ()

    @property
    def frames(self) -> Frames:
        """How the frames stand in `result`."""
        return self.result.fit.inputs["frames"]

    def __len__(self) -> int:
        return len(self.names)

    @functools.cached_property
    def template(self) -> js.ControlMesh:
        """The control mesh of one frame, in its place at the start, with its groups."""
        fit, n = self.result.fit, len(self)
        v = len(fit.model.template) // n
        faces = {size: np.asarray(rows)[: len(rows) // n] for size, rows in fit.topology.control_faces.items()}
        regions = None
        if fit.regions is not None:
            rows, t = fit.regions.faces.rows, len(fit.topology.control_faces[3])
            own = np.concatenate([rows[: t // n], rows[t : t + (len(rows) - t) // n]])
            regions = js.Regions(own, fit.regions.faces.names)
        vertices = np.asarray(fit.model.template, np.float64)[:v] - self.frames.offsets[0]
        return js.ControlMesh(vertices, faces, check=False, regions=regions)

    def control(self, frame: int) -> js.Control:
        """The control of a frame, in its place."""
        v = len(self.template.vertices)
        rows, whole = slice(frame * v, (frame + 1) * v), self.result.control
        offset = jnp.asarray(self.frames.offsets[frame], whole.vertices.dtype)
        return js.Control(whole.vertices[rows] - offset[None], whole.normals[rows])

    def control_mesh(self, frame: int) -> js.ControlMesh:
        """The control mesh of a frame with its normals and groups, for `js.write_mesh`."""
        control, template = self.control(frame), self.template
        return js.ControlMesh(control.vertices, template.faces, control.normals, check=False, regions=template.regions)

    def topology(self, levels: int | None = None) -> js.Topology:
        """Tables of the control mesh of one frame; default: with as many levels as the fit has."""
        settings = self.result.fit.settings
        if levels is not None:
            settings = dataclasses.replace(settings, levels=levels)
        return settings.topology(js.ControlMesh(self.template.vertices, self.template.faces, check=False))

    @functools.cached_property
    def _topology(self) -> js.Topology:
        return self.topology()

    def surface(self, frame: int, levels: int | None = None) -> js.RefinedSurface:
        """The surface of a frame, in its place."""
        topology = self._topology if levels is None else self.topology(levels)
        return js.refine(self.result.scheme, topology, self.control(frame))

    def scan(self, frame: int) -> Scan:
        """The points of a frame as they were measured, their slices not shifted."""
        whole = self.result.scan.rows(np.arange(self.result.scan.n_points)[self.frames.rows_of(frame)])
        offset = jnp.asarray(self.frames.offsets[frame], whole.points.dtype)
        return dataclasses.replace(whole, points=whole.points - offset[None])

    def points(self, frame: int) -> Float[np.ndarray, "p 3"]:
        """The points of a frame, moved by the shifts of their slices, in mm."""
        return self.result.points[self.frames.rows_of(frame)] - self.frames.offsets[frame]

    def rms(self, frame: int) -> float:
        """Root mean square distance of the points of a frame that count, in mm."""
        rows = self.frames.rows_of(frame)
        distances, weights = self.result.distances[rows], np.asarray(self.result.scan.weights_or_ones())[rows]
        return float(np.sqrt(np.average(np.asarray(distances) ** 2, weights=weights)))

    @property
    def slices(self) -> Int[np.ndarray, "s"]:
        """Numbers of the slices that were shifted, the same in all frames."""
        return self.result.slices

    @property
    def shifts(self) -> Float[np.ndarray, "s 3"]:
        """How far each was shifted in mm."""
        return self.result.shifts

    @functools.cached_property
    def measures(self) -> Measures:
        """What is measured of every frame."""
        surface = self.surface(0)
        owner = js.control_faces_of(self.result.scheme, self._topology, surface, self.control(0))
        return Measures(self._topology, surface, owner, self.template, self.valves)

    @functools.cached_property
    def table(self) -> SeriesTable:
        """Volumes, mass, areas, thickness of the wall and displacement of every frame, with standard deviations."""
        controls = [self.control(k) for k in range(len(self))]
        surfaces = [self.surface(k) for k in range(len(self))]
        return measure_series(self.result, self._topology, self.measures, controls, surfaces, self.names)

    def save(self, folder: str | os.PathLike[str], *, marks: Mapping[str, str] | None = None) -> None:
        """Write the fit into a folder, for `load_series`: as `FitResult.save`, and `series.json` with the names.

        Args:
            folder: made where there is none.
            marks: of all that went into the fit, for a program that fits again only what changed.

        Raises:
            OSError, ValueError: as `FitResult.save`.
        """
        save_fit(folder, self.result.fit, self.result.recipe, marks)
        with replace_file(Path(folder) / _SERIES) as path:
            path.write_text(json.dumps({"names": self.names, "valves": self.valves}, indent=2) + "\n", encoding="utf-8")


def load_series(folder: str | os.PathLike[str]) -> SeriesFit:
    """The series that `SeriesFit.save` wrote into a folder.

    Raises:
        FileNotFoundError: the folder has none.
        ValueError: a file is damaged, or the fit is of a single scan; the text names the file.
    """
    path = Path(folder) / _SERIES
    if not path.is_file():
        raise FileNotFoundError(f"{folder} has no {_SERIES}: it is not the folder of a series that was saved.")
    fit, _ = load_fit(folder)
    try:
        told: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        names, valves = (tuple(map(str, told[name])) for name in ("names", "valves"))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: no names of frames and valves ({error}).") from None
    frames = fit.inputs.get("frames")
    if frames is None or len(frames.counts) != len(names):
        raise ValueError(f"{path}: {len(names)} names, but the fit beside it is not of as many frames.")
    return SeriesFit(FitResult(fit), names, valves)
