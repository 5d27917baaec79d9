"""How fast a refinement is, beside trimesh's Loop subdivision of the same mesh in the same run.

pip install -e '.[bench]' && pytest tests/bench/bench_refine.py --benchmark-group-by=group
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxsubdiv as js

LEVELS = 4
SCHEMES = {"interpolating": js.Interpolating(), "circle": js.CirclePreserving()}


@functools.cache
def sphere() -> js.ControlMesh:
    """5,120 triangles, 1.3 million after four levels."""
    ball = trimesh.creation.icosphere(4)
    return js.ControlMesh(ball.vertices, ball.faces)


def single(control: js.Control) -> js.Control:
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), control)


@pytest.mark.benchmark(group="tables")
def test_build_topology(benchmark):
    benchmark(js.build_topology, sphere(), js.Interpolating(), LEVELS)


@pytest.mark.parametrize("name", SCHEMES)
@pytest.mark.parametrize("put_out", ["vertices", "vertices and normals", "value and gradient"])
def test_refine(benchmark, name, put_out):
    benchmark.group = put_out
    scheme, mesh = SCHEMES[name], sphere()
    topology, control = js.build_topology(mesh, scheme, LEVELS), single(mesh.control())

    def vertices(scheme, topology, control):
        return js.refine(scheme, topology, control).vertices

    def both(scheme, topology, control):
        surface = js.refine(scheme, topology, control)
        return surface.vertices, surface.normals

    def value_and_grad(scheme, topology, control):
        def value(of):
            x = vertices(of[0], topology, of[1])
            return jnp.vdot(x, x)

        return jax.value_and_grad(value)((scheme, control))

    run = {"vertices": vertices, "vertices and normals": both, "value and gradient": value_and_grad}[put_out]
    compiled = jax.jit(run)
    benchmark(lambda: jax.block_until_ready(compiled(scheme, topology, control)))


@pytest.mark.benchmark(group="vertices")
def test_trimesh_loop_with_its_tables(benchmark):
    mesh = sphere()
    benchmark.pedantic(
        trimesh.remesh.subdivide_loop, (mesh.vertices, np.asarray(mesh.faces[3]), LEVELS), rounds=2, iterations=1
    )
