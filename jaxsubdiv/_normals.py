"""Vertex normals from the faces around a vertex, eqs. (4)-(6), and the normals of edges."""

import operator
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from ._fans import Fans
from .linalg import PerRow, Rows, cross, dot, max_abs, take, unit, unit_or, where

Weights: TypeAlias = Literal["area", "uniform", "angle", "sphere"]
"""How the corner normals around a vertex are weighed in (6)."""
Boundary: TypeAlias = Literal["fan", "chord"]
"""Where the normal of a new boundary vertex comes from: the faces there are, or its edge."""

# A sum of cross products that is smaller than this many rounding errors of its terms has no direction of its own.
_ROUNDING_ERRORS = 16


def corner_sum(
    a: Float[Array, "k *rows 3"], b: Float[Array, "k *rows 3"], weights: Weights
) -> tuple[Float[Array, "*rows 3"], Float[Array, "*rows 1"]]:
    """Weighted sum of the corner normals around a vertex, eq. (6), and the size under which it is rounding alone.

    Args:
        a: edges to the neighbour after the vertex in each of its `k` faces, counter-clockwise around the face.
        b: edges to the neighbour before it in the same face.
        weights: "area", the raw cross products as printed; "uniform", unit corner normals; "angle", unit corner normals
            times the angle; "sphere", cross products over both squared edge lengths, exact on spheres.

    Source: Sisojevs & Glazs, eqs. (4)-(6), with v_i = P_i - P; "sphere": N. Max, Weights for computing vertex normals
    from facet normals, 1999.
    """
    if weights == "sphere":
        longest = jnp.maximum(dot(a, a), dot(b, b)).max(axis=0, keepdims=True, initial=0.0)
        longest = jnp.broadcast_to(longest, (*a.shape[:-1], 1))
        a, b = _invert(a, longest), _invert(b, longest)
    normals = _WEIGH[weights](cross(a, b), a, b)
    return normals.sum(axis=0), _rounding(max_abs(normals).sum(axis=0))


def ring_sum(
    centre: Rows, ring: Sequence[Rows], weights: Weights, there: Bool[Array, "k *rows 1"] | None = None
) -> tuple[Rows, Float[Array, "*rows 1"]]:
    """`corner_sum` for the closed ring of a vertex's neighbours, counter-clockwise.

    The centre may stand in its own ring, once or more: the faces beside it there are missing, and add nothing. With
    area weights the sum is twice the vector area of the ring, which does not depend on the centre: two cross products
    for six neighbours, one for four.

    Args:
        centre: the vertex.
        ring: its neighbours.
        weights: as for `corner_sum`.
        there: whether a neighbour and the next make a corner of a face; default: all do.
    """
    if weights != "area":
        # Corner by corner, and no stack of them: XLA's CPU backend would branch at every element of the stack. It does
        # so too where the edges are masked in place of the normals.
        spokes = [neighbour - centre for neighbour in ring]
        if weights == "sphere":
            longest = reduce(jnp.maximum, (dot(spoke, spoke) for spoke in spokes))
            spokes = [_invert(spoke, longest) for spoke in spokes]
        pairs = zip(spokes, [*spokes[1:], spokes[0]], strict=True)
        normals = [_WEIGH[weights](cross(a, b), a, b) for a, b in pairs]
        if there is not None:  # compiled code may round two copies of one position apart, and make a corner of them
            normals = [where(real, normal, 0.0) for real, normal in zip(there, normals, strict=True)]
        return reduce(operator.add, normals), _rounding(reduce(operator.add, map(max_abs, normals)))
    first, rest = ring[0], ring[1:]
    # The quads (first, rest_i, rest_i+1, rest_i+2), each by its diagonals.
    across = [rest[i + 1] - first for i in range(0, len(rest) - 1, 2)]
    along = [rest[i + 2] - rest[i] for i in range(0, len(rest) - 1, 2)]
    pairs = list(zip(across, along, strict=True))
    total = reduce(operator.add, (cross(a, b) for a, b in pairs))
    return total, _rounding(reduce(operator.add, (max_abs(a) * max_abs(b) for a, b in pairs)))


