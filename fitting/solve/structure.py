"""What the analysis of a model finds: which unknowns its rows depend on, and where their products stand in a matrix."""

import functools
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js

from ..model.priors import AbstractVertexPrior
from ..model.residual import Model
from ..model.unknowns import Layout, Variables
from .arrowhead import Arrowhead
from .cholesky import Symbolic
from .cholesky import analyse as analyse_pattern
from .derivatives import differentiate
from .elements import Elements, Patches, colour, find_elements, find_patches, forgets_some

_MOST_RINGS = 3


class Tied(NamedTuple):
    """Which unknowns the rows of a prior that ties vertices depend on."""

    prior: str
    seeds: Float[np.ndarray, "s n"]
    seeds_of: Int[np.ndarray, "m d"]
    columns: Int[np.ndarray, "m d"]
    """`n` where there are fewer than in other rows."""
    is_distant: bool


@dataclass(frozen=True, eq=False)
class Structure:
    """What the analysis of a model finds: the same for all sweeps."""

    layout: Layout
    elements: Elements
    patches: Patches
    tied: list[Tied]
    fixed: Bool[np.ndarray, "o"]
    """Which unknowns of vertices may not move."""
    pattern: sp.csc_array
    """Of A."""
    near: sp.csc_array | None
    """Without the rows of priors that couple vertices far from each other; None where there are none."""

    @property
    def n(self) -> int:
        """Number of unknowns of A."""
        return self.layout.n_own

    @functools.cached_property
    def diagonal(self) -> Int[np.ndarray, "o"]:
        """Where in A's values its diagonal stands."""
        return np.flatnonzero(self.pattern.indices == _columns(self.pattern))

    @functools.cached_property
    def fixed_entries(self) -> Int[np.ndarray, "_"]:
        """Where the rows and columns of fixed unknowns stand."""
        return np.flatnonzero(self.fixed[self.pattern.indices] | self.fixed[_columns(self.pattern)])

    @functools.cached_property
    def from_elements(self) -> tuple[Int[np.ndarray, "_"], Int[np.ndarray, "_"]]:
        """Entries of the elements' pattern that belong to A, and where they stand there."""
        of_elements, n = self.elements.pattern, self.n
        column = _columns(of_elements)
        source = np.flatnonzero((of_elements.indices < n) & (column < n))
        return source, np.searchsorted(
            _keys(self.pattern), column[source].astype(np.int64) * n + of_elements.indices[source]
        )

    @functools.cached_property
    def symbolic(self) -> Symbolic:
        """Order of elimination of A."""
        return analyse_pattern(self.pattern)

    @functools.cached_property
    def near_symbolic(self) -> tuple[Symbolic, Int[np.ndarray, "_"]]:
        """Order of elimination of the near part of A, and where its entries stand among A's."""
        assert self.near is not None
        return analyse_pattern(self.near), np.searchsorted(_keys(self.pattern), _keys(self.near))

    def faces_of_vertices(self, n: int) -> Int[np.ndarray, "n"]:
        """A control face that each of the `n` vertices of the surface lies in."""
        faces = np.zeros(n, np.int64)
        faces[self.patches.corners] = self.patches.owner[:, None]
        return faces

    def including(self, more: sp.sparray) -> "Structure":
        """The structure with the entries of another matrix of all unknowns, which rows of one sweep alone couple."""
        n = self.n
        own = sp.coo_array(sp.csc_array(more)[:n, :n])
        if np.isin(own.col.astype(np.int64) * n + own.row, _keys(self.pattern)).all():
            return self
        entries = sp.csc_array((np.ones(own.nnz), (own.row, own.col)), shape=(n, n))
        near = None if self.near is None else _sort(self.near + entries)
        return replace(self, pattern=_sort(self.pattern + entries), near=near)

    def arrange(self, values: Float[np.ndarray, "_"], n_shared: int) -> Arrowhead:
        """The arrowhead of values in the pattern of the elements, in which h stands after the unknowns of vertices."""
        of_elements, n = self.elements.pattern, self.n
        inner = np.zeros(self.pattern.nnz)
        source, place = self.from_elements
        inner[place] = values[source]
        border, corner = np.zeros((n, n_shared)), np.zeros((n_shared, n_shared))
        n_h = self.elements.n - n
        for j in range(n_h):
            run = slice(*of_elements.indptr[n + j : n + j + 2])
            rows = of_elements.indices[run]
            border[rows[rows < n], j] = values[run][rows < n]
            corner[rows[rows >= n] - n, j] = values[run][rows >= n]
        return Arrowhead(inner, border, corner)

    def arrange_sparse(self, matrix: sp.csc_array) -> Arrowhead:
        """The arrowhead of a sparse matrix of all unknowns, whose part in A lies in the pattern."""
        n = self.n
        own = sp.csc_array(matrix[:n, :n])
        inner = np.zeros(self.pattern.nnz)
        np.add.at(inner, np.searchsorted(_keys(self.pattern), _keys(own)), own.data)
        return Arrowhead(inner, matrix[:n, n:].toarray(), matrix[n:, n:].toarray())


