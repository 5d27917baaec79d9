"""Fit scans: `python -m fitting SCAN... [--control MESH] -o OUT`; without arguments, an example."""

import argparse
import csv
import dataclasses
import io
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxsubdiv as js
from jaxsubdiv import SCHEMES
from jaxsubdiv.console import in_colour, lasting_streams, plain_warnings, printable
from jaxsubdiv.files import replacing
from jaxsubdiv.frames import Frame, in_frame

from .image.boundary import suggest_settings
from .image.read import Seen, is_image, read_labels, read_scan, read_seen, stem
from .image.slices import Slice, cut_slices
from .image.volume import Label
from .model.limits import check_numbers
from .model.priors.boundary import BoundaryCurve, boundary_of
from .report.page import write_page
from .report.picture import draw_fit
from .report.result import FitResult
from .report.saved import read_marks, save_fit
from .run.carry import carry_landmarks
from .run.checkpoint import differing, marks_of
from .run.fit import Sweep
from .run.fit_scan import ScanFit, misfit
from .run.folder import CARRIED, FIT, LANDMARKS, SUMMARY, filling, is_unfinished, working_in
from .run.names import find_scans, name_folder, name_folders
from .run.recipe import Recipe, load, load_recipe
from .run.surface_files import FORMATS, check_formats, write_surface
from .scan.example import Example, example
from .scan.landmarks import (
    FramedLandmarks,
    Landmarks,
    match_landmarks,
    read_framed_landmarks,
    read_landmarks,
    write_landmarks,
)
from .scan.regions import Groups, match_regions, read_groups
from .scan.scan import Scan
from .start.mesh_topology import topology_of
from .start.parts import PartKind

_EXAMPLE_NOISE = 3.0  # mm: the example starts from a control mesh that is wrong, to show that the fit mends it
# What a scan, a file or a fit may be refused by, each with words of its own.
_REFUSALS = (js.MeshError, ValueError, TypeError, OSError, ImportError, RuntimeError, MemoryError)
_SUMMARY = (
    "scan",
    "status",
    "seconds",
    "points",
    "rms_mm",
    "percentile_95_mm",
    "noise_mm",
    "misfit_mm",
    "inlier_share",
    "warnings",
)


class _Source(NamedTuple):
    """Where a scan comes from."""

    path: Path
    label: Label | str | None = None
    """Of a label map."""

    def title(self, whole: bool = False) -> str:
        """The file's name, or all of its path, and the label where it is one of all."""
        name = str(self.path) if whole else self.path.name
        return f"{name}, {self.label}" if isinstance(self.label, Label) else name

    @property
    def as_file(self) -> Path:
        """A file of the same name with the label in it, which tells its folder from those of other labels."""
        if self.label is None:
            return self.path
        word = str(self.label.name or self.label.value) if isinstance(self.label, Label) else self.label
        name = f"{stem(self.path)}_{word}"
        return self.path.with_name("".join(c if c.isalnum() or c in "-_ " else "_" for c in name))


