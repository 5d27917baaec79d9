"""Curvatures of surfaces, places in control faces, and distances to a mesh."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from schemes import by_name, control_mesh, on_host, torus
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv._distance import closest_on_mesh


def of_torus(n: int, kind: str) -> tuple[js.RefinedSurface, np.ndarray]:
    """The torus with its own normals, and its lesser principal curvature."""
    mesh = torus(n, kind)
    faces = {size: jnp.asarray(rows) for size, rows in mesh.faces.items()}
    surface = js.RefinedSurface(jnp.asarray(mesh.vertices), jnp.asarray(mesh.normals), faces)
    across = np.hypot(*mesh.vertices[:, :2].T)
    return surface, (across - 2) / across


@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_curvatures_converge_to_those_of_a_torus(kind):
    errors = []
    for n in (10, 20):
        surface, least = of_torus(n, kind)
        found = on_host(js.curvatures(surface))
        expected = [least, (1 + least) / 2, np.stack([np.ones_like(least), least], axis=1)]
        errors.append([np.abs(one - other).max() for one, other in zip(found, expected, strict=True)])
    assert np.all(np.log2(np.divide(*errors)) > 1.8) and np.max(errors) < 0.1


def test_curvatures_are_exact_and_differentiable_on_a_sphere():
    vertices, faces = meshes.icosahedron()
    tables = {3: jnp.asarray(faces), 4: jnp.zeros((0, 4), int)}

    def mean(radius: jax.Array, x: jax.Array) -> jax.Array:
        found = js.curvatures(js.RefinedSurface(radius * x, x, tables))
        return jnp.stack([found.mean, found.principal[:, 0], jnp.sqrt(found.gaussian)])

    for radius in (0.5, 3.0):
        np.testing.assert_allclose(mean(jnp.asarray(radius), jnp.asarray(vertices)), 1 / radius, rtol=1e-12)
        # Every point is umbilic: the roots' derivative is that of the mean.
        slope = jax.jit(jax.jacfwd(mean))(jnp.asarray(radius), jnp.asarray(vertices))
        np.testing.assert_allclose(slope, -1 / radius**2, rtol=1e-10)
    rng, step = np.random.default_rng(0), 1e-6
    surface, _ = of_torus(4, "quad")
    along = rng.normal(size=surface.vertices.shape)

    def total(t: float) -> jax.Array:
        bent = js.RefinedSurface(surface.vertices + t * along, surface.normals, surface.faces)
        return sum(jnp.sum(jnp.sin(part)) for part in js.curvatures(bent))

    slope = jax.jit(jax.grad(total))(0.0)
    np.testing.assert_allclose(slope, (total(step) - total(-step)) / (2 * step), rtol=1e-6)


def test_curvatures_are_zero_where_there_are_no_faces():
    tables = {3: jnp.array([(0, 1, 2)]), 4: jnp.zeros((0, 4), int)}
    found = js.curvatures(js.RefinedSurface(jnp.eye(4, 3), jnp.ones((4, 3)) / np.sqrt(3), tables))
    assert all(not np.any(np.asarray(part)[3]) and np.isfinite(part).all() for part in found)


PLACES = np.random.default_rng(2).dirichlet(np.ones(3), 40)[:, :2]


@pytest.mark.parametrize("name", ["default", "bezier-triangle", "loop"])
def test_places_in_control_faces_are_where_their_refined_faces_are(name):
    case = by_name(name)
    mesh = control_mesh(meshes.mixed_closed() if 4 in case.scheme.takes else meshes.octahedron())
    scheme, control, levels = case.with_h(1.0), mesh.control(), 2
    options = {"limit": True} if scheme.is_linear else {}
    coarse, fine = (js.build_topology(mesh, scheme, n, **options) for n in (levels, 4))
    face = np.arange(len(PLACES)) % mesh.n_faces
    uv = jnp.asarray(PLACES)
    jet = js.evaluate_control(scheme, coarse, control, js.SurfacePoint(face, uv))
    # Against the flat faces of a finer surface, and against differences of itself.
    dense = js.refine(scheme, fine, control)
    corners = np.asarray(dense.vertices)[np.asarray(dense.triangles())]
    assert closest_on_mesh(np.asarray(jet.points), corners)[0].max() < 5e-3
    closer = js.evaluate_control(scheme, fine, control, js.SurfacePoint(face, uv))
    gap = np.linalg.norm(jet.points - closer.points, axis=1)
    assert np.all(gap <= jet.error + 1e-12)
    assert name != "bezier-triangle" or not np.any(jet.error)
    assert name == "bezier-triangle" or closer.error.mean() < jet.error.mean() / 8
    for slope, step in ((jet.du, (1e-6, 0)), (jet.dv, (0, 1e-6))):
        ahead, back = (
            js.evaluate_control(scheme, coarse, control, js.SurfacePoint(face, uv + sign * jnp.asarray([step]))).points
            for sign in (1, -1)
        )
        np.testing.assert_allclose(slope, (ahead - back) / 2e-6, rtol=0, atol=1e-7)
    np.testing.assert_allclose(np.sum(jet.normals * jet.du, axis=1), 0, atol=1e-14)
    corners = np.concatenate([mesh.faces[3][:, 1], mesh.faces[4][:, 1]])
    at = js.SurfacePoint(np.arange(len(corners)), np.tile((1.0, 0.0), (len(corners), 1)))
    refined_there = js.refine(scheme, coarse, control)
    ends = js.evaluate_control(scheme, coarse, control, at)
    np.testing.assert_allclose(ends.points, refined_there.vertices[corners], rtol=0, atol=1e-14)
    np.testing.assert_allclose(ends.normals, refined_there.normals[corners], rtol=0, atol=1e-12)


def test_places_that_have_none_in_the_refined_mesh_are_an_error():
    mesh, at = control_mesh(meshes.pyramid()), js.SurfacePoint([0], [(0.2, 0.3)])
    for scheme in (js.DooSabin(), js.CatmullClark()):
        topology = js.build_topology(mesh, scheme, 1, limit=True)
        with pytest.raises(ValueError, match=f"{type(scheme).__name__} does not split these control faces into four"):
            js.evaluate_control(scheme, topology, mesh.control(), at)
    with pytest.raises(ValueError, match="no limit masks"):
        js.evaluate_control(js.DooSabin(), js.build_topology(mesh, js.DooSabin(), 1), mesh.control(), at)


def test_distances_to_a_mesh_are_exact():
    rng = np.random.default_rng(0)
    vertices, faces = meshes.icosahedron()
    corners = vertices[np.array(faces)] * rng.uniform(0.2, 2, (20, 1, 1))
    points = rng.normal(size=(200, 3))
    barycentric = rng.dirichlet(np.ones(3), 4000)
    drawn = np.einsum("bk,tkx->tbx", np.concatenate([barycentric, np.eye(3)]), corners)
    distance, nearest = closest_on_mesh(points, corners, first=1)
    by_triangle = np.stack([KDTree(rows).query(points)[0] for rows in drawn], axis=1)
    assert np.all(distance <= by_triangle.min(axis=1) + 1e-12)
    np.testing.assert_allclose(distance, by_triangle[np.arange(200), nearest], atol=0.03)
