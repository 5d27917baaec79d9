"""The inside of closed surfaces as tetrahedra."""

import itertools

import meshes
import numpy as np
import pytest
import trimesh

import jaxsubdiv as js
from jaxsubdiv import _tetwild
from jaxsubdiv._tetrahedra import _Nesting, _Triangles
from jaxsubdiv._tetrahedron_quality import measure_shapes

pytest.importorskip("pytetwild")
pyvista = pytest.importorskip("pyvista")


def ball(radius: float = 1.0, middle: float = 0.0, finer: int = 2) -> js.ControlMesh:
    mesh = trimesh.creation.icosphere(finer)
    return js.ControlMesh(radius * mesh.vertices + [middle, 0, 0], {3: mesh.faces})


@pytest.fixture(scope="module")
def filled() -> js.Tetrahedra:
    return js.fill_with_tetrahedra(ball(), edge=0.5, tolerance=0.02)


def test_the_volume_and_boundary_are_those_of_the_surface(filled):
    expected = trimesh.creation.icosphere(2).volume
    quality = filled.quality
    np.testing.assert_allclose(quality.enclosed_volume, expected)
    np.testing.assert_allclose(quality.volume, expected, rtol=0.02)
    assert quality.n_inverted == 0
    assert 0 <= quality.rms <= quality.largest < 0.04
    assert np.linalg.norm(filled.points, axis=1).max() < 1.02
    assert filled.regions.names == ("solid",)
    lengths = np.linalg.norm(np.diff(filled.points[filled.cells], axis=1), axis=2)
    assert 0.25 < np.median(lengths) < 0.7


def test_quality_is_that_of_vtk(filled, tmp_path):
    js.write_tetrahedra(tmp_path / "ball.vtu", filled)
    grid = pyvista.read(tmp_path / "ball.vtu")
    np.testing.assert_array_equal(grid.points, filled.points)
    np.testing.assert_array_equal(grid.cells_dict[10], filled.cells)
    assert (grid["region"] == 1).all() and grid.field_data["solid"] == [1]
    measured = grid.cell_quality("scaled_jacobian")["scaled_jacobian"]
    np.testing.assert_allclose(grid["scaled_jacobian"], measured, atol=1e-12)
    np.testing.assert_allclose(filled.quality.scaled_jacobians, np.quantile(measured, [0, 0.05, 0.5]), atol=1e-12)
    # VTK's own "min_angle" of a tetrahedron leaves some of its edges out.
    angles = angles_at_edges(filled.points[filled.cells]).min(axis=0)
    np.testing.assert_allclose(grid["smallest_angle"], angles, atol=1e-9)
    np.testing.assert_allclose(filled.quality.angles, np.quantile(angles, [0, 0.05, 0.5]), atol=1e-9)
    meshio = pytest.importorskip("meshio")
    np.testing.assert_array_equal(meshio.read(tmp_path / "ball.vtu").cells_dict["tetra"], filled.cells)


def angles_at_edges(corners: np.ndarray) -> np.ndarray:
    """Between what the two faces at an edge look like along it, in degrees, for all six edges `[6, m]`."""
    found = []
    for i, j in itertools.combinations(range(4), 2):
        along = corners[:, j] - corners[:, i]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        sides = np.delete(corners, [i, j], axis=1) - corners[:, i, None]
        sides -= np.sum(sides * along[:, None], axis=2, keepdims=True) * along[:, None]
        one, other = np.moveaxis(sides / np.linalg.norm(sides, axis=2, keepdims=True), 1, 0)
        found.append(np.degrees(np.arccos(np.sum(one * other, axis=1))))
    return np.array(found)


def test_nested_surfaces_bound_regions_that_share_their_points():
    surfaces = {"shell": ball(1.0), "core": ball(0.5, 0.2, 1), "hole": ball(0.2, -0.7, 1)}
    filled = js.fill_with_tetrahedra(surfaces, edge=0.5, tolerance=0.03, cavities=["hole"])
    assert filled.regions.names == ("shell", "core")
    corners = filled.points[filled.cells]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
    of_shell, of_core, of_hole = (mesh_volume(surfaces[name]) for name in surfaces)
    found = np.bincount(filled.regions.rows, volumes)
    np.testing.assert_allclose(found, [of_shell - of_core - of_hole, of_core], rtol=0.06)
    np.testing.assert_allclose(filled.quality.enclosed_volume, of_shell - of_hole)
    in_core = np.linalg.norm(corners.mean(axis=1) - [0.2, 0, 0], axis=1) < 0.45
    assert (filled.regions.rows[in_core] == 1).all()
    assert np.linalg.norm(corners.mean(axis=1) + [0.7, 0, 0], axis=1).min() > 0.12
    shared = np.intersect1d(*(filled.cells[filled.regions.rows == i] for i in (0, 1)))
    assert np.abs(np.linalg.norm(filled.points[shared] - [0.2, 0, 0], axis=1) - 0.45).max() < 0.1


def mesh_volume(mesh: js.ControlMesh) -> float:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[3]).volume


def box(half: float, x: float = 0.0) -> js.ControlMesh:
    vertices, faces = meshes.cube()
    return js.ControlMesh(half * vertices + [x, 0, 0], faces)