class _Job(NamedTuple):
    """One scan to fit."""

    name: str
    scan: Scan
    mesh: js.ControlMesh | None
    landmarks: Landmarks | None
    boundary: BoundaryCurve | None = None
    seen: Seen | None = None
    carried: FramedLandmarks | None = None
    """Places on the control mesh, to be carried to the fit."""
    regions: Groups | None = None


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line: exit status 0, 1 for a fit not to be trusted, 2 for an input of no use, 130 where stopped."""
    with lasting_streams(), plain_warnings():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.control and not options.scans:
        parser.error("a control mesh needs a scan to be fitted to: give SCAN to --control")
    if options.labels and not options.scans:
        parser.error("labels are those of a scan: give SCAN before --labels, which takes all the words that follow")
    if options.carry and not options.control:
        parser.error("--carry takes landmarks of a template to the scan: give the template, --control MESH")
    _keep_what_serves_again()
    try:
        _check_options(options)
        scans, recipe = _sources(options), _recipe(options)
        check_formats(options.surface)
    except (ValueError, OSError, ImportError) as error:
        return _fail(error)
    try:
        if len(scans) > 1:
            return _run_all(scans, options, recipe)
        scan = scans[0] if scans else None
        folder = Path(options.output or (name_folder(scan.as_file) if scan else f"fit_{options.example}"))
        return _run(scan, folder, options, recipe, scan.title() if scan else options.example)["status"]
    except KeyboardInterrupt:
        skips = "; with --resume it skips the scans that are done" if len(scans) > 1 else ""
        print(f"\nstopped  the same command goes on from the last sweep{skips}", file=sys.stderr)
        return 130


def _sources(options: argparse.Namespace) -> list[_Source]:
    """Every scan of the files and folders that were named, one a label where all are asked for."""
    if options.label is not None and options.above is not None:
        raise ValueError("give --label, which is of a label map, or --above, of a grey image, not both.")
    sources: list[_Source] = []
    for path in find_scans([Path(scan) for scan in options.scans]):
        if not is_image(path):
            sources.append(_Source(path))
        elif options.label != "all":
            sources.append(_Source(path, options.label))
        else:
            sources += [_Source(path, label) for label in read_labels(path)]
    return sources


def _check_options(options: argparse.Namespace) -> None:
    """See that numbers lie in their ranges, and name them as they were typed."""
    names = {"tolerance_mm": "tolerance", "most_points": "points"}
    names |= {name: name for name in ("levels", "max_sweeps", "faces", "symmetry", "likeness", "h", "surface_level")}
    names |= {name: name for name in ("scale", "control_scale")}
    typed = {name: f"--{option.replace('_', '-')}" for name, option in names.items()}
    check_numbers({name: getattr(options, option) for name, option in names.items()}, typed)
    if options.carry and os.path.abspath(options.carry) in _landmark_files(options):
        raise ValueError(f"--carry {options.carry} would be replaced by the landmarks of the fit: give another -o OUT.")


def _landmark_files(options: argparse.Namespace) -> list[str]:
    """Where the named output folder gets landmarks."""
    return [os.path.abspath(Path(options.output or "fits") / name) for name in (LANDMARKS, CARRIED)]


def _recipe(options: argparse.Namespace) -> Recipe:
    """The settings: those of a recipe, or the defaults, and before them what was given beside it."""
    recipe = Recipe(js.Interpolating()) if options.recipe is None else load_recipe(options.recipe)
    scheme = recipe.scheme if options.scheme is None else SCHEMES[options.scheme]()  # pyright: ignore[reportCallIssue]
    if options.h is not None:
        if scheme.h is None:
            raise ValueError(f"the scheme {type(scheme).__name__} has no h: leave --h out.")
        scheme = eqx.tree_at(lambda s: s.h, scheme, jnp.asarray(options.h, scheme.h.dtype))
    given = {name: getattr(options, name) for name in ("levels", "faces", "kind", "closed", "part", "max_sweeps")}
    given |= {"tolerance_mm": options.tolerance, "most_points": options.points}
    given = {name: value for name, value in given.items() if value is not None}
    if options.align is not None:
        given["pose"] = None if options.align == "none" else options.align
    if options.mirror:
        given["mirror"] = True
    asked = {name: getattr(options, name) for name in ("symmetry", "likeness") if getattr(options, name) is not None}
    if asked:
        given["priors"] = dataclasses.replace(recipe.priors, **asked)
    return dataclasses.replace(recipe, scheme=scheme, **given)


def _run_all(scans: list[_Source], options: argparse.Namespace, recipe: Recipe) -> int:
    """Every scan into a folder of its own, going on after a failure, and a table of all."""
    parent = Path(options.output or "fits")
    counts = Counter(scan.title() for scan in scans)
    titles = [scan.title(whole=counts[scan.title()] > 1) for scan in scans]
    folders = name_folders([scan.as_file for scan in scans])
    rows, summary, landmarks = [], "", []
    try:
        with working_in(parent):
            for number, (scan, title, name) in enumerate(zip(scans, titles, folders, strict=True), 1):
                print(f"\n[{number}/{len(scans)}] {scan.title(whole=True)}")
                rows.append(_run(scan, parent / name, options, recipe, title))
                summary = _as_csv(rows, _SUMMARY)
                _write_table(parent / SUMMARY, summary)  # after every scan: the run may be stopped
                if options.carry and rows[-1]["status"] < 2:
                    landmarks += _landmark_rows(parent / name / CARRIED, title)
                    columns = dict.fromkeys(column for row in landmarks for column in row)
                    _write_table(parent / CARRIED, _as_csv(landmarks, tuple(columns)))
    except (ValueError, OSError) as error:
        return _fail(error)
    print(f"\n{summary}\nwrote    {parent / SUMMARY}{f' and {CARRIED}' if landmarks else ''}")
    failed = [row["scan"] for row in rows if row["status"]]
    if failed:
        print(f"{len(failed)} of {len(rows)} did not end well: {', '.join(failed)}", file=sys.stderr)
    return max(row["status"] for row in rows)


def _fail(error: BaseException) -> int:
    """Tell why an input cannot be used: exit status 2."""
    print(f"error: {str(error) or type(error).__name__}", file=sys.stderr)
    return 2


def _as_csv(rows: list[dict], columns: Sequence[str]) -> str:
    table = io.StringIO()
    writer = csv.DictWriter(table, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return table.getvalue()


def _landmark_rows(path: Path, title: str) -> list[dict]:
    """The landmarks of one scan, as its folder has them."""
    with path.open(encoding="utf-8", newline="") as file:
        return [{"scan": title} | row for row in csv.DictReader(file)]


def _write_table(path: Path, text: str) -> None:
    """Tell where that fails, and go on: the fits of the next scans do not depend on it."""
    try:
        with replacing(path) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    except OSError as error:
        _fail(error)


def _run(scan: _Source | None, folder: Path, options: argparse.Namespace, recipe: Recipe, title: str) -> dict:
    """One fit: its row of the summary, whose status is 0, 1 for one not to be trusted, 2 for one that failed."""
    title, began = printable(title), time.perf_counter()
    try:
        with working_in(folder):
            return _fit(scan, folder, options, recipe, title)
    except _REFUSALS as error:
        status = _fail(error)
    except (Exception, SystemExit) as error:  # a fault of this software or another: it must not end the other fits
        traceback.print_exc()
        status = _fail(error)
    return {"scan": title, "status": status, "seconds": f"{time.perf_counter() - began:.1f}"}


def _fit(scan: _Source | None, folder: Path, options: argparse.Namespace, recipe: Recipe, title: str) -> dict:
    began = time.perf_counter()
    job = _inputs(scan, options, recipe)
    slices = "" if job.scan.slices is None else f" in {len(np.unique(job.scan.slices))} slices"
    print(f"scan     {job.scan.n_points:,} points{slices}, {_size(np.asarray(job.scan.points))}")
    if job.seen is not None:
        recipe = _with_suggested(recipe, job.scan, options)
    marks = _marks(job, recipe, options)
    done = _done(folder, marks) if options.resume else None
    if done is not None:
        print(f"done     before, in {folder}")
        _print_warnings(done)
        return _row(title, done, misfit(done), None)
    if job.mesh is not None:
        print(f"control  {len(job.mesh.vertices):,} vertices, {job.mesh.n_faces:,} faces, {_size(job.mesh.vertices)}")
        _print_regions(job.scan, job.mesh, job.regions)
    with _Progress(recipe.max_sweeps) as progress:
        found = recipe.fit_scan(
            job.scan,
            job.mesh,
            landmarks=job.landmarks,
            boundary=job.boundary,
            regions=job.regions,
            on_stage=progress.stage,
            throw=False,
            on_sweep=progress.update,
            checkpoint=folder,
            keep_checkpoint=True,
        )
    seconds = time.perf_counter() - began
    report, off = found.result.report(uncertainty=True), misfit(found.result)
    print(f"done     in {seconds:.1f} s{_ending(found, off)}\n\n{dataclasses.replace(report, warnings=[])}\n")
    _save(folder, found, title, marks, job, options)
    if job.seen is not None and job.mesh is None and (rims := topology_of(found.result.control_mesh).boundary_loops):
        print(f"note     the surface has {rims} rim{'s' * (rims > 1)}: past the end of the image nothing is known")
    _print_warnings(found.result)
    return _row(title, found.result, off, seconds)


def _print_regions(scan: Scan, mesh: js.ControlMesh, groups: Groups | None) -> None:
    """Tell of each label of the scan how many points it has, and which of the template's groups it is of."""
    match = match_regions(scan, mesh, groups)
    if match is None or scan.regions is None:
        return
    found = dict(match.groups)
    for label, n in zip(scan.regions.names, scan.regions.counts(), strict=True):
        where = f"on {' and '.join(found[label])}" if label in found else "no group's, paired with any face"
        print(f"region   {label}: {n:,} points, {where}")


