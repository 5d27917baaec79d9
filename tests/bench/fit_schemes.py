"""How well each scheme fits one scan of a head, by the same call and without any tuning.

Points drawn by area from the surface of a head (no noise, so that what is left is the scheme's), and a control mesh
that lies about it. Lengths in mm. Prints a Markdown table, and writes JSON.

    pip install -e '.[bench]' && python tests/bench/fit_schemes.py --output schemes.json

The head is not shipped: it is taken from ../shared/data beside the repository, or from --data.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from fit_protocol import DATA, HEAD, nearest, rms, sample
from trimesh import Trimesh

import fitting
import jaxsubdiv as js
from jaxsubdiv._compare import SCHEMES

CONTROL = {3: "head_tri.obj", 4: "head_quad.obj"}  # triangles for the schemes that take nothing else
COLUMNS = ("rms", "p95", "truth_rms", "normals", "sweeps", "converged", "cpu_s")
HEADINGS = ("scan, RMS", "95th percentile", "truth, RMS", "normals, deg", "sweeps", "converged", "CPU s")


def row(name: str, data: Path, truth: Trimesh, points: np.ndarray, levels: int) -> dict:
    """Fit one scheme. Distances of the scan from the surface; surface and truth both ways, pooled."""
    scheme = SCHEMES[name]()
    mesh = js.read_mesh(data / "control" / CONTROL[4 if 4 in scheme.takes else 3])
    start = time.process_time()
    topology = js.build_topology(mesh, scheme, levels)
    found = fitting.fit(scheme, topology, mesh.control(), fitting.Scan(points), throw=False)
    seconds = time.process_time() - start
    surface = found.surface
    fitted = Trimesh(np.asarray(surface.vertices, np.float64), np.asarray(surface.triangles()), process=False)
    rng = np.random.default_rng(0)
    of_fitted, of_truth = sample(fitted, len(points), rng), sample(truth, len(points), rng)
    pairs = (of_fitted, nearest(truth, of_fitted.points)), (of_truth, nearest(fitted, of_truth.points))
    between = np.concatenate([np.linalg.norm(a.points - b.points, axis=1) for a, b in pairs])
    cosine = np.concatenate([np.sum(a.normals * b.normals, axis=1) for a, b in pairs])
    return {
        "scheme": name,
        "control_vertices": len(mesh.vertices),
        "rms": rms(found.distances),
        "p95": float(np.percentile(np.abs(found.distances), 95)),
        "truth_rms": rms(between),
        "normals": float(np.degrees(np.mean(np.arccos(np.clip(cosine, -1, 1))))),
        "sweeps": len(found.rms) - 1,
        "converged": bool(found.report().converged),
        "cpu_s": seconds,
    }


def table(rows: list[dict]) -> str:
    """Markdown."""
    lines = ["| scheme | " + " | ".join(HEADINGS) + " |", "|---|" + "--:|" * len(HEADINGS)]
    for found in rows:
        values = (found[key] for key in COLUMNS)
        texts = (f"{value:.3g}" if isinstance(value, float) else str(value) for value in values)
        lines.append(f"| {found['scheme']} | " + " | ".join(texts) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=DATA, help=f"folder that holds {HEAD} (default: {DATA})")
    parser.add_argument(
        "--schemes", nargs="+", choices=SCHEMES, default=list(SCHEMES), metavar="SCHEME", help=", ".join(SCHEMES)
    )
    parser.add_argument("--points", type=int, default=10_000, help="of the scan (default: %(default)s)")
    parser.add_argument("--levels", type=int, default=3, help="of every scheme (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the points (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=Path("fit_schemes.json"), help="default: %(default)s")
    options = parser.parse_args(arguments)
    if not (options.data / HEAD).is_file():
        print(f"error: {options.data / HEAD} is not there. The head is not shipped: name its folder with --data.")
        return 2
    truth = trimesh.load_mesh(options.data / HEAD, process=False)
    points = sample(truth, options.points, np.random.default_rng(options.seed)).points
    rows = []
    for name in options.schemes:
        rows.append(row(name, options.data, truth, points, options.levels))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
        options.output.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
