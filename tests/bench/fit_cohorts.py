"""What cohorts do for real subjects: frames of a heart, templates from two first subjects, and half a skull filled.

`heart` fits frames of one heart from the fit of the first, as a user may do: RMS, convergence, and what is warned of.
`first` makes the mean of some skulls twice, each time from another first one, and tells how far apart the means are.
`half` fits all skulls, and then the half of each of some, by the family of all others. Errors are distances from the
points of the half that was left out to the surface. Mirrored: the half that is seen is mirrored about the plane of
the template where it was aligned, or where the family's member lies, or, as a bound, about that of the whole skull.
`killed` fits 200 subjects made from a scan that ships, in a process that is killed three times at random moments and
started again, and in one that is not, and compares the fits bit for bit.
`scale` fits cohorts of other numbers of points and subjects at once, each in a process of its own: CPU seconds a
subject once compiled, of all its preparation too; memory of the device as told before; and the most of the process.
Only points of a skull that are seen from outside count. Lengths in mm. Prints Markdown tables.

    pip install -e '.[bench]' && python tests/bench/fit_cohorts.py half --subjects 3 8 14

The data are not shipped: they are taken from ../shared/data beside the repository, or from --data.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from fit_protocol import DATA, rms

import fitting
import jaxsubdiv as js
from fitting.model.priors.symmetry import Plane, symmetry_of
from fitting.model.procrustes import align_shape
from fitting.start.family import place_member
from fitting.start.symmetric_mesh import find_mirror_plane, make_symmetric

VIEWS, CELL, DEPTH, LEAST_VIEWS = 60, 0.25, 0.3, 5  # mm: what is seen from outside
POINTS, FACES, DEVIATION = 3000, 1000, 0.15
GAP = 0.3  # mm beside the mirror plane that are not judged


def seen_from_outside(points: np.ndarray) -> np.ndarray:
    """Points that lie foremost, or nearly, in enough of many views."""
    k = np.arange(VIEWS)
    z, turn = 1 - 2 * (k + 0.5) / VIEWS, np.pi * (3 - 5**0.5) * k
    seen = np.zeros(len(points), int)
    for view in np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1):
        aside = np.cross(view, np.eye(3)[int(np.argmin(np.abs(view)))])
        aside /= np.linalg.norm(aside)
        cells = np.floor(np.stack([points @ aside, points @ np.cross(view, aside)], axis=1) / CELL).astype(int)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        front = np.full(cell.max() + 1, -np.inf)
        np.maximum.at(front, cell.ravel(), points @ view)
        seen += points @ view > front[cell.ravel()] - DEPTH
    return seen >= LEAST_VIEWS


def read_skull(folder: Path, name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points of the outside, and landmarks by name."""
    mesh = trimesh.load(folder / f"{name}.ply", process=False)
    points = np.asarray(trimesh.sample.sample_surface(mesh, 60_000, seed=0)[0])
    points = points[seen_from_outside(points)]
    points = points[np.random.default_rng(0).permutation(len(points))]
    file = json.loads((folder / f"{name}.mrk.json").read_text())
    marks = {one["label"]: np.array(one["position"]) for one in file["markups"][0]["controlPoints"]}
    middle = np.mean(list(marks.values()), axis=0)
    return points - middle, {name: at - middle for name, at in marks.items()}


def off(surface: js.RefinedSurface, points: np.ndarray) -> np.ndarray:
    on = np.asarray(js.evaluate(surface, fitting.closest_points(surface, points)).points)
    return np.linalg.norm(on - points, axis=1)


def heart(data: Path) -> None:
    scheme, free = js.Interpolating(), fitting.Free(shifts=False)
    mesh = js.read_mesh(data / "control/heart_wall_regions.obj")
    scans = [fitting.read_scan(data / f"heart_cine/frame_{k:02d}.csv") for k in range(0, 25, 4)]
    first = fitting.fit_scan(scans[0], mesh, throw=False, levels=1, free=free).result
    matches = [fitting.match_regions(scan, mesh) for scan in scans]
    print("| start and pilot | regions | converged | RMS of each frame | warned |\n|---|---|--:|--:|---|")
    for pilot, regions in ((None, None), (first, None), (first, matches)):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = fitting.fit_cohort(
                scheme, first.fit.topology, first.control, scans, free=free, pilot=pilot, regions=regions
            )
        last = " ".join(f"{row[n]:.2f}" for row, n in zip(found.rms, found.sweeps, strict=True))
        words = "pilot" if any("pilot's own scan" in str(one.message) for one in told) else ""
        names = ("own fit" if pilot is None else "fit of the template"), ("" if regions is None else "yes")
        print(f"| {names[0]} | {names[1]} | {found.converged.sum()} of {len(scans)} | {last} | {words} |", flush=True)


