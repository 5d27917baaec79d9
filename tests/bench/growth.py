"""How time grows with faces, levels and points: straight lines of slope 1 in a log-log picture.

    pip install -e '.[bench]' && python tests/bench/growth.py docs/growth.png

float32, the best of several runs, compilation left out. "faces" and "levels" are refined faces, of larger control
meshes at 2 levels and of one control mesh at more levels; "points" are closest points searched on 20,480 triangles.
"""

import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from matplotlib.figure import Figure

import fitting
import jaxsubdiv as js

SCHEME = js.Interpolating()


def best(function: Callable, *arguments) -> float:
    times = []
    jax.block_until_ready(function(*arguments))
    while len(times) < 5 or (sum(times) < 0.5 and len(times) < 50):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - start)
    return min(times)


def refined(divisions: int, levels: int) -> tuple[js.Topology, js.Control]:
    ball = trimesh.creation.icosphere(divisions)
    mesh = js.ControlMesh(ball.vertices, ball.faces)
    control = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), mesh.control())
    return js.build_topology(mesh, SCHEME, levels), control


@jax.jit
def forward(topology: js.Topology, control: js.Control) -> jax.Array:
    return js.refine(SCHEME, topology, control).vertices


@jax.jit
def gradient(topology: js.Topology, control: js.Control) -> js.Control:
    return jax.grad(lambda control: jnp.sum(forward(topology, control) ** 2))(control)


def main(path: str) -> None:
    js.keep_freed_memory()
    lines: dict[str, list[tuple[float, float]]] = {}
    for name, cases in (("faces", [(d, 2) for d in range(1, 7)]), ("levels", [(2, level) for level in range(1, 7)])):
        for case in cases:
            problem = refined(*case)
            n = problem[0].faces[3].shape[0]
            lines.setdefault(f"vertices, more {name}", []).append((n, best(forward, *problem)))
            lines.setdefault(f"gradient, more {name}", []).append((n, best(gradient, *problem)))
    surface = js.refine(SCHEME, *refined(4, 1))
    for n in (1000, 10_000, 100_000, 1_000_000):
        points = np.random.default_rng(0).normal(size=(n, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        start = time.perf_counter()
        fitting.closest_points(surface, points)
        lines.setdefault("closest points, more points", []).append((n, time.perf_counter() - start))
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    ax = figure.subplots()
    for name, line in lines.items():
        n, seconds = np.array(line).T
        slope = np.polyfit(np.log(n[-3:]), np.log(seconds[-3:]), 1)[0]
        print(f"{name}: slope {slope:.2f} at the end; {', '.join(f'{1e3 * s:.3g}' for s in seconds)} ms")
        ax.loglog(n, 1e3 * seconds, "o-", label=f"{name}: slope {slope:.2f} at the end")
    ax.set(xlabel="refined faces, or points", ylabel="ms")
    ax.grid(True, which="major", alpha=0.4)
    ax.legend(loc="lower right")
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main(*sys.argv[1:])
