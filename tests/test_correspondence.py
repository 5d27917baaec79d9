"""Closest points: compared with searches that look at every face, which the library's search does not."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import trimesh

import jaxsubdiv as js
from fitting import closest_points
from fitting.scan import closest_points as module
from fitting.scan.closest_points import boundary_vertices

GOLDEN = (5**0.5 - 1) / 2


def surface_of(mesh: meshes.Mesh, dtype: type = np.float64) -> js.RefinedSurface:
    vertices, faces = mesh
    by_size = {n: np.array([f for f in faces if len(f) == n], np.int32).reshape(-1, n) for n in (3, 4)}
    values = jnp.asarray(vertices, dtype)
    return js.RefinedSurface(values, jnp.zeros_like(values), jax.tree.map(jnp.asarray, by_size))


def stretched(mesh: meshes.Mesh, *factors: float) -> meshes.Mesh:
    return mesh[0] * factors, mesh[1]


def needles() -> meshes.Mesh:
    """Triangles 400 long and 0.01 to 1 wide, in all directions: the nearest centre says little of the nearest face."""
    rng = np.random.default_rng(5)
    start, along, across = rng.uniform(-1, 1, (3, 60, 3))
    vertices = np.stack([start, start + 200 * along, start + across * rng.uniform(0.01, 1, (60, 1))], axis=1)
    return vertices.reshape(-1, 3), [(i, i + 1, i + 2) for i in range(0, 180, 3)]


def one_large_among_small() -> meshes.Mesh:
    large = np.array([(-50.0, -50, -3), (50, -50, -3), (0, 60, -3)]), [(0, 1, 2)]
    return meshes.union(meshes.torus(12, 8, "triangle"), large)


TRIANGLES = {
    "one face": (np.array([(0.0, 0, 0), (3, 0, 0), (0, 2, 1)]), [(0, 1, 2)]),
    "octahedron": meshes.octahedron(),
    "torus": meshes.torus(12, 8, "triangle"),
    "open": meshes.grid(6, 5, "triangle", bumpy=0.8),
    "elongated": stretched(meshes.grid(6, 5, "triangle", bumpy=0.8), 300, 1, 1),
    "needles": needles(),
    "one large among small": one_large_among_small(),
}


def some_points(surface: js.RefinedSurface, seed: int = 0) -> np.ndarray:
    """Points near the surface and all around it, far off, and on vertices, edges and faces."""
    rng = np.random.default_rng(seed)
    corners = np.asarray(surface.vertices)[np.asarray(surface.triangles())]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size = np.linalg.norm(high - low)
    a, b, c = np.moveaxis(corners[rng.integers(len(corners), size=40)], 1, 0)
    on_faces = np.concatenate([a, (a + b) / 2, GOLDEN * b + (1 - GOLDEN) * c, (a + b + c) / 3])
    around = rng.uniform(low - 0.2 * size, high + 0.2 * size, (200, 3))
    far = rng.normal(size=(20, 3)) * 50 * size
    return np.concatenate([on_faces, on_faces + rng.normal(scale=0.02 * size, size=on_faces.shape), around, far])


def distances(surface: js.RefinedSurface, points: np.ndarray) -> np.ndarray:
    """To the places found, which must lie in their faces."""
    at = closest_points(surface, points)
    uv, in_triangle = np.asarray(at.uv), np.asarray(at.face) < len(surface.faces[3])
    assert np.all((uv >= 0) & (uv <= 1)) and np.all(uv[in_triangle].sum(axis=1) <= 1 + 1e-12)
    return np.linalg.norm(js.evaluate(surface, at).points - points, axis=1)


def distances_to_every(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    n, t = len(points), len(triangles)
    closest = trimesh.triangles.closest_point(np.tile(triangles, (n, 1, 1)), np.repeat(points, t, axis=0))
    return np.linalg.norm(closest.reshape(n, t, 3) - points[:, None], axis=2).min(axis=1)


def corners_of(surface: js.RefinedSurface) -> np.ndarray:
    return np.asarray(surface.vertices)[np.asarray(surface.triangles())]


@pytest.mark.parametrize("shape", TRIANGLES)
def test_no_triangle_is_nearer_than_the_one_found(shape):
    surface = surface_of(TRIANGLES[shape])
    points = some_points(surface)
    expected = distances_to_every(corners_of(surface), points)
    rounding = 1e-11 * np.ptp(surface.vertices, axis=0).max()
    np.testing.assert_allclose(distances(surface, points), expected, rtol=1e-10, atol=rounding)


@pytest.mark.parametrize("mesh", [meshes.cube(), meshes.mixed_closed(), meshes.grid(4, 3, "mixed")])
def test_flat_quads_are_searched_as_their_triangles(mesh):
    surface = surface_of(mesh)
    points = some_points(surface)
    expected = distances_to_every(corners_of(surface), points)
    np.testing.assert_allclose(distances(surface, points), expected, rtol=1e-10, atol=1e-10)


def distances_to_each_quad(quads: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Bilinear patches by brute force, a column each: the best place of a grid, then of ever finer ones around it."""
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 33)] * 2), axis=-1).reshape(-1, 2)
    columns = []
    for a, b, c, d in quads:
        middle, half = np.full((len(points), 2), 0.5), 0.5
        for _ in range(8):
            uv = np.clip(middle[:, None] + half * steps, 0, 1)
            u, v = uv[..., :1], uv[..., 1:]
            on = (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d
            squared = ((on - points[:, None]) ** 2).sum(axis=-1)
            middle = uv[np.arange(len(points)), squared.argmin(axis=1)]
            half /= 8
        columns.append(np.sqrt(squared.min(axis=1)))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("bumpy", [0.05, 0.2])
def test_place_on_a_bent_quad_is_the_closest(bumpy):
    surface = surface_of(meshes.grid(3, 3, "quad", bumpy=bumpy))
    rng = np.random.default_rng(1)
    points = np.concatenate([some_points(surface)[:160], rng.uniform(-0.3, 3.3, (100, 3)) * (1, 1, 0.1)])
    quads = np.asarray(surface.vertices)[np.asarray(surface.faces[4])]
    to_each, found = distances_to_each_quad(quads, points), distances(surface, points)
    own = np.asarray(closest_points(surface, points).face)
    np.testing.assert_allclose(found, to_each[np.arange(len(points)), own], rtol=1e-6, atol=1e-6)
    # A patch leaves its two triangles by a quarter of its twist at most, so a neighbour is seldom nearer, and then by
    # no more than two quarters.
    a, b, c, d = np.moveaxis(quads, 1, 0)
    beyond = found - to_each.min(axis=1)
    assert np.all(beyond <= np.linalg.norm(a - b + c - d, axis=1).max() / 2) and np.mean(beyond > 1e-6) < 0.01


def distances_to_every_segment(starts: np.ndarray, ends: np.ndarray, points: np.ndarray) -> np.ndarray:
    along, away = ends - starts, points[:, None] - starts
    length = (along**2).sum(axis=-1)
    t = np.clip((away * along).sum(axis=-1) / np.where(length > 0, length, 1), 0, 1)
    return np.linalg.norm(away - t[..., None] * along, axis=-1).min(axis=1)


DEGENERATE = {
    "point": [(1, 2, 3)] * 3,
    "first edge": [(1, 2, 3), (1, 2, 3), (4, 2, 1)],
    "second edge": [(1, 2, 3), (4, 2, 1), (4, 2, 1)],
    "third edge": [(1, 2, 3), (4, 2, 1), (1, 2, 3)],
    "middle on the line": [(0, 0, 0), (0.5, 1, 1.5), (1, 2, 3)],
    "last on the line": [(0, 0, 0), (1, 2, 3), (0.5, 1, 1.5)],
    "first on the line": [(0.5, 1, 1.5), (0, 0, 0), (1, 2, 3)],
}


@pytest.mark.parametrize("shape", DEGENERATE)
def test_face_without_area_is_its_edges(shape):
    corners = np.array(DEGENERATE[shape], float)
    surface = surface_of((corners, [(0, 1, 2)]))
    points = np.random.default_rng(0).uniform(-3, 6, (100, 3))
    expected = distances_to_every_segment(corners, np.roll(corners, -1, axis=0), points)
    np.testing.assert_allclose(distances(surface, points), expected, rtol=1e-9)


def test_faces_without_area_do_not_hide_the_others():
    vertices, faces = meshes.grid(4, 4, "triangle", bumpy=0.3)
    sound, points = surface_of((vertices, faces)), some_points(surface_of((vertices, faces)))
    folded = surface_of((vertices, [(0, 0, 1), *faces, (7, 7, 7), (3, 4, 3)]))
    np.testing.assert_allclose(distances(folded, points), distances(sound, points), rtol=1e-12, atol=1e-12)


def test_quad_folded_to_a_triangle_or_a_line_is_found():
    vertices = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (5, 0, 0), (6, 0, 0)])
    surface = surface_of((vertices, [(0, 1, 2, 2), (3, 4, 4, 3)]))
    points = np.array([(0.2, 0.2, 1.0), (5.3, 1, 0), (7, 0, 0)])
    np.testing.assert_allclose(distances(surface, points), 1, atol=1e-9)


