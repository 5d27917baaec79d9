"""The equations of a sweep, smoothness found from the scan, uncertainty, and the fit as a function of the scan."""

import functools

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import scipy.sparse as sp
from scans import N_POINTS, SIGMA, noise, problem
from schemes import MIXED, control_mesh, random_control

import fitting
import jaxsubdiv as js
from fitting import Free, Priors, Scan
from fitting.model.residual import Pairs, Start, bend_edges, control_edges, control_faces_of, prior_faces, residuals
from fitting.model.unknowns import no_offset
from fitting.report import posterior as _posterior
from fitting.report import refit as _refit
from fitting.report.misfit import misfit_variances
from fitting.solve import elements as _elements
from fitting.solve.elements import (
    differentiate,
    differentiate_distances,
    find_elements,
    find_patches,
    flat,
    forgets_some,
    jacobian,
    normal_matrix,
    to_unknowns,
)
from fitting.solve.strengths import neighbourhoods, next_precision

# Derivatives by elements


@functools.cache
def mixed_rows(kind: str, levels: int):
    """Everything that the elements of a mesh of triangles and quads are made from, and its derivatives in full."""
    scheme = {
        "default": js.Interpolating(1.1),
        "h a level": js.Interpolating([1.1] * levels),
        "circle": js.CirclePreserving(),
    }
    scheme = scheme[kind]
    mesh, free = control_mesh(MIXED), Free()
    topology, control = js.build_topology(mesh, scheme, levels), random_control(MIXED, 0)
    surface = js.refine(scheme, topology, control)
    face = np.random.default_rng(1).integers(surface.n_faces, size=60)
    at = js.SurfacePoint(face, np.full((60, 2), 0.3))
    corners, weights = js._surface.corner_weights(surface, at)
    directions = js.evaluate(surface, at).normals
    pairs = Pairs(js.evaluate(surface, at).points + 0.1 * directions, corners, weights, directions)
    edges = control_edges(topology), bend_edges(scheme, topology)
    start = Start(scheme, topology, control, jnp.asarray(mesh.vertices), None, *edges)
    zero = no_offset(free, scheme, control)
    owner = control_faces_of(scheme, topology, surface, control)
    faces = prior_faces(scheme, topology, None, owner, zero.h.size)
    patches = find_patches(surface, owner, mesh.n_faces)

    @jax.jit
    def in_full(start, pairs):
        def of_vector(vector):
            return jnp.concatenate(residuals(to_unknowns(vector, zero), start, pairs))

        return jax.jacfwd(of_vector)(jnp.zeros(flat(zero).size))

    return start, pairs, zero, face, patches, np.concatenate(faces), np.asarray(in_full(start, pairs))


def by_elements(kind: str, levels: int, rings: int):
    start, pairs, zero, at, patches, of_priors, in_full = mixed_rows(kind, levels)
    elements = find_elements(start.topology, Free(), start, rings)
    tables = elements.seeds, elements.seeds_of, of_priors, patches.vertices
    return elements, differentiate(zero, start, *tables), pairs, at, patches, of_priors, in_full


