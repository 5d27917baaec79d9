"""`fit`: steps the solver `Sweeps` until the surface has come to rest, with progress and checkpoints."""

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

import jaxsubdiv as js
from jaxsubdiv.linalg import unit
from jaxsubdiv.notices import warn

from ..finding import Origin
from ..model.limits import check_numbers
from ..model.pairing import Scene, make_scene
from ..model.priors import Priors
from ..model.priors.boundary import BoundaryCurve, check_curve
from ..model.priors.landmarks import anchor_landmarks
from ..model.priors.shifts import find_slice_planes
from ..model.priors.symmetry import Symmetry, find_symmetry, symmetry_of
from ..model.recipe import Settings
from ..model.residual import Model, analyse
from ..model.robust import AbstractLoss, geman_mcclure
from ..model.unknowns import Free, Variables
from ..report.record import Fit, choose_faces
from ..report.result import FitResult
from ..scan.landmarks import Landmarks
from ..scan.regions import RegionMatch
from ..scan.scan import Scan, ScanError
from ..solve.collision_free import make_guard
from ..solve.conjugate_gradients import ConjugateGradients
from ..solve.pilot import FromPilot
from ..solve.sparse_normal import SparseNormal
from ..solve.strengths import FromScan, first_strengths
from ..solve.structure import find_structure
from ..solve.sweeps import State, Subject, Sweeps, hold_priors, subject_residual
from ..start.folds import Folds, unfold_start
from .checkpoint import Checkpoint
from .sizes import check_sizes

LinearSolver: TypeAlias = Literal["sparse", "conjugate gradients"]

