"""`refine`, the compiled front door: one loop over the levels for every scheme."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._control import Control
from ._linalg import unit
from ._normals import fan_normals
from ._scheme.base import AbstractScheme, gather_edges, new_normals
from ._surface import RefinedSurface
from ._topology import Level, Topology


def refine(scheme: AbstractScheme, topology: Topology, control: Control) -> RefinedSurface:
    """Refine a control mesh: a smooth function of the control vertices, their normals and h.

    Compiled once for every combination of sizes, scheme options and dtype; differentiable in both modes and to any
    order, under `jit` and `vmap`. The gradient is 0 at a row where a formula has none (a zero normal, a vanishing sum
    of face normals), never NaN.

    Args:
        scheme: the rules and their `h`.
        topology: tables from `build_topology`, for a mesh of these faces. Pass it as an argument into your own
            `jax.jit`: a table that is closed over is copied into the compiled program.
        control: vertices `[v, 3]` in any unit, and normals `[v, 3]` of any length.

    Returns:
        The surface after `len(topology.levels)` levels, in the unit and the dtype of `control.vertices`. Its vertices
        are the control vertices, unchanged and in their order, then level by level the edge vertices and the face
        vertices. Its normals have length 1, or 0 where a control vertex had none.

    Raises:
        ValueError: at trace time, if shapes do not fit one another, `h` has not one value a level, or the topology was
            built for a scheme that keeps its old normals and this one recomputes them.

    Source: Sisojevs & Glazs, Smoothing Approach of 3D Models Based on Interpolating Subdivision Surface, 2012.
    """
    _check(scheme, topology, control)
    # The faces stay outside of the compiled part: they would be copied there.
    vertices, normals = _refine(scheme, topology, control)
    return RefinedSurface(vertices, normals, topology.faces)


@jax.jit
def _refine(
    scheme: AbstractScheme, topology: Topology, control: Control
) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
    # Scanners put the origin anywhere. Differences of vertices a metre from it lose digits in float32, most of all in
    # the normals of small faces; every rule is free of the origin, so the middle of the mesh serves.
    origin = jax.lax.stop_gradient(jnp.mean(control.vertices, axis=0, keepdims=True))
    x, n = control.vertices - origin, unit(control.normals)
    h = scheme.h.astype(x.dtype)
    for i, level in enumerate(topology.levels):
        last = i == len(topology.levels) - 1
        recompute = scheme.recomputes_normals or (topology.mesh_normals and last)
        x, n = _refine_level(scheme, h if h.ndim == 0 else h[i], level, x, n, recompute)
    n_control = control.vertices.shape[0]
    return jnp.concatenate([control.vertices, x[n_control:] + origin]), n


def _refine_level(
    scheme: AbstractScheme,
    h: Float[Array, ""],
    level: Level,
    x: Float[Array, "v 3"],
    n: Float[Array, "v 3"],
    recompute: bool,
) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
    edges = gather_edges(level, x, n)
    edge_points = scheme.edge_points(h, edges)
    face_points = scheme.face_points(h, level, x, n, edges, edge_points)
    refined = jnp.concatenate([x, edge_points, face_points])
    edge_normals, face_normals = new_normals(scheme, level, edges, n, refined)
    if recompute:
        assert level.old_fans is not None  # see _check
        n = fan_normals(level.old_fans, x, refined, n, scheme.weights)
    return refined, jnp.concatenate([n, edge_normals, face_normals])


def _check(scheme: AbstractScheme, topology: Topology, control: Control) -> None:
    x, n, v = control.vertices, control.normals, topology.n_control_vertices
    if x.shape != (v, 3) or n.shape != (v, 3):
        raise ValueError(
            f"the topology has {v} control vertices, so vertices and normals must both have the shape [{v}, 3]; got "
            f"{list(x.shape)} and {list(n.shape)}. Batches go through `jax.vmap`."
        )
    if x.dtype != n.dtype:
        raise ValueError(f"vertices and normals must have one dtype; got {x.dtype} and {n.dtype}.")
    levels = len(topology.levels)
    if scheme.h.ndim > 1 or (scheme.h.ndim == 1 and scheme.h.shape[0] != levels):
        raise ValueError(
            f"the topology has {levels} levels, so `h` must be a scalar or have the shape [{levels}]; got "
            f"{list(scheme.h.shape)}."
        )
    if scheme.recomputes_normals and any(level.old_fans is None for level in topology.levels):
        raise ValueError(
            'the topology was built for a scheme that keeps old normals, but this one has old_normals="recompute". '
            "Build it with `build_topology(mesh, scheme, levels)` for this scheme."
        )
