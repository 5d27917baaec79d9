"""Weights on flat grids, and how near refined surfaces come to tori, spheres and cylinders."""

import functools

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import reference
from refined import DEFAULT, PART, X, refine, unit
from schemes import MIXED, SHEET, over_cases, refined

import jaxsubdiv as js


def stencil(mesh: meshes.Mesh, h: float) -> tuple[js.Topology, np.ndarray]:
    """Heights of the edge vertices over a flat sheet as weights of the control heights, normals from the mesh."""
    scheme = js.Interpolating(h)
    topology = js.build_topology(js.ControlMesh(*mesh), scheme, 1)

    def heights(z: jax.Array) -> jax.Array:
        vertices = jnp.concatenate([jnp.asarray(mesh[0][:, :2]), z[:, None]], axis=1)
        control = js.Control(vertices, js.estimate_normals(topology.control_fans, vertices))
        return js.refine(scheme, topology, control).vertices[len(z) :, 2]

    return topology, np.asarray(jax.jit(jax.jacfwd(heights))(jnp.zeros(len(mesh[0]))))


def weights_at(
    mesh: meshes.Mesh, h: float, places: dict[float, list[tuple[int, int]]]
) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the edge from (2, 2) to (3, 2), and the expected ones: each weight with its places in the grid."""
    topology, weights = stencil(mesh, h)
    ends = at(2, 2), at(3, 2)
    row = np.flatnonzero((np.sort(topology.levels[0].edges, axis=1) == ends).all(axis=1))
    expected = np.zeros(len(mesh[0]))
    for weight, cells in places.items():
        expected[[at(*cell) for cell in cells]] = weight
    return weights[row[0]], expected


def at(x: int, y: int) -> int:
    """Number of a vertex in a grid of 5 by 4 cells."""
    return 5 * x + y


@pytest.mark.parametrize("h", [1.0, 0.6])
def test_edges_of_a_flat_quad_grid_have_the_four_point_weights(h):
    w = h / 16
    places = {1 / 2 + w: [(2, 2), (3, 2)], -w: [(1, 2), (4, 2)]}
    np.testing.assert_allclose(*weights_at(meshes.grid(5, 4), h, places), rtol=0, atol=1e-15)


@pytest.mark.parametrize("h", [1.0, 0.6])
def test_edges_of_a_flat_triangle_grid_have_the_butterfly_weights(h):
    vertices, faces = meshes.grid(5, 4, "triangle")
    # The diagonals run from (0, 0) to (1, 1); sheared, the edges of all three directions are alike.
    x, y = vertices[:, 0] - vertices[:, 1] / 2, np.sqrt(3) / 2 * vertices[:, 1]
    tension, w = h / 16, -h / 24  # the two parameters of the 10-point butterfly
    places = {
        1 / 2 - w: [(2, 2), (3, 2)],
        2 * (tension + w): [(3, 3), (2, 1)],
        -tension - w: [(1, 1), (3, 1), (2, 3), (4, 3)],
        w: [(1, 2), (4, 2)],
    }
    flat = np.stack([x, y, vertices[:, 2]], axis=1)
    np.testing.assert_allclose(*weights_at((flat, faces), h, places), rtol=0, atol=1e-15)


def test_first_edge_points_are_the_middles_of_the_pn_triangle():
    rng = np.random.default_rng(8)
    for _ in range(5):
        vertices, normals = rng.normal(size=(2, 3, 3))
        surface = refine(js.Interpolating(), (vertices, [(0, 1, 2)]), 1, normals)
        middles = reference.pn_triangle_edge_middles(vertices, normals)
        np.testing.assert_allclose(surface.vertices[[3, 5, 4]], middles, rtol=0, atol=1e-14)  # edges 01, 02, 12


@functools.cache
def torus_error(circle: bool, h: float, n: int, kind: str) -> float:
    """Largest distance from the torus of radii 2 and 1, `2 n` cells by `n`, with its own normals."""
    scheme = js.CirclePreserving(h) if circle else js.Interpolating(h)
    vertices, faces = meshes.torus(2 * n, n, kind)
    surface = refine(scheme, (vertices, faces), 1, vertices - 2 * unit(vertices * (1, 1, 0)))
    across = np.linalg.norm(surface.vertices[:, :2], axis=1) - 2
    return np.abs(np.hypot(across, surface.vertices[:, 2]) - 1).max()


@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_order_is_four_with_exact_normals_and_h_one_alone(kind):
    order, of_other_h = (np.log2(torus_error(False, h, 10, kind) / torus_error(False, h, 20, kind)) for h in (1.0, 1.2))
    assert 3.7 < order < 4.3
    assert of_other_h < 2.3


def test_circle_preserving_scheme_is_closer_to_a_torus():
    order = np.log2(torus_error(True, 1.0, 10, "quad") / torus_error(True, 1.0, 20, "quad"))
    assert 3.7 < order < 4.3
    assert torus_error(True, 1.0, 20, "quad") < torus_error(False, 1.0, 20, "quad") / 4


@pytest.mark.parametrize(
    ("name", "best"), [("tetrahedron", 1.83), ("octahedron", 1.46), ("icosahedron", 1.206), ("cube", 1.51)]
)
def test_best_constant_h_on_a_sphere(name, best):
    vertices, faces = getattr(meshes, name)()
    vertices = unit(vertices)

    def error(h: float) -> float:
        surface = refine(js.Interpolating(h), (vertices, faces), 4, vertices)
        return np.mean((np.linalg.norm(surface.vertices, axis=1) - 1) ** 2)

    step = 0.05
    below, here, above = (error(best + shift) for shift in (-step, 0, step))
    bottom = best + step / 2 * (below - above) / (below - 2 * here + above)  # of the parabola through all three
    assert abs(bottom - best) < 0.015


def test_displacements_shrink_to_about_a_third_a_level():
    mesh, scheme, levels = meshes.icosahedron(), js.Interpolating(), 5
    topology = js.build_topology(js.ControlMesh(*mesh), scheme, levels)
    surface, first, largest = refine(scheme, mesh, levels), len(mesh[0]), []
    for level in topology.levels:
        edges = np.asarray(level.edges)
        bend = surface.vertices[first : first + len(edges)] - surface.vertices[edges].mean(axis=1)
        largest.append(np.linalg.norm(bend, axis=1).max())
        first += len(edges) + len(level.quads)
    ratios = np.divide(largest[1:], largest[:-1])
    assert 0.30 < ratios[-1] < 0.36
    assert np.all(np.diff(ratios) < 0)


def on_a_sphere() -> np.ndarray:
    """The parts of `MIXED` laid on the unit sphere, no two neighbours 120 degrees apart."""
    sheets = np.isin(PART, (SHEET, SHEET + 1))
    return unit(np.where(sheets[:, None], MIXED[0] * (0.4, 0.4, 0) + (0.1, 0, 1), X))


@over_cases("sphere")
def test_spheres_are_kept_by_schemes_that_claim_it(case):
    normals, centre, radius = on_a_sphere(), np.array([3.0, -1.0, 2.0]), 5.0
    surface = refined(case._replace(scheme=case.with_h(1.0)), js.Control(centre + radius * normals, normals))
    np.testing.assert_allclose(surface.vertices, centre + radius * surface.normals, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(surface.vertices - centre, axis=1), radius, rtol=1e-13)


def test_interpolating_scheme_leaves_a_sphere():
    normals = on_a_sphere()
    one = DEFAULT._replace(scheme=js.Interpolating())
    lengths = np.linalg.norm(refined(one, js.Control(normals, normals)).vertices, axis=1)
    assert np.abs(lengths - 1).max() > 0.01


def test_round_cylinders_are_kept_by_the_circle_preserving_scheme():
    angle, height, _ = meshes.grid(3, 2)[0].T
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    mesh = (3 * normals + np.outer(height, (0, 0, 1)), meshes.grid(3, 2)[1])
    surface = refine(js.CirclePreserving(), mesh, 1, normals)
    outward = unit(surface.vertices * (1, 1, 0))
    np.testing.assert_allclose(surface.vertices[:, :2], 3 * outward[:, :2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(surface.normals, outward, rtol=0, atol=1e-13)
