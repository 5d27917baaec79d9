"""Refinement until the limit is near enough, and surfaces to print."""

import meshes
import numpy as np
import pytest
import trimesh

import jaxsubdiv as js
from jaxsubdiv import _within_tolerance

SCHEMES = {
    "interpolating": js.Interpolating(),
    "catmull_clark": js.CatmullClark(),
    "loop": js.Loop(),
}


@pytest.mark.parametrize("name", SCHEMES)
def test_the_level_is_the_first_within_the_tolerance(name):
    vertices, faces = meshes.icosahedron() if name == "loop" else meshes.cube()
    mesh, scheme = js.ControlMesh(vertices, faces), SCHEMES[name]
    found = js.refine_within(scheme, mesh, mesh.control(), 0.1)
    assert 1 <= found.levels <= 2
    assert found.rms < found.largest <= 0.1
    # Measured in another way: points of a much deeper surface, by trimesh's search.
    topology = js.build_topology(mesh, scheme, 4, limit=scheme.is_linear)
    deep = np.asarray(js.refine(scheme, topology, mesh.control()).vertices)
    for levels, surface in ((found.levels, found.surface), (found.levels - 1, None)):
        if surface is None:
            surface = js.refine(scheme, js.build_topology(mesh, scheme, levels), mesh.control())
        flat = trimesh.Trimesh(np.asarray(surface.vertices), np.asarray(surface.triangles()))
        largest = np.abs(trimesh.proximity.closest_point_naive(flat, deep)[1]).max()
        if levels == found.levels:
            np.testing.assert_allclose(found.largest, largest, rtol=0.1)
        else:
            assert largest > 0.1


def test_a_tolerance_that_no_level_reaches_is_refused(monkeypatch):
    monkeypatch.setattr(_within_tolerance, "_MOST_FACES", 400)
    mesh = js.ControlMesh(*meshes.cube())
    with pytest.raises(ValueError, match=r"is not reached: the finest surface that is measured lies 0\.\d"):
        js.refine_within(js.Interpolating(), mesh, mesh.control(), 1e-9)
    with pytest.raises(ValueError, match="must be a positive length"):
        js.refine_within(js.Interpolating(), mesh, mesh.control(), 0.0)
    with pytest.raises(ValueError, match="one value a level"):
        js.refine_within(js.Interpolating([1.0, 0.5]), mesh, mesh.control(), 0.1)


def test_a_mesh_with_too_many_faces_is_refused(monkeypatch):
    monkeypatch.setattr(_within_tolerance, "_MOST_FACES", 80)
    mesh = js.ControlMesh(*meshes.cube())
    with pytest.raises(ValueError, match=r"the mesh has 6 faces, and .* on surfaces of up to 5"):
        js.refine_within(js.Interpolating(), mesh, mesh.control(), 0.1)


def test_a_print_is_watertight_once_it_is_read(tmp_path):
    vertices, faces = meshes.mixed_closed()
    mesh = js.ControlMesh(vertices / 3 + 1000.0 / 7, faces)
    found = js.refine_within(js.Interpolating(), mesh, mesh.control(), 0.02)
    js.write_mesh(tmp_path / "print.stl", js.prepare_to_print(found.surface))
    assert (tmp_path / "print.stl").stat().st_size == 84 + 50 * len(found.surface.triangles())
    read = trimesh.load(tmp_path / "print.stl")
    assert read.is_watertight and read.is_winding_consistent
    assert len(read.vertices) == len(found.surface.vertices)
    assert read.euler_number == mesh.euler_number


def test_a_surface_that_no_printer_takes_is_told():
    sheet = js.ControlMesh(*meshes.grid(2, 2))
    surface = js.refine(js.Interpolating(), js.build_topology(sheet, js.Interpolating(), 1), sheet.control())
    with pytest.warns(UserWarning, match="has 16 boundary edges: it is not watertight"):
        js.prepare_to_print(surface)
    ball = js.ControlMesh(*meshes.octahedron())
    split = js.ControlMesh(np.tile(ball.vertices, (2, 1)), np.concatenate([ball.faces[3], ball.faces[3] + 6]))
    surface = js.refine(js.Interpolating(), js.build_topology(split, js.Interpolating(), 0), split.control())
    assert len(js.prepare_to_print(surface).vertices) == 12  # twice the same surface: nothing is rounded, or told
    far = js.ControlMesh(ball.vertices * 1e-6 + 1e3, ball.faces, check=False)
    surface = js.refine(js.Interpolating(), js.build_topology(ball, js.Interpolating(), 0), far.control())
    with pytest.warns(UserWarning, match="vertices coincide with others in single precision"):
        js.prepare_to_print(surface)