@pytest.mark.parametrize(("kind", "levels"), [("default", 2), ("h a level", 2), ("circle", 1)])
def test_derivatives_by_elements_are_those_in_full(kind, levels):
    elements, found, pairs, at, patches, of_priors, in_full = by_elements(kind, levels, rings=1)
    assert not forgets_some(elements, patches, found, of_priors)
    face = np.append(patches.owner[at], of_priors)
    distances, by = differentiate_distances(found, pairs, face[: len(at)], patches.slots[at])
    np.testing.assert_allclose(distances, -0.1, atol=1e-12)
    by = np.concatenate([by, found.by_rows])
    np.testing.assert_allclose(jacobian(elements, by, face).toarray(), in_full, atol=1e-12)
    # Far fewer derivatives than unknowns: that is what the colours are for.
    assert elements.seeds.vertices.shape[0] < 0.75 * in_full.shape[1]

    def matrix(values):
        pattern = elements.pattern
        return sp.csc_array((values, pattern.indices, pattern.indptr), shape=pattern.shape).toarray()

    weights = np.random.default_rng(2).uniform(0.5, 2, len(face))
    np.testing.assert_allclose(
        matrix(normal_matrix(elements, by, weights, face)), in_full.T @ (weights[:, None] * in_full), atol=1e-10
    )
    np.testing.assert_allclose(_elements.times_transposed(elements, by, weights, face), in_full.T @ weights, atol=1e-10)
    # Summed up a patch at a time, as it is done where there are many pairs.
    of_pairs, weights = in_full[: len(at)], weights[: len(at)]
    for at_once in (1 << 22, 5 * elements.columns.shape[1] ** 2):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_elements, "_ENTRIES_AT_ONCE", at_once)
            _, runs = _elements._pattern(elements.columns, elements.n)
        assert len(runs) == (1 if at_once == 1 << 22 else -(-len(elements.columns) // 5))
        parts = elements._replace(runs=runs)
        values, gradient = _elements.equations_of_many(parts, patches, found, pairs, weights, at)
        np.testing.assert_allclose(matrix(values), of_pairs.T @ (weights[:, None] * of_pairs), atol=1e-10)
        one_by_one = normal_matrix(parts, by[: len(at)], weights, face[: len(at)])
        np.testing.assert_allclose(matrix(one_by_one), of_pairs.T @ (weights[:, None] * of_pairs), atol=1e-10)
        np.testing.assert_allclose(gradient, of_pairs.T @ (-0.1 * weights), atol=1e-10)


def test_elements_that_are_too_small_are_noticed():
    elements, found, _, _, patches, of_priors, _ = by_elements("default", 2, rings=0)
    assert forgets_some(elements, patches, found, of_priors)


def test_vectors_of_unknowns_go_to_offsets_and_back():
    start, _, zero, *_ = mixed_rows("h a level", 2)
    vector = np.arange(flat(zero).size, dtype=float)
    np.testing.assert_array_equal(flat(to_unknowns(jnp.asarray(vector), zero)), vector)
    for free in (Free(normals=False), Free(vertices=False), Free(True, True, False), Free(False, False, True)):
        like = no_offset(free, start.scheme, start.control)
        vector = np.arange(flat(like).size, dtype=float)
        np.testing.assert_array_equal(flat(to_unknowns(jnp.asarray(vector), like)), vector)


@pytest.mark.parametrize("n", [1, 7, 100, 5_000])
def test_pairs_come_in_runs_that_few_programs_serve(n, monkeypatch):
    monkeypatch.setattr(_elements, "_PAIRS_AT_ONCE", 512)
    rows = np.arange(n)
    pairs = Pairs(*(jnp.asarray(np.tile(rows[:, None], (1, width))) for width in (3, 4, 4, 3)))
    runs = list(_elements.padded(pairs, np.ones(n), rows))
    sizes = {len(face) for _, _, face in runs}
    assert len(sizes) == 1 and sizes.pop() <= max(512, 1.34 * n)
    counted = np.concatenate([face[weights > 0] for _, weights, face in runs])
    np.testing.assert_array_equal(counted, rows)
    np.testing.assert_array_equal(runs[-1][0].points[:, 0], runs[-1][2])


# Smoothness from the scan


def test_strength_of_the_prior_is_that_which_the_unknowns_were_drawn_with():
    """A line of faces, their bends measured with noise: rough at one end and smooth at the other."""
    rng, n = np.random.default_rng(0), 400
    face = np.repeat(np.arange(n // 8), 8)
    truth = np.where(np.arange(n) < n // 2, 1.0, 0.1)
    measured = rng.normal(scale=truth) + rng.normal(scale=0.3, size=n)
    around = sp.csr_array(np.abs(np.subtract.outer(range(n // 8), range(n // 8))) <= 3, dtype=float)
    around = sp.diags_array(1 / around.sum(axis=1)) @ around
    precision = np.full(n // 8, 4.0)
    for _ in range(30):
        prior, data = precision[face], 1 / 0.3**2
        precision = next_precision(
            precision,
            measured * data / (data + prior),
            sp.eye_array(n, format="csr"),
            face,
            lambda sides, prior=prior: sides / (prior + 1e-9)[:, None],
            lambda sides, prior=prior, data=data: sides / (prior + data)[:, None],
            around,
        )
    deviation = precision**-0.5
    # The smooth end, which shows little beside the noise, leans a little on the rest.
    assert 0.7 < np.median(deviation[:20]) < 1.3 and 0.05 < np.median(deviation[-20:]) < 0.35


def test_neighbourhoods_average():
    mesh = control_mesh(meshes.grid(4, 3, "mixed"))
    around = neighbourhoods(js.build_topology(mesh, js.Interpolating(), 1))
    np.testing.assert_allclose(around @ np.ones(mesh.n_faces), 1)
    assert 0.1 < np.abs(around @ np.eye(mesh.n_faces)[0]).max() < 0.9


def to_truth(result: fitting.FitResult) -> float:
    points = problem().points
    at = fitting.closest_points(result.surface, points)
    return float(np.sqrt(np.mean((js.evaluate(result.surface, at).points - points) ** 2) * 3))


def roughness(result: fitting.FitResult) -> float:
    bends = fitting.model.residual.bend_asymmetry(result.surface, bend_edges(result.scheme, problem().topology))
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


# Uncertainty


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
    around = sp.csr_array(np.kron(np.eye(n_faces // 300), np.full((300, 300), 1 / 300)))
    weights = np.where(rng.uniform(size=len(face)) < 0.2, 0.0, 1.0)  # outliers, which say nothing
    for height in (0.3, 0.0):
        truth = height * rng.choice([-1.0, 1.0], size=n_faces)
        measured = truth[face] + rng.normal(scale=sigma, size=len(face)) + 100 * (weights == 0)
        of_three = face // 3
        counts = np.bincount(of_three, weights)
        fitted = np.bincount(of_three, weights * measured) / counts
        off = fitted[np.arange(n_faces) // 3] - truth
        variance = sigma**2 / counts
        found = misfit_variances(measured - fitted[of_three], weights, variance[of_three], [face], around)
        expected = max(np.mean(off**2) - np.mean(variance), 0)
        np.testing.assert_allclose(np.mean(found), expected, atol=0.05 * height**2 + 0.001)
    alone = np.arange(n_faces)  # one point a face: nothing in common
    none = misfit_variances(np.ones(n_faces), np.ones(n_faces), np.zeros(n_faces), [alone], around)
    np.testing.assert_array_equal(none, 0)


def test_uncertainty_from_draws_is_the_exact_one(monkeypatch):
    posterior = problem().fit(problem().points + noise(), max_sweeps=4).posterior
    exact = posterior.uncertainty().surface
    draws = posterior.draws(4000)
    np.testing.assert_allclose(draws @ draws.T / 4000, np.linalg.inv(posterior.matrix.toarray()), atol=0.02)
    monkeypatch.setattr(_posterior, "DENSE", 0)
    monkeypatch.setattr(_posterior, "_DRAWS", 2000)
    np.testing.assert_allclose(posterior.uncertainty().surface, exact, rtol=0.08)


def test_what_is_fixed_is_certain():
    mask = np.arange(12) % 3 > 0
    found = problem().fit(problem().points + noise(), free=Free(vertices=mask, h=False), max_sweeps=3)
    deviation = found.uncertainty().control
    assert np.all(deviation[~mask] == 0) and np.all(deviation[mask] > 0.01)


# The fit as a function of the scan


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
