"""Linear schemes against other libraries: OpenSubdiv (stored vectors), libigl, trimesh and VTK."""

import meshes
import numpy as np
import opensubdiv
import pytest
import pyvista
import trimesh
from schemes import control_mesh
from scipy.spatial import KDTree

import jaxsubdiv as js

OPENSUBDIV = np.load(opensubdiv.VECTORS)
TRIANGLES = {
    "icosahedron": meshes.icosahedron(),
    "double pyramids": opensubdiv.PYRAMIDS,
    "torus": meshes.torus(7, 4, "triangle"),
}
OPEN = meshes.grid(5, 4, "triangle", bumpy=0.3)


def refined(scheme: js.AbstractScheme, mesh: js.ControlMesh, levels: int, **options) -> np.ndarray:
    """The refined vertices, by the stencils: nothing to compile. Another test has them equal those of `refine`."""
    return js.stencils(scheme, js.build_topology(mesh, scheme, levels, **options)) @ mesh.vertices


def assert_same_points(ours, theirs, atol: float) -> None:
    """Every point of the one has its own among the other."""
    assert len(ours) == len(theirs)
    gap, at = KDTree(theirs).query(ours)
    assert gap.max() <= atol and len(np.unique(at)) == len(at)


# --------------------------------------------------------------------------------------------------------- OpenSubdiv


@pytest.mark.parametrize("name", opensubdiv.CASES)
def test_boundaries_creases_and_limits_are_those_of_opensubdiv(name):
    case = opensubdiv.CASES[name]
    scheme, mesh = getattr(js, case.scheme)(boundary=case.boundary), control_mesh(case.mesh)
    edges, vertices = (list(sharp) for sharp in (case.edges, case.vertices))
    creases = js.Creases(edges, list(case.edges.values()), vertices, list(case.vertices.values()))
    points, limit, normals = np.moveaxis(OPENSUBDIV[name], 1, 0)
    topology = js.build_topology(mesh, scheme, case.levels, creases=creases, limit=True)
    ours = refined(scheme, mesh, case.levels, creases=creases)
    assert_same_points(ours, points, 1e-14)
    at = KDTree(points).query(ours)[1]
    np.testing.assert_allclose(topology.limit.points.matrix() @ ours, limit[at], rtol=0, atol=1e-14)
    along, across = (tangent.matrix() @ ours for tangent in topology.limit.tangents)
    direction = np.cross(along, across)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    known = length[:, 0] > 1e-12
    off = np.linalg.norm(direction / np.where(known, length[:, 0], 1)[:, None] - normals[at], axis=1)[known]
    # On a crease inside a surface there are two normals, and the masks give none. At irregular boundary vertices
    # OpenSubdiv uses tangents that were derived for other rules than its own; ours are those of the rules.
    irregular = 4 if name.startswith("mixed, open") else 0
    assert (off > 1e-13).sum() == irregular and off.max() < 0.01
    n_inner_creases = 16 if name == "cube, sharp" else None
    assert known.all() if not case.edges else n_inner_creases in (None, (~known).sum())


# ------------------------------------------------------------------------------------------------------ libigl, trimesh


@pytest.mark.parametrize("name", TRIANGLES)
def test_loop_is_that_of_trimesh_on_closed_meshes(name):
    mesh = control_mesh(TRIANGLES[name])
    theirs, _ = trimesh.remesh.subdivide_loop(mesh.vertices, mesh.faces[3], iterations=2)
    assert_same_points(refined(js.Loop(), mesh, 2), theirs, 1e-14)


@pytest.mark.parametrize("name", [*TRIANGLES, "open"])
def test_loop_with_the_weights_of_warren_is_that_of_libigl(name):
    igl = pytest.importorskip("igl")
    mesh = control_mesh(OPEN if name == "open" else TRIANGLES[name])
    theirs, _ = igl.loop(mesh.vertices, mesh.faces[3], 2)
    assert_same_points(refined(js.Loop("warren", "edge-only"), mesh, 2), theirs, 1e-14)


# ----------------------------------------------------------------------------------------------------------------- VTK


def vtk(mesh: js.ControlMesh, levels: int, kind: str) -> np.ndarray:
    """VTK puts out single precision, on coordinates up to 6 here."""
    faces = np.insert(mesh.faces[3], 0, 3, axis=1).ravel()
    return np.asarray(pyvista.PolyData(mesh.vertices, faces).subdivide(levels, kind).points, np.float64)


@pytest.mark.parametrize("name", [*TRIANGLES, "open"])
def test_loop_is_that_of_vtk(name):
    mesh = control_mesh(OPEN if name == "open" else TRIANGLES[name])
    assert_same_points(refined(js.Loop(boundary="edge-only"), mesh, 2), vtk(mesh, 2, "loop"), 1e-6)


@pytest.mark.parametrize("name", TRIANGLES)
def test_butterfly_is_that_of_vtk_on_closed_meshes(name):
    mesh = control_mesh(TRIANGLES[name])
    assert_same_points(refined(js.ModifiedButterfly(), mesh, 2), vtk(mesh, 2, "butterfly"), 1e-6)


def test_butterfly_differs_from_vtk_at_edges_from_inside_to_the_boundary_alone():
    # There VTK takes the corner opposite the edge for a wing that is missing, which leaves planes' own grid by up to an
    # eighth of an edge.
    mesh = control_mesh(meshes.grid(6, 6, "triangle", bumpy=0.3))
    topology = js.build_topology(mesh, js.ModifiedButterfly(), 1)
    ours = refined(js.ModifiedButterfly(), mesh, 1)
    off = KDTree(vtk(mesh, 1, "butterfly")).query(ours)[0] > 1e-6
    on_boundary = np.zeros(len(mesh.vertices), bool)
    on_boundary[mesh.boundary_edges] = True
    ends = on_boundary[np.asarray(topology.levels[0].edges)]
    boundary_edge = np.isin(
        np.sort(topology.levels[0].edges, axis=1) @ (100, 1), np.sort(mesh.boundary_edges, axis=1) @ (100, 1)
    )
    near = ends.any(axis=1) & ~boundary_edge
    assert not off[: len(mesh.vertices)].any()
    assert not off[len(mesh.vertices) :][~near].any()
    assert off[len(mesh.vertices) :][near].mean() > 0.5
