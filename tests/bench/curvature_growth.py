"""How curvature grows at control vertices from level to level, for every scheme that keeps them.

    python tests/bench/curvature_growth.py

prints a Markdown table: the factor by which the larger principal curvature of a control vertex grows from one level to
the next, as the median over all control vertices and the last two levels of five. 1 is a curvature that stays. The
control mesh is a torus of 12 x 6 quads, or as many pairs of triangles, of radii 2 and 1, with noise of 0.05.
"""

import sys
from pathlib import Path

import numpy as np

import jaxsubdiv as js

LEVELS = 5


def find_factors(scheme: js.AbstractScheme, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Of every control vertex, from the last level but two to the last but one, and from there to the last."""
    import meshes

    vertices, faces = meshes.torus(12, 6, kind)
    mesh = js.ControlMesh(vertices + np.random.default_rng(0).normal(scale=0.05, size=vertices.shape), faces)
    sizes = []
    for levels in range(LEVELS - 2, LEVELS + 1):
        topology = js.build_topology(mesh, scheme, levels)
        principal = js.curvatures(js.refine(scheme, topology, mesh.control())).principal[: len(vertices)]
        sizes.append(np.abs(np.asarray(principal, np.float64)).max(axis=1))
    return sizes[1] / sizes[0], sizes[2] / sizes[1]


def main() -> None:
    print("| scheme | median | 95th percentile |\n|---|---|---|")
    for scheme in js.SCHEMES.values():
        if scheme is js.DooSabin:  # its levels have no vertices of the level before
            continue
        factors = np.concatenate(find_factors(scheme(), "quad" if 4 in scheme.takes else "triangle"))
        print(f"| `{scheme.__name__}` | {np.median(factors):.2f} | {np.percentile(factors, 95):.2f} |", flush=True)


if __name__ == "__main__":
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    main()
