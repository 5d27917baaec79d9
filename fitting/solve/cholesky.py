"""Sparse Cholesky factors of symmetric positive definite matrices, for many matrices of one pattern.

`analyse` looks at the pattern once: it finds an order of elimination by nested dissection and splits the unknowns into
*fronts*, groups that are eliminated together. `Symbolic.factorise` then works front by front with dense linear algebra
(the multifrontal method), so that nearly all time is spent inside BLAS. A front has its own unknowns, and the later
unknowns ("rows") that they couple with once everything before them is eliminated. What the elimination of a front
leaves on its rows is handed to its parent: the front which owns the first of the rows.

With P the order of elimination, P A P' = R' R. Of R, each front stores one panel, an array in C order with one row per
unknown of the front (its own first) and one column per own unknown, that is, its share of R transposed.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from scipy.sparse import csgraph

POTRF, POTRI = get_lapack_funcs(("potrf", "potri"), dtype=np.float64)
TRSM, SYRK = get_blas_funcs(("trsm", "syrk"), dtype=np.float64)

LEAF = 100
"""Parts of the graph with at most so many unknowns are not dissected further."""

MERGE = 2.5e6
"""A front joins its parent where that costs fewer multiplications than this: so many take the time of its calls."""


@dataclass(frozen=True, eq=False)
class Front:
    """A group of unknowns that are eliminated together, all numbers being places in the order of elimination.

    Attributes:
        start, stop: its own unknowns
        rows: the later unknowns which they couple with, ascending
        parent: the front that receives what this one leaves on `rows`, -1 for none
        place: where `rows` are in the parent's front, whose own unknowns come first
        runs: (begin, end, place of begin) of each stretch of `rows` that is contiguous in the parent's front
        children: the fronts that have this one as their parent
        panel: where the front's panel is in the values of the factor
    """

    start: int
    stop: int
    rows: Int[np.ndarray, " r"]
    parent: int
    place: Int[np.ndarray, " r"]
    runs: tuple[tuple[int, int, int], ...]
    children: tuple[int, ...]
    panel: slice

    @property
    def own(self) -> int:
        return self.stop - self.start

    @property
    def size(self) -> int:
        return self.stop - self.start + len(self.rows)


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the fronts keep the unknowns.

    Attributes:
        front_of: the front that owns each step
        start: the first step of each front
        own: the number of steps that each front owns
        keys: (front * n + row) for the rows of all fronts, ascending
        first: where the rows of each front begin among the keys
    """

    front_of: Int[np.ndarray, " n"]
    start: Int[np.ndarray, " F"]
    own: Int[np.ndarray, " F"]
    keys: Int[np.ndarray, " R"]
    first: Int[np.ndarray, " F"]

    def locate(self, front: Int[np.ndarray, "*s"], step: Int[np.ndarray, "*s"]) -> Int[np.ndarray, "*s"]:
        """The places of steps among the unknowns of fronts, own ones first."""
        place = step - self.start[front]
        below = place >= self.own[front]
        outer = front[below]
        key = outer * len(self.front_of) + step[below]
        at = np.searchsorted(self.keys, key)
        if not np.array_equal(np.append(self.keys, -1)[at], key):
            raise ValueError("unknowns that are not coupled in the analysed pattern")
        place[below] = self.own[outer] + at - self.first[outer]
        return place


