"""Statistics of shapes that correspond: how good modes are, whether groups differ, and the files of both."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import permutation_test

import fitting


def family(n: int = 12, noise: float = 0.0) -> np.ndarray:
    """Boxes of points that vary along two modes, turned and shifted."""
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(30, 3)) * (10, 7, 5)
    stretch = rng.normal(scale=(0.1, 0.04), size=(n, 2))
    shapes = mean + stretch[:, :1, None] * mean * (1, 0, 0) + stretch[:, 1:, None] * mean[:, [1, 0, 2]] * (0, 1, 0)
    shapes = shapes + rng.normal(scale=noise, size=shapes.shape)
    turns = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    return np.einsum("svx,sxy->svy", shapes, turns) + 50 * rng.normal(size=(n, 1, 3))


def test_two_modes_are_enough_for_a_family_of_two():
    quality, modes = fitting.measure_modes(family()), fitting.shape_modes(family())
    assert len(quality.compactness) == 10
    np.testing.assert_allclose(quality.compactness, np.cumsum(modes.deviations[:10] ** 2))
    assert quality.generalisation[0] > 0.1 > 10 * quality.generalisation[2]
    assert np.all(np.diff(quality.generalisation) <= 1e-12)
    assert quality.specificity[1] > quality.specificity[0]  # shapes are drawn farther out
    assert np.all(quality.specificity_error < 0.1 * quality.specificity)


def test_specificity_is_that_of_shapes_drawn():
    """The same draws as whole shapes, against whole members."""
    shapes = family(6, noise=0.3)
    quality, modes = fitting.measure_modes(shapes, draws=50, seed=3), fitting.shape_modes(shapes)
    scores = np.random.default_rng(3).normal(size=(50, 4))
    for k in (1, 3):
        drawn = np.stack([modes.shape(row[:k]) for row in scores])
        away = cdist(drawn.reshape(50, -1), modes.aligned.reshape(6, -1)).min(axis=1) / np.sqrt(30)
        assert quality.specificity[k - 1] == pytest.approx(away.mean())


def test_generalisation_is_that_of_members_left_out():
    shapes = family(5, noise=0.3)
    quality = fitting.measure_modes(shapes)
    left = []
    for i in range(5):
        others = fitting.shape_modes(np.delete(shapes, i, axis=0))
        a = (shapes[i] - shapes[i].mean(axis=0)).T @ (others.mean - others.mean.mean(axis=0))
        turned = (shapes[i] - shapes[i].mean(axis=0)) @ _nearest_turn(a)
        away = (turned - others.mean).ravel()
        span = (others.aligned[1:] - others.aligned[0]).reshape(3, -1).T
        _, squares, *_ = np.linalg.lstsq(span, away, rcond=None)
        left.append(np.sqrt(squares[0] / 30))
    assert quality.generalisation[-1] == pytest.approx(np.mean(left))
    assert quality.generalisation_error[-1] == pytest.approx(np.std(left) / 2)


def _nearest_turn(a: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(a)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def test_groups_that_differ_at_one_place():
    rng = np.random.default_rng(1)
    shapes = np.repeat(family(1), 16, axis=0) + rng.normal(scale=0.2, size=(16, 30, 3))
    groups = ["wild", "other"] * 8
    shapes[1::2, 4] += (0, 1.0, 0)
    found = fitting.compare_groups(shapes, groups, n_permutations=9999)
    assert found.groups == ("other", "wild") and found.counts == (8, 8) and found.n_permutations == 10000
    assert found.p < 0.01 and found.p_any[4] < 0.01 and found.q[4] < 0.02
    assert np.argmax(found.explained) == 4 and np.sum(found.p_any < 0.05) == 1
    np.testing.assert_allclose(np.linalg.norm(found.means[1, 4] - found.means[0, 4]), 1.0, atol=0.25)


def test_groups_that_mean_nothing_are_told_apart_by_chance_alone():
    rng = np.random.default_rng(2)
    p, any_vertex = [], []
    for _ in range(60):
        shapes = np.repeat(family(1), 10, axis=0) + rng.normal(scale=0.2, size=(10, 30, 3))
        found = fitting.compare_groups(shapes, [0, 1] * 5, n_permutations=99)
        p.append(found.p)
        any_vertex.append(found.p_any.min())
    for values in (np.array(p), np.array(any_vertex)):  # uniform
        assert 0.35 < values.mean() < 0.65 and np.mean(values < 0.1) < 0.22


def test_small_groups_are_divided_in_all_ways():
    """As scipy's exact test has it, of the same distance between means."""
    shapes = family(8, noise=0.4)
    shapes[:4, 3] += 0.8
    found = fitting.compare_groups(shapes, [0] * 4 + [1] * 4)
    aligned = fitting.shape_modes(shapes).aligned

    def distance(rows, others):
        return np.linalg.norm(aligned[rows.astype(int)].mean(axis=0) - aligned[others.astype(int)].mean(axis=0))

    exact = permutation_test((np.arange(4.0), np.arange(4.0, 8)), distance, n_resamples=np.inf, alternative="greater")
    assert found.n_permutations == 70
    assert found.p == pytest.approx(exact.pvalue)
    assert found.distance == pytest.approx(exact.statistic / np.sqrt(30))


@pytest.mark.parametrize("groups", [[0, 1], [0] * 6, [0, 1, 2] * 2, [0, 1, 1, 1, 1, 1]])
def test_two_groups_are_compared(groups):
    with pytest.raises(ValueError, match="two groups of two shapes or more are compared"):
        fitting.compare_groups(family(6), groups)


def test_modes_of_two_shapes_cannot_be_measured():
    with pytest.raises(ValueError, match="three shapes or more"):
        fitting.measure_modes(family(2))
