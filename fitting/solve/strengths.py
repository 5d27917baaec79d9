"""How strongly priors hold, found from the scan: the strengths that make the scan most probable, place by place.

The strength of a Gaussian prior under which data are most probable obeys a fixed point: the squared rows that are left,
over their variance, equal the number of rows that the data do not determine. Source: D. MacKay, Bayesian interpolation,
1992, eq. (4.7); as an update for any number of strengths at once, S. Wood and M. Fasiolo, A generalized Fellner-Schall
method for smoothing parameter optimization, 2017, eq. (4). Here every control face has strengths of its own, shared
with its neighbourhood as the mean of logarithms and, a little, with the whole surface: a skull is smoother than an ear.

The means of the bend prior are the template's bends times one number, the likeness. Under given strengths that is most
probable which is found together with the surface, as one more unknown. Source: C. Henderson, Best linear unbiased
estimation and prediction under a selection model, 1975, eq. (8).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

import jaxsubdiv as js

from ..model.priors.base import backend
from ..model.priors.bend import Bend
from ..model.procrustes import align_shape, size_ratio
from ..model.residual import Model
from ..model.unknowns import AnyArray, Variables

Solve = Callable[[AnyArray], AnyArray]
Average = Callable[[AnyArray], AnyArray]

_PROBES = 24  # random vectors of a trace; a face and its neighbourhood average over a hundred rows besides
_DETERMINED_PROBES = 16
_SHARE_OF_ALL = 0.05  # how much the whole surface counts beside a face
_TINY = float(np.finfo(np.float32).tiny)
_LARGEST_CHANGE = 5.0  # of a strength in one sweep: what it depends on is known for the present one only
_PART_OF_WAY = 0.5  # of the likeness: it and the strengths are found in turns, whole steps overshoot
_SETTLED = 0.3  # mean change of the logarithm of a strength in a sweep
_SETTLED_LIKENESS = 0.1  # its change
_SOFTER = 0.3  # factor of a given strength from sweep to sweep, down to its own
_RANGE = 1.0, 1e-5  # most and least standard deviation that is looked for, in control edges


class Strengths(eqx.Module):
    """1 / variances of the rows of priors, as far as they are found or annealed.

    Attributes:
        values: by the name of the prior, in 1/mm^2; "likeness" is among them.
        determined: about how many unknowns the scan determines.
        annealed: whether they have come to rest.
    """

    values: dict[str, Any]
    determined: Any
    annealed: Any


@runtime_checkable
class Linearised(Protocol):
    """Rows of a fit about one place, as `SparseEquations` and `OperatorEquations` have them."""

    model: Model
    values: dict[str, Any]

    def times(self, name: str, x: AnyArray) -> AnyArray:
        """The derivatives of a prior's rows times vectors of unknowns `[n, k]`."""
        ...

    def transposed(self, name: str, x: AnyArray) -> AnyArray:
        """The transposed derivatives times values a row `[m, k]`."""
        ...


def first_strengths(model: Model) -> Strengths:
    """Those of the first sweep: stiffer than they will be."""
    bend = model.prior("bend")
    given = bend.likeness if isinstance(bend, Bend) else None
    xp = backend(model.edge)
    likeness = xp.zeros(()) if given is None else xp.asarray(given)
    values: dict[str, Any] = {prior.name: prior.first_strengths() for prior in model.priors if prior.n_strengths}
    values = {name: clip_strengths(model, value, xp) for name, value in values.items()}
    for prior in model.priors:
        given = prior.given_strengths() if prior.n_strengths else None
        if given is not None:
            values[prior.name] = xp.maximum(values[prior.name], given)
    return Strengths(values | {"likeness": likeness}, xp.zeros(()), xp.zeros((), bool))


def clip_strengths(model: Model, value: AnyArray, xp: Any = np) -> AnyArray:
    """Strengths of deviations that make sense for the size of the control mesh."""
    edge = float(model.edge) if xp is np else model.edge
    return xp.clip(value, *((edge * part) ** -2.0 for part in _RANGE))


class FromTargets(eqx.Module):
    """Strengths that are given, or that a pilot fit found: a fit anneals to them from stiffer ones.

    Attributes:
        values: by the name of the prior; what is missing, and has settings of its own, anneals to those.
        likeness: of all bends.
        determined: about how many unknowns a scan determines.
    """

    values: dict[str, Any]
    likeness: Any
    determined: Any

    def start(self, strengths: Strengths) -> Strengths:
        """Those of the first sweep, never softer than the targets."""
        first = {name: jnp.maximum(strengths.values[name], target) for name, target in self.values.items()}
        return Strengths(strengths.values | first | {"likeness": self.likeness}, self.determined, strengths.annealed)

    def update(self, model: Model, strengths: Strengths, xp: Any) -> Strengths:
        """Those of the next sweep."""
        found, annealed = dict(strengths.values), []
        for name, target in self.values.items():
            target = xp.asarray(target, found[name].dtype)
            found[name] = xp.maximum(found[name] * _SOFTER, target)
            annealed.append(xp.all(found[name] <= target))
        return Strengths(found, strengths.determined, xp.all(xp.stack(annealed)) if annealed else xp.ones((), bool))


