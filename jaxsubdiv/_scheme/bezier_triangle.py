"""Bézier (PN) triangles, and the Hermite patch for quads: a surface of patches, put out at their dyadic points."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._fans import as_table
from .._normals import Weights
from .._stage import Stage, hybrid_split
from .._topology import AbstractLevel
from ..linalg import Rows, dot, take, unit
from .base import AbstractScheme


class Places(eqx.Module):
    """Points on control faces of one size."""

    corners: Int[Array, "m k"] = eqx.field(converter=as_table)
    """Control vertices of the face."""
    uv: Int[Array, "m 2"] = eqx.field(converter=as_table)
    """Coordinates in the face, as `SurfacePoint` has them, times `denominator`."""
    denominator: int = eqx.field(static=True)

    def coordinates(self, x: Array) -> tuple[Float[Array, "m 1"], Float[Array, "m 1"]]:
        """u and v in the dtype of `x`."""
        uv = self.uv.astype(x.dtype) / self.denominator
        return uv[:, :1], uv[:, 1:]


class PatchLevel(AbstractLevel):
    """Places of the vertices that a level adds."""

    edges: Int[Array, "e 2"] = eqx.field(converter=as_table)
    in_triangles: Places
    in_quads: Places
    order: Int[Array, "w"] = eqx.field(converter=as_table)
    """Where each new vertex stands in the places laid end to end."""


class BezierTriangle(AbstractScheme):
    """Curved PN triangles: a cubic Bézier triangle on three points and normals; on quads the bicubic Hermite patch.

    The patches meet in common boundary curves, but not smoothly: only the normals put out are continuous, as they are
    interpolated apart from the points, by quadratics. A quad has the cubic boundaries of triangles, zero twist, and the
    biquadratic of its edges' normals. At the first level the edge vertices are those of `Interpolating` with h = 1.

    Source: A. Vlachos, J. Peters, C. Boyd & J. Mitchell, Curved PN triangles, 2001, with the normals as printed (no
    factor of 2 for the middle terms). They stand in for the Bézier triangles of Sisojevs & Glazs's earlier paper.
    """

    h: None = eqx.field(init=False, default=None)
    weights: Weights = eqx.field(static=True, default="area", init=False)

    interpolates: ClassVar[bool] = True
    is_linear: ClassVar[bool] = False
    uses_normals: ClassVar[bool] = True
    order: ClassVar[int] = 4

    def split(self, stage: Stage) -> Stage:
        return hybrid_split(stage)

    def level(self, stage: Stage, recompute: bool) -> PatchLevel:
        n_triangle_sides = stage.faces[3].size
        is_triangle = stage.left < n_triangle_sides
        n_quads = len(stage.faces[4])
        # Edge vertices lie in the face on the left; both faces agree there.
        triangles = _places(stage, 3, *np.divmod(stage.left[is_triangle], 3))
        face, side = np.divmod(stage.left[~is_triangle] - n_triangle_sides, 4)
        quads = _places(stage, 4, np.append(face, np.arange(n_quads)), np.append(side, np.full(n_quads, -1)))
        row = np.cumsum(is_triangle) - 1
        row = np.where(is_triangle, row, is_triangle.sum() + np.cumsum(~is_triangle) - 1)
        return PatchLevel(stage.edges, triangles, quads, np.append(row, len(row) + np.arange(n_quads)))

    def refine_level(
        self,
        h: Float[Array, ""] | None,
        level: PatchLevel,
        x: Float[Array, "v 3"],
        n: Float[Array, "v 3"],
        recompute: bool,
    ) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
        triangles, quads = level.in_triangles, level.in_quads
        parts = [
            triangle_patch(triangles.corners, *triangles.coordinates(x), x, n),
            quad_patch(quads.corners, *quads.coordinates(x), x, n),
        ]
        points, normals = (take(jnp.concatenate(rows), level.order) for rows in zip(*parts, strict=True))
        return jnp.concatenate([x, points]), jnp.concatenate([n, normals])


def tangent(x_a: Rows, x_b: Rows, n_a: Rows) -> Rows:
    """m_ab, eq. (1) with h = 1: the edge from a to b, laid into the tangent plane at a."""
    d = x_b - x_a
    return d - dot(n_a, d) * n_a


def edge_normal(x_a: Rows, x_b: Rows, n_a: Rows, n_b: Rows) -> Rows:
    """The middle normal of an edge: the ends' sum, mirrored in the plane across the edge."""
    s, along = n_a + n_b, unit(x_b - x_a)
    return unit(s - 2 * dot(along, s) * along)


