"""The most memory that fits take, each in a process of its own, beside what `fit_scan` says before it starts.

    pip install -e '.[bench]' && python tests/bench/fit_memory.py

Prints a Markdown table, in GB. The scans are noisy points of a bumpy ring, see `fit_million.py`.
"""

import json
import resource
import subprocess
import sys
import warnings

import fit_million
import numpy as np

import fitting
import jaxsubdiv as js
from fitting.run.memory import memory_of_fit

# Control vertices around the ring and around its tube; points; levels.
CASES = (
    (16, 10, 8_000, 3),
    (16, 10, 200_000, 1),
    (26, 25, 20_000, 2),
    (26, 25, 20_000, 3),
    (26, 25, 200_000, 2),
    (50, 30, 40_000, 2),
    (64, 48, 100_000, 2),
    (64, 48, 1_000_000, 2),
    (100, 100, 100_000, 2),
)
SWEEPS = 4  # later ones take no more


def measure(around: int, across: int, n_points: int, levels: int) -> None:
    mesh, points = fit_million.problem(np.random.default_rng(0), n_points, (around, across), rough=0.3)
    js.keep_freed_memory()
    topology = js.build_topology(mesh, js.Interpolating(), levels)
    scan = fitting.Scan(points)
    told = memory_of_fit(topology, scan.n_points)
    with warnings.catch_warnings(action="ignore"):
        fitting.fit(js.Interpolating(), topology, mesh.control(), scan, max_sweeps=SWEEPS, throw=False).uncertainty()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024  # KiB on Linux
    print(json.dumps((len(mesh.vertices), n_points, mesh.n_faces * 4**levels, told / 1e9, most / 1e9)))


def main() -> None:
    print("| control vertices | points | faces of the surface | said | measured |\n|--:|--:|--:|--:|--:|")
    for case in CASES:
        command = [sys.executable, __file__, *map(str, case)]
        out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        vertices, points, faces, told, most = json.loads(out)
        print(f"| {vertices:,} | {points:,} | {faces:,} | {told:.2f} | {most:.2f} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1:]:
        measure(*map(int, sys.argv[1:]))
    else:
        main()