@partial(jax.jit, static_argnames="weights")
def estimate_normals(fans: Fans, vertices: Float[Array, "v 3"], weights: Weights = "area") -> Float[Array, "v 3"]:
    """Unit normals at the vertices of a mesh from its faces, eqs. (4)-(6); zero where there are no faces.

    Args:
        fans: corners around every vertex; `topology.control_fans` for the control mesh.
        vertices: positions, in any unit.
        weights: how the corner normals are weighed, see `Interpolating`.

    Differentiable in `vertices`; the gradient is 0 where the sum vanishes.
    """
    return fan_normals(fans, vertices, vertices, jnp.zeros_like(vertices), weights)


def fan_normals(
    fans: Fans,
    centres: Float[Array, "v 3"],
    neighbours: Float[Array, "w 3"],
    fallback: Float[Array, "v 3"],
    weights: Weights,
) -> Float[Array, "v 3"]:
    """Unit normals of `centres` by the corners in `fans`; `fallback` where the sum in (6) vanishes."""
    parts = []
    for fan in fans.groups:
        centre = take(centres, fan.centre)[None]
        a, b = take(neighbours, fan.next) - centre, take(neighbours, fan.previous) - centre
        total, rounding = corner_sum(a, b, weights)
        parts.append(unit_or(total, take(fallback, fan.centre), rounding))
    return take(jnp.concatenate(parts), fans.order)


def chord_normals(n_a: Rows, n_b: Rows, d: Rows) -> Rows:
    """Normal of an edge, at right angles to it: the mean of its ends' normals less its part along the edge.

    Source: shared by the circle-preserving scheme and the "chord" boundary: n_e = unit(s - (s.d) d / |d|^2),
    s = n_a + n_b. Zero where `s` has nothing across the edge.
    """
    s = n_a + n_b
    along = unit(d)
    return unit_or(s - dot(s, along) * along, 0.0, _rounding(max_abs(s)))


def _rounding(terms: Array) -> Array:
    return lax.stop_gradient(_ROUNDING_ERRORS * jnp.finfo(terms.dtype).eps * terms)


def _invert(edges: Rows, longest: PerRow) -> Rows:
    """Edges as the inversion in a sphere around their vertex leaves them: their raw cross products are those of the
    edges over both squared lengths.

    Against the longest squared edge there, so that no unit enters; a short edge is left finite. An edge that is
    rounding alone is dropped: its inverse has a gradient of 1 / e, which says nothing.
    """
    longest, e = lax.stop_gradient(longest), jnp.finfo(longest.dtype).eps
    square = dot(edges, edges)
    there = lax.stop_gradient(square) > (_ROUNDING_ERRORS * e) ** 2 * longest
    share = where(there, square, 1.0) / where(there, longest, 1.0)
    return where(there, (1 / (share + e)) * edges, 0.0)


# The weighted normal of a corner, from its cross product and its edges.


def _area(c: Rows, a: Rows, b: Rows) -> Rows:
    return c


def _uniform(c: Rows, a: Rows, b: Rows) -> Rows:
    return _direction(c, a, b)


def _angle(c: Rows, a: Rows, b: Rows) -> Rows:
    direction = _direction(c, a, b)
    sine, cosine = dot(c, direction), dot(a, b)
    there = sine > 0  # atan2 has no gradient at the origin, where one edge or the angle is zero
    return where(there, jnp.arctan2(where(there, sine, 1.0), cosine), 0.0) * direction


def _direction(c: Rows, a: Rows, b: Rows) -> Rows:
    # A fused multiply-add leaves a remainder even in the cross product of a vector with itself.
    return unit_or(c, 0.0, _rounding(max_abs(a) * max_abs(b)))


_WEIGH: dict[str, Callable[[Rows, Rows, Rows], Rows]] = {
    "area": _area,
    "uniform": _uniform,
    "angle": _angle,
    "sphere": _area,  # of inverted edges
}
