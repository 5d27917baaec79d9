"""`fit_cohort`: one control mesh fitted to many scans in one compiled call of `Sweeps`, by optimistix.

It minimises the same rows as `fit`, with the same robust weights, annealed alike. Two things are simpler, for the sake
of one program for all: the strengths of the priors are given, or found once by an ordinary fit; and a sweep's normal
equations are solved by conjugate gradients, without a matrix, not further than a sweep deserves.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax

import jaxsubdiv as js
from jaxsubdiv.errors import name_rows
from jaxsubdiv.notices import warn

from ..model.limits import check_numbers
from ..model.pairing import Look, Scene, make_scene
from ..model.priors import Priors
from ..model.priors.boundary import BoundaryCurve
from ..model.priors.symmetry import Symmetry
from ..model.recipe import Settings
from ..model.residual import Model, analyse
from ..model.robust import AbstractLoss, geman_mcclure
from ..model.unknowns import Free, Variables
from ..report.cohort import Cohort, name_subjects
from ..report.evidence import rests_far_off
from ..report.record import Fit, choose_faces
from ..report.result import FitResult
from ..scan.landmarks import Landmarks
from ..scan.regions import RegionMatch
from ..scan.scan import Scan, ScanError
from ..solve.conjugate_gradients import ConjugateGradients
from ..solve.strengths import FromTargets
from ..solve.sweeps import CONVERGED, NONFINITE, State, Subject, Sweeps, loose_damping, subject_residual
from ..start.folds import Folds
from .fit import check, check_regions, find_partners, gather_inputs, record_fit, sound_start
from .pilot import make_pilot
from .stack import fill_choices, fill_scene, fill_up, split_common

# Of the gradient, squared sums: tighter solves of a sweep, whose pairs change anyway, take longer in all.
_SOLVED, _MOST_STEPS = 0.03, 200
_ROUND = 256  # scans are filled up to a multiple of it: cohorts of nearly equal lengths share a program
_T = TypeVar("_T")


def fit_cohort(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    controls: js.Control | Sequence[js.Control],
    scans: Sequence[Scan],
    *,
    free: Free | None = None,
    priors: Priors | None = None,
    pilot: FitResult | None = None,
    landmarks: Landmarks | Sequence[Landmarks] | None = None,
    landmark_deviation: float = 1.0,
    symmetry: Symmetry | None = None,
    boundary: BoundaryCurve | Sequence[BoundaryCurve] | None = None,
    regions: RegionMatch | Sequence[RegionMatch | None] | None = None,
    names: Sequence[str] | None = None,
    loss: AbstractLoss | None = None,
    max_sweeps: int = 60,
    tolerance: float = 0.1,
    at_once: int = 1,
) -> Cohort:
    """Fit one control mesh to many scans, in one compiled call.

    Compiling takes as long as several fits, and is done again for another number of subjects. After that each takes a
    fraction of the time of `fit`, and is as near to the truth.

    Args:
        scheme, topology: as in `fit`.
        controls: where the fits start: one control for all, or one a scan, aligned with it (see `align`).
        scans: in mm. They may differ in length; all have normals, or none.
        free, loss, max_sweeps, tolerance: as in `fit`.
        priors: as in `fit`; strengths that `fit` would find from the scan are those of the pilot, place by place: with
            `bend=None`, the default, the smoothness; with `likeness=None` how much of each control mesh's own shape is
            expected of it; and how far shapes may be from their modes.
        pilot: an ordinary fit of the same control mesh; default, where it is needed: that of the first scan. One whose
            start was fitted to its own scan is replaced.
        landmarks, boundary, regions: as in `fit`, one a scan; or one for all.
        names: of the scans, for tables and folders; default: their numbers.
        landmark_deviation, symmetry: as in `fit`, for all; symmetry is by default that of the first control mesh.
        at_once: how many subjects share each operation, as the memory allows: on an accelerator many; on a CPU one at
            a time is as fast, and stops when it has converged.

    Warns:
        UserWarning: some fits did not converge; it names them, and `Cohort.converged` has them. Or the control mesh was
            fitted to the pilot's own scan, so that the pilot is replaced. Or faces of a control mesh lie upside down,
            see `fit`.

    Raises:
        ScanError: a scan cannot be fitted; the text names it by its number. Or some have normals and others none.
        ValueError: as in `fit`; or the numbers of scans, controls, landmarks, boundaries and regions differ.
    """
    check_numbers({"max_sweeps": max_sweeps, "tolerance": tolerance, "landmark_deviation": landmark_deviation})
    check_numbers({"at_once": at_once})
    free, priors, loss = free or Free(), priors or Priors(), loss or geman_mcclure()
    n = len(scans)
    controls = _check_one_each(controls, js.Control, n, "controls")
    for i, (control, scan) in enumerate(zip(controls, scans, strict=True)):
        try:
            check(scheme, topology, control, scan)
        except ScanError as error:
            raise ScanError(f"scan {i}: {error}") from error
    given = [scan.normals is not None for scan in scans]
    if any(given) and not all(given):
        raise ScanError(f"scan {given.index(False)} has no normals and others have: give all of them normals, or none.")
    sound = {}
    for control in controls:  # mostly the same one for all
        if id(control) not in sound:
            sound[id(control)] = sound_start(scheme, topology, control, free)
    controls = [sound[id(control)] for control in controls]
    named = name_subjects(n, names)
    places = [None] * n if landmarks is None else _check_one_each(landmarks, Landmarks, n, "landmarks")
    curves = [None] * n if boundary is None else _check_one_each(boundary, BoundaryCurve, n, "boundaries")
    matches = [None] * n if regions is None else _check_one_each(regions, RegionMatch, n, "regions")
    for match in matches:
        check_regions(match, topology)
    partners = find_partners(symmetry, priors, topology, controls[0])
    settings = {"free": free, "priors": priors, "loss": loss, "max_sweeps": max_sweeps, "tolerance": tolerance}
    settings["landmark_deviation"] = landmark_deviation
    inputs = []
    for control, scan, place, curve, match in zip(controls, scans, places, curves, matches, strict=True):
        own = gather_inputs(scheme, topology, control, scan, free, place, landmark_deviation, curve)
        own |= {"symmetry": partners, "alike": None if pilot is None else pilot.fit.inputs.get("alike")}
        inputs.append(own | {"regions": match})
    made = [
        analyse(scheme, topology, control, free, priors, own) for control, own in zip(controls, inputs, strict=True)
    ]
    if pilot is not None or any(one.n_strengths and one.given_strengths() is None for one in made[0][0].priors):
        of_each = [
            {"landmarks": place, "boundary": curve, "symmetry": partners, "regions": match}
            for place, curve, match in zip(places, curves, matches, strict=True)
        ]
        pilot = make_pilot(scheme, topology, controls, scans, of_each, settings, pilot)
    filled = [
        analyse(scheme, topology, control, free, priors, own)
        for control, own in zip(controls, fill_up(inputs), strict=True)
    ]
    without = () if pilot is None or priors.bend is not None or "height" in pilot.fit.strengths.values else ("height",)
    models = [_leave_out(model, without) for model, _ in made]
    size = -(-max(scan.n_points for scan in scans) // _ROUND) * _ROUND
    scenes = [
        make_scene(scan, model.refine(y), own["slices"], choose_faces(own["regions"], model, y, scan))
        for scan, own, (model, y) in zip(scans, inputs, made, strict=True)
    ]
    choices = fill_choices([scene.choice for scene in scenes], [scan.n_points for scan in scans])
    has_slices = any(scene.of_points is not None for scene in scenes)
    subjects = [
        (_leave_out(model, without), fill_scene(scene._replace(choice=choice), size, has_slices), y)
        for scene, choice, (model, y) in zip(scenes, choices, filled, strict=True)
    ]
    subjects += subjects[-1:] * (-n % at_once)
    solver = Sweeps(
        linear_solver=ConjugateGradients(_SOLVED, _MOST_STEPS),
        strengths=find_targets(models[0], priors, pilot),
        loss=loss,
        rtol=jnp.asarray(tolerance, controls[0].vertices.dtype),
        max_sweeps=max_sweeps,
        folds=Folds(topology),
    )
    shared, own = split_common(subjects)
    values, states = jax.tree.map(lambda rows: rows[:n], _run(solver, shared, own, at_once))
    surfaces = jax.vmap(lambda y: subjects[0][0].refine(y))(values)
    rows_of, states = jax.tree.map(np.asarray, (values, states))  # rows of JAX arrays would be one program each
    ends = [_find_ending(models[i], scenes[i], jax.tree.map(lambda rows, i=i: rows[i], states)) for i in range(n)]
    converged = np.array([bool(end == optx.RESULTS.successful) for end in ends])
    if not converged.all():
        which = np.flatnonzero(~converged)
        warn(
            f"{len(which)} of {n} fits did not converge, of the scans {name_rows(which)}: see `Cohort.converged`. "
            "Align them better, or give more `max_sweeps`.",
        )
    told = Settings.of(scheme, topology, **settings)

    def fit_of(i: int) -> Fit:
        y, state = jax.tree.map(lambda rows: rows[i], (rows_of, states))
        y = _cut(models[i], jax.tree.map(jnp.asarray, y))
        cut = _cut_look(state.look, scans[i].n_points), _cut_hold(models[i], state)
        state = eqx.tree_at(lambda one: (one.look, one.damping.hold), state, cut)
        return record_fit(models[i], y, state, scenes[i], scans[i], controls[i], inputs[i], told, ends[i])

    return Cohort(
        control=values.control,
        h=values.shared.get("h"),
        surfaces=js.RefinedSurface(surfaces.vertices, surfaces.normals, topology.faces),
        converged=converged,
        sweeps=states.sweep - 1,
        rms=states.rms,
        robust_rms=states.robust_rms,
        noise=states.look.noise,
        weights=states.look.weights,
        scans=tuple(scans),
        names=named,
        _results=lambda i: FitResult(fit_of(i)),
    )


def find_targets(model: Model, priors: Priors, pilot: FitResult | None) -> FromTargets:
    """Strengths of the priors, and what is expected of bends: as given, or as the pilot found them."""
    told = {} if pilot is None else pilot.fit.strengths.values
    values = {}
    for prior in model.priors:
        if prior.n_strengths:
            given = prior.given_strengths()
            values[prior.name] = told.get(prior.name, prior.first_strengths()) if given is None else given
    likeness = priors.likeness
    if likeness is None:
        likeness = told.get("likeness", 0.0) if priors.bend is None else 0.0
    determined = 0.0 if pilot is None else pilot.fit.strengths.determined
    dtype = model.template.dtype
    values, likeness, determined = jax.tree.map(lambda x: jnp.asarray(x, dtype), (values, likeness, determined))
    return FromTargets(values, likeness, determined)


@eqx.filter_jit
def _run(solver: Sweeps, shared: Any, own: Any, at_once: int) -> tuple[Variables, State]:
    def fit_one(own: Any) -> tuple[Variables, State]:
        model, scene, y = eqx.combine(shared, own)
        subject = Subject(model, scene)
        found = optx.least_squares(subject_residual, solver, y, subject, max_steps=None, throw=False)
        return found.value, found.stats["state"]

    return lax.map(fit_one, own, batch_size=None if at_once == 1 else at_once)


def _find_ending(model: Model, scene: Scene, state: State) -> optx.RESULTS:
    """Why a subject's fit ended. One that nothing moved from far off has come to rest, and has not converged."""
    if state.status != CONVERGED:
        return optx.RESULTS.nonfinite if state.status == NONFINITE else optx.RESULTS.nonlinear_max_steps_reached
    if rests_far_off(scene, float(state.look.noise), float(model.edge), state.robust_rms[: state.sweep]):
        return optx.RESULTS.nonlinear_divergence
    return optx.RESULTS.successful


