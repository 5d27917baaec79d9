"""VTU files of unstructured grids, written by VTK: tetrahedra, and Bézier patches. `_vtp` reads surfaces from them."""

import errno
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped

from ..errors import MeshError
from ..extras import import_extra
from ..files import replace_file
from ._vtk import watch

TETRAHEDRON, BEZIER_TRIANGLE, BEZIER_QUAD = 10, 76, 77  # VTK's numbers of its kinds of cells


def check_can_write_vtu(path: str | os.PathLike[str]) -> Path:
    """The path of a VTU file that can be written.

    Raises:
        MeshError: another suffix.
        FileNotFoundError: its folder is not there.
        ImportError: pyvista, of the extras `io` and `simulation`, is not installed.
    """
    path = Path(path)
    if path.suffix.lower() != ".vtu":
        raise MeshError(f"{path.name}: cells of this kind go to .vtu files. Name one.")
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "the folder does not exist, create it first", str(path.parent))
    import_extra("pyvista", "io", ".vtu files")
    return path


def write_grid(
    path: str | os.PathLike[str],
    points: Float[np.ndarray, "n 3"],
    cells: Sequence[tuple[int, Int[np.ndarray, "_ _"]]],
    cell_data: Mapping[str, Shaped[np.ndarray, "m"]],
    numbers: Mapping[str, int] | None = None,
) -> None:
    """Write cells in double precision; the file takes the place of another only once it is complete.

    Args:
        path: the file, which ends in .vtu.
        points: in the unit of the surfaces.
        cells: VTK's number of the kind, and the corners of the cells of that kind, kind by kind.
        cell_data: name -> one number a cell, in the order of `cells`.
        numbers: name -> whole number, kept as field data: meshio reads no words there.
    """
    path = check_can_write_vtu(path)
    pyvista = import_extra("pyvista", "io", ".vtu files")
    rows = [np.insert(corners, 0, corners.shape[1], axis=1).ravel() for _, corners in cells if len(corners)]
    kinds = np.concatenate([np.full(len(corners), kind, np.uint8) for kind, corners in cells])
    grid = pyvista.UnstructuredGrid(np.concatenate(rows), kinds, np.ascontiguousarray(points, np.float64))
    for name, column in cell_data.items():
        grid.cell_data[name] = column
    for name, number in (numbers or {}).items():
        grid.field_data[name] = np.array([number])
    writer = import_extra("vtkmodules.vtkIOXML", "io", ".vtu files").vtkXMLUnstructuredGridWriter()
    with replace_file(path) as unfinished:
        writer.SetInputData(grid)
        writer.SetFileName(str(unfinished))
        done, messages = watch(writer.Write)
        if not done or messages:
            raise OSError(f"{path.name}: VTK could not write the file: {messages or 'it gives no reason'}")
