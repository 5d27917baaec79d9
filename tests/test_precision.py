"""Single precision, and what is compiled when."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from refined import CONTROL, DEFAULT, N, X, refine
from schemes import LEVELS, MIXED, by_name, over_cases, refined

import jaxsubdiv as js
from jaxsubdiv._refine import _refine


@pytest.mark.parametrize("name", ["default", "bezier-triangle", "catmull-clark", "butterfly"])
def test_single_precision_stays_single_and_agrees(name):
    case = by_name(name)
    single = js.Control(case.subject.x.astype(np.float32), case.subject.n.astype(np.float32))
    surface = js.refine(case.scheme, case.topology, single)
    assert surface.vertices.dtype == surface.normals.dtype == np.float32
    expected = refined(case, js.Control(*(np.asarray(rows, np.float64) for rows in (single.vertices, single.normals))))
    np.testing.assert_allclose(surface.vertices, expected.vertices, rtol=0, atol=2e-6)
    np.testing.assert_allclose(surface.normals, expected.normals, rtol=0, atol=2e-5)


def test_single_precision_holds_a_metre_from_the_origin():
    vertices, faces = meshes.icosahedron()
    vertices = np.asarray(100 * vertices + (1000, -1000, 500), np.float32)  # mm
    scheme, checked = js.Interpolating(), js.ControlMesh(vertices, faces)
    topology = js.build_topology(checked, scheme, 5)
    double = checked.control()
    single, double = (
        js.refine(scheme, topology, js.Control(vertices.astype(dtype), np.asarray(double.normals, dtype)))
        for dtype in (np.float32, np.float64)
    )
    np.testing.assert_allclose(single.vertices, double.vertices, rtol=2e-7, atol=0)
    sines = np.linalg.norm(np.cross(single.normals, double.normals), axis=1)
    assert np.degrees(sines.max()) < 0.01


def test_only_new_sizes_options_and_dtypes_compile_anew():
    topology = DEFAULT.topology
    js.refine(js.Interpolating(), topology, CONTROL)
    compiled = _refine._cache_size()
    for h in (1.2, 1, np.float64(0.9), jnp.asarray(0.9), jnp.asarray(0.9, jnp.float64)):
        js.refine(js.Interpolating(h), topology, js.Control(2 * X, N.tolist()))
    told, _, _ = meshes.relabelled(MIXED, seed=9)
    js.refine(js.Interpolating(), js.build_topology(js.ControlMesh(*told), js.Interpolating(), LEVELS), CONTROL)
    assert _refine._cache_size() == compiled
    refine(js.Interpolating(), (np.eye(3), [(0, 2, 1)]), 1)
    refine(js.Interpolating(weights="uniform"), (np.eye(3), [(0, 2, 1)]), 1)
    assert _refine._cache_size() > compiled


@over_cases()
def test_refinement_is_gathers_and_sums_without_scatters(case):
    program = _refine.lower(case.scheme, case.topology, case.subject.control).as_text()
    assert "gather" in program and "scatter" not in program


def test_gradients_have_the_scatters_that_a_search_would_find():
    topology, scheme = DEFAULT.topology, js.Interpolating()
    slope = jax.jit(jax.grad(lambda control: js.refine(scheme, topology, control).vertices.sum()))
    assert "scatter" in slope.lower(CONTROL).as_text()


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="only the CPU backend is told to keep stages apart")
def test_stages_stay_programs_of_their_own_forward_and_backward():
    # Were they inlined by another XLA, or did they call on smaller ones, everything would be slower in silence.
    topology, scheme = DEFAULT.topology, js.Interpolating()

    def normals(control):
        return jnp.sum(js.refine(scheme, topology, control).normals)

    def calls(function):
        # As users compile it, not as the tests do.
        emitters = {"xla_cpu_use_fusion_emitters": True} if jax.__version_info__ < (0, 11) else None
        return jax.jit(function).lower(CONTROL).compile(emitters).as_text().count(" call(")

    # Points of edges and faces, their sums of corner normals, and those made unit.
    assert calls(normals) == 6 * LEVELS
    assert calls(jax.grad(normals)) in range(2 * 6 * LEVELS - 2, 3 * 6 * LEVELS)
