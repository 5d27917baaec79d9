"""How well scans are fitted, beside the tools one would use instead, in the same run.

A synthetic scan of a head whose true surface is known (noise, outliers, a hole), and a coarse template that starts
off wrong: both drawn from a seed. Lengths in mm. Prints a Markdown table of means over the seeds, and writes JSON.

    pip install -e '.[bench]' && python tests/bench/fit_protocol.py --cases base --seeds 0 1 --output fit.json

The head is not shipped: it is taken from ../shared/data beside the repository, or from --data.
"""

import argparse
import functools
import json
import sys
import time
from collections.abc import Callable, Sequence
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from trimesh import Trimesh

import fitting
import jaxsubdiv as js

HEAD, CORTEX = "head_colin27.ply", "cortex_left_colin27.surf.gii"
# Remeshing its folds leaves no manifold: its template is a control mesh of 498 vertices, split once.
CORTEX_MESH, CORTEX_VERTICES = "control/cortex_tri.obj", 1986
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"

SAMPLES = 100_000  # on each of the two surfaces
BOX = 1.2  # outliers fill the bounding box of the head, this much larger
NRICP_VERTICES = 2600  # registration moves vertices only: it needs more of them
# Of a warp of 6 mm rms, waves this long leave about 2.4 mm rms after a similarity alignment, as two people differ.
WARP_LENGTH = 145.0
WAVES = 64
VERSIONS = ("jaxsubdiv", "jax", "optimistix", "trimesh", "open3d", "pymeshlab", "pyacvd", "numpy")


class Case(NamedTuple):
    """What is drawn for every seed."""

    truth: str = HEAD
    vertices: int = 650  # of the template
    points: int = 20_000  # before the hole is cut
    sigma: float = 0.5
    outliers: float = 0.05  # share of the points
    hole: float = 40.0  # radius of the ball without points
    off_cap: bool = False  # keeps the ball away from the flat cap that closes the head, 21 % of its area
    smoothing: int = 100  # iterations of Taubin: takes away what a template of another person would not have
    warp: float = 6.0  # of the template, rms
    rotation: float = 8.0  # degrees
    scale: float = 0.95
    shift: float = 9.0


CASES = {
    "base": Case(),
    "outliers-20": Case(outliers=0.2),
    "outliers-40": Case(outliers=0.4),
    "outliers-60": Case(outliers=0.6),
    "sigma-0.25": Case(sigma=0.25),
    "sigma-1": Case(sigma=1.0),
    "sigma-2": Case(sigma=2.0),
    "points-5k": Case(points=5_000),
    "points-80k": Case(points=80_000),
    "hole-80": Case(hole=80.0),
    "hole-off-cap": Case(off_cap=True),
    "warp-12": Case(warp=12.0),
    "rotation-30": Case(rotation=30.0),
    "scale-0.8": Case(scale=0.8),
    "scale-1.2": Case(scale=1.2),
    "no-noise": Case(points=80_000, sigma=0.01, outliers=0.0, hole=0.0),  # what the mesh itself leaves
    "bad-start": Case(warp=12.0, rotation=30.0, scale=0.8),
    "cortex": Case(CORTEX, vertices=CORTEX_VERTICES, points=40_000, sigma=0.25, hole=20.0, smoothing=0, warp=2.0),
}


class Samples(NamedTuple):
    """Points on a surface and the unit normals there."""

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]


class Problem(NamedTuple):
    """What a method is given: the scan, and a template of as many vertices as it asks for."""

    scan: Float[np.ndarray, "p 3"]
    of_head: Bool[np.ndarray, "p"]
    """Which points are no outliers: for the judge alone."""
    template: Callable[[int], Trimesh]
    n_vertices: int
    """That the case has in mind for it."""


class Errors(NamedTuple):
    """Between fitted and true surface, both directions pooled: RMS, percentile and maximum in mm, mean in degrees."""

    total: float
    data: float
    hole: float
    p95: float
    hausdorff: float
    normals: float


