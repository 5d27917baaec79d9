"""What is true of the refinement, as tests over every scheme and option for which it should hold."""

import meshes
import numpy as np
import pytest
import reference
from refined import CONTROL, DEFAULT, X, refine, unit
from schemes import CASES, LEVELS, MIXED, SHEET, Case, by_name, control_mesh, inherited, on_host, over_cases, refined

import jaxsubdiv as js

ROTATION = np.linalg.qr(np.random.default_rng(6).normal(size=(3, 3)))[0]
ROTATION *= np.linalg.det(ROTATION)


def part_of_vertex(case: Case) -> np.ndarray:
    return np.round(inherited(case.topology, case.subject.part)).astype(int)


@over_cases(interpolates=True)
def test_control_vertices_are_copied_bit_by_bit(case):
    surface = refined(case, case.subject.control)
    assert np.array_equal(surface.vertices[: len(case.subject.x)], case.subject.x)


@over_cases(interpolates=False)
def test_approximating_schemes_move_the_control_vertices(case):
    surface = refined(case, case.subject.control)
    assert np.linalg.norm(surface.vertices[: len(case.subject.x)] - case.subject.x, axis=1).max() > 0.1


@over_cases(uses_normals=True, recomputes_normals=False)
def test_kept_normals_are_the_control_normals_made_unit(case):
    surface = refined(case, case.subject.control)
    np.testing.assert_allclose(surface.normals[: len(case.subject.n)], unit(case.subject.n), rtol=0, atol=1e-15)


@over_cases(uses_normals=False)
def test_control_normals_change_nothing_where_they_are_not_used(case):
    surface, other = refined(case, case.subject.control), refined(case, js.Control(case.subject.x, 0 * case.subject.n))
    assert np.array_equal(surface.vertices, other.vertices) and np.array_equal(surface.normals, other.normals)


@over_cases()
def test_normals_have_length_one(case):
    lengths = np.linalg.norm(refined(case, case.subject.control).normals, axis=1)
    np.testing.assert_allclose(lengths, 1, rtol=0, atol=1e-15)


