"""`fit`: pairing on the host, derivatives on the device and a sparse solution on the host, in turns."""

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

import jaxsubdiv as js
from jaxsubdiv import corner_weights
from jaxsubdiv.linalg import dot, unit

from ..model.pairing import Look
from ..model.priors.boundary import BoundaryCurve, checked_curve
from ..model.priors.shifts import find_shifts
from ..model.priors.symmetry import Symmetry, find_symmetry, symmetry_of
from ..model.recipe import Recipe
from ..model.residual import Anchors, Priors
from ..model.robust import AbstractLoss, geman_mcclure
from ..model.unknowns import Free, apply_offset
from ..model.view import View
from ..report.result import FitResult
from ..scan.closest_points import closest_points
from ..scan.landmarks import Landmarks, place_landmarks
from ..scan.scan import Scan, ScanError
from ..solve.problem import Memory, Problem
from ..start.folds import unfolded_start
from .checkpoint import Checkpoint

# A start that is off by more than this part of the control mesh's size is not roughly aligned.
_FAR = 0.05
# Scans in metres against a mesh in mm differ by 1000; a partial scan of the anatomy by much less than this.
_UNIT_RATIO = 20.0
# Movements far below a control edge are at rest, however exact the scan.
AT_REST = 0.01
_LEAST_MARGIN = 0.05  # of a control normal at the start; see `js.admissible_margin`
_MOST = 0.9  # of the surface: so much of it has to be at rest
CHECKPOINT = "checkpoint.npz"


class Sweep(NamedTuple):
    """What `on_sweep` is told after every sweep."""

    number: int
    rms: float
    """Root mean square distance in mm, every point by its robust weight."""
    moved: float
    """How far the surface moved, across itself: nine tenths of it by less than this, in mm."""