def first_subjects(data: Path, n: int) -> None:
    names = sorted(path.stem for path in (data / "skulls").glob("*.ply"))[:n]
    skulls = [read_skull(data / "skulls", name) for name in names]
    scans, marks = [fitting.Scan(points[:POINTS]) for points, _ in skulls], [own for _, own in skulls]
    means = []
    print("| first | rounds | the last moved the mean | at rest | s |\n|---|--:|--:|---|--:|")
    for first in (0, n - 1):
        start = time.perf_counter()
        found = fitting.make_template(
            scans, faces=FACES // 2, closed=True, first=first, landmarks=marks, landmark_deviation=DEVIATION, rounds=3
        )
        means.append(found)
        moved = " ".join(f"{value:.3f}" for value in found.moved)
        seconds = time.perf_counter() - start
        print(f"| {names[first]} | {len(found.moved)} | {moved} | {found.at_rest} | {seconds:.0f} |", flush=True)
    scheme = js.Interpolating()
    surfaces = []
    for one in means:  # laid on the first subject, whose fit both have
        own = np.asarray(one.cohort.control.vertices[0], np.float64)
        placed = js.ControlMesh(align_shape(np.asarray(one.mesh.vertices), own, scale=False), one.mesh.faces)
        surfaces.append(js.refine(scheme, js.build_topology(placed, scheme, 1), placed.control()))
    there = fitting.align(
        js.ControlMesh(surfaces[1].vertices, surfaces[1].faces),
        fitting.Scan(np.asarray(surfaces[0].vertices)),
        kind="rigid",
    )
    differ = off(surfaces[0], np.asarray(there.mesh.vertices))
    subjects = off(surfaces[0], np.asarray(scans[0].points))
    print(f"\nmeans apart: RMS {rms(differ):.3f}, median {np.median(differ):.3f}; a subject: {np.median(subjects):.3f}")


def family_of_skulls(data: Path, folder: Path) -> tuple[fitting.Cohort, fitting.Symmetry]:
    """All skulls fitted by one symmetric mesh, and its symmetry; kept in a folder."""
    if (folder / "cohort.json").is_file():
        return fitting.load_cohort(folder), fitting.find_symmetry(js.read_mesh(folder / "mesh.npz"))
    names = sorted(path.stem for path in (data / "skulls").glob("*.ply"))
    skulls = [read_skull(data / "skulls", name) for name in names]
    mesh = make_symmetric(fitting.control_mesh(fitting.Scan(skulls[0][0]), faces=FACES, closed=True))
    scheme = js.Interpolating()
    topology = js.build_topology(mesh, scheme, 1)
    scans, places, controls = [], [], []
    for points, marks in skulls:
        own, others = (np.stack(list(one.values())) for one in (marks, skulls[0][1]))
        whole = align_shape(np.concatenate([others, others]), np.concatenate([own, own]))[: len(own)]
        # The same motion for the mesh: an affine map is known by where four and more points went.
        ends = np.linalg.lstsq(np.column_stack([others, np.ones(len(others))]), whole, rcond=None)[0]
        moved = np.column_stack([np.asarray(mesh.vertices), np.ones(len(mesh.vertices))]) @ ends
        controls.append(js.ControlMesh(moved, mesh.faces).control())
        places.append(fitting.Landmarks(own, whole))
        scans.append(fitting.Scan(points[:POINTS]))
    options = {"landmarks": places, "landmark_deviation": DEVIATION, "names": names}
    first = fitting.fit_cohort(scheme, topology, controls, scans, priors=fitting.Priors(likeness=0.0), **options)
    found = fitting.regroup(first, rounds=1, priors=fitting.Priors(), symmetry=fitting.find_symmetry(mesh))
    found.cohort.save(folder)
    js.write_mesh(folder / "mesh.npz", mesh)
    return found.cohort, fitting.find_symmetry(mesh)


