"""The limit surface in closed form: splines over the regular faces of Catmull-Clark and Loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from schemes import control_mesh, random_control

import jaxsubdiv as js
from jaxsubdiv._patches import patch_points

FINE = 3
CASES = {
    "torus": (js.CatmullClark(), meshes.torus(5, 4), {}, 1),
    "cube": (js.CatmullClark(), meshes.cube(), {}, 2),
    "cube, creased": (js.CatmullClark(), meshes.cube(), {"creases": js.Creases([(0, 1)])}, 2),
    "triangles on a torus": (js.Loop(), meshes.torus(5, 4, "triangle"), {}, 1),
    "double pyramid": (js.Loop("warren"), meshes.fan(5), {}, 2),
}


@pytest.mark.parametrize("name", CASES)
def test_splines_are_the_limit_of_more_levels(name):
    scheme, told, options, levels = CASES[name]
    mesh, control = control_mesh(told), random_control(told, seed=0)
    coarse, fine = (js.build_topology(mesh, scheme, n, limit=True, **options) for n in (levels, FINE))
    # Without splines a place at a corner of the finer faces is a vertex on the limit.
    by_masks = eqx.tree_at(lambda topology: topology.limit.patches, fine, None)
    steps = 2**FINE
    u, v = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1), indexing="ij")
    inside = (u + v <= steps) if len(mesh.faces[3]) else u >= 0
    uv = np.stack([u[inside], v[inside]], axis=1) / steps
    uv = uv[np.random.default_rng(0).permutation(len(uv))[:60]]
    face = np.repeat(np.arange(mesh.n_faces), len(uv))
    at = js.SurfacePoint(face, np.tile(uv, (mesh.n_faces, 1)))
    ours, expected = (js.evaluate_control(scheme, topology, control, at) for topology in (coarse, by_masks))
    exact = np.asarray(ours.error) == 0
    assert exact.all() == ("torus" in name) and exact.mean() > 0.25
    np.testing.assert_allclose(ours.points[exact], expected.points[exact], rtol=0, atol=1e-13)
    np.testing.assert_allclose(ours.normals[exact], expected.normals[exact], rtol=0, atol=1e-10)
    gap = np.linalg.norm(ours.points - expected.points, axis=1)
    assert options or np.all(gap <= ours.error + 1e-12)


@pytest.mark.parametrize("corners", [3, 4])
def test_weights_of_a_patch_sum_to_one_and_reproduce_linear_functions(corners):
    rng = np.random.default_rng(1)
    u, v = jnp.asarray(rng.dirichlet(np.ones(3), 20)[:, :2].T)
    if corners == 4:  # corner, across the side after it, across the side before it, diagonal
        rows = [[(0, 0), (1, 0), (1, 1), (0, 1)], [(0, -1), (2, 0), (1, 2), (-1, 1)]]
        rows += [[(-1, 0), (1, -1), (2, 1), (0, 2)], [(-1, -1), (2, -1), (2, 2), (-1, 2)]]
    else:
        rows = [[(0, 0), (1, 0), (0, 1)], [(1, -1), (1, 1), (-1, 1)]]
        rows += [[(0, -1), (2, 0), (-1, 2)], [(-1, 0), (2, -1), (0, 2)]]
    places = np.array([(*uv, 1) for row in rows for uv in row], float)
    table = jnp.tile(jnp.arange(len(places)), (20, 1))
    points = patch_points(table, u, v, jnp.asarray(places))
    np.testing.assert_allclose(points, np.stack([u, v, 0 * u + 1], axis=1), rtol=0, atol=1e-14)


def test_the_limit_is_differentiable_at_fixed_places():
    scheme, (vertices, faces) = js.CatmullClark(), meshes.torus(5, 4)
    mesh = js.ControlMesh(vertices, faces)
    topology, control = js.build_topology(mesh, scheme, 0, limit=True), mesh.control()
    at = js.SurfacePoint(np.arange(20), np.random.default_rng(0).uniform(size=(20, 2)))

    def value(x):
        return jnp.sum(jnp.sin(js.evaluate_control(scheme, topology, js.Control(x, control.normals), at).points))

    along = np.random.default_rng(1).normal(size=vertices.shape)
    slope = jnp.vdot(jax.grad(value)(control.vertices), along)
    ahead, back = (value(control.vertices + step * along) for step in (1e-5, -1e-5))
    np.testing.assert_allclose(slope, (ahead - back) / 2e-5, rtol=0, atol=1e-7)
