"""Closest points on triangles and bilinear quads, for arrays of numpy and of JAX alike."""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Int

from ._surface import RefinedSurface

_QUAD_STEPS = 3

AnyArray: TypeAlias = Any  # of numpy or of JAX


class FaceChoice(NamedTuple):
    """The faces of a surface that each point may be paired with."""

    of_points: Int[Array | np.ndarray, "p"]
    """The row of `faces` of each point; -1 where it may be any face."""
    faces: Bool[Array | np.ndarray, "k f"]


def triangle_choice(
    choice: FaceChoice, surface: RefinedSurface, xp: Any = np
) -> tuple[Int[AnyArray, "p"], Bool[AnyArray, "k t"]]:
    """The row of each point, and in it the triangles of the triangulated view that it may lie on: in the last, all.

    Raises:
        ValueError: the choice is of another number of faces.
    """
    if choice.faces.shape[1] != surface.n_faces:
        raise ValueError(f"the choice is among {choice.faces.shape[1]} faces; the surface has {surface.n_faces}.")
    n = surface.faces[3].shape[0]
    chosen = xp.concatenate([choice.faces, xp.ones_like(choice.faces[:1])])
    rows = xp.where(choice.of_points < 0, len(choice.faces), choice.of_points)
    return rows, xp.concatenate([chosen[:, :n], xp.repeat(chosen[:, n:], 2, axis=1)], axis=1)


def triangle_distance(
    a: AnyArray, ab: AnyArray, ac: AnyArray, points: AnyArray, xp: Any = np
) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Squared distance to a triangle each, and u and v of the closest point, a + u (b - a) + v (c - a).

    Args:
        a, ab, ac: a corner, and the edges from it to the next corner and to the one before; `[3, ...]`, coordinate by
            coordinate, as rows of three are slow.
        points: a point each, likewise.
        xp: numpy or jax.numpy.
    """
    ap = points - a

    def dot(x: AnyArray, y: AnyArray) -> AnyArray:
        return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]

    d00, d01, d11, d20, d21 = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
    area = d00 * d11 - d01 * d01
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
        inside = (u >= 0) & (v >= 0) & (u + v <= 1)  # False where the area is zero
        # Outside, the closest point lies on one of the edges ab, ac, bc; a triangle without area is its edges alone.
        on_ab = xp.nan_to_num(xp.clip(d20 / d00, 0, 1))
        on_ac = xp.nan_to_num(xp.clip(d21 / d11, 0, 1))
        on_bc = xp.nan_to_num(xp.clip((d21 - d20 - d01 + d00) / (d00 - 2 * d01 + d11), 0, 1))

    def squared(u: AnyArray, v: AnyArray) -> AnyArray:
        away = u[None] * ab + v[None] * ac - ap  # not by the products above: their difference has no digits close by
        return dot(away, away)

    u, v = xp.where(inside, u, on_ab), xp.where(inside, v, 0.0)
    best = squared(u, v)
    for other_u, other_v in ((xp.zeros_like(on_ac), on_ac), (1 - on_bc, on_bc)):
        other = xp.where(inside, np.inf, squared(other_u, other_v))
        closer = other < best
        u, v, best = xp.where(closer, other_u, u), xp.where(closer, other_v, v), xp.where(closer, other, best)
    return best, u, v


def to_faces(n_triangle_faces: int, triangle: AnyArray, uv: AnyArray, xp: Any = np) -> tuple[AnyArray, AnyArray]:
    """From the triangulated view, where a quad is (a, b, c) and (a, c, d), to faces `[p]` and their own `uv [p, 2]`."""
    half = triangle - n_triangle_faces
    in_quad, second = half >= 0, half % 2 == 1
    u, v = uv.T
    quad_uv = xp.stack([xp.where(second, u, u + v), xp.where(second, u + v, v)], axis=1)
    return xp.where(in_quad, n_triangle_faces + half // 2, triangle), xp.where(in_quad[:, None], quad_uv, uv)


def polish(corners: AnyArray, points: AnyArray, uv: AnyArray, xp: Any = np) -> AnyArray:
    """Gauss-Newton steps to the closest point of a bilinear patch `[p, 4, 3]` each, kept inside of it."""
    a, b, c, d = xp.moveaxis(corners, 1, 0)
    twist = a - b + c - d
    for _ in range(_QUAD_STEPS):
        u, v = uv[:, :1], uv[:, 1:]
        along_u, along_v = (b - a) + v * twist, (d - a) + u * twist
        residual = a + u * (b - a) + v * (d - a) + u * v * twist - points
        g0, g1 = dot_products(along_u, residual), dot_products(along_v, residual)
        h00, h01, h11 = dot_products(along_u, along_u), dot_products(along_u, along_v), dot_products(along_v, along_v)
        # Where a side holds the point fast, the other coordinate moves alone.
        held_u = ((uv[:, 0] <= 0) & (g0 > 0)) | ((uv[:, 0] >= 1) & (g0 < 0))
        held_v = ((uv[:, 1] <= 0) & (g1 > 0)) | ((uv[:, 1] >= 1) & (g1 < 0))
        h01 = xp.where(held_u | held_v, 0.0, h01)
        det = h00 * h11 - h01 * h01
        safe = xp.where(det > 0, det, 1.0)
        step_u = xp.where(held_u | (det <= 0), 0.0, (h11 * g0 - h01 * g1) / safe)
        step_v = xp.where(held_v | (det <= 0), 0.0, (h00 * g1 - h01 * g0) / safe)
        uv = xp.clip(uv - xp.stack([step_u, step_v], axis=1), 0, 1)
    return uv


def dot_products(a: AnyArray, b: AnyArray, axis: int = 1) -> AnyArray:
    """Dot products of vectors whose coordinates lie along `axis`, 0 or 1: written out, as sums over three are slow."""
    a, b = ((x[0], x[1], x[2]) if axis == 0 else (x[:, 0], x[:, 1], x[:, 2]) for x in (a, b))
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
