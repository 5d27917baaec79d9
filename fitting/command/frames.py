"""A series of the command: all its frames in one fit, and its files."""

import argparse
import time
from pathlib import Path

import jaxsubdiv as js

from ..report.animation import animate_series
from ..report.series import SeriesFit, load_series
from ..report.series_page import write_series_page
from ..run.checkpoint import marks_of
from ..run.folder import ANIMATION, FRAMES, PAGE_OF_SERIES, TABLE_OF_SERIES, fill_folder, reserve_folder
from ..run.names import name_folders
from ..run.recipe import Recipe
from ..run.series import fit_series
from .inputs import Source, mark_job, read_inputs
from .messages import print_regions, print_warnings, report_failure
from .one import REFUSALS, is_done
from .progress import Progress


def fit_frames(scans: list[Source], options: argparse.Namespace, recipe: Recipe) -> int:
    """All frames in one fit: exit status 0, 1 for one not to be trusted, 2 for one that failed."""
    folder = Path(options.output or "series")
    try:
        with reserve_folder(folder):
            return _fit_and_save(scans, folder, options, recipe)
    except REFUSALS as error:
        return report_failure(error)


def _fit_and_save(scans: list[Source], folder: Path, options: argparse.Namespace, recipe: Recipe) -> int:
    began = time.perf_counter()
    names = name_folders([scan.as_file for scan in scans])
    jobs = [read_inputs(scan, options, recipe) for scan in scans]
    for name, job in zip(names, jobs, strict=True):
        print(f"frame    {name}: {job.scan.n_points:,} points")
    mesh = jobs[0].mesh
    assert mesh is not None
    print_regions(jobs[0].scan, mesh, jobs[0].regions)
    own = {"frames": [mark_job(job, recipe, options) for job in jobs], "names of the frames": names}
    marks = marks_of(own | {"periodic": options.periodic, "valves": options.valves, "levels": options.levels})
    if options.resume and is_done(folder, marks):
        print(f"done     before, in {folder}")
        found = load_series(folder)
        print_warnings(found.result)
        return 0 if found.result.trusted else 1
    with Progress(recipe.max_sweeps) as progress:
        found = fit_series(
            [job.scan for job in jobs],
            mesh,
            names=names,
            periodic=options.periodic,
            scheme=recipe.scheme,
            levels=2 if options.levels is None and options.recipe is None else recipe.levels,
            pose=recipe.pose,
            regions=jobs[0].regions,
            valves=options.valves,
            free=recipe.free,
            priors=recipe.priors,
            loss=recipe.loss,
            max_sweeps=recipe.max_sweeps,
            tolerance=recipe.tolerance,
            throw=False,
            on_stage=progress.stage,
            on_sweep=progress.update,
            checkpoint=folder,
            keep_checkpoint=True,
        )
    print(f"done     in {time.perf_counter() - began:.1f} s\n\n{found.table}\n")
    _save(folder, found, marks)
    print_warnings(found.result)
    return 0 if found.result.trusted else 1


def _save(folder: Path, found: SeriesFit, marks: dict[str, str]) -> None:
    """The series and its frames as files, all of them in place of those of an earlier one, or none."""
    with fill_folder(folder) as new:
        (new / FRAMES).mkdir()
        for number, name in enumerate(found.names):
            js.write_mesh(new / FRAMES / f"{name}.obj", found.control_mesh(number), frame=found.result.scan.frame)
            js.write_mesh(new / FRAMES / f"{name}.ply", found.surface(number), frame=found.result.scan.frame)
        found.save(new, marks=marks)
        found.table.write_csv(new / TABLE_OF_SERIES)
        animation = None
        try:
            animation = animate_series(found)
            (new / ANIMATION).write_bytes(animation)
        except ImportError as error:
            print(f"note     no animation: {error}")
        write_series_page(new / PAGE_OF_SERIES, found, title=folder.name, animation=animation)
    print(f"wrote    the series, and {FRAMES}/ with the control mesh and surface of every frame, in {folder}")
