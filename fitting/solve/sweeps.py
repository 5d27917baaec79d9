"""The solver of a fit: sweeps of correspondence and Gauss-Newton steps, as a least-squares solver of optimistix.

A sweep pairs every scan point with the closest point of the surface, weighs the pairs robustly, linearises all rows,
and takes the most probable step. The strengths of the priors follow from the scan or are given, the scale of the loss
falls to the noise from sweep to sweep (graduated non-convexity), and control vertices that turn back are damped.

On the host `fit` steps the solver in Python, with sparse normal equations; on an accelerator, and for cohorts,
`optx.least_squares(subject_residual, Sweeps(...), y, Subject(model, scene))` runs as one compiled program with
conjugate gradients.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import dot

from ..model.pairing import LEAST_NOISE, Look, Scene, empty_look, measure
from ..model.residual import Held, Model, Residual
from ..model.robust import AbstractLoss, geman_mcclure
from ..model.unknowns import AnyArray, Variables
from ..scan.closest_points import closest_points
from ..start.folds import Folds
from .collision_free import CrossingGuard
from .conjugate_gradients import ConjugateGradients
from .pilot import FromPilot
from .sparse_normal import SparseNormal
from .strengths import FromScan, FromTargets, Strengths, count_determined, first_strengths

# Standard deviation of a step in control edges: what neither scan nor priors hold stays near where it is. A control
# vertex that turns back is held faster, and one that goes on is let go again: where the surface cannot follow the scan
# (an ear in a coarse mesh) points change sides from sweep to sweep, and exact steps would go to and fro for ever.
_STEP, HOLD, _LET_GO, _FASTEST = 0.25, 8.0, 0.7, 1e6
_TRIES = 6  # of a step that turns faces upside down: their vertices are held faster each time
_LEAST_LEFT = 0.1  # of the degrees of freedom: what is less says that the scan has too few points
_AT_REST = 0.01  # of a control edge: movements far below it are at rest, however exact the scan
_MOST_AT_REST = 0.1  # of a control edge: movements far above it are none, however noisy the scan seems
_MOST = 0.9  # of the surface: so much of it has to be at rest
RUNNING, CONVERGED, NONFINITE, OUT_OF_SWEEPS = range(4)


class Subject(NamedTuple):
    """What is fitted to what: the `args` of `Sweeps`."""

    model: Model
    scene: Scene


class Damping(eqx.Module):
    """What holds the unknowns in a step.

    Attributes:
        hold: 1 / variance of each unknown's next change.
        step: the last change.
    """

    hold: Float[Array | np.ndarray, "n"]
    step: Float[Array | np.ndarray, "n"]


class State(eqx.Module):
    """Between two sweeps; arrays alone.

    Attributes:
        sweep: how many times the scan was looked at.
        vertices, normals: of the surface of `y`.
        moved: how far the last step moved the surface across itself: nine tenths of it by less than this, in mm.
        look: the scan as seen from the surface before the last step; from the surface itself once the solver has ended.
        strengths: of the priors.
        damping: of the next step.
        widest: scale of the loss at the start, in mm.
        shifting: whether slices are free to be shifted: once the loss has come down to the noise.
        rms, robust_rms: of the distances in mm, at the start and after every sweep; NaN beyond the last.
        status: `RUNNING`, `CONVERGED`, `NONFINITE` or `OUT_OF_SWEEPS`.
    """

    sweep: Any
    vertices: Any
    normals: Any
    moved: Any
    look: Look
    strengths: Strengths
    damping: Damping
    widest: Any
    shifting: Any
    rms: Any
    robust_rms: Any
    status: Any


class Sweeps(optx.AbstractLeastSquaresSolver):
    """Fits a surface by sweeps; `y` is `Variables`, and `args` a `Subject`, whose rows `subject_residual` has.

    Attributes:
        linear_solver: `SparseNormal`, on the host, or `ConjugateGradients`, wherever JAX computes.
        strengths: `FromScan`, `FromTargets` or `FromPilot`.
        loss: how a point loses weight with its distance.
        rtol: converged once a sweep, annealed, moves nine tenths of the surface, and the RMS distance, by less than
            this part of the surface's uncertainty, or of a hundredth of a control edge, where that is more.
        max_sweeps: how many steps at most.
        folds: which control faces lie beside which.
        guard: keeps the surface from passing through itself, on the host; None lets it.
    """

    linear_solver: SparseNormal | ConjugateGradients
    strengths: FromScan | FromTargets | FromPilot
    loss: AbstractLoss
    rtol: Any
    max_sweeps: int = eqx.field(static=True)
    folds: Folds
    guard: CrossingGuard | None = eqx.field(static=True, default=None)
    atol: Any = 0.0
    norm: Callable = optx.max_norm

    @property
    def _on_host(self) -> bool:
        return isinstance(self.linear_solver, SparseNormal)

    def init(
        self, fn: Any, y: Variables, args: Subject, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> State:
        model, xp = args.model, np if self._on_host else jnp
        surface, dtype = model.refine(y), y.control.vertices.dtype
        unknown = xp.full(self.max_sweeps + 1, np.nan, dtype)
        none = xp.zeros((), dtype)
        strengths = first_strengths(model)
        if not isinstance(self.strengths, FromScan):
            strengths = self.strengths.start(strengths)
        loose = loose_damping(model, xp)
        if xp is jnp:
            strengths = jax.tree.map(
                lambda value: jnp.asarray(value, None if value.dtype == bool else dtype), strengths
            )
        return State(
            sweep=xp.zeros((), np.int32),
            vertices=surface.vertices,
            normals=surface.normals,
            moved=none,
            look=empty_look(args.scene),
            strengths=strengths,
            damping=Damping(loose, xp.zeros_like(loose)),
            widest=none,
            shifting=xp.zeros((), bool),
            rms=unknown,
            robust_rms=unknown,
            status=xp.zeros((), np.int32) + RUNNING,
        )

    def step(
        self, fn: Any, y: Variables, args: Subject, options: Any, state: State, tags: Any
    ) -> tuple[Variables, State, Any]:
        """Look where the scan lies and, unless the surface has come to rest, take a step.

        Looking comes first, so that the last step is judged too and a compiled program holds one search.
        """
        (model, scene), xp = args, np if self._on_host else jnp
        surface = js.RefinedSurface(state.vertices, state.normals, model.topology.faces)
        held, points = hold_priors(model, y, surface, state.strengths.values, scene)
        search = closest_points if self._on_host else js.search_closest
        at = search(surface, points, scene.choice)
        k, least = state.sweep, LEAST_NOISE * model.edge
        fallen = jnp.maximum(jnp.asarray(state.widest) * 0.5 ** jnp.asarray(k, model.edge.dtype), least)
        floor = jnp.where(jnp.asarray(k) > 0, fallen, least)
        covered = held["rim"].covered if "rim" in held else None
        look = measure(surface, scene, points, at, model.edge, floor, self.loss, covered)

        seen = jax.tree.map(np.asarray, look) if xp is np else look
        widest = xp.where(k > 0, state.widest, seen.scale)
        rms, robust_rms = (
            values.at[k].set(new) if xp is jnp else _replace(values, int(k), new)
            for values, new in ((state.rms, seen.rms), (state.robust_rms, seen.robust_rms))
        )
        change = xp.abs(seen.robust_rms - state.robust_rms[xp.maximum(k - 1, 0)])
        counted = xp.maximum((seen.weights > 0).sum(), 1).astype(rms.dtype)
        edge = xp.asarray(model.edge)
        uncertainty = seen.scale * xp.sqrt(model.layout.n_vertices / counted)
        # Of the surface alone: a scale that grows without bounds would let anything pass for rest.
        bounded = xp.clip(uncertainty, _AT_REST * edge, _MOST_AT_REST * edge)
        at_rest = xp.asarray(self.rtol, rms.dtype) * bounded
        at_noise = (k > 0) & (xp.asarray(floor) <= xp.maximum(seen.noise, LEAST_NOISE * edge))
        has_shifts = model.prior("shift") is not None
        annealed = state.strengths.annealed & at_noise & (state.shifting if has_shifts else True)
        converged = annealed & (xp.maximum(state.moved, change) <= at_rest)
        # Not before, where the start is off and everything would be taken for shifts; nor when the surface has come to
        # rest, for it has bent to the slices that are off.
        shifting = state.shifting | at_noise if has_shifts else state.shifting
        out = ~converged & (k >= self.max_sweeps)
        status = xp.where(converged, CONVERGED, xp.where(out, OUT_OF_SWEEPS, RUNNING)).astype(np.int32)
        looked = State(
            k + 1, state.vertices, state.normals, state.moved, look if xp is jnp else seen, state.strengths,
            state.damping, widest, shifting, rms, robust_rms, status,
        )  # fmt: skip
        moves = lambda: self._move(y, args, looked, surface, at, held)  # noqa: E731
        if xp is np:
            y, looked = moves() if int(status) == RUNNING else (y, looked)
        else:
            y, looked = lax.cond(status == RUNNING, moves, lambda: (y, looked))
        return y, looked, None

    def terminate(
        self, fn: Any, y: Variables, args: Subject, options: Any, state: State, tags: Any
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        status = jnp.asarray(state.status)
        result = optx.RESULTS.where(status == NONFINITE, optx.RESULTS.nonfinite, optx.RESULTS.successful)
        stopped = status == OUT_OF_SWEEPS
        return status != RUNNING, optx.RESULTS.where(stopped, optx.RESULTS.nonlinear_max_steps_reached, result)

    def postprocess(
        self, fn: Any, y: Variables, aux: Any, args: Subject, options: Any, state: State, tags: Any, result: Any
    ) -> tuple[Variables, Any, dict[str, Any]]:
        return y, aux, {"state": state}

    def _move(
        self,
        y: Variables,
        subject: Subject,
        state: State,
        surface: js.RefinedSurface,
        at: js.SurfacePoint,
        held: dict[str, Any],
    ) -> tuple[Variables, State]:
        """Take the most probable step, and find the next strengths and damping."""
        (model, scene), xp = subject, np if self._on_host else jnp
        strengths, damping, loose = state.strengths, state.damping, loose_damping(model, xp)
        crossing = np.zeros(0, bool)
        if self.guard is not None:
            crossing = self.guard.crossing_faces(surface)
            held = held | {"contact": self.guard.find_contacts(surface, state.look, crossing)}
        fixed = hold_sweep(model, y, scene, state.look, at, strengths, held, xp)
        rows = self.linear_solver.linearise(model, y, fixed)
        active = active_unknowns(model, state.shifting, xp)

        def refine(step: AnyArray) -> tuple[Variables, js.RefinedSurface]:
            proposed = _retract(model, y, jnp.asarray(step, y.control.vertices.dtype))
            return proposed, model.refine(proposed)

        def attempt(hold: AnyArray) -> tuple[AnyArray, AnyArray]:
            step = rows.step(hold, active)
            return step, self._find_turned_over(model, y, step, xp)

        def hold_faster(hold: AnyArray, turned: AnyArray) -> AnyArray:
            return scale_damping(model, hold, xp.where(turned, HOLD, 1.0), loose, xp)

        # A step that turns faces upside down is taken again, their vertices held faster for this sweep alone.
        hold = damping.hold
        if xp is np:
            step, turned = attempt(hold)
            for _ in range(_TRIES - 1):
                if not turned.any():
                    break
                hold = hold_faster(hold, turned)
                step, turned = attempt(hold)
        else:
            nothing = jnp.zeros_like(hold), jnp.zeros(model.layout.n_vertices, bool)
            *_, step = lax.while_loop(
                lambda carry: (carry[0] == 0) | (jnp.any(carry[2]) & (carry[0] < _TRIES)),
                lambda carry: _next_try(carry, attempt, hold_faster),
                (jnp.int32(0), hold, nothing[1], nothing[0]),
            )
        whole = 1.0
        if self.guard is not None:

            def solve_again(crossing: AnyArray) -> AnyArray:
                nonlocal hold
                hold = hold_faster(hold, crossing)
                return rows.step(hold, active & ~_columns_of_h(model))

            step, whole = self.guard.shorten(
                np.asarray(step), crossing, model.layout, lambda step: refine(step)[1], solve_again
            )
        new_strengths = strengths
        if isinstance(self.strengths, FromScan):
            solve = rows.solver("all", loose, active)  # what damps a step says nothing of what the scan determines
            n = model.layout.n
            determined = count_determined(n, solve, rows.multiply_data, xp)
            new_strengths = eqx.tree_at(lambda one: one.determined, strengths, determined)
            solve_prior = lambda: rows.solver("prior", loose, active)  # noqa: E731
            new_strengths = self.strengths.update(model, y, new_strengths, rows, step, solve_prior, solve, xp)
        elif isinstance(self.strengths, FromPilot):
            solve_prior, solve_all = (partial(rows.solver, which, loose, active) for which in ("prior", "all"))
            new_strengths = self.strengths.update(model, strengths, rows, step, solve_prior, solve_all, xp)
        else:
            new_strengths = self.strengths.update(model, strengths, xp)
        proposed, refined = refine(step)
        # A step that was shortened as a whole is no rest.
        moved = measure_movement(surface, refined) if whole == 1 else np.full((), np.inf, model.edge.dtype)
        finite = jnp.isfinite(refined.vertices).all()
        new_damping = Damping(next_damping(model, damping, step, loose, state.shifting, xp), step)
        after = State(
            state.sweep, refined.vertices, refined.normals, xp.asarray(moved), state.look, new_strengths, new_damping,
            state.widest, state.shifting, state.rms, state.robust_rms, state.status,
        )  # fmt: skip
        lost = eqx.tree_at(lambda one: one.status, state, xp.zeros((), np.int32) + NONFINITE)
        if xp is np:
            return (proposed, after) if bool(finite) else (y, lost)
        return jax.tree.map(lambda a, b: jnp.where(finite, a, b), (proposed, after), (y, lost))

    def _find_turned_over(self, model: Model, y: Variables, step: AnyArray, xp: Any) -> Bool[AnyArray, "v"]:
        """Vertices of control faces that a step would turn upside down."""
        layout = model.layout
        if not layout.has_vertices or (xp is np and not np.isfinite(step).all()):
            return xp.zeros(layout.n_vertices, bool)
        before = xp.asarray(y.control.vertices, step.dtype)
        moved = before + step[: layout.n_own].reshape(layout.n_vertices, layout.width)[:, :3]
        turned = self.folds.find_turned_over(moved, xp) & ~self.folds.find_turned_over(before, xp)
        return self.folds.corners_of(turned, xp)


def _columns_of_h(model: Model) -> Bool[np.ndarray, "k"]:
    """Which shared unknowns are tangent lengths."""
    parts = [np.full(int(np.prod(of.shape, dtype=int)), name == "h") for name, of in model.layout.shared]
    return np.concatenate([np.zeros(0, bool), *parts])


def _next_try(carry: tuple, attempt: Callable, hold_faster: Callable) -> tuple:
    tries, hold, turned, _ = carry
    hold = hold_faster(hold, turned)
    step, turned = attempt(hold)
    return tries + 1, hold, turned, step


def _replace(values: Float[np.ndarray, "n"], k: int, new: AnyArray) -> Float[np.ndarray, "n"]:
    values = values.copy()
    values[k] = new
    return values


def subject_residual(y: Variables, subject: Subject) -> dict[str, Float[Array, "_"]]:
    """The rows of a sweep that starts at `y`, in the first sweep's strengths: what `Sweeps` makes small.

    `Residual` has the rows of one sweep as a function of the variables, for other solvers.
    """
    model, scene = subject
    surface, strengths = model.refine(y), first_strengths(model)
    held, points = hold_priors(model, y, surface, strengths.values, scene)
    at = js.search_closest(surface, points, scene.choice)
    look = measure(surface, scene, points, at, model.edge, LEAST_NOISE * model.edge, geman_mcclure())
    return Residual(model)(y, hold_sweep(model, y, scene, look, at, strengths, held, jnp))


@eqx.filter_jit
def hold_priors(
    model: Model, y: Variables, surface: js.RefinedSurface, strengths: dict[str, Any], scene: Scene
) -> tuple[dict[str, Any], Float[Array, "p 3"]]:
    """What every prior holds fixed during a sweep, and the scan's points with the shifts of their slices put on."""
    place = model.place(y, surface)
    points = scene.scan.points
    if scene.of_points is not None:
        points = points + shift_points(model, y.shared["shifts"], scene.of_points).astype(points.dtype)
    return model.hold(place, strengths), points


