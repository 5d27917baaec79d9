"""Cases whose refined vertices OpenSubdiv 3.5.0 gave, stored in opensubdiv.npz; opensubdiv.cpp says how.

For each case the rows of `name` are the vertices of the last level, their limits, and the unit normals there, side by
side, in OpenSubdiv's order. Sharpness is such that OpenSubdiv's single precision holds it exactly.
"""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import meshes
import numpy as np
from meshes import Mesh

VECTORS = Path(__file__).with_suffix(".npz")


class Case(NamedTuple):
    scheme: str
    mesh: Mesh
    boundary: str = "edge-and-corner"
    levels: int = 2
    edges: Mapping[tuple[int, int], float] = MappingProxyType({})
    vertices: Mapping[int, float] = MappingProxyType({})


def around(mesh: Mesh, face: int, *sharpness: float) -> dict[tuple[int, int], float]:
    """Sharpness of the edges of a face, in their order."""
    corners = mesh[1][face]
    return dict(zip(zip(corners, corners[1:] + corners[:1], strict=True), sharpness, strict=False))


CUBE, QUAD_SHEET, SHEET = meshes.cube(), meshes.grid(3, 2, bumpy=0.3), meshes.grid(3, 3, "mixed", bumpy=0.3)
BALL, TRIANGLE_SHEET = meshes.octahedron(), meshes.grid(3, 2, "triangle", bumpy=0.3)
PYRAMIDS = meshes.union(meshes.fan(7), (meshes.fan(3)[0] + (5, 0, 0), meshes.fan(3)[1]))
CASES = {
    "cube": Case("CatmullClark", CUBE),
    "quads, open": Case("CatmullClark", QUAD_SHEET),
    "quads, open, edge-only": Case("CatmullClark", QUAD_SHEET, "edge-only"),
    "mixed": Case("CatmullClark", meshes.union(meshes.pyramid(), meshes.fan(7))),
    "mixed, open": Case("CatmullClark", SHEET),
    "cube, sharp": Case("CatmullClark", CUBE, edges=around(CUBE, 0, 10, 10, 10, 10)),
    "cube, semi-sharp": Case(
        "CatmullClark",
        CUBE,
        levels=3,
        edges=around(CUBE, 0, 1.5, 2.25, 0.5, 10) | around(CUBE, 3, 1),
        vertices={0: 0.75, 7: 1.625},
    ),
    "mixed, open, semi-sharp": Case(
        "CatmullClark", SHEET, levels=3, edges={(5, 6): 2.5, (6, 10): 0.625, (9, 10): 1.25}, vertices={5: 0.5}
    ),
    "octahedron": Case("Loop", BALL),
    "double pyramids": Case("Loop", PYRAMIDS),
    "triangles, open": Case("Loop", TRIANGLE_SHEET),
    "triangles, open, edge-only": Case("Loop", TRIANGLE_SHEET, "edge-only"),
    "octahedron, semi-sharp": Case(
        "Loop",
        BALL,
        levels=3,
        edges=around(BALL, 0, 1.5, 2.25, 0.5) | around(BALL, 5, 10, 1),
        vertices={2: 0.75, 5: 1.625},
    ),
}


def _as_text(case: Case) -> str:
    vertices, faces = case.mesh
    rows = [
        (case.scheme, case.boundary, case.levels),
        (len(vertices),),
        *(map(float, row) for row in vertices),
        (len(faces),),
        *((len(face), *face) for face in faces),
        (len(case.edges),),
        *((*edge, sharpness) for edge, sharpness in case.edges.items()),
        (len(case.vertices),),
        *case.vertices.items(),
    ]
    return "\n".join(" ".join(map(str, row)) for row in rows) + "\n"


def _read(block: str) -> np.ndarray:
    rows = np.array([line.split() for line in block.strip().splitlines()], float).reshape(-1, 4, 3)
    normals = np.cross(rows[:, 2], rows[:, 3])
    return np.stack([rows[:, 0], rows[:, 1], normals / np.linalg.norm(normals, axis=1, keepdims=True)], axis=1)


if __name__ == "__main__":
    text = "".join(map(_as_text, CASES.values()))
    printed = subprocess.run([sys.argv[1]], input=text, capture_output=True, text=True, check=True).stdout
    blocks = map(_read, printed.split("case")[1:])
    np.savez_compressed(VECTORS, **dict(zip(CASES, blocks, strict=True)))
