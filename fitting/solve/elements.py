"""Normal equations of a fit, assembled as in finite elements: a control face is an element.

The surface over a control face depends on few control vertices: its own, and those of the faces around it. All
derivatives of all rows are therefore found by few forward derivatives, each along many control vertices at once that
have no face in common (Curtis, Powell and Reid, On the estimation of sparse Jacobian matrices, 1974), and the normal
equations are sums of small dense matrices, one a face. Which vertices belong to which face is analysed once.
"""

import heapq
import itertools
import math
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

import jaxsubdiv as js

from ..model.residual import Model, Pairs
from ..model.unknowns import AnyArray, Layout
from .derivatives import Derivatives

_ROWS_A_BLOCK = 24
_ENTRIES_AT_ONCE = 1 << 22  # of the faces' matrices, likewise
_ONE_THREAD = 1 << 18  # multiplications of a product that OpenBLAS leaves to one
_WRONG = 1e-3  # of a derivative: far more than rounding in float32, far less than a forgotten control vertex


class Run(NamedTuple):
    """Faces whose matrices are summed up at once, and where these go."""

    faces: slice
    source: Int[np.ndarray, "e"]
    """Entries of the faces' matrices, one after the other, that lie in the lower triangle; equal places together."""
    first: Int[np.ndarray, "k"]
    """Where in `source` each place begins."""
    place: Int[np.ndarray, "k"]
    """Among the places of the lower triangle of all."""


class Elements(NamedTuple):
    """Which unknowns the rows of each control face depend on. Unknowns are numbered vertex by vertex, then h."""

    columns: Int[np.ndarray, "f d"]
    """Unknowns of every face; `n` where there are fewer than in other faces."""
    seeds_of: Int[np.ndarray, "f d"]
    """The seed that each of them moves in."""
    seeds: Float[np.ndarray, "s n"]
    """Directions: many unknowns at once, no two of them in one face. The last is at random."""
    pattern: sp.csc_array
    """Of the normal equations, which are symmetric; its values are the place of each entry in the lower triangle."""
    runs: list[Run]
    n: int
    """Number of unknowns."""


class Patches(NamedTuple):
    """The part of the surface that belongs to each control face."""

    owner: Int[np.ndarray, "g"]
    """The control face of every face of the surface."""
    vertices: Int[np.ndarray, "f w"]
    """The vertices of each patch; 0 where there are fewer than in others."""
    slots: Int[np.ndarray, "g 4"]
    """Where in its patch each corner of a face of the surface stands; corners as `corner_weights` has them."""

    @property
    def corners(self) -> Int[np.ndarray, "g 4"]:
        """Vertices of every face of the surface; the last of a triangle twice."""
        return self.vertices[self.owner[:, None], self.slots]


def face_corners(faces: dict[int, Any]) -> Int[np.ndarray, "g 4"]:
    """Vertices of every face, the triangles first; the last of a triangle twice."""
    triangles, quads = (np.asarray(faces[size]) for size in (3, 4))
    return np.concatenate([triangles[:, [0, 1, 2, 2]], quads])


def find_patches(faces: dict[int, Any], owner: Int[np.ndarray, "g"], n_control_faces: int) -> Patches:
    """The patches of a surface, from its faces and the control face of each."""
    corners = face_corners(faces)
    n = int(corners.max()) + 1
    keys, place = np.unique(owner[:, None].astype(np.int64) * n + corners, return_inverse=True)
    of_key = keys // n
    counts = np.bincount(of_key, minlength=n_control_faces)
    slot = np.arange(len(keys)) - (np.cumsum(counts) - counts)[of_key]
    vertices = np.zeros((n_control_faces, counts.max()), np.int32)
    vertices[of_key, slot] = keys % n
    return Patches(owner, vertices, slot[place].reshape(corners.shape).astype(np.int32))


