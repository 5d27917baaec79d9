"""Topologies padded to size classes: what is real stays as it is, meshes of a class share a program, batches."""

import itertools

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from schemes import control_mesh

import jaxsubdiv as js
from jaxsubdiv._padding import _SMALLEST, _sizes

LEVELS = 2
MIXED = control_mesh(meshes.grid(3, 2, "mixed", bumpy=0.2))
CREASED = js.split_normals(MIXED, [(1, 4), (4, 7), (7, 10)])
SCHEMES = {
    "keep": js.Interpolating(1.1),
    "recompute": js.Interpolating(old_normals="recompute"),
    "circle": js.CirclePreserving(0.9),
}


def over_schemes():
    return pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES.keys())


def assert_same(ours: js.RefinedSurface, theirs: js.RefinedSurface) -> None:
    np.testing.assert_allclose(ours.vertices, theirs.vertices, atol=1e-13)
    np.testing.assert_allclose(ours.normals, theirs.normals, atol=1e-12)
    for size in (3, 4):
        np.testing.assert_array_equal(ours.faces[size], theirs.faces[size])


def padded(scheme, mesh, **options):
    before = js.build_topology(mesh, scheme, LEVELS, **options)
    topology = js.pad_topology(before)
    return before, topology, mesh.control(), js.pad_control(topology, mesh.control())


@over_schemes()
def test_real_rows_are_those_of_the_mesh_alone(scheme):
    before, topology, alone, control = padded(scheme, CREASED.mesh, seams=CREASED.origin)
    surface = js.refine(scheme, topology, control)
    real = topology.real
    assert real is not None and real.vertices.shape == surface.vertices.shape[:1] and not real.vertices.all()
    assert real.faces.shape == (surface.n_faces,)
    assert_same(js.cut_padding(topology, surface), js.refine(scheme, before, alone))
    assert np.array_equal(np.asarray(surface.areas()) > 0, real.faces)


@pytest.mark.parametrize("scheme", [SCHEMES["keep"], SCHEMES["recompute"]], ids=["keep", "recompute"])
def test_gradients_are_those_of_the_mesh_alone_and_finite_at_spare_rows(scheme):
    before, topology, alone, control = padded(scheme, CREASED.mesh, seams=CREASED.origin)
    real = topology.real
    assert real is not None

    @jax.grad
    def gradient(control, topology, weights):
        surface = js.refine(scheme, topology, control)
        return jnp.vdot(weights, jnp.sin(surface.vertices + surface.normals).sum(axis=1))

    n = len(alone.vertices)
    ours = gradient(control, topology, real.vertices.astype(float))
    theirs = gradient(alone, before, jnp.ones(int(real.vertices.sum())))
    for leaf, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(leaf[:n], expected, atol=1e-12)
        assert not leaf[n:].any()
    of_all = gradient(control, topology, jnp.ones(len(real.vertices)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(of_all))


def test_meshes_of_a_class_share_one_program():
    scheme = js.Interpolating()
    given = [padded(scheme, control_mesh(mesh)) for mesh in (meshes.fan(7), meshes.octahedron(), meshes.fan(8))]
    shapes = (
        {jax.tree.structure(t) for _, t, *_ in given},
        {tuple(leaf.shape for leaf in jax.tree.leaves(t)) for _, t, *_ in given},
    )
    assert list(map(len, shapes)) == [1, 1]
    refine = jax.jit(js.refine)
    found = [refine(scheme, topology, control) for _, topology, _, control in given]
    assert refine._cache_size() == 1
    for (before, topology, alone, _), surface in zip(given, found, strict=True):
        assert_same(js.cut_padding(topology, surface), js.refine(scheme, before, alone))


def test_a_batch_of_different_meshes():
    scheme = SCHEMES["keep"]
    given = [MIXED, control_mesh(meshes.octahedron()), control_mesh(meshes.cube())]
    alone = [js.build_topology(mesh, scheme, LEVELS) for mesh in given]
    topologies = js.stack_topologies(alone)
    controls = [js.pad_control(topologies, mesh.control()) for mesh in given]
    control = jax.tree.map(lambda *rows: jnp.stack(rows), *controls)
    surfaces = jax.jit(jax.vmap(js.refine, (None, 0, 0)))(scheme, topologies, control)
    for i, (mesh, topology) in enumerate(zip(given, alone, strict=True)):
        of_mesh, surface = jax.tree.map(lambda leaf, i=i: leaf[i], (topologies, surfaces))
        assert_same(js.cut_padding(of_mesh, surface), js.refine(scheme, topology, mesh.control()))

    def total(control):
        surfaces = jax.vmap(js.refine, (None, 0, 0))(scheme, topologies, control)
        return jnp.vdot(surfaces.vertices, surfaces.normals)

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(jax.grad(total))(control)))


