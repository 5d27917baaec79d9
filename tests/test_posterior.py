"""Smoothness found from the scan, uncertainty, and the fit as a function of the scan."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scans import N_POINTS, SIGMA, noise, problem
from schemes import control_mesh

import fitting
import jaxsubdiv as js
from fitting import Free, Priors, Scan
from fitting.model.priors.bend import bend_asymmetry
from fitting.report import refit as _refit
from fitting.report.misfit import misfit_variances
from fitting.solve.strengths import Family, neighbourhood_mean, next_precisions


class Bends:
    """Rows that are the unknowns themselves."""

    model, values = None, None

    def times(self, name, x):
        return x

    transposed = times


def test_strength_of_the_prior_is_that_which_the_unknowns_were_drawn_with():
    """A line of faces, their bends measured with noise: rough at one end and smooth at the other."""
    rng, n = np.random.default_rng(0), 400
    face = np.repeat(np.arange(n // 8), 8)
    truth = np.where(np.arange(n) < n // 2, 1.0, 0.1)
    measured = rng.normal(scale=truth) + rng.normal(scale=0.3, size=n)
    around = np.abs(np.subtract.outer(range(n // 8), range(n // 8))) <= 3
    around = around / around.sum(axis=1, keepdims=True)
    precision, rows = np.full(n // 8, 4.0), Bends()
    for _ in range(30):
        prior, data = precision[face], 1 / 0.3**2
        (precision,) = next_precisions(
            [Family("bend", precision, measured * data / (data + prior), face, lambda values: around @ values)],
            rows,
            lambda sides, prior=prior: sides / (prior + 1e-9)[:, None],
            lambda sides, prior=prior, data=data: sides / (prior + data)[:, None],
        )
    deviation = precision**-0.5
    # The smooth end, which shows little beside the noise, leans a little on the rest.
    assert 0.7 < np.median(deviation[:20]) < 1.3 and 0.05 < np.median(deviation[-20:]) < 0.35


def test_neighbourhoods_average():
    mesh = control_mesh(meshes.grid(4, 3, "mixed"))
    average = neighbourhood_mean(js.build_topology(mesh, js.Interpolating(), 1))
    np.testing.assert_allclose(average(np.ones(mesh.n_faces)), 1)
    of_first = average(np.eye(mesh.n_faces)[0])
    assert 0.1 < np.abs(of_first).max() < 0.9
    np.testing.assert_allclose(average(jnp.asarray(np.eye(mesh.n_faces)[0])), of_first, atol=1e-12)


def to_truth(result: fitting.FitResult) -> float:
    points = problem().points
    at = fitting.closest_points(result.surface, points)
    return float(np.sqrt(np.mean((js.evaluate(result.surface, at).points - points) ** 2) * 3))


def roughness(result: fitting.FitResult) -> float:
    bends = bend_asymmetry(result.surface, result.fit.model.prior("bend").edges)
    return float(np.sqrt(np.mean(bends**2)))


def test_bend_prior_that_is_given_smooths_as_it_says():
    stiff, found, loose = (
        problem().fit(problem().points + noise(), priors=Priors(bend=bend, likeness=0.0), tolerance=0.05)
        for bend in (0.01, None, 20.0)
    )
    assert roughness(stiff) < roughness(found) < roughness(loose)
    assert to_truth(found) < 1.05 * min(to_truth(stiff), to_truth(loose))


def test_stretch_prior_holds_the_edges_in_length():
    topology, start = problem().topology, np.asarray(problem().start.vertices)
    edges = np.asarray(topology.levels[0].edges)

    def change(result):
        before, after = (np.linalg.norm(np.diff(x[edges], axis=1), axis=2) for x in (start, result.control.vertices))
        return np.std(np.log(np.asarray(after) / before))

    tight, loose = (fitted_with(Priors(stretch=value)) for value in (0.003, 1.0))
    assert change(tight) < 0.5 * change(loose)


def test_h_prior_holds_h():
    tight, loose = (fitted_with(Priors(h=value)) for value in (0.003, 1.0))
    assert abs(tight.scheme.h - 1) < 0.02 < 0.05 < abs(loose.scheme.h - 1)


def fitted_with(priors: Priors) -> fitting.FitResult:
    return problem().fit(problem().points + noise(), priors=priors)


@pytest.mark.parametrize("name", ["bend", "stretch", "h"])
def test_priors_are_standard_deviations(name):
    with pytest.raises(ValueError, match=r"must be positive; got 0\.0\. Give jnp\.inf to leave a prior out"):
        Priors(**{name: 0.0})


def test_points_are_trusted_by_their_deviations():
    p, exact = problem(), np.arange(N_POINTS) % 2 == 0
    scan = p.points + np.where(exact, 0.2, 2.0)[:, None] * noise()
    told, untold = (
        fitting.fit(js.Interpolating(), p.topology, p.start, Scan(scan, deviations=given), throw=False)
        for given in (np.where(exact, 0.1, 1.0), None)
    )
    assert to_truth(told) < 0.8 * to_truth(untold)


def test_points_whose_normals_look_away_are_left_out():
    p = problem()
    surface = js.refine(js.Interpolating(p.h), p.topology, p.truth)
    points, normals = js.sample(surface, N_POINTS, jax.random.key(3))
    away = np.arange(N_POINTS) % 4 == 0
    normals = np.where(away[:, None], -np.asarray(normals), normals)
    found = fitting.fit(js.Interpolating(), p.topology, p.start, Scan(points, normals), throw=False, max_sweeps=3)
    assert not np.any(found.weights[away]) and np.mean(found.weights[~away] > 0) > 0.95


def test_bands_hold_the_truth_as_often_as_they_say():
    """Over scans of one smooth surface, by the distance of the fits' vertices from it; in theory 68 %."""
    p, inside = problem(), []
    topology = js.build_topology(p.mesh, js.Interpolating(), 3)
    surface = js.refine(js.Interpolating(p.h), topology, p.truth)
    points = np.asarray(js.sample(surface, N_POINTS, jax.random.key(0)).points)
    for seed in range(6):
        found = p.fit(points + noise(seed), topology=topology, priors=Priors(h=0.5))
        at = fitting.closest_points(surface, np.asarray(found.surface.vertices))
        off = np.linalg.norm(js.evaluate(surface, at).points - found.surface.vertices, axis=1)
        inside.append(np.mean(off < found.uncertainty().surface))
    assert 0.5 < np.mean(inside) < 0.8


