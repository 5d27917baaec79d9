"""Where a surface goes through itself."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import fitting
import jaxsubdiv as js

pytest.importorskip("ipctk")


def surface_of(vertices: np.ndarray, triangles: np.ndarray, quads: np.ndarray | None = None) -> js.RefinedSurface:
    vertices = jnp.asarray(vertices, float)
    faces = {3: jnp.asarray(triangles, jnp.int32).reshape(-1, 3)}
    faces[4] = jnp.asarray([] if quads is None else quads, jnp.int32).reshape(-1, 4)
    return js.RefinedSurface(vertices, jnp.zeros_like(vertices), faces)


def two_balls(apart: float) -> js.RefinedSurface:
    ball = trimesh.creation.icosphere(2)
    vertices = np.concatenate([ball.vertices, ball.vertices + [apart, 0.013, 0.007]])
    return surface_of(vertices, np.concatenate([ball.faces, ball.faces + len(ball.vertices)]))


def crosses(edge: np.ndarray, triangle: np.ndarray) -> bool:
    """By Moeller and Trumbore's solution of p + t d = a + u (b - a) + v (c - a)."""
    p, d = edge[0], edge[1] - edge[0]
    a, b, c = triangle
    columns = np.stack([-d, b - a, c - a], axis=1)
    if abs(np.linalg.det(columns)) < 1e-12:
        return False
    t, u, v = np.linalg.solve(columns, p - a)
    return 0 < t < 1 and u > 0 and v > 0 and u + v < 1


def test_crossings_are_those_of_every_pair():
    surface = two_balls(1.6)
    x, triangles = np.asarray(surface.vertices), np.asarray(surface.triangles())
    near = np.flatnonzero(np.abs(x[triangles].mean(axis=1)[:, 0] - 0.8) < 0.4)
    expected = set()
    for one, other in itertools.permutations(near.tolist(), 2):
        if set(triangles[one]) & set(triangles[other]):
            continue
        if any(crosses(x[triangles[one][[i, i - 1]]], x[triangles[other]]) for i in range(3)):
            expected |= {one, other}
    found = js.find_crossings(surface)
    assert len(expected) > 20
    assert found.triangles.tolist() == sorted(expected)
    assert found.n_triangles == len(triangles)
    # Two unit balls meet in a circle halfway between their middles.
    np.testing.assert_allclose(found.places[:, 0], 0.8, atol=0.06)
    np.testing.assert_allclose(np.linalg.norm(found.places, axis=1), 1, atol=0.05)


def test_surfaces_that_touch_or_lie_apart_do_not_cross():
    assert not len(js.find_crossings(two_balls(2.2)).triangles)
    flat = surface_of([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    assert not len(js.find_crossings(flat).triangles)
    assert not len(js.find_crossings(surface_of(np.zeros((3, 3)), [[0, 1, 2]])).triangles)
    assert not len(js.find_crossings(surface_of(np.zeros((3, 3)), [[0, 1, 1]])).triangles)


def test_quads_cross_as_two_triangles():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    upright = np.array([[0.6, 0.3, -1], [0.7, 0.3, -1], [0.7, 0.3, 1], [0.6, 0.3, 1]], float)
    found = js.find_crossings(surface_of(np.concatenate([square, upright]), [], [[0, 1, 2, 3], [4, 5, 6, 7]]))
    assert found.triangles.tolist() == [0, 2, 3]  # the square's half below its diagonal, and both of the other
    np.testing.assert_allclose(found.places[:, 1:], [[0.3, 0]] * len(found.places), atol=1e-12)


def test_a_report_counts_them():
    scan, mesh = fitting.example("femur_distal")
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    result = fitting.fit(js.Interpolating(), topology, mesh.control(), scan, max_sweeps=1, throw=False)
    assert result.report().crossing_triangles == 0
    report = result.report(uncertainty=True)
    assert report.crossing_triangles == 0 and report.crossings_at is None
    assert ("triangles that cross others", "0") in report.as_rows()


def test_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ipctk", None)
    with pytest.raises(ImportError, match=r"jaxsubdiv\[contact\]"):
        js.find_crossings(two_balls(1.6))
