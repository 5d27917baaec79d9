"""The layer: the surface of `refine` for every shape and dtype, under every transformation; h stays in its range."""

import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest

import jaxsubdiv as js

VERTICES, FACES = meshes.octahedron()
MESH = js.ControlMesh(VERTICES, FACES)
TOPOLOGY = js.build_topology(MESH, js.Interpolating(), 1)
LAYER = js.SurfaceLayer(js.Interpolating(), TOPOLOGY)
X, N = MESH.control().vertices, MESH.control().normals
BATCH = X[None] + 0.1 * jnp.asarray(np.random.default_rng(0).normal(size=(2, 6, 3)))
call = eqx.filter_jit(lambda layer, *control: layer(*control))


def test_it_is_refine_for_any_leading_axes():
    expected = js.refine(js.Interpolating(), TOPOLOGY, MESH.control())
    for found in (call(LAYER, X, N), call(LAYER, X)):  # without normals: those of the control faces
        np.testing.assert_allclose(found.vertices, expected.vertices, rtol=1e-12)
        np.testing.assert_allclose(found.normals, expected.normals, atol=1e-12)
    batch = call(LAYER, BATCH[None])
    assert batch.vertices.shape == batch.normals.shape == (1, 2, 18, 3) and batch.faces[3].shape == (32, 3)
    for i in range(2):
        np.testing.assert_allclose(batch.vertices[0, i], call(LAYER, BATCH[i]).vertices, rtol=1e-12, atol=1e-15)
    by_vmap = eqx.filter_jit(eqx.filter_vmap(LAYER))(BATCH)
    np.testing.assert_allclose(by_vmap.vertices, batch.vertices[0], rtol=1e-12, atol=1e-15)
    shared = call(LAYER, BATCH, N)  # one set of normals for all
    np.testing.assert_allclose(shared.normals[1], call(LAYER, BATCH[1], N).normals, atol=1e-12)


def test_different_meshes_are_refined_at_once():
    meshes_ = [MESH, js.ControlMesh(*meshes.tetrahedron())]
    alone = [js.build_topology(mesh, js.Interpolating(), 1) for mesh in meshes_]
    stacked = js.stack_topologies(alone)
    layer, there = js.SurfaceLayer(js.Interpolating(), stacked), np.asarray(stacked.real.control_vertices)
    rows = jnp.stack([js.pad_control(stacked, mesh.control()).vertices for mesh in meshes_])
    cloud = jnp.asarray(np.random.default_rng(1).normal(size=(2, 20, 3)))

    @jax.jit
    def find(layer, rows):
        def losses(rows):
            surfaces = layer(rows)
            each = js.losses.chamfer_distance(surfaces, cloud) + js.losses.inverted_faces(surfaces, margin=2.0)
            return jnp.sum(each), (surfaces, each)

        return jax.grad(losses, has_aux=True)(rows)

    spoilt = jnp.where(there[..., None], rows, 7.0)  # a network predicts anything there
    slope, (surfaces, each) = find(layer, spoilt)
    assert np.all(slope[~there] == 0) and np.isfinite(slope).all() and np.all(slope[there] != 0, axis=1).any()
    for i, mesh in enumerate(meshes_):
        one = js.refine(js.Interpolating(), alone[i], mesh.control())
        padded = jax.tree.map(lambda leaf, i=i: leaf[i], (stacked, surfaces))
        real = js.cut_padding(*padded)
        np.testing.assert_allclose(real.vertices, one.vertices, atol=1e-12)
        np.testing.assert_allclose(real.normals, one.normals, atol=1e-12)
    expected = js.losses.chamfer_distance(one, cloud[1]) + js.losses.inverted_faces(one, margin=2.0)
    np.testing.assert_allclose(each[1], expected, rtol=1e-9)


