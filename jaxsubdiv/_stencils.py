"""What linear schemes alone can give: their weights as a sparse matrix, and control vertices that interpolate."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from ._control import Control
from ._masks import Matrix, identity, stack
from ._normals import estimate_normals
from ._scheme.base import AbstractScheme
from ._topology import MaskLevel, Topology

# Relative, of the linear solver and of what it may leave.
_SOLVED = 1e-12
_REPEATS = 3
_REACHED = 1e-6


def stencils(scheme: AbstractScheme, topology: Topology) -> Matrix:
    """Weights of the refined vertices over the control vertices, as a `scipy.sparse.csr_array` `[w, v]`.

    `stencils(scheme, topology) @ control.vertices` are the vertices that `refine` gives, those on the limit surface
    where the topology was built with `limit=True`. Rows sum to 1.

    Raises:
        ValueError: the scheme is not linear, or the topology was built for another one.
    """
    if not scheme.is_linear:
        raise ValueError(
            f"{type(scheme).__name__} has no stencils: its vertices are no fixed weighted sums. The linear schemes are "
            "CatmullClark, DooSabin, Kobbelt, Loop and ModifiedButterfly."
        )
    if topology.built_for != scheme.tables_for:
        raise ValueError(
            f"the topology was built for {topology.built_for}, not for {scheme.tables_for}. Build it with "
            "`build_topology(mesh, scheme, levels)` for this scheme."
        )
    weights = identity(topology.n_control_vertices)
    for level in topology.levels:
        assert isinstance(level, MaskLevel)
        new = level.masks.matrix() @ weights
        weights = stack([weights, new]) if scheme.interpolates else new
    return weights if topology.limit is None else topology.limit.points.matrix() @ weights


def interpolating_control(scheme: AbstractScheme, topology: Topology, points: ArrayLike) -> Control:
    """Control vertices whose limit surface goes through `points`, one a control vertex.

    Args:
        scheme: a linear scheme; one that interpolates gives the points back.
        topology: from `build_topology(mesh, scheme, levels, limit=True)`. Doo-Sabin needs one of 0 levels, as its
            control vertices have no place of their own at later ones.
        points: `[v, 3]`, where the limit position of each control vertex shall be.

    Returns:
        The control vertices, those closest to `points` where several would do, and the control mesh's own normals.

    Raises:
        ValueError: the topology has no limit masks, or no control vertices reach these points: around even faces
            (a cube, say) the limit positions may depend on one another. Fit instead.
    """
    import scipy.sparse.linalg  # here and not above: refining never needs it

    points = np.asarray(points, np.float64)
    n = topology.n_control_vertices
    if points.shape != (n, 3):
        raise ValueError(f"`points` must be one a control vertex, shape [{n}, 3]; got {list(points.shape)}.")
    vertices = points
    if not scheme.interpolates:
        if topology.limit is None:
            raise ValueError("the topology has no limit masks. Build it with `limit=True`.")
        weights = stencils(scheme, topology)
        if topology.levels and not scheme.is_primal:
            raise ValueError(f"{type(scheme).__name__} needs a topology of 0 levels here; this one has more.")
        weights = weights[:n]
        # The least change that does: a matrix without an inverse then gives no large steps from nowhere. Solved again
        # for what is left, as the normal equations lose half of the digits.
        for _ in range(_REPEATS):
            miss = (points - weights @ vertices).T
            solve = partial(scipy.sparse.linalg.lsmr, weights, atol=_SOLVED, btol=_SOLVED, maxiter=10 * n)
            vertices = vertices + np.stack([solve(column)[0] for column in miss], axis=1)
        left = np.abs(weights @ vertices - points).max()
        if left > _REACHED * np.ptp(points, axis=0).max():
            raise ValueError(
                f"no control vertices reach these points: the closest limit misses by {left:.3g}. On this mesh the "
                "limit positions depend on one another. Leave some points out, refine once first, or fit."
            )
    rows = jnp.asarray(vertices, jnp.result_type(float))
    return Control(rows, estimate_normals(topology.control_fans, rows, scheme.weights))