def _slices_of(job: _Job, result: FitResult) -> Sequence[Slice]:
    """Of the image, where there was one."""
    if job.seen is None:
        return ()
    return cut_slices(job.seen.volume, np.asarray(result.surface.vertices, np.float64), label=job.seen.label)


def _print_warnings(result: FitResult) -> None:
    for finding in result.warnings:
        print(in_colour(f"WARNING  {finding.text}"))


def _row(name: str, result: FitResult, off: float, seconds: float | None) -> dict:
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
    }


def _marks(job: _Job, recipe: Recipe, options: argparse.Namespace) -> dict[str, str]:
    """What tells this fit from any other, by the names of what went in."""
    inputs = {f"{name} of the scan": value for name, value in vars(job.scan).items() if name != "regions"}
    if job.mesh is not None and (match := match_regions(job.scan, job.mesh, job.regions)) is not None:
        inputs["regions"] = match, job.scan.regions  # labels that no fit looks at are none of its inputs
    inputs["control mesh"] = None if job.mesh is None else (job.mesh.vertices, job.mesh.faces, job.mesh.normals)
    inputs |= {"landmarks": job.landmarks, "boundary": job.boundary}
    inputs |= {} if job.carried is None else {"carried landmarks": job.carried}
    if (options.surface, options.surface_level) != (["ply"], None):
        inputs["surface format or level"] = options.surface, options.surface_level
    return marks_of(inputs | {field.name: getattr(recipe, field.name) for field in dataclasses.fields(recipe)})


