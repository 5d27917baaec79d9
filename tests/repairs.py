"""Damaged meshes and their repair, for tests."""

import numpy as np
from meshes import Mesh, cube

from jaxsubdiv._mesh import ControlMesh

SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def volume(mesh: ControlMesh) -> float:
    """Of triangles fanned from the first corner of every face."""
    total = 0.0
    for faces in mesh.faces.values():
        a = mesh.vertices[faces]
        for i in range(1, faces.shape[1] - 1):
            total += np.einsum("fx,fx->", a[:, 0], np.cross(a[:, i], a[:, i + 1])) / 6
    return total


def repaired(vertices, faces, normals=None, merge_within: float | None = None) -> ControlMesh:
    mesh = ControlMesh(vertices, faces, normals, check=False).repair(merge_within)
    ControlMesh(mesh.vertices, mesh.faces, mesh.normals)  # checked anew
    return mesh


def shifted(mesh: Mesh, by, n: int) -> Mesh:
    """A mesh beside another of `n` vertices."""
    return mesh[0] + by, [tuple(c + n for c in f) for f in mesh[1]]


def joined(*meshes: Mesh) -> Mesh:
    return np.concatenate([v for v, _ in meshes]), [f for _, faces in meshes for f in faces]


def touching_solids() -> Mesh:
    """Two cubes that share the place of an edge, but no vertex."""
    return joined(cube(), shifted(cube(), (2, 2, 0), 8))
