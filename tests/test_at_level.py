"""The fitted surface at other levels than that of the fit: the same surface, and the same posterior."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from posteriors import precision_matrix
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting.report import at_level


@functools.cache
def fitted() -> fitting.FitResult:
    return problem().fit(problem().points + noise())


def test_own_level_is_the_fit():
    at = fitted().refine_to()
    assert at.levels == 1
    np.testing.assert_array_equal(at.surface.vertices, fitted().surface.vertices)
    np.testing.assert_array_equal(at.deviations, fitted().uncertainty().surface)


@pytest.mark.parametrize("levels", [0, 2, 3])
def test_levels_share_their_vertices_and_what_is_known_there(levels):
    own, at = fitted().refine_to(), fitted().refine_to(levels)
    n = min(len(own.surface.vertices), len(at.surface.vertices))
    assert len(at.deviations) == len(at.distances) == len(at.surface.vertices)
    assert at.surface.n_faces == 14 * 4**levels
    np.testing.assert_allclose(at.surface.vertices[:n], own.surface.vertices[:n], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(at.distances[:n], own.distances[:n], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(at.deviations[:n], own.deviations[:n], rtol=1e-6)
    assert np.all(at.deviations > 0)


def test_deviations_are_those_of_the_whole_covariance():
    result, levels = fitted(), 2
    at, fit = result.refine_to(levels), result.fit
    model, layout = dataclasses.replace(fit.model, topology=at.topology, priors=()), fit.model.layout
    normals = jnp.asarray(at.surface.normals)

    def across(offset):
        return jnp.sum(model.refine(model.retract(fit.y, layout.split(offset))).vertices * normals, axis=1)

    free = np.flatnonzero(fit.model.is_free)
    by = np.asarray(jax.jacfwd(across)(jnp.zeros(layout.n)))[:, free]
    variances = np.einsum("vd,vd->v", by, np.linalg.solve(precision_matrix(result), by.T).T)
    corners = corners_of(at.surface)
    owner = np.arange(len(corners)) // 4**levels
    misfit = np.zeros(len(variances))
    for vertex in range(len(variances)):
        misfit[vertex] = result.posterior._misfit_of_faces[owner[(corners == vertex).any(axis=1)]].mean()
    np.testing.assert_allclose(at.deviations, np.sqrt(variances + misfit), rtol=1e-5)


def corners_of(surface: js.RefinedSurface) -> np.ndarray:
    triangles, quads = (np.asarray(surface.faces[size]) for size in (3, 4))
    return np.concatenate([triangles[:, [0, 1, 2, 2]], quads])


def test_very_fine_surfaces_have_their_deviations_from_a_coarser_one(monkeypatch):
    exact, coarse = fitted().refine_to(3), fitted().refine_to(2)
    limit = len(coarse.surface.vertices) * len(fitted().posterior.equations.structure.elements.seeds)
    monkeypatch.setattr(at_level, "_MOST_DERIVATIVES", limit)
    monkeypatch.setattr(at_level, "_AT_ONCE", 100)
    found = fitted().refine_to(3).deviations
    n = len(coarse.surface.vertices)
    np.testing.assert_allclose(found[:n], coarse.deviations, rtol=1e-3)
    off = np.abs(found / exact.deviations - 1)
    assert np.median(off) < 0.05 and np.percentile(off, 95) < 0.3


def test_distances_are_told_where_the_scan_is():
    result = fitted()
    part = np.asarray(result.points)[:, 0] > 0
    at = result.compare_with(fitting.Scan(np.asarray(problem().points)[part])).refine_to(3)
    x = np.asarray(at.surface.vertices)[:, 0]
    assert np.isnan(at.distances[x < -10]).all() and np.isfinite(at.distances[x > 5]).all()


@pytest.mark.parametrize("name", ["loop", "doo-sabin"])
def test_other_schemes_have_levels_too(name):
    scheme = js.SCHEMES[name]()  # pyright: ignore[reportCallIssue]
    vertices, faces = meshes.octahedron() if name == "loop" else meshes.cube()
    mesh = js.ControlMesh(vertices * 20.0, faces)
    topology = js.build_topology(mesh, scheme, 2)
    points = np.asarray(js.refine(scheme, topology, mesh.control()).vertices)
    result = fitting.fit(scheme, topology, mesh.control(), fitting.Scan(points), max_sweeps=2, throw=False)
    for levels in (1, 3):
        at = result.refine_to(levels)
        assert len(at.deviations) == len(at.surface.vertices) and np.isfinite(at.deviations).all()


def test_levels_that_a_surface_does_not_have():
    with pytest.raises(ValueError, match="`levels` must lie between 0 and 8; got 9"):
        fitted().refine_to(9)
    p = problem()
    each = p.fit(scheme=js.Interpolating([1.0]), max_sweeps=1)
    assert len(each.refine_to(1).surface.vertices) == len(each.surface.vertices)
    with pytest.raises(ValueError, match="no other level than 1, that of the fit: it has an h for each level"):
        each.refine_to(2)
    vertices, faces = meshes.cube()
    cube, scheme = js.ControlMesh(vertices * 20.0, faces), js.CatmullClark()
    creases = js.Creases(edges=[(faces[0][0], faces[0][1])], sharpness=[2.0])
    topology = js.build_topology(cube, scheme, 1, creases=creases)
    points = np.asarray(js.refine(scheme, topology, cube.control()).vertices)
    creased = fitting.fit(scheme, topology, cube.control(), fitting.Scan(points), max_sweeps=1, throw=False)
    with pytest.raises(ValueError, match="no other level than 1, that of the fit: its control mesh has creases"):
        creased.refine_to(2)
