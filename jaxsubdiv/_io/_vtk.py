"""VTP files and legacy VTK files of polygons, by VTK through pyvista."""

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MeshError
from ._contents import Contents, VertexData, by_size, check_polygons, doubles, library, warn

_NORMALS = "Normals"


def read(path: Path) -> Contents:
    """Points, polygons, and the point normals: the array marked as such, or the one called Normals."""
    polydata = _read_polydata(path)
    if polydata.n_strips:
        raise MeshError(
            f"{path.name}: it holds {polydata.n_strips} triangle strips, which are not read. Save it as polygons: "
            "pyvista.read(...).triangulate().save(...)."
        )
    arrays = polydata.point_data
    names = [arrays.active_normals_name, *(name for name in arrays if name.lower() == "normals")]
    normals = [arrays[name] for name in names if name is not None and arrays[name].shape == polydata.points.shape]
    return Contents(
        doubles(np.asarray(polydata.points)),
        _faces(path, polydata),
        doubles(np.asarray(normals[0])) if normals else None,
    )


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Double precision, binary; `path` ends in .vtp or .vtk."""
    pyvista = library("pyvista", ".vtp and .vtk files")
    rows = [np.insert(corners, 0, size, axis=1).ravel() for size, corners in (contents.faces or {}).items()]
    polydata = pyvista.PolyData(contents.vertices, np.concatenate(rows))
    if contents.normals is not None:
        polydata.point_data[_NORMALS] = contents.normals
        polydata.point_data.active_normals_name = _NORMALS
    for name, column in data.items():
        if name == _NORMALS:
            raise MeshError(f"`vertex_data` has the name '{_NORMALS}', which the normals of the mesh take.")
        polydata.point_data[name] = column
    if path.suffix.lower() == ".vtp":
        writer = library("vtkmodules.vtkIOXML", ".vtp files").vtkXMLPolyDataWriter()
    else:
        writer = library("vtkmodules.vtkIOLegacy", ".vtk files").vtkPolyDataWriter()
        writer.SetFileTypeToBinary()
    writer.SetInputData(polydata)
    writer.SetFileName(str(path))
    done, messages = _watch(writer.Write)
    if not done or messages:
        raise OSError(f"{path.name}: VTK could not write the file: {messages or 'it gives no reason'}")


def _read_polydata(path: Path) -> Any:
    pyvista = library("pyvista", ".vtp and .vtk files")
    if path.suffix.lower() == ".vtp":
        reader = library("vtkmodules.vtkIOXML", ".vtp files").vtkXMLPolyDataReader()
    else:
        reader = library("vtkmodules.vtkIOLegacy", ".vtk files").vtkDataSetReader()
    reader.SetFileName(str(path))
    _, messages = _watch(reader.Update)
    # VTK calls a file that ends too early a warning, and fills up what is missing.
    if "error" in messages.lower() or reader.GetOutput() is None:
        raise MeshError(
            f"{path.name}: VTK cannot read the file, it is damaged or of another format. It says: {messages}"
        )
    if messages:
        warn(path, f"VTK says: {messages}")
    dataset = pyvista.wrap(reader.GetOutput())
    if not isinstance(dataset, pyvista.PolyData):
        raise MeshError(
            f"{path.name}: it holds a {type(dataset).__name__}, not polygons. Take its surface first: "
            "pyvista.read(...).extract_surface().save(...)."
        )
    return dataset


def _faces(path: Path, polydata: Any) -> dict[int, np.ndarray] | None:
    to_numpy = library("vtkmodules.util.numpy_support", ".vtp and .vtk files").vtk_to_numpy
    polygons = polydata.GetPolys()
    if polygons.GetNumberOfCells() == 0:
        return None
    offsets, corners = (
        to_numpy(array).astype(np.int64) for array in (polygons.GetOffsetsArray(), polygons.GetConnectivityArray())
    )
    sizes = np.diff(offsets)
    check_polygons(path, sizes)
    return by_size(corners, offsets[:-1], sizes)


def _watch(act: Any) -> tuple[Any, str]:
    """What `act` returns and what VTK says meanwhile, which would otherwise go to the terminal."""
    core = library("vtkmodules.vtkCommonCore", ".vtp and .vtk files")
    window, window_before = core.vtkStringOutputWindow(), core.vtkOutputWindow.GetInstance()
    logged_before = core.vtkLogger.GetCurrentVerbosityCutoff()
    core.vtkOutputWindow.SetInstance(window)
    core.vtkLogger.SetStderrVerbosity(core.vtkLogger.VERBOSITY_OFF)
    try:
        result = act()
    finally:
        core.vtkOutputWindow.SetInstance(window_before)
        core.vtkLogger.SetStderrVerbosity(logged_before)
    said = window.GetOutput()
    text = said.decode("utf-8", errors="replace") if isinstance(said, bytes) else said  # it may quote a damaged file
    return result, " ".join(text.split())
