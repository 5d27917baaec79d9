"""One sweep's equations: what scan and priors say of the unknowns, and the step that makes both most probable."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import SuperLU, splu

import jaxsubdiv as js
from jaxsubdiv.linalg import unit

from ..model.pairing import Look
from ..model.priors.boundary import BoundaryCurve, pair_with_boundary
from ..model.priors.shifts import Border, Shifts, border_of
from ..model.priors.symmetry import Mirror, Symmetry, Ties, mirror_at, ties
from ..model.residual import (
    Anchors,
    Expected,
    Pairs,
    Priors,
    Rows,
    Start,
    bend_asymmetry,
    bend_edges,
    bend_height,
    control_edges,
    control_faces_of,
    prior_faces,
    with_control_vertices,
)
from ..model.unknowns import Free, Unknowns, no_offset
from ..scan.closest_points import AnyArray
from ..start.folds import Folds
from .elements import (
    Derivatives,
    Elements,
    differentiate,
    differentiate_distances,
    equations_of_many,
    find_elements,
    find_patches,
    flat,
    forgets_some,
    jacobian,
    normal_matrix,
    padded,
    times_transposed,
    to_unknowns,
)
from .strengths import Solve, neighbourhoods, next_likeness, next_precision

# Standard deviation of a step in control edges: what neither scan nor priors hold stays near where it is. A control
# vertex that turns back is held faster, and one that goes on is let go again: where the surface cannot follow the scan
# (an ear in a coarse mesh) points change sides from sweep to sweep, and exact steps would go to and fro for ever.
STEP, HOLD, LET_GO, FASTEST = 0.25, 8.0, 0.7, 1e6
_TRIES = 6  # of a step that turns faces upside down: their vertices are held faster each time
STIFFER = 10.0  # the bend prior's strength in the first sweep, over that of the template's own bends
SOFTER = 0.3  # factor of the bend prior from sweep to sweep, down to its own strength
_SETTLED = 0.3  # mean change of the logarithm of the bend prior's strength in a sweep
_SETTLED_LIKENESS = 0.1  # its change
LEAST_LEFT = 0.1  # of the degrees of freedom: what is less says that the scan has too few points
_PROBES = 16  # random vectors of a trace
_MOST_RINGS = 3
_TINY = np.finfo(float).tiny
_BENDS = 1.0, 1e-5  # most and least bend asymmetry that is looked for, in control edges
_FARTHEST = 1e3  # mm: standard deviation of a shift without a prior, so that a slice without weight has an equation


class _Equations(NamedTuple):
    """Normal equations of a sweep."""

    data: Float[np.ndarray, "_"]
    """Values of the scan's matrix, in the pattern of the elements."""
    prior: Float[np.ndarray, "_"]
    """Of the priors' matrix."""
    gradient: Float[np.ndarray, "n"]
    bends: Float[np.ndarray, "b"]
    """And their heights, less what is expected of both."""
    by_bend: Float[np.ndarray, "b d"]
    ties: Ties | None
    """Of the prior of symmetry, whose rows lie in no control face."""
    border: Border | None
    """Of the shifts, where slices may move."""

    @property
    def tied(self) -> sp.csc_array | None:
        """The matrix of the ties."""
        return None if self.ties is None else (self.ties.by.T @ self.ties.by).tocsc()


class Found(NamedTuple):
    """What makes a problem besides its options, and what the sweeps find out."""

    template: Float[np.ndarray, "v 3"]
    """Control vertices where the fit started, in mm."""
    bend_precision: Float[np.ndarray, "s"]
    """1 / variance of the bends, a control face, and then of their heights; empty before the first sweep."""
    expected: Expected
    """Of likeness 1, and at the size of the start."""
    likeness: float
    determined: float
    annealed: bool
    hold: Float[np.ndarray, "n"]
    """What held the unknowns in the last sweep."""
    anchors: Anchors | None
    symmetry: Symmetry | None = None
    curve: BoundaryCurve | None = None


class Memory(NamedTuple):
    """What a problem knows after a sweep, and needs for the next."""

    bend_precision: Float[np.ndarray, "s"]
    likeness: float
    determined: float
    annealed: bool
    hold: Float[np.ndarray, "n"]
    last_step: Float[np.ndarray, "n"]


