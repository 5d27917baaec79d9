"""How far a fit moves when nothing that matters changes: the order of the points, rounding, threads, precision.

    python tests/bench/fit_continuity.py                      # the two examples that ship
    python tests/bench/fit_continuity.py base head_fragment   # the protocol's base case needs the extra `bench`

Prints a Markdown table. Every fit runs in a process of its own: precision and threads are settings of a process.
The surface's change is measured across itself, over the median standard deviation that the first fit reports; that of
control vertices over a control edge.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

CASES = ("head_fragment", "femur_distal")
CHANGES = {
    "as it is": "",
    "points shuffled": "shuffled",
    "points moved by 1e-13 of the size": "moved",
    "two threads": "threads",
    "float32": "single",
}


def fit_once(case: str, change: str, path: Path) -> None:
    import jax

    jax.config.update("jax_enable_x64", change != "single")

    import fitting
    import jaxsubdiv as js

    points, mesh = read_base() if case == "base" else read_example(case)
    rng = np.random.default_rng(1)
    if change == "shuffled":
        points = points[rng.permutation(len(points))]
    if change == "moved":
        points = points + 1e-13 * np.ptp(points, axis=0).max() * rng.normal(size=points.shape)
    topology = js.build_topology(mesh, js.Interpolating(), 2 if case == "base" else 3)
    scan = fitting.Scan(points)
    if case == "base":
        mesh = fitting.align(mesh, scan).mesh
    found = fitting.fit(js.Interpolating(), topology, mesh.control(), scan, throw=False)
    np.savez(
        path,
        vertices=np.asarray(found.surface.vertices, np.float64),
        normals=np.asarray(found.surface.normals, np.float64),
        control=np.asarray(found.control.vertices, np.float64),
        edge=float(js.edge_length(topology, mesh.control().vertices)),
        deviation=float(np.median(found.uncertainty().surface)) if not change else 0.0,
        sweeps=len(found.rms) - 1,
        rms=found.rms[-1],
    )


def read_example(name: str):
    import fitting

    scan, mesh = fitting.example(name)
    return np.asarray(scan.points, np.float64), mesh


def read_base():
    import fit_protocol

    import jaxsubdiv as js

    case = fit_protocol.CASES["base"]
    problem, _ = fit_protocol.draw(fit_protocol.true_surface(fit_protocol.DATA / case.truth), case, 0)
    template = problem.template(problem.n_vertices)
    return problem.scan, js.ControlMesh(template.vertices, template.faces, template.vertex_normals)


def compare(folder: Path, case: str) -> None:
    found = {}
    for name, change in CHANGES.items():
        path = folder / f"{case}_{change}.npz"
        threads = "2" if change == "threads" else "1"
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NPROC")
        flags = "" if threads == "2" else "--xla_cpu_multi_thread_eigen=false"
        environment = os.environ | dict.fromkeys(names, threads) | {"XLA_FLAGS": flags}
        subprocess.run(
            [sys.executable, __file__, case, "--change", change, "--output", str(path)], env=environment, check=True
        )
        with np.load(path) as arrays:
            found[name] = dict(arrays)
    first = found["as it is"]
    for name, other in found.items():
        across = np.abs(np.sum((other["vertices"] - first["vertices"]) * first["normals"], axis=1))
        control = np.linalg.norm(other["control"] - first["control"], axis=1) / first["edge"]
        print(
            f"| {case} | {name} | {other['sweeps']} | {other['rms']:.5f} |"
            f" {np.percentile(across, 95) / first['deviation']:.2g} | {np.max(across) / first['deviation']:.2g} |"
            f" {np.percentile(control, 95):.2g} | {np.max(control):.2g} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--change")
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    if given.output:
        fit_once(given.cases[0], given.change, given.output)
        return
    print(
        "| case | change | sweeps | RMS, mm | surface, 95 % / sd | at most | control vertices, 95 % / edge | at most |"
    )
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    with tempfile.TemporaryDirectory() as folder:
        for case in given.cases:
            compare(Path(folder), case)


if __name__ == "__main__":
    main()