def _check_one_each(given: _T | Sequence[_T], kind: type, n: int, name: str) -> list[_T]:
    """One for each scan."""
    values = [given] * n if isinstance(given, kind) else list(given)  # pyright: ignore[reportArgumentType]
    if len(values) != n or not n:
        raise ValueError(f"there are {n} scans and {len(values)} {name}: give one or more, and one each.")
    return values  # pyright: ignore[reportReturnType]


def _leave_out(model: Model, names: tuple[str, ...]) -> Model:
    kept = tuple(prior for prior in model.priors if prior.name not in names)
    return Model(model.scheme, model.topology, kept, model.layout, model.is_free, model.template, model.edge)


def _cut(model: Model, y: Variables) -> Variables:
    """Variables without what only filled up an array."""
    sizes = {name: of.shape for name, of in model.layout.shared}
    shared = {name: value[tuple(map(slice, sizes[name]))] for name, value in y.shared.items() if name in sizes}
    return Variables(y.control, shared)


def _cut_look(look: Look, n: int) -> Look:
    at, pairs = (jax.tree.map(lambda rows: rows[:n], part) for part in (look.at, look.pairs))
    of_points = {name: getattr(look, name)[:n] for name in ("distances", "weights", "precisions")}
    return look._replace(at=at, pairs=pairs, **of_points)


def _cut_hold(model: Model, state: State) -> Any:
    hold = loose_damping(model)
    own = np.asarray(state.damping.hold)[: model.layout.n_own]
    return np.concatenate([own, hold[model.layout.n_own :]])
