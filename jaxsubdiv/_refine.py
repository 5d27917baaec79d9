"""`refine`, the compiled front door: one loop over the levels for every scheme."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._control import Control
from ._control_faces import faces_of_levels
from ._normals import fan_normals
from ._scheme.base import AbstractScheme
from ._surface import RefinedSurface
from ._topology import Level, LimitMasks, Topology
from .linalg import cross, max_abs, unit, unit_or


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


def refine_vertices(scheme: AbstractScheme, topology: Topology, control: Control) -> Float[Array, "w 3"]:
    """The vertices of `refine` alone: what their normals cost is saved, outside of `jax.jit` too.

    Args:
        scheme: the rules and their `h`.
        topology: tables from `build_topology`.
        control: vertices `[v, 3]` in any unit, and normals `[v, 3]` of any length.

    Returns:
        The refined vertices, in the unit, the dtype and the order of those of `refine`.

    Raises:
        ValueError: as `refine`.
    """
    _check(scheme, topology, control)
    return _refine_vertices(scheme, topology, control)


def refine_levels(scheme: AbstractScheme, topology: Topology, control: Control) -> tuple[RefinedSurface, ...]:
    """The surfaces of all levels, from the control mesh itself to what `refine` returns: levels of detail, and whatever
    looks at a coarse level and a fine one in one program.

    Args:
        scheme: of points and normals; one that keeps its old normals has those of a level in all later ones.
        topology: tables from `build_topology`, not padded.
        control: vertices `[v, 3]` in any unit, and normals `[v, 3]` of any length.

    Raises:
        ValueError: as `refine`; or the scheme is linear: its normals are those of the last mesh alone.
    """
    _check(scheme, topology, control)
    faces = faces_of_levels(topology)
    found = _refine_levels(scheme, topology, control)
    return tuple(RefinedSurface(x, n, of_level) for (x, n), of_level in zip(found, faces, strict=True))


@jax.jit
def _refine_levels(
    scheme: AbstractScheme, topology: Topology, control: Control
) -> list[tuple[Float[Array, "_ 3"], Float[Array, "_ 3"]]]:
    origin, levels = _split_levels(scheme, topology, control)
    n_control = control.vertices.shape[0]
    return [(jnp.concatenate([control.vertices, x[n_control:] + origin]), n) for x, n in levels]


@jax.jit
def _refine_vertices(scheme: AbstractScheme, topology: Topology, control: Control) -> Float[Array, "w 3"]:
    return _refine(scheme, topology, control)[0]


@jax.jit
def _refine(
    scheme: AbstractScheme, topology: Topology, control: Control
) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
    origin, levels = _split_levels(scheme, topology, control)
    x, n = levels[-1]
    if topology.limit is not None:
        x, n = _move_to_limit(topology, topology.limit, x, scheme)
    elif topology.fans is not None:
        n = fan_normals(topology.fans, x, x, jnp.zeros_like(x), scheme.weights)
    if not scheme.interpolates:
        return x + origin, n
    n_control = control.vertices.shape[0]
    return jnp.concatenate([control.vertices, x[n_control:] + origin]), n


def _split_levels(
    scheme: AbstractScheme, topology: Topology, control: Control
) -> tuple[Float[Array, "1 3"], list[tuple[Float[Array, "_ 3"], Float[Array, "_ 3"]]]]:
    """The middle of the mesh, and about it the vertices and normals of all levels, the control mesh first."""
    # Scanners put the origin anywhere. Differences of vertices a metre from it lose digits in float32, most of all in
    # the normals of small faces; every rule is free of the origin, so the middle of the mesh serves.
    origin = jax.lax.stop_gradient(_middle(topology, control.vertices))
    levels = [(control.vertices - origin, unit(control.normals))]
    h = None if scheme.h is None else scheme.h.astype(control.vertices.dtype)
    for i, level in enumerate(topology.levels):
        last = i == len(topology.levels) - 1
        recompute = scheme.recomputes_normals or (topology.mesh_normals and last)
        levels.append(scheme.refine_level(h if h is None or h.ndim == 0 else h[i], level, *levels[-1], recompute))
    return origin, levels


def _middle(topology: Topology, x: Float[Array, "v 3"]) -> Float[Array, "1 3"]:
    """Mean of the control vertices, spare ones left out."""
    if topology.real is None:
        return jnp.mean(x, axis=0, keepdims=True)
    real = topology.real.control_vertices[:, None]
    return jnp.sum(jnp.where(real, x, 0.0), axis=0, keepdims=True) / jnp.sum(real).astype(x.dtype)


def _move_to_limit(
    topology: Topology, limit: LimitMasks, x: Float[Array, "w 3"], scheme: AbstractScheme
) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
    """Every vertex in its place on the limit surface, and the normal there; that of the mesh where it has none."""
    assert topology.fans is not None
    points = limit.points(x)
    n = fan_normals(topology.fans, points, points, jnp.zeros_like(x), scheme.weights)
    if limit.tangents is None:
        return points, n
    first, second = (tangent(x) for tangent in limit.tangents)
    rounding = 16 * jnp.finfo(x.dtype).eps * max_abs(first) * max_abs(second)
    return points, unit_or(cross(first, second), n, rounding)


def _check(scheme: AbstractScheme, topology: Topology, control: Control) -> None:
    x, n, v = control.vertices, control.normals, topology.n_control_vertices
    if x.shape != (v, 3) or n.shape != (v, 3):
        padded = "" if topology.real is None else " For a padded topology, pad them with `pad_control`."
        raise ValueError(
            f"the topology has {v} control vertices, so vertices and normals must both have the shape [{v}, 3]; got "
            f"{list(x.shape)} and {list(n.shape)}. Batches go through `jax.vmap`.{padded}"
        )
    if x.dtype != n.dtype:
        raise ValueError(f"vertices and normals must have one dtype; got {x.dtype} and {n.dtype}.")
    if topology.built_for != scheme.tables_for:
        raise ValueError(
            f"the topology was built for {topology.built_for}, and this scheme needs its own, for {scheme.tables_for}. "
            "Build it with `build_topology(mesh, scheme, levels)` for this scheme."
        )
    levels, h = len(topology.levels), scheme.h
    if h is not None and (h.ndim > 1 or (h.ndim == 1 and h.shape[0] != levels)):
        raise ValueError(
            f"the topology has {levels} levels, so `h` must be a scalar or have the shape [{levels}]; got "
            f"{list(h.shape)}."
        )
    if scheme.recomputes_normals and any(isinstance(a, Level) and a.old_fans is None for a in topology.levels):
        raise ValueError(
            'the topology was built for a scheme that keeps old normals, but this one has old_normals="recompute". '
            "Build it with `build_topology(mesh, scheme, levels)` for this scheme."
        )