def _done(folder: Path, marks: dict[str, str]) -> FitResult | None:
    """The fit in a folder that would come out again; None where there is none, or one that was stopped.

    Raises:
        ValueError: there is one of other inputs, or it does not say of which.
    """
    if is_unfinished(folder) or not (folder / FIT).exists():
        return None
    then = read_marks(folder)
    others = f"with another {', another '.join(differing(then, marks))}" if then else "that does not say of what"
    if then != marks:
        raise ValueError(
            f"{folder} holds a fit {others}. Without --resume it is fitted anew and replaced; or give another folder "
            "with -o."
        )
    return load(folder)


def _with_suggested(recipe: Recipe, scan: Scan, options: argparse.Namespace) -> Recipe:
    """What suits an image, where neither the options nor a recipe say otherwise."""
    given = {"faces": options.faces, "most_points": options.points}
    if options.recipe is not None:
        return recipe
    return dataclasses.replace(
        recipe, **{name: value for name, value in suggest_settings(scan).items() if given[name] is None}
    )


def _inputs(scan: _Source | None, options: argparse.Namespace, recipe: Recipe) -> _Job:
    if scan is None:
        print(
            f"example  {options.example}, its control vertices moved by noise of {_EXAMPLE_NOISE:g} mm in each "
            "coordinate"
        )
        points, mesh = example(options.example)
        noise = np.random.default_rng(0).normal(scale=_EXAMPLE_NOISE, size=mesh.vertices.shape)
        return _Job(options.example, points, js.ControlMesh(mesh.vertices + noise, mesh.faces, mesh.normals), None)
    file, seen = scan.path, None
    if is_image(file) and not options.labels:
        seen = read_seen(file, scale=options.scale, label=scan.label, above=options.above)
        points = seen.scan
    else:
        points = read_scan(file, scale=options.scale, labels=options.labels, label=options.label, above=options.above)
    mesh, of_mesh = _template(options, recipe, points.frame)
    landmarks = carried = None
    if (options.landmarks is None) != (options.control_landmarks is None) or (options.landmarks and mesh is None):
        raise ValueError(
            "landmarks are places on both sides: give --landmarks FILE for the scan, --control-landmarks FILE for the "
            "control mesh, and --control MESH."
        )
    if options.landmarks is not None:
        landmarks = match_landmarks(
            read_landmarks(options.landmarks, scale=options.scale, frame=points.frame),
            read_landmarks(options.control_landmarks, scale=options.control_scale, frame=of_mesh),
        )
    if options.carry is not None:
        carried = read_framed_landmarks(options.carry, scale=options.control_scale, frame=of_mesh)
    if mesh is None and (options.symmetry is not None or options.likeness is not None):
        which = "symmetry" if options.symmetry is not None else "likeness"
        raise ValueError(f"{which} is that of a template: give --control MESH to --{which}.")
    regions = None
    if options.regions is not None:
        if mesh is None:
            raise ValueError("regions are groups of a template's faces: give --control MESH to --regions.")
        regions = read_groups(options.regions)
    boundary = None
    if options.boundary == "scan":
        boundary = BoundaryCurve(boundary_of(js.read_mesh(file, scale=options.scale, check=False)))
    elif options.boundary is not None:
        boundary = BoundaryCurve(js.read_points(options.boundary, scale=options.scale).points)
    return _Job(scan.title(), points, mesh, landmarks, boundary, seen, carried, regions)


