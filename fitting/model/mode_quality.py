"""How good a family's modes are: compactness, generalisation and specificity, by the number of modes that are used."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from .limits import check_numbers
from .modes import shape_modes
from .procrustes import align_shape


class ModeQuality(NamedTuple):
    """Row `k` is of the first `k + 1` modes; distances are root mean squares over the vertices, in mm."""

    compactness: Float[np.ndarray, "k"]
    """Variance of the family that they have, in mm^2 over all coordinates: more in fewer modes is better."""
    generalisation: Float[np.ndarray, "k"]
    """How far members lie from what the modes of all others make of them, as a mean: smaller is better."""
    specificity: Float[np.ndarray, "k"]
    """How far shapes that are drawn from the modes lie from the nearest member, as a mean: smaller is better."""
    generalisation_error: Float[np.ndarray, "k"]
    """Standard error of the mean."""
    specificity_error: Float[np.ndarray, "k"]


def measure_modes(vertices: ArrayLike, *, size: bool = False, draws: int = 1000, seed: int = 0) -> ModeQuality:
    """Compactness, generalisation and specificity of the modes of corresponding vertices `[s, v, 3]`.

    There is one row for each mode that all members but one have, s - 2 in all.

    Args:
        vertices: in mm, of three shapes or more; see `shape_modes`.
        size: also scale the shapes to one size.
        draws: how many shapes are drawn for the specificity, with independent Gaussian scores.
        seed: of the draws.

    Raises:
        ValueError: fewer than three shapes; another shape of array, or values that are not finite.

    Source: R. Davies, Learning shape: optimal models for analysing shape variability, 2002, chapter 4; M. Styner and
    others, Evaluation of 3D correspondence methods for model building, 2003, section 2.3.
    """
    check_numbers({"draws": draws})
    x = np.asarray(vertices, np.float64)
    family = shape_modes(x, size=size)
    n, k = len(x), len(x) - 2
    if k < 1:
        raise ValueError("generalisation needs three shapes or more: each is told by the modes of the others.")
    root = len(family.mean) ** 0.5
    left = np.stack([_leave_out(x, i, k, size) for i in range(n)]) / root
    scores = family.scores * family.deviations
    drawn = np.random.default_rng(seed).normal(size=(draws, k)) * family.deviations[:k]
    # All members lie in the span of the modes: their distances are those of the scores.
    near = np.stack(
        [cdist(np.pad(drawn[:, :m], ((0, 0), (0, len(scores[0]) - m))), scores).min(axis=1) for m in range(1, k + 1)],
        axis=1,
    )
    near /= root
    return ModeQuality(
        compactness=np.cumsum(family.deviations[:k] ** 2),
        generalisation=left.mean(axis=0),
        specificity=near.mean(axis=0),
        generalisation_error=left.std(axis=0) / (n - 1) ** 0.5,
        specificity_error=near.std(axis=0) / draws**0.5,
    )


def _leave_out(x: Float[np.ndarray, "s v 3"], i: int, k: int, size: bool) -> Float[np.ndarray, "k"]:
    """How far shape i lies from its likeness by the first 1, 2, ... k modes of the others, over all coordinates."""
    others = shape_modes(np.delete(x, i, axis=0), size=size)
    away = (align_shape(x[i], others.mean, scale=size) - others.mean).ravel()
    along = others.modes[:k].reshape(k, -1) @ away
    return np.sqrt(np.maximum(away @ away - np.cumsum(along**2), 0.0))