@dataclass(frozen=True, eq=False)
class Symbolic:
    """What the pattern alone says about the factors of a matrix.

    Attributes:
        order: the unknown that is eliminated at each step
        step: the step at which each unknown is eliminated, with a last entry n for "no unknown"
        indptr, indices: the pattern, of sorted columns
        source: the values of the matrix that are used: those of one triangle
        target: where each of them goes in the values of the factor
        fronts: in order of elimination
        layout: where the fronts keep the unknowns
    """

    order: Int[np.ndarray, " n"]
    step: Int[np.ndarray, " n+1"]
    indptr: Int[np.ndarray, " n+1"]
    indices: Int[np.ndarray, " e"]
    source: Int[np.ndarray, " l"]
    target: Int[np.ndarray, " l"]
    fronts: tuple[Front, ...]
    layout: Layout

    def factorise(self, matrix: sp.csc_array) -> "Factor":
        """Factor a symmetric positive definite matrix of the analysed pattern, or of part of it.

        Of each pair of mirrored entries only one is read, so the symmetry itself is not checked. Raises
        `np.linalg.LinAlgError` if the matrix is not positive definite, `ValueError` if it has other entries.
        """
        values = np.zeros(self.fronts[-1].panel.stop if self.fronts else 0)
        values[self.target] = self._data(matrix)[self.source]
        left: dict[int, np.ndarray] = {}
        for number, front in enumerate(self.fronts):
            k, r = front.own, len(front.rows)
            panel = values[front.panel].reshape(k + r, k)
            rest = np.zeros((r, r))  # of this and of `update`, the lower triangle counts
            for child in front.children:
                _add_update(panel, rest, left.pop(child), self.fronts[child])
            corner, side = panel[:k].T, panel[k:].T  # BLAS sees the transposes, in Fortran order, and works in place
            _, failed = POTRF(corner, lower=0, clean=0, overwrite_a=1)
            if failed or not np.isfinite(corner[-1, -1]):
                unknown = self.order[front.start + (failed or k) - 1]
                raise np.linalg.LinAlgError(f"the matrix is not positive definite (found at unknown {unknown})")
            if r:
                TRSM(1.0, corner, side, trans_a=1, overwrite_b=1)
                SYRK(-1.0, side, beta=1.0, c=rest.T, trans=1, overwrite_c=1)
                left[number] = rest
        return Factor(self, values)

    def _data(self, matrix: sp.csc_array) -> Float[np.ndarray, " e"]:
        """The values of a matrix at the entries of the analysed pattern."""
        n = len(self.order)
        if matrix.shape != (n, n):
            raise ValueError(f"the matrix has shape {matrix.shape}, the pattern {(n, n)}")
        if np.array_equal(matrix.indptr, self.indptr) and np.array_equal(matrix.indices, self.indices):
            return np.asarray(matrix.data, float)
        matrix = sp.csc_array(matrix, dtype=float, copy=True)
        matrix.sum_duplicates()
        entries, known = _keys(matrix.indptr, matrix.indices), _keys(self.indptr, self.indices)
        at = np.searchsorted(known, entries)
        if not np.array_equal(np.append(known, -1)[at], entries):
            raise ValueError("the matrix has entries outside the analysed pattern")
        data = np.zeros(len(known))
        data[at] = matrix.data
        return data