class Judgement(NamedTuple):
    """Of a fit by its own numbers."""

    f1: float
    """Of the points that it takes for the head's."""
    within: float
    """Share of the surface where data, by area, that lies no farther from the truth than its `uncertainty()`."""
    crossing: float
    """Triangles of the surface that cross others."""


def draw(truth: Trimesh, case: Case, seed: int, data: Path = DATA) -> tuple[Problem, Float[np.ndarray, "3"]]:
    """The scan and template of a seed, and the centre of the hole. Cases of one seed share what they do not change."""
    hole_at, scan, start = np.random.default_rng(seed).spawn(3)
    centres = sample(truth, 1000, hole_at).points
    centre = centres[centres[:, 2] > truth.bounds[0, 2] + case.hole][0] if case.off_cap else centres[0]
    template = functools.cache(lambda n: make_template(truth, case, n, start.bit_generator.seed_seq, data))
    return Problem(*make_scan(truth, case, centre, scan), template, case.vertices), centre


def make_scan(
    truth: Trimesh, case: Case, centre: Float[np.ndarray, "3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "p 3"], Bool[np.ndarray, "p"]]:
    """Points uniform by area with isotropic noise, among them outliers uniform in a box; none inside the hole."""
    n_outliers = round(case.outliers * case.points)
    points = sample(truth, case.points - n_outliers, rng).points
    points = points + rng.normal(scale=case.sigma, size=points.shape)
    low, high = truth.bounds
    outliers = (low + high) / 2 + BOX * (high - low) * rng.uniform(-0.5, 0.5, (n_outliers, 3))
    scan = np.concatenate([points, outliers])
    there = np.flatnonzero(np.linalg.norm(scan - centre, axis=1) > case.hole)
    order = there[rng.permutation(len(there))]
    return scan[order], order < len(points)


def make_template(
    truth: Trimesh, case: Case, n_vertices: int, seed: np.random.SeedSequence, data: Path = DATA
) -> Trimesh:
    """The smoothed head, warped, rotated, scaled, shifted, then remeshed; vertex normals from the dense mesh."""
    rng = np.random.default_rng(seed)
    is_cortex = case.truth == CORTEX
    dense = split_once(data / CORTEX_MESH) if is_cortex else truth.copy()
    trimesh.smoothing.filter_taubin(dense, iterations=case.smoothing)
    x = dense.vertices - dense.centroid
    warp = smooth_field(x, rng)
    x = x + case.warp * warp / np.sqrt(np.mean(np.sum(warp**2, axis=1)))
    axis, shift = trimesh.unitize(rng.normal(size=(2, 3)))
    x = case.scale * Rotation.from_rotvec(case.rotation * axis, degrees=True).apply(x) + case.shift * shift
    moved = Trimesh(x + dense.centroid, dense.faces, process=False)
    return moved if is_cortex else remesh(moved, n_vertices)


def split_once(path: Path) -> Trimesh:
    mesh, scheme = js.read_mesh(path), js.ModifiedButterfly()
    surface = js.refine(scheme, js.build_topology(mesh, scheme, 1), mesh.control())
    return Trimesh(np.asarray(surface.vertices, np.float64), np.asarray(surface.faces[3]), process=False)


def smooth_field(x: Float[np.ndarray, "v 3"], rng: np.random.Generator) -> Float[np.ndarray, "v 3"]:
    """A random field: the sum of waves, whose correlation falls as a Gaussian of the width WARP_LENGTH."""
    waves, phases = rng.normal(scale=1 / WARP_LENGTH, size=(WAVES, 3)), rng.uniform(0, 2 * np.pi, WAVES)
    return np.cos(x @ waves.T + phases) @ rng.normal(size=(WAVES, 3))


def remesh(dense: Trimesh, n_vertices: int) -> Trimesh:
    """About `n_vertices` vertices, one a cluster of the dense ones, in even triangles; normals of the dense mesh."""
    import pyacvd
    import pyvista

    clustering = pyacvd.Clustering(pyvista.make_tri_mesh(dense.vertices, dense.faces))
    clustering.cluster(n_vertices)
    vertices = clustering.create_mesh(clean=False).points
    # Dense faces between three clusters, as they are wound; create_mesh itself leaves a few faces the wrong way round.
    # Where two such faces close on each other, a cluster has no more than two neighbours: both faces go, and it goes.
    corners = clustering.clusters[dense.faces]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    _, first, times = np.unique(np.sort(corners, axis=1), axis=0, return_index=True, return_counts=True)
    mesh = Trimesh(vertices, corners[first[times == 1]], process=False)
    mesh.remove_unreferenced_vertices()
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == dense.euler_number):
        raise RuntimeError("pyacvd gave a template that is no closed manifold; take another seed.")
    normals = dense.vertex_normals[KDTree(dense.vertices).query(mesh.vertices)[1]]
    return Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, process=False)


