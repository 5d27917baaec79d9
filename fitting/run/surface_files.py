"""The files that a fitted surface is written to, by the names that the command line has for their formats."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

import jaxsubdiv as js
from jaxsubdiv.frames import Frame

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


def write_surface(
    folder: Path,
    surface: js.RefinedSurface,
    values: Mapping[str, Float[np.ndarray, "v"]],
    formats: Sequence[str],
    frame: Frame | None = None,
    name: str = "surface",
) -> list[str]:
    """Write a surface, and the values at its vertices where the format holds them.

    Args:
        values: by their names.
        name: of the files, before their endings.

    Returns:
        the names of the files.
    """
    written = []
    for kind in dict.fromkeys(formats):
        of_vertices = values if kind in _WITH_DATA else None
        written.append(_FILES[kind].replace("surface", name, 1))
        js.write_mesh(folder / written[-1], surface, vertex_data=of_vertices, frame=frame)
        if kind == "gii":
            written.append(_DATA_OF_GIFTI.replace("surface", name, 1))
            js.write_mesh(folder / written[-1], surface, vertex_data=values)
    return written
