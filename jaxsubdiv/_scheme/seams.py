"""Edges that two sides of a crease share: one edge point for both, from the normals of both."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._topology import Level
from ..linalg import Rows, dot, max_abs, take

# Two normals that are closer than this (in length, about a degree) fade into one: so close, the direction at right
# angles to both is lost, and its derivatives are large. At any sharper crease nothing of the fading is left.
_FADE = 0.02


def project_on_normals(d: Rows, left: Rows, right: Rows) -> Rows:
    """The part of `d` that lies in the plane of two unit normals; along the one normal where they agree.

    Their sum s and difference t are at right angles, so that it is (s.d) s/|s|^2 + (t.d) t/|t|^2: symmetric in the two
    sides and in their signs. A sum or difference that vanishes fades out with a continuous derivative, and none is
    divided by a small number. Where one normal is zero the other one stands for both.
    """
    left, right = jnp.where(dot(left, left) > 0, left, right), jnp.where(dot(right, right) > 0, right, left)
    s, t = left + right, left - right
    return _inverse(dot(s, s)) * dot(s, d) * s + _inverse(dot(t, t)) * dot(t, d) * t


def _inverse(square: Float[Array, "*rows 1"]) -> Float[Array, "*rows 1"]:
    """1 / q down to the fading; under it w(q / e) / q with w(r) = r^2 (3 - 2 r), which is 1 at r = 1 with slope 0."""
    r = square / _FADE**2
    faded = r < 1
    return jnp.where(faded, r * (3 - 2 * r) / _FADE**2, 1 / jnp.where(faded, 1.0, square))


def place_seam_points(
    level: Level,
    x: Float[Array, "v 3"],
    n: Float[Array, "v 3"],
    edge_points: Float[Array, "e 3"],
    h: Float[Array, ""],
    factor: Callable[[Rows, Rows], Float[Array, "s 1"] | float],
) -> Float[Array, "e 3"]:
    """Edge points with those of the seams put in, the same for both sides bit by bit.

    Eqs. (1) and (2) with tangents at right angles to the normals of both sides: with the part N of d = b - a in the
    plane of the two normals at an end, m_ab = h (d - N_a), m_ba = -h (d - N_b), and Q = (a + b)/2 + (h/8) (N_b - N_a).

    Args:
        level: tables with seams.
        x: positions of the vertices.
        n: their unit normals, or zeros.
        edge_points: of all edges, by the rule for one normal an end.
        h: tangent length coefficient.
        factor: of the tangents m, by the scheme.
    """
    assert level.seams is not None
    one, other = level.edges[level.seams[:, 0]], level.edges[level.seams[:, 1]]
    a, b = take(x, one[:, 0]), take(x, one[:, 1])
    d = b - a
    n_a = project_on_normals(d, take(n, one[:, 0]), take(n, other[:, 1]))  # the sides run opposite ways
    n_b = project_on_normals(d, take(n, one[:, 1]), take(n, other[:, 0]))
    t_a, t_b = (_drop_rounding(d - part, d) for part in (n_a, n_b))
    points = 0.5 * (a + b) + (h / 8) * factor(t_a, t_b) * (n_b - n_a)
    # Computed once and put in twice: computed twice, compiled code may round the two sides apart.
    return edge_points.at[level.seams.reshape(-1)].set(jnp.repeat(points, 2, axis=0), mode="promise_in_bounds")


def _drop_rounding(t: Rows, d: Rows) -> Rows:
    """Zero where nothing but rounding is left of `d`: that has no direction."""
    return jnp.where(max_abs(t) > 16 * jnp.finfo(d.dtype).eps * max_abs(d), t, 0.0)