def _template(
    options: argparse.Namespace, recipe: Recipe, of_scan: Frame | None
) -> tuple[js.ControlMesh | None, Frame | None]:
    """The template in the frame of the scan where both files say theirs, and the frame that it is in."""
    if options.control is None:
        return None, None
    mesh, own = js.read_mesh(options.control, scale=options.control_scale), js.read_frame(options.control)
    if own is None:  # a template that stays where it is lies in the frame of the scan
        return mesh, of_scan if recipe.pose is None else None
    if of_scan is None or own == of_scan:
        return mesh, own
    print(f"note     the control mesh was turned from {own}, as its file says, to the scan's {of_scan}")
    normals = None if mesh.normals is None else in_frame(mesh.normals, own, of_scan)
    turned = in_frame(mesh.vertices, own, of_scan)
    return js.ControlMesh(turned, mesh.faces, normals, regions=mesh.regions), of_scan


def _ending(found: ScanFit, off: float) -> str:
    if found.outcome is None:
        return ""
    return f"; split {found.splits} times, {found.outcome}: the surface is {off:.3f} mm off the scan beside the noise"


def _save(
    folder: Path, found: ScanFit, title: str, marks: dict[str, str], job: _Job, options: argparse.Namespace
) -> None:
    """The fit as files, all of them in place of those of an earlier one, or none."""
    result, frame = found.result, job.scan.frame or (job.carried.frame if job.carried is not None else None)
    slices = _slices_of(job, result)
    with filling(folder) as new:
        js.write_mesh(new / "control.obj", result.control_mesh, frame=frame)
        written = ["control.obj", *_write_surface(new, result, options, frame)]
        written += ["report.json", "fit.html", "fit.npz", "recipe.json"]
        if job.carried is not None and job.mesh is not None:
            there = carry_landmarks(job.mesh, result, job.carried.positions)
            for name in (LANDMARKS, CARRIED):
                write_landmarks(new / name, there.positions, frame=frame, deviations=there.deviations)
                written.append(name)
        (new / "report.json").write_text(result.report(uncertainty=True).as_json() + "\n", encoding="utf-8")
        write_page(new / "fit.html", result, title=title, start=found.start, slices=slices)
        assert result.recipe is not None
        save_fit(new, result.fit, result.recipe, marks)
        try:
            draw_fit(result, found.start, title=title, slices=slices).savefig(new / "fit.png")
            written.append("fit.png")
        except ImportError as error:
            print(f"note     no picture: {error}")
    print(f"wrote    {', '.join(written)} in {folder}")


