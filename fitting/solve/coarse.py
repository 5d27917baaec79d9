"""A coarser level of a surface, whose derivatives stand in for those of the full one in a normal matrix.

The gradient of a sweep is exact, from one reverse pass over the full surface, so that a fit comes to rest where it
should. Its matrix only says how far to step: that of a coarser level is several times as cheap, and nearly the same.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

import jaxsubdiv as js

from ..model.residual import Model, Pairs
from .elements import face_corners

_LEVELS = 2


class Coarse(NamedTuple):
    """A model of fewer levels, and where places of the full surface lie on its surface."""

    model: Model
    weights: Float[np.ndarray, "g 4 4"]
    """Of every corner of every face of the full surface, over the corners of the coarser face that it descends from."""
    corners: Int[np.ndarray, "g 4"]
    """These corners; the last of a triangle twice."""

    def transfer(self, pairs: Pairs, faces: Int[np.ndarray, "p"]) -> Pairs:
        """The same pairs on the coarser surface.

        Args:
            faces: the face of the full surface of each.
        """
        weights = np.einsum("pc,pck->pk", np.asarray(pairs.corner_weights, np.float64), self.weights[faces])
        return pairs._replace(corners=self.corners[faces], corner_weights=weights)


def coarsen(model: Model) -> Coarse | None:
    """The coarser level of a model; None where it has none, or a prior or scheme that needs the full surface.

    Only where a scheme interpolates are the vertices of a coarser level those of the full one.
    """
    topology, scheme, n_levels = model.topology, model.scheme, len(model.topology.levels)
    plain = scheme.interpolates and js.splits_in_four(scheme, topology) and not topology.mesh_normals
    one_h = scheme.h is None or scheme.h.ndim == 0
    if n_levels <= _LEVELS or not plain or not one_h or any(prior.needs_full_surface for prior in model.face_priors):
        return None
    bare = js.ControlMesh(model.template, topology.control_faces, check=False)
    coarser = js.build_topology(bare, scheme, _LEVELS)
    fine, coarse = (face_corners(one.faces).astype(np.int64) for one in (topology, coarser))
    ancestor = np.arange(len(fine)) // 4 ** (n_levels - _LEVELS)
    n = int(coarse.max()) + 1
    midpoints = _midpoint_weights(topology, n)
    keys = np.repeat(np.arange(len(midpoints.indptr) - 1), np.diff(midpoints.indptr)) * n + midpoints.indices
    wanted = fine[:, :, None] * n + coarse[ancestor][:, None, :]
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    weights = np.where(keys[place] == wanted, midpoints.data[place], 0.0)
    is_triangle = coarse[ancestor, 3] == coarse[ancestor, 2]
    weights[is_triangle, :, 3] = 0
    return Coarse(eqx.tree_at(lambda one: one.topology, model, coarser), weights, coarse[ancestor])


def _midpoint_weights(topology: js.Topology, n: int) -> sp.csr_array:
    """Weights of all vertices over the `n` of the coarser level: edge vertices in the middle of their edges, face
    vertices in the middle of their quads."""
    whole = sp.csr_array(sp.eye_array(n, format="csr"))
    for level in topology.levels[_LEVELS:]:
        edges, quads = np.asarray(level.edges), np.asarray(level.quads)  # pyright: ignore[reportAttributeAccessIssue]
        parts = [whole]
        for ends in (edges, quads):
            rows = np.repeat(np.arange(len(ends)), ends.shape[1])
            mean = sp.csr_array(
                (np.full(ends.size, 1 / ends.shape[1]), (rows, ends.ravel())), shape=(len(ends), len(whole.indptr) - 1)
            )
            parts.append(mean @ whole)
        whole = sp.csr_array(sp.vstack(parts, format="csr"))
    whole.sort_indices()
    return whole