def test_uncertainty_is_larger_in_a_hole():
    p = problem()
    top = p.points[:, 2] > 8
    scan = np.where(top[:, None], np.resize(p.points[~top], p.points.shape), p.points) + noise()
    whole, holed = (p.fit(points).uncertainty() for points in (p.points + noise(), scan))
    z = np.asarray(p.truth.vertices)[:, 2]
    assert np.all(holed.control[z > 12] > 1.5 * whole.control[z > 12])
    np.testing.assert_allclose(np.hypot(whole.control, whole.misfit[: len(z)]), whole.surface[: len(z)], rtol=1e-9)


def test_uncertainty_knows_what_the_control_mesh_cannot_follow():
    """Ripples of the anatomy, far shorter than a control edge and larger than what noise leaves uncertain."""
    p = problem()
    topology = js.build_topology(p.mesh, js.Interpolating(), 4)
    smooth = js.refine(js.Interpolating(p.h), topology, p.truth)
    x = np.asarray(smooth.vertices)
    height = 0.5 * np.sin(x / 2.5 + np.arange(3)).prod(axis=1)
    truth = js.RefinedSurface(jnp.asarray(x + height[:, None] * smooth.normals), smooth.normals, smooth.faces)
    points = np.asarray(js.sample(truth, 8 * N_POINTS, jax.random.key(1)).points)
    points = points + np.random.default_rng(1).normal(scale=SIGMA, size=points.shape)
    found = p.fit(points, topology=js.build_topology(p.mesh, js.Interpolating(), 3))
    vertices = np.asarray(found.surface.vertices)
    off = np.linalg.norm(js.evaluate(truth, fitting.closest_points(truth, vertices)).points - vertices, axis=1)
    deviation = found.uncertainty()
    without = np.sqrt(deviation.surface**2 - deviation.misfit**2)
    assert np.mean(off < without) < 0.45 and 0.55 < np.mean(off < deviation.surface) < 0.8


