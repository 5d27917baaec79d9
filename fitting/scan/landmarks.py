"""Landmarks: the same few places named on the scan and on the template."""

import json
import reprlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

import jaxsubdiv as js
from jaxsubdiv.tables import decode, read_table

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
    """Named positions from a JSON or CSV file, or one of control points of 3D Slicer (`.mrk.json`, `.fcsv`).

    JSON holds an object of `"name": [x, y, z]`; a name may hold a list of positions as well, which become `name 1`,
    `name 2` and so on. CSV holds rows of `name,x,y,z`, or a row of headings that names x, y, z and the names' column
    `name` or `label`. Control points stay in the frame of their file, and a warning says which it is.

    Args:
        path: the file; its ending says which it is.
        scale: multiplies the coordinates; 1000 takes metres to mm.

    Raises:
        ScanError: the file cannot be read, a position is not three finite numbers, or a name comes twice. The text
            names the file and the landmark or line.
    """
    path = Path(path)
    readers = {".json": _json_rows, ".csv": _csv_rows, ".fcsv": _control_points}
    if path.suffix.lower() not in readers:
        raise ScanError(
            f"{path}: landmarks are read from .json, .csv and .fcsv files, not from {path.suffix or 'this'}."
        )
    landmarks: dict[str, Float[np.ndarray, "3"]] = {}
    try:
        for name, where, values in readers[path.suffix.lower()](path):
            position = np.array(values, np.float64) * scale if _are_three_numbers(values) else np.full(3, np.nan)
            if not np.isfinite(position).all():
                raise ScanError(
                    f"{path}, {where}: a landmark is three finite numbers x, y, z; got {reprlib.repr(values)}."
                )
            if name in landmarks:
                raise ScanError(f"{path}, {where}: a landmark of the name '{name}' came before. Names must differ.")
            landmarks[name] = position
    except OSError as error:
        raise ScanError(f"landmarks cannot be read from {path}: {error}.") from error
    except js.MeshError as error:
        raise ScanError(f"landmarks cannot be read from {path.parent / ''}{error}") from None
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


def _are_three_numbers(values: Any) -> bool:
    """Whether it is a list of three numbers that floating point holds."""
    numbers = isinstance(values, list) and all(type(value) in (int, float) for value in values)
    return numbers and len(values) == 3 and all(abs(value) < 1e300 for value in values)


def _json_rows(path: Path) -> Iterator[tuple[str, str, Any]]:
    try:
        content = json.loads(decode(path.read_bytes()))
    except (ValueError, RecursionError) as error:  # also of numbers of thousands of digits, and of depth
        raise ScanError(f"{path} is no JSON: {error}.") from None
    if not isinstance(content, dict):
        raise ScanError(f"{path}: landmarks in JSON are an object of names, each with its position [x, y, z].")
    if "markups" in content:
        yield from _control_points(path)
        return
    for name, value in content.items():
        if isinstance(value, list) and value and all(isinstance(item, list) for item in value):
            yield from ((f"{name} {i}", f"'{name}'", item) for i, item in enumerate(value, 1))
        else:
            yield name, f"'{name}'", value


def _csv_rows(path: Path) -> Iterator[tuple[str, str, Any]]:
    table = read_table(path)
    names = table.headings or ["name", "x", "y", "z"]
    known = [name for name in ("name", "label", "landmark") if name in names] or [
        name for name in names if len(name) > 1
    ]
    if not {"x", "y", "z"} <= set(names[: table.n_columns]) or not known:
        raise ScanError(f"{path}, line {table.line}: landmarks need the columns name, x, y and z; it has {names}.")
    positions = table.numbers([names.index(axis) for axis in "xyz"]).tolist()
    of_rows = zip(table.texts(names.index(known[0])), table.lines, positions, strict=True)
    yield from ((name, f"line {line}", position) for name, line, position in of_rows)


def _control_points(path: Path) -> Iterator[tuple[str, str, Any]]:
    cloud, columns = js.read_labelled_points(path, ("label",))
    for i, (name, position) in enumerate(zip(columns["label"], cloud.points.tolist(), strict=True)):
        yield name or f"{i + 1}", f"control point {i}, counted from zero", position
