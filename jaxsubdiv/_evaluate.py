"""The surface of a control mesh at any place `(control face, uv)`, with its derivatives."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._control import Control
from ._patches import patch_points
from ._refine import refine, refine_vertices
from ._scheme.base import AbstractScheme
from ._scheme.bezier_triangle import BezierTriangle, quad_patch, triangle_patch
from ._scheme.interpolating import edge_rule
from ._surface import SurfacePoint
from ._topology import Topology
from .linalg import cross, norm, take, unit

# Displacements shrink by about a third a level: what all later levels add is 3/2 of what the next one does.
_ALL_OF_NEXT = 1.5


class SurfaceJet(NamedTuple):
    """The surface at some places."""

    points: Float[Array, "p 3"]
    du: Float[Array, "p 3"]
    """Derivative of the point along the first coordinate of the control face, in the unit of the mesh."""
    dv: Float[Array, "p 3"]
    """And along the second."""
    normals: Float[Array, "p 3"]
    """Unit normals, at right angles to both derivatives."""
    error: Float[Array, "p"]
    """About how far the limit may be from the points, in the unit of the mesh: what the levels to come displace, by the
    bend of the refined face. 0 where the surface is evaluated as it is; beside creases, where one normal stands for
    two, it may be too small."""


def evaluate_control(scheme: AbstractScheme, topology: Topology, control: Control, at: SurfacePoint) -> SurfaceJet:
    """The surface at places of the control mesh: points, first derivatives, normals, and an estimate of the error.

    `BezierTriangle` is evaluated as it is. For the others a cubic patch is laid through the vertices and normals of the
    refined face there, so that more levels come closer. Linear schemes need `limit=True`: their patches then have
    their corners and normals on the limit surface, and are exact there. Catmull-Clark and Loop are evaluated as they
    are on refined faces away from extraordinary vertices, creases and boundaries: there the limit is a spline.

    Args:
        scheme: the rules.
        topology: tables from `build_topology`.
        control: vertices and normals.
        at: faces of the control mesh, triangles numbered first, and coordinates in them.

    Raises:
        ValueError: a linear scheme without `limit=True`, or one whose refined faces have no place in the control faces:
            Doo-Sabin, and Catmull-Clark on triangles.
    """
    if scheme.is_linear and topology.limit is None:
        raise ValueError("the topology has no limit masks. Build it with `limit=True`.")
    whole = {size: 4 ** len(topology.levels) * len(rows) for size, rows in topology.control_faces.items()}
    if not scheme.is_primal or whole != {size: len(rows) for size, rows in topology.faces.items()}:
        raise ValueError(
            f"{type(scheme).__name__} does not split these control faces into four at every level, so that a place in "
            "one has none in the refined mesh. Refine, and use `evaluate` on the refined surface."
        )
    return _evaluate(scheme, topology, control, at)


@jax.jit
def _evaluate(scheme: AbstractScheme, topology: Topology, control: Control, at: SurfacePoint) -> SurfaceJet:
    exact = isinstance(scheme, BezierTriangle)
    if exact:
        x, n, faces, levels = control.vertices, unit(control.normals), topology.control_faces, 0
    else:
        surface = refine(scheme, topology, control)
        x, n, faces, levels = surface.vertices, surface.normals, surface.faces, len(topology.levels)
    splines, before_limit = None if topology.limit is None else topology.limit.patches, x
    if splines is not None:
        bare = eqx.tree_at(lambda topology: topology.limit, topology, None)
        before_limit = refine_vertices(scheme, bare, control)
    n_triangles = topology.control_faces[3].shape[0]
    given, uv = at.face.astype(jnp.int32), at.uv.astype(x.dtype)
    in_triangle = given < n_triangles
    row = jnp.where(in_triangle, given, given - n_triangles)

    def patches(uv: Float[Array, "p 2"]) -> tuple[Float[Array, "p 3"], Float[Array, "p"]]:
        found = []
        for size, locate, patch in ((3, _in_triangle, triangle_patch), (4, _in_quad, quad_patch)):
            if not faces[size].shape[0]:
                continue
            face, (u, v) = row, (uv[:, 0], uv[:, 1])
            for _ in range(levels):
                child, u, v = locate(u, v)
                face = 4 * face + child
            corners = faces[size][jnp.clip(face, 0, faces[size].shape[0] - 1)]
            points, _ = patch(corners, u[:, None], v[:, None], x, n)
            bend = jnp.zeros_like(u) if exact else _bend(corners, x, n)
            if splines is not None and splines.shape[1] == 4 * size:
                table = splines[jnp.clip(face, 0, splines.shape[0] - 1)]
                regular = table[:, 0] >= 0
                points = jnp.where(regular[:, None], patch_points(table, u, v, before_limit), points)
                bend = jnp.where(regular, 0.0, bend)
            found.append((points, bend))
        if len(found) == 1:
            return found[0]
        (a, of_a), (b, of_b) = found
        return jnp.where(in_triangle[:, None], a, b), jnp.where(in_triangle, of_a, of_b)

    first, second = (jnp.zeros_like(uv).at[:, axis].set(1.0) for axis in (0, 1))
    (points, bend), (du, _) = jax.jvp(patches, (uv,), (first,))
    _, (dv, _) = jax.jvp(patches, (uv,), (second,))
    return SurfaceJet(points, du, dv, unit(cross(du, dv)), _ALL_OF_NEXT * bend)


def _bend(corners: Int[Array, "p k"], x: Float[Array, "v 3"], n: Float[Array, "v 3"]) -> Float[Array, "p"]:
    """By how much the next level would displace the middle of an edge, at most."""
    p, q = take(x, corners), take(n, corners)
    p_next, q_next = jnp.roll(p, -1, axis=1), jnp.roll(q, -1, axis=1)
    middle = edge_rule(jnp.ones((), x.dtype), p, p_next, q, q_next)
    return norm(middle - (p + p_next) / 2)[..., 0].max(axis=1)


_Coordinate = Float[Array, "p"]


def _in_triangle(u: _Coordinate, v: _Coordinate) -> tuple[Int[Array, "p"], _Coordinate, _Coordinate]:
    """The child of a triangle that a point lies in, and its coordinates there; children as in `hybrid_split`."""
    w = 1 - u - v
    places = [(w >= 0.5, 2 * u, 2 * v), (u >= 0.5, 2 * v, 2 * w), (v >= 0.5, 2 * w, 2 * u)]
    return _choose(places, (2 * (u + v) - 1, 1 - 2 * u))


def _in_quad(u: _Coordinate, v: _Coordinate) -> tuple[Int[Array, "p"], _Coordinate, _Coordinate]:
    """The child of a quad that a point lies in, and its coordinates there."""
    left, low = u < 0.5, v < 0.5
    places = [
        (left & low, 2 * u, 2 * v),
        (~left & low, 2 * v, 2 * (1 - u)),
        (~left & ~low, 2 * (1 - u), 2 * (1 - v)),
    ]
    return _choose(places, (2 * (1 - v), 2 * u))


def _choose(
    places: list[tuple[Bool[Array, "p"], _Coordinate, _Coordinate]], last: tuple[_Coordinate, _Coordinate]
) -> tuple[Int[Array, "p"], _Coordinate, _Coordinate]:
    child, (u, v) = jnp.full(last[0].shape, len(places), jnp.int32), last
    for i, (here, at_u, at_v) in reversed(list(enumerate(places))):
        child, u, v = jnp.where(here, jnp.int32(i), child), jnp.where(here, at_u, u), jnp.where(here, at_v, v)
    return child, u, v
