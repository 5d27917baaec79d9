"""Surfaces as Bézier patches, and their files as VTK and G+Smo read them."""

from xml.etree import ElementTree

import meshes
import numpy as np
import pytest

import jaxsubdiv as js
from jaxsubdiv._bezier_patches import weigh_points

pyvista = pytest.importorskip("pyvista")

UV = np.array([[0.1, 0.2], [0.5, 0.3], [0.0, 0.7], [0.25, 0.5]])


def patches_of(scheme, mesh, levels, creases=None) -> js.BezierPatches:
    return js.make_patches(scheme, mesh, mesh.control(), levels, creases=creases)


def on_surface(scheme, mesh, size: int, n: int, creases=None) -> np.ndarray:
    """The surface at these places of all control faces of a size, `[n, 4, 3]`, by `evaluate_control`."""
    topology = js.build_topology(mesh, scheme, 0, limit=scheme.is_linear, creases=creases)
    face = np.repeat(np.arange(n), len(UV)) + (len(mesh.faces[3]) if size == 4 else 0)
    at = js.SurfacePoint(face, np.tile(UV, (n, 1)))
    return np.asarray(js.evaluate_control(scheme, topology, mesh.control(), at).points).reshape(n, len(UV), 3)


EXACT = {
    "catmull_clark": (js.CatmullClark(), meshes.torus(6, 5)),
    "loop": (js.Loop(), meshes.torus(6, 5, "triangle")),
    "bezier_triangle": (js.BezierTriangle(), meshes.mixed_closed()),
}


@pytest.mark.parametrize("name", EXACT)
def test_patches_are_the_surface_where_that_is_polynomial(name, tmp_path):
    scheme, mesh = EXACT[name][0], js.ControlMesh(*EXACT[name][1])
    patches = patches_of(scheme, mesh, 0)
    assert patches.is_exact.all() and patches.rms <= patches.largest < 1e-14
    expected = [on_surface(scheme, mesh, size, len(mesh.faces[size])) for size in (3, 4)]
    for size, points, surface in zip((3, 4), (patches.triangles, patches.quads), expected, strict=True):
        if len(points):
            degree = 4 if name == "loop" else 3
            np.testing.assert_allclose(weigh_points(size, degree, UV) @ patches.points[points], surface, atol=1e-14)
    js.write_patches(tmp_path / "patches.vtu", patches)
    np.testing.assert_allclose(evaluated_by_vtk(tmp_path / "patches.vtu"), np.concatenate(expected), atol=1e-14)


def evaluated_by_vtk(path) -> np.ndarray:
    from vtkmodules.vtkCommonCore import reference

    grid = pyvista.read(path)
    found = np.zeros((grid.n_cells, len(UV), 3))
    for i in range(grid.n_cells):
        cell = grid.GetCell(i)
        for place, uv in zip(found[i], UV, strict=True):
            point, weights = [0.0, 0.0, 0.0], [0.0] * cell.GetNumberOfPoints()
            cell.EvaluateLocation(reference(0), [*uv, 0.0], point, weights)
            place[:] = point
    return found


def test_beside_irregular_vertices_patches_come_closer_with_every_level():
    mesh = js.ControlMesh(*meshes.cube())
    coarse, fine = (patches_of(js.CatmullClark(), mesh, levels) for levels in (1, 2))
    assert not coarse.is_exact.any() and fine.is_exact.mean() == 0.75
    assert 2 * fine.largest < coarse.largest < 0.003 and 3 * fine.rms < coarse.rms
    # Every patch shares its sides: a closed surface of quads has two corners, four inner points and four own a patch.
    n_corners, n_sides = 26, 48
    assert len(coarse.points) == n_corners + 2 * n_sides + 4 * len(coarse.quads)


def refined_twice(mesh) -> js.ControlMesh:
    topology = js.build_topology(mesh, js.CatmullClark(), 2)
    return js.ControlMesh(js.refine_vertices(js.CatmullClark(), topology, mesh.control()), topology.faces)


PARTLY_EXACT = {  # mesh, level of the patches, the mesh whose faces these are, creases, count of exact ones
    "cube": (meshes.cube(), 2, refined_twice, None, 72),
    "boundary": (meshes.grid(5, 4, bumpy=0.3), 0, lambda mesh: mesh, None, 6),
    "crease": (meshes.grid(6, 6, bumpy=0.3), 0, lambda mesh: mesh, js.Creases([(23, 24)]), 10),
}