def shift_points(
    model: Model, shifts: Float[Array, "s 2"], of_points: Int[Array | np.ndarray, "p"]
) -> Float[Array, "p 3"]:
    """The shift of every point in mm."""
    prior: Any = model.prior("shift")
    moved = jnp.sum(shifts[:, :, None] * jnp.asarray(prior.planes, shifts.dtype), axis=1)
    there = jnp.asarray(of_points)
    return jnp.where((there >= 0)[:, None], moved[jnp.maximum(there, 0)], 0.0)


def measure_look(
    model: Model,
    y: Variables,
    surface: js.RefinedSurface,
    scene: Scene,
    loss: AbstractLoss,
    strengths: dict[str, Any],
) -> Look:
    """The scan as seen from a surface, on the host, the loss at the scale of the noise."""
    held, points = hold_priors(model, y, surface, strengths, scene)
    covered = held["rim"].covered if "rim" in held else None
    edge = js.edge_length(model.topology, y.control.vertices)
    at = closest_points(surface, points, scene.choice)
    look = measure(surface, scene, points, at, edge, LEAST_NOISE * edge, loss, covered)
    return jax.tree.map(np.asarray, look)


def hold_sweep(
    model: Model,
    y: Variables,
    scene: Scene,
    look: Look,
    at: js.SurfacePoint,
    strengths: Strengths,
    held: dict[str, Any],
    xp: Any = np,
) -> Held:
    """All that one sweep holds fixed."""
    # A fit of many unknowns to few points leaves less than the noise in their distances.
    counted = xp.maximum(xp.sum(xp.asarray(look.weights)), 1.0)
    left = xp.maximum(1 - strengths.determined / counted, _LEAST_LEFT)
    precisions = {prior.name: prior.precisions(strengths.values) for prior in model.priors}
    shifts = y.shared.get("shifts") if scene.of_points is not None else None
    of_distances = left * xp.asarray(look.precisions, np.float64 if xp is np else None)
    return Held(look.pairs, at.face, scene.of_points, shifts, of_distances, held, precisions)


