"""The files that a fitted surface is written to, by the names that the command line has for their formats."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import jaxsubdiv as js
from jaxsubdiv.frames import Frame

from ..report.at_level import SurfaceAtLevel

_FILES = {
    "ply": "surface.ply",
    "glb": "surface.glb",
    "obj": "surface.obj",
    "stl": "surface.stl",
    "vtp": "surface.vtp",
    "gii": "surface.surf.gii",  # the name by which Connectome Workbench knows a surface
    "surf": "surface.surf",
}
_WITH_DATA = ("ply", "glb", "vtp")
_DATA_OF_GIFTI = "surface.shape.gii"
FORMATS = tuple(_FILES)
SURFACE_FILES = (*_FILES.values(), _DATA_OF_GIFTI)


def check_formats(formats: Iterable[str]) -> None:
    """See that surfaces can be written so.

    Raises:
        ImportError: a library of the extra `io` is not installed; the text names it.
    """
    for name in formats:
        js.check_can_write(_FILES[name], vertex_data=name in _WITH_DATA)


def write_surface(folder: Path, at: SurfaceAtLevel, formats: Sequence[str], frame: Frame | None = None) -> list[str]:
    """Write a surface, and the distances and deviations at its vertices where the format holds them.

    Returns:
        the names of the files.
    """
    values, written = {"distance_mm": at.distances, "deviation_mm": at.deviations}, []
    for name in dict.fromkeys(formats):
        of_vertices = values if name in _WITH_DATA else None
        js.write_mesh(folder / _FILES[name], at.surface, vertex_data=of_vertices, frame=frame)
        written.append(_FILES[name])
        if name == "gii":
            js.write_mesh(folder / _DATA_OF_GIFTI, at.surface, vertex_data=values)
            written.append(_DATA_OF_GIFTI)
    return written
