"""The derivative of a fitted volume, area and landmark by all points and weights: its error and time.

    pip install -e '.[bench]' && python tests/bench/fit_derivatives.py

The head fragment that ships with the package, in float64, at 2 levels; "volume" is that between its surface and the
plane z = 0. Seconds are of compiled programs.
"""

import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fitting
import jaxsubdiv as js

LEVELS = 2


def volume(surface: js.RefinedSurface) -> jax.Array:
    a, b, c = (surface.vertices[corner] for corner in surface.triangles().T)
    return jnp.sum(jnp.cross(b - a, c - a)[:, 2] * (a + b + c)[:, 2]) / 6


def area(surface: js.RefinedSurface) -> jax.Array:
    a, b, c = (surface.vertices[corner] for corner in surface.triangles().T)
    return jnp.sum(jnp.linalg.norm(jnp.cross(b - a, c - a), axis=1)) / 2


def height(surface: js.RefinedSurface) -> jax.Array:
    """Of one vertex, as of a landmark."""
    return surface.vertices[surface.vertices.shape[0] // 2, 2]


def timed(function: Callable, *arguments):
    start = time.perf_counter()
    found = jax.block_until_ready(function(*arguments))
    return found, time.perf_counter() - start


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    scan, template = fitting.example("head_fragment")
    scan, mesh = fitting.Scan(np.asarray(scan.points, np.float64)), js.ControlMesh(template.vertices, template.faces)
    topology, scheme = js.build_topology(mesh, js.Interpolating(), LEVELS), js.Interpolating()

    def fit() -> fitting.FitResult:
        return fitting.fit(scheme, topology, mesh.control(), scan, throw=False)

    fit()
    result, seconds = timed(fit)
    refit, points, ones = result.refit(), scan.points, jnp.ones(scan.n_points)
    rng = np.random.default_rng(0)
    along = [jnp.asarray(rng.normal(size=shape)) for shape in (points.shape, ones.shape)]
    print(f"fit: {seconds:.2f} s, {len(result.rms) - 1} sweeps\n")
    print("| | by | relative difference | seconds over the fit's |\n|---|---|--:|--:|")
    for measure in (volume, area, height):

        @eqx.filter_jit
        def of(points, weights, refit, measure=measure):
            def value(given):
                scheme, control = refit(*given)
                return measure(js.refine(scheme, topology, control))

            return jax.value_and_grad(value)((points, weights))

        of(points, ones, refit)
        # From other points, so that Newton's steps count.
        _, took = timed(of, points + 0.01 * along[0], ones, refit)
        _, gradients = of(points, ones, refit)
        for name, which, step in (("points", 0, 1e-5), ("weights", 1, 1e-4)):
            ahead, back = (
                of(*(x + s * step * along[i] * (i == which) for i, x in enumerate((points, ones))), refit)[0]
                for s in (1, -1)
            )
            by_differences = (ahead - back) / (2 * step)
            off = abs(jnp.vdot(gradients[which], along[which]) / by_differences - 1)
            print(f"| {measure.__name__} | {name} | {off:.1e} | {took / seconds:.2f} |", flush=True)


if __name__ == "__main__":
    main()
