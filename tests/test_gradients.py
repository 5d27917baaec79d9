"""Derivatives in the vertices, the normals and h, of every scheme, where they are smooth and where they are not.

One level holds every rule and puts out the normals too. The operations run one by one, on batches of one size: they are
compiled once for all schemes, while compiling each scheme's second derivatives whole would take minutes.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from schemes import Case, by_name, control_mesh, over_cases, random_control

import jaxsubdiv as js
from jaxsubdiv._scheme.circle_preserving import arc_factor

BATCH = 12
STEP = 1e-5
VERTICES, FACES = meshes.pyramid()
MESH = (VERTICES, FACES[:-1])  # a quad and three triangles, with edges inside and on the boundary
# The like for schemes that take one kind of faces only.
MESHES = {
    (3, 4): MESH,
    (3,): (VERTICES, [(3, 2, 1), (3, 1, 0), *FACES[1:-1]]),
    (4,): (np.array([(0, 0, 0), (2, 0, 0.4), (2, 2, 0), (0, 2, 0.2), (4, 0, 0.6)]), [(0, 1, 2, 3), (1, 4, 3, 2)]),
}

Point = tuple[js.AbstractScheme, js.Control]


class Derivatives(NamedTuple):
    """A batch of: points and normals put out, stacked; their derivative along `along`; the gradient of their product
    with fixed random weights; and the derivative of that along `along`."""

    at: Point
    along: Point
    value: jax.Array
    tangent: jax.Array
    weights: np.ndarray
    gradient: Point
    hessian_vector: Point


def derivatives(case: Case, at: list[Point], along: list[Point]) -> Derivatives:
    topology = js.build_topology(control_mesh(MESHES[case.scheme.takes]), case.scheme, 1)
    n = jax.eval_shape(js.refine, at[0][0], topology, at[0][1]).vertices.shape[0]
    weights = np.random.default_rng(0).normal(size=(2 * n, 3))

    def refined(scheme: js.AbstractScheme, control: js.Control) -> jax.Array:
        surface = js.refine(scheme, topology, control)
        return jnp.concatenate([surface.vertices, surface.normals])

    def gradient(*at: Any) -> Point:
        return jax.grad(lambda at: jnp.vdot(weights, refined(*at)))(at)

    def all_at(at: Point, along: Point) -> tuple:
        return jax.jvp(refined, at, along), jax.jvp(gradient, at, along)

    pad = BATCH - len(at)
    at, along = (jax.tree.map(lambda *rows: jnp.stack(rows), *points, *points[:1] * pad) for points in (at, along))
    with jax.disable_jit():
        (value, tangent), (slope, hessian_vector) = jax.vmap(all_at)(at, along)
    return Derivatives(at, along, value, tangent, weights, slope, hessian_vector)


def point(case: Case, control: js.Control) -> Point:
    h = case.scheme.h
    return (case.scheme if h is None or h.ndim == 0 else dataclasses.replace(case.scheme, h=h[:1])), control


def moved(at: Point, along: Point, step: float) -> Point:
    return jax.tree.map(lambda x, dx: x + step * dx, at, along)


@functools.cache
def at_random(name: str) -> Derivatives:
    """Rows 3 i, 3 i + 1, 3 i + 2: a random point, and the same a step ahead and a step back along direction i: h, the
    vertices, the normals, and all of them, where the scheme depends on them."""
    case = by_name(name)
    at = point(case, random_control(MESHES[case.scheme.takes], seed=0, bumps=0.2))
    rng = np.random.default_rng(1)
    leaves = [rng.normal(size=leaf.shape) for leaf in jax.tree.leaves(at)]
    used = range(len(leaves) if case.scheme.uses_normals else len(leaves) - 1)  # the normals come last
    chosen = [[i] for i in used] + [list(used)] * 4
    parts = [[leaf * (i in some) for i, leaf in enumerate(leaves)] for some in chosen[: BATCH // 3]]
    along = [jax.tree.unflatten(jax.tree.structure(at), list(map(jnp.asarray, part))) for part in parts]
    steps = [(t, step) for t in along for step in (0.0, STEP, -STEP)]
    return derivatives(case, [moved(at, t, step) for t, step in steps], [t for t, _ in steps])


def rows(tree: Any) -> np.ndarray:
    """The leaves of a batch, side by side."""
    return np.concatenate([np.reshape(leaf, (BATCH, -1)) for leaf in jax.tree.leaves(tree)], axis=1)


@over_cases()
def test_first_derivatives_agree_with_central_differences(case):
    d = at_random(case.name)
    differences = (d.value[1::3] - d.value[2::3]) / (2 * STEP)
    assert np.all(np.abs(d.tangent[::3]).max(axis=(1, 2)) > 1e-2)
    np.testing.assert_allclose(d.tangent[::3], differences, rtol=0, atol=1e-7)


@over_cases()
def test_forward_and_reverse_mode_agree(case):
    d = at_random(case.name)
    forward = np.sum(np.asarray(d.tangent) * d.weights, axis=(1, 2))
    reverse = np.sum(rows(d.gradient) * rows(d.along), axis=1)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


@over_cases()
def test_second_derivatives_agree_with_differences_of_the_first(case):
    d = at_random(case.name)
    slopes = rows(d.gradient)
    differences = (slopes[1::3] - slopes[2::3]) / (2 * STEP)
    assert np.all(np.abs(differences[1:]).max(axis=1) > 1e-2)
    np.testing.assert_allclose(rows(d.hessian_vector)[::3], differences, rtol=0, atol=1e-6)


@over_cases(uses_normals=True)
def test_length_of_a_normal_is_a_null_direction(case):
    d = at_random(case.name)
    slopes, normals = d.gradient[1].normals, d.at[1].normals
    assert np.abs(slopes).max() > 1e-2
    np.testing.assert_allclose(np.sum(slopes * normals, axis=-1), 0, atol=1e-12)


def _corners() -> dict[str, js.Control]:
    """Controls at which one formula or the other has no derivative."""
    start = random_control(MESH, seed=0)
    x, n = start.vertices, start.normals
    along_edge = n.at[0].set(x[1] - x[0]).at[1].set(x[1] - x[0])
    folded = js.Control(x.at[2].set(x[0]), n.at[2].set(n[0]))  # two triangles back to back, and a quad without area
    opposite = js.Control(x, n.at[1].set(-n[0]))
    return {
        "zero normal": js.Control(x, n.at[0].set(0.0)),
        "zero normals": js.Control(x, 0 * n),
        "normals along an edge": js.Control(x, along_edge),
        "opposite normals": opposite,
        "coincident vertices": js.Control(x.at[1].set(x[0]), n),
        "folded": folded,
        "all on a line": js.Control(x * np.array([[1.0, 0.0, 0.0]]), n),
        "all at one spot": js.Control(0 * x + x[:1], n),
        "all at the origin, zero normals": js.Control(0 * x, 0 * n),
    }


CORNERS = _corners()


@functools.cache
def at_corners(name: str) -> Derivatives:
    """One row for each of `CORNERS`."""
    case = by_name(name)
    at = [point(case, control) for control in CORNERS.values()]
    ones = jax.tree.map(jnp.ones_like, at[0])
    return derivatives(case, at, [ones] * len(at))


@pytest.mark.parametrize("corner", CORNERS)
@over_cases()
def test_derivatives_are_finite_where_formulas_have_none(case, corner):
    d, row = at_corners(case.name), list(CORNERS).index(corner)
    for part in (d.value, d.tangent, d.gradient, d.hessian_vector):
        assert np.isfinite(rows(part)[row]).all()
    # Nothing is divided by a length that vanishes: a guard that only just holds would leave a huge number here.
    assert np.abs(rows(d.gradient)[row]).max() < 1e4


@over_cases(tables_for="points and normals")
def test_normal_is_that_of_the_parents_where_the_sum_vanishes(case):
    d, row = at_corners(case.name), list(CORNERS).index("folded")
    level = js.build_topology(control_mesh(MESH), case.scheme, 1).levels[0]
    normals = d.value[row, d.value.shape[1] // 2 :]
    parents = np.asarray(CORNERS["folded"].normals)
    parents = parents / np.linalg.norm(parents, axis=1, keepdims=True)
    back_to_back = np.flatnonzero((np.sort(level.edges, axis=1) == (1, 4)).all(axis=1))
    for vertex, of in ((len(VERTICES) + back_to_back[0], [1, 4]), (-1, [0, 1, 2, 3])):
        mean = parents[of].sum(axis=0)
        np.testing.assert_allclose(normals[vertex], mean / np.linalg.norm(mean), rtol=0, atol=1e-14)


@over_cases(uses_normals=True)
def test_gradient_is_zero_in_a_zero_normal(case):
    d = at_corners(case.name)
    one, every = (list(CORNERS).index(name) for name in ("zero normal", "zero normals"))
    assert not np.any(d.gradient[1].normals[one, 0]) and np.any(d.gradient[1].normals[one, 1])
    assert not np.any(d.gradient[1].normals[every])
    assert case.scheme.h is None or not np.any(d.gradient[0].h[every])


@pytest.mark.parametrize("degrees", [0, 60, 119, 121, 180])
def test_circle_factor_is_flat_beyond_120_degrees_only(degrees):
    angle = np.radians(degrees)
    n_a, n_b = jnp.array([[1.0, 0.0, 0.0]]), jnp.array([[np.cos(angle), np.sin(angle), 0.0]])
    factor, slope = jax.value_and_grad(lambda n: arc_factor(n, n_b)[0, 0])(n_a)
    cosine = np.cos(min(angle, np.radians(120)) / 2)
    np.testing.assert_allclose(factor, 2 / (cosine * (1 + cosine)), rtol=1e-12)
    assert np.any(slope) == (degrees < 120)


@pytest.mark.parametrize(("name", "levels"), [("default", 2), ("circle", 1), ("loop", 2)])
def test_compiled_gradients_of_a_batch_agree_with_central_differences(name, levels):
    case = by_name(name)
    mesh = MESHES[case.scheme.takes]
    topology = js.build_topology(control_mesh(mesh), case.scheme, levels)
    at = point(case, random_control(mesh, seed=2, bumps=0.2))
    rng = np.random.default_rng(3)
    along = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), at)

    @jax.jit
    @jax.vmap
    def value_and_slope(at: Point) -> tuple:
        return jax.value_and_grad(lambda at: jnp.sum(jnp.sin(js.refine(at[0], topology, at[1]).vertices)))(at)

    batch = jax.tree.map(lambda *rows: jnp.stack(rows), *(moved(at, along, s * STEP) for s in (0, 1, -1)))
    values, slopes = value_and_slope(batch)
    slope = sum(jax.tree.leaves(jax.tree.map(lambda s, t: jnp.vdot(s[0], t), slopes, along)))
    np.testing.assert_allclose(slope, (values[1] - values[2]) / (2 * STEP), rtol=0, atol=1e-7)


@over_cases()
def test_rows_of_a_batch_run_one_by_one_equal_compiled_single_runs(case):
    d = at_random(case.name)
    topology = js.build_topology(control_mesh(MESHES[case.scheme.takes]), case.scheme, 1)
    for row in (0, 7):
        scheme, control = jax.tree.map(lambda leaf, row=row: leaf[row], d.at)
        surface = js.refine(scheme, topology, control)
        single = np.concatenate([surface.vertices, surface.normals])
        np.testing.assert_allclose(single, d.value[row], rtol=0, atol=1e-14)