def measure(
    fitted: Trimesh, truth: Trimesh, centre: Float[np.ndarray, "3"], radius: float, rng: np.random.Generator
) -> Errors:
    """Errors over area-weighted samples of both surfaces, each against the exactly closest point of the other.

    A sample counts as in the hole where its place on the true surface is. Normals are interpolated vertex normals.
    """
    of_fitted, of_truth = sample(fitted, SAMPLES, rng), sample(truth, SAMPLES, rng)
    on_truth, on_fitted = nearest(truth, of_fitted.points), nearest(fitted, of_truth.points)
    pairs = ((of_fitted, on_truth), (of_truth, on_fitted))
    distance = np.concatenate([np.linalg.norm(a.points - b.points, axis=1) for a, b in pairs])
    cosine = np.concatenate([np.sum(a.normals * b.normals, axis=1) for a, b in pairs])
    places = np.concatenate([on_truth.points, of_truth.points])
    in_hole = np.linalg.norm(places - centre, axis=1) < radius
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    distances = (rms(distance), rms(distance[~in_hole]), rms(distance[in_hole]), np.percentile(distance, 95))
    return Errors(*map(float, (*distances, distance.max(), angle.mean())))


def judge(
    result: fitting.FitResult, problem: Problem, truth: Trimesh, centre: Float[np.ndarray, "3"], radius: float
) -> Judgement:
    kept, right = result.inliers, problem.of_head
    f1 = 2 * np.sum(kept & right) / (np.sum(kept) + np.sum(right))
    vertices = np.asarray(result.surface.vertices, np.float64)
    on, areas = nearest(truth, vertices).points, np.asarray(result.surface.vertex_areas(), float)
    known = areas * (np.linalg.norm(on - centre, axis=1) >= radius)
    within = np.linalg.norm(on - vertices, axis=1) <= result.uncertainty().surface
    return Judgement(float(f1), float(np.sum(known * within) / np.sum(known)), crossing_faces(surface_of(result)))


def crossing_faces(surface: Trimesh) -> float:
    vertices = jnp.asarray(surface.vertices)
    faces = {3: jnp.asarray(surface.faces, jnp.int32), 4: jnp.zeros((0, 4), jnp.int32)}
    return float(len(js.find_crossings(js.RefinedSurface(vertices, jnp.zeros_like(vertices), faces)).triangles))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def sample(mesh: Trimesh, n: int, rng: np.random.Generator) -> Samples:
    """`n` points uniform by area."""
    face = rng.choice(len(mesh.faces), n, p=mesh.area_faces / mesh.area_faces.sum())
    u, v = rng.uniform(size=(2, n))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
    points, normals = (np.sum(of[mesh.faces[face]] * weights, axis=1) for of in (mesh.vertices, mesh.vertex_normals))
    return Samples(points, trimesh.unitize(normals))


def nearest(mesh: Trimesh, points: Float[np.ndarray, "p 3"]) -> Samples:
    """The exactly closest points of the triangles; by VTK, so that no method is its own judge."""
    import pyvista

    face, on = pyvista.make_tri_mesh(mesh.vertices, mesh.faces).find_closest_cell(points, return_closest_point=True)
    weights = np.nan_to_num(trimesh.triangles.points_to_barycentric(mesh.triangles[face], on))  # slivers have no area
    return Samples(on, trimesh.unitize(np.sum(mesh.vertex_normals[mesh.faces[face]] * weights[:, :, None], axis=1)))


