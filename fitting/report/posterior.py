"""What the scan leaves uncertain.

To first order the surface, given the scan, is Gaussian about the fit; its precision is the normal matrix of scan and
priors. With the strength of the bend prior found from the scan, its bands hold as much of the truth as they say on
average over the surface. Source: D. Nychka, Bayesian confidence intervals for smoothing splines, 1988.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import unit

from ..model.pairing import is_on_boundary
from ..scan.closest_points import boundary_vertices
from ..solve.arrowhead import ArrowheadFactor
from ..solve.derivatives import differentiate_across
from ..solve.elements import face_corners, slopes_of_rows, times_transposed
from ..solve.sparse_normal import SparseEquations
from ..solve.strengths import neighbourhood_mean
from ..solve.structure import sparse_rows
from .misfit import misfit_variances
from .record import Fit

_FACES_AT_ONCE, _ROWS_AT_ONCE = 512, 1024


class Uncertainty(NamedTuple):
    """How well a fit determines its surface: standard deviations in mm, across the surface."""

    control: Float[np.ndarray, "v"]
    """Of every control vertex, posterior to scan and priors."""
    surface: Float[np.ndarray, "w"]
    """Of every vertex of the refined surface from the anatomy: posterior, with the misfit."""
    misfit: Float[np.ndarray, "w"]
    """The part of it that the control mesh cannot follow, as residuals that points have in common show it."""


class Posterior:
    """The surfaces that the scan and the priors leave probable: a Gaussian about the fit, to first order."""

    def __init__(self, fit: Fit):
        self.fit: Fit = fit
        self.equations: SparseEquations = fit.equations()
        matrix = self.equations.data.add(self.equations.prior)
        self.factor: ArrowheadFactor = self.equations.factorise(matrix, fit.loose, fit.active)

    def uncertainty(self) -> Uncertainty:
        """Standard deviations across the surface, from the blocks of the covariance that its patches need."""
        return self._uncertainty

    @functools.cached_property
    def _uncertainty(self) -> Uncertainty:
        structure = self.equations.structure
        of_control, of_surface = self._control_variances(), self._surface_variances
        patches = structure.patches
        misfit = _average_corners(self._misfit_of_faces, patches.corners, patches.owner, len(of_surface))
        return Uncertainty(np.sqrt(of_control), np.sqrt(of_surface + misfit), np.sqrt(misfit))

    def deviations_of(self, topology: js.Topology) -> Float[np.ndarray, "w"]:
        """`Uncertainty.surface` of the surface that the same control mesh has with other tables."""
        fit, elements = self.fit, self.equations.structure.elements
        model = dataclasses.replace(fit.model, topology=topology, priors=())
        surface = model.refine(fit.y)
        corners = face_corners(surface.faces)
        owner = js.control_faces_of(model.scheme, topology, surface, fit.y.control)
        face = np.zeros(len(surface.vertices), np.int64)
        face[corners] = owner[:, None]
        across = np.asarray(differentiate_across(model, fit.y, elements.seeds, surface.normals))
        variances = self._variances(face, lambda rows: slopes_of_rows(elements, across[:, rows], face[rows]))
        return np.sqrt(variances + _average_corners(self._misfit_of_faces, corners, owner, len(variances)))

    @functools.cached_property
    def _surface_variances(self) -> Float[np.ndarray, "w"]:
        """Of every vertex of the surface along its normal."""
        structure, normals = self.equations.structure, np.asarray(self.fit.surface().normals)
        across = np.einsum("svx,vx->sv", np.asarray(self.equations.found.of_surface), normals)
        face = structure.faces_of_vertices(len(normals))
        return self._variances(face, lambda rows: slopes_of_rows(structure.elements, across[:, rows], face[rows]))

    def _variances(
        self, face: Int[np.ndarray, "w"], derivatives: Callable[[Int[np.ndarray, "r"]], Float[np.ndarray, "r d"]]
    ) -> Float[np.ndarray, "w"]:
        """Of numbers that depend on the unknowns of a control face each.

        Args:
            face: that each number lies in.
            derivatives: of some of the numbers by the unknowns of their faces.
        """
        columns = self._free_columns(self.equations.structure.elements.columns)
        order = np.argsort(face, kind="stable")
        ends, variances = np.searchsorted(face[order], np.arange(len(columns) + 1)), np.zeros(len(face))
        for first in range(0, len(columns), _FACES_AT_ONCE):
            those = slice(first, first + _FACES_AT_ONCE)
            blocks = self.factor.covariance_blocks(columns[those])
            rows = order[ends[first] : ends[min(first + _FACES_AT_ONCE, len(columns))]]
            for some in np.array_split(rows, -(-len(rows) // _ROWS_AT_ONCE) or 1):
                by = derivatives(some)
                variances[some] = np.einsum("vd,vde,ve->v", by, blocks[face[some] - first], by, optimize=True)
        return np.maximum(variances, 0)

    def covariances(self, at: js.SurfacePoint) -> Float[np.ndarray, "p 3 3"]:
        """Of places that move along with the surface, in mm^2, without the misfit."""
        structure = self.equations.structure
        owner = structure.patches.owner[np.asarray(at.face)]
        corners, weights = (np.asarray(part) for part in js.corner_weights(self.fit.surface(), at))
        along = np.einsum("pc,spcx->pxs", weights, np.asarray(self.equations.found.of_surface)[:, corners])
        by = np.take_along_axis(along, structure.elements.seeds_of[owner][:, None], axis=2).astype(np.float64)
        blocks = self.factor.covariance_blocks(self._free_columns(structure.elements.columns[owner]))
        return np.einsum("pxd,pde,pye->pxy", by, blocks, by, optimize=True)

    def covariance_of(self, gradients: Float[np.ndarray, "m v 3"]) -> Float[np.ndarray, "m m"]:
        """Of numbers that depend on the surface, from their gradients by its vertices; without the misfit."""
        elements, of_surface = self.equations.structure.elements, np.asarray(self.equations.found.of_surface)
        face = self.equations.structure.faces_of_vertices(of_surface.shape[1])
        sides = np.zeros((self.fit.model.layout.n, len(gradients)))
        for i, gradient in enumerate(gradients):
            across = np.einsum("svx,vx->sv", of_surface, gradient.astype(of_surface.dtype))
            slopes = slopes_of_rows(elements, across, face)
            sides[: elements.n, i] = times_transposed(elements, slopes, np.ones(len(face)), face)
        return self.covariance_by_unknowns(sides)

    def covariance_by_unknowns(self, derivatives: Float[np.ndarray, "u m"]) -> Float[np.ndarray, "m m"]:
        """Of numbers, from their derivatives by all unknowns; see `Layout` for their order."""
        free = self._is_free * derivatives
        return free.T @ self.factor.solve(free)

    @property
    def _is_free(self) -> Float[np.ndarray, "u 1"]:
        """1 for unknowns that the fit was free to change, else 0."""
        active = np.concatenate([np.ones(self.equations.structure.n, bool), self.fit.active])
        return (np.asarray(self.fit.model.is_free) * active)[:, None]

    def _control_variances(self) -> Float[np.ndarray, "v"]:
        """Of every control vertex along its normal."""
        layout, normals = self.fit.model.layout, np.asarray(unit(self.fit.y.control.normals), np.float64)
        if not layout.has_vertices:
            return np.zeros(layout.n_vertices)
        columns = layout.width * np.arange(layout.n_vertices)[:, None] + np.arange(3)
        blocks = self.factor.covariance_blocks(self._free_columns(columns))
        return np.maximum(np.einsum("vi,vij,vj->v", normals, blocks, normals), 0)

    def _free_columns(self, columns: Int[np.ndarray, "f d"]) -> Int[np.ndarray, "f d"]:
        """Unknowns, or -1 for those that are fixed or none."""
        n = self.equations.structure.elements.n
        is_free = np.append(np.asarray(self.fit.model.is_free)[:n] > 0, False)
        return np.where(is_free[columns], columns, -1)

    @functools.cached_property
    def _misfit_of_faces(self) -> Float[np.ndarray, "f"]:
        """Of the control faces, in mm^2."""
        surface, variances = self.fit.surface(), self._surface_variances
        look, structure, topology = self.fit.look, self.equations.structure, self.fit.topology
        owner = structure.patches.owner
        pairs, open_vertices = look.pairs, boundary_vertices(surface)
        # Where a surface ends, distances run along it.
        counted = ~np.asarray(is_on_boundary(open_vertices, pairs.corners, pairs.corner_weights))
        at_points = np.sum(np.asarray(pairs.corner_weights, np.float64) * variances[np.asarray(pairs.corners)], axis=1)
        weights = np.asarray(look.precisions, np.float64) * counted
        distances, face = np.asarray(look.distances, np.float64), np.asarray(look.at.face)
        nested = js.splits_in_four(self.fit.model.scheme, topology)
        finer = range(len(topology.levels) - 1, -1, -1) if nested else []
        patches = [owner[face]] + [face // 4**level for level in finer]
        average, n_faces = neighbourhood_mean(topology), topology.n_control_faces
        return misfit_variances(distances, weights, at_points, patches, average, n_faces)

    def displace(self, offsets: Float[np.ndarray, "u k"]) -> Float[np.ndarray, "v 3 k"]:
        """How far offsets of the unknowns move every vertex of the surface, to first order, in mm."""
        structure, of_surface = self.equations.structure, np.asarray(self.equations.found.of_surface)
        n = of_surface.shape[1]
        face = structure.faces_of_vertices(n)
        moved = np.zeros((n, 3, offsets.shape[1]))
        for rows in np.array_split(np.arange(n), -(-n // _ROWS_AT_ONCE)):
            along = of_surface[:, rows].reshape(-1, 3 * len(rows))
            moved[rows] = (self._slopes(along, np.repeat(face[rows], 3)) @ offsets).reshape(len(rows), 3, -1)
        return moved

    def find_slopes(
        self,
        corners: Int[np.ndarray, "p c"],
        weights: Float[np.ndarray, "p c"],
        directions: Float[np.ndarray, "p 3"],
        face: Int[np.ndarray, "p"],
    ) -> sp.csr_array:
        """Derivatives by all unknowns of how far places of the surface lie along directions, `[p, u]`.

        Args:
            corners, weights: vertices of the surface around each place, and how much of it each is.
            directions: unit vectors.
            face: a control face that all corners of a place lie in.
        """
        of_surface, found = np.asarray(self.equations.found.of_surface), []
        for rows in np.array_split(np.arange(len(face)), -(-len(face) // _ROWS_AT_ONCE) or 1):
            factors = (weights[rows][:, :, None] * directions[rows][:, None]).astype(of_surface.dtype)
            along = np.einsum("pcx,spcx->sp", factors, of_surface[:, corners[rows]])
            found.append(self._slopes(along, face[rows]))
        return sp.csr_array(sp.vstack(found))

    def _slopes(self, along: Float[np.ndarray, "s p"], face: Int[np.ndarray, "p"]) -> sp.csr_array:
        """Derivatives by all unknowns, from those along the seeds."""
        elements, n = self.equations.structure.elements, self.fit.model.layout.n
        columns = np.where(elements.columns < elements.n, elements.columns, n)[face]
        return sparse_rows(slopes_of_rows(elements, along, face), columns, n)

    def draws(self, n: int, seed: int = 0) -> Float[np.ndarray, "u n"]:
        """Random offsets of the unknowns, as probable as the posterior has them; see `Layout` for their order."""
        size = self.fit.model.layout.n
        drawn = self.factor.sample(np.random.default_rng(seed).normal(size=(size, n)))
        return drawn * self._is_free


def _average_corners(
    of_faces: Float[np.ndarray, "f"], corners: Int[np.ndarray, "g 4"], owner: Int[np.ndarray, "g"], n: int
) -> Float[np.ndarray, "n"]:
    """Of the vertices of a surface, means of the control faces that they lie on."""
    once = np.append(np.ones((len(corners), 3)), corners[:, 3:] != corners[:, 2:3], axis=1)  # triangles repeat one
    sums, counts = (np.bincount(corners.ravel(), (once * of).ravel(), n) for of in (of_faces[owner][:, None], 1))
    return sums / np.maximum(counts, 1)
