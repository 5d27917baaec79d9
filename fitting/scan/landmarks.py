"""Landmarks: the same few places named on the scan and on the template."""

import csv
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

import jaxsubdiv as js

from .scan import ScanError


class Landmarks(NamedTuple):
    """Places on the scan, and the same places on the template, row by row."""

    on_scan: ArrayLike
    """`[l, 3]`, positions in mm."""
    on_mesh: ArrayLike
    """`[l]` vertex indices of the control mesh, or `[l, 3]` positions in its unit."""
    weights: ArrayLike | None = None
    """`[l]`, how much each counts, not negative; None where all count alike."""


class Placed(NamedTuple):
    """Landmarks after their checks, with a position for each."""

    scan: Float[np.ndarray, "l 3"]
    mesh: Float[np.ndarray, "l 3"]
    weights: Float[np.ndarray, "l"]


def read_landmarks(path: str | Path, *, scale: float = 1.0) -> dict[str, Float[np.ndarray, "3"]]:
    """Named positions from a JSON or CSV file.

    JSON holds an object of `"name": [x, y, z]`; a name may hold a list of positions as well, which become `name 1`,
    `name 2` and so on. CSV holds rows of `name,x,y,z`, with or without a row of headings.

    Args:
        path: the file; its ending says which of the two it is.
        scale: multiplies the coordinates; 1000 takes metres to mm.

    Raises:
        ScanError: the file cannot be read, a position is not three finite numbers, or a name comes twice. The text
            names the file and the landmark or line.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ScanError(f"landmarks cannot be read from {path}: {error}.") from error
    readers = {".json": _json_rows, ".csv": _csv_rows}
    if path.suffix.lower() not in readers:
        raise ScanError(f"{path}: landmarks are read from .json and .csv files, not from {path.suffix or 'this'}.")
    landmarks: dict[str, Float[np.ndarray, "3"]] = {}
    for name, where, values in readers[path.suffix.lower()](path, text):
        try:
            position = np.asarray(values, np.float64) * scale
        except (TypeError, ValueError):
            position = np.zeros(0)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ScanError(f"{path}, {where}: a landmark is three finite numbers x, y, z; got {values}.")
        if name in landmarks:
            raise ScanError(f"{path}, {where}: a landmark of the name '{name}' came before. Names must differ.")
        landmarks[name] = position
    if not landmarks:
        raise ScanError(f"{path} holds no landmarks.")
    return landmarks


def match_landmarks(
    on_scan: Mapping[str, ArrayLike], on_mesh: Mapping[str, ArrayLike] | Mapping[str, int]
) -> Landmarks:
    """Landmarks that both name, in the order of the first; capitals and blanks around a name make no difference.

    Args:
        on_scan: positions in mm by name, as `read_landmarks` gives them.
        on_mesh: positions in the unit of the control mesh by name, or a vertex index each.

    Raises:
        ScanError: no name is in both; the text lists the names.
    """
    known = {name.strip().casefold(): value for name, value in on_mesh.items()}
    both = [(value, known[key]) for name, value in on_scan.items() if (key := name.strip().casefold()) in known]
    if not both:
        raise ScanError(
            f"no landmark is named on both sides: the scan has {', '.join(on_scan) or 'none'}; the mesh has "
            f"{', '.join(on_mesh) or 'none'}."
        )
    scan, mesh = zip(*both, strict=True)
    return Landmarks(np.array(scan, np.float64), np.array(mesh))


def place_landmarks(landmarks: Landmarks | tuple[Any, ...], mesh: js.ControlMesh) -> Placed:
    """Positions on both sides.

    Raises:
        ScanError: lengths differ, an index is no vertex, or a value is not finite; the text names the rows.
    """
    first, second, *rest = landmarks
    scan, on_mesh = np.asarray(first, np.float64), np.asarray(second)
    if on_mesh.ndim == 1 and len(on_mesh) and np.issubdtype(on_mesh.dtype, np.integer):
        on_mesh = _vertices(on_mesh, mesh)
    on_mesh = on_mesh.astype(np.float64)
    for name, rows in (("on_scan", scan), ("on_mesh", on_mesh)):
        if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) == 0:
            indices = ", or vertex indices [l]" * (name == "on_mesh")
            raise ScanError(f"landmarks: `{name}` must be positions [l, 3]{indices}; got {list(rows.shape)}.")
        if not np.isfinite(rows).all():
            bad = ", ".join(map(str, np.flatnonzero(~np.isfinite(rows).all(axis=1))))
            raise ScanError(f"landmarks: `{name}` is not finite in rows {bad}. Leave these landmarks out.")
    weights = np.ones(len(scan)) if not rest or rest[0] is None else np.asarray(rest[0], np.float64)
    if len(scan) != len(on_mesh) or weights.shape != (len(scan),):
        raise ScanError(
            f"landmarks: {len(scan)} on the scan, {len(on_mesh)} on the mesh, {weights.size} weights. Each place needs "
            "one of every kind."
        )
    if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.sum() > 0):
        raise ScanError("landmarks: `weights` must be finite and not negative, and not all 0.")
    return Placed(scan, on_mesh, weights)


def _vertices(rows: Int[np.ndarray, "l"], mesh: js.ControlMesh) -> Float[np.ndarray, "l 3"]:
    beyond = rows[(rows < 0) | (rows >= len(mesh.vertices))]
    if len(beyond):
        raise ScanError(
            f"landmarks: there is no vertex {', '.join(map(str, beyond))} in a mesh of {len(mesh.vertices)} vertices, "
            "counted from zero."
        )
    return mesh.vertices[rows]


def _json_rows(path: Path, text: str) -> Iterator[tuple[str, str, Any]]:
    try:
        content = json.loads(text)
    except json.JSONDecodeError as error:
        raise ScanError(f"{path} is no JSON: {error}.") from error
    if not isinstance(content, dict):
        raise ScanError(f"{path}: landmarks in JSON are an object of names, each with its position [x, y, z].")
    for name, value in content.items():
        if isinstance(value, list) and value and all(isinstance(item, list) for item in value):
            yield from ((f"{name} {i}", f"'{name}'", item) for i, item in enumerate(value, 1))
        else:
            yield name, f"'{name}'", value


def _csv_rows(path: Path, text: str) -> Iterator[tuple[str, str, Any]]:
    for line, row in enumerate(csv.reader(text.splitlines()), 1):
        cells = [cell.strip() for cell in row]
        if not any(cells) or (line == 1 and [cell.casefold() for cell in cells[1:]] == ["x", "y", "z"]):
            continue
        yield cells[0], f"line {line}", cells[1:]
