"""How long fits take beside an older commit, in the same run, the two in turns.

    git worktree add ../older 612daa1
    python tests/bench/fit_against.py ../older                      # tasks: command first fit cohort
    python tests/bench/fit_against.py ../older --tasks million --repeats 1

Prints a Markdown table of the CPU seconds of each, the least of the repeats, and their ratio. The scan is that of the
protocol's base case (20,000 points, 650 control vertices, here of three levels), and needs `.[bench]`; the cohort
is 16 femora, the one that ships with noise of its own for each.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
TASKS = ("command", "first", "fit", "cohort")
FIT = """
import sys, time, warnings
import fitting, jaxsubdiv as js
warnings.simplefilter("ignore")
scan, mesh = fitting.read_scan(sys.argv[1]), js.read_mesh(sys.argv[2])
mesh = fitting.align(mesh, scan).mesh
topology = js.build_topology(mesh, js.Interpolating(), int(sys.argv[3]))
for repeat in range(2):
    start = time.process_time()
    found = fitting.fit(js.Interpolating(), topology, mesh.control(), scan, throw=False)
    print(time.process_time() - start, len(found.rms) - 1, found.rms[-1])
"""
COHORT = """
import time, warnings
import numpy as np
import fitting, jaxsubdiv as js
warnings.simplefilter("ignore")
scan, mesh = fitting.example("femur_distal")
rng = np.random.default_rng(0)
points = np.asarray(scan.points)
scans = [fitting.Scan(points + rng.normal(scale=0.2, size=points.shape)) for _ in range(16)]
topology = js.build_topology(mesh, js.Interpolating(), 2)
pilot = fitting.fit(js.Interpolating(), topology, mesh.control(), scans[0], throw=False)
for repeat in range(2):
    start = time.process_time()
    found = fitting.fit_cohort(js.Interpolating(), topology, mesh.control(), scans, pilot=pilot)
    rms = [rows[n] for rows, n in zip(found.rms, found.sweeps)]
    print((time.process_time() - start) / 16, np.mean(found.sweeps), np.mean(rms))
"""


def write_data(folder: Path) -> None:
    import fit_protocol

    import jaxsubdiv as js

    case = fit_protocol.CASES["base"]
    truth = fit_protocol.true_surface(fit_protocol.DATA / case.truth)
    problem, _ = fit_protocol.draw(truth, case, 0)
    template = problem.template(problem.n_vertices)
    np.savetxt(folder / "scan.xyz", problem.scan, fmt="%.5f")
    js.write_mesh(folder / "template.obj", js.ControlMesh(template.vertices, template.faces, template.vertex_normals))
    big = np.repeat(problem.scan, 50, axis=0)
    np.savetxt(folder / "million.xyz", big + np.random.default_rng(0).normal(scale=0.3, size=big.shape), fmt="%.4f")


def run(task: str, root: Path, folder: Path, cache: Path) -> tuple[float, str]:
    """CPU seconds, and what else the task tells."""
    scan, template = folder / "scan.xyz", folder / "template.obj"
    command = {
        "fit": ["-c", FIT, scan, template, "3"],
        "million": ["-c", FIT, folder / "million.xyz", template, "2"],
        "cohort": ["-c", COHORT],
    }.get(task, ["-m", "fitting", scan, "--control", template, "--levels", "3", "-o", folder / "out"])
    empty = tempfile.TemporaryDirectory()
    kept = empty.name if task == "first" else str(cache)
    environment = os.environ | {"PYTHONPATH": str(root), "JAX_COMPILATION_CACHE_DIR": kept, "OPENBLAS_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, *map(str, command)], env=environment, cwd=folder, capture_output=True, text=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    empty.cleanup()
    if done.returncode > 1:
        raise RuntimeError(done.stderr[-2000:])
    if task in ("command", "first"):
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, ""
    seconds, sweeps, rms = done.stdout.split()[-3:]
    return float(seconds), f"{float(sweeps):.3g} sweeps, RMS {float(rms):.4f} mm"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("older", type=Path, help="a worktree of the older commit")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=(*TASKS, "million"))
    parser.add_argument("--repeats", type=int, default=2)
    given = parser.parse_args()
    roots = {"older": given.older.resolve(), "this": ROOT}
    print("| task | older, CPU s | this, CPU s | ratio | older | this |\n| --- | ---: | ---: | ---: | --- | --- |")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data(folder)
        for task in given.tasks:
            if task == "command":  # once to fill the caches
                for which, root in roots.items():
                    run(task, root, folder, folder / which)
            least, told = dict.fromkeys(roots, np.inf), dict.fromkeys(roots, "")
            for _ in range(given.repeats):
                for which, root in roots.items():
                    seconds, told[which] = run(task, root, folder, folder / which)
                    least[which] = min(least[which], seconds)
            older, this = least.values()
            print(
                f"| {task} | {older:.2f} | {this:.2f} | {this / older:.2f} | {told['older']} | {told['this']} |",
                flush=True,
            )


if __name__ == "__main__":
    start = time.time()
    main()
    print(f"\n{time.time() - start:.0f} s in all", file=sys.stderr)
