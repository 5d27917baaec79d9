"""What it takes to keep fits from passing through themselves: real scans fitted with and without.

    pip install -e '.[bench]' && OPENBLAS_NUM_THREADS=1 python tests/bench/fit_contact.py

Every case of `fit_real.py` that is named, the heart's walls with their regions, and a cortex whose scan keeps its
normals; each is fitted twice by `fitting.fit_scan`, without and with `Priors(contact=0.25)`, after a sweep to compile.
Prints a Markdown table, lengths in mm, of pairs "without / with". `crossing` is the triangles that go through others,
where the fit starts and where it ends; `normals` the angle between the normals of surface and scan, as a mean over the
points of scans that have faces. What is not there in ../shared/data, or --data, is skipped.
"""

import argparse
import dataclasses
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from fit_real import CASES, DATA, HEART, Case, line

import fitting
import jaxsubdiv as js

OWN = {
    "heart-regions": Case(HEART, "heart_wall_regions.obj", options={"levels": 2}),
    "cortex-normals": dataclasses.replace(CASES["cortex"], options={"faces": 4400, "levels": 2}),
}
NAMES = ("head-fragment", "femur", "face", "ct", "ct-mixed", "head", "head-tri", "cortex", "heart-lv", "heart-wall")
COLUMNS = ("case", "triangles", "crossing at the start", "crossing", "RMS", "of inliers", "normals", "sweeps", "CPU s")


def scan_of(name: str, case: Case, data: Path) -> tuple[fitting.Scan, js.ControlMesh | None, dict[str, Any]]:
    """Scan, template and options; with the normals of the scan's own faces where the case is about them."""
    scan, mesh, options = case.read(data)
    if name == "cortex-normals":
        scan = dataclasses.replace(scan, normals=normals_of(data / case.scan))
    return scan, mesh, options


def normals_of(path: Path) -> np.ndarray:
    """Unit normals of the vertices of a mesh, which are the points of its scan."""
    return np.asarray(js.read_mesh(path, check=False).control().normals)


def run(name: str, data: Path) -> list[str]:
    """The row of a case."""
    case = (CASES | OWN)[name]
    found: list[tuple[fitting.FitResult, float]] = []
    for contact, sweeps in ((0.0, 1), (0.25, 1), (0.0, None), (0.25, None)):
        scan, mesh, options = scan_of(name, case, data)
        options |= {"priors": fitting.Priors(contact=contact)} | ({} if sweeps is None else {"max_sweeps": sweeps})
        began = time.process_time()
        result = fitting.fit_scan(scan, mesh, throw=False, **options).result
        if sweeps is None:
            found.append((result, time.process_time() - began))
    both = [result for result, _ in found]
    fit = both[0].fit
    start = js.find_crossings(js.refine(fit.model.scheme, fit.topology, fit.start))
    angles = ["", ""]
    if Path(case.scan).suffix in (".ply", ".stl", ".gii", ".vtp") and both[0].crossings is not None:
        angles = [f"{mean_angle(result, data / case.scan):.1f}" for result in both]
    crossing = [0 if result.crossings is None else len(result.crossings.triangles) for result in both]
    inliers = [np.sqrt(np.mean(result.distances[result.inliers] ** 2)) for result in both]
    sweeps = [f"{len(result.rms) - 1}{'' if result.report().converged else ' (not at rest)'}" for result in both]
    cells = [name, f"{start.n_triangles:,}", f"{len(start.triangles):,}", " / ".join(f"{n:,}" for n in crossing)]
    cells.append(" / ".join(f"{result.rms[-1]:.3f}" for result in both))
    cells.append(" / ".join(f"{rms:.3f}" for rms in inliers))
    cells += [" / ".join(filter(None, angles)), " / ".join(sweeps)]
    return [*cells, " / ".join(f"{seconds:.1f}" for _, seconds in found)]


def mean_angle(result: fitting.FitResult, path: Path) -> float:
    """Degrees between the normals of the surface and those of the scan's faces, over all points."""
    own, there = normals_of(path), np.asarray(js.evaluate(result.surface, result.at).normals)
    if len(own) != len(there):
        return np.nan
    cosine = np.sum(own * there, axis=1)
    return float(np.degrees(np.mean(np.arccos(np.clip(cosine * np.sign(cosine.sum()), -1, 1)))))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=DATA, help=f"folder of the scans (default: {DATA})")
    parser.add_argument("--cases", nargs="+", choices=[*CASES, *OWN], default=[*NAMES, *OWN], metavar="CASE")
    options = parser.parse_args(arguments)
    print(line(COLUMNS))
    print("|---" + "|--:" * (len(COLUMNS) - 1) + "|", flush=True)
    for name in options.cases:
        missing = [path for path in (CASES | OWN)[name].files(options.data) if not path.is_file()]
        if missing:
            print(f"\nSkipped, {name}: {missing[0]} not there.")
            continue
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            print(line(process.submit(run, name, options.data).result()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
