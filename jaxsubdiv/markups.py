"""Control points of 3D Slicer: `.mrk.json`, `.fcsv` of its older versions, and the tables that it exports."""

import csv
import io
import json
import re
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .errors import MeshError, name_rows
from .frames import Frame
from .tables import Table, decode, read_table

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
# Older versions number the frames.
_FRAMES: dict[str, Frame] = {"0": "RAS", "1": "LPS", "ras": "RAS", "lps": "LPS", "scanner-xyz": "RAS"}
_AXES: dict[tuple[str, str, str], Frame | None] = {
    ("x", "y", "z"): None,
    ("l", "p", "s"): "LPS",
    ("r", "a", "s"): "RAS",
}
_COLUMNS = ["id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label", "desc", "associatedNodeID"]
_NAMES = ("name", "label", "landmark")
_MM = ("mm", ["mm", "UCUM", "millimeter"])


class ControlPoints(NamedTuple):
    """The control points of a file that were placed, as it has them."""

    positions: Float[np.ndarray, "c 3"]
    labels: list[str]
    """Empty where a point has none."""
    places: list[str]
    """Where in the file each stands, for error texts."""
    frame: Frame | None
    """None where the file does not say it."""
    unit: str
    """`mm`, or what the file says instead."""


class _Point(NamedTuple):
    position: list[float]
    label: str
    place: str
    frame: Frame | None


def read_control_points(path: Path) -> ControlPoints:
    """Control points of a `.json`, `.fcsv`, `.csv` or `.tsv` file, those that were not placed left out.

    Tables have a row of headings in any order, or none and then `name,x,y,z`. The columns `l`, `p` and `s`, or `r`, `a`
    and `s`, or a column `frame` beside `x`, `y` and `z`, say what the axes are; a column `defined` which points were
    placed.

    Raises:
        MeshError: the file is no such file, or its points lie in two frames; the text names the file and the point.
    """
    unit = "mm"
    if path.suffix.lower() == ".json":
        points, unit = _read_json(path)
    else:
        points = _read_fcsv(path) if path.suffix.lower() == ".fcsv" else _read_table(path)
    frames = sorted({point.frame or "a frame without a name" for point in points})
    if len(frames) > 1:
        raise MeshError(f"{path.name}: it holds control points in {' and '.join(frames)}. Save each frame for itself.")
    positions = np.array([point.position for point in points], np.float64).reshape(-1, 3)
    labels, places = [point.label for point in points], [point.place for point in points]
    return ControlPoints(positions, labels, places, points[0].frame if points else None, unit)


def _read_json(path: Path) -> tuple[list[_Point], str]:
    try:
        content = json.loads(decode(path.read_bytes()))
    except (ValueError, RecursionError) as error:
        raise MeshError(f"{path.name}: it is no JSON: {error}.") from None
    markups = content.get("markups") if isinstance(content, dict) else None
    if not isinstance(markups, list):
        raise MeshError(f"{path.name}: it has no list `markups`, so it is no file of control points of 3D Slicer.")
    found: list[_Point] = []
    odd_unit = "mm"
    for markup in markups:
        points = markup.get("controlPoints", []) if isinstance(markup, dict) else None
        if not isinstance(points, list):
            raise MeshError(f"{path.name}: the list `markups` must hold objects with a list `controlPoints`.")
        unit = markup.get("coordinateUnits", "mm")
        odd_unit = odd_unit if unit in _MM else reprlib.repr(unit)
        for i, point in enumerate(points):
            where = f"control point {i}, counted from zero,"
            if not isinstance(point, dict):
                raise MeshError(f"{path.name}: {where} is no object with a `position`.")
            if point.get("positionStatus", "defined") != "defined" or point.get("position", ()) is None:
                continue
            frame = _frame(path, markup.get("coordinateSystem", "LPS"))
            found.append(_point(path, where, point.get("position"), point.get("label"), frame))
    return found, odd_unit


def _read_fcsv(path: Path) -> list[_Point]:
    text, table = decode(path.read_bytes()), read_table(path)
    named = re.search(r"^# *CoordinateSystem *= *(\w+)", text, re.MULTILINE)
    columns = re.search(r"^# *columns *= *(\S+)", text, re.MULTILINE)
    names = columns[1].split(",") if columns else _COLUMNS
    if not {"x", "y", "z", "label"} <= set(names[: table.n_columns]):
        raise MeshError(
            f"{path.name}: its {table.n_columns} columns must have x, y, z and label; it has {name_rows(names)}."
        )
    frame = _frame(path, named[1] if named else "RAS")
    labels = table.texts(names.index("label"))
    frames: list[Frame | None] = [frame for _ in labels]
    return _points_of_table(path, table, [names.index(axis) for axis in "xyz"], labels, frames)


