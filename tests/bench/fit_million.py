"""Time and memory of a large fit: a million noisy points of a bumpy ring, 3,072 control vertices, 15,361 unknowns.

    pip install -e '.[bench]' && python tests/bench/fit_million.py

Lengths in mm. The first call compiles.
"""

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import meshes

import fitting
import jaxsubdiv as js

SIGMA = 0.2


def ring(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Points of the ring, whose tube is 30 mm thick and has bumps of 2 mm."""
    tube = 30 + 2 * np.cos(5 * u) * np.sin(3 * v)
    around = 80 + tube * np.cos(v)
    return np.stack([around * np.cos(u), around * np.sin(u), tube * np.sin(v)], axis=-1)


def problem(
    rng: np.random.Generator, n_points: int, vertices: tuple[int, int], rough: float
) -> tuple[js.ControlMesh, np.ndarray]:
    """Control mesh, with noise of `rough` mm, and noisy points; vertices around the ring and around its tube."""
    points = ring(*rng.uniform(0, 2 * np.pi, (2, n_points))) + rng.normal(scale=SIGMA, size=(n_points, 3))
    start, faces = meshes.torus(*vertices, "triangle")
    angles = np.arctan2(start[:, 1], start[:, 0]), np.arctan2(start[:, 2], np.hypot(*start[:, :2].T) - 2)
    return js.ControlMesh(ring(*angles) + rng.normal(scale=rough, size=start.shape), faces), points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--most-points", type=int, help="fit so many of them, and measure all (default: fit all)")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    mesh, points = problem(rng, given.points, (64, 48), rough=1.0)
    began = time.perf_counter()

    def told(sweep: fitting.Sweep) -> None:
        print(f"sweep {sweep.number}: {sweep.rms:.3f} mm, {time.perf_counter() - began:.1f} s", flush=True)

    options = {"pose": None, "levels": 2, "most_points": given.most_points}
    found = fitting.fit_scan(fitting.Scan(points), mesh, **options, throw=False, on_sweep=told).result
    truth = ring(*rng.uniform(0, 2 * np.pi, (2, 50_000)))
    off = js.evaluate(found.surface, fitting.closest_points(found.surface, truth)).points - truth
    print(f"{given.points:,} points, {len(mesh.vertices):,} control vertices, {found.report().n_unknowns:,} unknowns")
    print(f"fitted in {time.perf_counter() - began:.0f} s, {len(found.rms) - 1} sweeps, {found.report().reason}")
    rms = np.sqrt((off**2).sum(axis=1).mean())
    print(f"noise {found.noise:.3f} mm (drawn {SIGMA}); off the truth by {rms:.3f} mm RMS")
    print(f"most memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB")  # in kB on Linux


if __name__ == "__main__":
    main()
