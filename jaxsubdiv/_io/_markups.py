"""Control points of 3D Slicer: `.mrk.json`, and `.fcsv` of its older versions."""

import json
import re
import reprlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import MeshError, name_rows
from ..frames import AXES
from ..tables import decode, read_table
from ._contents import Contents, warn

# Older versions number the frames.
_FRAMES = {"0": "RAS", "1": "LPS", "ras": "RAS", "lps": "LPS", "scanner-xyz": "RAS"}
_COLUMNS = ["id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label", "desc", "associatedNodeID"]


class _Marks(NamedTuple):
    positions: list[list[float]]
    labels: list[str]
    frames: list[str]


def read(path: Path) -> Contents:
    """Positions as the file has them, and the column `label`; a warning says in which frame they are.

    Control points that were not placed are left out.
    """
    marks = _read_fcsv(path) if path.suffix.lower() == ".fcsv" else _read_json(path)
    frames = sorted(set(marks.frames))
    if len(frames) > 1:
        raise MeshError(f"{path.name}: it holds control points in {' and '.join(frames)}. Save each frame for itself.")
    for frame in frames:
        warn(path, f"positions are in {frame} ({AXES[frame]}), as the file says; scan and template must be in it too.")
    return Contents(np.array(marks.positions, np.float64).reshape(-1, 3), texts={"label": marks.labels})


def _read_json(path: Path) -> _Marks:
    try:
        content = json.loads(decode(path.read_bytes()))
    except (ValueError, RecursionError) as error:
        raise MeshError(f"{path.name}: it is no JSON: {error}.") from None
    markups = content.get("markups") if isinstance(content, dict) else None
    if not isinstance(markups, list):
        raise MeshError(f"{path.name}: it has no list `markups`, so it is no file of control points of 3D Slicer.")
    marks = _Marks([], [], [])
    for markup in markups:
        points = markup.get("controlPoints", []) if isinstance(markup, dict) else None
        if not isinstance(points, list):
            raise MeshError(f"{path.name}: the list `markups` must hold objects with a list `controlPoints`.")
        unit = markup.get("coordinateUnits", "mm")
        if unit != "mm":
            warn(path, f"positions are in {reprlib.repr(unit)}, as the file says; `scale` turns them into mm.")
        for i, point in enumerate(points):
            where = f"control point {i}, counted from zero,"
            if not isinstance(point, dict):
                raise MeshError(f"{path.name}: {where} is no object with a `position`.")
            if point.get("positionStatus", "defined") != "defined" or point.get("position", ()) is None:
                continue
            _append(
                path, marks, where, point.get("position"), point.get("label"), markup.get("coordinateSystem", "LPS")
            )
    return marks


def _read_fcsv(path: Path) -> _Marks:
    text, table = decode(path.read_bytes()), read_table(path)
    frame = re.search(r"^# *CoordinateSystem *= *(\w+)", text, re.MULTILINE)
    columns = re.search(r"^# *columns *= *(\S+)", text, re.MULTILINE)
    names = columns[1].split(",") if columns else _COLUMNS
    if not {"x", "y", "z", "label"} <= set(names[: table.n_columns]):
        raise MeshError(
            f"{path.name}: its {table.n_columns} columns must have x, y, z and label; it has {name_rows(names)}."
        )
    positions = table.numbers([names.index(axis) for axis in "xyz"])
    marks = _Marks([], [], [])
    for line, position, label in zip(table.lines, positions.tolist(), table.texts(names.index("label")), strict=True):
        _append(path, marks, f"line {line}", position, label, frame[1] if frame else "RAS")
    return marks


def _append(path: Path, marks: _Marks, where: str, position: Any, label: Any, frame: Any) -> None:
    try:
        x, y, z = (
            float(value) for value in position if isinstance(value, (int, float)) and not isinstance(value, bool)
        )
    except (TypeError, ValueError, OverflowError):
        raise MeshError(
            f"{path.name}: {where} needs a `position` of three numbers; got {reprlib.repr(position)}."
        ) from None
    known = _FRAMES.get(str(frame).lower()) if isinstance(frame, (str, int)) else None
    if known is None:
        raise MeshError(f"{path.name}: the frame {reprlib.repr(frame)} is not known; it must be LPS or RAS.")
    marks.positions.append([x, y, z])
    marks.labels.append(label if isinstance(label, str) else "")
    marks.frames.append(known)