def test_estimated_normals_and_places_are_those_of_the_mesh_alone():
    scheme = js.Interpolating()
    before, topology, alone, control = padded(scheme, MIXED)
    normals = js.estimate_normals(topology.control_fans, control.vertices)
    n = len(alone.vertices)
    np.testing.assert_allclose(normals[:n], js.estimate_normals(before.control_fans, alone.vertices), atol=1e-14)
    np.testing.assert_allclose(normals[n:], np.tile(normals[:1], (len(normals) - n, 1)), atol=1e-14)
    # Quads are numbered after all triangles, the spare ones too.
    face, uv = np.array([0, len(before.control_faces[3])]), np.array([[0.3, 0.2], [0.6, 0.7]])
    ours = js.evaluate_control(
        scheme, topology, control, js.SurfacePoint([0, len(topology.control_faces[3])], jnp.asarray(uv))
    )
    theirs = js.evaluate_control(scheme, before, alone, js.SurfacePoint(face, uv))
    np.testing.assert_allclose(ours.points, theirs.points, atol=1e-13)


def test_classes_grow_by_a_quarter_or_are_given():
    steps = list(itertools.islice(_sizes(_SMALLEST), 20))
    assert steps[:4] == [16, 20, 25, 32] and all(b <= 1.25 * a + 1 for a, b in itertools.pairwise(steps))
    topology = js.build_topology(MIXED, js.Interpolating(), 1)
    sizes = [len(js.pad_topology(topology, [8, 30]).control_faces[size]) for size in (3, 4)]
    assert sizes == [8, 8]


def test_a_saved_padded_topology_is_read_as_it_was(tmp_path):
    _, topology, *_ = padded(js.Interpolating(), MIXED)
    js.save_topology(tmp_path / "tables.npz", topology)
    again = js.load_topology(tmp_path / "tables.npz")
    assert jax.tree.structure(again) == jax.tree.structure(topology)
    assert all(map(np.array_equal, jax.tree.leaves(again), jax.tree.leaves(topology)))


def test_what_cannot_be_padded_is_refused():
    scheme = js.Interpolating()
    topology = js.build_topology(MIXED, scheme, 1)
    with pytest.raises(ValueError, match=r"the classes \[2\] hold no mesh of 6 triangles, 3 quads"):
        js.pad_topology(topology, [2])
    with pytest.raises(ValueError, match="is padded already"):
        js.pad_topology(js.pad_topology(topology))
    with pytest.raises(ValueError, match=r"tables for .*Butterfly.* cannot be padded"):
        other = js.ModifiedButterfly()
        js.pad_topology(js.build_topology(control_mesh(meshes.octahedron()), other, 1))
    with pytest.raises(ValueError, match="topologies 0 and 1 differ in their levels"):
        js.stack_topologies([topology, js.build_topology(MIXED, scheme, 2)])
    with pytest.raises(ValueError, match="no topologies"):
        js.stack_topologies([])
    with pytest.raises(ValueError, match="pad them with `pad_control`"):
        js.refine(scheme, js.pad_topology(topology), MIXED.control())
    with pytest.raises(ValueError, match="room for 1 to 12 control vertices; got 13"):
        js.pad_control(topology, js.Control(np.zeros((13, 3)), np.zeros((13, 3))))
