"""Robust losses against their definitions, and the noise found among outliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting import Barron, Huber, LeastSquares, Tukey, cauchy, geman_mcclure
from fitting.model.robust import noise_scale
from fitting.scan.outliers import dense_points, scattered_points

R = np.linspace(-12, 12, 97)


def barron(r, alpha, c):
    """rho of Barron 2019, eq. (8), for an alpha that is neither 0, 2 nor -inf."""
    b = abs(alpha - 2)
    return b / alpha * (((r / c) ** 2 / b + 1) ** (alpha / 2) - 1)


LOSSES = {
    "least squares": (LeastSquares(), lambda r: r**2 / 2),
    "huber": (Huber(1.5), lambda r: jnp.where(abs(r) <= 1.5, r**2 / 2, 1.5 * abs(r) - 1.5**2 / 2)),
    "cauchy": (cauchy(2.0), lambda r: 4 * jnp.log1p((r / 2) ** 2 / 2)),
    "geman-mcclure": (geman_mcclure(3.0), lambda r: 9 * barron(r, -2.0, 3.0)),
    "pseudo-huber": (Barron(1.0, 2.0), lambda r: 4 * barron(r, 1.0, 2.0)),
    "half way to cauchy": (Barron(0.5, 2.0), lambda r: 4 * barron(r, 0.5, 2.0)),
    "barron's least squares": (Barron(2.0, 3.0), lambda r: r**2 / 2),
    "welsch": (Barron(-np.inf, 2.0), lambda r: -4 * jnp.exp(-((r / 2) ** 2) / 2)),
    "tukey": (Tukey(4.0), lambda r: jnp.where(abs(r) <= 4, -(4**2) / 6 * (1 - (r / 4) ** 2) ** 3, 0.0)),
}


@pytest.mark.parametrize("name", LOSSES)
def test_weight_is_the_slope_of_the_loss_over_the_residual(name):
    loss, rho = LOSSES[name]
    slope = jax.vmap(jax.grad(rho))(jnp.asarray(R))
    np.testing.assert_allclose(loss.weight(jnp.asarray(R)) * R, slope, atol=1e-12)


@pytest.mark.parametrize("name", LOSSES)
def test_weight_is_one_at_no_distance_and_never_grows(name):
    weight = np.asarray(LOSSES[name][0].weight(jnp.abs(jnp.asarray(R[R >= 0]))))
    assert weight[0] == 1
    assert (np.diff(weight) <= 1e-15).all()
    assert (weight >= 0).all()


@pytest.mark.parametrize("outliers", [0.0, 0.05, 0.2, 0.4, 0.6])
def test_noise_is_found_among_outliers(outliers):
    rng = np.random.default_rng(0)
    n = 20_000
    n_out = round(outliers * n)
    r = np.concatenate([rng.normal(scale=0.5, size=n - n_out), rng.uniform(-60, 60, n_out)])
    found = noise_scale(jnp.asarray(r), jnp.ones(n))
    assert abs(found - 0.5) < 0.025


def test_points_without_weight_have_no_say_in_the_noise():
    r = np.random.default_rng(0).normal(size=2000)
    weights = np.repeat([1.0, 0.0], 1000)
    alone = noise_scale(jnp.asarray(r[:1000]), jnp.ones(1000))
    spoilt = np.concatenate([r[:1000], np.full(1000, 0.01)])
    np.testing.assert_allclose(noise_scale(jnp.asarray(spoilt), jnp.asarray(weights)), alone, rtol=1e-12)


def test_no_distances_are_no_noise():
    assert noise_scale(jnp.zeros(10), jnp.ones(10)) == 0


@pytest.mark.parametrize("outliers", [0.05, 0.2, 0.6])
def test_scattered_points_are_told_from_a_surface(outliers):
    rng, n = np.random.default_rng(0), 8000
    n_out = round(outliers * n)
    ball = rng.normal(size=(n - n_out, 3))
    ball = 100 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + rng.normal(scale=0.5, size=ball.shape)
    points = np.concatenate([ball, rng.uniform(-120, 120, (n_out, 3))])
    found = scattered_points(points, dense_points(points))
    assert found[: len(ball)].mean() < 0.002
    assert found[len(ball) :].mean() > 0.6  # those that lie close to the surface cannot be told so


def test_a_sparse_part_of_a_surface_and_a_line_are_not_scattered():
    rng = np.random.default_rng(0)
    dense, sparse = rng.uniform(-50, 50, (5000, 2)), rng.uniform(50, 250, (300, 2))
    line = np.stack([np.linspace(300, 500, 40), rng.normal(scale=0.3, size=40), rng.normal(scale=0.3, size=40)], axis=1)
    sheet = np.concatenate([dense, sparse])
    points = np.concatenate(
        [np.c_[sheet, 0.002 * (sheet**2).sum(axis=1) ** 0.5 + rng.normal(scale=0.3, size=5300)], line]
    )
    is_dense = dense_points(points)
    assert is_dense[5000:].mean() < 0.2  # they would all be taken for outliers by how thinly they lie
    assert scattered_points(points, is_dense).mean() < 0.003