class FromScan(eqx.Module):
    """Strengths that make the scan most probable; those that the settings give are annealed to."""

    def update(
        self,
        model: Model,
        y: Variables,
        strengths: Strengths,
        rows: Linearised,
        step: AnyArray,
        solve_prior: Callable[[], Solve],
        solve_posterior: Solve,
        xp: Any = np,
    ) -> Strengths:
        """Strengths and likeness after a step.

        Args:
            y: where the step started.
            rows: linearised about that.
            step: the step taken, `[n]`.
            solve_prior: makes the solution with the normal matrix of all priors.
            solve_posterior: solves with that of the priors and the scan.
        """
        values, bend = dict(strengths.values), model.prior("bend")
        assert isinstance(bend, Bend)
        settled, likeness = [], values["likeness"]
        for prior in model.priors:
            given = prior.given_strengths() if prior.n_strengths else None
            if given is not None:
                values[prior.name] = xp.maximum(values[prior.name] * _SOFTER, xp.asarray(given))
                settled.append(xp.all(values[prior.name] <= xp.asarray(given)))
        found = [prior for prior in model.priors if prior.n_strengths and prior.given_strengths() is None]
        if not found:
            return Strengths(values, strengths.determined, xp.all(xp.stack(settled)))
        left = {prior.name: rows.values[prior.name] + rows.times(prior.name, step[:, None])[:, 0] for prior in found}
        if bend.finds_likeness:
            moved = align_shape(xp.asarray(model.template, step.dtype), xp.asarray(y.control.vertices, step.dtype), xp)
            expected = size_ratio(xp.asarray(model.template, step.dtype), moved, xp) * xp.asarray(
                bend.template, step.dtype
            )
            values["likeness"] = next_likeness(
                likeness,
                expected,
                values["bend"][bend.of_rows],
                left["bend"],
                lambda x: rows.transposed("bend", x),
                solve_posterior,
                xp,
            )
        average = neighbourhood_mean(model.topology)
        families = []
        for prior in found:
            of_faces = prior.n_strengths == model.topology.n_control_faces
            one = Family(
                prior.name, values[prior.name], left[prior.name], prior.strength_rows(), average if of_faces else None
            )
            families.append(one)
        new = next_precisions(families, rows, solve_prior(), solve_posterior, xp)
        changes, used = [], []
        for prior, precision in zip(found, new, strict=True):
            clipped = clip_strengths(model, precision, xp)
            of_rows = prior.strength_rows()
            has_rows = _sums(of_rows[of_rows >= 0] if xp is np else of_rows, None, prior.n_strengths, xp) > 0
            changes.append(xp.where(has_rows, xp.abs(xp.log(clipped / values[prior.name])), 0.0))
            used.append(has_rows)
            values[prior.name] = clipped
        used = xp.concatenate(used).astype(step.dtype)
        change = xp.concatenate(changes).sum() / xp.maximum(used.sum(), 1)
        settled += [change < _SETTLED, xp.abs(values["likeness"] - likeness) < _SETTLED_LIKENESS]
        return Strengths(values, strengths.determined, xp.all(xp.stack([xp.asarray(one) for one in settled])))


def count_determined(n: int, solve_posterior: Solve, of_data: Solve, xp: Any = np) -> AnyArray:
    """The trace of the scan's part of the posterior, by random vectors: how many unknowns the scan determines.

    Args:
        n: number of unknowns.
        of_data: multiplies by the normal matrix of the scan.
    """
    probes = xp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], size=(n, _DETERMINED_PROBES)))
    return xp.maximum(xp.mean(xp.sum(probes * solve_posterior(of_data(probes)), axis=0)), 0.0)


class Family(NamedTuple):
    """Rows of one prior, whose strengths are found."""

    name: str
    precision: AnyArray
    """1 / variance of a row, a strength each, in 1/mm^2."""
    left: AnyArray
    """The rows after the step, in mm."""
    strength: Int[np.ndarray, "m"]
    """Which is that of each row; -1 for rows of another kind."""
    average: Average | None
    """Averages a value a strength over its neighbourhood; None where each stands for itself."""


def neighbourhood_mean(topology: js.Topology) -> Average:
    """Averages of a value a face over the faces around each of its corners, the corners counting alike."""
    parts = [topology.control_faces[size] for size in (3, 4)]
    xp = backend(*parts)
    corners = xp.concatenate([xp.asarray(part).reshape(-1) for part in parts])
    counts = np.concatenate([np.full(len(part), part.shape[1]) for part in parts])
    face = np.repeat(np.arange(len(counts)), counts)
    around = xp.maximum(_sums(corners, None, topology.n_control_vertices, xp), 1)

    def average(values: AnyArray) -> AnyArray:
        xp = jnp if isinstance(values, jax.Array) else np
        at_vertices = _sums(corners, values[face], len(around), xp) / xp.asarray(around, values.dtype)
        return _sums(face, at_vertices[corners], len(counts), xp) / xp.asarray(counts, values.dtype)

    return average


