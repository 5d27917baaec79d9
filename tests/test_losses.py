"""Losses: their values are those of the truth, their gradients those of finite differences, and nothing is NaN."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scipy.spatial import KDTree

import fitting
import jaxsubdiv as js

RNG = np.random.default_rng(0)


def surface_of(mesh: meshes.Mesh, levels: int = 1, noise: float = 0.0) -> tuple[js.Topology, js.RefinedSurface]:
    vertices, faces = mesh
    control = js.ControlMesh(vertices, sorted(faces, key=len))
    topology = js.build_topology(control, js.CirclePreserving(), levels)
    surface = js.refine(js.CirclePreserving(), topology, control.control())
    x, n = (rows + noise * RNG.normal(size=rows.shape) for rows in (surface.vertices, surface.normals))
    return topology, js.RefinedSurface(x, n / jnp.linalg.norm(n, axis=1, keepdims=True), surface.faces)


MIXED, ROUGH = surface_of(meshes.mixed_closed(), noise=0.02)
CLOUD = jnp.asarray(1.2 * RNG.normal(size=(40, 3)))
DIRECTIONS = jnp.asarray(RNG.normal(size=(40, 3)))
WEIGHTS = jnp.asarray(RNG.uniform(0.5, 1.5, 40)).at[-5:].set(0.0)
PART = js.losses.surface_part(MIXED, np.arange(ROUGH.n_faces) < 41)


def all_losses(vertices, normals, points, faces=ROUGH.faces):
    """Every loss once, in a row."""
    surface, losses = js.RefinedSurface(vertices, normals, faces), js.losses
    return jnp.stack(
        [
            jnp.mean(losses.distances_to_surface(surface, points), axis=-1),
            jnp.mean(losses.distances_to_points(surface, points), axis=-1),
            losses.chamfer_distance(surface, points, weights=jnp.broadcast_to(WEIGHTS, points.shape[:-1])),
            losses.normal_disagreement(surface, points, jnp.broadcast_to(DIRECTIONS, points.shape)),
            losses.surface_area(surface, part=PART),
            losses.enclosed_volume(surface, part=PART),
            losses.bending_energy(surface),
            losses.inverted_faces(surface, margin=0.99),
            jnp.mean(losses.edge_lengths(vertices, MIXED.levels[0].edges) ** 2, axis=-1),
        ],
        axis=-1,
    )


compiled = jax.jit(all_losses)
gradient_of_sum = jax.jit(jax.grad(lambda of_each, *at: jnp.sum(of_each * all_losses(*at)), (1, 2, 3)))


def test_gradients_are_those_of_finite_differences():
    at = (ROUGH.vertices, ROUGH.normals, CLOUD)
    along = tuple(jnp.asarray(RNG.normal(size=a.shape)) for a in at)
    gradients = [gradient_of_sum(of_each, *at) for of_each in jnp.eye(9)]
    slopes = np.array([sum(np.sum(g * d) for g, d in zip(one, along, strict=True)) for one in gradients])
    step = 1e-6
    ahead, back = (compiled(*(a + s * d for a, d in zip(at, along, strict=True))) for s in (step, -step))
    expected = (ahead - back) / (2 * step)
    exact = np.arange(len(slopes)) != 3  # the feet of normals do move, which this derivative leaves out
    # The foot in a bent quad is found in a few steps, to about 1e-6: the first two and the third are as exact as that.
    np.testing.assert_allclose(slopes[exact], expected[exact], rtol=1e-5, atol=1e-6)
    assert np.all(np.abs(expected) > 1e-3)


def test_gradient_of_normals_is_that_at_fixed_feet():
    at = js.search_closest(ROUGH, CLOUD)

    def loss(normals, oriented):
        surface = js.RefinedSurface(ROUGH.vertices, normals, ROUGH.faces)
        return js.losses.normal_disagreement(surface, CLOUD, DIRECTIONS, WEIGHTS, at, oriented=oriented)

    along, step = jnp.asarray(RNG.normal(size=ROUGH.normals.shape)), 1e-6
    for oriented in (True, False):
        of_normals = jax.jit(lambda normals, oriented=oriented: loss(normals, oriented))
        _, slope = jax.jvp(of_normals, (ROUGH.normals,), (along,))
        ahead, back = (of_normals(ROUGH.normals + s * along) for s in (step, -step))
        np.testing.assert_allclose(slope, (ahead - back) / (2 * step), rtol=1e-6)


def test_a_batch_is_as_one_by_one():
    at = [jnp.stack([a, 1.1 * a]) for a in (ROUGH.vertices, ROUGH.normals, CLOUD)]
    expected = jnp.stack([compiled(*(a[i] for a in at)) for i in range(2)])
    together = jax.jit(all_losses)(*at)
    np.testing.assert_allclose(together, expected, rtol=1e-12)
    # Surfaces of different faces have theirs in the batch, too.
    faces = {size: jnp.stack([rows, jnp.roll(rows, 1, axis=0)]) for size, rows in ROUGH.faces.items()}
    area = jax.jit(js.losses.surface_area)(js.RefinedSurface(at[0], at[1], faces))
    np.testing.assert_allclose(area, [ROUGH.areas().sum(), 1.21 * ROUGH.areas().sum()])


def test_all_is_finite_where_rows_are_degenerate():
    x = ROUGH.vertices.at[ROUGH.faces[3][0]].set(ROUGH.vertices[0])  # a triangle that is a point
    x = x.at[ROUGH.faces[4][3, 1]].set(x[ROUGH.faces[4][3, 0]])  # a quad with a side of no length
    n = ROUGH.normals.at[:5].set(0.0)
    points = CLOUD.at[0].set(x[0]).at[1].set(CLOUD[2])  # on the surface, and twice at one place
    slopes = gradient_of_sum(jnp.ones(9), x, n, points)  # NaN stays in a sum
    assert np.isfinite(compiled(x, n, points)).all() and all(np.isfinite(slope).all() for slope in slopes)


def test_gradient_of_a_distance_is_zero_on_the_surface():
    at = js.search_closest(ROUGH, CLOUD)
    on = js.evaluate(ROUGH, at).points
    slope = jax.grad(lambda points: jnp.sum(js.losses.distances_to_surface(ROUGH, points, at)))(on)
    assert np.all(slope == 0)


def test_distances_are_to_the_closest_points():
    found = js.losses.distances_to_surface(ROUGH, CLOUD)
    on = js.evaluate(ROUGH, fitting.closest_points(ROUGH, CLOUD)).points
    np.testing.assert_allclose(found, np.linalg.norm(on - CLOUD, axis=1), rtol=1e-9)
    back = js.losses.distances_to_points(ROUGH, CLOUD, WEIGHTS)
    np.testing.assert_allclose(back, KDTree(CLOUD[:-5]).query(ROUGH.vertices)[0], rtol=1e-12)
    areas = ROUGH.vertex_areas()
    expected = np.sum(WEIGHTS * found**2) / WEIGHTS.sum() + np.sum(areas * back**2) / areas.sum()
    np.testing.assert_allclose(js.losses.chamfer_distance(ROUGH, CLOUD, WEIGHTS), expected, rtol=1e-12)
    blocks = js.search_nearest(ROUGH.vertices, CLOUD, memory=2000)
    np.testing.assert_array_equal(blocks, KDTree(CLOUD).query(ROUGH.vertices)[1])
    assert js.losses.chamfer_distance(ROUGH, CLOUD, 0 * WEIGHTS) == 0


def test_a_sphere_has_its_area_volume_energy_and_normals():
    topology, ball = surface_of(meshes.icosahedron(), levels=2)
    ball = js.RefinedSurface(3.0 * ball.vertices + 100.0, ball.normals, ball.faces)
    part, points = js.losses.surface_part(topology), 100.0 + 5.0 * ball.normals

    @jax.jit
    def found(ball):
        losses, inside_out = js.losses, js.RefinedSurface(ball.vertices, -ball.normals, ball.faces)
        at = js.search_closest(ball, points)
        return (
            (losses.surface_area(ball), losses.enclosed_volume(ball, part=part), ball.vertex_areas().sum()),
            losses.bending_energy(ball),
            [losses.normal_disagreement(ball, points, n * ball.normals, None, at) for n in (7.0, -1.0)],
            [losses.inverted_faces(each, margin=0.0) for each in (ball, inside_out)],
        )

    sizes, energy, normals, inverted = found(ball)
    np.testing.assert_allclose(sizes, 36 * np.pi, rtol=0.04)
    np.testing.assert_allclose(energy, 2 * sizes[0] / 9, rtol=1e-9)
    np.testing.assert_allclose(sizes[2], sizes[0])
    np.testing.assert_allclose(normals, [0, 2], atol=1e-2)
    assert inverted[0] == 0
    np.testing.assert_allclose(inverted[1], 1.0, rtol=0.05)


def test_parts_are_closed_by_flat_caps():
    vertices, faces = meshes.cube()
    topology, cube = surface_of((vertices, faces), levels=0)
    ring = np.abs(vertices[np.array(topology.faces[4])].mean(axis=1)[:, 2]) < 0.5  # without floor and ceiling
    tube = js.losses.surface_part(topology, ring)
    assert tube.n_rims == 2 and len(tube.triangles) == 8
    np.testing.assert_allclose(js.losses.enclosed_volume(cube, part=tube), 8.0)
    np.testing.assert_allclose(js.losses.surface_area(cube, part=tube), 16.0)
    whole = js.losses.surface_part(topology)
    assert whole.n_rims == 0
    np.testing.assert_allclose(js.losses.enclosed_volume(cube, part=whole), 8.0)
    with pytest.raises(ValueError, match="must mark some of the 6 faces of the refined surface; got 0 marks"):
        js.losses.surface_part(topology, np.zeros(6, bool))
    with pytest.raises(ValueError, match="of the 6 faces"):
        js.losses.surface_part(topology, np.ones(5, bool))
