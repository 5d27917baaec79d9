"""How fast refinement is: beside C++, OpenSubdiv, libigl and trimesh on the same work in one run, and its own parts.

    pip install -e '.[bench]' && pytest tests/bench/bench_refine.py

prints a table of ratios after the timings. float32, 4 levels. C++ (`gathers.cpp`, built with g++ on the spot) runs the
same formulas on the same tables, on all cores: what a person would write for this alone. Lengths have no unit here.
"""

import functools
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import trimesh
from gathers import Gathers
from opensubdiv import OpenSubdiv

import fitting
import jaxsubdiv as js

LEVELS = 4
SCHEME = js.Interpolating()
ROUNDS = {"min_rounds": 15, "warmup": True, "warmup_iterations": 2, "disable_gc": True}
MESHES = ("triangles", "quads", "mixed", "shuffled")

pytestmark = pytest.mark.benchmark(**ROUNDS)
js.keep_freed_memory()


@functools.cache
def control_mesh(kind: str) -> js.ControlMesh:
    """5,120 triangles on a sphere, in order or shuffled; 6,144 quads on a torus, or half of them cut in two."""
    ball = trimesh.creation.icosphere(4)
    if kind == "triangles":
        return js.ControlMesh(ball.vertices, ball.faces)
    if kind == "shuffled":
        rng = np.random.default_rng(0)
        order, faces = rng.permutation(len(ball.vertices)), rng.permutation(ball.faces)
        return js.ControlMesh(ball.vertices[order], np.argsort(order)[faces])
    return js.ControlMesh(*meshes.torus(96, 64, kind.removesuffix("s")))


@functools.cache
def prepared(kind: str) -> tuple[js.Topology, js.Control]:
    mesh = control_mesh(kind)
    control = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), mesh.control())
    return js.build_topology(mesh, SCHEME, LEVELS), control


def vertices(topology, control):
    return js.refine(SCHEME, topology, control).vertices


def vertices_and_normals(topology, control):
    surface = js.refine(SCHEME, topology, control)
    return surface.vertices, surface.normals


def value_and_gradient(topology, control):
    def value(control, h):
        x = js.refine(js.Interpolating(h), topology, control).vertices
        return jnp.vdot(x, x)

    return jax.value_and_grad(value, argnums=(0, 1))(control, jnp.float32(1.0))


def directional_derivative(topology, control):
    return jax.jvp(functools.partial(vertices, topology), (control,), (control,))


WORK = {
    "vertices": vertices,
    "normals": vertices_and_normals,
    "gradient": value_and_gradient,
    "jvp": directional_derivative,
}


def run(benchmark, function: Callable, *arguments) -> None:
    benchmark(lambda: jax.block_until_ready(function(*arguments)))


@pytest.mark.parametrize("kind", MESHES)
@pytest.mark.parametrize("work", WORK)
def test_refine(benchmark, work, kind):
    benchmark.group, benchmark.name = kind, f"jaxsubdiv, {work}"
    run(benchmark, jax.jit(WORK[work]), *prepared(kind))


@pytest.mark.parametrize("kind", ["triangles", "quads"])
@pytest.mark.parametrize("work", ["vertices", "normals"])
def test_cpp(benchmark, work, kind):
    benchmark.group, benchmark.name = kind, f"C++, {work}"
    gathers = Gathers(*prepared(kind))
    gathers.run(True)
    surface = js.refine(SCHEME, *prepared(kind))
    np.testing.assert_allclose(gathers.vertices, surface.vertices, atol=1e-5)
    np.testing.assert_allclose(gathers.normals, surface.normals, atol=1e-3)
    benchmark(gathers.run, work == "normals")