def jaxsubdiv(problem: Problem, scheme: js.AbstractScheme, likeness: float | None = None) -> fitting.FitResult:
    priors = fitting.Priors(likeness=likeness)
    template = problem.template(problem.n_vertices)
    mesh = js.ControlMesh(template.vertices, template.faces, template.vertex_normals)
    scan = fitting.Scan(problem.scan)
    return fitting.fit_scan(scan, mesh, scheme=scheme, levels=2, priors=priors, throw=False).result


def jaxsubdiv_alone(problem: Problem) -> fitting.FitResult:
    """Without a template, at as many faces."""
    faces = 2 * problem.n_vertices - 4
    return fitting.fit_scan(fitting.Scan(problem.scan), faces=faces, closed=True, levels=2, throw=False).result


def jaxsubdiv_split(problem: Problem) -> fitting.FitResult:
    """The template split once: four times the control vertices."""
    template = problem.template(problem.n_vertices)
    mesh = js.ControlMesh(template.vertices, template.faces, template.vertex_normals)
    found = fitting.fit_scan(
        fitting.Scan(problem.scan), mesh, levels=2, tolerance_mm=0.01, most_faces=6000, throw=False
    )
    return found.result


def surface_of(result: fitting.FitResult) -> Trimesh:
    surface = result.surface
    return Trimesh(np.asarray(surface.vertices, np.float64), np.asarray(surface.triangles()), process=False)


def open3d_poisson(problem: Problem) -> Trimesh:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(problem.scan))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
    cloud.normals = o3d.utility.Vector3dVector(outward(problem.scan, np.asarray(cloud.normals)))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=6)
    return largest_part(np.asarray(mesh.vertices), np.asarray(mesh.triangles))


def pymeshlab_poisson(problem: Problem) -> Trimesh:
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(problem.scan))
    meshes.compute_normal_for_point_clouds(k=30)
    normals = outward(problem.scan, meshes.current_mesh().vertex_normal_matrix())
    meshes.add_mesh(pymeshlab.Mesh(problem.scan, v_normals_matrix=normals))
    meshes.generate_surface_reconstruction_screened_poisson(depth=7, pointweight=0.1)
    found = meshes.current_mesh()
    return largest_part(found.vertex_matrix(), found.face_matrix())


def nricp(problem: Problem) -> Trimesh:
    template = align(problem.template(NRICP_VERTICES), problem.scan)
    vertices = trimesh.registration.nricp_amberg(template, problem.scan, use_faces=False)
    return Trimesh(vertices, template.faces, process=False)


