"""Bézier (PN) triangles, and the Hermite patch for quads: a surface of patches, put out at their dyadic points."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._fans import as_table
from .._linalg import Rows, dot, take, unit
from .._normals import Weights
from .._stage import Stage, hybrid_split
from .._topology import AbstractLevel
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
        parts = [triangle_patch(level.in_triangles, x, n), quad_patch(level.in_quads, x, n)]
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


def triangle_patch(at: Places, x: Float[Array, "v 3"], n: Float[Array, "v 3"]) -> tuple[Rows, Rows]:
    """Points and normals of PN triangles."""
    u, v = at.coordinates(x)
    w = 1 - u - v
    p, q = ([take(values, corner) for corner in at.corners.T] for values in (x, n))
    weights = (w, u, v)
    middle = point = normal = jnp.zeros_like(p[0])
    for i in range(3):
        j = (i + 1) % 3
        near = p[i] + tangent(p[i], p[j], q[i]) / 3  # b_210 and b_120 and so on
        far = p[j] + tangent(p[j], p[i], q[j]) / 3
        middle += (near + far) / 6
        point += weights[i] ** 3 * p[i] + 3 * weights[i] * weights[j] * (weights[i] * near + weights[j] * far)
        normal += weights[i] ** 2 * q[i] + weights[i] * weights[j] * edge_normal(p[i], p[j], q[i], q[j])
    flat = (p[0] + p[1] + p[2]) / 3
    return point + 6 * u * v * w * (1.5 * middle - 0.5 * flat), unit(normal)


def quad_patch(at: Places, x: Float[Array, "v 3"], n: Float[Array, "v 3"]) -> tuple[Rows, Rows]:
    """Points of bicubic Hermite patches with zero twist, and biquadratic normals."""
    u, v = at.coordinates(x)
    p, q = ([take(values, corner) for corner in at.corners.T] for values in (x, n))
    s, t = (1 - u, u), (1 - v, v)  # how near a corner is, by its place along u and along v
    place = ((0, 0), (1, 0), (1, 1), (0, 1))
    middles = [edge_normal(p[i], p[(i + 1) % 4], q[i], q[(i + 1) % 4]) for i in range(4)]
    centre = unit((middles[0] + middles[1]) + (middles[2] + middles[3]))
    point, normal = jnp.zeros_like(centre), s[0] * s[1] * t[0] * t[1] * centre
    for i, (a, b) in enumerate(place):
        along_u, along_v = (i + 1, i - 1) if i % 2 == 0 else (i - 1, i + 1)
        blend_u, blend_v = s[a] ** 2 * (3 - 2 * s[a]), t[b] ** 2 * (3 - 2 * t[b])
        point += blend_u * blend_v * p[i]
        point += s[a] ** 2 * (1 - s[a]) * blend_v * tangent(p[i], p[along_u % 4], q[i])
        point += blend_u * t[b] ** 2 * (1 - t[b]) * tangent(p[i], p[along_v % 4], q[i])
        normal += s[a] ** 2 * t[b] ** 2 * q[i]
        of_edge = s[0] * s[1] * t[b] ** 2 if i % 2 == 0 else s[a] ** 2 * t[0] * t[1]
        normal += of_edge * middles[i]
    return point, unit(normal)


def _places(stage: Stage, size: int, face: Int[np.ndarray, "m"], side: Int[np.ndarray, "m"]) -> Places:
    """The middles of sides of faces, and with side -1 the middles of quads."""
    uv, n_children = _corner_uv(size, stage.level), 4**stage.level
    control, child = np.divmod(face, n_children)
    # A face's first descendant starts at its first corner, and so on: corner children keep their corner.
    blocks = stage.faces[size].reshape(-1, n_children, size)
    ahead = np.where(side < 0, 2, (side + 1) % size)
    behind = np.where(side < 0, 0, side)
    corners = _control_corners(blocks, size, stage.level)
    return Places(corners[control], uv[child, behind] + uv[child, ahead], 2 ** (stage.level + 1))


def _control_corners(blocks: Int[np.ndarray, "f n k"], size: int, level: int) -> Int[np.ndarray, "f k"]:
    """Corners of the control faces: child `c` of a face starts at its corner `c`, at every level."""
    rows = [sum(corner * 4**power for power in range(level)) for corner in range(size)]
    first = [0 if level else corner for corner in range(size)]
    return blocks[:, rows if level else [0] * size, first]


def _corner_uv(size: int, level: int) -> Int[np.ndarray, "n k 2"]:
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