@pytest.mark.parametrize("name", PARTLY_EXACT)
def test_patches_that_are_told_exact_are_the_surface(name):
    given, levels, same_faces, creases, n_exact = PARTLY_EXACT[name]
    mesh, scheme = js.ControlMesh(*given), js.CatmullClark()
    patches = patches_of(scheme, mesh, levels, creases)
    own = same_faces(mesh)
    expected = on_surface(scheme, own, 4, len(own.faces[4]), creases)
    away = np.abs(weigh_points(4, 3, UV) @ patches.points[patches.quads] - expected).max(axis=(1, 2))
    assert away[patches.is_exact].max() < 1e-13 < 1e-5 < away[~patches.is_exact].max()
    assert patches.is_exact.sum() == n_exact


def test_the_error_is_the_distance_from_the_surface():
    mesh, scheme = js.ControlMesh(*meshes.mixed_closed()), js.Interpolating()
    patches = patches_of(scheme, mesh, 1)
    deep = js.refine(scheme, js.build_topology(mesh, scheme, 4), mesh.control())
    t = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 9)]), axis=-1).reshape(-1, 2)
    in_quads = (weigh_points(4, 3, t) @ patches.points[patches.quads]).reshape(-1, 3)
    in_triangles = (weigh_points(3, 3, t[t.sum(axis=1) <= 1]) @ patches.points[patches.triangles]).reshape(-1, 3)
    points = np.concatenate([in_quads, in_triangles])
    on, _ = js.evaluate(deep, js.search_closest(deep, points))
    away = np.linalg.norm(points - np.asarray(on), axis=1)
    assert 0.5 * patches.largest < away.max() < 1.05 * patches.largest
    assert not patches.is_exact.any()
    corners = np.asarray(js.refine_vertices(scheme, js.build_topology(mesh, scheme, 1), mesh.control()))
    np.testing.assert_allclose(patches.points[: len(corners)], corners, atol=1e-14)


def test_gismo_reads_the_patches_and_finds_the_same_sides(tmp_path):
    vertices, faces = meshes.grid(3, 2, bumpy=0.3)
    rng = np.random.default_rng(0)  # faces that begin at any corner, so that sides of every kind meet
    mesh = js.ControlMesh(vertices, [tuple(np.roll(face, rng.integers(4))) for face in faces])
    patches = patches_of(js.CatmullClark(), mesh, 0)
    js.write_patches(tmp_path / "patches.xml", patches)
    root = ElementTree.parse(tmp_path / "patches.xml").getroot()
    rows = [np.array(each.text.split(), float).reshape(4, 4, 3) for each in root.iter("coefs")]
    u, v = (np.linspace(0, 1, 5)[:, None] ** [0, 1, 2, 3] for _ in range(2))
    to_powers = np.array([[1, 0, 0, 0], [-3, 3, 0, 0], [3, -6, 3, 0], [-1, 3, -3, 1]])
    surface = np.einsum("ui,vj,qjix->qvux", u @ to_powers, v @ to_powers, rows)
    uv = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 5)]), axis=-1).reshape(-1, 2)
    expected = weigh_points(4, 3, uv) @ patches.points[patches.quads]
    np.testing.assert_allclose(surface.reshape(6, 25, 3), expected, atol=1e-14)
    # Sides that are one have the same points: west 1, east 2, south 3, north 4.
    sides = {1: surface[:, :, 0], 2: surface[:, :, -1], 3: surface[:, 0], 4: surface[:, -1]}
    words = root.find("MultiPatch/interfaces").text.split()
    for one, side, other, beside, *directions in np.array(words, int).reshape(-1, 8):
        along = int(side < 3)
        assert directions[along] == int(beside < 3)
        same_way = directions[2 + along]
        np.testing.assert_allclose(sides[side][one], sides[beside][other][:: 1 if same_way else -1], atol=1e-14)
    assert len(words) == 8 * 7 and len(root.find("MultiPatch/boundary").text.split()) == 2 * 10


def test_what_has_no_patches_is_refused(tmp_path):
    mesh = js.ControlMesh(*meshes.mixed_closed())
    with pytest.raises(ValueError, match=r"CatmullClark does not split .* Begin at level 1"):
        patches_of(js.CatmullClark(), mesh, 0)
    with pytest.raises(ValueError, match=r"DooSabin does not split .* Take another scheme"):
        patches_of(js.DooSabin(), mesh, 1)
    with pytest.raises(ValueError, match="at levels up to 5; got 6"):
        patches_of(js.Interpolating(), mesh, 6)
    with pytest.raises(ValueError, match="one value a level"):
        patches_of(js.Interpolating([1.0]), mesh, 1)
    patches = patches_of(js.BezierTriangle(), mesh, 0)
    with pytest.raises(js.MeshError, match="8 of these are triangles"):
        js.write_patches(tmp_path / "patches.xml", patches)
    with pytest.raises(js.MeshError, match=r"go to \.vtu files"):
        js.write_patches(tmp_path / "patches.stl", patches)