@eqx.filter_jit
def _retract(model: Model, y: Variables, step: Float[Array, "n"]) -> Variables:
    return model.keep_lasting(model.retract(y, model.layout.split(step)))


@jax.jit
def measure_movement(before: js.RefinedSurface, after: js.RefinedSurface) -> Float[Array, ""]:
    """How far a surface moved across itself: nine tenths of its vertices by less than this.

    The rest may be where the control mesh is too coarse for the scan, and points change sides for ever.
    """
    return jnp.quantile(jnp.abs(dot(after.normals, after.vertices - before.vertices)), _MOST)


def loose_damping(model: Model, xp: Any = np) -> Float[AnyArray, "n"]:
    """The damping of unknowns that go on."""
    layout, edge = model.layout, np.float64(model.edge) if xp is np else model.edge
    parts = [xp.full(layout.n_own, (_STEP * edge) ** -2)]
    for _, of in layout.shared:
        size = int(np.prod(of.shape, dtype=int))
        usual = (_STEP * edge) ** -2 if of.lever is not None else edge**-2 if of.common else 0.0
        parts.append(xp.full(size, usual))
    return xp.concatenate(parts)


def active_unknowns(model: Model, shifting: Any, xp: Any = np) -> Bool[AnyArray, "k"]:
    """Which shared unknowns take part in a step: shifts, and the motion that goes with them, once they are free."""
    of_shifts = ("shifts", "motion")
    parts = [
        xp.broadcast_to(
            xp.asarray(shifting) if name in of_shifts else xp.ones((), bool), (int(np.prod(of.shape, dtype=int)),)
        )
        for name, of in model.layout.shared
    ]
    return xp.concatenate([xp.zeros(0, bool), *parts])


