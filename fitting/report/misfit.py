"""What a control mesh cannot follow, seen in what scan points that lie together have in common.

Two residuals r and s of points whose noise is their own, at places where the surface is off by the same e, have the
mean product E[r s] = E[e^2] - 2 v, where v is the covariance of the fit with the noise there: what it took of the noise
with it, the residuals have lost. So E[e^2] = E[r s] + 2 v. Source: B. Efron, The estimation of prediction error:
covariance penalties and cross-validation, 2004, eq. (2.8). The posterior variance is v once; the rest is the misfit.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int

_FEWEST = 0.5  # pairs a point, of whose products a neighbourhood's mean is taken
_A_PATCH = 5  # points on average: of fewer the noise is too much, and more lie too far apart
_TINY = np.finfo(float).tiny


def misfit_variances(
    distances: Float[np.ndarray, "p"],
    weights: Float[np.ndarray, "p"],
    variances: Float[np.ndarray, "p"],
    patches: Sequence[Int[np.ndarray, "p"]],
    average: Callable[[Float[np.ndarray, "f"]], Float[np.ndarray, "f"]],
    n_faces: int,
) -> Float[np.ndarray, "f"]:
    """Mean square in mm^2 of what the surface is off beyond its posterior variance, over a control face and those
    around it; 0 where there are too few points to tell.

    Args:
        distances: signed, in mm.
        weights: how much each point counts beside the others, 0 of an outlier.
        variances: posterior ones of the surface at the points, in mm^2.
        patches: where each point lies: the control face, then finer and finer parts of it. Points that lie in one
            patch are compared, of the finest patches that have enough.
        average: over a control face and those around it, see `neighbourhood_mean`.
        n_faces: number of control faces.
    """
    counted = weights > 0
    if not counted.any():
        return np.zeros(n_faces)
    enough = [patch for patch in patches if counted.sum() >= _A_PATCH * len(np.unique(patch[counted]))]
    _, patch = np.unique((enough or patches[:1])[-1], return_inverse=True)
    weights = weights / np.mean(weights[counted])
    face = np.zeros(patch.max() + 1, int)
    face[patch] = patches[0]

    # Over all pairs of different points of a patch, without going through them, every point counting alike.
    count, total = np.bincount(patch, weights), np.bincount(patch, weights * distances)
    mean_variance = np.bincount(patch, weights * variances) / (count + _TINY)
    pairs = count**2 - np.bincount(patch, weights**2)
    products = total**2 - np.bincount(patch, (weights * distances) ** 2) + pairs * mean_variance
    pairs, products = (average(np.bincount(face, values / (count + _TINY), n_faces)) for values in (pairs, products))
    return np.where(pairs > _FEWEST, np.maximum(products, 0) / np.maximum(pairs, _FEWEST), 0)
