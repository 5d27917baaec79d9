"""What tests look at of a posterior."""

import numpy as np

import fitting


def precision_matrix(result: fitting.FitResult) -> np.ndarray:
    """Of the free unknowns: the inverse of the covariance that the posterior has."""
    return result.posterior.equations.to_dense(result.fit.loose, np.flatnonzero(result.fit.model.is_free))