def scale_damping(
    model: Model, hold: AnyArray, factor: Float[AnyArray, "v"], loose: AnyArray, xp: Any
) -> Float[AnyArray, "n"]:
    """The damping, where that of vertices and their normals changes by a factor."""
    layout = model.layout
    by = xp.concatenate([layout.repeat_per_unknown(factor, xp), xp.ones(layout.n - layout.n_own, factor.dtype)])
    lasting = xp.where(xp.arange(layout.n) < layout.n_own, xp.clip(hold * by, loose, _FASTEST * loose), hold)
    return lasting


def next_damping(
    model: Model, damping: Damping, step: AnyArray, loose: AnyArray, shifting: Any, xp: Any
) -> Float[AnyArray, "n"]:
    """Control vertices that turn back are held faster, those that go on are let go again; and slices likewise."""
    layout, n_own = model.layout, model.layout.n_own
    agree = xp.sum((step * damping.step)[:n_own].reshape(layout.n_vertices, layout.width), axis=1)
    factor = xp.where(agree < 0, HOLD, _LET_GO).astype(step.dtype)
    hold = scale_damping(model, damping.hold, factor, loose, xp)
    prior: Any = model.prior("shift")
    if prior is None:
        return hold
    columns = layout.columns("shifts")
    back = xp.sum((step * damping.step)[columns].reshape(-1, 2), axis=1) < 0
    loosest = xp.asarray(prior.deviation, step.dtype) ** -2
    of_slices = xp.repeat(xp.where(back, HOLD, _LET_GO).astype(step.dtype), 2)
    held = xp.clip(hold[columns] * of_slices, loosest, _FASTEST * loosest)
    held = xp.where(xp.asarray(shifting), held, hold[columns])
    return xp.concatenate([hold[: columns.start], held, hold[columns.stop :]])
