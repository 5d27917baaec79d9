"""Time and memory of one large gradient: 512 triangles refined eight times, 33 million.

pip install -e '.[bench]' && python tests/bench/large.py
"""

import resource
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxsubdiv as js

LEVELS = 8


def torus() -> js.ControlMesh:
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(16), np.arange(16), indexing="ij"))
    around, angle = 2 + np.cos(v * np.pi / 8), u * np.pi / 8
    vertices = np.stack([around * np.cos(angle), around * np.sin(angle), np.sin(v * np.pi / 8)], axis=1)
    corners = [(u, v), (u + 1, v), (u + 1, v + 1), (u, v + 1)]
    quads = np.stack([(a % 16) * 16 + b % 16 for a, b in corners], axis=1)
    return js.ControlMesh(vertices, quads).triangulated()


@jax.jit
def gradient(topology: js.Topology, control: js.Control) -> js.Control:
    return jax.grad(lambda c: jnp.sum(js.refine(js.Interpolating(), topology, c).vertices ** 2))(control)


def main() -> None:
    mesh, start = torus(), time.perf_counter()
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
