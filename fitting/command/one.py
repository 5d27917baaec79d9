"""One fit of the command: from its inputs to its files and its row of the summary."""

import argparse
import dataclasses
import re
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np

import jaxsubdiv as js
from jaxsubdiv.console import make_printable

from ..image.read import is_image
from ..report.fit_measures import Measure
from ..report.result import FitResult
from ..report.saved import read_marks
from ..run.checkpoint import find_differing
from ..run.fit_scan import misfit
from ..run.folder import FIT, is_unfinished, reserve_folder
from ..run.recipe import Recipe, load
from ..start.mesh_topology import topology_of
from .inputs import Source, mark_job, read_inputs, suggest_for_image
from .messages import describe_ending, describe_size, print_regions, print_warnings, report_failure
from .outputs import save_outputs
from .progress import Progress

# What a scan, a file or a fit may be refused by, each with words of its own.
REFUSALS = (js.MeshError, ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError)


def fit_one(
    scan: Source | None, folder: Path, options: argparse.Namespace, recipe: Recipe, title: str
) -> dict[str, Any]:
    """One fit: its row of the summary, whose status is 0, 1 for one not to be trusted, 2 for one that failed."""
    title, began = make_printable(title), time.perf_counter()
    try:
        with reserve_folder(folder):
            return _fit_and_save(scan, folder, options, recipe, title)
    except REFUSALS as error:
        status = report_failure(error)
    except (Exception, SystemExit) as error:  # a fault of this software or another: it must not end the other fits
        traceback.print_exc()
        status = report_failure(error)
    return {"scan": title, "status": status, "seconds": f"{time.perf_counter() - began:.1f}"}


def _fit_and_save(
    scan: Source | None, folder: Path, options: argparse.Namespace, recipe: Recipe, title: str
) -> dict[str, Any]:
    began = time.perf_counter()
    job = read_inputs(scan, options, recipe)
    slices = "" if job.scan.slices is None else f" in {len(np.unique(job.scan.slices))} slices"
    print(f"scan     {job.scan.n_points:,} points{slices}, {describe_size(np.asarray(job.scan.points))}")
    if job.seen is not None or (job.layered is not None and scan is not None and is_image(scan.path)):
        recipe = suggest_for_image(recipe, job.scan, options)
    marks = mark_job(job, recipe, options)
    done = find_done(folder, marks) if options.resume else None
    if done is not None:
        print(f"done     before, in {folder}")
        print_warnings(done)
        return make_row(title, done, misfit(done), None, options.details)
    if job.mesh is not None:
        counts = f"{len(job.mesh.vertices):,} vertices, {job.mesh.n_faces:,} faces"
        print(f"control  {counts}, {describe_size(job.mesh.vertices)}")
        print_regions(job.scan, job.mesh, job.regions)
    own = {"landmarks": job.landmarks, "boundary": job.boundary, "regions": job.regions}
    own |= {} if job.layered is None else job.layered.options(recipe.priors)
    with Progress(recipe.max_sweeps) as progress:
        found = recipe.fit_scan(
            job.scan,
            job.mesh,
            **own,
            on_stage=progress.stage,
            throw=False,
            on_sweep=progress.update,
            checkpoint=folder,
            keep_checkpoint=True,
        )
    found = found if job.layered is None else job.layered.judge(found)
    seconds = time.perf_counter() - began
    report, off = found.result.report(uncertainty=True, details=options.details), misfit(found.result)
    print(f"done     in {seconds:.1f} s{describe_ending(found, off)}\n\n{dataclasses.replace(report, warnings=[])}\n")
    save_outputs(folder, found, title, marks, job, options)
    if job.seen is not None and job.mesh is None and (rims := topology_of(found.result.control_mesh).boundary_loops):
        print(f"note     the surface has {rims} rim{'s' * (rims > 1)}: past the end of the image nothing is known")
    print_warnings(found.result)
    return make_row(title, found.result, off, seconds, options.details)


def find_done(folder: Path, marks: dict[str, str]) -> FitResult | None:
    """The fit in a folder that would come out again; None where there is none, or one that was stopped.

    Raises:
        ValueError: there is one of other inputs, or it does not say of which.
    """
    if is_unfinished(folder) or not (folder / FIT).exists():
        return None
    then = read_marks(folder)
    others = f"with another {', another '.join(find_differing(then, marks))}" if then else "that does not say of what"
    if then != marks:
        raise ValueError(
            f"{folder} holds a fit {others}. Without --resume it is fitted anew and replaced; or give another folder "
            "with -o."
        )
    return load(folder)


def make_row(name: str, result: FitResult, off: float, seconds: float | None, details: bool) -> dict[str, Any]:
    """The row of a fit in the summary: its state, and every measure with its standard deviation."""
    report = result.report()
    return {
        "scan": name,
        "status": 0 if report.trusted else 1,
        "seconds": "" if seconds is None else f"{seconds:.1f}",
        "points": report.n_points,
        "rms_mm": f"{report.rms:.4f}",
        "percentile_95_mm": f"{report.percentile_95:.4f}",
        "noise_mm": f"{report.noise:.4f}",
        "misfit_mm": f"{off:.4f}",
        "inlier_share": f"{report.inlier_share:.4f}",
        "warnings": " ".join(finding.name for finding in report.warnings),
    } | _columns_of_measures(result.measures(details=details))


def _columns_of_measures(measures: tuple[Measure, ...]) -> dict[str, str]:
    """As `volume_ml` and `volume_sd_ml`."""
    found = {}
    for one in measures:
        words = re.sub(r"[\W_]+", "_", one.name.replace("%", "")).strip("_")
        unit = re.sub(r"\W+", "_", one.unit.replace("1/", "per "))
        found |= {f"{words}_{unit}": f"{one.value:.6g}", f"{words}_sd_{unit}": f"{one.deviation:.3g}"}
    return found
