"""Where the time of a fit goes: its sweeps, part by part, and its start, with an empty compilation cache and a warm.

    python tests/bench/fit_parts.py                          # the head fragment that ships
    python tests/bench/fit_parts.py SCAN --control MESH      # files in mm, aligned

Prints Markdown tables. Each part is timed without the parts inside of it, so that they add up to the whole; "beside the
parts" is what no part accounts for.
"""

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

PARTS = {
    "closest points": ["fitting.solve.sweeps.closest_points"],
    "weights, noise": ["fitting.solve.sweeps.measure"],
    "what priors hold": ["fitting.solve.sweeps.hold_priors", "fitting.solve.sweeps.hold_sweep"],
    "derivatives": [
        "fitting.solve.sparse_normal.differentiate",
        "fitting.solve.sparse_normal._differentiate_tied",
    ],
    "normal equations": ["fitting.solve.sweeps.SparseNormal.linearise"],
    "factorisation": ["fitting.solve.sparse_normal.SparseEquations.factorise"],
    "solution": ["fitting.solve.sparse_normal.ArrowheadFactor.solve"],
    "strengths by the evidence": ["fitting.solve.sweeps.FromScan.update"],
    "degrees of freedom": ["fitting.solve.sweeps.count_determined"],
    "faces upside down": ["fitting.solve.sweeps.Sweeps._find_turned_over"],
    "new surface": [f"fitting.solve.sweeps.{name}" for name in ("_retract", "Model.refine", "measure_movement")],
    "analysis, once a fit": [
        "fitting.run.fit.analyse",
        "fitting.run.fit.make_scene",
        "fitting.run.fit.find_structure",
        "fitting.run.fit.Folds",
        "fitting.run.fit.sound_start",
    ],
    "rest of a sweep": ["fitting.solve.sweeps.Sweeps.step"],
}
STAGES = {"jaxpr_trace": "traced", "jaxpr_to_mlir_module": "lowered", "backend_compile": "compiled"}


class Clock:
    """Seconds and calls of every part; what runs inside another part counts for itself alone."""

    def __init__(self):
        self.seconds, self.calls, self._inside = defaultdict(float), defaultdict(int), [0.0]

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        self._inside.append(0.0)
        try:
            yield
        finally:
            whole = time.perf_counter() - start
            self.seconds[name] += whole - self._inside.pop()
            self.calls[name] += 1
            self._inside[-1] += whole

    def timed(self, name: str, function: Callable) -> Callable:
        import jax

        @functools.wraps(function)
        def run(*arguments: Any, **options: Any) -> Any:
            with self.part(name):
                return jax.block_until_ready(function(*arguments, **options))

        return run

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Every part timed while this lasts."""
        with ExitStack() as stack:
            for name, places in PARTS.items():
                for place in places:
                    patched = patch(place)
                    original, _ = patched.get_original()
                    stack.enter_context(patch(place, self.timed(name, original)))
            yield


def fit(scan: str | None, control: str | None, levels: int) -> dict:
    """One process: imports, reads, fits twice. Seconds of everything."""
    began, clock, compiling = time.perf_counter(), Clock(), defaultdict(float)
    with clock.part("imports"):
        import jax

        import fitting
        import jaxsubdiv as js

    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

    def listen(event: str, seconds: float, **about: Any) -> None:
        stage = event.rsplit("/", 1)[-1].removesuffix("_duration").removesuffix("_time")
        compiling[STAGES.get(stage, "")] += seconds

    jax.monitoring.register_event_duration_secs_listener(listen)
    with clock.part("reading"):
        example = fitting.example("head_fragment")
        points = fitting.read_scan(scan) if scan else example[0]
        mesh = js.read_mesh(control) if control else example[1]
    scheme = js.Interpolating()
    with clock.part("tables"):
        topology, start = js.build_topology(mesh, scheme, levels), mesh.control()
    with clock.part("first fit"):
        fitting.fit(scheme, topology, start, points, throw=False)
    found = {"first call": dict(clock.seconds), "compiling": dict(compiling), "until done": time.perf_counter() - began}
    clock = Clock()
    with clock.part("beside the parts"), clock.watching():
        result = fitting.fit(scheme, topology, start, points, throw=False)
    sizes = f"{points.n_points:,} points, {len(mesh.vertices):,} control vertices, {levels} levels"
    sweeps = {name: [seconds, clock.calls[name]] for name, seconds in clock.seconds.items()}
    return found | {"sweeps": sweeps, "n": len(result.rms) - 1, "sizes": sizes}


def tables(cold: dict, warm: dict) -> str:
    n, whole = warm["n"], sum(seconds for seconds, _ in warm["sweeps"].values())
    lines = [f"{warm['sizes']}; {n} sweeps, {whole:.2f} s, {1000 * whole / n:.0f} ms a sweep", ""]
    lines += ["| part of a fit | ms a sweep | % | calls |", "|---|---|---|---|"]
    for name, (seconds, calls) in sorted(warm["sweeps"].items(), key=lambda row: -row[1][0]):
        lines.append(f"| {name} | {1000 * seconds / n:.1f} | {100 * seconds / whole:.0f} | {calls} |")
    beside = warm["sweeps"]["beside the parts"][0]
    lines += ["", f"The whole over the sum of its parts: {whole / (whole - beside):.2f}", ""]
    lines += ["| start, s | empty cache | warm cache |", "|---|---|---|"]
    rows = {
        name: [run["first call"].get(name, 0.0) for run in (cold, warm)] for name in ("imports", "reading", "tables")
    }
    for stage in STAGES.values():
        rows[f"programs {stage}"] = [run["compiling"].get(stage, 0.0) for run in (cold, warm)]
    counted = [sum(values[i] for values in rows.values()) for i in range(2)]
    rows["the fit itself, and the rest"] = [run["until done"] - counted[i] for i, run in enumerate((cold, warm))]
    rows["until the fit is there"] = [run["until done"] for run in (cold, warm)]
    lines += [f"| {name} | {a:.2f} | {b:.2f} |" for name, (a, b) in rows.items()]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan", nargs="?")
    parser.add_argument("--control")
    parser.add_argument("--levels", type=int, default=2)
    parser.add_argument("--one-process", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one_process:
        print(json.dumps(fit(given.scan, given.control, given.levels)))
        return
    runs = []
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(2):
            command = [sys.executable, __file__, "--one-process", *sys.argv[1:]]
            environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
            done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
            runs.append(json.loads(done.stdout.splitlines()[-1]))
    print(tables(*runs))


if __name__ == "__main__":
    main()
