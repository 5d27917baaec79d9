"""`fit_series`: one anatomy in many frames, fitted at once by one control mesh."""

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

import jaxsubdiv as js
from jaxsubdiv.notices import warn

from ..finding import Origin
from ..model.limits import check_numbers
from ..model.pairing import make_scene
from ..model.priors import Priors
from ..model.priors.shifts import ShiftPrior, SlicePlanes, find_slice_planes
from ..model.priors.valves import ValvePoints
from ..model.recipe import Settings
from ..model.residual import Model, analyse
from ..model.robust import AbstractLoss, geman_mcclure
from ..model.unknowns import Free, Variables
from ..report.record import choose_faces
from ..report.result import FitResult
from ..report.series import SeriesFit
from ..scan.frames import Frames, check_slices, copies_of_faces, copy_mesh, place_frames
from ..scan.regions import Groups, RegionMatch, match_regions
from ..scan.scan import Scan, ScanError
from ..solve.pilot import FromPilot
from ..solve.sparse_normal import SparseNormal
from ..solve.strengths import FromTargets
from ..solve.sweeps import Subject, subject_residual
from ..start.align import Kind, align
from ..start.cavities import find_parts, find_valves
from .checkpoint import Checkpoint
from .fit import (
    CHECKPOINT,
    Sweep,
    check,
    fit,
    gather_inputs,
    make_solver,
    record_fit,
    refuse_unfinished,
    run_sweeps,
    sound_start,
)
from .fit_scan import CHECKPOINT_START, first_control

_FEWEST = 10  # points of a frame
_FEW = 0.4  # of the points of most frames