def half(data: Path, subjects: Sequence[int], folder: Path) -> None:
    cohort, symmetry = family_of_skulls(data, folder)
    shapes, result = np.asarray(cohort.control.vertices, np.float64), cohort.result(0)
    topology, scheme, faces = result.fit.topology, js.Interpolating(), result.control_mesh.faces
    rows: dict[str, list[float]] = {}
    for i in subjects:
        whole = np.asarray(cohort.scans[i].points, np.float64)
        middle, normal = find_mirror_plane(js.ControlMesh(shapes[i], faces))
        side = (whole - middle) @ normal
        seen, lost = whole[side < 0], whole[side > GAP]
        shape = fitting.ShapeModes.of(fitting.shape_modes(np.delete(shapes, i, axis=0)))
        assert shape is not None
        mean = js.ControlMesh(np.asarray(shape.mean, np.float64), faces)
        placed = fitting.align(mesh=mean, scan=fitting.Scan(seen), kind="rigid").mesh
        modes = np.asarray(shape.modes * shape.deviations[:, None, None], np.float64)
        member = js.ControlMesh(place_member(mean.vertices, modes, placed, fitting.Scan(seen)).vertices, faces)
        own, family = fitting.Priors(), fitting.Priors(shape=shape)
        planes = {
            name: symmetry_of(symmetry.partner, np.asarray(one.vertices)).plane
            for name, one in (("template's", placed), ("member's", member))
        } | {"whole skull's": Plane(middle, normal)}
        ways = {"template": (placed, seen, own), "family": (member, seen, family)}
        for name, plane in planes.items():
            both = np.concatenate([seen, plane.mirror(seen)])
            ways[f"mirrored, {name} plane"] = member if name == "member's" else placed, both, own
        ways["whole skull (bound)"] = placed, whole, own
        for name, (start, points, priors) in ways.items():
            found = fitting.fit(scheme, topology, start.control(), fitting.Scan(points), priors=priors, throw=False)
            rows.setdefault(name, []).append(rms(off(found.surface, lost)))
            print(f"{cohort.names[i]} {name}: {rows[name][-1]:.3f}", file=sys.stderr, flush=True)
    print(
        "| prior | " + " | ".join(cohort.names[i] for i in subjects) + " | mean |\n|---|" + "--:|" * (len(subjects) + 1)
    )
    for name, values in rows.items():
        print(f"| {name} | " + " | ".join(f"{value:.3f}" for value in [*values, float(np.mean(values))]) + " |")


def make_subjects(n: int) -> tuple[js.ControlMesh, list[fitting.Scan]]:
    """A template, and scans of different lengths whose anatomy is stretched and bent at random."""
    scan, mesh = fitting.example("head_fragment")
    rng, points = np.random.default_rng(0), np.asarray(scan.points, np.float64)
    middle, size = points.mean(axis=0), np.ptp(points, axis=0).max()
    scans = []
    for _ in range(n):
        some = points[rng.choice(len(points), rng.integers(800, 1600), replace=False)] - middle
        bent = (
            some * (1 + rng.normal(scale=0.04, size=3))
            + rng.normal(scale=0.02, size=3) * some[:, [1, 2, 0]] ** 2 / size
        )
        scans.append(fitting.Scan(bent + middle + rng.normal(scale=0.2, size=bent.shape)))
    return mesh, scans


def fit_subjects(folder: Path, n: int) -> None:
    """One process of `killed`: fits all, goes on where an earlier one was killed, and saves the fits."""
    mesh, scans = make_subjects(n)
    scheme = js.Interpolating()
    topology = js.build_topology(js.ControlMesh(mesh.vertices, mesh.faces), scheme, 1)
    start = time.perf_counter()
    found = fitting.fit_cohort(
        scheme, topology, mesh.control(), scans, checkpoint=folder, on_stage=lambda words: print(words, flush=True)
    )
    print(f"all after {time.perf_counter() - start:.0f} s, {found.converged.sum()} converged", flush=True)
    found.save(folder)


