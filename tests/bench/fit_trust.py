"""Fits that are wrong, and fits that are right: which of them say so, and which raise a false alarm.

    pip install -e '.[bench]' && OPENBLAS_NUM_THREADS=1 python tests/bench/fit_trust.py

Prints a Markdown table: for every situation whether the fit is wrong, by the true surface where that is known, and the
names of what it finds to speak against itself; at the end the hits, misses and false alarms. A situation is refused
where an error ends it. Scans that do not ship are taken from ../shared beside the repository, or from --shared; what is
not there is skipped.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import fit_protocol
import fit_real
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

import fitting
import jaxsubdiv as js

SHARED = Path(__file__).resolve().parents[3] / "shared"
# A fit is wrong whose surface is farther than this from half, or from a tenth, of what it should show, over its size.
MEDIAN_OFF, TENTH_OFF = 0.015, 0.05


class Situation(NamedTuple):
    """A scan, a start, and what is known of the right answer."""

    scan: fitting.Scan
    mesh: js.ControlMesh | None = None
    options: dict[str, Any] = {}  # noqa: RUF012
    truth: Float[np.ndarray, "n 3"] | None = None
    """Points of what the surface should show."""
    wrong: bool | None = None
    """Known beforehand, where no truth tells."""
    deserves_a_word: bool = False
    """The surface may be right, but the scan shows more than it: silence would be wrong all the same."""


def _head(shared: Path) -> Trimesh:
    return trimesh.load(shared / "data" / "head_colin27.ply", process=False)  # type: ignore[return-value]


def _points(surface: Trimesh, n: int, sigma: float, seed: int = 0) -> Float[np.ndarray, "n 3"]:
    rng = np.random.default_rng(seed)
    return fit_protocol.sample(surface, n, rng).points + rng.normal(scale=sigma, size=(n, 3))


def _template(shared: Path, name: str) -> js.ControlMesh:
    return js.read_mesh(shared / "data" / "control" / name)


def _moved(mesh: js.ControlMesh, turn: Float[np.ndarray, "3"] = (0, 0, 0), scale: float = 1.0, shift=(0, 0, 0)):
    """Turned about its middle by a rotation vector in degrees, scaled there and shifted."""
    x = np.asarray(mesh.vertices, np.float64)
    about, rotation = x.mean(axis=0), Rotation.from_rotvec(np.asarray(turn, float), degrees=True)
    normals = None if mesh.normals is None else rotation.apply(np.array(mesh.normals))
    return js.ControlMesh(scale * rotation.apply(x - about) + about + np.asarray(shift, float), mesh.faces, normals)


def _protocol(case: str, seed: int) -> Callable[[Path], Situation]:
    def make(shared: Path) -> Situation:
        settings = fit_protocol.CASES[case]._replace(vertices=330)
        truth = _head(shared)
        problem, _ = fit_protocol.draw(truth, settings, seed, shared / "data")
        template = problem.template(problem.n_vertices)
        mesh = js.ControlMesh(template.vertices, template.faces, template.vertex_normals)
        return Situation(fitting.Scan(problem.scan), mesh, {"levels": 2}, _points(truth, 5000, 0))

    return make


def _real(name: str) -> Callable[[Path], Situation]:
    def make(shared: Path) -> Situation:
        scan, mesh, options = fit_real.CASES[name].read(shared / "data")
        return Situation(scan, mesh, options, wrong=False)

    return make


def _tibia(name: str) -> Callable[[Path], Situation]:
    def make(shared: Path) -> Situation:
        points = fitting.read_scan(shared / "cases" / name)
        whole = np.asarray(fitting.read_scan(shared / "cases" / "tibia_slices5.xyz").points)
        return Situation(points, None, {"levels": 2, "faces": 300}, whole, deserves_a_word="slices" not in name)

    return make


def _femur(n: int = 5000, sigma: float = 0.2) -> tuple[Float[np.ndarray, "n 3"], js.ControlMesh]:
    scan, mesh = fitting.example("femur_distal")
    points = np.asarray(scan.draw(n).points)
    return points + np.random.default_rng(1).normal(scale=sigma, size=points.shape), mesh


def two_bones_with_template(shared: Path) -> Situation:
    points, mesh = _femur()
    both = np.concatenate([points, points + (110.0, 0, 0)])
    return Situation(fitting.Scan(both), mesh, {"levels": 2}, points, deserves_a_word=True)


def table_with_template(shared: Path) -> Situation:
    points, mesh = _femur()
    low, high = points.min(axis=0), points.max(axis=0)
    table = np.random.default_rng(0).uniform(low - 80, high + 80, (5000, 3))
    table[:, 2] = low[2] - 3
    both = np.concatenate([points, table])
    return Situation(fitting.Scan(both), mesh, {"levels": 2}, points, deserves_a_word=True)


def half_head(turn: float) -> Callable[[Path], Situation]:
    def make(shared: Path) -> Situation:
        truth = _head(shared)
        points = _points(truth, 10_000, 0.5)
        kept = points[points[:, 1] > np.median(points[:, 1])]
        mesh = _moved(_template(shared, "head_tri.obj"), (0, 0, turn))
        return Situation(fitting.Scan(kept), mesh, {"levels": 2}, _points(truth, 5000, 0))

    return make


def half_of_another(seed: int, turn: tuple[float, float, float]) -> Callable[[Path], Situation]:
    """The back of a head, and a template of another person's that is turned."""

    def make(shared: Path) -> Situation:
        given = _protocol("base", seed)(shared)
        assert given.mesh is not None
        points = np.asarray(given.scan.points)
        back = points[:, 1] < np.median(points[:, 1])
        return Situation(fitting.Scan(points[back]), _moved(given.mesh, turn), {"levels": 2}, given.truth)

    return make


