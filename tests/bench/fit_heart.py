"""One patient's heart through its beat: distances, volumes and ejection fraction beside those of biv-me.

All frames of cine MRI are fitted at once by one control mesh, with one shift a slice. `own` is the RMS distance of the
contours of each structure to their own groups of faces; of biv-me's fits of the same frames, frame by frame, and of its
volumes of the left ventricle, the published numbers stand beside. Prints Markdown, and writes the page of the series.

    pip install -e '.[bench,viz]' && python tests/bench/fit_heart.py

The data are not shipped: they are taken from ../shared/data beside the repository, or from the folder given.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from fit_protocol import DATA, rms

import fitting
import jaxsubdiv as js

CONTROL, FRAMES = "control/heart_wall_regions.obj", "heart_cine"
GROUPS = {"LAX_RV_ENDOCARDIAL": ["RV_FREEWALL", "RV_SEPTUM"]}
STRUCTURES = {"LV": ("LV_ENDOCARDIAL",), "epicardium": ("EPICARDIAL",), "RV": ("RV_FREEWALL", "RV_SEPTUM")}
# biv-me d01024f8d824, its own fits of these frames, each alone, with its own shifts of slices.
BIV_ME_RMS = {"LV": 1.26, "epicardium": 1.56, "RV": 1.64}
BIV_ME_VOLUMES = {0: 174, 4: 122, 8: 79, 12: 88, 16: 145, 20: 146, 24: 179}  # ml, of the left ventricle
BIV_ME_EJECTION = 0.547
CAVITY = "LV_ENDOCARDIAL"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("data", nargs="?", type=Path, default=DATA, help=f"folder of the data (default: {DATA})")
    parser.add_argument("--every", type=int, default=1, help="fit every so manieth frame (default: %(default)s)")
    parser.add_argument("--levels", type=int, default=2, help="of refinement (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="folder for the fit, its table, page and animation")
    options = parser.parse_args(arguments)
    paths = sorted((options.data / FRAMES).glob("*.csv"))[:: options.every]
    if len(paths) < 2 or not (options.data / CONTROL).is_file():
        print(f"error: {options.data} has no {CONTROL} and {FRAMES}. The data are not shipped: name their folder.")
        return 2
    mesh, scans = js.read_mesh(options.data / CONTROL), [fitting.read_scan(path) for path in paths]
    clock, wall = time.process_time(), time.perf_counter()

    def tell(what: object) -> None:
        print(f"{time.process_time() - clock:6.1f} CPU s: {what}", file=sys.stderr, flush=True)

    found = fitting.fit_series(
        scans, mesh, names=[path.stem for path in paths], periodic=True, levels=options.levels, regions=GROUPS,
        throw=False, on_stage=tell, on_sweep=tell,
    )  # fmt: skip
    seconds = time.process_time() - clock
    table = found.table
    report = found.result.report()
    print(
        f"{len(found)} frames, {options.levels} levels: {report.sweeps} sweeps, "
        f"{'at rest' if report.converged else 'not at rest'}; {seconds:.0f} CPU s ({time.perf_counter() - wall:.0f} s "
        f"of wall time with the table, {time.process_time() - clock - seconds:.0f} CPU s)\n"
    )
    print("| RMS, mm (median) | own | biv-me |\n|---|--:|--:|")
    words = [] if found.result.scan.regions is None else found.result.scan.regions.words()
    away = np.abs(np.asarray(found.result.distances))
    for name, parts in STRUCTURES.items():
        rows = np.array([any(part in word for part in parts) for word in words])
        print(f"| {name} | {rms(away[rows]):.2f} ({np.median(away[rows]):.2f}) | {BIV_ME_RMS[name]:.2f} |")
    volumes, deviations = table.column(f"volume {CAVITY}")
    print("\n| frame | volume of the left ventricle, ml | biv-me | off |\n|---|--:|--:|--:|")
    for path, volume, deviation in zip(paths, volumes, deviations, strict=True):
        theirs = BIV_ME_VOLUMES.get(int(path.stem.split("_")[-1]))
        if theirs is not None:
            print(f"| {path.stem} | {volume:.1f} ± {deviation:.1f} | {theirs} | {volume / theirs - 1:+.1%} |")
    ejected, deviation = table.ejection[CAVITY]
    print(f"\nEjection fraction, of the largest and smallest volume: {ejected:.3f} ± {deviation:.3f}")
    own = {path.stem: volume for path, volume in zip(paths, volumes, strict=True)}
    if {"frame_00", "frame_08"} <= set(own):
        print(f"Of frames 0 and 8: {1 - own['frame_08'] / own['frame_00']:.3f}; biv-me {BIV_ME_EJECTION}")
    mass = table.column("wall mass")[0]
    print(f"Mass of the wall {mass.mean():.0f} g, from {mass.min():.0f} to {mass.max():.0f} g over the beat")
    print(f"Shifts of the slices, mm: {np.round(np.linalg.norm(found.shifts, axis=1), 1).tolist()}")
    if options.out is not None:
        found.save(options.out)
        table.write_csv(options.out / "series.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
