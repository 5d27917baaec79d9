"""Time and memory of one large gradient: 512 triangles refined eight times, 33 million.

pip install -e '.[bench]' && python tests/bench/large.py
"""

import resource
import time

import jax
import jax.numpy as jnp
import trimesh

import jaxsubdiv as js

LEVELS = 8


@jax.jit
def gradient(topology: js.Topology, control: js.Control) -> js.Control:
    return jax.grad(lambda c: jnp.sum(js.refine(js.Interpolating(), topology, c).vertices ** 2))(control)


def main() -> None:
    ring = trimesh.creation.torus(2, 1, 16, 16)
    mesh, start = js.ControlMesh(ring.vertices, ring.faces), time.perf_counter()
    topology = js.build_topology(mesh, js.Interpolating(), LEVELS)
    print(f"{len(topology.faces[3]):,} faces; tables {time.perf_counter() - start:.1f} s")
    control = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), mesh.control())
    for call in ("first", "second"):
        start = time.perf_counter()
        jax.block_until_ready(gradient(topology, control))
        print(f"{call} gradient {time.perf_counter() - start:.1f} s")
    print(
        f"most memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB"
    )  # ru_maxrss is in kB on Linux


if __name__ == "__main__":
    main()