def two_walls(apart: float, sigma: float) -> Callable[[Path], Situation]:
    def make(shared: Path) -> Situation:
        sphere = trimesh.creation.icosphere(4, 60.0)
        inner, outer = (
            _points(Trimesh(sphere.vertices * r, sphere.faces), 6000, sigma, i)
            for i, r in ((0, 1), (1, 1 + apart / 60))
        )
        return Situation(fitting.Scan(np.concatenate([inner, outer])), None, {"levels": 2, "faces": 300}, wrong=True)

    return make


def two_walls_with_template(shared: Path) -> Situation:
    given = two_walls(3.0, 0.2)(shared)
    sphere = trimesh.creation.icosphere(2, 61.0)
    return given._replace(mesh=js.ControlMesh(sphere.vertices, sphere.faces, sphere.vertex_normals))


def coarse_face(shared: Path) -> Situation:
    given = _real("face")(shared)
    return Situation(given.scan, None, {"levels": 2, "faces": 40}, np.asarray(given.scan.points))


def far_template(off: float) -> Callable[[Path], Situation]:
    def make(shared: Path) -> Situation:
        points, mesh = _femur()
        return Situation(fitting.Scan(points), _moved(mesh, shift=(off, 0, 0)), {"levels": 2, "pose": None}, points)

    return make


def tubes(faces: int) -> Callable[[Path], Situation]:
    """A vessel that branches, 100 mm long and 6 mm wide."""

    def make(shared: Path) -> Situation:
        rng = np.random.default_rng(0)
        parts = []
        for end in ((0.0, 0, -50), (18.0, 0, 50), (-18.0, 0, 50)):
            t, a = rng.uniform(size=3000), rng.uniform(0, 2 * np.pi, 3000)
            axis = np.asarray(end) / np.linalg.norm(end)
            first = np.cross(axis, (0, 1.0, 0))
            first /= np.linalg.norm(first)
            ring = np.cos(a)[:, None] * first + np.sin(a)[:, None] * np.cross(axis, first)
            parts.append(t[:, None] * np.asarray(end) + 3 * ring)
        points = np.concatenate(parts) + rng.normal(scale=0.1, size=(9000, 3))
        return Situation(fitting.Scan(points), None, {"levels": 2, "faces": faces}, points)

    return make


