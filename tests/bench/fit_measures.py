"""How often the truth lies within one standard deviation of what a fit measures: volume and area of a known surface.

    python tests/bench/fit_measures.py               # 20 scans of a femur that is known, and of a ball

The truth is a smooth surface, refined twice from a control mesh. Every scan has 4,000 points of that, with noise of
0.3 mm and other seeds; every fit starts from the true control mesh moved by 1 mm of noise, and has its faces: what the
control mesh cannot follow is none of what is measured here.
"""

import argparse
import warnings

import jax.numpy as jnp
import numpy as np
import trimesh

import fitting
import jaxsubdiv as js

N_POINTS, NOISE, MOVED = 4000, 0.3, 1.0


def control_meshes() -> dict[str, js.ControlMesh]:
    ball = trimesh.creation.icosphere(2, radius=40.0)
    return {
        "femur": fitting.example("femur_distal")[1],
        "ball": js.ControlMesh(ball.vertices, {3: ball.faces, 4: np.zeros((0, 4), int)}, ball.vertex_normals),
    }


def judge(mesh: js.ControlMesh, seeds: range) -> dict[str, list[float]]:
    """Errors over their standard deviations, of each measure."""
    scheme = js.Interpolating()
    topology = js.build_topology(mesh, scheme, 2)
    truth = js.refine(scheme, topology, mesh.control())
    part = js.losses.surface_part(topology)
    expected = {
        "volume": float(js.losses.enclosed_volume(truth, part=part)) / 1e3,
        "area surface": float(js.losses.surface_area(truth)) / 1e2,
    }
    solid = trimesh.Trimesh(np.asarray(truth.vertices), np.asarray(truth.triangles()), process=False)
    off: dict[str, list[float]] = {name: [] for name in expected}
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
        for one in result.measures():
            off[one.name].append((one.value - expected[one.name]) / one.deviation)
    return off


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| surface | measure | within 1 sd | RMS of error over sd | mean |\n| --- | --- | ---: | ---: | ---: |")
    for name, mesh in control_meshes().items():
        for measure, rows in judge(mesh, range(given.seeds)).items():
            off = np.array(rows)
            within, root = np.mean(np.abs(off) < 1), np.sqrt(np.mean(off**2))
            print(f"| {name} | {measure} | {within:.0%} | {root:.2f} | {off.mean():+.2f} |", flush=True)


if __name__ == "__main__":
    main()
