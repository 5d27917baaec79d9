"""The unknowns of a fit: which arrays may move, and in which coordinates."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

import jaxsubdiv as js
from jaxsubdiv._linalg import Rows, cross, norm, take, unit


class Free(eqx.Module):
    """What a fit may change.

    Attributes:
        vertices: the control vertices.
        normals: the directions of the control normals.
        h: the tangent length coefficient, one or one a level, as the scheme has it.
    """

    vertices: bool = eqx.field(static=True, default=True)
    normals: bool = eqx.field(static=True, default=True)
    h: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if not (self.vertices or self.normals or self.h):
            raise ValueError("nothing is free: let at least one of vertices, normals and h be True.")


class Unknowns(eqx.Module):
    """Offsets from where a sweep starts, each scaled so that 1 moves the surface by about 1 mm.

    Levenberg-Marquardt damps all unknowns alike, so they have to be alike.
    """

    vertices: Float[Array, "v 3"] | None
    normals: Float[Array, "v 2"] | None
    """Along two tangents of the unit sphere at the normal: its length is no unknown."""
    h: Float[Array, "..."] | None


def no_offset(free: Free, scheme: js.AbstractScheme, control: js.Control) -> Unknowns:
    """The start of a sweep."""
    dtype = control.vertices.dtype
    return Unknowns(
        jnp.zeros_like(control.vertices) if free.vertices else None,
        jnp.zeros_like(control.vertices[:, :2]) if free.normals else None,
        jnp.zeros_like(scheme.h, dtype=dtype) if free.h else None,
    )


def apply_offset(
    topology: js.Topology, scheme: js.AbstractScheme, control: js.Control, offset: Unknowns
) -> tuple[js.AbstractScheme, js.Control]:
    """Scheme and control with the offset put on: normals that turn become unit, what is not free stays bit for bit."""
    vertices, normals = control.vertices, control.normals
    length = edge_length(topology, control.vertices)
    if offset.normals is not None:
        # By eq. (2) an edge point moves by an eighth of the edge for a normal that turns by one radian.
        normals = unit(normals)
        first, second = tangents(normals)
        turn = offset.normals[:, :1] * first + offset.normals[:, 1:] * second
        normals = unit(normals + turn * (8 / length))
    if offset.vertices is not None:
        vertices = vertices + offset.vertices
    if offset.h is not None:
        h = scheme.h + (offset.h / h_effect(length)).astype(scheme.h.dtype)
        scheme = eqx.tree_at(lambda s: s.h, scheme, h)
    return scheme, js.Control(vertices, normals)


def edge_length(topology: js.Topology, vertices: Float[Array, "v 3"]) -> Float[Array, ""]:
    """Root mean square length of the control edges."""
    edges = topology.levels[0].edges
    d = take(vertices, edges[:, 1]) - take(vertices, edges[:, 0])
    return jnp.sqrt(jnp.mean(norm(d) ** 2))


def h_effect(length: Float[Array, ""]) -> Float[Array, ""]:
    """How far, in mm, the surface moves for a change of h by one: about a tenth of an edge in a sensible mesh."""
    return 0.1 * length


def tangents(n: Rows) -> tuple[Rows, Rows]:
    """Two unit vectors at right angles to a unit vector and to each other."""
    # The axis that is farthest from the normal never leaves the cross product short.
    least = jnp.argmin(jnp.abs(n), axis=1)
    first = unit(cross(n, jnp.eye(3, dtype=n.dtype)[least]))
    return first, cross(n, first)
