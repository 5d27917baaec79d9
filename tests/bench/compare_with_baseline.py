"""What got slower since `baseline.json`: CPU seconds of refinements and of a fit over those of peers, taken by turns.

    pip install -e '.[bench]'
    python tests/bench/compare_with_baseline.py            # exit status 1 where a ratio grew by more than a fifth
    python tests/bench/compare_with_baseline.py --write    # makes this checkout the baseline

Refinements (float32, 4 levels, the meshes of `bench_refine.py`) are timed beside the same formulas in C++, on one
thread, and beside libigl's Loop matrices; the fit of the femur that ships, warm and with compilation, beside trimesh's
`nricp_amberg` of the same mesh and scan. Of each pair the median of the rounds counts. What seems slower is timed once
more. A peer that is missing is left out. Ratios depend on the machine: compare on that of the baseline, which the file
describes.
"""

import argparse
import functools
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

# Threads that wait would count as work where other programs run; read when the libraries are loaded.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
ROOT = Path(__file__).resolve().parents[2]
BASELINE = Path(__file__).with_name("baseline.json")
MORE = 1.2
"""By more than a fifth: slower."""
Work = Callable[[], object]

FIT = """
import os, sys, warnings
import fitting, jaxsubdiv as js
warnings.simplefilter("ignore")
scan, mesh = fitting.example("femur_distal")
topology = js.build_topology(mesh, js.Interpolating(), 2)
for line in sys.stdin:
    before = os.times()
    fitting.fit(js.Interpolating(), topology, mesh.control(), scan, throw=False)
    after = os.times()
    print(after.user + after.system - before.user - before.system, flush=True)
"""


def cpu_seconds(work: Work) -> float:
    """Of all threads of this process."""
    start = time.process_time()
    work()
    return time.process_time() - start


def find_refinements() -> dict[str, tuple[Work, Work]]:
    """Name -> ours and the peer's."""
    import bench_refine
    import jax
    import numpy as np
    from gathers import Gathers, library

    import jaxsubdiv as js

    def compile_work(function: Callable, *arguments: object) -> Work:
        compiled = jax.jit(function).lower(*arguments).compile()
        return lambda: jax.block_until_ready(compiled(*arguments))

    found: dict[str, tuple[Work, Work]] = {}
    try:
        library()
    except (OSError, subprocess.CalledProcessError) as error:
        print(f"C++ is left out: {error}", file=sys.stderr)
    else:
        for kind in ("triangles", "quads"):
            peer = Gathers(*bench_refine.prepared(kind))
            for work, function in bench_refine.WORK.items():
                theirs = functools.partial(peer.run, work == "normals")
                found[f"{kind}: {work}, over C++"] = compile_work(function, *bench_refine.prepared(kind)), theirs
    try:
        import igl
    except ImportError as error:
        print(f"libigl is left out: {error}", file=sys.stderr)
    else:
        mesh, (_, control) = bench_refine.control_mesh("triangles"), bench_refine.prepared("triangles")
        topology = js.build_topology(mesh, js.Loop(), bench_refine.LEVELS)
        faces, matrices, x = np.asarray(mesh.faces[3]), [], np.asarray(mesh.vertices, np.float32)
        for _ in range(bench_refine.LEVELS):
            matrix, faces = igl.loop_matrix(faces.astype(np.int64))
            matrices.append(matrix.astype(np.float32))
        ours = compile_work(lambda control: js.refine_vertices(js.Loop(), topology, control), control)
        theirs = functools.partial(functools.reduce, lambda x, matrix: matrix @ x, matrices, x)
        found["Loop, over libigl's matrices"] = ours, theirs
    return found


def time_refinements(works: dict[str, tuple[Work, Work]], rounds: int) -> dict[str, float]:
    seconds: dict[str, list[list[float]]] = {name: [[], []] for name in works}
    for i in range(rounds + 1):
        for name, pair in works.items():
            for kept, work in zip(seconds[name], pair, strict=True):
                once = cpu_seconds(work)
                if i:  # the first warms up
                    kept.append(once)
    return {name: statistics.median(ours) / statistics.median(theirs) for name, (ours, theirs) in seconds.items()}


def time_fits(rounds: int) -> dict[str, float]:
    """Fits in a process of their own with an empty cache, by turns with the peer here."""
    import numpy as np
    import trimesh

    import fitting

    scan, mesh = fitting.example("femur_distal")
    template, points = trimesh.Trimesh(mesh.vertices, mesh.faces[3]), np.asarray(scan.points, np.float64)

    def register() -> None:
        trimesh.registration.nricp_amberg(template, points, use_faces=False)

    theirs: list[float] = []
    ours: list[float] = []
    with tempfile.TemporaryDirectory() as cache:
        paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache, "PYTHONPATH": paths}
        with subprocess.Popen(
            [sys.executable, "-c", FIT], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdin and process.stdout
            for _ in range(rounds + 1):
                process.stdin.write("fit\n")
                process.stdin.flush()
                ours.append(float(process.stdout.readline()))
                theirs.append(cpu_seconds(register))
            process.stdin.close()
    first, *warm = ours
    return {
        "fit with compilation, over nricp_amberg": first / statistics.median(theirs),
        "fit, over nricp_amberg": statistics.median(warm) / statistics.median(theirs),
    }


def find_slower(found: dict[str, float], before: dict[str, float]) -> list[str]:
    return [name for name, ratio in found.items() if name in before and ratio > MORE * before[name]]


def describe_machine() -> dict[str, str]:
    import jax

    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
        "python": platform.python_version(),
        "jax": jax.__version__,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the baseline instead of comparing with it")
    parser.add_argument("--rounds", type=int, default=15, help="of refinements; a fifth as many of fits")
    options = parser.parse_args()
    sys.path[1:1] = [str(ROOT), str(ROOT / "tests")]  # after this folder, which has an `opensubdiv` of its own
    works, rounds_of_fits = find_refinements(), max(1, options.rounds // 5)
    found = time_refinements(works, options.rounds) | time_fits(rounds_of_fits)
    if options.write:
        ratios = {name: round(ratio, 2) for name, ratio in found.items()}
        BASELINE.write_text(json.dumps({"made with": describe_machine(), "ratios": ratios}, indent=2) + "\n")
    baseline = json.loads(BASELINE.read_text())
    before = baseline["ratios"]
    if slower := find_slower(found, before):
        again = time_refinements({name: works[name] for name in slower if name in works}, options.rounds)
        if any(name not in works for name in slower):
            again |= time_fits(rounds_of_fits)
        found |= {name: min(found[name], ratio) for name, ratio in again.items()}
    slower = find_slower(found, before)
    print("| CPU seconds | baseline | now | |\n| --- | ---: | ---: | --- |")
    for name, ratio in found.items():
        old = f"{before[name]:.2f}" if name in before else "none"
        print(f"| {name} | {old} | {ratio:.2f} | {'slower' if name in slower else ''} |")
    for name in before.keys() - found.keys():
        print(f"| {name} | {before[name]:.2f} | not timed | |")
    print(f"\nBaseline: {', '.join(baseline['made with'].values())}; now: {', '.join(describe_machine().values())}.")
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