@dataclass(frozen=True, eq=False)
class Factor:
    """The Cholesky factor of a matrix A: its panels one after another, see the top of this module."""

    symbolic: Symbolic
    values: Float[np.ndarray, " v"]

    @property
    def log_determinant(self) -> float:
        """The logarithm of the determinant of A."""
        return float(2 * sum(np.log(np.diagonal(corner)).sum() for _, corner, _ in self._parts()))

    def solve(self, sides: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "n *k"]:
        """The solutions x of A x = sides, for one right side or several."""
        x = np.asarray(sides, float)
        x = x if x.ndim > 1 else x[:, None]
        x = np.ascontiguousarray(x[self.symbolic.order])  # BLAS changes its rows in place
        for front, corner, side in self._parts():
            own = x[front.start : front.stop]
            TRSM(1.0, corner, own.T, side=1, overwrite_b=1)
            if len(front.rows):
                x[front.rows] -= side.T @ own
        return self._solve_back(x).reshape(np.shape(sides))

    def sample(self, normal: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Vectors of covariance A^-1, from independent standard normal numbers."""
        return self._solve_back(np.array(normal, float, order="C"))

    def inverse_blocks(self, columns: Int[np.ndarray, "f d"]) -> Float[np.ndarray, "f d d"]:
        """The blocks A^-1[columns[i]][:, columns[i]], each set of columns being coupled pairwise in the pattern.

        An entry n (one past the end) stands for no unknown: its row and column are zero.
        """
        symbolic = self.symbolic
        step = symbolic.step[columns]
        blocks = np.zeros((*step.shape, step.shape[1]))
        known = step < len(symbolic.order)
        sets = np.flatnonzero(known.any(1))
        # the front of a set's first unknown has all others among its rows: there each set starts, to find the entries
        # of the unknowns which that front owns, and goes on to the parent with the others (-1: found before)
        first = step[sets].min(1, keepdims=True, initial=len(symbolic.order))
        front_of = symbolic.layout.front_of[first]
        inside = np.where(known[sets], step[sets], first)
        places = np.where(known[sets], symbolic.layout.locate(np.broadcast_to(front_of, inside.shape), inside), -1)
        begins = np.argsort(front_of[:, 0], kind="stable")
        bounds = np.searchsorted(front_of[begins, 0], np.arange(len(symbolic.fronts) + 1))
        arrived: list[list[np.ndarray]] = [[begins[a:b]] for a, b in pairwise(bounds)]
        for number, (front, panel) in enumerate(zip(symbolic.fronts, self._inverse, strict=True)):
            here = np.concatenate(arrived[number])
            place = places[here]
            one, owned = np.nonzero((place >= 0) & (place < front.own))
            rows = panel.ravel().take(place[one] * front.own + place[one, owned][:, None], mode="clip")
            blocks[sets[here[one]], owned] = np.where(place[one] >= 0, rows, 0)
            further = place >= front.own
            places[here] = np.where(further, np.append(front.place, -1).take(place - front.own, mode="clip"), -1)
            if front.parent >= 0:
                arrived[front.parent].append(here[further.any(1)])
        return np.where(blocks == 0, blocks.transpose(0, 2, 1), blocks)  # each entry was found at least on one side

    def _parts(self) -> list[tuple[Front, np.ndarray, np.ndarray]]:
        """Each front with its part of R: the triangle of its own unknowns, and what is beside that."""
        parts = []
        for front in self.symbolic.fronts:
            panel = self.values[front.panel].reshape(front.size, front.own)
            parts.append((front, panel[: front.own].T, panel[front.own :].T))
        return parts

    def _solve_back(self, x: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """R^-1 x, in the order of the matrix; overwrites x."""
        for front, corner, side in reversed(self._parts()):
            own = x[front.start : front.stop]
            if len(front.rows):
                own -= side @ x[front.rows]
            TRSM(1.0, corner, own.T, side=1, trans_a=1, overwrite_b=1)
        return x[self.symbolic.step[:-1]]

    @cached_property
    def _inverse(self) -> list[Float[np.ndarray, "_ _"]]:
        """The entries of A^-1 between all unknowns of each front (its own first) and its own: Takahashi's equations."""
        fronts, inverse = self.symbolic.fronts, []
        whole: dict[int, np.ndarray] = {}  # the entries between all unknowns of a front, while it has children to come
        for number, (front, corner, side) in reversed(list(enumerate(self._parts()))):
            own, _ = POTRI(corner, lower=0)
            own = np.triu(own) + np.triu(own, 1).T
            below = np.empty((0, front.own))
            rest = np.empty((0, 0))
            if len(front.rows):
                rest = whole[front.parent].take(front.place, 0).take(front.place, 1)
                weights = TRSM(1.0, corner, side)
                below = -rest @ weights.T
                own -= weights @ below
                own = (own + own.T) / 2
                if number == fronts[front.parent].children[0]:
                    del whole[front.parent]
            inverse.append(np.concatenate([own, below]))
            if front.children:
                whole[number] = np.block([[own, below.T], [below, rest]])
        return inverse[::-1]


def analyse(pattern: sp.csc_array) -> Symbolic:
    """Find the order of elimination and the fronts for matrices with a symmetric pattern (the values do not count)."""
    n = len(pattern.indptr) - 1
    entries = sp.csc_array((np.ones(pattern.nnz, bool), pattern.indices, pattern.indptr), shape=(n, n))
    diagonal = sp.csc_array((np.ones(n, bool), np.arange(n), np.arange(n + 1)), shape=(n, n))
    full = sp.csc_array(entries + entries.T + diagonal)
    full.sort_indices()
    node_of, graph, weight = _compress(full)
    parts, rows, parents = _fronts(graph, weight, _dissect(graph, weight))

    # from nodes to unknowns: the nodes follow each other as in `parts`, each with all its unknowns
    order = np.argsort(np.argsort(_join(parts))[node_of], kind="stable")
    step = np.append(np.argsort(order), n)
    own = np.array([weight[part].sum() for part in parts], int)
    steps = [np.flatnonzero(np.isin(node_of[order], nodes)) for nodes in rows]
    count = np.array([len(some) for some in steps], int)
    front_of = np.repeat(np.arange(len(parts)), own)
    keys = _join([number * n + some for number, some in enumerate(steps)])
    layout = Layout(front_of, np.cumsum(own) - own, own, keys, np.cumsum(count) - count)

    panel_begin = np.cumsum(own * (own + count)) - own * (own + count)
    fronts, children = [], [[] for _ in parts]
    for number, (some, parent) in enumerate(zip(steps, parents, strict=True)):
        place = layout.locate(np.full(len(some), parent), some)
        cuts = np.flatnonzero((np.diff(place) != 1) | (place[1:] == own[parent])) + 1
        begins, ends = np.append(0, cuts), np.append(cuts, len(place))
        runs = tuple((int(a), int(b), int(place[a])) for a, b in zip(begins, ends, strict=True) if a < b)
        start, begin = int(layout.start[number]), int(panel_begin[number])
        panel = slice(begin, begin + int(own[number] * (own[number] + count[number])))
        if parent >= 0:
            children[parent].append(number)
        fronts.append(Front(start, start + int(own[number]), some, parent, place, runs, tuple(children[number]), panel))

    row, column = step[full.indices], step[np.repeat(np.arange(n), np.diff(full.indptr))]
    source = np.flatnonzero(row >= column)
    row, column = row[source], column[source]
    front = front_of[column]
    target = panel_begin[front] + layout.locate(front, row) * own[front] + column - layout.start[front]
    return Symbolic(order, step, full.indptr, full.indices, source, target, tuple(fronts), layout)


def _join(arrays: list[np.ndarray]) -> Int[np.ndarray, " n"]:
    """One array of integers of several, or of none."""
    return np.concatenate([np.empty(0, int), *arrays])


def _keys(indptr: Int[np.ndarray, " _"], indices: Int[np.ndarray, " e"]) -> Int[np.ndarray, " e"]:
    """A number for each entry of a pattern, ascending if the columns are sorted."""
    n = len(indptr) - 1
    return np.repeat(np.arange(n), np.diff(indptr)) * n + indices


def _compress(full: sp.csc_array) -> tuple[Int[np.ndarray, " n"], sp.csr_array, Int[np.ndarray, " N"]]:
    """Join the unknowns of identical pattern into nodes: the node of each unknown, the graph, unknowns per node."""
    n = len(full.indptr) - 1
    labels = np.random.default_rng(0).integers(2**63, size=n, dtype=np.uint64)
    sums = np.add.reduceat(labels[full.indices], full.indptr[:-1]) if n else labels  # wraps around
    _, one, node_of, weight = np.unique(sums, return_index=True, return_inverse=True, return_counts=True)
    by_first = np.argsort(one)
    graph = sp.csr_array(full[:, one[by_first]][one[by_first]], dtype=float)
    return np.argsort(by_first)[node_of], graph, weight[by_first]


def _dissect(graph: sp.csr_array, weight: Int[np.ndarray, " N"]) -> list[Int[np.ndarray, " _"]]:
    """Nested dissection: parts of the graph in order of elimination, separators after what they separate."""

    def split(nodes: np.ndarray) -> list[np.ndarray]:
        size = weight[nodes]
        if size.sum() <= LEAF:
            return [nodes]
        part = graph[nodes][:, nodes]
        count, label = csgraph.connected_components(part, directed=False)
        if count > 1:
            pieces = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
            out, small = [], []
            for piece in pieces:
                if size[piece].sum() > LEAF:
                    out += split(nodes[piece])
                    continue
                small.append(nodes[piece])
                if weight[_join(small)].sum() > LEAF:
                    out.append(_join(small))
                    small = []
            return out + [_join(small)] * bool(small)
        # a smooth field from one end of the part to the other, cut near the middle where the separator is small
        smooth = sp.csr_array(part.multiply(1 / part.sum(1)[:, None]))
        field = _order_end_to_end(part)
        for _ in range(6):
            field = smooth @ field
        by_field = np.argsort(field, kind="stable")
        share = np.cumsum(size[by_field]) / size.sum()
        best, least = None, np.inf
        for cut in (0.4, 0.45, 0.5, 0.55, 0.6):
            low = np.zeros(len(nodes), bool)
            low[by_field[share <= cut]] = True
            for side in (low, ~low):
                separator = side & (part @ (~side).astype(float) > 0)
                one, other = side & ~separator, ~side
                cost = size[separator].sum() * (1 + abs(size[one].sum() - size[other].sum()) / size.sum())
                if one.any() and other.any() and cost < least:
                    best, least = (one, other, separator), cost
        if best is None:
            return [nodes]
        one, other, separator = (nodes[chosen] for chosen in best)
        return split(one) + split(other) + [separator]

    return split(np.arange(len(weight))) if len(weight) else []


def _order_end_to_end(part: sp.csr_array) -> Float[np.ndarray, " N"]:
    """How much nearer each node of a connected graph is to one end of it than to the other."""
    distance = csgraph.dijkstra(part, indices=0, unweighted=True)
    one = csgraph.dijkstra(part, indices=int(np.argmax(distance)), unweighted=True)
    return one - csgraph.dijkstra(part, indices=int(np.argmax(one)), unweighted=True)


def _fronts(
    graph: sp.csr_array, weight: Int[np.ndarray, " N"], parts: list[Int[np.ndarray, " _"]]
) -> tuple[list[Int[np.ndarray, " _"]], list[Int[np.ndarray, " _"]], list[int]]:
    """The fronts: own nodes, later nodes coupled with them once all before is eliminated, and parents."""
    parts = list(parts)
    front_of = np.empty(len(weight), int)
    for number, part in enumerate(parts):
        front_of[part] = number
    rows: list[np.ndarray] = []
    children: list[list[int]] = [[] for _ in parts]
    for number, part in enumerate(parts):
        coupled = np.unique(_join([graph[part].indices] + [rows[child] for child in children[number]]))
        rows.append(coupled[front_of[coupled] > number])
        for child in sorted(children[number], key=lambda c: -weight[rows[c]].sum()):
            k, r = int(weight[parts[child]].sum()), int(weight[rows[child]].sum())
            own, above = int(weight[parts[number]].sum()), int(weight[rows[number]].sum())
            if _work(k + own, above) < _work(k, r) + _work(own, above) + MERGE:
                children[number] = [c for c in children[number] if c != child] + children[child]
                parts[number], parts[child] = np.append(parts[child], parts[number]), parts[child][:0]
                front_of[parts[number]] = number
        if len(rows[number]):
            children[front_of[rows[number]].min()].append(number)
    kept = [number for number, part in enumerate(parts) if len(part)]
    parents = [int(np.searchsorted(kept, front_of[rows[f]].min())) if len(rows[f]) else -1 for f in kept]
    return [parts[f] for f in kept], [rows[f] for f in kept], parents


def _work(own: int, rows: int) -> float:
    """The multiplications that a front takes."""
    return own * (own**2 / 3 + own * rows + rows**2)


def _add_update(panel: np.ndarray, rest: np.ndarray, update: np.ndarray, front: Front) -> None:
    """Add what a child left on its rows (lower triangle) to the front of its parent."""
    k = panel.shape[1]
    for begin, end, at in front.runs:
        if at < k:
            panel[front.place[begin:], at : at + end - begin] += update[begin:, begin:end]
        else:
            rest[front.place[begin:] - k, at - k : at - k + end - begin] += update[begin:, begin:end]