def find_elements(model: Model, rings: int) -> Elements:
    """Analyse which unknowns belong together, if a face depends on the vertices of `rings` rings of faces around it."""
    layout = model.layout
    near = _vertices_near_faces(model.topology, rings)
    colours = colour(near)
    per_vertex, n_own = layout.width, layout.n_own
    last = np.arange(n_own, n_own + n_lengths(layout))
    n = n_own + len(last)
    n_colours = int(colours.max()) + 1

    counts, n_faces = np.diff(near.indptr), len(near.indptr) - 1
    slot = np.arange(near.indptr[-1]) - np.repeat(near.indptr[:-1], counts)
    vertices = np.full((n_faces, counts.max()), -1)
    vertices[np.repeat(np.arange(n_faces), counts), slot] = near.indices
    there = vertices >= 0
    components = np.arange(per_vertex)
    columns = np.where(there[..., None], vertices[..., None] * per_vertex + components, n)
    seeds_of = np.where(there[..., None], colours[vertices][..., None] * per_vertex + components, 0)
    first = n_colours * per_vertex
    columns, seeds_of = (
        np.concatenate([table.reshape(len(vertices), -1), np.tile(tail, (len(vertices), 1))], axis=1)
        for table, tail in ((columns, last), (seeds_of, first + last - n_own))
    )
    seeds = np.zeros((first + len(last) + 1, layout.n))
    rows = np.arange(n_own)
    seeds[colours[rows // max(per_vertex, 1)] * per_vertex + rows % max(per_vertex, 1), rows] = 1
    seeds[first + last - n_own, last] = 1
    seeds[-1, :n] = np.random.default_rng(0).normal(size=n)
    pattern, runs = _pattern(columns, n)
    return Elements(columns, seeds_of, seeds, pattern, runs, n)


def n_lengths(layout: Layout) -> int:
    """Number of tangent lengths h among the unknowns: the only shared ones that the surface depends on."""
    return next((math.prod(of.shape) for name, of in layout.shared if name == "h"), 0)


def forgets_some(elements: Elements, patches: Patches, found: Derivatives, row_faces: Int[np.ndarray, "m"]) -> bool:
    """Whether values depend on unknowns that the elements do not know: seen in the derivative along the last seed."""
    of_surface, of_rows = np.asarray(found.of_surface), np.asarray(found.of_rows)
    # How far each unknown of a face goes along the last seed, at the seed that the face knows it by.
    parts = np.zeros((len(elements.columns), len(elements.seeds)), of_surface.dtype)
    last = np.append(elements.seeds[-1, : elements.n], 0.0)[elements.columns]
    np.add.at(parts, (np.arange(len(parts))[:, None], elements.seeds_of), last)
    of_patches = np.einsum("sfwx,fs->fwx", of_surface[:, patches.vertices], parts)
    corners = patches.owner[:, None], patches.slots
    surface = of_patches[corners] - of_surface[-1, patches.vertices[corners]]
    rows = np.einsum("sm,ms->m", of_rows, parts[row_faces]) - of_rows[-1]
    both = ((surface, of_surface[-1]), (rows, of_rows[-1]))
    return any(np.abs(off).max(initial=0) > _WRONG * np.abs(of).max(initial=0) for off, of in both)


def slopes_of_rows(
    elements: Elements, of_rows: Float[AnyArray, "s m"], face: Int[np.ndarray, "m"]
) -> Float[np.ndarray, "m d"]:
    """Derivatives of rows by the unknowns of their faces, from those along the seeds."""
    return np.asarray(of_rows)[elements.seeds_of[face], np.arange(len(face))[:, None]].astype(np.float64)


def slopes_of_distances(
    elements: Elements, patches: Patches, found: Derivatives, pairs: Pairs, at: Int[np.ndarray, "p"]
) -> Float[np.ndarray, "p d"]:
    """Derivatives of the distances of pairs by the unknowns of their faces.

    Args:
        at: the face of the surface of each pair.
    """
    of_surface, n = np.asarray(found.of_surface), len(at)
    weights, directions = (np.asarray(part, of_surface.dtype) for part in (pairs.corner_weights, pairs.directions))
    factors = weights[:, :, None] * directions[:, None, :]
    coordinate = 3 * np.asarray(pairs.corners)[:, :, None] + np.arange(3)
    by_coordinates = sp.csr_array(
        (factors.ravel(), coordinate.ravel(), 12 * np.arange(n + 1)), shape=(n, of_surface[0].size)
    )
    along = np.stack([by_coordinates @ of_seed.ravel() for of_seed in of_surface])
    return slopes_of_rows(elements, along, patches.owner[at])


def are_many(elements: Elements, patches: Patches, n_points: int) -> bool:
    """Whether points are so many that their distances are summed up by patches at less cost than one by one."""
    n_faces, d = elements.columns.shape
    width = 3 * patches.vertices.shape[1]
    return n_points * d > n_faces * width * (width + d)


def normal_matrix(
    elements: Elements,
    by: Float[np.ndarray, "m d"],
    weights: Float[np.ndarray, "m"],
    face: Int[np.ndarray, "m"],
) -> Float[np.ndarray, "_"]:
    """Values of J' W J in the pattern of the elements."""
    order = np.argsort(face, kind="stable")
    ends = np.searchsorted(face, np.arange(len(elements.columns) + 1), sorter=order)
    roots, sums = np.sqrt(weights), _Sums(elements)

    def product(first: Int[np.ndarray, "b"], last: Int[np.ndarray, "b"]) -> Float[np.ndarray, "b d d"]:
        place = first[:, None] + np.arange(_ROWS_A_BLOCK)
        inside = place < last[:, None]
        rows = order[np.where(inside, place, 0)]
        scaled = by[rows] * (roots[rows] * inside)[..., None]
        return _products(scaled.transpose(0, 2, 1), scaled)

    for run in elements.runs:
        first, last = ends[run.faces], ends[run.faces.start + 1 : run.faces.stop + 1]
        matrices = product(first, last)
        while len(more := np.flatnonzero(last - first > _ROWS_A_BLOCK)):  # few faces have so many rows
            first = first + _ROWS_A_BLOCK
            matrices[more] += product(first[more], last[more])
        sums.add(run, matrices)
    return sums.values()


def _products(a: Float[np.ndarray, "b m k"], b: Float[np.ndarray, "b k n"]) -> Float[np.ndarray, "b m n"]:
    """Products of many small matrices, a few columns at a time: over a size OpenBLAS gives each to all cores, whose
    threads then mostly wait for one another (on busy cores ten times as long)."""
    columns = max(_ONE_THREAD // (a.shape[1] * a.shape[2]), 1)
    return np.concatenate([np.matmul(a, b[..., i : i + columns]) for i in range(0, b.shape[2], columns)], axis=2)


class _Sums:
    """Sums of symmetric matrices, a control face each, in the pattern of the elements."""

    def __init__(self, elements: Elements):
        self._place = np.asarray(elements.pattern.data, np.intp)
        self._lower = np.zeros(self._place.max(initial=-1) + 1)

    def add(self, run: Run, matrices: Float[np.ndarray, "n d d"]) -> None:
        if len(run.first):
            self._lower[run.place] += np.add.reduceat(matrices.ravel()[run.source], run.first)

    def values(self) -> Float[np.ndarray, "_"]:
        return self._lower[self._place]


def distance_matrix(
    elements: Elements,
    patches: Patches,
    found: Derivatives,
    pairs: Pairs,
    weights: Float[np.ndarray, "p"],
    at: Int[np.ndarray, "p"],
) -> Float[np.ndarray, "_"]:
    """Values of J' W J for the distances of many pairs, in the pattern of the elements.

    A distance depends on three or four vertices of the surface. What the pairs of a patch say of its vertices is summed
    up first, and then taken to the unknowns, once a patch and not once a pair.

    Args:
        at: the face of the surface of each pair.
    """
    width, sums = 3 * patches.vertices.shape[1], _Sums(elements)
    face = patches.owner[at]
    order = np.argsort(face, kind="stable")
    for run in elements.runs:
        those = run.faces
        n = those.stop - those.start
        rows = order[slice(*np.searchsorted(face, (those.start, those.stop), sorter=order))]
        coordinate, factors = _pair_factors(patches, pairs, at, rows)
        place = (face[rows, None] - those.start) * width + coordinate
        inner = np.bincount(
            (place[:, :, None] * width + coordinate[:, None, :]).ravel(),
            ((factors * weights[rows, None])[:, :, None] * factors[:, None, :]).ravel(),
            n * width * width,
        ).reshape(n, width, width)
        by = _slopes_of_patches(elements, patches, found, those)
        sums.add(run, _products(by.transpose(0, 2, 1), _products(inner, by)))
    return sums.values()


def _slopes_of_patches(
    elements: Elements, patches: Patches, found: Derivatives, those: slice
) -> Float[np.ndarray, "f c d"]:
    """Derivatives of the vertices of some patches by the unknowns of their faces."""
    vertices, seeds_of = patches.vertices[those], elements.seeds_of[those]
    place = seeds_of[:, None, None, :], vertices[:, :, None, None], np.arange(3)[:, None]
    return np.asarray(found.of_surface)[place].astype(np.float64).reshape(len(vertices), -1, seeds_of.shape[1])


def _pair_factors(
    patches: Patches, pairs: Pairs, at: Int[np.ndarray, "p"], rows: Int[np.ndarray, "r"]
) -> tuple[Int[np.ndarray, "r 12"], Float[np.ndarray, "r 12"]]:
    """The coordinates of its patch that each distance depends on, and by what factors."""
    corner_weights, directions = (
        np.asarray(part)[rows].astype(float) for part in (pairs.corner_weights, pairs.directions)
    )
    factors = (corner_weights[:, :, None] * directions[:, None, :]).reshape(-1, 12)
    return (3 * patches.slots[at[rows], :, None] + np.arange(3)).reshape(-1, 12), factors


def distances_transposed(
    elements: Elements,
    patches: Patches,
    found: Derivatives,
    pairs: Pairs,
    values: sp.csr_array,
    at: Int[np.ndarray, "p"],
) -> Float[np.ndarray, "n k"]:
    """J' times values of many pairs `[p, k]`, J being the derivatives of their distances; see `distance_matrix`."""
    coordinate, factors = _pair_factors(patches, pairs, at, np.arange(len(at)))
    f, w = patches.vertices.shape
    place = patches.owner[at][:, None] * (3 * w) + coordinate
    ends = np.arange(0, factors.size + 1, 12)
    by_coordinates = sp.csr_array((factors.ravel(), place.ravel(), ends), shape=(len(at), 3 * w * f))
    sides = (by_coordinates.T @ values).toarray().reshape(f, 3 * w, -1)
    of_faces = [
        _slopes_of_patches(elements, patches, found, run.faces).transpose(0, 2, 1) @ sides[run.faces]
        for run in elements.runs
    ]
    columns = elements.columns.ravel()
    gather = sp.csr_array(
        (np.ones(len(columns)), columns, np.arange(len(columns) + 1)), shape=(len(columns), elements.n + 1)
    )
    return (gather.T @ np.concatenate(of_faces).reshape(len(columns), -1))[:-1]


def times_transposed(
    elements: Elements, by: Float[np.ndarray, "m d"], values: Float[np.ndarray, "m"], face: Int[np.ndarray, "m"]
) -> Float[np.ndarray, "n"]:
    """J' times a value a row."""
    products = by * values[:, None]
    return np.bincount(elements.columns[face].ravel(), products.ravel(), minlength=elements.n + 1)[:-1]


def jacobian(elements: Elements, by: Float[np.ndarray, "m d"], face: Int[np.ndarray, "m"]) -> sp.csr_array:
    """J as a sparse matrix."""
    m, d = by.shape
    table = sp.csr_array(
        (by.ravel(), elements.columns[face].ravel(), np.arange(0, m * d + 1, d)), shape=(m, elements.n + 1)
    )
    return table[:, :-1]


def _vertices_near_faces(topology: js.Topology, rings: int) -> sp.csr_array:
    """Faces by the vertices of the faces around them, `rings` rings of them."""
    parts = [np.asarray(topology.control_faces[size]) for size in (3, 4)]
    counts = np.concatenate([np.full(len(part), part.shape[1]) for part in parts])
    corners = np.concatenate([part.ravel() for part in parts])
    shape = (len(counts), topology.n_control_vertices)
    at = sp.csr_array((np.ones(len(corners), np.int32), corners, np.append(0, np.cumsum(counts))), shape=shape)
    near = at
    for _ in range(rings):
        near = ((near @ at.T) @ at).tocsr()
    near.sort_indices()
    return near


def colour(near: sp.csr_array) -> Int[np.ndarray, "v"]:
    """A colour for every vertex, so that no two in one face have the same: next the one beside most colours (DSATUR).

    Source: D. Brelaz, New methods to color the vertices of a graph, 1979.
    """
    together = (near.T @ near).tocsr()
    beside = np.split(together.indices, together.indptr[1:-1])
    colours, taken = np.full(len(beside), -1), [set() for _ in beside]
    queue = [(0, -len(others), vertex) for vertex, others in enumerate(beside)]
    heapq.heapify(queue)
    while queue:
        n_taken, _, vertex = heapq.heappop(queue)
        if colours[vertex] >= 0 or -n_taken != len(taken[vertex]):
            continue  # done, or queued again since with more colours beside it
        found = next(number for number in itertools.count() if number not in taken[vertex])
        colours[vertex] = found
        for other in beside[vertex].tolist():
            if colours[other] < 0 and found not in taken[other]:
                taken[other].add(found)
                heapq.heappush(queue, (-len(taken[other]), -len(beside[other]), other))
    return colours


def _pattern(columns: Int[np.ndarray, "f d"], n: int) -> tuple[sp.csc_array, list[Run]]:
    (n_faces, d), runs, keys_of_runs = columns.shape, [], []
    one, other = np.tril_indices(d)
    length = max(_ENTRIES_AT_ONCE // d**2, 1)
    for start in range(0, n_faces, length):
        those = columns[start : start + length]
        row, column = np.maximum(those[:, one], those[:, other]), np.minimum(those[:, one], those[:, other])
        face, entry = np.nonzero(row < n)
        keys = column[face, entry].astype(np.int64) * n + row[face, entry]
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        source = (face * d**2 + one[entry] * d + other[entry])[order]
        keys_of_runs.append(keys[first])
        runs.append(Run(slice(start, start + len(those)), source, first, keys[first]))
    keys = np.unique(np.concatenate(keys_of_runs))
    runs = [run._replace(place=np.searchsorted(keys, run.place)) for run in runs]
    column, row = keys // n, keys % n
    beside = np.flatnonzero(row != column)
    both = np.append(np.arange(len(keys)), beside)
    rows, columns_ = np.append(row, column[beside]), np.append(column, row[beside])
    order = np.lexsort((rows, columns_))
    indptr = np.searchsorted(columns_[order], np.arange(n + 1))
    return sp.csc_array((both[order], rows[order], indptr), shape=(n, n)), runs
