"""`fit_cohort`: one control mesh fitted to many scans in one compiled call, with optimistix; no step on the host.

It minimises the same rows as `fit`, with the same robust weights, annealed alike. Two things are simpler, for the sake
of one program for all: the strength of the bend prior is given, or found once by an ordinary fit; and a sweep's normal
equations are solved by conjugate gradients, without a matrix, not further than a sweep deserves.
"""

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.errors import name_rows

from ..model.pairing import Look, Surroundings, measure, surroundings
from ..model.recipe import Recipe
from ..model.residual import (
    Expected,
    Priors,
    Start,
    bend_asymmetry,
    bend_edges,
    bend_height,
    control_edges,
    residuals,
    with_control_vertices,
)
from ..model.robust import AbstractLoss, geman_mcclure
from ..model.unknowns import Free, Unknowns, apply_offset, no_offset
from ..model.view import LEAST_NOISE
from ..report.cohort import Cohort
from ..report.result import FitResult
from ..scan.closest_points import boundary_vertices
from ..scan.scan import Scan, ScanError
from ..scan.search_closest import search_closest
from ..solve.conjugate_gradients import ConjugateGradients
from ..solve.elements import flat, to_unknowns
from ..solve.problem import FASTEST, HOLD, LEAST_LEFT, LET_GO, SOFTER, STEP, STIFFER, Found, Problem, larger, moved_to
from .fit import AT_REST, check, fit, sound_start, surface_moved

# Of the gradient, squared sums: tighter solves of a sweep, whose pairs change anyway, take longer in all.
_SOLVED, _MOST_STEPS = 0.03, 200
_ROUND = 256  # scans are filled up to a multiple of it: cohorts of nearly equal lengths share a program


class _Common(NamedTuple):
    """What all subjects share."""

    scheme: js.AbstractScheme
    topology: js.Topology
    priors: Priors
    loss: AbstractLoss
    zero: Unknowns
    is_free: Float[Array | np.ndarray, "n"]
    bend: Float[Array, "b"]
    """1 / variance of every bend."""
    height: Float[Array, "g"]
    """Of the heights that are expected."""
    likeness: Float[Array, "b"]
    """Of every bend."""
    determined: Float[Array, ""]
    """Degrees of freedom that a scan's points determine, about."""
    edges: Int[Array | np.ndarray, "e 2"]
    bend_edges: Int[Array | np.ndarray, "b 2"]
    height_rows: Int[Array | np.ndarray, "g"]
    """The bends whose heights are expected."""
    open_vertices: Bool[Array | np.ndarray, "w"]
    tolerance: Float[Array, ""]


class _Subject(NamedTuple):
    """What differs; scans are filled up with points of weight 0."""

    control: js.Control
    scan: Scan
    around: Surroundings
    part: Float[Array, ""]
    """Of the rows of the scan, that are points."""


class _State(NamedTuple):
    """Between two sweeps."""

    sweep: Int[Array, ""]
    h: Float[Array, "..."] | None
    control: js.Control
    before: tuple[Float[Array, "w 3"], Float[Array, "w 3"]]
    """Vertices and normals of the surface before the last step."""
    weights: Float[Array, "p"]
    noise: Float[Array, ""]
    widest: Float[Array, ""]
    """Scale of the distances at the start."""
    stiff: Float[Array, ""]
    """1 / variance of the bends at the start."""
    hold: Float[Array, "n"]
    step: Float[Array, "n"]
    rms: Float[Array, "sweeps"]
    robust_rms: Float[Array, "sweeps"]
    converged: Bool[Array, ""]
    finite: Bool[Array, ""]