def test_narrow_numbers_are_widened_inside():
    narrow = X.astype(jnp.bfloat16)
    found = call(LAYER, narrow)
    assert found.vertices.dtype == found.normals.dtype == jnp.float32
    expected = call(LAYER, narrow.astype(jnp.float32))
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    slope = jax.grad(lambda x: jnp.sum(LAYER(x).vertices ** 2))(narrow)
    assert slope.dtype == jnp.bfloat16 and np.isfinite(slope.astype(jnp.float32)).all()
    assert call(LAYER, narrow, N).vertices.dtype == jnp.float64


def test_h_is_trained_within_its_range():
    layer = js.SurfaceLayer(js.Interpolating([0.7]), TOPOLOGY, train_h=True, h_range=(0.5, 1.5))
    np.testing.assert_allclose(layer.scheme.h, [0.7])
    for parameter, end in ((-1e3, 0.5), (1e3, 1.5)):
        at_end = eqx.tree_at(lambda layer: layer.parameter, layer, jnp.full(1, parameter))
        np.testing.assert_allclose(at_end.scheme.h, end)
        assert np.isfinite(eqx.filter_grad(lambda layer: layer.scheme.h.sum())(at_end).parameter).all()

    @eqx.filter_jit
    def size(layer):
        return jnp.mean(jnp.sum(layer(X, N).vertices ** 2, axis=1))

    step = 1e-6
    ahead, back = (size(eqx.tree_at(lambda layer: layer.parameter, layer, jnp.full(1, s))) for s in (step, -step))
    np.testing.assert_allclose(eqx.filter_grad(size)(layer).parameter[0], (ahead - back) / (2 * step), rtol=1e-7)


@pytest.mark.parametrize("scheme", [js.Interpolating(0.8), js.Loop()], ids=["with h", "with weights"])
def test_what_is_fixed_is_no_parameter(scheme):
    topology = js.build_topology(MESH, scheme, 1)
    layer = js.SurfaceLayer(scheme, topology)
    assert not jax.tree.leaves(eqx.filter(layer, eqx.is_inexact_array))
    expected = js.refine(scheme, topology, MESH.control())
    np.testing.assert_allclose(call(layer, X).vertices, expected.vertices, rtol=1e-12)
    assert eqx.tree_equal(layer.topology, topology) and eqx.tree_equal(layer.scheme, scheme)
    with_h = js.SurfaceLayer(js.Interpolating(0.8), TOPOLOGY, train_h=True)
    assert len(jax.tree.leaves(eqx.filter(with_h, eqx.is_inexact_array))) == 1


def test_it_learns_inside_of_a_scan():
    """Steepest descent on an encoder of one matrix and on h, all of it one compiled program."""
    layer = js.SurfaceLayer(js.Interpolating(0.8), TOPOLOGY, train_h=True)
    goal = js.SurfaceLayer(js.Interpolating(1.3), TOPOLOGY)(jnp.einsum("...vx,xy->...vy", BATCH, jnp.diag(X[4] + 1)))

    @eqx.filter_jit
    def train(model, goal):
        of_arrays, rest = eqx.partition(model, eqx.is_inexact_array)

        def loss(of_arrays):
            matrix, layer = eqx.combine(of_arrays, rest)
            found = layer(jnp.einsum("...vx,xy->...vy", BATCH, matrix))
            return jnp.mean((found.vertices - goal.vertices) ** 2)

        def step(of_arrays, _):
            value, slope = jax.value_and_grad(loss)(of_arrays)
            return jax.tree.map(lambda p, g: p - (1.0 if p.ndim else 30.0) * g, of_arrays, slope), value

        return jax.lax.scan(step, of_arrays, length=300)

    (_, trained), values = train((jnp.eye(3), layer), goal)
    h = eqx.combine(trained, layer).scheme.h
    assert values[-1] < 1e-3 * values[0] and abs(h - 1.3) < 0.1