def find_structure(model: Model, y: Variables, held: dict[str, Any]) -> Structure:
    """Find which unknowns belong to which rows: so few rings of faces that explain all derivatives.

    Args:
        held: what each prior holds where a fit starts.

    Raises:
        ValueError: a face of the scheme depends on too many control vertices.
    """
    model = model.strip_strengths()
    surface = model.refine(y)
    owner = js.control_faces_of(model.scheme, model.topology, surface, y.control)
    patches = find_patches(surface.faces, owner, model.topology.n_control_faces)
    rows = row_faces(model, held)
    for rings in range(1, _MOST_RINGS + 1):
        elements = find_elements(model, rings)
        found = differentiate(model, y, held_of_faces(model, held), elements.seeds)
        if not forgets_some(elements, patches, found, rows):
            break
    else:
        raise ValueError(
            f"a face of {type(model.scheme).__name__} depends on control vertices more than {_MOST_RINGS} rings of "
            "faces away: the fit has no sparse derivatives to work with."
        )
    layout, n = model.layout, model.layout.n_own
    tied = [_tie(model, prior) for prior in model.vertex_priors]
    own = sp.csc_array(abs(sp.csc_array(elements.pattern.astype(float))[:n, :n]))
    pattern = sp.csc_array(own + sp.eye_array(n, format="csc"))
    pattern.data[:] = 1
    near = None
    for one in sorted(tied, key=lambda one: one.is_distant):
        if one.is_distant and near is None:
            near = _sort(pattern)
        by = sparse_rows(np.ones(one.columns.shape), one.columns, layout.n)
        pattern = pattern + abs(sp.csc_array((by.T @ by)[:n, :n]))
    fixed = np.asarray(model.is_free)[:n] == 0
    return Structure(layout, elements, patches, tied, fixed, _sort(pattern), near)


def held_of_faces(model: Model, held: dict[str, Any]) -> dict[str, Any]:
    """What the face priors hold."""
    return {prior.name: held[prior.name] for prior in model.face_priors}


def row_faces(model: Model, held: dict[str, Any]) -> Int[np.ndarray, "m"]:
    """The control face of every row of the face priors."""
    faces = [np.asarray(prior.faces(held[prior.name])) for prior in model.face_priors]
    return np.concatenate([np.zeros(0, int), *faces]).astype(int)


def _tie(model: Model, prior: AbstractVertexPrior) -> Tied:
    layout, vertices = model.layout, prior.vertices()
    m, c = vertices.shape
    there = vertices >= 0
    incidence = sp.csr_array(
        (np.ones(there.sum(), np.int32), (np.nonzero(there)[0], vertices[there])), shape=(m, layout.n_vertices)
    )
    colours = colour(incidence) if c else np.zeros(layout.n_vertices, int)
    n_colours = int(colours.max(initial=-1)) + 1 if c else 0
    width, parts = layout.width, np.arange(layout.width)
    columns = np.where(there[..., None], vertices[..., None] * width + parts, layout.n).reshape(m, -1)
    seeds_of = np.where(there[..., None], colours[vertices][..., None] * width + parts, 0).reshape(m, -1)
    seeds = np.zeros((n_colours * width, layout.n))
    if c:
        own = np.arange(layout.n_own)
        seeds[colours[own // max(width, 1)] * width + own % max(width, 1), own] = 1
    for name in prior.uses:
        places = np.arange(layout.n)[layout.columns(name)]
        seeds_of = np.concatenate([seeds_of, np.tile(len(seeds) + np.arange(len(places)), (m, 1))], axis=1)
        columns = np.concatenate([columns, np.tile(places, (m, 1))], axis=1)
        seeds = np.concatenate([seeds, places[:, None] == np.arange(layout.n)])
    return Tied(prior.name, seeds, seeds_of, columns, prior.is_distant)


def sparse_rows(by: Float[np.ndarray, "m d"], columns: Int[np.ndarray, "m d"], n: int) -> sp.csr_array:
    """A sparse matrix from its rows; columns of `n` are left out."""
    m, d = columns.shape
    table = sp.csr_array(
        (by.ravel(), columns.ravel(), np.arange(0, m * d + 1, d) if d else np.zeros(m + 1, int)), shape=(m, n + 1)
    )
    return sp.csr_array(table[:, :n])


def _sort(pattern: sp.sparray) -> sp.csc_array:
    sorted_pattern = sp.csc_array(pattern)
    sorted_pattern.sort_indices()
    return sorted_pattern


def _columns(pattern: sp.csc_array) -> Int[np.ndarray, "e"]:
    """The column of every entry."""
    return np.repeat(np.arange(len(pattern.indptr) - 1), np.diff(pattern.indptr))


def _keys(pattern: sp.csc_array) -> Int[np.ndarray, "e"]:
    """A number for every entry, by column and row."""
    return _columns(pattern).astype(np.int64) * pattern.shape[0] + pattern.indices  # pyright: ignore[reportOptionalSubscript]