def _read_table(path: Path) -> list[_Point]:
    table = read_table(path)
    names = table.headings or ["name", "x", "y", "z"]
    there = names[: table.n_columns]
    axes = next((axes for axes in _AXES if set(axes) <= set(there)), None)
    known = [name for name in _NAMES if name in there] or [name for name in there if len(name) > 1]
    if axes is None or not known:
        raise MeshError(
            f"{path.name}, line {table.line}: landmarks need the columns name, x, y and z; or l, p and s, or r, a and "
            f"s, in place of the last three; it has {names}."
        )
    frames: list[Frame | None] = [_AXES[axes]] * len(table.rows)
    if "frame" in there and _AXES[axes] is None:
        frames = [_frame(path, cell) if cell else None for cell in table.texts(there.index("frame"))]
    labels = table.texts(there.index(known[0]))
    points = _points_of_table(path, table, [there.index(axis) for axis in axes], labels, frames)
    if "defined" not in there:
        return points
    placed = table.texts(there.index("defined"))
    return [point for point, cell in zip(points, placed, strict=True) if cell.lower() not in ("0", "false")]


def _points_of_table(
    path: Path, table: Table, places: list[int], labels: list[str], frames: Sequence[Frame | None]
) -> list[_Point]:
    rows = zip(table.numbers(places).tolist(), labels, table.lines, frames, strict=True)
    return [_point(path, f"line {line}", position, label, frame) for position, label, line, frame in rows]


def _frame(path: Path, named: Any) -> Frame:
    known = _FRAMES.get(str(named).lower()) if isinstance(named, (str, int)) else None
    if known is None:
        raise MeshError(f"{path.name}: the frame {reprlib.repr(named)} is not known; it must be LPS or RAS.")
    return known


def _point(path: Path, where: str, position: Any, label: Any, frame: Frame | None) -> _Point:
    try:
        x, y, z = (
            float(value) for value in position if isinstance(value, (int, float)) and not isinstance(value, bool)
        )
    except (TypeError, ValueError, OverflowError):
        raise MeshError(
            f"{path.name}: {where} needs a `position` of three numbers; got {reprlib.repr(position)}."
        ) from None
    return _Point([x, y, z], label if isinstance(label, str) else "", where, frame)


def write_control_points(
    path: Path,
    positions: Float[np.ndarray, "c 3"],
    labels: Sequence[str],
    *,
    frame: Frame | None,
    deviations: Float[np.ndarray, "c"] | None = None,
) -> None:
    """Write control points in mm so that `read_control_points` and, of `.json` and `.fcsv`, 3D Slicer read them.

    A file of 3D Slicer says LPS where the frame is not known: what 3D Slicer takes a mesh for that says none. A table
    has the columns `name`, `x`, `y`, `z`; `deviation_mm`, where there are deviations; and `frame`, where it is known.
    """
    rows = [position for position in np.asarray(positions, np.float64).tolist()]
    spread = None if deviations is None else np.asarray(deviations, np.float64).tolist()
    words = ["" if spread is None else f"standard deviation {spread[i]:.4g} mm" for i in range(len(rows))]
    suffix = path.suffix.lower()
    if suffix == ".json":
        text = _as_json(rows, labels, words, frame or "LPS")
    elif suffix == ".fcsv":
        head = f"# Markups fiducial file version = 4.11\n# CoordinateSystem = {frame or 'LPS'}\n"
        head += f"# columns = {','.join(_COLUMNS)}\n"
        of_points = zip(rows, labels, words, strict=True)
        text = head + _as_table(
            ([i, *at, 0, 0, 0, 1, 1, 1, 0, label, word, ""] for i, (at, label, word) in enumerate(of_points, 1)), ","
        )
    else:
        heads = ["name", "x", "y", "z", *(["deviation_mm"] * (spread is not None)), *(["frame"] * (frame is not None))]
        cells = [
            [label, *at, *([] if spread is None else [spread[i]]), *([] if frame is None else [frame])]
            for i, (at, label) in enumerate(zip(rows, labels, strict=True))
        ]
        text = _as_table([heads, *cells], "\t" if suffix == ".tsv" else ",")
    path.write_text(text, encoding="utf-8")


def _as_json(rows: list[list[float]], labels: Sequence[str], words: Sequence[str], frame: Frame) -> str:
    points = [
        {
            "id": str(i),
            "label": label,
            "description": word,
            "associatedNodeID": "",
            "position": at,
            "orientation": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0]
            if frame == "LPS"
            else np.eye(3).ravel().tolist(),
            "selected": True,
            "locked": False,
            "visibility": True,
            "positionStatus": "defined",
        }
        for i, (at, label, word) in enumerate(zip(rows, labels, words, strict=True), 1)
    ]
    markup = {
        "type": "Fiducial",
        "coordinateSystem": frame,
        "coordinateUnits": "mm",
        "locked": False,
        "fixedNumberOfControlPoints": False,
        "labelFormat": "%N-%d",
        "lastUsedControlPointNumber": len(points),
        "controlPoints": points,
    }
    return json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=4, ensure_ascii=False) + "\n"


def _as_table(rows: Any, delimiter: str) -> str:
    text = io.StringIO()
    csv.writer(text, delimiter=delimiter, lineterminator="\n").writerows(rows)
    return text.getvalue()
