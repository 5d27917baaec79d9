"""A shape moved onto another one as a whole: Procrustes alignment."""

from typing import Any

import numpy as np

from jaxsubdiv.closest import AnyArray


def align_shape(shape: AnyArray, vertices: AnyArray, xp: Any = np, *, scale: bool = True) -> AnyArray:
    """A shape `[v, 3]`, turned, scaled and shifted to where the vertices are. Source: Umeyama 1991.

    Args:
        xp: numpy or jax.numpy.
        scale: False only turns and shifts.
    """
    middle, there = shape.mean(axis=0), vertices.mean(axis=0)
    a, b = shape - middle[None], vertices - there[None]
    u, s, vt = xp.linalg.svd(b.T @ a)
    signs = xp.stack([xp.ones_like(s[0]), xp.ones_like(s[0]), xp.sign(xp.linalg.det(u @ vt))])
    factor = (s * signs).sum() / xp.maximum((a**2).sum(), np.finfo(a.dtype).tiny) if scale else 1.0
    return factor * a @ (u * signs[None] @ vt).T + there[None]


def size_ratio(shape: AnyArray, moved: AnyArray, xp: Any = np) -> AnyArray:
    """How many times as large as the shape `[v, 3]` it is where `align_shape` moved it to."""
    size, before = (xp.linalg.norm(x - x.mean(axis=0)[None]) for x in (moved, shape))
    return size / xp.maximum(before, np.finfo(before.dtype).tiny)
