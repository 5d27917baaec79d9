"""`fit_cohort`: one control mesh fitted to many scans by one compiled call of `Sweeps` a bucket, by optimistix.

It minimises the same rows as `fit`, with the same robust weights, annealed alike. Two things are simpler, for the sake
of one program for all: the strengths of the priors are given, or found once by an ordinary fit; and a sweep's normal
equations are solved by conjugate gradients, without a matrix, not further than a sweep deserves.
"""

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import Mesh

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
from ..report.cohort import Cohort, name_subjects, pad_rows
from ..report.evidence import rests_far_off
from ..report.record import Fit, choose_faces
from ..report.result import FitResult
from ..scan.landmarks import Landmarks
from ..scan.regions import RegionMatch
from ..scan.scan import Scan, ScanError
from ..solve.conjugate_gradients import ConjugateGradients
from ..solve.strengths import FromTargets
from ..solve.sweeps import CONVERGED, NONFINITE, State, Sweeps, loose_damping
from ..start.folds import Folds
from .buckets import Kept, fit_in_buckets
from .fit import check, check_regions, find_partners, gather_inputs, record_fit, sound_start
from .pilot import Member, make_pilot, take_strengths
from .stack import fill_choices, fill_up, share_equal

# Of the gradient. Stiff priors make up most of it: where less of it is solved, the surface hardly follows the scan from
# sweep to sweep, which looks like rest (at 0.03 a heart stopped 5 mm from its contours, `tests/bench/fit_cohorts.py`).
_SOLVED, _MOST_STEPS = 0.001, 1000
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
    mesh: Mesh | None = None,
    skip_bad: bool = False,
    on_stage: Callable[[str], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Cohort:
    """Fit one control mesh to many scans, by one compiled program for all scans of about a size.

    Scans are sorted into classes by their number of points: up to 1024, and then a quarter more from class to class; a
    few scans join the next larger class. Each class is compiled once, which takes as long as several fits. After that
    each fit takes a fraction of the time of `fit`, and is as near to the truth.

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
        at_once: how many subjects share each operation of a device, as the memory allows: on an accelerator many; on a
            CPU one at a time is as fast, and stops when it has converged.
        mesh: devices, along any axes, that fit `at_once` subjects each at the same time; default: JAX's default device
            alone. The devices may be those of several processes (`jax.distributed`), which then all call this with the
            same arguments, and all get the whole cohort.
        skip_bad: leave out scans that cannot be fitted, named in `Cohort.failed` with the reason, and fit the others;
            default: refuse all.
        on_stage: told what begins, how much memory it takes, and how many scans are done, in a few words.
        checkpoint: a folder that keeps what was finished. Called again with the same arguments, a cohort that was
            stopped goes on from there, to the same result bit for bit. The files go when the cohort is saved there.

    Warns:
        UserWarning: some fits did not converge; it names them, and `Cohort.converged` has them. Or scans were left out;
            it names them. Or the control mesh was fitted to the pilot's own scan, so that the pilot is replaced. Or
            faces of a control mesh lie upside down, see `fit`.

    Raises:
        ScanError: a scan cannot be fitted; the text names it by its number. Or some have normals and others none.
        ValueError: as in `fit`; or the numbers of scans, controls, landmarks, boundaries and regions differ; or the
            checkpoint is of another cohort.
    """
    check_numbers({"max_sweeps": max_sweeps, "tolerance": tolerance, "landmark_deviation": landmark_deviation})
    check_numbers({"at_once": at_once})
    free, priors, loss, say = free or Free(), priors or Priors(), loss or geman_mcclure(), on_stage or (lambda _: None)
    if float(priors.contact) > 0:
        raise ValueError(
            "a cohort is fitted without `Priors.contact`: its surfaces may cross themselves. Leave it out."
        )
    of_each = _give_each(controls, scans, landmarks, boundary, regions)
    check_one = partial(_check, scheme, topology, free=free, deviation=landmark_deviation, sound={})
    given, inputs, named, numbers, failed = [], [], [], [], {}
    for i, (one, name) in enumerate(zip(of_each, name_subjects(len(scans), names), strict=True)):
        try:
            one, own = check_one(one)
        except ScanError as error:
            if not skip_bad:
                raise ScanError(f"scan {i}: {error}") from error
            failed[name] = str(error)
        else:
            given, inputs = [*given, one], [*inputs, own]
            named, numbers = [*named, name], [*numbers, i]
    if failed:
        words = "; ".join(f"{name}: {reason}" for name, reason in failed.items())
        if not given:
            raise ScanError(f"none of the scans can be fitted. {words}")
        warn(f"{len(failed)} of {len(scans)} scans are left out. {words}")
    have = [one.scan.normals is not None for one in given]
    if any(have) and not all(have):
        which = numbers[have.index(False)]
        raise ScanError(f"scan {which} has no normals and others have: give all of them normals, or none.")
    partners = find_partners(symmetry, priors, topology, given[0].control)
    settings = {"free": free, "priors": priors, "loss": loss, "max_sweeps": max_sweeps, "tolerance": tolerance}
    settings["landmark_deviation"] = landmark_deviation
    of_all = {"scheme": scheme, "topology": topology, "symmetry": partners, "scan or what belongs to it": given}
    of_all |= {"pilot": pilot and pilot.fit.strengths, "at_once": at_once, "number of devices": mesh and mesh.size}
    kept = Kept(None if checkpoint is None else Path(checkpoint), of_all | settings, mesh)
    for own in inputs:
        own |= {"symmetry": partners, "alike": None if pilot is None else pilot.fit.inputs.get("alike")}
    made = _analyse_all(scheme, topology, given, free, priors, inputs)
    strengths = None
    if pilot is not None or any(one.n_strengths and one.given_strengths() is None for one in made[0][0].priors):
        say("finds the strengths of the priors by a fit of one scan")
        of_pilot = {"symmetry": partners} | settings
        strengths = kept.recall_strengths(lambda: take_strengths(make_pilot(scheme, topology, given, of_pilot, pilot)))
    without = () if strengths is None or priors.bend is not None or "height" in strengths.values else ("height",)
    filled = fill_up(inputs)
    filled = made if filled is inputs else _analyse_all(scheme, topology, given, free, priors, filled)
    models = [_leave_out(model, without) for model, _ in made]
    scenes = [
        make_scene(one.scan, model.refine(y), own["slices"], choose_faces(one.regions, model, y, one.scan))
        for one, own, (model, y) in zip(given, inputs, made, strict=True)
    ]
    choices = fill_choices([scene.choice for scene in scenes], [one.scan.n_points for one in given])
    solver = Sweeps(
        linear_solver=ConjugateGradients(_SOLVED, _MOST_STEPS),
        strengths=find_targets(models[0], priors, strengths),
        loss=loss,
        rtol=jnp.asarray(tolerance, given[0].control.vertices.dtype),
        max_sweeps=max_sweeps,
        folds=Folds(topology),
    )
    found = fit_in_buckets(
        solver,
        [(_leave_out(model, without), y) for model, y in filled],
        [scene._replace(choice=choice) for scene, choice in zip(scenes, choices, strict=True)],
        at_once=at_once,
        mesh=mesh,
        kept=kept,
        on_stage=say,
    )
    ends = [_find_ending(model, scene, state) for model, scene, (_, state) in zip(models, scenes, found, strict=True)]
    converged = np.array([bool(end == optx.RESULTS.successful) for end in ends])
    if not converged.all():
        which = [number for number, rests in zip(numbers, converged, strict=True) if not rests]
        warn(
            f"{len(which)} of {len(given)} fits did not converge, of the scans {name_rows(which)}: see "
            "`Cohort.converged`. Align them better, or give more `max_sweeps`.",
        )
    told = Settings.of(scheme, topology, **settings)

    def fit_of(i: int) -> Fit:
        y, state = found[i]
        y = _cut(models[i], jax.tree.map(jnp.asarray, y))
        cut = _cut_look(state.look, given[i].scan.n_points), _cut_hold(models[i], state)
        state = eqx.tree_at(lambda one: (one.look, one.damping.hold), state, cut)
        return record_fit(models[i], y, state, scenes[i], given[i].scan, given[i].control, inputs[i], told, ends[i])

    values, states = [y for y, _ in found], [state for _, state in found]
    vertices, normals = (jnp.stack([getattr(one, name) for one in states]) for name in ("vertices", "normals"))
    return Cohort(
        control=jax.tree.map(lambda *rows: jnp.stack(rows), *(y.control for y in values)),
        h=jnp.stack([y.shared["h"] for y in values]) if "h" in values[0].shared else None,
        surfaces=js.RefinedSurface(vertices, normals, topology.faces),
        converged=converged,
        sweeps=np.array([int(state.sweep) - 1 for state in states]),
        rms=np.stack([state.rms for state in states]),
        robust_rms=np.stack([state.robust_rms for state in states]),
        noise=np.array([float(state.look.noise) for state in states]),
        weights=pad_rows([np.asarray(state.look.weights) for state in states], 0.0),
        scans=tuple(one.scan for one in given),
        names=tuple(named),
        failed=failed,
        _results=lambda i: FitResult(fit_of(i)),
    )


def find_targets(model: Model, priors: Priors, pilot: FromTargets | None) -> FromTargets:
    """Strengths of the priors, and what is expected of bends: as given, or as the pilot found them."""
    pilot = pilot or FromTargets({}, 0.0, 0.0)
    values = {}
    for prior in model.priors:
        if prior.n_strengths:
            given = prior.given_strengths()
            values[prior.name] = pilot.values.get(prior.name, prior.first_strengths()) if given is None else given
    likeness = priors.likeness
    if likeness is None:
        likeness = pilot.likeness if priors.bend is None else 0.0
    targets = FromTargets(values, likeness, pilot.determined)
    return jax.tree.map(lambda x: jnp.asarray(x, model.template.dtype), targets)


def _give_each(controls: Any, scans: Sequence[Scan], landmarks: Any, boundary: Any, regions: Any) -> list[Member]:
    """What belongs to each scan, of what was given for all or for each."""
    n = len(scans)
    controls = _check_one_each(controls, js.Control, n, "controls")
    places = [None] * n if landmarks is None else _check_one_each(landmarks, Landmarks, n, "landmarks")
    curves = [None] * n if boundary is None else _check_one_each(boundary, BoundaryCurve, n, "boundaries")
    matches = [None] * n if regions is None else _check_one_each(regions, RegionMatch, n, "regions")
    return [Member(*one) for one in zip(controls, scans, places, curves, matches, strict=True)]


def _check(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    one: Member,
    *,
    free: Free,
    deviation: float,
    sound: dict[int, js.Control],
) -> tuple[Member, dict[str, Any]]:
    """A subject with a sound start, and its inputs.

    Args:
        sound: the starts that are sound, by the identity of those that were given; new ones are put in.
    """
    check(scheme, topology, one.control, one.scan)
    check_regions(one.regions, topology)
    if id(one.control) not in sound:
        sound[id(one.control)] = sound_start(scheme, topology, one.control, free)
    one = one._replace(control=sound[id(one.control)])
    inputs = gather_inputs(scheme, topology, one.control, one.scan, free, one.landmarks, deviation, one.boundary)
    return one, inputs | {"regions": one.regions}


def _analyse_all(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    given: list[Member],
    free: Free,
    priors: Priors,
    inputs: list[dict[str, Any]],
) -> list[tuple[Model, Variables]]:
    """The models of all subjects, which share the tables that are alike."""
    made: list[tuple[Model, Variables]] = []
    for one, own in zip(given, inputs, strict=True):
        new = analyse(scheme, topology, one.control, free, priors, own)
        made.append(share_equal(new, made[0]) if made else new)
    return made


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
