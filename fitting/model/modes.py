"""Mean shape and modes of surfaces whose vertices correspond: Procrustes alignment and principal components."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .procrustes import align_shape

_STEPS, _SETTLED = 20, 1e-9


class Modes(NamedTuple):
    """The mean of many shapes and the directions in which they differ, the widest first."""

    mean: Float[np.ndarray, "v 3"]
    """In mm, about the origin, turned as the first shape."""
    modes: Float[np.ndarray, "k v 3"]
    """Directions, each of length 1 over all coordinates."""
    deviations: Float[np.ndarray, "k"]
    """Standard deviation of the shapes along each, in mm over all coordinates."""
    scores: Float[np.ndarray, "s k"]
    """Where every shape stands, in standard deviations."""
    share: Float[np.ndarray, "k"]
    """Part of the variance that each mode has."""
    aligned: Float[np.ndarray, "s v 3"]
    """The shapes, moved onto the mean."""
    sizes: Float[np.ndarray, "s"]
    """Centroid size of each shape as it was given, in mm: the root of the summed squares of the distances of its
    vertices from their mean."""

    def shape(self, scores: Sequence[float] | Float[np.ndarray, "j"]) -> Float[np.ndarray, "v 3"]:
        """The shape at these scores, in standard deviations along the first modes."""
        along = np.asarray(scores, float) * self.deviations[: len(scores)]
        return self.mean + np.einsum("k,kvx->vx", along, self.modes[: len(scores)])


def shape_modes(vertices: ArrayLike, *, size: bool = False) -> Modes:
    """Mean and modes of corresponding vertices `[s, v, 3]`, such as `cohort.surfaces.vertices`.

    All shapes are turned and shifted onto their mean, which is then the new mean, until it rests.

    Args:
        vertices: in mm, of two shapes or more; row by row the same places of the anatomy.
        size: also scale the shapes to one size, that of the mean: what is left is shape alone.

    Raises:
        ValueError: another shape of array, fewer than two shapes, or values that are not finite.

    Source: J. Gower, Generalized Procrustes analysis, 1975; T. Cootes et al., Active shape models, 1995.
    """
    x = np.asarray(vertices, np.float64)
    if x.ndim != 3 or x.shape[0] < 2 or x.shape[2] != 3 or not np.isfinite(x).all():
        raise ValueError(f"modes need finite vertices [s, v, 3] of two shapes or more; got {list(x.shape)}.")
    x = x - x.mean(axis=1, keepdims=True)
    sizes, mean = np.linalg.norm(x, axis=(1, 2)), x[0]
    usual = float(np.mean(sizes))
    for _ in range(_STEPS):
        mean = mean * (usual / np.linalg.norm(mean))  # averaging, and scaling by parts, would shrink it to nothing
        x = np.stack([align_shape(one, mean, scale=size) for one in x])
        last, mean = mean, x.mean(axis=0)
        if np.linalg.norm(mean - last) <= _SETTLED * usual:
            break
    n = len(x)
    left, widths, modes = np.linalg.svd((x - mean).reshape(n, -1), full_matrices=False)
    left, widths, modes = left[:, : n - 1], widths[: n - 1], modes[: n - 1]
    return Modes(
        mean=mean,
        modes=modes.reshape(-1, *mean.shape),
        deviations=widths / np.sqrt(n - 1),
        scores=left * np.sqrt(n - 1),
        share=widths**2 / max(np.sum(widths**2), np.finfo(float).tiny),
        aligned=x,
        sizes=sizes,
    )
