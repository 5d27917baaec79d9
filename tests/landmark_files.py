"""Landmarks, for tests."""

import numpy as np

FLIP = np.array([-1.0, -1.0, 1.0])
PLACES = {"the, tip": np.array([1.5, -2.25, 1 / 3]), "low": np.array([4.0, 5.0, -6e-7])}


def same(found, expected, **how) -> None:
    assert list(found) == list(expected)
    np.testing.assert_allclose(list(found.values()), list(expected.values()), **{"rtol": 0, "atol": 0} | how)
