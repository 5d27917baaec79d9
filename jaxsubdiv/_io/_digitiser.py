"""Heads traced with a pen, as Polhemus digitisers and the programs around them write them: `.hsp`, `.elp`, `.pos`.

Each format has its unit, in which programs of magnetoencephalography (MNE-Python, FieldTrip) read it.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import MeshError
from ..tables import decode
from ._contents import Contents

_METRES, _CENTIMETRES = ("metres", 1000.0), ("centimetres", 10.0)
_FIDUCIALS = ("nasion", "lpa", "rpa")
"""The places that files give as X+, Y+ and Y-: x runs through the nose, y through the left ear."""
_NUMBER = re.compile(r"[-+]?([0-9]{1,40}\.?[0-9]{0,40}|\.[0-9]{1,40})([eE][-+]?[0-9]{1,4})?|[-+]?nan|[-+]?inf", re.I)
_COUNT = re.compile("[0-9]{1,9}")


class _Points(NamedTuple):
    positions: list[list[float]]
    labels: list[str]

    def add(self, position: list[float], label: str) -> None:
        self.positions.append(position)
        self.labels.append(label)


def read(path: Path) -> Contents:
    """Places of the head, fiducials among them, and what each is called as the column `label`."""
    lines = [line.split() for line in decode(path.read_bytes()).split("\n")]
    points = _Points([], [])
    if path.suffix.lower() == ".pos":
        _read_pos(path, lines, points)
        unit = _CENTIMETRES
    else:
        _read_isotrak(path, lines, points)
        unit = _METRES
    positions = np.array(points.positions, np.float64).reshape(-1, 3)
    return Contents(positions, texts={"label": points.labels}, usual_unit=unit)


def _read_isotrak(path: Path, lines: list[list[str]], points: _Points) -> None:
    """Head shapes and probes: comments after `//`, fiducials after `%F`, a sensor's name after `%N` and its place in
    the line that follows."""
    name, n_fiducials, n_shape, announced = "", 0, 0, None
    begins = iter([*lines[0], *[""] * 2])
    if next(begins) != "3" or next(begins) not in ("200", "2"):
        raise MeshError(
            f"{path.name}, line 1: a head shape of a Polhemus digitiser begins with '3 200', and a probe with '3 2'. "
            "A table of points has the suffix .xyz, .csv or .txt; angles of BESA give no positions."
        )
    given = enumerate(lines[1:], 2)
    for number, words in given:
        if not words or words[0].startswith("//"):
            # The rows of a head shape are counted in the line after this comment, and follow that.
            if "".join(words[:3]).lower().startswith("//noofrows"):
                announced = _rows_announced(path, *next(given, (number + 1, [])))
        elif words[0] == "%F":
            label = _FIDUCIALS[n_fiducials] if n_fiducials < 3 else "fiducial"
            points.add(_numbers(path, number, words[1:4]), label)
            n_fiducials += 1
        elif words[0] == "%N":
            name = " ".join(words[1:])[:80]
        elif words[0].startswith("%") or (announced is None and len(words) < 3):
            continue  # kinds of sensors, and numbers that say how many there are
        else:
            points.add(_numbers(path, number, words), "head" if announced is not None else name or "sensor")
            n_shape += 1
    if announced is not None and n_shape != announced:
        raise MeshError(f"{path.name}: {announced} points are announced, but {n_shape} follow. It is cut off.")


def _rows_announced(path: Path, number: int, words: list[str]) -> int:
    if len(words) != 2 or not _COUNT.fullmatch(words[0]) or words[1] != "3":
        raise MeshError(f"{path.name}, line {number}: the number of points must stand here, and that of columns, 3.")
    return int(words[0])


def _read_pos(path: Path, lines: list[list[str]], points: _Points) -> None:
    """A number or a name and x, y, z, or both; the first line may give the number of points."""
    announced = None
    for number, words in enumerate(lines, 1):
        if len(words) == 1 and number == 1 and _COUNT.fullmatch(words[0]):
            announced = int(words[0])
        elif words:
            if len(words) not in (4, 5):
                raise MeshError(
                    f"{path.name}, line {number}: {len(words)} words, where a number or a name, and x, y, z are needed."
                )
            points.add(_numbers(path, number, words[-3:]), words[-4][:80])
    if announced is not None and len(points.labels) < announced:
        raise MeshError(
            f"{path.name}: {announced} points are announced, but {len(points.labels)} follow. It is cut off."
        )


def _numbers(path: Path, line: int, words: list[str]) -> list[float]:
    if len(words) != 3 or not all(map(_NUMBER.fullmatch, words)):
        raise MeshError(f"{path.name}, line {line}: '{' '.join(words)[:60]}' should be three numbers: x, y and z.")
    return [float(word) for word in words]
