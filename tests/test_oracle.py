"""The library against a slow, literal reference that shares nothing with it."""

import meshes
import numpy as np
import pytest
import reference
from schemes import CASES, LEVELS, MIXED, QUADS, TRIANGLES, Case, by_name, control_mesh, random_control

import jaxsubdiv as js

# Meshes of one kind of faces have tables of their own shape; the rules that run on them are the same.
ONE_KIND = {
    "quads": (QUADS, ["default", "printed-recompute-chord", "circle"]),
    # Compiled for these, edge vertices once differed by rounding from their own copies in their rings.
    "triangles": (TRIANGLES, ["default", "uniform-recompute", "printed-sphere"]),
}
PAIRS = [pytest.param(case, MIXED, id=case.name) for case in CASES if case.reference is not None] + [
    pytest.param(by_name(name), mesh, id=f"{name}-{kind}") for kind, (mesh, names) in ONE_KIND.items() for name in names
]


def literal(case: Case, mesh: js.ControlMesh, control: js.Control, levels: int) -> tuple[np.ndarray, np.ndarray, list]:
    faces = [tuple(map(int, face)) for size in (3, 4) for face in mesh.faces[size]]
    h = np.asarray(case.scheme.h)
    return reference.refine(control.vertices, control.normals, faces, levels, h, **case.reference)[:3]


def assert_same(surface: js.RefinedSurface, expected: tuple[np.ndarray, np.ndarray, list], atol: float) -> None:
    """Equal faces, corner by corner, give the reference's number of every vertex; there the values must agree."""
    vertices, normals, faces = expected
    ours = [tuple(face) for size in (3, 4) for face in np.asarray(surface.faces[size]).tolist()]
    assert list(map(len, ours)) == list(map(len, faces))
    theirs = np.arange(len(vertices))
    theirs[np.concatenate(ours)] = np.concatenate(faces)
    assert [tuple(int(theirs[i]) for i in face) for face in ours] == faces
    assert np.array_equal(np.sort(theirs), np.arange(len(surface.vertices)))
    np.testing.assert_allclose(surface.vertices, vertices[theirs], rtol=0, atol=atol)
    np.testing.assert_allclose(surface.normals, normals[theirs], rtol=0, atol=atol)


@pytest.mark.parametrize(("case", "mesh"), PAIRS)
def test_points_normals_and_faces_agree(case, mesh):
    for seed in range(2):
        told, _, _ = meshes.relabelled(mesh, seed)
        checked, control = control_mesh(told), random_control(told, seed)
        control = js.Control(control.vertices, control.normals.at[seed].set(0.0))  # one missing normal
        topology = js.build_topology(checked, case.scheme, LEVELS)
        assert_same(js.refine(case.scheme, topology, control), literal(case, checked, control, LEVELS), 1e-12)