@pytest.mark.parametrize("at_once", [5, 300])
def test_many_points_go_in_parts_with_the_same_result(monkeypatch, at_once):
    surface = surface_of(TRIANGLES["one large among small"])
    points = some_points(surface)[::9]
    whole = closest_points(surface, points)
    monkeypatch.setattr(module, "_PAIRS_AT_ONCE", at_once)
    parts = closest_points(surface, points)
    np.testing.assert_array_equal(parts.face, whole.face)
    np.testing.assert_array_equal(parts.uv, whole.uv)


@pytest.mark.parametrize("shape", ["open", "needles", "one large among small"])
def test_place_of_a_point_does_not_depend_on_the_other_points(shape):
    surface = surface_of(TRIANGLES[shape])
    points = some_points(surface)
    whole = closest_points(surface, points)
    for rows in ([7], np.arange(3, len(points), 5), np.arange(len(points))[::-1]):
        some = closest_points(surface, points[rows])
        np.testing.assert_array_equal(some.face, np.asarray(whole.face)[rows])
        np.testing.assert_array_equal(some.uv, np.asarray(whole.uv)[rows])


def test_of_equally_near_faces_the_first_is_found():
    vertices, faces = meshes.octahedron()
    rng = np.random.default_rng(2)
    order = [faces[i] for i in rng.permutation(len(faces))]
    points = np.concatenate([vertices * 3, np.zeros((1, 3))])
    at = closest_points(surface_of((vertices, order)), points)
    holding = [min(f for f, face in enumerate(order) if v in face) for v in range(len(vertices))]
    np.testing.assert_array_equal(at.face, [*holding, 0])
    twice = closest_points(surface_of((vertices, [*order, *order])), some_points(surface_of((vertices, order))))
    assert np.asarray(twice.face).max() < len(order)