def mirrored(shared: Path) -> Situation:
    points, mesh = _femur()
    flipped = points * (-1, 1, 1)
    return Situation(fitting.Scan(flipped), mesh, {"levels": 2}, wrong=True)


def other_anatomy(scan: str, template: str) -> Callable[[Path], Situation]:
    def make(shared: Path) -> Situation:
        points = fitting.read_scan(shared / "data" / scan)
        return Situation(points.draw(6000), _template(shared, template), {"levels": 2}, wrong=True)

    return make


def rigid_twice_as_large(shared: Path) -> Situation:
    points, mesh = _femur()
    return Situation(fitting.Scan(points), _moved(mesh, scale=1.9), {"levels": 2, "pose": "rigid"}, points)


def similar_twice_as_large(shared: Path) -> Situation:
    points, mesh = _femur()
    return Situation(fitting.Scan(points), _moved(mesh, scale=1.4), {"levels": 2}, points)


def closed_face(shared: Path) -> Situation:
    given = _real("face")(shared)
    return Situation(given.scan, None, {"levels": 2, "faces": 300, "closed": True}, wrong=True)


def coarse_cortex(shared: Path) -> Situation:
    given = _real("cortex")(shared)
    return Situation(given.scan, None, {"levels": 2, "faces": 100}, wrong=True)


def inward_normals(shared: Path) -> Situation:
    truth = _head(shared)
    drawn = fit_protocol.sample(truth, 8000, np.random.default_rng(0))
    return Situation(
        fitting.Scan(drawn.points, -drawn.normals), _template(shared, "head_tri.obj"), {"levels": 2}, drawn.points
    )


def mixed_normals(shared: Path) -> Situation:
    """A shell 2 mm thick, both sides of it, with true normals, and a template of its outside."""
    sphere = trimesh.creation.icosphere(4, 60.0)
    outer, inner = (
        fit_protocol.sample(sphere, 5000, np.random.default_rng(0)),
        fit_protocol.sample(sphere, 5000, np.random.default_rng(1)),
    )
    points = np.concatenate([outer.points, inner.points * 58 / 60])
    ball = trimesh.creation.icosphere(2, 60.0)
    return Situation(
        fitting.Scan(points, np.concatenate([outer.normals, -inner.normals])),
        js.ControlMesh(ball.vertices, ball.faces, ball.vertex_normals),
        {"levels": 2},
        outer.points,
        deserves_a_word=True,
    )


def three_objects(shared: Path) -> Situation:
    points, _ = _femur()
    return Situation(
        fitting.Scan(np.concatenate([points, points + (120.0, 0, 0), points + (0, 130.0, 0)])),
        None,
        {"levels": 2, "faces": 300},
        np.concatenate([points, points + (120.0, 0, 0), points + (0, 130.0, 0)]),
    )


def repeated_slab(shared: Path) -> Situation:
    points, _ = _femur()
    slab = points[points[:, 0] > np.quantile(points[:, 0], 0.7)]
    return Situation(fitting.Scan(np.concatenate([points, *[slab] * 30])), None, {"levels": 2, "faces": 300}, points)


def zeros_for_no_return(shared: Path) -> Situation:
    points, _ = _femur()
    points = points + (400.0, 0, 0)
    return Situation(
        fitting.Scan(np.concatenate([points, np.zeros((3000, 3))])), None, {"levels": 2, "faces": 300}, points
    )


def lone_far_point(shared: Path) -> Situation:
    points, _ = _femur()
    return Situation(
        fitting.Scan(np.concatenate([points, [[5000.0, 0, 0]]])), None, {"levels": 2, "faces": 300}, points
    )


def lone_far_point_with_template(shared: Path) -> Situation:
    return lone_far_point(shared)._replace(mesh=_femur()[1], options={"levels": 2})


def noise_alone(shared: Path) -> Situation:
    points = np.random.default_rng(0).uniform(-50, 50, (6000, 3))
    ball = trimesh.creation.icosphere(2, 50.0)
    return Situation(
        fitting.Scan(points), js.ControlMesh(ball.vertices, ball.faces, ball.vertex_normals), {"levels": 2}, wrong=True
    )


