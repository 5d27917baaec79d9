"""How often the truth lies within one standard deviation of what a fit measures: volume and area of a known surface.

    python tests/bench/fit_measures.py               # 20 scans of a femur that is known, and of a ball
    python tests/bench/fit_measures.py --terms       # with what is known to be left out, over the standard deviation

The truth is a smooth surface, refined twice from a control mesh. Every scan has 4,000 points of that, with noise of
0.3 mm and other seeds; every fit starts from the true control mesh moved by 1 mm of noise, and has its faces: what the
control mesh cannot follow is none of what is measured here.

`--terms` adds the means of two terms of second order. Roughness: by how much a measure grows where the surface moves
along its normals as the posterior has it. Noise along: by how much the volume grows as noise of the same size in all
coordinates moves points outwards, noise^2 times the integral of the mean curvature.
"""

import argparse
import warnings

import jax.numpy as jnp
import numpy as np
import trimesh

import fitting
import jaxsubdiv as js

N_POINTS, NOISE, MOVED = 4000, 0.3, 1.0
N_DRAWS, STEP = 64, 0.01  # of the surface; mm along its normals


def control_meshes() -> dict[str, js.ControlMesh]:
    ball = trimesh.creation.icosphere(2, radius=40.0)
    return {
        "femur": fitting.example("femur_distal")[1],
        "ball": js.ControlMesh(ball.vertices, {3: ball.faces, 4: np.zeros((0, 4), int)}, ball.vertex_normals),
    }


def measure_shape(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Volume in ml and area in cm2."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    volume = np.einsum("tx,tx->", a - vertices.mean(axis=0), across) / 6
    return np.array([volume / 1e3, np.linalg.norm(across, axis=1).sum() / 2e2])


def find_terms(result: fitting.FitResult) -> tuple[np.ndarray, float]:
    """Roughness of volume and area, and noise along of the volume."""
    x, normals = (np.asarray(rows, np.float64) for rows in (result.surface.vertices, result.surface.normals))
    triangles = np.asarray(result.surface.triangles())
    moved = np.einsum("vxk,vx->kv", result.posterior.displace(result.posterior.draws(N_DRAWS)), normals)
    steps = moved[..., None] * normals
    around = [(measure_shape(x + step, triangles) + measure_shape(x - step, triangles)) / 2 for step in steps]
    growth = measure_shape(x + STEP * normals, triangles) - measure_shape(x - STEP * normals, triangles)
    curvature = growth[1] * 1e2 / (4 * STEP)  # the area grows by twice its integral
    return np.mean(around, axis=0) - measure_shape(x, triangles), result.noise**2 * curvature / 1e3


def judge(mesh: js.ControlMesh, seeds: range, with_terms: bool) -> dict[str, list[tuple[float, float, float]]]:
    """Errors over their standard deviations, of each measure, and the two terms likewise."""
    scheme = js.Interpolating()
    topology = js.build_topology(mesh, scheme, 2)
    truth = js.refine(scheme, topology, mesh.control())
    part = js.losses.surface_part(topology)
    expected = {
        "volume": float(js.losses.enclosed_volume(truth, part=part)) / 1e3,
        "area surface": float(js.losses.surface_area(truth)) / 1e2,
    }
    solid = trimesh.Trimesh(np.asarray(truth.vertices), np.asarray(truth.triangles()), process=False)
    off: dict[str, list[tuple[float, float, float]]] = {name: [] for name in expected}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        face = rng.choice(len(solid.faces), N_POINTS, p=solid.area_faces / solid.area_faces.sum())
        u, v = rng.uniform(size=(2, N_POINTS, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        a, b, c = (solid.triangles[face, i] for i in range(3))
        points = a + u * (b - a) + v * (c - a) + rng.normal(scale=NOISE, size=(N_POINTS, 3))
        start = mesh.vertices + rng.normal(scale=MOVED, size=mesh.vertices.shape)
        control = js.Control(jnp.asarray(start, truth.vertices.dtype), mesh.control().normals)
        scan = fitting.Scan(jnp.asarray(points, truth.vertices.dtype))
        result = fitting.fit(scheme, topology, control, scan, throw=False)
        roughness, along = find_terms(result) if with_terms else (np.zeros(2), 0.0)
        for i, one in enumerate(result.measures()):
            errors = np.array([one.value - expected[one.name], roughness[i], along if i == 0 else 0.0])
            off[one.name].append(tuple((errors / one.deviation).tolist()))
    return off


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--terms", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    columns = ["surface", "measure", "within 1 sd", "RMS of error over sd", "mean"]
    columns += ["roughness", "noise along"] if given.terms else []
    print(f"| {' | '.join(columns)} |\n| --- | --- |{' ---: |' * (len(columns) - 2)}")
    for name, mesh in control_meshes().items():
        for measure, rows in judge(mesh, range(given.seeds), given.terms).items():
            off, *terms = np.array(rows).T
            within, root = np.mean(np.abs(off) < 1), np.sqrt(np.mean(off**2))
            more = "".join(f" {term.mean():+.2f} |" for term in terms) if given.terms else ""
            print(f"| {name} | {measure} | {within:.0%} | {root:.2f} | {off.mean():+.2f} |{more}", flush=True)


if __name__ == "__main__":
    main()
