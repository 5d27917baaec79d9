"""VTK's unstructured grids and strips."""

import numpy as np
import pytest
from files import put
from meshes import cube, mixed_closed, turns

from jaxsubdiv import ControlMesh, MeshError, read_mesh, read_points

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)


@pytest.mark.parametrize("name", ["a.vtu", "text.vtu", "a.vtk", "text.vtk"])
def test_unstructured_grids_of_faces(tmp_path, name):
    import pyvista

    vertices, faces = mixed_closed()
    mesh = ControlMesh(vertices, faces)
    cells = [[2, 0, 1], *([len(face), *face] for face in faces), [3, 0, 1, 2], [4, 0, 1, 3, 2], [4, 0, 1, 2, 3], [1, 5]]
    types = [3, *(5 if len(face) == 3 else 9 for face in faces), 7, 8, 6, 1]
    grid = pyvista.UnstructuredGrid(np.concatenate(cells), np.array(types, np.uint8), np.asarray(vertices, float))
    grid.point_data["Normals"] = vertices / 8
    grid.save(tmp_path / name, binary=not name.startswith("text"))
    read = read_mesh(tmp_path / name, check=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.normals, mesh.vertices / 8)
    np.testing.assert_array_equal(read.faces[3], [*mesh.faces[3], (0, 1, 2), (0, 1, 2), (1, 3, 2)])
    np.testing.assert_array_equal(read.faces[4], [*mesh.faces[4], (0, 1, 2, 3)])
    np.testing.assert_array_equal(read_points(tmp_path / name).points, mesh.vertices)


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk"])
def test_grids_of_volumes_are_refused_by_their_cells(tmp_path, name):
    import pyvista

    pyvista.UnstructuredGrid([4, 0, 1, 2, 3], [10], SQUARE + [(0, 0, 0), (0, 0, 0), (0, 0, 1), (0, 0, 0)]).save(
        tmp_path / name
    )
    with pytest.raises(MeshError, match=r"it holds 1 tetrahedra, .* Take its surface first: pyvista\.read"):
        read_mesh(tmp_path / name)
    assert len(read_points(tmp_path / name).points) == 4


@pytest.mark.parametrize("name", ["a.vtp", "text.vtp", "a.vtk", "text.vtk"])
def test_triangle_strips_are_turned_as_their_triangles(tmp_path, name):
    import pyvista

    sphere = pyvista.Icosphere(nsub=2)
    strip = sphere.strip()
    assert strip.n_strips and strip.n_cells < sphere.n_cells / 2
    strip.points = sphere.points
    strip.save(tmp_path / name, binary=not name.startswith("text"))
    mesh = read_mesh(tmp_path / name)
    assert mesh.is_closed and mesh.euler_number == 2
    assert turns(mesh.faces[3]) == turns(sphere.regular_faces)


VTU = (
    '<VTKFile type="UnstructuredGrid"><UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="1"><Points><DataArray '
)
VTU += 'type="Float32" NumberOfComponents="3" format="ascii">0 0 0 1 0 0 1 1 0 0 1 0</DataArray></Points><Cells>'
VTU += (
    '<DataArray type="Int32" Name="connectivity" format="ascii">{}</DataArray><DataArray type="Int32" Name="offsets" '
)
VTU += 'format="ascii">{}</DataArray>{}</Cells></Piece></UnstructuredGrid></VTKFile>'
TYPES = '<DataArray type="UInt8" Name="types" format="ascii">{}</DataArray>'
VTK = "# vtk DataFile Version 3\n\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n0 0 0 1 0 0 1 1 0 0 1 0\n"
POLYDATA = VTK.replace("UNSTRUCTURED_GRID", "POLYDATA")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.vtu", VTU.format("0 1 2 3", "4", ""), "the element 'Cells' needs the array 'types'"),
        ("a.vtu", VTU.format("0 1 2", "3", TYPES.format(9)), "a cell of 4 corners has 3"),
        ("a.vtu", VTU.format("0 1 2 3", "4", TYPES.format(12)), "it holds 1 hexahedra"),
        ("a.vtu", VTU.format("0 1 2 3", "4", TYPES.format(200)), "it holds 1 cells of the type 200"),
        ("a.vtu", VTU.format("", "-4", TYPES.format(9)), "do not ascend"),
        ("a.vtu", VTU.format("0 1", "2", TYPES.format(6)), "triangle strip 0, counted from zero, has 2 corners"),
        ("a.vtu", VTU.format("0 1 2 3 0", "5", TYPES.format(7)), "neither triangles nor quads"),
        ("a.vtu", VTU.replace("UnstructuredGrid", "ImageData"), "it holds a ImageData"),
        ("a.vtk", VTK + "CELLS 1 5\n4 0 1 2 3\n", "it has 1 CELLS, but 0 CELL_TYPES"),
        ("a.vtk", VTK + "CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 9000000000\n9\n", "9000000000 numbers are announced"),
        ("a.vtk", VTK + "CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n", "it holds 1 tetrahedra"),
        ("a.vtk", POLYDATA + "TRIANGLE_STRIPS 1 3\n2 0 1\n", "triangle strip 0, counted from zero, has 2 corners"),
        ("a.vtk", POLYDATA + "TRIANGLE_STRIPS 1 4\n3 0 1 9\n", "use vertex indices >= 4"),
        ("a.vtk", VTK, "it holds points but no faces"),
    ],
)
def test_grids_that_are_damaged(tmp_path, name, content, words):
    with pytest.raises(MeshError, match=words) as caught:
        read_mesh(put(tmp_path, name, content))
    assert str(caught.value).startswith(name)


def test_a_grid_of_quads_as_vtk_makes_it(tmp_path):
    """Quads as VTK's own grid of them, from a program that names no normals."""
    import pyvista

    vertices, faces = cube()
    grid = pyvista.PolyData(np.asarray(vertices, float), np.concatenate([[4, *face] for face in faces]))
    grid.cast_to_unstructured_grid().save(tmp_path / "a.vtu")
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.vtu").faces[4], faces)