def test_surface_far_from_the_origin_is_searched_exactly():
    vertices, faces = TRIANGLES["torus"]
    surface = surface_of((vertices + 1e6, faces))
    points = some_points(surface)
    expected = distances_to_every(corners_of(surface) - 1e6, points - 1e6)
    np.testing.assert_allclose(distances(surface, points), expected, rtol=1e-9, atol=1e-8)


def test_no_points_have_no_places():
    at = closest_points(surface_of(TRIANGLES["torus"]), np.zeros((0, 3)))
    assert at.face.shape == (0,) and at.uv.shape == (0, 2)


@pytest.mark.parametrize("off", [0.0, 0.3, 40.0])
def test_refined_surface_is_searched_exactly_near_and_far(off):
    mesh = js.ControlMesh(*stretched(meshes.torus(8, 6, "triangle"), 10, 10, 10))
    topology = js.build_topology(mesh, js.Interpolating(), 2)
    surface = js.refine(js.Interpolating(), topology, mesh.control())
    rng = np.random.default_rng(4)
    at = js.SurfacePoint(rng.integers(surface.n_faces, size=120), rng.uniform(0.0, 0.5, (120, 2)))
    on, normals = js.evaluate(surface, at)
    points = np.asarray(on + off * normals) + rng.normal(scale=0.05, size=(120, 3))
    points[::20] = rng.uniform(-80, 80, (6, 3))  # few that are farther than the others
    expected = distances_to_every(corners_of(surface), points)
    np.testing.assert_allclose(distances(surface, points), expected, rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("kind", ["quad", "triangle", "mixed"])
def test_place_on_the_surface_is_found_again(kind):
    surface = surface_of(meshes.grid(6, 5, kind, bumpy=0.1))
    rng = np.random.default_rng(3)
    face = np.arange(surface.n_faces)
    uv = rng.uniform(0.05, 0.45, (surface.n_faces, 2))
    on = js.evaluate(surface, js.SurfacePoint(face, uv)).points
    found = closest_points(surface, np.asarray(on))
    np.testing.assert_array_equal(found.face, face)
    np.testing.assert_allclose(found.uv, uv, atol=1e-9)


def test_single_precision_surface_is_searched_in_double():
    mesh = TRIANGLES["torus"]
    surface, points = surface_of(mesh, np.float32), some_points(surface_of(mesh))
    found = closest_points(surface, points)
    assert found.uv.dtype == np.float32 and found.face.dtype == np.int32
    expected = closest_points(surface_of((np.asarray(surface.vertices, np.float64), mesh[1])), points)
    np.testing.assert_array_equal(found.face, expected.face)
    np.testing.assert_array_equal(found.uv, np.asarray(expected.uv, np.float32))


@pytest.mark.parametrize("mesh", [meshes.octahedron(), meshes.cube(), meshes.torus(5, 4), meshes.two_components()])
def test_closed_surface_has_no_boundary_vertices(mesh):
    assert not boundary_vertices(surface_of(mesh)).any()


@pytest.mark.parametrize("kind", ["quad", "triangle", "mixed"])
def test_boundary_vertices_of_a_sheet_are_its_rim(kind):
    vertices, faces = meshes.grid(4, 3, kind)
    rim = np.isin(vertices[:, 0], (0, 4)) | np.isin(vertices[:, 1], (0, 3))
    unused = np.append(vertices, [(9, 9, 9)], axis=0), faces
    np.testing.assert_array_equal(boundary_vertices(surface_of(unused)), np.append(rim, False))