def outward(scan: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
    """Normals turned away from the middle of the scan, which on a head is right nearly everywhere."""
    away = np.sum((scan - np.median(scan, axis=0)) * normals, axis=1, keepdims=True)
    return np.where(away < 0, -normals, normals)


def largest_part(vertices: np.ndarray, faces: np.ndarray) -> Trimesh:
    """Poisson closes islands around outliers too, which a person would delete."""
    parts = Trimesh(vertices, faces, process=False).split(only_watertight=False)
    return max(parts, key=lambda part: part.area)


def align(mesh: Trimesh, scan: Float[np.ndarray, "p 3"]) -> Trimesh:
    """The mesh moved to the scan by a similarity, the same for every method that starts from a template."""
    control = js.ControlMesh(mesh.vertices, mesh.faces, mesh.vertex_normals)
    moved = fitting.align(control, fitting.Scan(scan), kind="similarity").mesh
    return Trimesh(moved.vertices, mesh.faces, vertex_normals=moved.normals, process=False)


METHODS: dict[str, Callable[[Problem], Trimesh | fitting.FitResult]] = {
    "jaxsubdiv": lambda problem: jaxsubdiv(problem, js.Interpolating()),
    "jaxsubdiv-unlike": lambda problem: jaxsubdiv(problem, js.Interpolating(), likeness=0.0),
    "jaxsubdiv-no-template": jaxsubdiv_alone,
    "jaxsubdiv-split": jaxsubdiv_split,
    "loop": lambda problem: jaxsubdiv(problem, js.Loop()),
    "open3d": open3d_poisson,
    "pymeshlab": pymeshlab_poisson,
    "nricp": nricp,
}


@functools.cache
def true_surface(path: Path) -> Trimesh:
    mesh = js.read_mesh(path)
    return Trimesh(mesh.vertices, mesh.faces[3], vertex_normals=mesh.normals, process=False)


def run(data: Path, cases: Sequence[str], methods: Sequence[str], seeds: Sequence[int]) -> list[dict]:
    """A row a case, method and seed, told as it comes. One without numbers says why under `error`."""
    rows = []
    for name in cases:
        truth = true_surface(data / CASES[name].truth)
        problems = {seed: draw(truth, CASES[name], seed, data) for seed in seeds}
        for method in methods:
            for seed, (problem, centre) in problems.items():
                row = {"case": name, "method": method, "seed": seed}
                try:
                    found, row["cpu_s"], row["wall_s"] = timed(METHODS[method], problem)
                    if isinstance(found, fitting.FitResult):
                        row |= judge(found, problem, truth, centre, CASES[name].hole)._asdict()
                        found = surface_of(found)
                    errors = measure(found, truth, centre, CASES[name].hole, np.random.default_rng(seed))
                    rows.append(row | errors._asdict())
                except Exception as error:  # a method that fails or is missing must not take the others' numbers along
                    rows.append(row | {"error": f"{type(error).__name__}: {error}"})
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def timed(method: Callable[[Problem], Any], problem: Problem) -> tuple[Any, float, float]:
    """What a method finds, its CPU and its wall seconds, compilation included; templates are made beforehand."""
    for n_vertices in (problem.n_vertices, NRICP_VERTICES):
        problem.template(n_vertices)
    wall, cpu = time.perf_counter(), time.process_time()
    fitted = method(problem)
    return fitted, time.process_time() - cpu, time.perf_counter() - wall


HEADINGS = (
    "total",
    "where data",
    "in the hole",
    "p95",
    "Hausdorff",
    "normals, deg",
    "F1",
    "within 1 sd",
    "crossing",
    "CPU s",
    "wall s",
)
COLUMNS = (*Errors._fields, *Judgement._fields, "cpu_s", "wall_s")


def table(rows: list[dict]) -> str:
    """Markdown: means over the seeds; below, what there are no numbers for."""
    lines = ["| case | method | seeds | " + " | ".join(HEADINGS) + " |", "|---|---|" + "--:|" * 12]
    for case, method in dict.fromkeys((row["case"], row["method"]) for row in rows if "error" not in row):
        of = [row for row in rows if (row["case"], row["method"]) == (case, method) and "error" not in row]
        means = (f"{np.mean([row[key] for row in of]):.3g}" if key in of[0] else "" for key in COLUMNS)
        lines.append(f"| {case} | {method} | {len(of)} | " + " | ".join(means) + " |")
    without = dict.fromkeys(f"{row['method']}: {row['error']}" for row in rows if "error" in row)
    return "\n".join([*lines, *(f"\nSkipped, {why}" for why in without)])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=DATA, help=f"folder of the true surfaces (default: {DATA})")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE", help=", ".join(CASES))
    parser.add_argument(
        "--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="METHOD", help=", ".join(METHODS)
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=range(5), metavar="SEED", help="default: 0 1 2 3 4")
    parser.add_argument("--output", type=Path, default=Path("fit_protocol.json"), help="default: %(default)s")
    options = parser.parse_args(arguments)
    missing = {CASES[case].truth for case in options.cases if not (options.data / CASES[case].truth).is_file()}
    if missing:
        words = " and ".join(sorted(missing))
        print(f"error: {options.data} has no {words}. They are not shipped: name their folder with --data.")
        return 2
    rows = run(options.data, options.cases, options.methods, options.seeds)
    versions = {found.name: found.version for found in distributions() if found.name in VERSIONS}
    options.output.write_text(json.dumps({"versions": versions, "rows": rows}, indent=2) + "\n", encoding="utf-8")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
