"""The scheme of the paper: edge tangents from vertices and normals, eqs. (1)-(3)."""

from typing import ClassVar, Literal, TypeAlias, get_args

import equinox as eqx
from jaxtyping import Array, Float

from .._normals import Boundary, Weights
from .._topology import Level
from ..linalg import PerRow, Rows, Vectors, dot, take_each
from .base import AbstractPointNormalScheme, Edges, OldNormals, check_option, corner_total, tangent_length

Twist: TypeAlias = Literal["zero", "printed"]


def edge_rule(h: Float[Array, ""] | PerRow, x_a: Rows, x_b: Rows, n_a: Rows, n_b: Rows) -> Rows:
    """Point in the middle of an edge, eqs. (1) and (2).

    With the tangents m_ab = h (d - (n_a.d) n_a) and m_ba = -h (d - (n_b.d) n_b), d = b - a, eq. (2),
    Q = (a + b)/2 + (m_ab + m_ba)/8, becomes Q = (a + b)/2 + (h/8) ((n_b.d) n_b - (n_a.d) n_a): no division, and a zero
    normal gives no bend from its end.

    Args:
        h: tangent length coefficient, for all edges or one an edge.
        x_a, x_b: ends, in the unit of the mesh.
        n_a, n_b: unit normals at the ends, or zeros.
    """
    d = x_b - x_a
    return 0.5 * (x_a + x_b) + ((h / 8 * dot(n_b, d)) * n_b - (h / 8 * dot(n_a, d)) * n_a)


def coons_centre(level: Level, x: Float[Array, "v 3"], edge_points: Float[Array, "e 3"]) -> Float[Array, "1 q 3"]:
    """Middle of the Coons patch between four edges: half the sum of the edge points less a quarter of the corners'.

    It is eq. (3) with zero twist vectors, 1/4 sum P + 1/16 sum m, with the tangents m put in terms of the edge points.
    """
    a, b, c, d = take_each(edge_points, level.quad_edges)
    return 0.5 * ((a + b) + (c + d)) - 0.25 * corner_total(level, x)


class Interpolating(AbstractPointNormalScheme):
    """The interpolating subdivision of Sisojevs & Glazs (2012), for triangles, quads and meshes of both.

    Control vertices stay where they are; smooth limit for 0 < h < 3, planes stay planes, order 4 in the edge length
    with exact normals on regular meshes.

    Args:
        h: tangent length coefficient, dimensionless: one for all levels, or one a level, `[levels]`. 1 is exact on
            quadratics and gives the edge middles of the cubic Bézier (PN) triangle; 0 is flat midpoint splitting.
        twist: "zero", or "printed" for eq. (3) as it stands in the paper. The printed bracket takes normals for twist
            vectors: it depends on the unit of length and on a quad's first corner, and folds small meshes.
        weights: of the corner normals in (6): "area" (printed), "uniform", "angle" or "sphere".
        old_normals: "keep" the normals of old vertices, which are then those of the limit; or "recompute" them by (6)
            at every level, which never folds where the given normals are bad.
        boundary: normals of new boundary vertices by (6) on the one-sided "fan", or the "chord" normal of their edge.

    Raises:
        ValueError: an option is not one of these, or `h` has more than one axis.
    """

    h: Float[Array, "..."] = eqx.field(converter=tangent_length, default=1.0)
    twist: Twist = eqx.field(static=True, default="zero")
    weights: Weights = eqx.field(static=True, default="area")
    old_normals: OldNormals = eqx.field(static=True, default="keep")
    boundary: Boundary = eqx.field(static=True, default="fan")
    order: ClassVar[int] = 4

    def __check_init__(self) -> None:
        check_option("twist", self.twist, get_args(Twist))
        check_option("weights", self.weights, get_args(Weights))
        check_option("old_normals", self.old_normals, get_args(OldNormals))
        check_option("boundary", self.boundary, get_args(Boundary))

    @property
    def recomputes_normals(self) -> bool:
        return self.old_normals == "recompute"

    def edge_points(self, h: Float[Array, ""], edges: Edges) -> Vectors:
        return edge_rule(h, *edges)

    def face_points(
        self,
        h: Float[Array, ""],
        level: Level,
        x: Float[Array, "v 3"],
        n: Float[Array, "v 3"],
        edge_points: Float[Array, "e 3"],
    ) -> Float[Array, "1 q 3"]:
        centre = coons_centre(level, x, edge_points)
        if self.twist == "zero":
            return centre
        i, j, k, l = take_each(n, level.quads)  # noqa: E741  # the paper's names
        return centre + (i - j + k - l) / 64
