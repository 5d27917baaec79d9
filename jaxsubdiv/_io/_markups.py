"""Control points of 3D Slicer as points of a scan."""

from pathlib import Path

from ..frames import AXES
from ..markups import read_control_points
from ._contents import Contents, warn


def read(path: Path) -> Contents:
    """Positions as the file has them, and the column `label`; a warning says in which frame they are."""
    points = read_control_points(path)
    if points.unit != "mm":
        warn(path, f"positions are in {points.unit}, as the file says; `scale` turns them into mm.")
    if (frame := points.frame) is not None:
        warn(path, f"positions are in {frame} ({AXES[frame]}), as the file says; scan and template must be in it too.")
    return Contents(points.positions, texts={"label": points.labels}, frame=frame)
