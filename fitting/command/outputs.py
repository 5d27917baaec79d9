"""The files of one fit."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import jaxsubdiv as js
from jaxsubdiv.frames import Frame

from ..image.slices import Slice, cut_slices
from ..report.layers import LayersFit
from ..report.page import write_page
from ..report.picture import draw_fit, draw_thickness
from ..report.result import FitResult
from ..report.saved import save_fit
from ..run.carry import carry_landmarks
from ..run.fit_scan import ScanFit
from ..run.folder import CARRIED, LANDMARKS, LAYER_CONTROL, LAYER_THICKNESS, LAYERS, fill_folder
from ..run.surface_files import write_surface
from ..scan.landmarks import write_landmarks
from .exports import find_level, write_exports
from .inputs import Job


def save_outputs(
    folder: Path, found: ScanFit, title: str, marks: dict[str, str], job: Job, options: argparse.Namespace
) -> None:
    """The fit as files, all of them in place of those of an earlier one, or none."""
    result, frame = found.result, job.scan.frame or (job.carried.frame if job.carried is not None else None)
    slices = cut_job_slices(job, result)
    with fill_folder(folder) as new:
        js.write_mesh(new / "control.obj", result.control_mesh, frame=frame)
        written = ["control.obj", *_write_surface(new, result, options, frame)]
        written += ["report.json", "fit.html", "fit.npz", "recipe.json"]
        if result.layers:
            (new / LAYERS).mkdir()
            written += _write_layers(new / LAYERS, LayersFit(result), options, frame)
        if job.carried is not None and job.mesh is not None:
            there = carry_landmarks(job.mesh, result, job.carried.positions)
            for name in (LANDMARKS, CARRIED):
                write_landmarks(new / name, there.positions, frame=frame, deviations=there.deviations)
                written.append(name)
        (new / "report.json").write_text(
            result.report(uncertainty=True, details=options.details).as_json() + "\n", encoding="utf-8"
        )
        write_page(new / "fit.html", result, title=title, start=found.start, details=options.details, slices=slices)
        assert result.recipe is not None
        save_fit(new, result.fit, result.recipe, marks)
        try:
            draw_fit(result, found.start, title=title, slices=slices).savefig(new / "fit.png")
            written.append("fit.png")
        except ImportError as error:
            print(f"note     no picture: {error}")
    print(f"wrote    {', '.join(written)} in {folder}")


def _write_layers(folder: Path, found: LayersFit, options: argparse.Namespace, frame: Frame | None) -> list[str]:
    """Every layer's control mesh and surface, and what lies between it and the next, as values and as a picture.

    Returns:
        the names of the files, with that of their folder.
    """
    at, written = found.result.refine_to(), list[str]()
    for number, name in enumerate(found.names):
        thickness = found.thickness(name)
        of_surface = {
            "distance_mm": at.distances,
            "deviation_mm": at.deviations,
            "thickness_mm": thickness.values,
            "thickness_deviation_mm": thickness.deviations,
        }
        values = {word: found.take_values(name, numbers) for word, numbers in of_surface.items()}
        js.write_mesh(folder / f"{name}{LAYER_CONTROL}", found.control_mesh(name), frame=frame)
        written.append(f"{name}{LAYER_CONTROL}")
        written += write_surface(folder, found.surface(name), values, options.surface, frame, name)
        if number + 1 < len(found.names) and (thickness.shares > 0).any():
            try:
                draw_thickness(found.result.surface, thickness).savefig(folder / f"{name}{LAYER_THICKNESS}")
                written.append(f"{name}{LAYER_THICKNESS}")
            except ImportError as error:
                print(f"note     no picture: {error}")
    return [f"{folder.name}/{file}" for file in written]


def _write_surface(folder: Path, result: FitResult, options: argparse.Namespace, frame: Frame | None) -> list[str]:
    """Write the surface's files, and return their names.

    A level that the surface lacks leaves all of them out with a note, so that the fit itself is not lost.
    """
    try:
        at = result.refine_to(find_level(result, options))
        values = {"distance_mm": at.distances, "deviation_mm": at.deviations}
        written = write_surface(folder, at.surface, values, options.surface, frame)
    except (ValueError, MemoryError) as error:
        print(f"note     no surface: {str(error) or 'it takes more memory than there is'}")
        return []
    return written + write_exports(folder, result, at, options)


def cut_job_slices(job: Job, result: FitResult) -> Sequence[Slice]:
    """Of the image, where there was one."""
    if job.seen is None:
        return ()
    return cut_slices(job.seen.volume, np.asarray(result.surface.vertices, np.float64), label=job.seen.label)
