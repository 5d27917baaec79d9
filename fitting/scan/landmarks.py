"""Landmarks: the same few places named on the scan and on the template."""

import json
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

import jaxsubdiv as js
from jaxsubdiv.files import replace_file
from jaxsubdiv.frames import AXES, Frame, convert_frame
from jaxsubdiv.markups import read_control_points, write_control_points
from jaxsubdiv.notices import warn
from jaxsubdiv.tables import decode

from .scan import ScanError

SUFFIXES = (".json", ".csv", ".tsv", ".fcsv")
_Row: TypeAlias = tuple[str, str, Any]
"""A name, where it stands in the file, and what should be a position."""


def name_suffixes() -> str:
    """Of files of landmarks, for error texts."""
    return f"{', '.join(SUFFIXES[:-1])} and {SUFFIXES[-1]}"


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


class FramedLandmarks(NamedTuple):
    """Named positions, and what their axes are."""

    positions: dict[str, Float[np.ndarray, "3"]]
    """In mm."""
    frame: Frame | None
    """None where neither the file says it nor the one who asked."""


def read_landmarks(
    path: str | Path, *, scale: float = 1.0, frame: Frame | None = None
) -> dict[str, Float[np.ndarray, "3"]]:
    """Named positions from a JSON or CSV file, or from a file of 3D Slicer (`.mrk.json`, `.fcsv`, exported tables).

    JSON holds an object of `"name": [x, y, z]`; a name may hold a list of positions as well, which become `name 1`,
    `name 2` and so on. CSV (or TSV) holds rows of `name,x,y,z`, or a row of headings in any order: the names are in the
    column `name` or `label`, positions in `x`, `y`, `z`, or in `l`, `p`, `s` or `r`, `a`, `s` as 3D Slicer exports
    them. Control points that were not placed are left out.

    Args:
        path: the file; its ending says which it is.
        scale: multiplies the coordinates; 1000 takes metres to mm.
        frame: of the scan, or of the template, that the landmarks lie on (`Scan.frame`, `js.read_frame`): positions of
            a file that says another are turned into it. Without one they stay in the frame of their file, and a warning
            says which it is.

    Raises:
        ScanError: the file cannot be read, a position is not three finite numbers, or a name comes twice. The text
            names the file and the landmark or line.
    """
    return read_framed_landmarks(path, scale=scale, frame=frame).positions


def read_framed_landmarks(path: str | Path, *, scale: float = 1.0, frame: Frame | None = None) -> FramedLandmarks:
    """The landmarks of `read_landmarks`, and the frame that they are in."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ScanError(f"{path}: landmarks are read from {name_suffixes()} files, not from {path.suffix or 'this'}.")
    landmarks: dict[str, Float[np.ndarray, "3"]] = {}
    try:
        rows, own = _json_rows(path) if suffix == ".json" else _control_points(path)
        for name, where, values in rows:
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
    if own is not None and frame is None:
        warn(
            f"{path.name}: positions are in {own} ({AXES[own]}), as the file says; scan and template must be in it too."
        )
    if own is not None and frame is not None:
        landmarks = {name: convert_frame(position, own, frame) for name, position in landmarks.items()}
    return FramedLandmarks(landmarks, frame or own)


def write_landmarks(
    path: str | Path,
    landmarks: Mapping[str, ArrayLike],
    *,
    frame: Frame | None = None,
    deviations: Mapping[str, float] | None = None,
) -> None:
    """Write named positions in a format that `read_landmarks` reads, to the same positions and frame.

    `.json` (name it `.mrk.json`) and `.fcsv` are files of 3D Slicer; where the frame is not known they say LPS, which
    is what 3D Slicer takes for the frame of a mesh that names none. `.csv` and `.tsv` are tables with the columns
    `name`, `x`, `y`, `z`, then `deviation_mm` where there are deviations, and `frame` where it is known.

    Args:
        path: the file; its ending says which it is to be. It appears once it is complete.
        landmarks: positions in mm by name.
        frame: what the axes are.
        deviations: standard deviation of each in mm, by name: a column of a table, words in a file of 3D Slicer.

    Raises:
        ScanError: the ending is none of these, or a position is not three finite numbers.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ScanError(f"{path}: landmarks are written to {name_suffixes()} files, not to {path.suffix or 'this'}.")
    positions = {name: np.asarray(position, np.float64) for name, position in landmarks.items()}
    bad = [name for name, position in positions.items() if position.shape != (3,) or not np.isfinite(position).all()]
    if bad:
        raise ScanError(f"{path}: the landmarks {', '.join(bad)} are not three finite numbers x, y, z.")
    spread = None if deviations is None else np.array([deviations[name] for name in positions], np.float64)
    rows = np.array(list(positions.values())).reshape(-1, 3)
    with replace_file(path) as unfinished:
        write_control_points(unfinished, rows, list(positions), frame=frame, deviations=spread)


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


def _json_rows(path: Path) -> tuple[list[_Row], Frame | None]:
    try:
        content = json.loads(decode(path.read_bytes()))
    except (ValueError, RecursionError) as error:  # also of numbers of thousands of digits, and of depth
        raise ScanError(f"{path} is no JSON: {error}.") from None
    if not isinstance(content, dict):
        raise ScanError(f"{path}: landmarks in JSON are an object of names, each with its position [x, y, z].")
    if "markups" in content:
        return _control_points(path)
    rows: list[_Row] = []
    for name, value in content.items():
        if isinstance(value, list) and value and all(isinstance(item, list) for item in value):
            rows += [(f"{name} {i}", f"'{name}'", item) for i, item in enumerate(value, 1)]
        else:
            rows.append((name, f"'{name}'", value))
    return rows, None


def _control_points(path: Path) -> tuple[list[_Row], Frame | None]:
    points = read_control_points(path)
    if points.unit != "mm":
        warn(f"{path.name}: positions are in {points.unit}, as the file says; `scale` turns them into mm.")
    numbered = enumerate(zip(points.labels, points.places, points.positions.tolist(), strict=True), 1)
    return [(label or f"{i}", place, position) for i, (label, place, position) in numbered], points.frame