@pytest.mark.parametrize(
    ("cavities", "of_regions"),
    [
        (["small"], {"large": 8000 - 1728, "middle": 1728 - 216}),
        (["middle", "beside"], {"large": 8000 - 1728 - 8, "small": 216}),
    ],
)
def test_cavities_of_nested_surfaces_stay_empty(cavities, of_regions):
    surfaces = {"large": box(10), "middle": box(6), "small": box(3)}
    surfaces |= {"beside": box(1, 8)} if "beside" in cavities else {}
    filled = js.fill_with_tetrahedra(surfaces, edge=8, tolerance=0.05, cavities=cavities)
    assert filled.regions.names == tuple(of_regions)
    volumes = measure_shapes(filled.points, filled.cells)[2]
    np.testing.assert_allclose(np.bincount(filled.regions.rows, volumes), list(of_regions.values()), rtol=0.02)
    np.testing.assert_allclose(filled.quality.enclosed_volume, sum(of_regions.values()))
    np.testing.assert_array_equal(np.unique(filled.cells), np.arange(len(filled.points)))


def test_tetrahedra_beyond_a_surface_belong_to_the_nearest():
    surfaces = {"large": box(10), "small": box(1, 30), "hole": box(2), "core": box(1, 6)}
    closed = [_Triangles(name, surface) for name, surface in surfaces.items()]
    nesting = _Nesting(closed, np.array([False, False, True, False]))
    np.testing.assert_array_equal(nesting.parents, [-1, -1, 0, 0])
    middles = np.array([[31.001, 0, 0], [-10.001, 0, 0], [29.1, 0, 0], [1.999, 0, 0], [6.5, 0, 0], [4, 0, 0]])
    names = [closed[i].name for i in nesting.find_owners(middles)]
    assert names == ["small", "large", "small", "large", "core", "large"]


def test_a_part_that_points_inwards_is_a_cavity():
    outer, inner = ball(), ball(0.5)
    faces = np.concatenate([outer.faces[3], inner.faces[3][:, ::-1] + len(outer.vertices)])
    hollow = js.ControlMesh(np.concatenate([outer.vertices, inner.vertices]), {3: faces})
    quality = js.fill_with_tetrahedra(hollow, edge=0.6, tolerance=0.03).quality
    np.testing.assert_allclose(quality.enclosed_volume, mesh_volume(outer) - mesh_volume(inner))
    np.testing.assert_allclose(quality.volume, quality.enclosed_volume, rtol=0.04)


def test_surfaces_without_an_inside_are_refused(tmp_path):
    with pytest.raises(ValueError, match="'solid' has no inside: 8 of its edges"):
        js.fill_with_tetrahedra(js.ControlMesh(*meshes.grid(2, 2)))
    mesh = ball()
    with pytest.raises(ValueError, match="'solid' point inwards"):
        js.fill_with_tetrahedra(js.ControlMesh(mesh.vertices, {3: mesh.faces[3][:, ::-1]}))
    for wrong in ({"edge": -1.0}, {"tolerance": np.nan}):
        with pytest.raises(ValueError, match="must be a positive length"):
            js.fill_with_tetrahedra(mesh, **wrong)
    with pytest.raises(ValueError, match="A cavity is one of the surfaces"):
        js.fill_with_tetrahedra({"a": mesh}, cavities=["b"])
    with pytest.raises(ValueError, match="A cavity is one of the surfaces"):
        js.fill_with_tetrahedra({"a": mesh}, cavities=["a"])
    with pytest.raises(ValueError, match="the cavity 'b' lies in no surface"):
        js.fill_with_tetrahedra({"a": mesh, "b": ball(0.2, 3, 1)}, cavities=["b"])
    with pytest.raises(ValueError, match="the cavity 'c' lies in the cavity 'b'"):
        js.fill_with_tetrahedra({"a": mesh, "b": ball(0.5), "c": ball(0.2, 0, 1)}, cavities=["b", "c"])


def test_surfaces_that_cross_are_told():
    with pytest.warns(UserWarning, match="triangles go through others"):
        js.fill_with_tetrahedra({"left": ball(finer=1), "right": ball(middle=1.3, finer=1)}, edge=0.7, tolerance=0.05)


def test_only_vtu_files_in_folders_that_are_there(filled, tmp_path):
    with pytest.raises(js.MeshError, match=r"go to \.vtu files"):
        js.write_tetrahedra(tmp_path / "ball.stl", filled)
    with pytest.raises(FileNotFoundError, match="the folder does not exist"):
        js.write_tetrahedra(tmp_path / "lost" / "ball.vtu", filled)


def test_nothing_is_left_where_it_runs_and_a_failure_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    js.fill_with_tetrahedra(ball(finer=1), edge=1.0, tolerance=0.1)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(_tetwild, "_PROGRAM", "raise SystemExit('out of luck')")
    with pytest.raises(RuntimeError, match=r"ended with status 1 and made no tetrahedra \(out of luck\)"):
        js.fill_with_tetrahedra(ball(finer=1))


def test_inverted_tetrahedra_are_counted(filled):
    flipped = filled.cells.copy()
    flipped[:3] = flipped[:3, [1, 0, 2, 3]]
    _, jacobians, volumes = measure_shapes(filled.points, flipped)
    assert np.sum(volumes <= 0) == np.sum(jacobians <= 0) == 3
    flat = np.zeros((4, 3))
    assert [values.tolist() for values in measure_shapes(flat, np.arange(4)[None])[1:]] == [[0.0], [0.0]]