def _sums(index: AnyArray, values: AnyArray | None, n: int, xp: Any) -> AnyArray:
    """Sums of values by their index; how many there are, where there are no values. Negative indices count for none."""
    if xp is np:
        kept = index >= 0
        return np.bincount(index[kept], None if values is None else values[kept], n)
    summed = jnp.ones(len(index)) if values is None else values
    return jax.ops.segment_sum(jnp.where(jnp.asarray(index) >= 0, summed, 0), jnp.maximum(jnp.asarray(index), 0), n)


def next_precisions(
    families: list[Family],
    rows: Linearised,
    solve_prior: Solve,
    solve_posterior: Solve,
    xp: Any = np,
    n_probes: int = _PROBES,
) -> list[AnyArray]:
    """One step of the fixed point, for all families together.

    Args:
        rows: multiplies by the derivatives of each family's rows.
        solve_prior: with the normal matrix of all priors.
        solve_posterior: with that of the priors and the scan.
        n_probes: random vectors of the traces.
    """
    generator = np.random.default_rng(0)
    roots, probes, sides = [], [], 0.0
    drawn = generator.choice([-1.0, 1.0], size=(sum(len(one.left) for one in families), n_probes))
    first = 0
    for one in families:
        root = xp.where(one.strength >= 0, xp.sqrt(one.precision)[xp.maximum(one.strength, 0)], 0.0)
        probe = xp.asarray(drawn[first : first + len(one.left)])
        roots.append(root)
        probes.append(probe)
        sides = sides + rows.transposed(one.name, probe * root[:, None])
        first += len(one.left)
    free = solve_prior(sides) - solve_posterior(sides)
    found = []
    for one, root, probe in zip(families, roots, probes, strict=True):
        n = len(one.precision)
        determined = root * xp.mean(probe * rows.times(one.name, free), axis=1)
        determined = xp.maximum(_sums(one.strength, determined, n, xp), 0)
        squares = _sums(one.strength, one.left**2, n, xp)
        has_rows = _sums(one.strength, None, n, xp) > 0
        average = (lambda values: values) if one.average is None else one.average
        found.append(_next_of_family(one.precision, determined, squares, has_rows, average, xp))
    return found


def _next_of_family(
    precision: AnyArray,
    determined: AnyArray,
    left: AnyArray,
    has_rows: Bool[AnyArray, "s"],
    average: Average,
    xp: Any,
) -> AnyArray:
    """Next strengths, from how many rows the data determine on each face, and the squares that are left of all."""
    # Where the scan says nothing, in a hole, the surface is as smooth as elsewhere.
    counted = has_rows.astype(precision.dtype)
    shared = _SHARE_OF_ALL * determined.sum() / xp.maximum(counted.sum(), 1)
    weights = determined + (shared + _TINY) * counted + _TINY
    usual = xp.exp(xp.sum(weights * xp.log(precision)) / xp.sum(weights))
    found = (shared + determined) / xp.maximum(shared / usual + left, _TINY)
    changed = precision * xp.clip(found / precision, 1 / _LARGEST_CHANGE, _LARGEST_CHANGE)
    # Means of the logarithms: means of the bends would be those of the one ear or rim in a neighbourhood, and leave
    # noise in all of it. Edges that are not halved belong to one face of two, and the other has no rows.
    votes = average(counted)
    means = average(xp.log(xp.where(has_rows, changed, 1.0))) / xp.where(votes > 0, votes, 1)
    # Rows in holes alone: nothing is known of them.
    return xp.where((votes > 0) & (determined.sum() >= 1), xp.exp(means), precision)


def next_likeness(
    likeness: AnyArray,
    expected: AnyArray,
    precision: AnyArray,
    bends: AnyArray,
    transposed: Solve,
    solve_posterior: Solve,
    xp: Any = np,
) -> AnyArray:
    """A step towards the likeness, from 0 to 1, that makes the scan most probable; none where that is as near as the
    scan can tell.

    Args:
        expected: the template's bends in mm.
        precision: 1 / variance of each bend.
        bends: departures from what is expected now, in mm.
        transposed: multiplies by their transposed derivatives.
        solve_posterior: with the normal matrix of the priors and the scan.
    """
    side = transposed((precision * expected)[:, None])
    # Beforehand it is 0, give or take 1: a template without bends, or without a scan over them, is expected nowhere.
    slope = xp.sum(expected * precision * bends) - likeness
    curvature = xp.sum(expected * precision * expected) - xp.sum(side * solve_posterior(side)) + 1
    changed = xp.clip(likeness + _PART_OF_WAY * slope / curvature, 0.0, 1.0)
    return xp.where(slope**2 < curvature, likeness, changed)  # less than its own standard deviation
