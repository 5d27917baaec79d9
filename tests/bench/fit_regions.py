"""What regions do for a heart: RMS of each structure, triangles that cross, and seconds, with and without them.

Contours of both ventricles are fitted by one control mesh, whose groups are the structures. `closest` is how far the
points lie from the closest place of the surface, of whichever side; `own` from the closest place of their own groups,
which is the distance that counts, also of a fit that did not look at them: RMS, and the median, which slices that are
far out do not make. Lengths in mm. Prints a Markdown table.

    pip install -e '.[bench]' && python tests/bench/fit_regions.py

The data are not shipped: they are taken from ../shared/data beside the repository, or from --data.
"""

import argparse
import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from fit_protocol import DATA, rms

import fitting
import jaxsubdiv as js
from fitting.scan.regions import Groups

CONTROL = "control/heart_wall_regions.obj"
SCANS = ("heart_cine/frame_00.csv", "heart_cine/frame_08.csv", "heart_guidepoints_a.csv")
RV = ["RV_FREEWALL", "RV_SEPTUM"]
WAYS: dict[str, Groups | None] = {"none": None, "by the names": {}, "and long axis": {"LAX_RV_ENDOCARDIAL": RV}}
STRUCTURES = {"LV": ("LV_ENDOCARDIAL",), "epicardium": ("EPICARDIAL",), "RV": ("RV_FREEWALL", "RV_SEPTUM", "RV_ENDO")}


def row(scan: fitting.Scan, mesh: js.ControlMesh, way: str, shifts: bool, levels: int) -> list[str]:
    groups = WAYS[way]
    fitted = scan if groups is not None else dataclasses.replace(scan, regions=None)
    start = time.perf_counter()
    free = fitting.Free(shifts=shifts)
    found = fitting.fit_scan(fitted, mesh, regions=groups, throw=False, free=free, levels=levels).result
    seconds = time.perf_counter() - start
    own = fitting.match_regions(scan, mesh, WAYS["and long axis"])
    assert own is not None and scan.regions is not None
    choice = own.choice(scan, js.control_faces_of(found.scheme, found.fit.topology, found.surface, found.control))
    places = [
        js.evaluate(found.surface, fitting.closest_points(found.surface, found.points, c)) for c in (None, choice)
    ]
    away = [np.linalg.norm(np.asarray(on.points) - found.points, axis=1) for on in places]
    words = scan.regions.words()
    of = [np.array([any(part in word for part in parts) for word in words]) for parts in STRUCTURES.values()]
    median = [np.median(away[1][rows]) for rows in of]
    cells = [" / ".join(f"{rms(distances[rows]):.2f}" for rows in of) for distances in away]
    cells.append(" / ".join(f"{value:.2f}" for value in median))
    crossing = len(found.crossings.triangles)
    share = f"{crossing / found.crossings.n_triangles:.2%}"
    report = found.report()
    ended = "" if report.converged else ", not at rest"
    return [*cells, f"{report.noise:.2f}", share, f"{report.sweeps}{ended}", f"{seconds:.0f}"]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=DATA, help=f"folder of the scans (default: {DATA})")
    parser.add_argument("--scans", nargs="+", default=list(SCANS), help="default: all")
    parser.add_argument("--still", action="store_true", help="slices stay where they are")
    parser.add_argument("--levels", type=int, default=2, help="of refinement (default: %(default)s)")
    options = parser.parse_args(arguments)
    missing = [path for path in map(options.data.joinpath, (CONTROL, *options.scans)) if not path.is_file()]
    if missing:
        print(f"error: {missing[0]} is not there. The data are not shipped: name their folder with --data.")
        return 2
    names = " / ".join(STRUCTURES)
    print(f"| scan | regions | closest: {names} | own: {names} | median | noise | triangles that cross | sweeps | s |")
    print("|---|---|--:|--:|--:|--:|--:|--:|--:|", flush=True)
    mesh = js.read_mesh(options.data / CONTROL)
    for name in options.scans:
        scan = fitting.read_scan(options.data / name)
        assert scan.regions is not None
        for way, groups in WAYS.items():
            if groups and not set(groups) & set(scan.regions.names):
                continue  # the names say all
            print(
                "| " + " | ".join([name, way, *row(scan, mesh, way, not options.still, options.levels)]) + " |",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
