"""What a scan covers of a surface, signed gaps, and the places that are worst."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

import fitting
import jaxsubdiv as js
from fitting.model.pairing import Look, make_scene, measure
from fitting.report.coverage import distances_to_scan, weighted_quantile, worst_places


@functools.cache
def on_sphere(levels: int = 2) -> js.RefinedSurface:
    """A sphere of 30 mm, exactly."""
    mesh = js.ControlMesh(*sphere_of_quads(6))
    topology = js.build_topology(mesh, js.Interpolating(), levels)
    surface = js.refine(js.Interpolating(), topology, mesh.control())
    unit = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
    return js.RefinedSurface(30 * unit, unit, surface.faces)


def sphere_of_quads(n: int):
    """A cube of n x n quads a side, blown up."""
    grid = np.stack(np.meshgrid(*3 * [np.arange(n + 1)], indexing="ij"), axis=-1).reshape(-1, 3)
    used = ((grid == 0) | (grid == n)).any(axis=1)
    row = {tuple(key): i for i, key in enumerate(grid[used].tolist())}
    faces = []
    for axis in range(3):
        for side in (0, n):
            for i in range(n):
                for j in range(n):
                    corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
                    face = [row[tuple(np.insert(corner, axis, side).tolist())] for corner in corners]
                    outward = (side == n) == (axis != 1)
                    faces.append(face if outward else face[::-1])
    vertices = grid[used] - n / 2
    return 30 * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def seen_from(surface: js.RefinedSurface, points: np.ndarray) -> tuple[Look, np.ndarray]:
    """Pairs and signed distances, without a fit."""
    scan = fitting.Scan(points)
    at, lengths = fitting.closest_points(surface, scan.points), map(jnp.asarray, (8.0, 1e-3))
    seen = measure(surface, make_scene(scan, surface), scan.points, at, *lengths, fitting.Huber())
    return seen, np.asarray(seen.distances)


def scan_of_sphere(radius: float, n: int = 4000) -> np.ndarray:
    rows = np.random.default_rng(1).normal(size=(n, 3))
    return radius * rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_area_of_the_vertices_is_that_of_the_surface():
    surface = on_sphere()
    np.testing.assert_allclose(np.asarray(surface.vertex_areas()).sum(), surface.areas().sum(), rtol=1e-12)
    np.testing.assert_allclose(np.asarray(surface.vertex_areas()).sum(), 4 * np.pi * 900, rtol=5e-3)


@pytest.mark.parametrize("off", [-0.5, 0.0, 0.5])
def test_surface_to_scan_is_the_signed_gap_and_not_the_spacing(off):
    surface, points = on_sphere(), scan_of_sphere(30 + off)
    seen, _ = seen_from(surface, points)
    found = distances_to_scan(surface, seen, np.ones(len(points), bool))
    assert not np.isnan(found).any()
    # The scan is a sphere and the surface has flat faces, which lie below it by their size squared over the diameter.
    sagitta = 30 - np.linalg.norm(np.asarray(surface.vertices)[np.asarray(surface.faces[4])].mean(axis=1), axis=1).min()
    assert sagitta < 0.2 and ((off - 1e-9 < found) & (found < off + sagitta + 1e-9)).all()
    assert np.mean(KDTree(points).query(surface.vertices)[0]) > abs(off) + 0.2


def test_hole_is_not_covered_and_its_share_is_its_area():
    surface, points = on_sphere(), scan_of_sphere(30.0, 8000)
    points = points[points[:, 2] < 15]
    seen, _ = seen_from(surface, points)
    covered = ~np.isnan(distances_to_scan(surface, seen, np.ones(len(points), bool)))
    share = np.asarray(surface.vertex_areas())[covered].sum() / np.asarray(surface.vertex_areas()).sum()
    reach = 5 * np.median(KDTree(points).query(points, k=2)[0][:, 1])
    assert 0.75 < share < 0.75 + reach / 60 + 0.01
    assert covered[np.asarray(surface.vertices)[:, 2] < 14].all()


def test_points_on_the_other_side_of_something_thin_cover_nothing():
    """Two sheets half a millimetre apart, of which only the upper one was scanned."""
    plane = np.stack(np.meshgrid(np.arange(21.0), np.arange(21.0), indexing="ij"), axis=-1).reshape(-1, 2)
    quad = (np.arange(20)[:, None] * 21 + np.arange(20)).reshape(-1, 1) + np.array([0, 21, 22, 1])
    up = np.column_stack([plane, np.full(441, 0.25)])
    vertices = np.concatenate([up, up * (1, 1, -1)])
    normals = np.repeat([[0.0, 0, 1], [0, 0, -1]], 441, axis=0)
    faces = {3: np.zeros((0, 3), np.int32), 4: np.concatenate([quad, quad[:, ::-1] + 441]).astype(np.int32)}
    faces = jax.tree.map(jnp.asarray, faces)
    surface = js.RefinedSurface(jnp.asarray(vertices), jnp.asarray(normals), faces)
    points = np.column_stack([np.random.default_rng(0).uniform(0, 20, (3000, 2)), np.full(3000, 0.35)])
    seen, _ = seen_from(surface, points)
    found = distances_to_scan(surface, seen, np.ones(3000, bool))
    np.testing.assert_allclose(found[:441], 0.1, atol=1e-9)
    assert np.isnan(found[441:]).all()


def test_scan_without_inliers_covers_nothing():
    surface = on_sphere()
    seen, _ = seen_from(surface, scan_of_sphere(30.0, 50))
    assert np.isnan(distances_to_scan(surface, seen, np.zeros(50, bool))).all()


def test_points_on_one_line_cover_a_band():
    surface, turn = on_sphere(), np.linspace(0, 2 * np.pi, 500)
    seen, _ = seen_from(surface, 30.2 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]))
    found = distances_to_scan(surface, seen, np.ones(500, bool))
    covered = ~np.isnan(found)
    np.testing.assert_array_less(np.abs(np.asarray(surface.vertices)[covered, 2]), 1.01 * 5 * 60 * np.pi / 500)
    assert covered.any() and ((found[covered] > 0.2) & (found[covered] < 0.4)).all()


def test_weighted_quantile_is_the_plain_one_with_repeated_values():
    rng = np.random.default_rng(0)
    values, counts = rng.normal(size=50), rng.integers(1, 9, 50)
    plain = np.quantile(np.repeat(values, counts), 0.95, method="inverted_cdf")
    assert weighted_quantile(values, counts.astype(float), 0.95) == plain


def test_worst_places_are_the_bumps_and_not_the_outliers():
    surface, points = on_sphere(), scan_of_sphere(30.0, 6000)
    rng = np.random.default_rng(0)
    tops = np.array([(0, 0, 30.0), (30.0, 0, 0)])
    for top, height in zip(tops, (3.0, -2.0), strict=True):
        points *= 1 + height / 30 * np.exp(-(np.linalg.norm(points - top, axis=1, keepdims=True) ** 2) / 16)
    points[rng.choice(6000, 30, replace=False)] *= 1.5
    seen, distances = seen_from(surface, points)
    places = worst_places(surface, seen, distances, 8.0)
    assert len(places) == 5 and [abs(place.distance) for place in places] == sorted(
        (abs(place.distance) for place in places), reverse=True
    )
    # A bump is wider than its top: the median of nine points is a little less than its height.
    assert 2.2 < places[0].distance < 3.1 and -2.1 < places[1].distance < -1.6
    for place, top in zip(places[:2], tops, strict=True):
        assert np.linalg.norm(place.position - top) < 2
    positions = np.array([place.position for place in places])
    apart = np.linalg.norm(positions[:, None] - positions, axis=-1)[np.triu_indices(5, 1)]
    assert apart.min() >= 8
    on, _ = js.evaluate(surface, seen.at)
    assert places[0].n_points == np.sum(np.linalg.norm(np.asarray(on) - positions[0], axis=1) <= 4)


def test_worst_place_of_many_noisy_points_is_the_bump_and_not_the_noise():
    surface, points = on_sphere(), scan_of_sphere(30.0, 120_000)
    bump = 0.8 * np.exp(-(np.linalg.norm(points - (0, 30, 0), axis=1, keepdims=True) ** 2) / 36)
    points *= 1 + (bump + np.random.default_rng(5).normal(size=(120_000, 1))) / 30
    seen, distances = seen_from(surface, points)
    first, second, *_ = worst_places(surface, seen, distances, 8.0)
    assert np.linalg.norm(first.position - (0, 30, 0)) < 4 and 0.5 < first.distance < 1.1
    assert abs(second.distance) < 0.75  # of nine points it would be 1.7


def test_fewer_places_than_five_where_the_surface_is_small():
    surface, points = on_sphere(), scan_of_sphere(30.1, 200)
    seen, distances = seen_from(surface, points)
    assert len(worst_places(surface, seen, distances, 100.0)) == 1
