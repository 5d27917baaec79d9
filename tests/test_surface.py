"""The refined surface: triangles, areas, bounding box, evaluation and sampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxsubdiv as js
from jaxsubdiv._surface import sample_surface_points

STEP = 1e-6
# A bent quad beside a triangle; vertex 5 is in no face.
VERTICES = np.array([(0, 0, 0), (2, 0, 0), (2, 1, 1), (0, 1, 0), (4, 0, 0), (9, 9, 9)], dtype=np.float64)
NORMALS = np.array([(0, 0, 1), (0, 0.6, 0.8), (0.6, 0, 0.8), (0, 0, 1), (0, 1, 0), (1, 0, 0)])
TRIANGLES, QUADS = np.array([(1, 4, 2)], np.int32), np.array([(0, 1, 2, 3)], np.int32)
FACES = {
    "both": {3: TRIANGLES, 4: QUADS},
    "triangles": {3: TRIANGLES, 4: QUADS[:0]},
    "quads": {3: TRIANGLES[:0], 4: QUADS},
}
QUAD_HALVES = [(0, 1, 2), (0, 2, 3)]


def surface(faces: str = "both", vertices: np.ndarray | jax.Array = VERTICES) -> js.RefinedSurface:
    tables = {size: jnp.asarray(rows) for size, rows in FACES[faces].items()}
    return js.RefinedSurface(jnp.asarray(vertices), jnp.asarray(NORMALS), tables)


def area(*corners: int) -> float:
    a, b, c = VERTICES[list(corners)]
    return np.linalg.norm(np.cross(b - a, c - a)) / 2


@pytest.mark.parametrize(
    ("faces", "expected"),
    [("both", [(1, 4, 2), *QUAD_HALVES]), ("triangles", [(1, 4, 2)]), ("quads", QUAD_HALVES)],
)
def test_triangles_are_the_triangles_then_the_halves_of_the_quads(faces, expected):
    assert np.array_equal(surface(faces).triangles(), expected)
    assert surface(faces).n_faces == sum(map(len, FACES[faces].values()))


def test_areas_of_a_quad_are_those_of_its_halves():
    whole = area(0, 1, 2) + area(0, 2, 3)
    np.testing.assert_allclose(surface().areas(), [area(1, 4, 2), whole], rtol=1e-14)
    np.testing.assert_allclose(surface("quads").areas(), [whole], rtol=1e-14)
    np.testing.assert_allclose(surface("triangles").areas(), [area(1, 4, 2)], rtol=1e-14)


def test_areas_follow_the_order_of_the_faces():
    quads = jnp.asarray([(0, 1, 2, 3), (1, 4, 5, 2)], jnp.int32)
    many = js.RefinedSurface(jnp.asarray(VERTICES), jnp.asarray(NORMALS), {3: jnp.asarray(TRIANGLES), 4: quads})
    halves = [(area(0, 1, 2) + area(0, 2, 3)), (area(1, 4, 5) + area(1, 5, 2))]
    np.testing.assert_allclose(many.areas(), [area(1, 4, 2), *halves], rtol=1e-14)


def test_bounding_box_leaves_unused_vertices_out():
    assert np.array_equal(surface().bounding_box(), [(0, 0, 0), (4, 1, 1)])
    assert np.array_equal(surface("quads").bounding_box(), [(0, 0, 0), (2, 1, 1)])


CORNERS = {(0, 0.0, 0.0): 1, (0, 1.0, 0.0): 4, (0, 0.0, 1.0): 2} | {
    (1, u, v): corner for (u, v), corner in {(0.0, 0.0): 0, (1.0, 0.0): 1, (1.0, 1.0): 2, (0.0, 1.0): 3}.items()
}


@pytest.mark.parametrize(("face", "u", "v"), CORNERS)
def test_corners_of_a_face_are_its_vertices(face, u, v):
    at = js.evaluate(surface(), js.SurfacePoint(face, (u, v)))
    assert np.array_equal(at.points, VERTICES[CORNERS[face, u, v]])
    np.testing.assert_allclose(at.normals, NORMALS[CORNERS[face, u, v]], rtol=0, atol=1e-15)


def test_points_between_corners_are_linear_or_bilinear():
    at = js.evaluate(surface(), js.SurfacePoint([[0], [1]], [[(0.2, 0.3)], [(0.2, 0.3)]]))
    weights = np.array([0.5, 0.2, 0.3]), np.array([0.8 * 0.7, 0.2 * 0.7, 0.2 * 0.3, 0.8 * 0.3])
    for row, (corners, weight) in enumerate(zip(([1, 4, 2], [0, 1, 2, 3]), weights, strict=True)):
        normal = weight @ NORMALS[corners]
        np.testing.assert_allclose(at.points[row, 0], weight @ VERTICES[corners], rtol=0, atol=1e-15)
        np.testing.assert_allclose(at.normals[row, 0], normal / np.linalg.norm(normal), rtol=0, atol=1e-15)


@pytest.mark.parametrize(("faces", "face"), [("triangles", 0), ("quads", 0)])
def test_meshes_of_one_kind_evaluate(faces, face):
    at = js.evaluate(surface(faces), js.SurfacePoint(face, (0.5, 0.5)))
    corners = [4, 2] if faces == "triangles" else [0, 1, 2, 3]
    np.testing.assert_allclose(at.points, VERTICES[corners].mean(axis=0), rtol=0, atol=1e-15)


def test_evaluation_is_differentiable_in_the_surface_and_in_uv():
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(2, 2, 3))

    def value(vertices: jax.Array, normals: jax.Array, uv: jax.Array) -> jax.Array:
        at = js.evaluate(js.RefinedSurface(vertices, normals, surface().faces), js.SurfacePoint(jnp.array([0, 1]), uv))
        return jnp.vdot(weights, jnp.stack(at))

    start = jnp.asarray(VERTICES), jnp.asarray(NORMALS), jnp.array([(0.2, 0.3), (0.4, 0.7)])
    slopes = jax.jit(jax.grad(value, argnums=(0, 1, 2)))(*start)
    value = jax.jit(value)
    for i, slope in enumerate(slopes):
        along = jnp.asarray(rng.normal(size=slope.shape))
        ahead, back = ((*start[:i], start[i] + s * STEP * along, *start[i + 1 :]) for s in (1, -1))
        difference = (value(*ahead) - value(*back)) / (2 * STEP)
        assert abs(difference) > 0.1
        np.testing.assert_allclose(jnp.vdot(slope, along), difference, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("faces", "pieces"),
    [("both", [(1, 4, 2), *QUAD_HALVES]), ("triangles", [(1, 4, 2)]), ("quads", QUAD_HALVES)],
)
def test_samples_are_uniform_by_area(faces, pieces):
    flat = VERTICES * (1, 1, 0)
    points = np.asarray(js.sample(surface(faces, flat), 20_000, jax.random.key(1)).points)
    counts, shares = [], []
    for piece in pieces:
        a, b, c = flat[list(piece), :2]
        sides = np.stack([b - a, c - a], axis=1)
        inside = (points[:, :2] - a) @ np.linalg.inv(sides).T
        barycentric = np.column_stack([1 - inside.sum(axis=1), inside])
        barycentric = barycentric[(barycentric > 0).all(axis=1)]
        at_corners = (barycentric > 0.5).sum(axis=0)  # three of the four parts that the middles of the sides cut
        counts += [*at_corners, len(barycentric) - at_corners.sum()]
        shares += 4 * [np.linalg.det(sides)]
    assert sum(counts) == len(points)
    expected = np.array(shares) / sum(shares) * len(points)
    assert scipy.stats.chisquare(counts, expected).pvalue > 1e-3


def test_halves_of_a_quad_are_drawn_by_their_areas():
    kite = np.array([(0, 0, 0), (1, 0, 0), (3, 3, 0), (0, 1, 0), (0, 0, 0), (0, 0, 0)], dtype=np.float64) * (1, 0.2, 1)
    kite[1] = (3, 0, 0)
    drawn = sample_surface_points(surface("quads", kite), 20_000, jax.random.key(2))
    in_first = np.mean(np.asarray(drawn.uv[:, 0] > drawn.uv[:, 1]))
    sizes = [np.linalg.norm(np.cross(kite[b] - kite[a], kite[c] - kite[a])) for a, b, c in QUAD_HALVES]
    assert abs(sizes[0] - sizes[1]) > 0.3 * sum(sizes) / 2
    assert abs(in_first - sizes[0] / sum(sizes)) < 5 * 0.5 / np.sqrt(20_000)


def test_samples_follow_the_surface_at_fixed_places():
    def mean_height(scale: jax.Array) -> jax.Array:
        return js.sample(surface(vertices=scale * jnp.asarray(VERTICES)), 100, jax.random.key(3)).points[:, 2].mean()

    at_one, slope = jax.value_and_grad(mean_height)(jnp.asarray(1.0))
    np.testing.assert_allclose(slope, at_one, rtol=1e-12)