def corner_values(
    corners: Int[Array, "m k"], x: Float[Array, "v 3"]
) -> tuple[Float[Array, "k m 3"], Float[Array, "k m 3"]]:
    """Values at the corners of every face, and at the corners after those."""
    here = take(x, corners.T)
    return here, jnp.roll(here, -1, axis=0)


def triangle_patch(
    corners: Int[Array, "m 3"],
    u: Float[Array, "m 1"],
    v: Float[Array, "m 1"],
    x: Float[Array, "v 3"],
    n: Float[Array, "v 3"],
) -> tuple[Rows, Rows]:
    """Points and normals of PN triangles."""
    (p, p_next), (q, q_next) = corner_values(corners, x), corner_values(corners, n)
    weight = jnp.stack([1 - u - v, u, v])
    after = jnp.roll(weight, -1, axis=0)
    near = p + tangent(p, p_next, q) / 3  # b_210, b_021, b_102
    far = p_next + tangent(p_next, p, q_next) / 3  # b_120, b_012, b_201
    point = (weight**3 * p + 3 * weight * after * (weight * near + after * far)).sum(axis=0)
    normal = (weight**2 * q + weight * after * edge_normal(p, p_next, q, q_next)).sum(axis=0)
    middle = (near + far).sum(axis=0) / 4 - p.sum(axis=0) / 6  # b_111 = E + (E - V) / 2
    return point + 6 * weight[0] * weight[1] * weight[2] * middle, unit(normal)


def quad_patch(
    corners: Int[Array, "m 4"],
    u: Float[Array, "m 1"],
    v: Float[Array, "m 1"],
    x: Float[Array, "v 3"],
    n: Float[Array, "v 3"],
) -> tuple[Rows, Rows]:
    """Points of bicubic Hermite patches with zero twist, and biquadratic normals."""
    (p, p_next), (q, q_next) = corner_values(corners, x), corner_values(corners, n)
    # How near a point is to each corner, along the side that follows the corner and along the one before it.
    ahead, back = jnp.stack([1 - u, 1 - v, u, v]), jnp.stack([1 - v, u, v, 1 - u])
    of_tangent_ahead, of_tangent_back = ahead**2 * (1 - ahead), back**2 * (1 - back)
    blend_ahead, blend_back = ahead**2 * (3 - 2 * ahead), back**2 * (3 - 2 * back)
    p_before = jnp.roll(p, 1, axis=0)
    point = (
        blend_ahead * blend_back * p
        + of_tangent_ahead * blend_back * tangent(p, p_next, q)
        + blend_ahead * of_tangent_back * tangent(p, p_before, q)
    ).sum(axis=0)
    middles = edge_normal(p, p_next, q, q_next)
    normal = ((ahead * back) ** 2 * q + ahead * (1 - ahead) * back**2 * middles).sum(axis=0)
    inside = u * (1 - u) * v * (1 - v)
    return point, unit(normal + inside * unit(middles.sum(axis=0)))


def _places(stage: Stage, size: int, face: Int[np.ndarray, "m"], side: Int[np.ndarray, "m"]) -> Places:
    """The middles of sides of faces, and with side -1 the middles of quads."""
    uv, n_children = corner_uv(size, stage.level), 4**stage.level
    control, child = np.divmod(face, n_children)
    blocks = stage.faces[size].reshape(-1, n_children, size)
    ahead = np.where(side < 0, 2, (side + 1) % size)
    behind = np.where(side < 0, 0, side)
    corners = _control_corners(blocks, size, stage.level)
    return Places(corners[control], uv[child, behind] + uv[child, ahead], 2 ** (stage.level + 1))


def _control_corners(blocks: Int[np.ndarray, "f n k"], size: int, level: int) -> Int[np.ndarray, "f k"]:
    """Corners of the control faces: at corner `c` lies child `c`, which starts there, and so do its first children."""
    if level == 0:
        return blocks[:, 0]
    return blocks[:, 4 ** (level - 1) * np.arange(size), 0]


def corner_uv(size: int, level: int) -> Int[np.ndarray, "n k 2"]:
    """Corners of the descendants of one face, in its own coordinates times `2**level`."""
    uv = np.array([[(0, 0), (1, 0), (1, 1), (0, 1)] if size == 4 else [(0, 0), (1, 0), (0, 1)]])
    for _ in range(level):
        middle = uv + np.roll(uv, -1, axis=1)
        before = np.roll(middle, 1, axis=1)
        if size == 4:
            centre = np.broadcast_to((uv[:, :1] + uv[:, 2:3]), uv.shape)
            children = np.stack([2 * uv, middle, centre, before], axis=2)
        else:
            children = np.concatenate([np.stack([2 * uv, middle, before], axis=2), middle[:, None]], axis=1)
        uv = children.reshape(-1, size, 2)
    return uv
