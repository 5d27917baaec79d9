"""What `js.memory_of` says beforehand of a training step's surface, against what the process then takes.

    python tests/bench/layer_memory.py [--levels 4] [--batch 8]

Linux only: the peak of the process is reset through /proc.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

import fitting
import jaxsubdiv as js


def _status(name: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if line.startswith(name)).split()[1]) / 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--levels", type=int, default=4)
    parser.add_argument("--batch", type=int, default=8)
    options = parser.parse_args()
    _, mesh = fitting.example("femur_distal")
    scheme = js.Interpolating()
    topology = js.build_topology(mesh, scheme, options.levels)
    layer = js.SurfaceLayer(scheme, topology, train_h=True)
    vertices = jnp.tile(mesh.control().vertices.astype(jnp.float32), (options.batch, 1, 1))
    normals = jnp.tile(mesh.control().normals.astype(jnp.float32), (options.batch, 1, 1))

    def step(wrap):
        def loss(inputs):
            layer, vertices, normals = inputs
            surface = wrap(lambda layer, *control: layer(*control))(layer, vertices, normals)
            return jnp.sum(surface.vertices**2) + jnp.sum(surface.normals[..., 0])

        return eqx.filter_jit(eqx.filter_value_and_grad(loss))

    print(f"announced: {js.memory_of(scheme, topology, batch=options.batch)}")
    for name, wrap in (("as it is", lambda f: f), ("in eqx.filter_checkpoint", eqx.filter_checkpoint)):
        program = step(wrap).lower((layer, vertices, normals)).compile()
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts from here
        before = _status("VmRSS")
        jax.block_until_ready(program((layer, vertices, normals)))
        print(f"{name}: the process grew by {_status('VmHWM') - before:,.1f} MB at its peak")


if __name__ == "__main__":
    main()
