"""The library against a slow, literal reference that shares nothing with it."""

import jax
import meshes
import numpy as np
import pytest
import reference
from schemes import CASES, LEVELS, Case, control_mesh, over_cases, random_control, refine_eagerly

import jaxsubdiv as js

TRIANGLES = meshes.union(meshes.fan(7), meshes.torus(4, 3, "triangle"), meshes.grid(2, 2, "triangle", bumpy=0.2))
QUADS = meshes.union(meshes.cube(), meshes.torus(4, 3), meshes.grid(3, 2, bumpy=0.2))
BOW_TIE = (np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (-1, 0, 0.5), (-1, -1, 0)]), [(0, 1, 2), (0, 3, 4)])
MIXED = meshes.union(
    meshes.mixed_closed(), meshes.fan(8), meshes.torus(4, 4, "mixed"), meshes.grid(3, 2, "mixed", bumpy=0.2), BOW_TIE
)
MESHES = {"triangles": TRIANGLES, "quads": QUADS, "mixed": MIXED}


def literal(case: Case, mesh: js.ControlMesh, control: js.Control, levels: int) -> tuple[np.ndarray, np.ndarray, list]:
    faces = [tuple(map(int, face)) for size in (3, 4) for face in mesh.faces[size]]
    h = np.asarray(case.scheme.h)
    return reference.refine(control.vertices, control.normals, faces, levels, h, **case.reference)[:3]


def assert_same(surface: js.RefinedSurface, expected: tuple[np.ndarray, np.ndarray, list], atol: float) -> None:
    """Equal faces, corner by corner, give the reference's number of every vertex; there the values must agree."""
    vertices, normals, faces = expected
    ours = [tuple(map(int, face)) for size in (3, 4) for face in surface.faces[size]]
    assert list(map(len, ours)) == list(map(len, faces))
    theirs = np.arange(len(vertices))
    theirs[np.concatenate(ours)] = np.concatenate(faces)
    assert [tuple(int(theirs[i]) for i in face) for face in ours] == faces
    assert np.array_equal(np.sort(theirs), np.arange(len(surface.vertices)))
    np.testing.assert_allclose(surface.vertices, vertices[theirs], rtol=0, atol=atol)
    np.testing.assert_allclose(surface.normals, normals[theirs], rtol=0, atol=atol)


@pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())
@over_cases()
def test_points_normals_and_faces_agree(case, mesh):
    for seed in range(2):
        told, _, _ = meshes.relabelled(mesh, seed)
        checked, control = control_mesh(told), random_control(told, seed)
        control = js.Control(control.vertices, control.normals.at[seed].set(0.0))  # one missing normal
        topology = js.build_topology(checked, case.scheme, LEVELS)
        assert_same(js.refine(case.scheme, topology, control), literal(case, checked, control, LEVELS), 1e-12)