_ON_EIGHT_DEVICES = """
import jax, jax.numpy as jnp, jaxsubdiv as js, numpy as np
from jax.sharding import PartitionSpec as P
assert len(jax.devices()) == 8
corners = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
sides = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (1, 0, 5), (2, 1, 5), (3, 2, 5), (0, 3, 5)]
mesh = js.ControlMesh(corners, sides)
layer = js.SurfaceLayer(js.Interpolating(), js.build_topology(mesh, js.Interpolating(), 1), train_h=True)
batch = jnp.linspace(0.5, 1.5, 16)[:, None, None] * mesh.control().vertices
clouds = batch[:, :3] + 0.1
def losses(layer, batch, clouds):
    return js.losses.chamfer_distance(layer(batch), clouds)
def loss(layer, batch, clouds):
    return jax.lax.pmean(losses(layer, batch, clouds).mean(), "batch")
def slopes(layer, batch, clouds):
    parameter = lambda p: loss(jax.tree.unflatten(tree, [p, *rest]), batch, clouds)
    (p, *rest), tree = jax.tree.flatten(layer)
    return jax.grad(parameter)(p)
over = jax.make_mesh((8,), ("batch",), axis_types=(jax.sharding.AxisType.Auto,))
specs = (P(), P("batch"), P("batch"))
found = jax.jit(jax.shard_map(losses, mesh=over, in_specs=specs, out_specs=P("batch")))(layer, batch, clouds)
slope = jax.jit(jax.shard_map(slopes, mesh=over, in_specs=specs, out_specs=P()))(layer, batch, clouds)
assert len(found.sharding.device_set) == 8
np.testing.assert_allclose(found, jax.jit(losses)(layer, batch, clouds), rtol=1e-5)
leaves, tree = jax.tree.flatten(layer)
alone = jax.jit(jax.grad(lambda p: losses(jax.tree.unflatten(tree, [p, *leaves[1:]]), batch, clouds).mean()))(leaves[0])
np.testing.assert_allclose(slope, alone, rtol=1e-4)
"""


def test_a_batch_is_shared_between_devices():
    """In a process of its own: the number of devices is chosen when JAX starts."""
    environment = {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=8 --xla_cpu_use_fusion_emitters=false",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    done = subprocess.run([sys.executable, "-c", _ON_EIGHT_DEVICES], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def test_bad_arguments_are_refused_with_words(as_users_run):
    for message, make in {
        "Loop has no h to train": lambda: js.SurfaceLayer(js.Loop(), TOPOLOGY, train_h=True),
        "h must lie between 1.5 and 2": lambda: js.SurfaceLayer(
            js.Interpolating(), TOPOLOGY, train_h=True, h_range=(1.5, 2)
        ),
        "two finite numbers, the smaller one first": lambda: js.SurfaceLayer(
            js.Interpolating(), TOPOLOGY, train_h=True, h_range=(2, 0)
        ),
        r"the tables of 1 meshes, so `vertices` must have the shape \[1, 10, 3\]": lambda: js.SurfaceLayer(
            js.Interpolating(), js.stack_topologies([TOPOLOGY])
        )(BATCH),
        r"shape \[..., 6, 3\]; got \[5, 3\]": lambda: LAYER(X[:5]),
        r"the shape of `vertices`, \[2, 6, 3\], or \[6, 3\]": lambda: LAYER(BATCH, BATCH[:1]),
        "a whole number from 1 on": lambda: js.memory_of(js.Interpolating(), TOPOLOGY, batch=0),
    }.items():
        with pytest.raises(ValueError, match=message):
            make()


def test_memory_is_that_of_the_compiled_program():
    scheme = js.Interpolating()
    value = js.memory_of(scheme, TOPOLOGY, batch=3, gradient=False)
    control, surface = 3 * 6 * 3 * 4, 3 * 18 * 3 * 4  # bytes of positions, and of normals likewise
    assert 2 * surface <= value.results < 2 * surface + 200 and value.arguments > 2 * control
    both = js.memory_of(scheme, TOPOLOGY, batch=3)
    gradient = 2 * control + 4
    assert 2 * surface + gradient <= both.results < 2 * surface + gradient + 200
    assert both.temporaries > value.temporaries and both.total == sum(both)
    assert "temporaries" in str(both)
    wide = js.memory_of(scheme, TOPOLOGY, batch=3, dtype=jnp.float64, gradient=False)
    assert 2 * value.results <= wide.results + 200 <= 2 * value.results + 400