def test_misfit_is_what_points_of_a_face_have_in_common_beyond_the_noise():
    """Faces whose height is fitted three at a time, by the mean of their points: a mesh that is too coarse for them."""
    rng, n_faces, n, sigma = np.random.default_rng(0), 3000, 12, 0.5
    face = np.repeat(np.arange(n_faces), n)

    def average(values):
        return values.reshape(-1, 300).mean(axis=1).repeat(300)

    weights = np.where(rng.uniform(size=len(face)) < 0.2, 0.0, 1.0)  # outliers, which say nothing
    for height in (0.3, 0.0):
        truth = height * rng.choice([-1.0, 1.0], size=n_faces)
        measured = truth[face] + rng.normal(scale=sigma, size=len(face)) + 100 * (weights == 0)
        of_three = face // 3
        counts = np.bincount(of_three, weights)
        fitted = np.bincount(of_three, weights * measured) / counts
        off = fitted[np.arange(n_faces) // 3] - truth
        variance = sigma**2 / counts
        found = misfit_variances(measured - fitted[of_three], weights, variance[of_three], [face], average, n_faces)
        expected = max(np.mean(off**2) - np.mean(variance), 0)
        np.testing.assert_allclose(np.mean(found), expected, atol=0.05 * height**2 + 0.001)
    alone = np.arange(n_faces)  # one point a face: nothing in common
    none = misfit_variances(np.ones(n_faces), np.ones(n_faces), np.zeros(n_faces), [alone], average, n_faces)
    np.testing.assert_array_equal(none, 0)


def test_draws_are_of_the_posterior_and_so_is_the_uncertainty():
    """Against the inverse of the whole matrix."""
    found = problem().fit(problem().points + noise(), max_sweeps=4)
    posterior, layout = found.posterior, found.fit.model.layout
    covariance = np.linalg.inv(posterior.equations.to_dense(found.fit.loose, np.arange(layout.n)))
    draws = posterior.draws(4000)
    np.testing.assert_allclose(draws @ draws.T / 4000, covariance, atol=0.02)

    @jax.jit
    def vertices_along_normals(vector):
        moved = found.fit.model.refine(found.fit.model.retract(found.fit.y, layout.split(vector)))
        return jnp.sum(moved.vertices * found.surface.normals, axis=1)

    by = np.asarray(jax.jacfwd(vertices_along_normals)(jnp.zeros(layout.n)))
    deviation = posterior.uncertainty()
    exact = np.sqrt(np.einsum("vn,nm,vm->v", by, covariance, by))
    np.testing.assert_allclose(np.sqrt(deviation.surface**2 - deviation.misfit**2), exact, rtol=1e-6)
    np.testing.assert_allclose(deviation.control, exact[:12], rtol=1e-6)


def test_what_is_fixed_is_certain():
    mask = np.arange(12) % 3 > 0
    found = problem().fit(problem().points + noise(), free=Free(vertices=mask, h=False), max_sweeps=3)
    deviation = found.uncertainty().control
    assert np.all(deviation[~mask] == 0) and np.all(deviation[mask] > 0.01)


def test_derivatives_of_the_fit_are_those_of_differences():
    p = problem()
    points = jnp.asarray(p.points + noise())
    refit = p.fit(points).refit()
    topology = p.topology

    def volume(points, weights, refit):
        scheme, control = refit(points, weights)
        surface = js.refine(scheme, topology, control)
        a, b, c = (surface.vertices[corner] for corner in surface.triangles().T)
        return jnp.sum(a * jnp.cross(b, c)) / 6

    compiled = jax.jit(jax.value_and_grad(volume, (0, 1)))
    ones, rng = jnp.ones(N_POINTS), np.random.default_rng(0)
    value, gradients = compiled(points, ones, refit)
    assert value > 1e4
    for which, scale in ((0, SIGMA), (1, 0.1)):
        along = jnp.asarray(rng.normal(size=gradients[which].shape))
        step = 1e-3 * scale
        ahead, back = (
            compiled(*((points + s * along, ones) if which == 0 else (points, ones + s * along)), refit)[0]
            for s in (step, -step)
        )
        np.testing.assert_allclose(jnp.vdot(gradients[which], along), (ahead - back) / (2 * step), rtol=1e-3)


def test_refit_starts_from_the_fit_where_that_was_not_quite_at_rest():
    """Eyes and temples that the control mesh cannot follow: without a hold the cost would not even be convex there."""
    scan, template = fitting.example("head_fragment")
    scan, mesh = Scan(np.asarray(scan.points, float)), js.ControlMesh(template.vertices, template.faces)
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    found = fitting.fit(js.Interpolating(), topology, mesh.control(), scan, throw=False)
    refit = found.refit()
    assert float(jnp.linalg.norm(refit._fixed.left)) > 1  # in posterior standard deviations

    @jax.jit
    def rise(points, refit):
        def value(points):
            _, control = refit(points)
            return jnp.mean(control.vertices**2), control

        return jax.value_and_grad(value, has_aux=True)(points)

    (_, control), slope = rise(scan.points, refit)
    np.testing.assert_allclose(control.vertices, found.control.vertices, atol=1e-9)
    along = jnp.asarray(np.random.default_rng(0).normal(size=slope.shape))
    ahead, back = (rise(scan.points + s * along, refit)[0][0] for s in (1e-5, -1e-5))
    np.testing.assert_allclose(jnp.vdot(slope, along), (ahead - back) / 2e-5, rtol=1e-3)


def test_refit_runs_under_vmap_and_takes_its_own_precision():
    p = problem()
    points = np.asarray(p.points + noise())
    refit = p.fit(points).refit()
    both = jnp.asarray(np.stack([points, points + (1.0, 0, 0)]), jnp.float32)
    of_both = jax.jit(jax.vmap(lambda points: refit(points)[1].vertices))(both)
    assert of_both.dtype == p.start.vertices.dtype
    np.testing.assert_allclose(jnp.mean(of_both[1] - of_both[0], axis=0), (1, 0, 0), atol=0.1)
    np.testing.assert_allclose(of_both[1], refit(both[1])[1].vertices, atol=1e-5)


def test_refit_of_a_fit_that_did_not_converge_says_so():
    with pytest.warns(UserWarning, match="the fit did not converge: what depends on the scan here"):
        problem().fit(max_sweeps=1).refit()


def test_refit_refuses_what_it_cannot_do(monkeypatch):
    found = problem().fit()
    with pytest.raises(ValueError, match=r"the fit had points \[600, 3\]; got \[599, 3\]"):
        found.refit()(jnp.zeros((599, 3)))
    monkeypatch.setattr(_refit, "_MOST_UNKNOWNS", 50)
    with pytest.raises(ValueError, match="the fit has 61 unknowns; its derivative is for up to 50"):
        found.refit()