def _write_surface(folder: Path, result: FitResult, options: argparse.Namespace, frame: Frame | None) -> list[str]:
    """The surface's files; where it has no such level, told, none: the fit itself is not lost."""
    try:
        return write_surface(folder, result.at_level(options.surface_level), options.surface, frame)
    except (ValueError, MemoryError) as error:
        print(f"note     no surface: {str(error) or 'it takes more memory than there is'}")
        return []


class _Progress:
    """A bar where tqdm is installed, else a line a sweep."""

    def __init__(self, max_sweeps: int):
        self._max_sweeps = max_sweeps

    def __enter__(self) -> "_Progress":
        try:
            from tqdm import tqdm
        except ImportError:
            self._bar = None
        else:
            self._bar = tqdm(total=self._max_sweeps, unit="sweep", desc="sweeps at most", leave=False, disable=None)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    @property
    def stage(self) -> Callable[[str], None]:
        return self._stage

    @property
    def update(self) -> Callable[[Sweep], None]:
        return self._update

    def _stage(self, words: str) -> None:
        text = f"now      {words}"
        if self._bar is None:
            print(text)
        else:
            self._bar.reset()
            self._bar.write(text)

    def _update(self, sweep: Sweep) -> None:
        if self._bar is None:
            print(f"sweep {sweep.number:3d}  RMS {sweep.rms:.3f} mm")
        else:
            self._bar.set_postfix_str(f"RMS {sweep.rms:.3f} mm")
            self._bar.update(sweep.number - self._bar.n)  # a fit that goes on does not begin at 1


def _size(points: np.ndarray) -> str:
    return " x ".join(f"{extent:.0f}" for extent in np.ptp(points, axis=0)) + " mm"