# Of conjugate gradients, where one fit is to come to the host's surface: of the gradient, or as near as its precision.
_TIGHT, _ROUNDING, _MOST_STEPS = 1e-6, 1e3, 1000
# A start that is off by more than this part of the control mesh's size is not roughly aligned.
_FAR = 0.05
# Scans in metres against a mesh in mm differ by 1000; a partial scan of the anatomy by much less than this.
_UNIT_RATIO = 20.0
_LEAST_MARGIN = 0.05  # of a control normal at the start; see `js.admissible_margin`
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
    regions: RegionMatch | None = None,
    layers: Sequence[str] | None = None,
    linear_solver: LinearSolver | None = None,
    max_sweeps: int = 60,
    tolerance: float = 0.1,
    throw: bool = True,
    on_sweep: Callable[[Sweep], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    keep_checkpoint: bool = False,
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
        regions: which control faces the points of each label of the scan lie on, by `match_regions`: they are paired
            with the closest place of these. Points of other labels, or of none, are paired with any.
        layers: regions that lie one around the other, from the inside out: what lies between two that follow each other
            changes its thickness little from place to place, see `Priors.thickness`. `fit_layers` makes them.
        linear_solver: "sparse" solves the normal equations of each sweep on the host, "conjugate gradients" pairs and
            solves where JAX computes; default: "sparse" on the CPU, else the other. Both come to the same surface.
        max_sweeps: how many sweeps at most.
        tolerance: converged once a sweep, annealed, moves nine tenths of the surface, and the RMS distance, by less
            than this part of the surface's uncertainty, which is about noise / sqrt(points a control vertex), or of a
            hundredth of a control edge, where that is more; and no more than of a tenth of one.
        throw: raise where the fit did not converge, or return the reason in `FitResult.result`.
        on_sweep: called after every sweep, for progress.
        checkpoint: a folder that keeps the state after every sweep in `checkpoint.npz`. Called again with the same
            arguments, a fit that was stopped goes on from there, to the same result bit for bit. The file goes when
            the fit has ended.
        keep_checkpoint: leave the file even then, for a caller that saves the result before it removes it.

    Raises:
        UserWarning: the start is so far off that the fit will hardly find its way; or faces of the control mesh lie
            upside down on their neighbours, which the fit turns back at its start, as far as it can.
        ScanError: the sizes of scan and control mesh differ as by a wrong unit, or there are too few points.
        ImportError: `Priors.contact` is not 0, and ipctk, of the extra `contact`, is not installed.
        ValueError: a number is out of its range; the topology has no levels, or does not fit the control; the control
            mesh has no symmetry, though the priors ask for it; the checkpoint is of another fit.
        RuntimeError: with `throw`, the fit did not converge or met values that are not finite.
    """
    check_numbers({"max_sweeps": max_sweeps, "tolerance": tolerance, "landmark_deviation": landmark_deviation})
    check(scheme, topology, control, scan)
    # Made here and not in the signature: arrays made while a module loads would settle JAX's device and precision.
    free, priors, loss = free or Free(), priors or Priors(), loss or geman_mcclure()
    symmetry = find_partners(symmetry, priors, topology, control)
    if alike is not None and alike.shape != (topology.n_control_faces,):
        n_faces = topology.n_control_faces
        raise ValueError(f"`alike` must say it of each of the {n_faces} control faces; got {list(alike.shape)}.")
    check_regions(regions, topology)
    layers = check_layers(layers, regions)
    control = sound_start(scheme, topology, control, free)
    settings = {"free": free, "priors": priors, "loss": loss, "max_sweeps": max_sweeps, "tolerance": tolerance}
    settings["landmark_deviation"] = landmark_deviation
    given = {"scheme": scheme, "topology": topology, "control": control, "scan": scan, "landmarks": landmarks}
    given |= {"symmetry": symmetry, "boundary": boundary, "alike": alike, "solver": linear_solver, "regions": regions}
    given |= {"layers": layers} if layers else {}
    kept = None if checkpoint is None else Checkpoint(Path(checkpoint) / CHECKPOINT, given | settings)
    inputs = gather_inputs(scheme, topology, control, scan, free, landmarks, landmark_deviation, boundary)
    inputs |= {"symmetry": symmetry, "alike": alike, "regions": regions, "layers": layers}
    model, y = analyse(scheme, topology, control, free, priors, inputs)
    scene = make_scene(scan, model.refine(y), inputs["slices"], choose_faces(regions, model, y, scan))
    solver = make_solver(model, y, scene, linear_solver, loss, tolerance, max_sweeps)
    subject, nothing = Subject(model, scene), frozenset()
    state = solver.init(subject_residual, y, subject, {}, None, None, nothing)
    if kept is not None and (before := kept.read_tree((y, state))) is not None:
        y, state = before
    y, state, result = run_sweeps(solver, subject, y, state, control, on_sweep, kept)
    if kept is not None and not keep_checkpoint:
        kept.remove()
    told = Settings.of(scheme, topology, **settings)
    record = record_fit(model, y, state, scene, scan, control, inputs, told, result)
    if isinstance(solver.linear_solver, SparseNormal):
        record = dataclasses.replace(record, structure=solver.linear_solver.structure)
    found = FitResult(record)
    if throw:
        refuse_unfinished(found)
    return found


def run_sweeps(
    solver: Sweeps,
    subject: Subject,
    y: Variables,
    state: State,
    control: js.Control,
    on_sweep: Callable[[Sweep], None] | None,
    kept: Checkpoint | None = None,
) -> tuple[Variables, State, optx.RESULTS]:
    """Step a solver until the surface has come to rest.

    Args:
        control: where the fit started.
        on_sweep: called after every sweep.
        kept: where the state after every sweep is kept.
    """
    nothing = frozenset()
    # Where JAX solves, a sweep is one program; on the host it is many small ones between sparse matrices.
    step = solver.step if isinstance(solver.linear_solver, SparseNormal) else eqx.filter_jit(solver.step)
    done, result = False, optx.RESULTS.successful
    while not done:
        k = int(state.sweep)
        moved = float(state.moved)
        y, state, _ = step(subject_residual, y, subject, {}, state, nothing)
        done, result = solver.terminate(subject_residual, y, subject, {}, state, nothing)
        if k == 0:
            _warn_if_far(float(np.median(np.abs(state.look.distances))), control)
        elif on_sweep is not None:
            on_sweep(Sweep(k, float(state.robust_rms[k]), moved))
        if kept is not None and not done:
            kept.write_tree((y, state))
    return y, state, result


def refuse_unfinished(found: FitResult) -> None:
    """Raise where a fit did not converge."""
    if found.result != optx.RESULTS.successful:
        rms = found.rms
        raise RuntimeError(
            f"the fit did not converge in {len(rms) - 1} sweeps (RMS {rms[0]:.3f} -> {rms[-1]:.3f} mm): "
            f"{found.report().reason}. Give more `max_sweeps`, a better start, or throw=False to get what there is."
        )


def make_solver(
    model: Model,
    y: Variables,
    scene: Scene,
    linear_solver: LinearSolver | None,
    loss: AbstractLoss,
    tolerance: float,
    max_sweeps: int,
    strengths: FromScan | FromPilot | None = None,
) -> Sweeps:
    """The solver of a fit, whose strengths by default follow from the scan."""
    guard = make_guard(model, y)
    if linear_solver is None:
        on_host = guard is not None or jax.default_backend() == "cpu"
        linear_solver = "sparse" if on_host else "conjugate gradients"
    if linear_solver == "sparse":
        held, _ = hold_priors(model, y, model.refine(y), first_strengths(model).values, scene)
        solver = SparseNormal(find_structure(model, y, held))
    elif guard is not None:
        raise ValueError('`Priors.contact` takes the sparse solver: leave `linear_solver` out, or say "sparse".')
    else:
        eps = float(jnp.finfo(y.control.vertices.dtype).eps)
        solver = ConjugateGradients(max(_TIGHT, _ROUNDING * eps), _MOST_STEPS)
    return Sweeps(
        linear_solver=solver,
        strengths=strengths or FromScan(),
        loss=loss,
        rtol=tolerance,
        max_sweeps=max_sweeps,
        folds=Folds(model.topology),
        guard=guard,
    )


def gather_inputs(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    control: js.Control,
    scan: Scan,
    free: Free,
    landmarks: Landmarks | None,
    landmark_deviation: float,
    boundary: BoundaryCurve | None,
) -> dict[str, Any]:
    """What belongs to one scan alone, checked; see `Start.inputs`."""
    surface = js.refine(scheme, topology, control)
    return {
        "landmarks": None
        if landmarks is None
        else anchor_landmarks(landmarks, landmark_deviation, topology, control, surface),
        "boundary": None if boundary is None else check_curve(boundary, topology),
        "slices": find_slice_planes(scan) if free.shifts else None,
    }


def record_fit(
    model: Model,
    y: Variables,
    state: State,
    scene: Scene,
    scan: Scan,
    start: js.Control,
    inputs: dict[str, Any],
    settings: Settings,
    result: optx.RESULTS,
    origin: Origin | None = None,
) -> Fit:
    """What a solver found, as data on the host."""
    state = jax.tree.map(np.asarray, state)
    n = int(state.sweep)
    return Fit(
        model=model,
        y=y,
        scene=scene,
        look=state.look,
        strengths=state.strengths,
        hold=np.asarray(state.damping.hold),
        shifting=bool(state.shifting),
        scan=scan,
        start=start,
        inputs=inputs,
        settings=settings,
        rms=state.rms[:n],
        robust_rms=state.robust_rms[:n],
        result=result,
        origin=origin or Origin(),
    )


def check_regions(regions: RegionMatch | None, topology: js.Topology) -> None:
    """Refuses regions of another control mesh."""
    if regions is not None and len(regions.faces) != topology.n_control_faces:
        raise ValueError(
            f"`regions` are of {len(regions.faces)} control faces, and the topology has {topology.n_control_faces}. "
            "Match the scan with the control mesh that the topology was made from."
        )


def check_layers(layers: Sequence[str] | None, regions: RegionMatch | None) -> tuple[str, ...]:
    """The names of layers, each a region."""
    names = tuple(layers or ())
    there = () if regions is None else regions.faces.names
    lost = [name for name in names if name not in there]
    if lost:
        raise ValueError(
            f"the layer '{lost[0]}' is no region of the control mesh; it has {', '.join(there) or 'none'}. Give "
            "`regions`, by `match_regions`, or fit by `fit_layers`."
        )
    if len(names) == 1 or len(set(names)) < len(names):
        raise ValueError(f"`layers` are two regions or more, each once, from the inside out; got {', '.join(names)}.")
    return names


def find_partners(
    symmetry: Symmetry | None, priors: Priors, topology: js.Topology, control: js.Control
) -> Symmetry | None:
    """Those that the prior ties, where there is one."""
    if not np.isfinite(priors.symmetry):
        if symmetry is not None:
            raise ValueError("`symmetry` says who is whose image; say how near in mm, too: Priors(symmetry=1.0).")
        return None
    if symmetry is None:
        return find_symmetry(js.ControlMesh(control.vertices, topology.control_faces, check=False))
    return symmetry_of(symmetry.partner, np.asarray(control.vertices))


def sound_start(scheme: js.AbstractScheme, topology: js.Topology, control: js.Control, free: Free) -> js.Control:
    """The control mesh without faces upside down, with unit normals that fold nothing."""
    may_move = free.masks(scheme, topology.n_control_vertices)["vertices"]
    control = unfold_start(topology, control, may_move)
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
        warn(
            f"half of the scan lies over {off:.3g} mm from the surface at the start, which is {size:.3g} mm across: "
            "points will be paired with the wrong places. Align the control mesh with the scan first; axes named in "
            "another order or a mirrored side are common causes.",
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
    check_sizes(scan, control)
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
    # Of the scan without its outermost points: a lone one far off must not look like another unit.
    inner = np.diff(np.quantile(np.asarray(scan.points), [0.01, 0.99], axis=0), axis=0)
    ratio = float(np.linalg.norm(inner) or sizes[0]) / sizes[1]
    if not 1 / _UNIT_RATIO <= ratio <= _UNIT_RATIO:
        raise ScanError(
            f"the scan measures {sizes[0]:.4g} across and the control mesh {sizes[1]:.4g}: their units differ, it "
            "seems. Both must be in mm; read the file that is not with `scale=` (1000 for metres)."
        )