def killed(folder: Path, n: int, kills: int) -> None:
    rng, names = np.random.default_rng(0), ("once", "killed")

    def start(name: str) -> subprocess.Popen:
        command = [sys.executable, __file__, "fit_subjects", "--family", str(folder / name), "--n", str(n)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def kept(name: str) -> int:
        return len(list((folder / name).glob("checkpoint_of_cohort_*.npz")))

    print("| run | seconds | ended by | buckets kept before and after |\n|---|--:|---|---|", flush=True)
    for name, moments in (("once", []), ("killed", [*rng.uniform(0.1, 0.9, kills)])):
        share = 0.0
        for run in range(len(moments) + 1):
            before, began, process = kept(name), time.perf_counter(), start(name)
            if run < len(moments):  # a part of what was left, counted in buckets: how long one takes is not known
                share += (1 - share) * moments[run] / 2
                while kept(name) < share * n and process.poll() is None:
                    time.sleep(float(rng.uniform(0, 0.1)))
                process.kill()
            lines = (process.communicate()[0] or "").splitlines()
            ended = "SIGKILL" if process.returncode < 0 else lines[-1]
            counts = f"{before}, {kept(name)}"
            print(f"| {name} | {time.perf_counter() - began:.0f} | {ended} | {counts} |", flush=True)
    once, again = (fitting.load_cohort(folder / name) for name in names)
    for name in ("h", "weights", "rms", "sweeps"):
        same = np.array_equal(*(np.asarray(getattr(one, name)) for one in (once, again)), equal_nan=True)
        print(f"{name}: {'identical' if same else 'DIFFERENT'}")
    same = np.array_equal(once.control.vertices, again.control.vertices)
    print(f"control vertices: {'identical' if same else 'DIFFERENT'}")


def scale() -> None:
    cases = [(1000, 1), (1000, 8), (4000, 1), (16000, 1)]
    print("| points | at once | CPU s a subject | CPU s to compile | MB on the device | GB in all |", flush=True)
    print("|--:|--:|--:|--:|--:|--:|", flush=True)
    for case in cases:
        command = [sys.executable, __file__, "scale_case", "--subjects", *map(str, case)]
        out = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
        print(out.splitlines()[-1], flush=True)


def scale_case(n_points: int, at_once: int) -> None:
    scan, mesh = fitting.example("head_fragment")
    rng, points, n, scheme = np.random.default_rng(0), np.asarray(scan.points, np.float64), 8, js.Interpolating()
    topology = js.build_topology(js.ControlMesh(mesh.vertices, mesh.faces), scheme, 1)
    scans = []
    for _ in range(n):
        some = points[rng.integers(0, len(points), n_points)] * (1 + rng.normal(scale=0.03, size=3))
        scans.append(fitting.Scan(some + rng.normal(scale=0.2, size=some.shape)))
    told, seconds = [], []
    for _ in range(2):
        began = time.process_time()
        fitting.fit_cohort(
            scheme,
            topology,
            mesh.control(),
            scans,
            priors=fitting.Priors(bend=0.01, likeness=0.5),
            at_once=at_once,
            on_stage=told.append,
        )
        seconds.append(time.process_time() - began)
    memory = next(words for words in told if " MB" in words).split(" in ")[-1].split(" MB")[0]
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9  # KiB on Linux
    own = seconds[1] / n
    print(f"| {n_points:,} | {at_once} | {own:.2f} | {seconds[0] - seconds[1]:.0f} | {memory} | {most:.2f} |")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("what", choices=("heart", "first", "half", "killed", "fit_subjects", "scale", "scale_case"))
    parser.add_argument("--data", type=Path, default=DATA, help=f"folder of the scans (default: {DATA})")
    parser.add_argument("--subjects", type=int, nargs="+", default=[3, 8, 14], help="whose half is fitted")
    parser.add_argument("--n", type=int, help="skulls of a mean, or subjects of `killed` (default: 6, 200)")
    parser.add_argument("--family", type=Path, default=Path("skull_family"), help="folder that keeps the fits")
    options = parser.parse_args(arguments)
    if options.what == "killed":
        killed(options.family, options.n or 200, 3)
        return 0
    if options.what == "scale":
        scale()
        return 0
    if options.what == "scale_case":
        scale_case(*options.subjects)
        return 0
    if options.what == "fit_subjects":
        fit_subjects(options.family, options.n)
        return 0
    if not (options.data / "skulls").is_dir():
        print(
            f"error: {options.data / 'skulls'} is not there. The data are not shipped: name their folder with --data."
        )
        return 2
    if options.what == "heart":
        heart(options.data)
    elif options.what == "first":
        first_subjects(options.data, options.n or 6)
    else:
        half(options.data, options.subjects, options.family)
    return 0


if __name__ == "__main__":
    sys.exit(main())