def open_patch_for_a_head(shared: Path) -> Situation:
    return Situation(
        fitting.Scan(_points(_head(shared), 8000, 0.5)),
        _template(shared, "head_fragment_quad.obj"),
        {"levels": 2},
        _points(_head(shared), 5000, 0),
    )


def cut_short(shared: Path) -> Situation:
    points, mesh = _femur()
    return Situation(
        fitting.Scan(points), _moved(mesh, shift=(6.0, 0, 0)), {"levels": 2, "pose": None, "max_sweeps": 2}, wrong=True
    )


def skull_box(shared: Path) -> Situation:
    scan = fitting.read_scan(shared / "data" / "skulls" / "A_J.ply")
    return Situation(scan.draw(12_000), None, {"levels": 2, "faces": 400, "closed": True}, wrong=True)


def swapped_landmarks(shared: Path) -> Situation:
    points, mesh = _femur()
    corners = np.asarray(mesh.vertices)[[0, 60, 120, 180]]
    return Situation(
        fitting.Scan(points),
        mesh,
        {"levels": 2, "landmarks": fitting.Landmarks(corners[[3, 0, 1, 2]], corners)},
        wrong=True,
    )


def half_displaced(shared: Path) -> Situation:
    """Every second point of the scan moved by 5 mm: the patient moved between two passes."""
    points, mesh = _femur()
    points[::2] += (0, 5.0, 0)
    return Situation(fitting.Scan(points), mesh, {"levels": 2}, wrong=True)


def sparse(shared: Path) -> Situation:
    points, mesh = _femur(900, 0.3)
    return Situation(fitting.Scan(points), mesh, {"levels": 2}, _femur()[0])


# Seeds of each case of the protocol; the last five are bad starts.
PROTOCOL = {"base": 2, "outliers-40": 1, "outliers-60": 1, "sigma-2": 1, "points-5k": 1, "hole-80": 1}
PROTOCOL |= {"rotation-30": 6, "warp-12": 6, "scale-0.8": 3, "scale-1.2": 3, "bad-start": 13}
SITUATIONS: dict[str, Callable[[Path], Situation]] = {
    **{f"real: {name}": _real(name) for name in fit_real.CASES if not name.endswith("still")},
    **{f"protocol: {case} {seed}": _protocol(case, seed) for case, seeds in PROTOCOL.items() for seed in range(seeds)},
    "bone and table, no template": _tibia("tibia_table.xyz"),
    "two bones, no template": _tibia("tibia_two.xyz"),
    "bone in slices 5 mm apart, no template": _tibia("tibia_slices5.xyz"),
    "two bones, template in its place": two_bones_with_template,
    "bone and table, template in its place": table_with_template,
    "half a head, template in its place": half_head(0),
    "half a head, template turned by 60 degrees": half_head(60),
    "half a head, template turned by 150 degrees": half_head(150),
    **{
        f"half a head, another's template turned about {axis} by {max(turn)} degrees, {seed}": half_of_another(
            seed, turn
        )
        for seed in (0, 1)
        for axis, turn in (("x", (60, 0, 0)), ("y", (0, 60, 0)), ("z", (0, 0, 60)), ("z", (0, 0, 140)))
    },
    "two walls 3 mm apart, no template": two_walls(3, 0.2),
    "two walls 2 mm apart, noisy, no template": two_walls(2, 0.3),
    "two walls, template": two_walls_with_template,
    "shell with normals, template": mixed_normals,
    "face, 40 faces": coarse_face,
    "face, closed": closed_face,
    "template 5 mm off, not aligned": far_template(5.0),
    "template 50 mm off, not aligned": far_template(50.0),
    "template 300 mm off, not aligned": far_template(300.0),
    "template 5 m off, not aligned": far_template(5000.0),
    "vessel of 30 faces": tubes(30),
    "vessel of 400 faces": tubes(400),
    "mirrored scan": mirrored,
    "head, template of a femur": other_anatomy("head_colin27.ply", "femur_tri.obj"),
    "cortex, template of a head": other_anatomy("cortex_left_colin27.surf.gii", "head_tri.obj"),
    "face, template of a head fragment": other_anatomy("face_laser.vtp", "head_fragment_mixed.obj"),
    "template 1.9 times as large, rigid": rigid_twice_as_large,
    "template 1.4 times as large": similar_twice_as_large,
    "cortex of 100 faces": coarse_cortex,
    "normals inwards, template": inward_normals,
    "three bones, no template": three_objects,
    "a slab repeated 30 times, no template": repeated_slab,
    "3000 zeros for no return, no template": zeros_for_no_return,
    "a lone far point, no template": lone_far_point,
    "a lone far point, template": lone_far_point_with_template,
    "scattered points alone, template": noise_alone,
    "head, template of its front": open_patch_for_a_head,
    "two sweeps": cut_short,
    "skull, closed": skull_box,
    "landmarks exchanged": swapped_landmarks,
    "half of the points moved by 5 mm": half_displaced,
    "few points": sparse,
}