class Problem:
    """What stays the same from sweep to sweep; and the strength of the bend prior, which the sweeps find."""

    def __init__(
        self,
        scheme: js.AbstractScheme,
        topology: js.Topology,
        control: js.Control,
        free: Free,
        priors: Priors,
        anchors: Anchors | None = None,
        symmetry: Symmetry | None = None,
        curve: BoundaryCurve | None = None,
        alike: Bool[np.ndarray, "f"] | None = None,
    ):
        self._topology, self.free, self._priors, self._anchors = topology, free, priors, anchors
        self._symmetry, self._curve = symmetry, curve
        self._template = np.asarray(control.vertices, np.float64)
        self._zero = no_offset(free, scheme, control)
        masks = free.of(scheme, len(self._template))
        self.is_free = flat(masks).astype(bool)
        # A surface of any shape: only to tell which face lies where.
        surface = js.refine(scheme, topology, control)
        owner = control_faces_of(scheme, topology, surface, control)
        self._n_faces = topology.n_control_faces
        self._patches = find_patches(surface, owner, self._n_faces)
        self._faces = prior_faces(scheme, topology, anchors, owner, 0 if masks.h is None else masks.h.size)
        self._edges, self._bend_edges = control_edges(topology), bend_edges(scheme, topology)
        own = with_control_vertices(topology, scheme, control, surface)
        self._bends = np.asarray(bend_asymmetry(own, self._bend_edges), np.float64)
        heights = np.asarray(bend_height(own, self._bend_edges), np.float64)
        there = np.ones(len(heights), bool) if alike is None else alike[self._faces.bend]
        there &= priors.bend is None if priors.likeness is None else bool(priors.likeness > 0)
        rows = np.flatnonzero(there & (priors.bend is None))  # nothing says how closely heights should be kept, else
        self._expect(Expected(np.where(there, self._bends, 0.0), rows, heights[rows]))
        self.around = neighbourhoods(topology)
        self._folds = Folds(topology)
        self._edge = float(js.edge_length(topology, control.vertices))
        self._elements: Elements | None = None
        self._precision: Float[np.ndarray, "s"] = np.zeros(0)  # see `Found`; from the first sweep on
        self.likeness = 0.0 if priors.likeness is None else float(priors.likeness)
        self._hold = np.full(self.is_free.shape, (STEP * self._edge) ** -2)
        self.loose = self._hold.copy()
        self._last_step = np.zeros(self.is_free.shape)
        self.annealed = False
        self.determined = 0.0

    def step(
        self, scheme: js.AbstractScheme, control: js.Control, seen: Look, shifts: Shifts | None = None
    ) -> tuple[Unknowns, Shifts | None]:
        """The most probable offset from here, to first order, and the shifts of slices together with it.

        It also finds the next strength of the bend prior.
        """
        found = self._equations(scheme, control, seen, shifts)
        hold, tries = self._hold, 0
        while True:
            held = factorise(self._whole(found, hold, 0.0 if shifts is None else np.repeat(shifts.hold, 2)))
            step, of_shifts = self._solution(found, held)
            offset = to_unknowns(jnp.asarray(step), self._zero)
            rash, tries = self._rash(control, offset), tries + 1
            if tries == _TRIES or not rash.any():
                break
            hold = self._held(hold, np.where(rash, HOLD, 1.0))  # for this sweep alone
        if shifts is not None:
            shifts = self._hold_what_shifts_back(shifts, of_shifts.reshape(-1, 2))
        # What is held says nothing of what the scan determines.
        slack = shifts is None and not np.any(hold > self.loose)
        loose = held if slack else factorise(self._whole(found, self.loose))
        self._hold_what_turns_back(step)
        self._count_determined(found, loose)
        if self._priors.bend is None:
            self._find_bend(found, control, step, loose)
        else:
            self._set_bend(self._precision * SOFTER)
        return offset, shifts

    def precision_matrix(
        self, scheme: js.AbstractScheme, control: js.Control, seen: Look, shifts: Shifts | None = None
    ) -> sp.csc_array:
        """Of the free unknowns about here, and after them of what `Border` adds: the inverse of their covariance."""
        return self._whole(self._equations(scheme, control, seen, shifts), self.loose)

    def _equations(
        self, scheme: js.AbstractScheme, control: js.Control, seen: Look, shifts: Shifts | None
    ) -> _Equations:
        start = self.start(scheme, control)
        found = self._analyse(start) if self._elements is None else self._differentiate(start)
        elements = self.elements
        data, gradient, border = self._of_distances(found, seen, shifts)
        rows, by_priors = jax.tree.map(lambda values: np.asarray(values, np.float64), (found.rows, found.by_rows))
        if not len(self._precision):
            families = [self._bends] + ([self._expected.heights] if len(self._expected.rows) else [])
            first = [1 / max(float(np.mean(np.square(of))) / STIFFER, _TINY) for of in families]
            self._set_bend(np.repeat(first, self._n_faces))
        weights, of_priors = np.concatenate(self.prior_precisions()), self._row_faces(start)
        gradient += times_transposed(elements, by_priors, weights * np.concatenate(rows[1:]), of_priors)
        prior = normal_matrix(elements, by_priors, weights, of_priors)
        mirror = self.mirror(control)
        tied = None if mirror is None else ties(mirror, control, self._zero)
        if tied is not None:
            gradient += tied.by.T @ tied.rows
        if shifts is not None and border is not None:
            of_prior = self._shift_precision * shifts.within.ravel()
            across = sp.csr_array(border.across[self.is_free, :])
            border = border._replace(across=across, gradient=border.gradient + of_prior)
        bends = np.append(rows.bend, rows.height)
        return _Equations(data, prior, gradient, bends, by_priors[: len(bends)], tied, border)

    @property
    def last_hold(self) -> Float[np.ndarray, "n"]:
        """What the last sweep held the unknowns by, but no faster than by one turn back."""
        return np.minimum(self._hold, HOLD * self.loose)

    def mirror(self, control: js.Control) -> Mirror | None:
        """The prior of symmetry about here; None where there is none."""
        if self._symmetry is None:
            return None
        return mirror_at(self._symmetry, float(self._priors.symmetry), self._topology, control, self._zero)

    def prior_precisions(self) -> Rows:
        """1 / variance of every row of the priors; there are none of distances."""
        faces = self._faces
        stretch, h = float(self._priors.stretch) ** -2, float(self._priors.h) ** -2
        return Rows(
            distance=np.zeros(0),
            bend=self._precision[faces.bend],
            height=self._precision[self._height_strengths],
            stretch=np.full(len(faces.stretch), stretch),
            margin=np.ones(len(faces.margin)),
            landmark=np.ones(len(faces.landmark)),
            rim=np.ones(0 if self._curve is None else 2 * len(self._curve.points)),
            h=np.full(len(faces.h), h),
        )

    def distance_precisions(self, seen: Look) -> Float[np.ndarray, "p"]:
        """1 / variance of every distance. A fit of many unknowns to few points leaves less than the noise in them."""
        left = max(1 - self.determined / max(float(np.sum(seen.weights)), 1.0), LEAST_LEFT)
        return left * np.asarray(seen.precisions, np.float64)

    def start(self, scheme: js.AbstractScheme, control: js.Control) -> Start:
        """The arguments of the residuals, for a sweep that starts here."""
        moved = moved_to(self._template, np.asarray(control.vertices, np.float64))
        template = jnp.asarray(moved, control.vertices.dtype)
        by = larger(self._template, moved)
        expected = self._expected.times(self.likeness * by, by)
        expected = Expected(
            *(jnp.asarray(part, template.dtype if part.dtype.kind == "f" else None) for part in expected)
        )
        rim = None
        if self._curve is not None:
            rim = pair_with_boundary(self._curve, js.refine(scheme, self._topology, control))
        tables = self._anchors, self._edges, self._bend_edges
        return Start(scheme, self._topology, control, template, *tables, rim, expected)

    def _expect(self, expected: Expected) -> None:
        self._expected = expected
        self._faces = self._faces._replace(height=self._faces.bend[expected.rows])

    @property
    def _height_strengths(self) -> Int[np.ndarray, "g"]:
        """Which strength that of each height is: those of the faces, after those of the bends."""
        return self._faces.height + self._n_faces

    @property
    def _finds_likeness(self) -> bool:
        return self._priors.likeness is None and self._priors.bend is None

    def _row_faces(self, start: Start) -> Int[np.ndarray, "m"]:
        """The control face of every row of the priors."""
        faces = self._faces
        if start.rim is not None:
            faces = faces._replace(rim=np.repeat(self._patches.owner[np.asarray(start.rim.face)], 2))
        return np.concatenate(faces)

    def across(
        self, scheme: js.AbstractScheme, control: js.Control
    ) -> tuple[Int[np.ndarray, "w"], Float[np.ndarray, "w d"]]:
        """How the vertices of the surface move along their normals: the control face of each, and the derivatives."""
        surface, patches = js.refine(scheme, self._topology, control), self._patches
        face, slot = np.zeros((2, surface.vertices.shape[0]), np.int64)
        corners = self.corners
        face[corners], slot[corners] = patches.owner[:, None], patches.slots
        by_surface = np.asarray(self._differentiate(self.start(scheme, control)).by_surface, np.float64)
        return face, np.einsum("vdx,vx->vd", by_surface[face, slot], np.asarray(surface.normals, np.float64))

    def across_control(self, control: js.Control) -> tuple[Int[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
        """How the control vertices move along their normals: the unknowns of each, and the derivatives."""
        n = len(self._template)
        normals = np.asarray(unit(control.normals))
        if self._zero.vertices is None:
            return np.full((n, 3), self.elements.n), normals
        width = 3 + (0 if self._zero.normals is None else 2)
        return width * np.arange(n)[:, None] + np.arange(3), normals

    def _find_bend(self, found: _Equations, control: js.Control, step: Float[np.ndarray, "n"], factor: SuperLU) -> None:
        faces, n = self._faces, len(self._bends)
        by = jacobian(self.elements, found.by_bend, np.append(faces.bend, faces.height))[:, self.is_free]
        bends, before, likeness = found.bends + by @ step[self.is_free], self._precision, self.likeness
        strength = np.append(faces.bend, self._height_strengths)
        solve = _first_part_of(factor)  # what the scan says of the bends, not knowing how its slices are shifted
        if self._finds_likeness:
            moved = moved_to(self._template, np.asarray(control.vertices, np.float64))
            expected = larger(self._template, moved) * self._expected.bends
            self.likeness = next_likeness(likeness, expected, before[faces.bend], bends[:n], by[:n], solve)
        of_priors = factorise(self._matrix(found.prior, self.loose, found.tied)).solve
        self._set_bend(next_precision(before, bends, by, strength, of_priors, solve, self.around))
        used = np.bincount(strength, minlength=len(before)) > 0
        settled = np.abs(np.log(self._precision / before))[used].mean() < _SETTLED
        self.annealed = bool(settled and abs(self.likeness - likeness) < _SETTLED_LIKENESS)

    def _count_determined(self, found: _Equations, factor: SuperLU) -> None:
        """The trace of the scan's part of the posterior, by random vectors."""
        probes = np.random.default_rng(0).choice([-1.0, 1.0], size=(factor.shape[0], _PROBES))
        of_data = self._matrix(found.data, np.zeros(len(self.is_free)))
        if found.border is not None:
            of_data = found.border.around(of_data, 0.0, np.zeros((int(self.is_free.sum()), 3)), 0.0)
        self.determined = max(float(np.mean(np.sum(probes * factor.solve(of_data @ probes), axis=0))), 0.0)

    def _solution(self, found: _Equations, factor: SuperLU) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "k"]]:
        """The step of the unknowns, and of the shifts."""
        n, step = int(self.is_free.sum()), np.zeros(self.elements.n)
        of_shifts = np.zeros(0) if found.border is None else found.border.gradient
        sides = np.zeros(factor.shape[0])
        sides[: n + len(of_shifts)] = np.append(found.gradient[self.is_free], of_shifts)
        solution = -factor.solve(sides)
        step[self.is_free] = solution[:n]
        if found.ties is not None:
            step = found.ties.with_plane(step, _first_part_of(factor), self.is_free)
        return step, solution[n : n + len(of_shifts)]

    def _rash(self, control: js.Control, offset: Unknowns) -> Bool[np.ndarray, "v"]:
        """Vertices of control faces that a step would turn upside down."""
        if offset.vertices is None:
            return np.zeros(len(self._template), bool)
        before, after = (np.asarray(x, np.float64) for x in (control.vertices, control.vertices + offset.vertices))
        return self._folds.corners_of(self._folds.turned_over(after) & ~self._folds.turned_over(before))

    def _hold_what_turns_back(self, step: Float[np.ndarray, "n"]) -> None:
        n = self._vertex_width * len(self._template)
        agree = np.sum((step * self._last_step)[:n].reshape(len(self._template), self._vertex_width), axis=1)
        self._hold = self._held(self._hold, np.where(agree < 0, HOLD, LET_GO))
        self._last_step = step

    def _held(self, hold: Float[np.ndarray, "n"], faster: Float[np.ndarray, "v"]) -> Float[np.ndarray, "n"]:
        """What holds the unknowns, where that of vertices and their normals changes by a factor."""
        of_others = np.ones(len(hold) - self._vertex_width * len(faster))
        by = np.concatenate([np.repeat(faster, self._vertex_width), of_others])
        return np.clip(hold * by, self.loose, FASTEST * self.loose)

    @property
    def _vertex_width(self) -> int:
        """Number of unknowns that each control vertex has, with its normal."""
        return (len(self._hold) - len(self._faces.h)) // max(len(self._template), 1)

    def _hold_what_shifts_back(self, shifts: Shifts, step: Float[np.ndarray, "s 2"]) -> Shifts:
        back = np.sum(step * shifts.step, axis=1) < 0
        loosest = self._shift_precision
        hold = np.clip(shifts.hold * np.where(back, HOLD, LET_GO), loosest, FASTEST * loosest)
        return shifts._replace(within=shifts.within + step, step=step, hold=hold)

    def _set_bend(self, precision: Float[np.ndarray, "f"]) -> None:
        """The strength found; or the one that the priors ask for, or a stiffer one while it anneals."""
        self._precision = np.clip(precision, *((self._edge * part) ** -2.0 for part in _BENDS))
        if self._priors.bend is not None:
            given = float(self._priors.bend) ** -2
            self._precision = np.maximum(self._precision, given)
            self.annealed = bool((self._precision <= given).all())

    def _analyse(self, start: Start) -> Derivatives:
        """Find which unknowns belong to which face: so few rings that explain all derivatives, which it returns."""
        for rings in range(1, _MOST_RINGS + 1):
            self._elements = find_elements(self._topology, self.free, start, rings)
            found = self._differentiate(start)
            if not forgets_some(self._elements, self._patches, found, self._row_faces(start)):
                return found
        raise ValueError(
            f"a face of {type(start.scheme).__name__} depends on control vertices more than {_MOST_RINGS} rings of "
            "faces away: the fit has no sparse derivatives to work with."
        )

    def _differentiate(self, start: Start) -> Derivatives:
        elements, faces = self.elements, self._row_faces(start)
        return differentiate(self._zero, start, elements.seeds, elements.seeds_of, faces, self._patches.vertices)

    def _of_distances(
        self, found: Derivatives, seen: Look, shifts: Shifts | None
    ) -> tuple[Float[np.ndarray, "_"], Float[np.ndarray, "n"], Border | None]:
        """The scan's matrix, in the pattern of the elements, its gradient, and what the shifts have to do with them."""
        elements, patches = self.elements, self._patches
        of_pairs = seen.pairs, self.distance_precisions(seen), np.asarray(seen.at.face)
        n_pairs = len(of_pairs[-1])
        if shifts is None and n_pairs > patches.vertices.size:
            return *equations_of_many(elements, patches, found, *of_pairs), None
        data, gradient, border, first = np.zeros(elements.pattern.nnz), np.zeros(elements.n), None, 0
        by_shifts = None if shifts is None else shifts.derivatives(seen.pairs.directions)
        for pairs, weights, at in padded(*of_pairs):
            distances, by, face = self._differentiate_distances(found, pairs, at)
            data += normal_matrix(elements, by, weights, face)
            gradient += times_transposed(elements, by, weights * distances, face)
            if by_shifts is not None:
                points = np.minimum(np.arange(first, first + len(at)), n_pairs - 1)  # the rows of `padded`
                this = border_of(jacobian(elements, by, face), sp.csr_array(by_shifts[points, :]), weights, distances)
                border = this if border is None else border.plus(this)
                first += len(at)
        return data, gradient, border

    def _differentiate_distances(
        self, found: Derivatives, pairs: Pairs, at: Int[np.ndarray, "p"]
    ) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p d"], Int[np.ndarray, "p"]]:
        """Distances, derivatives and control faces of pairs on these faces of the surface."""
        face = self._patches.owner[at]
        distances, by = differentiate_distances(found, pairs, face, self._patches.slots[at])
        return np.asarray(distances, np.float64), np.asarray(by), face

    @property
    def elements(self) -> Elements:
        """The structure, known after the first sweep."""
        assert self._elements is not None
        return self._elements

    @property
    def likeness_of_all(self) -> float:
        """The likeness, as a mean over all bends: those of a mesh that was split are mostly not expected."""
        return self.likeness * float(np.mean(self._expected.bends != 0))

    @property
    def owner(self) -> Int[np.ndarray, "g"]:
        """The control face of every face of the surface."""
        return self._patches.owner

    @property
    def corners(self) -> Int[np.ndarray, "g 4"]:
        """Vertices of every face of the surface; the last of a triangle twice."""
        return self._patches.vertices[self.owner[:, None], self._patches.slots]

    @property
    def topology(self) -> js.Topology:
        """Tables of the control mesh."""
        return self._topology

    @property
    def curve(self) -> BoundaryCurve | None:
        """That the surface ends at."""
        return self._curve

    def found(self) -> Found:
        """What a problem made anew has to be told, to know as much as this one."""
        of_bends = self._precision, self._expected, self.likeness
        of_sweeps = self.determined, self.annealed, self._hold
        return Found(self._template, *of_bends, *of_sweeps, self._anchors, self._symmetry, self._curve)

    def tell(self, found: Found) -> None:
        """Take over what the sweeps of another problem found."""
        self._precision, self.likeness = found.bend_precision, found.likeness
        self._expect(found.expected)
        self.determined, self.annealed, self._hold = found.determined, found.annealed, found.hold

    def memory(self) -> Memory:
        """What `recall` needs, to go on from here."""
        return Memory(self._precision, self.likeness, self.determined, self.annealed, self._hold, self._last_step)

    def recall(self, memory: Memory, scheme: js.AbstractScheme, control: js.Control) -> None:
        """Go on where another problem was, that made its first step from this scheme and control."""
        self._analyse(self.start(scheme, control))
        self._precision, self.likeness, self.determined, self.annealed, self._hold, self._last_step = memory

    @property
    def _shift_precision(self) -> float:
        return min(float(self._priors.shift), _FARTHEST) ** -2

    def _whole(
        self, found: _Equations, hold: Float[np.ndarray, "n"], hold_shifts: float | Float[np.ndarray, "k"] = 0.0
    ) -> sp.csc_array:
        """Of scan and priors; where slices may move, bordered, see `Border`."""
        matrix = self._matrix(found.data + found.prior, hold, found.tied)
        if found.border is None:
            return matrix
        of_vertices, normals = np.zeros((len(hold), 3)), self._zero.normals
        if self._zero.vertices is not None:
            at = (3 if normals is None else 5) * np.arange(len(self._template))
            for axis in range(3):
                of_vertices[at + axis, axis] = hold[at + axis]
        precision = self._shift_precision + hold_shifts
        return found.border.around(matrix, precision, of_vertices[self.is_free], self._edge**-2)

    def _matrix(self, values: np.ndarray, diagonal: np.ndarray, tied: sp.csc_array | None = None) -> sp.csc_array:
        pattern = self.elements.pattern
        whole = sp.csc_array((values, pattern.indices, pattern.indptr), shape=pattern.shape)
        whole = (whole + sp.diags_array(diagonal)).tocsc()
        whole = whole if tied is None else (whole + tied).tocsc()
        return whole if self.is_free.all() else whole[self.is_free][:, self.is_free].tocsc()