@pytest.mark.parametrize("h", [0.0, 0.5, 1.0, 2.5])
@over_cases()
def test_planes_stay_planes(case, h):
    flat = case.subject.x * (1, 1, 0) @ ROTATION.T + 3
    up = ROTATION[:, 2]
    control = js.Control(flat, np.outer(np.linspace(0.5, 2, len(flat)), up))
    surface = refined(case._replace(scheme=case.with_h(h)), control)
    sheet = part_of_vertex(case) == SHEET  # the closed parts are pressed flat: their sides face both ways
    np.testing.assert_allclose((surface.vertices[sheet] - 3) @ up, 0, atol=1e-12)
    np.testing.assert_allclose(surface.normals[sheet], np.tile(up, (sheet.sum(), 1)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("case", [c for c in CASES if c.scheme.h is not None], ids=lambda case: case.name)
def test_h_zero_is_flat_midpoint_splitting(case):
    if "flat at h = 0" in case.lacks:
        pytest.skip("the printed twist bends quads at h = 0 too")
    surface = refined(case._replace(scheme=case.with_h(0.0)), CONTROL)
    np.testing.assert_allclose(surface.vertices, inherited(case.topology, X), rtol=0, atol=1e-14)


def test_unused_vertices_survive_and_change_nothing():
    vertices, faces = meshes.pyramid()
    with_more = np.insert(vertices, 2, (9, 9, 9), axis=0)
    skipping = [tuple(corner + (corner >= 2) for corner in face) for face in faces]
    plain, more = (refine(js.Interpolating(), mesh, 1) for mesh in ((vertices, faces), (with_more, skipping)))
    assert np.array_equal(more.vertices[2], (9, 9, 9)) and np.array_equal(more.normals[2], (0, 0, 0))
    np.testing.assert_allclose(np.delete(more.vertices[:6], 2, axis=0), plain.vertices[:5], atol=1e-14)
    # Edges are sorted by their vertices, so their order stays.
    np.testing.assert_allclose(more.vertices[6:], plain.vertices[5:], rtol=0, atol=1e-14)
    np.testing.assert_allclose(more.normals[6:], plain.normals[5:], rtol=0, atol=1e-14)


def test_no_levels_give_the_control_with_unit_normals():
    checked = js.ControlMesh(*meshes.mixed_closed())
    control = js.Control(checked.vertices, 3 * checked.vertices)
    surface = js.refine(js.Interpolating(), js.build_topology(checked, js.Interpolating(), 0), control)
    assert np.array_equal(surface.vertices, checked.vertices)
    np.testing.assert_allclose(surface.normals, unit(checked.vertices), rtol=0, atol=1e-15)
    assert all(np.array_equal(surface.faces[size], checked.faces[size]) for size in (3, 4))


def test_eight_levels_run():
    control = js.Control(np.eye(3), np.eye(3))
    checked = js.ControlMesh(control.vertices, [(0, 1, 2)])
    surface = on_host(js.refine(js.Interpolating(), js.build_topology(checked, js.Interpolating(), 8), control))
    assert surface.faces[3].shape == (4**8, 3) and surface.vertices.shape == (257 * 258 // 2, 3)
    assert np.isfinite(surface.vertices).all()
    # Triangles 1/256 of the first one in size, none of them folded back.
    a, b, c = np.moveaxis(surface.vertices[surface.faces[3]], 1, 0)
    assert np.all(np.cross(b - a, c - a) @ np.ones(3) > 0)


@over_cases()
def test_moves_with_a_rigid_motion(case):
    x, n = case.subject.x, case.subject.n
    surface = refined(case, case.subject.control)
    moved = refined(case, js.Control(x @ ROTATION.T + 7.0, n @ ROTATION.T))
    np.testing.assert_allclose(moved.vertices, surface.vertices @ ROTATION.T + 7.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved.normals, surface.normals @ ROTATION.T, rtol=0, atol=1e-12)


def scaled(case, factor: float) -> tuple[js.RefinedSurface, js.RefinedSurface]:
    return refined(case, case.subject.control), refined(case, js.Control(factor * case.subject.x, case.subject.n))


@pytest.mark.parametrize("factor", [1e-3, 25.4])
@over_cases("scale")
def test_grows_with_a_uniform_scale(case, factor):
    surface, larger = scaled(case, factor)
    np.testing.assert_allclose(larger.vertices / factor, surface.vertices, rtol=0, atol=1e-12)
    np.testing.assert_allclose(larger.normals, surface.normals, rtol=0, atol=1e-12)


@pytest.mark.parametrize("case", [case for case in CASES if "scale" in case.lacks], ids=lambda case: case.name)
def test_printed_twist_depends_on_the_unit(case):
    surface, larger = scaled(case, 25.4)
    assert np.abs(larger.vertices / 25.4 - surface.vertices).max() > 1e-2


def match(one: js.RefinedSurface, other: js.RefinedSurface) -> np.ndarray:
    """For every vertex of `one` the vertex of `other` at its place."""
    gaps = np.linalg.norm(one.vertices[:, None] - other.vertices, axis=2)
    nearest = gaps.argmin(axis=1)
    assert gaps.min(axis=1).max() < 1e-12 and len(np.unique(nearest)) == len(nearest)
    return nearest


def cycles(faces: dict, label: np.ndarray | None = None) -> set[tuple[int, ...]]:
    """Faces from their smallest corner on, under other labels."""
    rows = [tuple(row if label is None else label[row]) for size in (3, 4) for row in faces[size]]
    return {face[face.index(min(face)) :] + face[: face.index(min(face))] for face in rows}


@over_cases()
def test_names_and_order_of_vertices_and_faces_do_not_matter(case):
    told, of_vertex, _ = meshes.relabelled(case.subject.mesh, seed=3, turn="first corner" not in case.lacks)
    topology = js.build_topology(js.ControlMesh(*told), case.scheme, LEVELS)
    other = on_host(js.refine(case.scheme, topology, js.Control(case.subject.x[of_vertex], case.subject.n[of_vertex])))
    surface = refined(case, case.subject.control)
    at = match(other, surface)
    np.testing.assert_allclose(other.normals, surface.normals[at], rtol=0, atol=1e-12)
    if "whole polygons" not in case.lacks:  # where a polygon is cut does depend on its first corner
        assert cycles(other.faces, at) == cycles(surface.faces)


@pytest.mark.parametrize("case", [case for case in CASES if "first corner" in case.lacks], ids=lambda case: case.name)
def test_printed_twist_depends_on_the_first_corner_of_a_quad(case):
    turned = [face[1:] + face[:1] for face in MIXED[1]]
    topology = js.build_topology(control_mesh((MIXED[0], turned)), case.scheme, LEVELS)
    other = on_host(js.refine(case.scheme, topology, CONTROL))
    assert np.abs(other.vertices - refined(case, CONTROL).vertices).max() > 1e-2


@over_cases("first corner")
def test_turns_inside_out_with_the_faces_and_the_normals(case):
    vertices, faces = case.subject.mesh
    turned = [face[:1] + face[:0:-1] for face in faces]
    topology = js.build_topology(control_mesh((vertices, turned)), case.scheme, LEVELS)
    other = on_host(js.refine(case.scheme, topology, js.Control(case.subject.x, -case.subject.n)))
    surface = refined(case, case.subject.control)
    at = match(other, surface)
    np.testing.assert_allclose(other.normals, -surface.normals[at], rtol=0, atol=1e-12)
    if "whole polygons" in case.lacks:
        return
    assert cycles({size: rows[:, ::-1] for size, rows in other.faces.items()}, at) == cycles(surface.faces)


@over_cases()
def test_components_do_not_feel_one_another(case):
    others = case.subject.part != SHEET
    rng = np.random.default_rng(4)
    shaken = case.subject.x + others[:, None] * rng.normal(size=case.subject.x.shape)
    turned = case.subject.n * np.where(others, -1, 1)[:, None]
    surface, other = refined(case, case.subject.control), refined(case, js.Control(shaken, turned))
    sheet = part_of_vertex(case) == SHEET
    np.testing.assert_allclose(other.vertices[sheet], surface.vertices[sheet], rtol=0, atol=1e-13)
    np.testing.assert_allclose(other.normals[sheet], surface.normals[sheet], rtol=0, atol=1e-13)
    assert np.abs(other.vertices[~sheet] - surface.vertices[~sheet]).max() > 0.1


def test_every_level_has_four_times_the_faces_and_the_same_euler_number():
    mesh = control_mesh(meshes.union(MIXED, meshes.torus(4, 3, "mixed")))
    finer = mesh
    for levels in range(4):
        topology = js.build_topology(mesh, js.Interpolating(), levels)
        n = len(mesh.vertices) + sum(len(level.edges) + len(level.quads) for level in topology.levels)
        finer = js.ControlMesh(np.zeros((n, 3)), {size: rows for size, rows in topology.faces.items()}, check=False)
        assert {size: len(rows) for size, rows in finer.faces.items()} == {
            size: 4**levels * len(rows) for size, rows in mesh.faces.items()
        }
        assert finer.euler_number == mesh.euler_number
        assert len(np.unique(finer.half_edges.start)) == n
        assert len(finer.boundary_edges) == 2**levels * len(mesh.boundary_edges)


@over_cases("scale", "blocks of children")
def test_faces_keep_the_side_of_their_parents(case):
    mesh = control_mesh(case.subject.mesh)
    surface = refined(case, mesh.control())
    for size, parents in mesh.faces.items():
        if not len(parents):
            continue
        before, after = (
            unit(areas(vertices, faces))
            for vertices, faces in ((mesh.vertices, parents), (surface.vertices, surface.faces[size]))
        )
        cosines = np.sum(np.repeat(before, 4**LEVELS, axis=0) * after, axis=1)
        assert cosines.min() > 0.5


def areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vector areas of triangles or quads, doubled."""
    corners = vertices[faces]
    return np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])


@pytest.mark.parametrize("name", ["default", "bezier-triangle", "butterfly", "kobbelt"])
def test_coarser_levels_are_prefixes_of_finer_ones(name):
    case = by_name(name)
    finer = refined(case, case.subject.control)
    topology = js.build_topology(control_mesh(case.subject.mesh), case.scheme, LEVELS - 1)
    coarser = js.refine(case.scheme, topology, case.subject.control)
    n = len(coarser.vertices)
    assert len(case.subject.x) < n < len(finer.vertices)
    np.testing.assert_allclose(coarser.vertices, finer.vertices[:n], rtol=0, atol=1e-14)
    if case.scheme.uses_normals:
        np.testing.assert_allclose(coarser.normals, finer.normals[:n], rtol=0, atol=1e-14)


@pytest.mark.parametrize("weights", ["area", "uniform", "angle", "sphere"])
def test_estimated_normals_agree_with_the_reference(weights):
    topology = DEFAULT.topology
    ours = js.estimate_normals(topology.control_fans, CONTROL.vertices, weights)
    np.testing.assert_allclose(ours, reference.vertex_normals(X, MIXED[1], weights), rtol=0, atol=1e-13)
    of_mesh = js.ControlMesh(X, MIXED[1]).control(weights=weights)
    np.testing.assert_allclose(of_mesh.normals, ours, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["default", "circle"])
def test_mesh_normals_are_those_of_the_last_level(name):
    scheme, (vertices, faces) = by_name(name).scheme, meshes.pyramid(base=False)
    checked = js.ControlMesh(vertices, faces)
    topology = js.build_topology(checked, scheme, 1, mesh_normals=True)
    surface = on_host(js.refine(scheme, topology, checked.control()))
    of_mesh = reference.vertex_normals(surface.vertices, surface.faces[3].tolist(), scheme.weights)
    old = slice(0, len(vertices))  # new vertices on the boundary may have chord normals
    np.testing.assert_allclose(surface.normals[old], of_mesh[old], rtol=0, atol=1e-13)
    plain = js.refine(scheme, js.build_topology(checked, scheme, 1), checked.control())
    np.testing.assert_allclose(surface.vertices, plain.vertices, rtol=0, atol=1e-14)
    assert np.abs(surface.normals[old] - plain.normals[old]).max() > 1e-3