def fit_cohort(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    controls: js.Control | Sequence[js.Control],
    scans: Sequence[Scan],
    *,
    free: Free | None = None,
    priors: Priors | None = None,
    pilot: FitResult | None = None,
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
        priors: as in `fit`; with `bend=None`, the default, the smoothness is that of the pilot, place by place; and
            with `likeness=None` so is how much of each control mesh's own shape is expected of it.
        pilot: an ordinary fit of the same control mesh; default, where it is needed: that of the first scan.
        at_once: how many subjects share each operation, as the memory allows: on an accelerator many; on a CPU one at
            a time is as fast, and stops when it has converged.

    Warns:
        UserWarning: some fits did not converge; it names them, and `Cohort.converged` has them. Or faces of a control
            mesh lie upside down, see `fit`.

    Raises:
        ScanError: a scan cannot be fitted, or has slices that are free to move; the text names it by its number.
        ValueError: as in `fit`; or the numbers of scans and controls differ, or the priors ask for symmetry.
    """
    free, priors, loss = free or Free(), priors or Priors(), loss or geman_mcclure()
    controls = [controls] * len(scans) if isinstance(controls, js.Control) else list(controls)
    if len(controls) != len(scans) or not scans:
        raise ValueError(f"there are {len(scans)} scans and {len(controls)} controls: give one or more, and one each.")
    if np.isfinite(priors.symmetry):
        raise ValueError(
            "a cohort has no prior of symmetry: its steps do not solve for a mirror plane. Leave `Priors.symmetry` "
            "out, or call `fit` for each scan."
        )
    for i, (control, scan) in enumerate(zip(controls, scans, strict=True)):
        try:
            check(scheme, topology, control, scan)
            if scan.slices is not None and free.shifts:
                raise ScanError(
                    "it has slices, which a cohort does not shift. Give `free=Free(shifts=False)` to fit it as it is, "
                    "or fit it alone with `fit` and give the `points` of its result."
                )
        except ScanError as error:
            raise ScanError(f"scan {i}: {error}") from error
    sound = {}
    for control in controls:  # mostly the same one for all
        if id(control) not in sound:
            sound[id(control)] = sound_start(scheme, topology, control, free)
    controls = [sound[id(control)] for control in controls]
    settings = {"free": free, "priors": priors, "loss": loss, "max_sweeps": max_sweeps, "tolerance": tolerance}
    if priors.bend is None and pilot is None:
        pilot = fit(scheme, topology, controls[0], scans[0], throw=False, **settings)
    recipe = Recipe.of(scheme, topology, **settings)
    problem = Problem(scheme, topology, controls[0], free, priors)
    problem.tell(_strength(problem, priors, pilot))
    precisions, expected = problem.prior_precisions(), problem.found().expected
    dtype, masks = controls[0].vertices.dtype, free.of(scheme, topology.n_control_vertices)
    common = _Common(
        scheme=scheme,
        topology=topology,
        priors=priors,
        loss=loss,
        zero=no_offset(free, scheme, controls[0]),
        is_free=jnp.asarray(flat(masks), dtype),
        bend=jnp.asarray(precisions.bend, dtype),
        height=jnp.asarray(precisions.height, dtype),
        likeness=jnp.asarray(problem.likeness * (expected.bends != 0), dtype),
        determined=jnp.asarray(problem.determined, dtype),
        edges=control_edges(topology),
        bend_edges=bend_edges(scheme, topology),
        height_rows=expected.rows,
        open_vertices=boundary_vertices(js.refine(scheme, topology, controls[0])),
        tolerance=jnp.asarray(tolerance, dtype),
    )
    subjects, n = _stacked(controls, scans, at_once), len(scans)
    states = jax.tree.map(lambda rows: rows[:n], _run(common, subjects, max_sweeps, at_once))
    surfaces = jax.vmap(lambda h, control: _refined(common, h, control), (0, 0))(states.h, states.control)
    converged = np.asarray(states.converged)
    if not converged.all():
        which = np.flatnonzero(~converged)
        warnings.warn(
            f"{len(which)} of {n} fits did not converge, of the scans {name_rows(which)}: see `Cohort.converged`. "
            "Align them better, or give more `max_sweeps`.",
            stacklevel=2,
        )
    return Cohort(
        control=states.control,
        h=states.h,
        surfaces=js.RefinedSurface(surfaces.vertices, surfaces.normals, topology.faces),
        converged=converged,
        sweeps=np.asarray(states.sweep) - 1,
        rms=np.asarray(states.rms),
        robust_rms=np.asarray(states.robust_rms),
        noise=np.asarray(states.noise),
        weights=np.asarray(states.weights),
        scans=tuple(scans),
        _recipe=recipe,
        _problem=problem,
        _starts=jax.tree.map(lambda rows: rows[:n], subjects.control),
        _finite=np.asarray(states.finite),
    )


def _strength(problem: Problem, priors: Priors, pilot: FitResult | None) -> Found:
    """Of the bend prior, and what it expects: as given, or as the pilot found it."""
    found = problem.found()
    if priors.bend is not None:
        found = found._replace(bend_precision=np.full(problem.topology.n_control_faces, float(priors.bend) ** -2))
    if pilot is None:
        return found
    told = pilot._problem.found()
    if priors.bend is None:
        found = found._replace(bend_precision=told.bend_precision, expected=found.expected.only(told.expected))
        if priors.likeness is None:
            found = found._replace(likeness=told.likeness)
    return found._replace(determined=told.determined)


def _stacked(controls: list[js.Control], scans: Sequence[Scan], at_once: int) -> _Subject:
    """Subjects one a row, their number filled up to a multiple of `at_once`."""
    given = [scan.normals is not None for scan in scans]
    if any(given) and not all(given):
        raise ScanError(f"scan {given.index(False)} has no normals and others have: give all of them normals, or none.")
    size = -(-max(scan.n_points for scan in scans) // _ROUND) * _ROUND

    def subject(control: js.Control, scan: Scan) -> _Subject:
        def filled(rows: Array, mode: Any = "edge") -> Array:
            return jnp.pad(rows, [(0, size - len(rows))] + [(0, 0)] * (rows.ndim - 1), mode=mode)

        around = surroundings(scan)
        filled_up = (
            filled(scan.points),
            None if scan.normals is None else filled(scan.normals),
            filled(scan.weights_or_ones(), mode="constant"),
            jnp.pad(scan.relative_deviations(), (0, size - scan.n_points), constant_values=1),
            None,  # slices, which do not move
        )
        whole = eqx.tree_at(lambda s: tuple(vars(s).values()), scan, filled_up, is_leaf=lambda leaf: leaf is None)
        around = around._replace(neighbours=np.asarray(around.neighbours, np.int32))
        full = Surroundings(*(filled(jnp.asarray(rows)) for rows in around))
        return _Subject(control, whole, full, jnp.asarray(scan.n_points / size, scan.points.dtype))

    one_each = [subject(*pair) for pair in zip(controls, scans, strict=True)]
    one_each += one_each[-1:] * (-len(scans) % at_once)
    return jax.tree.map(lambda *rows: jnp.stack(rows), *one_each)


@eqx.filter_jit
def _run(common: _Common, subjects: _Subject, max_sweeps: int, at_once: int) -> _State:
    def one(subject: _Subject) -> _State:
        state, expected = _first(common, subject, max_sweeps), _expected(common, subject)
        return lax.while_loop(
            lambda s: (s.sweep <= max_sweeps) & ~s.converged & s.finite,
            lambda s: _sweep(common, subject, expected, s),
            state,
        )

    return lax.map(one, subjects, batch_size=None if at_once == 1 else at_once)


def _refined(common: _Common, h: Float[Array, "..."] | None, control: js.Control) -> js.RefinedSurface:
    return js.refine(_with(common.scheme, h), common.topology, control)


def _with(scheme: js.AbstractScheme, h: Float[Array, "..."] | None) -> js.AbstractScheme:
    return scheme if h is None else eqx.tree_at(lambda s: s.h, scheme, h)


def _expected(common: _Common, subject: _Subject) -> Expected:
    """Of bends, at the size of the start."""
    surface = _refined(common, common.scheme.h, subject.control)
    own, rows = with_control_vertices(common.topology, common.scheme, subject.control, surface), common.height_rows
    bends = common.likeness * bend_asymmetry(own, common.bend_edges)
    return Expected(bends, rows, bend_height(own, jnp.asarray(common.bend_edges)[rows]))


def _first(common: _Common, subject: _Subject, max_sweeps: int) -> _State:
    x = subject.control.vertices
    none, nothing = jnp.zeros((), x.dtype), jnp.zeros_like(common.is_free)
    shapes = jax.eval_shape(_refined, common, common.scheme.h, subject.control)
    unknown = jnp.full(max_sweeps + 1, jnp.nan, x.dtype)
    return _State(
        sweep=jnp.int32(0),
        h=common.scheme.h,
        control=subject.control,
        before=(jnp.zeros_like(shapes.vertices), jnp.zeros_like(shapes.normals)),
        weights=jnp.zeros_like(subject.scan.points[:, 0]),
        noise=none,
        widest=none,
        stiff=none,
        hold=_loosest(common, x),
        step=nothing,
        rms=unknown,
        robust_rms=unknown,
        converged=jnp.bool_(False),
        finite=jnp.bool_(True),
    )


def _sweep(common: _Common, subject: _Subject, expected: Expected, state: _State) -> _State:
    """Look where the scan lies, and, unless the surface came to rest, take a step.

    Looking comes first, so that the last step is judged too and the program holds one search.
    """
    k, topology, control = state.sweep, common.topology, state.control
    surface = _refined(common, state.h, control)
    edge = js.edge_length(topology, subject.control.vertices)
    floor = jnp.where(
        k > 0, jnp.maximum(state.widest * 0.5 ** k.astype(edge.dtype), LEAST_NOISE * edge), LEAST_NOISE * edge
    )
    at = search_closest(surface, subject.scan.points)
    seen = measure(surface, subject.scan, at, common.open_vertices, subject.around, edge, floor, common.loss)

    own = with_control_vertices(topology, common.scheme, control, surface)
    stiff = STIFFER / jnp.mean(bend_asymmetry(own, common.bend_edges) ** 2)
    stiffest = jnp.where(k > 0, state.stiff, stiff)
    softer = SOFTER ** k.astype(edge.dtype)
    bend = jnp.maximum(common.bend, stiffest * softer)
    height = jnp.maximum(common.height, STIFFER / jnp.mean(expected.heights**2) * softer)
    moved = surface_moved(js.RefinedSurface(*state.before, topology.faces), surface)
    change = jnp.abs(seen.robust_rms - state.robust_rms[jnp.maximum(k - 1, 0)])
    counted = jnp.maximum(jnp.sum(seen.weights > 0), 1).astype(edge.dtype)
    uncertainty = seen.scale * jnp.sqrt(control.vertices.shape[0] / counted)
    at_rest = common.tolerance * jnp.maximum(uncertainty, AT_REST * edge)
    at_noise = floor <= jnp.maximum(seen.noise, LEAST_NOISE * edge)
    annealed = (k > 0) & at_noise & jnp.all(bend <= common.bend) & jnp.all(height <= common.height)
    converged = annealed & (jnp.maximum(moved, change) <= at_rest)

    step = lax.cond(
        converged | (k == state.rms.shape[0] - 1),
        lambda: jnp.zeros_like(state.step),
        lambda: _solved(common, subject, expected, state, seen, bend, height),
    )
    finite = jnp.all(jnp.isfinite(step))
    step = jnp.where(finite, step, 0.0)
    scheme, control = apply_offset(topology, _with(common.scheme, state.h), control, _offset(common, step))
    return _State(
        sweep=k + 1,
        h=scheme.h,
        control=control,
        before=(surface.vertices, surface.normals),
        weights=seen.weights,
        noise=seen.noise,
        widest=jnp.where(k > 0, state.widest, seen.scale),
        stiff=stiffest,
        hold=_held(common, state, step),
        step=step,
        rms=state.rms.at[k].set(seen.rms),
        robust_rms=state.robust_rms.at[k].set(seen.robust_rms),
        converged=converged,
        finite=finite,
    )


def _solved(
    common: _Common,
    subject: _Subject,
    expected: Expected,
    state: _State,
    seen: Look,
    bend: Float[Array, "b"],
    height: Float[Array, "g"],
) -> Float[Array, "n"]:
    """A Gauss-Newton step of optimistix from here, pairs and weights held."""
    template = moved_to(subject.control.vertices, state.control.vertices, jnp)
    scheme = _with(common.scheme, state.h)
    tables = None, common.edges, common.bend_edges
    by = larger(subject.control.vertices, template, jnp)
    start = Start(scheme, common.topology, state.control, template, *tables, None, expected.times(by, by))
    left = jnp.maximum(1 - common.determined / jnp.maximum(jnp.sum(seen.weights), 1.0), LEAST_LEFT)
    deviations = tuple(map(jnp.sqrt, (seen.precisions * left * subject.part, bend, height, state.hold)))

    def rows(vector: Float[Array, "n"], args: Any) -> tuple[Float[Array, "m"], None]:
        start, pairs, priors, (of_distance, of_bend, of_height, of_hold) = args
        found = residuals(_offset(common, vector), start, pairs)
        weighed = (
            of_distance * found.distance,
            of_bend * found.bend,
            of_height * found.height,
            found.stretch / priors.stretch.astype(vector.dtype),
            found.margin,
            found.h / priors.h.astype(vector.dtype),
            of_hold * vector,
        )
        return jnp.concatenate(weighed), None

    solver = optx.GaussNewton(rtol=0.0, atol=0.0, linear_solver=ConjugateGradients(_SOLVED, _MOST_STEPS))
    nothing, args = jnp.zeros_like(state.step), (start, seen.pairs, common.priors, deviations)
    shape = jax.eval_shape(lambda vector: rows(vector, args)[0], nothing)
    # One step by hand: `optx.least_squares` would linearise and solve once more to find that its step was good, and the
    # next sweep does so anyway, with better pairs.
    begun = solver.init(rows, nothing, args, {}, shape, None, frozenset())
    _, stepped, _ = solver.step(rows, nothing, args, {}, begun, frozenset())
    return stepped.y_eval * common.is_free


def _offset(common: _Common, vector: Float[Array, "n"]) -> Unknowns:
    return to_unknowns(vector * common.is_free, common.zero)


def _loosest(common: _Common, vertices: Float[Array, "v 3"]) -> Float[Array, "n"]:
    return jnp.full_like(common.is_free, (STEP * js.edge_length(common.topology, vertices)) ** -2)


def _held(common: _Common, state: _State, step: Float[Array, "n"]) -> Float[Array, "n"]:
    """Control vertices that turn back are held faster, those that go on are let go again; see `Problem`."""
    n_vertices = common.topology.n_control_vertices
    width = step.shape[0] // n_vertices
    n, loosest = width * n_vertices, _loosest(common, state.control.vertices)
    agree = jnp.sum((step * state.step)[:n].reshape(n_vertices, width), axis=1)
    factor = jnp.repeat(jnp.where(agree < 0, HOLD, LET_GO), width)
    return jnp.clip(
        state.hold * jnp.append(factor, jnp.ones(step.shape[0] - n, factor.dtype)), loosest, FASTEST * loosest
    )
