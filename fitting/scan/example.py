"""Scans that ship with the package."""

from importlib.resources import as_file, files
from typing import Literal, TypeAlias, get_args

import jaxsubdiv as js

from .scan import Scan, read_scan

Example: TypeAlias = Literal["head_fragment", "femur_distal"]


def example(name: Example) -> tuple[Scan, js.ControlMesh]:
    """A scan in mm and a control mesh for it.

    "head_fragment": brow, eyes and temples of a person, 8,000 points of an MRI iso-surface, 140 quads, open.
    "femur_distal": the knee end of a femur, 5,000 points from MRI, 496 triangles, closed.
    Sources and licences lie beside the files, in `fitting/data`.
    """
    if name not in get_args(Example):
        raise ValueError(f"`name` must be one of {', '.join(map(repr, get_args(Example)))}; got {name!r}.")
    package = __name__.rsplit(".", 2)[0]  # by its name on import, which may be `jaxsubdiv.fitting`
    with as_file(files(package) / "data" / f"{name}.npz") as path:
        return read_scan(path), js.read_mesh(path)
