"""The paper's split with rules that reproduce circles: spheres from any mesh on them."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._normals import Boundary, Weights, chord_normals
from .._topology import Level
from ..linalg import Rows, Vectors, compile_apart, dot, take_planes, unit, where
from .base import AbstractPointNormalScheme, Edges, edge_chord_normals, tangent_length
from .interpolating import edge_rule


def arc_factor(n_a: Rows, n_b: Rows) -> Float[Array, "*rows 1"]:
    """Factor of the tangents that puts an edge point on the circle through its ends, with their normals.

    An arc of angle theta between the normals asks for g = 2 / (c (1 + c)), c = cos(theta / 2). Beyond 120 degrees g
    stays what it is there, with gradient 0; where a normal is missing it is 1.
    """
    cosine = dot(n_a, n_b)
    c = jnp.sqrt((1 + where(cosine > -0.5, cosine, -0.5)) / 2)
    given = (dot(n_a, n_a) > 0) & (dot(n_b, n_b) > 0)
    return where(given, 2 / (c * (1 + c)), 1.0)


def arc_rule(h: Float[Array, ""], x_a: Rows, x_b: Rows, n_a: Rows, n_b: Rows) -> Rows:
    """`edge_rule` with its tangents lengthened to those of a circle."""
    return edge_rule(h * arc_factor(n_a, n_b), x_a, x_b, n_a, n_b)


class CirclePreserving(AbstractPointNormalScheme):
    """A relative of the paper's scheme that reproduces circles: same split, same inputs, four formulas changed.

    With h = 1 a mesh with its corners and normals on a sphere is refined on the sphere, to rounding, as long as no two
    normals that a rule joins are more than 120 degrees apart. It needs normals that are oriented alike: the sign of
    n_i.n_j matters. Against a torus or an ellipsoid its error is 4 to 10 times smaller than that of `Interpolating`.

    Args:
        h: tangent length coefficient, dimensionless: one for all levels, or one a level, `[levels]`.

    Raises:
        ValueError: `h` has more than one axis.

    Source: ours; close to the circle average of Lipovetsky & Dyn, A weighted binary average of point-normal pairs with
    application to subdivision schemes, 2016. Weights of the normals: Max 1999.
    """

    h: Float[Array, "..."] = eqx.field(converter=tangent_length, default=1.0)
    weights: Weights = eqx.field(static=True, default="sphere", init=False)
    boundary: Boundary = eqx.field(static=True, default="chord", init=False)
    order: ClassVar[int] = 4

    def edge_points(self, h: Float[Array, ""], edges: Edges) -> Vectors:
        return arc_rule(h, *edges)

    def seam_factor(self, t_a: Rows, t_b: Rows) -> Float[Array, "*rows 1"]:
        return arc_factor(unit(t_a), unit(t_b))  # on a circle tangents turn by the angle by which normals do

    def face_points(
        self,
        h: Float[Array, ""],
        level: Level,
        x: Float[Array, "v 3"],
        n: Float[Array, "v 3"],
        edge_points: Float[Array, "e 3"],
    ) -> Vectors:
        edge_normals = edge_chord_normals(level, jnp.concatenate([x, n], axis=1))
        q_ij, q_jk, q_kl, q_li = take_planes(edge_points, level.quad_edges)
        n_ij, n_jk, n_kl, n_li = take_planes(edge_normals, level.quad_edges)
        a, n_a = _middle(h, q_ij, q_kl, n_ij, n_kl)
        b, n_b = _middle(h, q_jk, q_li, n_jk, n_li)
        return arc_rule(h, a, b, n_a, n_b)


def _middle(h: Float[Array, ""], x_a: Vectors, x_b: Vectors, n_a: Vectors, n_b: Vectors) -> tuple[Vectors, Vectors]:
    """Point in the middle of a curve across a face, and the normal there."""
    middle = lax.split(_stacked_middle(h, x_a, x_b, n_a, n_b), (1,) * 6, axis=0)
    return Vectors(*middle[:3]), Vectors(*middle[3:])


@compile_apart
def _stacked_middle(
    h: Float[Array, ""], x_a: Vectors, x_b: Vectors, n_a: Vectors, n_b: Vectors
) -> Float[Array, "6 q 1"]:
    rules = arc_rule(h, x_a, x_b, n_a, n_b), chord_normals(n_a, n_b, x_b - x_a)
    return jnp.concatenate(jax.tree.leaves(rules))