def fit(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    control: js.Control,
    scan: Scan,
    *,
    free: Free | None = None,
    priors: Priors | None = None,
    loss: AbstractLoss | None = None,
    landmarks: Landmarks | None = None,
    landmark_deviation: float = 1.0,
    symmetry: Symmetry | None = None,
    boundary: BoundaryCurve | None = None,
    alike: Bool[np.ndarray, "f"] | None = None,
    max_sweeps: int = 60,
    tolerance: float = 0.1,
    throw: bool = True,
    on_sweep: Callable[[Sweep], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> FitResult:
    """Fit a control mesh, its normals and h to a scan, so that the refined surface passes through the points.

    Every sweep pairs each scan point with the closest point of the surface, and takes a Gauss-Newton step, exactly
    solved, on the distances across the surface and on the priors. Points far out beyond the noise lose weight by a
    robust loss, whose scale is the noise that the distances show; it falls to that from a large one, sweep by sweep
    (graduated non-convexity), so that a start that is far off is not taken for outliers. How smooth the surface is
    follows from the scan, unless the priors say it.

    Where the scan has slices, as of cine MRI, each is shifted within its plane to where it fits the surface and its
    neighbours best: once the scale of the loss has fallen to the noise, the shifts are found together with the surface.
    Where that lies as a whole is known from the slices' mean place, as far as `Priors.shift` says.

    Args:
        scheme: the scheme; its h is where the fit starts.
        topology: tables of the control mesh, of one level or more.
        control: where the fit starts, roughly aligned with the scan and in mm.
        scan: the measured points in mm.
        free: what may move; default: all of `Free()`.
        priors: what is known of the surface beforehand; default: `Priors()`.
        loss: how a point loses weight with its distance; default: `geman_mcclure()`.
        landmarks: places on the scan and on the control mesh where it starts, which the fit keeps together.
        landmark_deviation: how far they may be apart, as a standard deviation in mm; a weight divides its square.
        symmetry: the partners that `Priors.symmetry` ties; default, where it is given: those that `find_symmetry` finds
            on the control mesh where the fit starts.
        boundary: a curve that the open surface ends at: its boundary follows from the points of the curve, and scan
            points beyond it do not count.
        alike: control faces whose shape where the fit starts says what to expect, see `Priors.likeness`; triangles
            first. Default: all.
        max_sweeps: how many sweeps at most.
        tolerance: converged once a sweep, annealed, moves nine tenths of the surface, and the RMS distance, by less
            than this part of the surface's uncertainty, which is about noise / sqrt(points a control vertex); or of a
            hundredth of a control edge, where that is more.
        throw: raise where the fit did not converge, or return the reason in `FitResult.result`.
        on_sweep: called after every sweep, for progress.
        checkpoint: a folder that keeps the state after every sweep in `checkpoint.npz`. Called again with the same
            arguments, a fit that was stopped goes on from there, to the same result bit for bit. The file goes when
            the fit has ended.

    Raises:
        UserWarning: the start is so far off that the fit will hardly find its way; or faces of the control mesh lie
            upside down on their neighbours, which the fit turns back at its start, as far as it can.
        ScanError: the sizes of scan and control mesh differ as by a wrong unit, or there are too few points.
        ValueError: the topology has no levels, or does not fit the control; the control mesh has no symmetry, though
            the priors ask for it; the checkpoint is of another fit.
        RuntimeError: with `throw`, the fit did not converge or met values that are not finite.
    """
    check(scheme, topology, control, scan)
    # Made here and not in the signature: arrays made while a module loads would settle JAX's device and precision.
    free, priors, loss = free or Free(), priors or Priors(), loss or geman_mcclure()
    symmetry = _partners(symmetry, priors, topology, control)
    if alike is not None and alike.shape != (topology.n_control_faces,):
        n_faces = topology.n_control_faces
        raise ValueError(f"`alike` must say it of each of the {n_faces} control faces; got {list(alike.shape)}.")
    control = sound_start(scheme, topology, control, free)
    settings = {"free": free, "priors": priors, "loss": loss, "max_sweeps": max_sweeps, "tolerance": tolerance}
    settings["landmark_deviation"] = landmark_deviation
    recipe = Recipe.of(scheme, topology, **settings)
    given = {"scheme": scheme, "topology": topology, "control": control, "scan": scan, "landmarks": landmarks}
    given |= {"symmetry": symmetry, "boundary": boundary, "alike": alike}
    kept = None if checkpoint is None else Checkpoint(Path(checkpoint) / CHECKPOINT, given | settings)
    before = None if kept is None else kept.read()
    start = control
    surface = js.refine(scheme, topology, control)
    edge = float(js.edge_length(topology, control.vertices))
    curve = None if boundary is None else checked_curve(boundary, topology)
    view = View(scan, surface, edge, loss, curve)
    seen = view.seen_from(surface)
    widest = float(seen.scale)  # a robust scale of the start's own error: outliers must not widen it
    _warn_if_far(float(np.median(np.abs(seen.distances))), control)
    rms, robust_rms, result = [float(seen.rms)], [float(seen.robust_rms)], optx.RESULTS.nonlinear_max_steps_reached
    anchors = None if landmarks is None else _anchors(landmarks, landmark_deviation, topology, control, surface)
    problem = Problem(scheme, topology, control, free, priors, anchors, symmetry, curve, alike)
    waiting, shifts = find_shifts(scan) if free.shifts else None, None
    if before is not None:
        scheme, control, rms, robust_rms = _recalled(before, problem, scheme, control)
        if waiting is not None and "within" in before:
            waiting, shifts = None, waiting.recalled(before)
        surface = js.refine(scheme, topology, control)
        seen = view.seen_from(surface, _floor(widest, len(rms) - 1), shifts)
    for sweep in range(len(rms) - 1, max_sweeps):
        step, shifted = problem.step(scheme, control, seen, shifts)
        proposed = _apply(topology, scheme, control, step)
        refined = js.refine(proposed[0], topology, proposed[1])
        if not np.isfinite(refined.vertices).all():
            result = optx.RESULTS.nonfinite  # what the last sound sweep found is what comes back
            break
        moved = float(surface_moved(surface, refined))
        (scheme, control), surface, shifts = proposed, refined, shifted
        floor = _floor(widest, sweep + 1)
        seen = view.seen_from(surface, floor, shifts)
        rms.append(float(seen.rms))
        robust_rms.append(float(seen.robust_rms))
        if on_sweep is not None:
            on_sweep(Sweep(sweep + 1, robust_rms[-1], moved))
        at_noise = floor <= max(float(seen.noise), view.least_scale)
        annealed = problem.annealed and at_noise and waiting is None
        at_rest = tolerance * max(_uncertainty(seen, control), AT_REST * edge)
        if annealed and max(moved, abs(robust_rms[-1] - robust_rms[-2])) <= at_rest:
            result = optx.RESULTS.successful
            break
        if waiting is not None and at_noise:
            # Not before, where the start is off and everything would be taken for shifts; nor when the surface has come
            # to rest, for it has bent to the slices that are off.
            waiting, shifts = None, waiting
        if kept is not None:
            now = {"vertices": control.vertices, "normals": control.normals, "h": scheme.h}
            now |= {} if shifts is None else shifts.memory()
            kept.write(now | {"rms": rms, "robust_rms": robust_rms} | problem.memory()._asdict())
    if kept is not None:
        kept.remove()
    found = FitResult(
        control=control,
        scheme=scheme,
        surface=surface,
        scan=scan,
        rms=np.array(rms),
        robust_rms=np.array(robust_rms),
        result=result,
        problem=problem,
        seen=seen,
        recipe=recipe,
        start=start,
        shifts=shifts,
    )
    if throw and result != optx.RESULTS.successful:
        raise RuntimeError(
            f"the fit did not converge in {len(rms) - 1} sweeps (RMS {rms[0]:.3f} -> {rms[-1]:.3f} mm): "
            f"{found.report().reason}. Give more `max_sweeps`, a better start, or throw=False to get what there is."
        )
    return found


_apply = eqx.filter_jit(apply_offset)


def _floor(widest: float, sweep: int) -> float:
    """Least scale of the loss after a sweep: half of what it was after the one before."""
    return widest * 0.5**sweep


def _recalled(
    before: dict[str, np.ndarray], problem: Problem, scheme: js.AbstractScheme, control: js.Control
) -> tuple[js.AbstractScheme, js.Control, list[float], list[float]]:
    """Scheme, control and RMS distances of a fit that was stopped; its problem takes up what it knew."""
    memory = Memory._make(before[name] for name in Memory._fields)
    numbers = {"likeness": float(memory.likeness), "determined": float(memory.determined)}
    memory = memory._replace(**numbers, annealed=bool(memory.annealed))
    problem.recall(memory, scheme, control)
    if scheme.h is not None:
        scheme = eqx.tree_at(lambda s: s.h, scheme, jnp.asarray(before["h"]))
    control = js.Control(jnp.asarray(before["vertices"]), jnp.asarray(before["normals"]))
    return scheme, control, before["rms"].tolist(), before["robust_rms"].tolist()


def _partners(symmetry: Symmetry | None, priors: Priors, topology: js.Topology, control: js.Control) -> Symmetry | None:
    """Those that the prior ties, where there is one."""
    if not np.isfinite(priors.symmetry):
        if symmetry is not None:
            raise ValueError("`symmetry` says who is whose image; say how near in mm, too: Priors(symmetry=1.0).")
        return None
    if symmetry is None:
        return find_symmetry(js.ControlMesh(control.vertices, topology.control_faces, check=False))
    return symmetry_of(symmetry.partner, np.asarray(control.vertices))


@eqx.filter_jit
def surface_moved(before: js.RefinedSurface, after: js.RefinedSurface) -> Float[Array, ""]:
    """How far a surface moved across itself: nine tenths of its vertices by less than this.

    The rest may be where the control mesh is too coarse for the scan, and points change sides for ever.
    """
    return jnp.quantile(jnp.abs(dot(after.normals, after.vertices - before.vertices)), _MOST)


def _uncertainty(seen: Look, control: js.Control) -> float:
    """About how well the scan determines the surface, in mm."""
    counted = max(float(np.sum(np.asarray(seen.weights) > 0)), 1.0)
    return float(seen.scale) * (control.vertices.shape[0] / counted) ** 0.5


def _anchors(
    landmarks: Landmarks,
    deviation: float,
    topology: js.Topology,
    control: js.Control,
    surface: js.RefinedSurface,
) -> Anchors:
    """Landmarks at the places of the surface that are closest to theirs on the control mesh."""
    placed = place_landmarks(landmarks, js.ControlMesh(control.vertices, topology.control_faces, check=False))
    counted = placed.weights > 0
    at = closest_points(surface, placed.mesh[counted])
    corners, weights = corner_weights(surface, at)
    dtype = control.vertices.dtype
    points = jnp.asarray(placed.scan[counted], dtype)
    deviations = jnp.asarray(deviation / np.sqrt(placed.weights[counted]), dtype)
    return Anchors(points, at.face, corners, weights, deviations)


def sound_start(scheme: js.AbstractScheme, topology: js.Topology, control: js.Control, free: Free) -> js.Control:
    """The control mesh without faces upside down, with unit normals that fold nothing."""
    control = unfolded_start(scheme, topology, control, free)
    return js.Control(control.vertices, given_normals(topology, control))


def given_normals(topology: js.Topology, control: js.Control) -> Float[Array, "v 3"]:
    """Unit normals; from the faces where a control vertex has none, or has one that would fold the surface."""
    normals = np.asarray(unit(control.normals))
    mesh = js.ControlMesh(control.vertices, topology.control_faces, check=False)
    usable = js.admissible_margin(mesh, js.Control(control.vertices, normals)) > _LEAST_MARGIN
    of_faces = js.estimate_normals(topology.control_fans, control.vertices)
    return jnp.where(jnp.asarray(usable)[:, None], normals, of_faces)


def _warn_if_far(off: float, control: js.Control) -> None:
    size = float(np.linalg.norm(np.ptp(np.asarray(control.vertices), axis=0)))
    if off > _FAR * size:
        warnings.warn(
            f"half of the scan lies over {off:.3g} mm from the surface at the start, which is {size:.3g} mm across: "
            "points will be paired with the wrong places. Align the control mesh with the scan first; axes named in "
            "another order or a mirrored side are common causes.",
            stacklevel=3,
        )


def check(scheme: js.AbstractScheme, topology: js.Topology, control: js.Control, scan: Scan) -> None:
    if not topology.levels:
        raise ValueError("a fit needs a topology of one level or more; this one has none. Two or three serve well.")
    if topology.has_seams:
        raise ValueError(
            "a mesh with seams cannot be fitted: its copies of one vertex would come apart. Fit without seams, or with "
            "`js.Loop()` or `js.CatmullClark()`, whose `js.Creases` keep one vertex a place."
        )
    eqx.filter_eval_shape(js.refine, scheme, topology, control)  # for its checks of the shapes
    # The solver keeps its own state in the default dtype, and cannot mix it with another.
    dtypes, default = (control.vertices.dtype, scan.points.dtype), jnp.result_type(float)
    if any(dtype != default for dtype in dtypes):
        raise ValueError(
            f"control mesh and scan must have JAX's default floating dtype, {default}; got {dtypes[0]} and {dtypes[1]}."
        )
    if not all(np.isfinite(values).all() for values in jax.tree.leaves((control.vertices, scheme))):
        raise ValueError("the control vertices or h are not finite: there is no surface to start from.")
    n_needed = control.vertices.shape[0]
    if scan.n_points < n_needed:
        raise ScanError(
            f"the scan has {scan.n_points} points for {n_needed} control vertices. Fit a coarser control mesh, or "
            "measure more points: fewer points than vertices leave most of the surface to the priors."
        )
    sizes = [float(np.linalg.norm(np.ptp(np.asarray(rows), axis=0))) for rows in (scan.points, control.vertices)]
    if sizes[0] == 0:
        raise ScanError("all scan points lie on one spot. Check the columns of the file.")
    if sizes[1] == 0:
        raise ValueError("all control vertices lie on one spot: there is no surface to start from.")
    ratio = sizes[0] / sizes[1]
    if not 1 / _UNIT_RATIO <= ratio <= _UNIT_RATIO:
        raise ScanError(
            f"the scan measures {sizes[0]:.4g} across and the control mesh {sizes[1]:.4g}: their units differ, it "
            "seems. Both must be in mm; read the file that is not with `scale=` (1000 for metres)."
        )