def is_wrong(result: fitting.FitResult, truth: Float[np.ndarray, "n 3"]) -> tuple[bool, str]:
    """Whether the surface misses what it should show, by how much: median and worst tenth, in the worse direction."""
    surface = fit_protocol.surface_of(result)
    samples = fit_protocol.sample(surface, 60_000, np.random.default_rng(0)).points
    both_ways = KDTree(samples).query(truth)[0], KDTree(truth).query(samples)[0]
    size = float(np.linalg.norm(np.ptp(truth, axis=0)))
    median, tenth = np.max([np.quantile(off, [0.5, 0.9]) for off in both_ways], axis=0)
    return bool(median > MEDIAN_OFF * size or tenth > TENTH_OFF * size), f"{median:.2f} / {tenth:.2f}"


def run(name: str, shared: Path, folder: Path | None) -> tuple[str, str]:
    """Fit one situation: its line of the table, and what kind of outcome that is."""
    began = time.perf_counter()
    given = SITUATIONS[name](shared)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = fitting.fit_scan(given.scan, given.mesh, throw=False, **given.options)
        except (ValueError, RuntimeError) as error:
            return f"| {name} | refused | | {str(error)[:60]} | refused |", "refused"
        result = found.result
        wrong, off = (bool(given.wrong), "") if given.truth is None else is_wrong(result, given.truth)
        names = [finding.name for finding in result.warnings]
    if folder is not None:
        result.save(folder / name.replace(": ", "_").replace(" ", "_").replace(",", ""))
    told = ", ".join(names)
    kinds = {(True, True): "hit", (True, False): "MISSED", (False, True): "false alarm", (False, False): "quiet"}
    kind = kinds[wrong or given.deserves_a_word, bool(names)]
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr)
    return f"| {name} | {'wrong' if wrong else 'right'} | {off} | {told} | {kind} |", kind


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--shared", type=Path, default=SHARED, help=f"folder of data and cases (default: {SHARED})")
    parser.add_argument(
        "--only", nargs="+", default=[""], metavar="WORD", help="situations whose name holds one of these"
    )
    parser.add_argument("--save", type=Path, metavar="FOLDER", help="keep every fit here")
    options = parser.parse_args(arguments)
    chosen = [name for name in SITUATIONS if any(word in name for word in options.only)]
    print(
        "| situation | fit | off the truth, median / worst tenth, mm | findings | |\n|---|---|--:|---|---|", flush=True
    )
    counts = {"hit": 0, "MISSED": 0, "false alarm": 0, "quiet": 0, "refused": 0}
    for name in chosen:
        try:
            text, kind = run(name, options.shared, options.save)
        except FileNotFoundError as error:
            print(f"\nSkipped, {name}: {error.filename} is not there; name its folder with --shared.")
            continue
        print(text, flush=True)
        counts[kind] += 1
    print("\n" + ", ".join(f"{kind} {count}" for kind, count in counts.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
