"""Closest points inside of compiled programs: the same places as the search on the host, which is tested elsewhere."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

import fitting
import jaxsubdiv as js

TOLERANCE = {np.float32: 1e-6, np.float64: 1e-9}


def surface_of(mesh: meshes.Mesh, dtype: type, levels: int = 2, seed: int = 0) -> js.RefinedSurface:
    """A refined surface with a little roughness, so that no two of its faces are equally near."""
    vertices, faces = mesh
    control = js.ControlMesh(vertices, sorted(faces, key=len))
    fine = js.refine(js.Interpolating(), js.build_topology(control, js.Interpolating(), levels), control.control())
    rough = np.random.default_rng(seed).normal(scale=0.003, size=fine.vertices.shape)
    return js.RefinedSurface(*((rows + rough).astype(dtype) for rows in (fine.vertices, fine.normals)), fine.faces)


def some_points(surface: js.RefinedSurface, n: int = 150) -> np.ndarray:
    """On the surface, near it, around it and far away."""
    rng = np.random.default_rng(1)
    x = np.asarray(surface.vertices)
    near = x[rng.integers(len(x), size=n)]
    size = np.ptp(x, axis=0).max()
    around = rng.uniform(x.min(axis=0) - size / 4, x.max(axis=0) + size / 4, (n, 3))
    rows = [near, near + rng.normal(scale=0.02 * size, size=near.shape), around, 30 * rng.normal(size=(9, 3)) * size]
    return np.concatenate(rows).astype(x.dtype)


def distances(surface: js.RefinedSurface, at: js.SurfacePoint, points: np.ndarray) -> np.ndarray:
    wide = js.RefinedSurface(*(rows.astype(np.float64) for rows in (surface.vertices, surface.normals)), surface.faces)
    on = js.evaluate(wide, js.SurfacePoint(at.face, at.uv.astype(np.float64))).points
    return np.linalg.norm(np.asarray(on) - np.asarray(points, np.float64), axis=1)


MESHES = {
    "closed": meshes.torus(8, 6, "triangle"),
    "open": meshes.grid(5, 4, "triangle", bumpy=0.4),
    "quads": meshes.torus(8, 6, "quad"),
    "mixed": meshes.mixed_closed(),
    "mixed, open": meshes.grid(4, 3, "mixed", bumpy=0.3),
}


CASES = [*((shape, np.float64) for shape in MESHES), ("mixed", np.float32)]


@pytest.mark.parametrize(("shape", "dtype"), CASES)
def test_places_are_those_of_the_host(shape, dtype):
    surface = surface_of(MESHES[shape], dtype)
    points = some_points(surface)
    found, expected = js.search_closest(surface, jnp.asarray(points)), fitting.closest_points(surface, points)
    assert found.face.dtype == np.int32 and found.uv.dtype == dtype
    own, host = (distances(surface, at, points) for at in (found, expected))
    size = np.linalg.norm(points, axis=1) + np.ptp(surface.vertices, axis=0).max()
    # Beyond an edge or a vertex several faces are equally near, as at the vertices, with which the points begin. Of two
    # bent quads, equally near as triangles, one is nearer: by a quarter of their twist at most.
    same = np.asarray(found.face) == np.asarray(expected.face)
    assert np.mean(same[150:300]) > 0.5
    corners = np.asarray(surface.vertices)[np.asarray(surface.faces[4])]
    twist = np.linalg.norm(np.einsum("qkx,k->qx", corners, (1, -1, 1, -1)), axis=1)
    allowed = TOLERANCE[dtype] * size + np.where(same, 0, twist.max(initial=0) / 4)
    assert np.all(np.abs(own - host) <= allowed)


def test_patches_and_blocks_of_any_size_find_the_same():
    surface = surface_of(MESHES["mixed"], np.float64)
    points = jnp.asarray(some_points(surface)[::7])
    expected = distances(surface, js.search_closest(surface, points), points)
    for options in ({"patch": 7}, {"patch": 10_000}, {"memory": 1 << 16}):
        found = js.search_closest(surface, points, **options)
        np.testing.assert_allclose(distances(surface, found, points), expected, rtol=1e-12, atol=1e-12)


def test_many_surfaces_at_once_are_searched_as_one_by_one():
    surface = surface_of(MESHES["mixed, open"], np.float64)
    points = some_points(surface, 40)
    vertices = jnp.stack([surface.vertices, surface.vertices * 1.5, surface.vertices + 2.0])
    scans = jnp.stack([points, points + 1.0, points * 0.5])

    def search(vertices, points):
        return js.search_closest(js.RefinedSurface(vertices, surface.normals, surface.faces), points)

    together = jax.jit(jax.vmap(search))(vertices, scans)
    for i in range(len(scans)):
        alone = search(vertices[i], scans[i])
        np.testing.assert_array_equal(together.face[i], alone.face)
        np.testing.assert_allclose(together.uv[i], alone.uv, atol=1e-12)


def test_points_that_are_not_finite_do_not_keep_the_others_waiting():
    surface = surface_of(MESHES["closed"], np.float64)
    points = some_points(surface, 20)
    broken = points.copy()
    broken[3], broken[10] = np.nan, np.inf
    found, expected = (js.search_closest(surface, jnp.asarray(rows)) for rows in (broken, points))
    others = np.setdiff1d(np.arange(len(points)), (3, 10))
    np.testing.assert_array_equal(found.face[others], expected.face[others])
    assert np.all((np.asarray(found.face) >= 0) & (np.asarray(found.face) < surface.n_faces))


def test_faces_without_area_do_not_hide_the_others():
    vertices, faces = meshes.grid(4, 4, "triangle", bumpy=0.3)
    by_size = {3: np.array([(0, 0, 1), *faces, (7, 7, 7), (3, 4, 3)], np.int32), 4: np.zeros((0, 4), np.int32)}
    surface = js.RefinedSurface(
        *(jnp.asarray(rows) for rows in (vertices, vertices)), jax.tree.map(jnp.asarray, by_size)
    )
    points = some_points(surface, 50)
    found, expected = js.search_closest(surface, jnp.asarray(points)), fitting.closest_points(surface, points)
    np.testing.assert_allclose(*(distances(surface, at, points) for at in (found, expected)), rtol=1e-9, atol=1e-12)