@pytest.mark.parametrize("kind", ["triangles", "quads"])
def test_floor(benchmark, kind):
    """Every byte once: the control mesh and the tables read, the surface written, at the speed of a copy in place."""
    benchmark.group, benchmark.name = kind, "floor"
    topology, control = prepared(kind)
    read = sum(leaf.nbytes for leaf in jax.tree.leaves((topology.levels, control)))
    out = jax.eval_shape(vertices, topology, control)
    source = np.zeros((read + out.size * 4) // 2, np.uint8)
    target = np.zeros_like(source)
    benchmark(np.copyto, target, source)


@pytest.mark.parametrize("kind", ["triangles", "quads"])
@pytest.mark.parametrize("way", ["stencils", "levels"])
def test_opensubdiv(benchmark, way, kind):
    """Loop's scheme, Catmull and Clark's: factorised stencils on all cores, or level by level on one."""
    benchmark.group, benchmark.name = kind, f"OpenSubdiv, {way}"
    try:
        peer = OpenSubdiv(control_mesh(kind), LEVELS, stencils=way == "stencils")
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no OpenSubdiv to build with (Debian: libosd-dev): {error}")
    peer.run()
    scheme = js.Loop() if kind == "triangles" else js.CatmullClark()
    topology = js.build_topology(control_mesh(kind), scheme, LEVELS)
    ours = np.asarray(js.refine(scheme, topology, prepared(kind)[1]).vertices)
    assert peer.vertices.shape == ours.shape
    np.testing.assert_allclose(np.sort(peer.vertices, axis=0), np.sort(ours, axis=0), atol=1e-5)
    benchmark(peer.run)


def test_libigl_loop_matrix(benchmark):
    """libigl's Loop matrices of all levels, built before, times the vertices."""
    igl = pytest.importorskip("igl")
    benchmark.group, benchmark.name = "triangles", "libigl, Loop matrix"
    mesh = control_mesh("triangles")
    faces, matrices = np.asarray(mesh.faces[3]), []
    for _ in range(LEVELS):
        matrix, faces = igl.loop_matrix(faces.astype(np.int64))
        matrices.append(matrix.astype(np.float32))
    x = np.asarray(mesh.vertices, np.float32)
    benchmark(lambda: functools.reduce(lambda x, matrix: matrix @ x, matrices, x))


def test_trimesh_loop(benchmark):
    """trimesh's Loop subdivision, which has no tables to build before."""
    benchmark.group, benchmark.name = "triangles", "trimesh, Loop with its tables"
    mesh = control_mesh("triangles")
    arguments = (mesh.vertices, np.asarray(mesh.faces[3]), LEVELS)
    benchmark.pedantic(trimesh.remesh.subdivide_loop, arguments, rounds=2, iterations=1)


@pytest.mark.parametrize("kind", ["triangles", "quads"])
def test_tables(benchmark, kind, tmp_path):
    benchmark.group, benchmark.name = kind, "tables"
    topology = benchmark.pedantic(js.build_topology, (control_mesh(kind), SCHEME, LEVELS), rounds=5, warmup_rounds=1)
    tables = sum(leaf.nbytes for leaf in jax.tree.leaves(topology.levels))
    n = jax.eval_shape(vertices, *prepared(kind)).shape[0]
    benchmark.extra_info["bytes a refined vertex"] = round(tables / n, 1)
    js.save_topology(tmp_path / "tables.npz", topology)
    start = time.perf_counter()
    jax.block_until_ready(js.load_topology(tmp_path / "tables.npz"))
    benchmark.extra_info["s to load the tables"] = round(time.perf_counter() - start, 3)


@pytest.mark.parametrize("kind", ["triangles", "quads"])
def test_memory(benchmark, kind):
    """What the compiled programs need beside arguments and results, over the bytes of the refined vertices."""
    benchmark.group, benchmark.name = kind, "temporary memory (see the extra figures)"
    out = jax.eval_shape(vertices, *prepared(kind)).size * 4
    for work in ("vertices", "gradient"):
        needs = jax.jit(WORK[work]).lower(*prepared(kind)).compile().memory_analysis().temp_size_in_bytes
        benchmark.extra_info[f"temporaries over output, {work}"] = round(needs / out, 2)
    benchmark(lambda: None)


@pytest.mark.parametrize("work", ["evaluate", "value and gradient"])
def test_evaluate(benchmark, work):
    """20,000 places on 20,480 triangles."""
    benchmark.group, benchmark.name = "20,000 points", work
    topology = js.build_topology(control_mesh("triangles"), SCHEME, 1)
    surface = js.refine(SCHEME, topology, prepared("triangles")[1])
    points = js.sample(surface, 20_000, jax.random.key(0)).points
    at = fitting.closest_points(surface, np.asarray(points))

    def squared(vertices):
        away = js.evaluate(js.RefinedSurface(vertices, surface.normals, surface.faces), at).points - points
        return jnp.vdot(away, away)

    function = {"evaluate": lambda vertices: squared(vertices), "value and gradient": jax.value_and_grad(squared)}[work]
    run(benchmark, jax.jit(function), surface.vertices)


FIRST_CALL = """
import sys, time, jax, jax.numpy as jnp, trimesh, jaxsubdiv as js
if sys.argv[2]:
    jax.config.update("jax_compilation_cache_dir", sys.argv[2])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
ball = trimesh.creation.icosphere(1)
mesh, scheme = js.ControlMesh(ball.vertices, ball.faces), js.Interpolating()
topology, control = js.build_topology(mesh, scheme, int(sys.argv[3])), mesh.control()
def value(control):
    x = js.refine(scheme, topology, control).vertices
    return jnp.vdot(x, x)
jnp.zeros(3).block_until_ready()
start = time.perf_counter()
jax.block_until_ready(jax.jit(jax.grad(value) if sys.argv[1] == "gradient" else value)(control))
print(time.perf_counter() - start)
"""


@pytest.mark.parametrize("levels", [2, 4])
@pytest.mark.parametrize("work", ["forward", "gradient"])
def test_first_call(benchmark, work, levels, tmp_path):
    """Of a small mesh, in a new process: tracing and compiling; then again with the persistent cache filled."""
    benchmark.group, benchmark.name = f"first call, {levels} levels", work

    def seconds(cache: str) -> float:
        command = [sys.executable, "-c", FIRST_CALL, work, cache, str(levels)]
        return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    seconds(str(tmp_path))
    benchmark.extra_info[f"s cold, {work}"] = round(seconds(""), 2)
    benchmark.extra_info[f"s with a warm cache, {work}"] = round(seconds(str(tmp_path)), 2)
    benchmark(lambda: time.sleep(0))