def fit_series(
    scans: Sequence[Scan],
    mesh: js.ControlMesh,
    *,
    names: Sequence[str] | None = None,
    periodic: bool = False,
    scheme: js.AbstractScheme | None = None,
    levels: int = 2,
    pose: Kind | None = Settings.pose,
    regions: Groups | None = None,
    valves: Sequence[str] | None = None,
    valve_deviation: float = 0.5,
    free: Free | None = None,
    priors: Priors | None = None,
    loss: AbstractLoss | None = None,
    max_sweeps: int = 60,
    tolerance: float = 0.1,
    throw: bool = True,
    on_stage: Callable[[str], None] | None = None,
    on_sweep: Callable[[Sweep], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    keep_checkpoint: bool = False,
) -> SeriesFit:
    """Fit the frames of a series, such as those of a heart through its beat, by one control mesh.

    All frames are fitted at once. A slice of the scans has one shift for all frames; control vertices move by little
    from frame to frame (`Priors.frame_change`), which is found from the scans unless it is given. The template is
    aligned with the first frame, for all. A fit of that frame alone finds how smooth the surface is, place by place.

    Args:
        scans: of the frames in their order, in mm. A slice has the same number in all of them.
        mesh: the template.
        names: of the frames, for texts and tables. Default: their numbers.
        periodic: whether the first frame follows the last, as in a beat.
        scheme: default: `js.Interpolating()`.
        levels: of refinement.
        pose: how the template may move to the first frame before the fit, see `align`; None leaves it where it is.
        regions: as in `fit_scan`.
        valves: the template's groups that are valves, as `find_valves` takes them; default: those whose names say so.
            Points whose label is of a valve lie on the rim of that, where it meets the lining of a cavity.
        valve_deviation: how far they may be off it, as a standard deviation in mm.
        free, loss, max_sweeps, tolerance, on_sweep: as in `fit`.
        priors: as in `fit`; neither shape nor symmetry.
        throw: raise where the fit did not converge.
        on_stage: told what begins, in a few words.
        checkpoint: a folder from which a call with the same arguments goes on where it was stopped, see `fit`; what the
            first frame told is in it too, in `checkpoint_start.npz`.
        keep_checkpoint: leave both files when the fit has ended, see `fit`.

    Raises:
        ScanError: there are fewer than two frames; a frame has too few points, no slices though others have them, or a
            slice in another plane; the text names the frame.
        ValueError: as `fit_scan`; or the priors ask for shape or symmetry; or the checkpoint is of another series.
        RuntimeError: with `throw`, the fit did not converge.

    Warns:
        UserWarning: a frame has far fewer points than the others.
    """
    check_numbers({"levels": levels, "max_sweeps": max_sweeps, "tolerance": tolerance})
    names = [f"frame {k}" for k in range(len(scans))] if names is None else list(names)
    _check_frames(scans, names)
    free, priors, loss = free or Free(), priors or Priors(), loss or geman_mcclure()
    if float(priors.contact) > 0:
        raise ValueError(
            "a series is fitted without `Priors.contact`: its surfaces may cross themselves. Leave it out."
        )
    if priors.shape is not None or np.isfinite(priors.symmetry):
        raise ValueError("a series is fitted without `Priors.shape` and `Priors.symmetry`: leave them out.")
    valves = find_valves(mesh, valves)
    say, scheme = on_stage or (lambda words: None), scheme or js.Interpolating()
    match_regions(scans[0], mesh, regions)  # before anything is computed: what cannot be matched is told at once
    told = {"free": free, "priors": priors, "loss": loss, "max_sweeps": max_sweeps, "tolerance": tolerance}
    kept = kept_sweeps = before = None
    if checkpoint is not None:
        inputs = {"frames": list(scans), "mesh": (mesh.vertices, mesh.faces, mesh.normals, mesh.regions)}
        inputs |= {"scheme": scheme, "levels": levels, "pose": pose, "regions": regions, "periodic": periodic}
        inputs |= {"valves": valves, "valve_deviation": valve_deviation} | told
        kept, kept_sweeps = (Checkpoint(Path(checkpoint) / name, inputs) for name in (CHECKPOINT_START, CHECKPOINT))
        before = kept.read()
    if before is not None:
        say("goes on where it was stopped")
    first = before or _fit_first(scans[0], mesh, scheme, levels, pose, regions, told, say)
    if kept is not None and before is None:
        kept.write(first)
    origin = Origin.from_json(str(first["origin"]))
    normals = first.get("template_normals")
    mesh = js.ControlMesh(first["template"], mesh.faces, normals, check=False, regions=mesh.regions)
    scan, frames = place_frames(scans, periodic)
    n = len(scans)
    say(f"fits {n} frames, {n * len(mesh.vertices):,} control vertices")
    whole = copy_mesh(mesh, frames)
    tables = js.build_topology(js.ControlMesh(whole.vertices, whole.faces), scheme, levels)
    placed = first_control(mesh, scheme)
    control = js.Control(jnp.asarray(frames.copy_rows(np.asarray(placed.vertices))), jnp.tile(placed.normals, (n, 1)))
    check(scheme, tables, control, scan)
    control = sound_start(scheme, tables, control, free)
    inputs = gather_inputs(scheme, tables, control, scan, free, None, 1.0, None)
    match = match_regions(scan, whole, regions)
    inputs |= {"regions": match, "frames": frames}
    inputs["slices"] = find_slice_planes(frames.place_back(scan)) if free.shifts else None
    inputs["valves"], scan = _take_valve_points(scan, mesh, match, valves, valve_deviation, inputs["slices"], n)
    model, y = analyse(scheme, tables, control, free, priors, inputs)
    y = _start_at(first, y, frames)
    scene = make_scene(scan, model.refine(y), inputs["slices"], choose_faces(match, model, y, scan))
    strengths = FromPilot(_targets(first, model, n))
    solver = make_solver(model, y, scene, None, loss, tolerance, max_sweeps, strengths)
    subject = Subject(model, scene)
    state = solver.init(subject_residual, y, subject, {}, None, None, frozenset())
    if kept_sweeps is not None and (stopped := kept_sweeps.read_tree((y, state))) is not None:
        y, state = stopped
    y, state, ended = run_sweeps(solver, subject, y, state, control, on_sweep, kept_sweeps)
    settings = Settings.of(scheme, tables, **told)
    record = record_fit(model, y, state, scene, scan, control, inputs, settings, ended, origin)
    if isinstance(solver.linear_solver, SparseNormal):
        record = dataclasses.replace(record, structure=solver.linear_solver.structure)
    result = FitResult(record)
    if kept is not None and kept_sweeps is not None and not keep_checkpoint:
        kept.remove()
        kept_sweeps.remove()
    if throw:
        refuse_unfinished(result)
    return SeriesFit(result, tuple(names), valves)


def _fit_first(
    scan: Scan,
    mesh: js.ControlMesh,
    scheme: js.AbstractScheme,
    levels: int,
    pose: Kind | None,
    regions: Groups | None,
    told: dict[str, Any],
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Align the template with the first frame and fit that alone: arrays for the start of all frames, by name.

    Args:
        told: what `fit` takes.
    """
    origin = Origin()
    if pose is not None:
        say("aligns the control mesh with the first frame")
        alignment = align(mesh, scan, kind=pose)
        mesh, origin = alignment.mesh, Origin(alignment.pose, alignment.doubts)
    say("fits the first frame")
    topology = js.build_topology(js.ControlMesh(mesh.vertices, mesh.faces), scheme, levels)
    match = match_regions(scan, mesh, regions)
    pilot = fit(scheme, topology, first_control(mesh, scheme), scan, regions=match, throw=False, **told)
    found = {
        "origin": origin.to_json(),
        "template": mesh.vertices,
        "template_normals": mesh.normals,
        "vertices": np.asarray(pilot.control.vertices) - _common_motion(pilot),
        "normals": pilot.control.normals,
        "h": pilot.fit.y.shared.get("h"),
        "determined": pilot.fit.strengths.determined,
    }
    strengths = {f"strength {name}": value for name, value in pilot.fit.strengths.values.items()}
    return {name: np.asarray(value) for name, value in (found | strengths).items() if value is not None}


def _take_valve_points(
    scan: Scan,
    mesh: js.ControlMesh,
    match: RegionMatch | None,
    names: Sequence[str],
    deviation: float,
    planes: SlicePlanes | None,
    n: int,
) -> tuple[ValvePoints | None, Scan]:
    """The points of all frames that lie on rims of valves, and the scan in which these no longer count."""
    if match is None or scan.regions is None or not names:
        return None, scan
    valve_of = {label: groups[0] for label, groups in match.groups if len(groups) == 1 and groups[0] in names}
    words = scan.regions.words()
    rows = np.array([word in valve_of for word in words]) & (np.asarray(scan.weights_or_ones()) > 0)
    parts = find_parts(mesh, names)
    beside = [part for part in parts if part.is_cavity] or list(parts)
    if not rows.any() or not beside:
        return None, scan
    region = np.array(mesh.regions.words() if mesh.regions is not None else [])

    def copy_faces(faces: Bool[np.ndarray, "f"]) -> Bool[np.ndarray, "g"]:
        return copies_of_faces(faces, mesh.faces[3], n)

    given = ValvePoints(
        np.asarray(scan.points, np.float64)[rows],
        (np.full(scan.n_points, -1) if planes is None else planes.rows_of(scan))[rows],
        np.array([names.index(valve_of[word]) for word, is_valve in zip(words, rows, strict=True) if is_valve]),
        np.stack([copy_faces(region == name) for name in names]),
        copy_faces(np.any([part.faces for part in beside], axis=0)),
        deviation,
    )
    weights = np.where(rows, 0.0, np.asarray(scan.weights_or_ones()))
    return given, dataclasses.replace(scan, weights=weights)


def _start_at(first: dict[str, Any], y: Variables, frames: Frames) -> Variables:
    """The variables of all frames where those of the first one ended, less the motion that its slices have in common.

    That motion is hardly known from the scan, and little by little only would the prior of the shifts take it back.
    """
    normals = jnp.tile(jnp.asarray(first["normals"]), (len(frames.counts), 1))
    shared = {name: jnp.asarray(first["h"]) if name == "h" else value for name, value in y.shared.items()}
    return Variables(js.Control(jnp.asarray(frames.copy_rows(first["vertices"])), normals), shared)


def _common_motion(result: FitResult) -> Float[np.ndarray, "3"]:
    """The motion of all points whose components within the planes of the slices are nearest to their shifts, in mm."""
    prior = result.fit.model.prior("shift")
    if not isinstance(prior, ShiftPrior) or not result.fit.shifting:
        return np.zeros(3)
    planes = np.asarray(prior.planes, np.float64).reshape(-1, 3)
    return np.linalg.lstsq(planes, np.asarray(result.fit.y.shared["shifts"], np.float64).ravel(), rcond=1e-3)[0]


def _targets(first: dict[str, Any], model: Model, n: int) -> FromTargets:
    """The strengths of one frame's priors for all frames."""
    found = {name.removeprefix("strength "): value for name, value in first.items() if name.startswith("strength ")}
    triangles = np.asarray(model.topology.control_faces[3])[: len(model.topology.control_faces[3]) // n]
    values = {}
    for prior in model.priors:
        if not prior.n_strengths:
            continue
        given = prior.given_strengths()
        if given is not None:
            values[prior.name] = given
        elif prior.n_strengths == model.topology.n_control_faces:
            values[prior.name] = copies_of_faces(found[prior.name], triangles, n)
        elif prior.name in found:
            values[prior.name] = found[prior.name]
    return FromTargets(values, found["likeness"], n * first["determined"])


def _check_frames(scans: Sequence[Scan], names: Sequence[str]) -> None:
    if len(scans) < 2:
        raise ScanError(f"a series has two frames or more; got {len(scans)}. Fit a single frame by `fit_scan`.")
    if len(names) != len(scans):
        raise ValueError(f"there are {len(scans)} frames and {len(names)} names: give one each.")
    counts = np.array([int((np.asarray(scan.weights_or_ones()) > 0).sum()) for scan in scans])
    usual = float(np.median(counts))
    for name, count in zip(names, counts, strict=True):
        if count < _FEWEST:
            raise ScanError(
                f"{name}: the frame has {count} points, where most have {usual:.0f}. Leave the frame out, or give more."
            )
    few = [f"{name} ({count})" for name, count in zip(names, counts, strict=True) if count < _FEW * usual]
    if few:
        warn(
            f"{', '.join(few)}: far fewer points than most frames have, {usual:.0f}. The surface there follows from "
            "the frames before and after: look at its standard deviations.",
        )
    check_slices(scans, names)