def factorise(matrix: sp.csc_array) -> SuperLU:
    # Symmetric and positive definite: no pivoting, and an ordering for symmetric patterns.
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _first_part_of(factor: SuperLU) -> Solve:
    """Solves with the inverse's block of the first unknowns: the covariance of them alone."""

    def solve(sides: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        whole = np.zeros((factor.shape[0], sides.shape[1]))
        whole[: len(sides)] = sides
        return factor.solve(whole)[: len(sides)]

    return solve


def moved_to(template: AnyArray, vertices: AnyArray, xp: Any = np, *, scale: bool = True) -> AnyArray:
    """The template `[v, 3]`, turned, scaled and shifted to where the vertices are. Source: Umeyama 1991.

    Args:
        xp: numpy or jax.numpy.
        scale: False only turns and shifts.
    """
    middle, there = template.mean(axis=0), vertices.mean(axis=0)
    a, b = template - middle[None], vertices - there[None]
    u, s, vt = xp.linalg.svd(b.T @ a)
    signs = xp.stack([xp.ones_like(s[0]), xp.ones_like(s[0]), xp.sign(xp.linalg.det(u @ vt))])
    factor = (s * signs).sum() / xp.maximum((a**2).sum(), np.finfo(a.dtype).tiny) if scale else 1.0
    return factor * a @ (u * signs[None] @ vt).T + there[None]


def larger(template: AnyArray, moved: AnyArray, xp: Any = np) -> AnyArray:
    """How many times as large as the template `[v, 3]` it is where it was moved to; see `moved_to`."""
    size, before = (xp.linalg.norm(x - x.mean(axis=0)[None]) for x in (moved, template))
    return size / xp.maximum(before, np.finfo(before.dtype).tiny)