def _keep_what_serves_again() -> None:
    """Keep freed memory, and compiled programs from run to run, unless the environment says where already."""
    js.keep_freed_memory()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and (cache := _make_cache()) is not None:
        jax.config.update("jax_compilation_cache_dir", str(cache))
    # A fit compiles many small programs besides few large ones: they are kept too.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _make_cache() -> Path | None:
    """The folder of compiled programs; None where the user has no home folder, or may not write there."""
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxsubdiv"
        cache.mkdir(parents=True, exist_ok=True)
    except (RuntimeError, OSError):
        return None
    return cache if os.access(cache, os.W_OK) else None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv-fit",
        description="Fit a control mesh, with its normals and h, to a scan, so that its smooth subdivision surface is "
        "the anatomy. The control mesh is aligned with the scan first, or made from it where none is given. Without "
        "SCAN it runs an example that ships with the package.",
        epilog="OUT gets control.obj (fitted control mesh with normals), surface.ply (refined surface, with the signed "
        "distance of the scan and the standard deviation of the surface in mm at every vertex, as in .glb, .vtp and "
        ".shape.gii), report.json, fit.html (a page to turn the surface in, without a network), fit.png, and fit.npz "
        "and recipe.json for `fitting.load`; with --carry landmarks.mrk.json and landmarks.csv; of several scans, a "
        "folder each, named by the scan, and where names are alike by its folders too, and summary.csv, and "
        "landmarks.csv with all landmarks. Files take their places together when a fit has ended; until then "
        "checkpoints mark OUT as "
        "unfinished. Lengths are in mm. A fit that was stopped, by Ctrl-C or otherwise, goes on from the last sweep "
        "when the same command is given again. Exit status: 0 the fit converged and nothing speaks against it, 1 it "
        "is not to be trusted (the warnings say why; files are written all the same), 2 an input cannot be used, 130 "
        "stopped by Ctrl-C.",
    )
    add = parser.add_argument
    add(
        "scans",
        nargs="*",
        metavar="SCAN",
        help="points, meshes, label maps or images, or folders of them: .ply .xyz .csv .vtp .nii.gz .nrrd",
    )
    add("--control", metavar="MESH", help="template of triangles and quads to start from; default: made from the scan")
    add("-o", "--output", metavar="OUT", help="folder for the results (default: fit_ and the scan's file, or fits)")
    add("--faces", type=int, help=f"of the control mesh, where it is made (default: {Recipe.faces})")
    add("--kind", choices=("triangle", "quad"), help=f"of these faces (default: {Recipe.kind})")
    add("--closed", action=argparse.BooleanOptionalAction, help="whether the anatomy is; default: found from the scan")
    add("--part", choices=get_args(PartKind), help="of a scan that shows several; default: the largest, with a warning")
    add("--mirror", action="store_true", help="fit the template's mirror image: that of the other side of the body")
    add("--align", choices=("similarity", "rigid", "affine", "none"), help=f"of the template (default: {Recipe.pose})")
    add("--landmarks", metavar="FILE", help="named places on the scan: .mrk.json .json .csv .tsv .fcsv")
    add("--control-landmarks", metavar="FILE", help="the same names on the template")
    add(
        "--carry",
        metavar="FILE",
        help="landmarks on the template, put onto the fitted surface: landmarks.mrk.json and landmarks.csv in OUT",
    )
    add("--symmetry", type=float, metavar="MM", help="keep the fit as symmetric as the template, but for so much")
    add(
        "--likeness",
        type=float,
        metavar="SHARE",
        help="of the template's own shape, expected of the fit; default: found. 0 where it was made from this scan",
    )
    add("--boundary", metavar="FILE", help="points of the curve that the open surface ends at; `scan`: the scan's rim")
    add("--tolerance", type=float, metavar="MM", help="split the control mesh until the surface is this near the scan")
    add("--points", type=int, metavar="N", help="fit no more than so many, drawn at random; all of them are measured")
    add("--labels", nargs="+", metavar="WORD", default=[], help="only rows of a table whose label holds one of these")
    add(
        "--regions",
        metavar="FILE",
        help="JSON, label of the scan: group of the template's faces; default: by the names",
    )
    add("--label", metavar="LABEL", help="of a label map: a value, a name, or `all`, a fit each; default: the only one")
    add(
        "--above", type=float, metavar="VALUE", help="of a grey image: the value at the surface, which is lower outside"
    )
    add("--scale", type=float, default=1.0, help="multiplies the scan's coordinates; 1000 for metres")
    add("--control-scale", type=float, default=1.0, help="multiplies the control mesh's coordinates")
    add("--levels", type=int, help=f"levels of refinement, 1 to 8 (default: {Recipe.levels})")
    add(
        "--surface",
        nargs="+",
        metavar="FORMAT",
        choices=FORMATS,
        default=["ply"],
        help=f"of the surface's files: {', '.join(FORMATS)} (default: ply)",
    )
    add(
        "--surface-level",
        type=int,
        metavar="N",
        help="levels of the surface that is written, 0 to 8 (default: those of the fit)",
    )
    add("--scheme", choices=tuple(SCHEMES), help="default: interpolating")
    add("--h", type=float, help="tangent length coefficient at the start, for schemes that have one (default: 1)")
    add("--max-sweeps", type=int, help=f"pairing and solving in turns (default: {Recipe.max_sweeps})")
    add(
        "--recipe", metavar="FILE", help="recipe.json of a fit: its settings; files, --scale and --labels are not in it"
    )
    add(
        "--resume",
        action="store_true",
        help="skip the scans that OUT has whole fits of, from the same inputs and options",
    )
    add("--example", choices=get_args(Example), default="head_fragment", help="which, without SCAN")
    return parser


if __name__ == "__main__":
    sys.exit(main())
