"""Points as text: one a line, with or without a header row that names the columns."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float

from ..errors import MeshError, name_rows
from ._contents import Contents
from ._text import decode

_POSITION, _NORMAL, _WEIGHT = ("x", "y", "z"), ("nx", "ny", "nz"), "weight"
_POINT = "Write decimals with a point."
_EXPECTED = (
    "Without a header row there must be 3 columns (x, y, z) or 6 (x, y, z, nx, ny, nz); with others, name them in a "
    "first row, of x, y, z, nx, ny, nz, weight. Columns of other names are left out."
)


def read(path: Path) -> Contents:
    """Points, and normals and weights where the file has them.

    Commas, semicolons or white space part the columns. A header row names them in any order, and those of other names
    are left out. Without one there are 3 columns, or 6 with the normals. What follows a `#` is a comment.
    """
    rows, delimiter = _rows(path)
    number, first = rows[0]
    cells = _split(first, delimiter)
    if all(map(_is_number, cells)):
        if len(cells) not in (3, 6):
            raise MeshError(f"{path.name}, line {number}: {len(cells)} columns. {_EXPECTED}")
        names = [*_POSITION, *_NORMAL][: len(cells)]
    elif all(_is_number(part.replace(",", ".")) for part in first.split()):
        raise MeshError(f"{path.name}, line {number}: '{first.split()[0][:40]}' is not a number. {_POINT}")
    else:
        names = [cell.lower() for cell in cells]
        _check_names(path, number, names)
        rows = rows[1:]
    wanted = [name for name in (*_POSITION, *_NORMAL, _WEIGHT) if name in names]
    table = _numbers(path, rows, delimiter, [names.index(name) for name in wanted], len(names))
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if len(bad):
        raise MeshError(
            f"{path.name}, line {name_rows(rows[i][0] for i in bad)}: a number is not finite. Delete these rows."
        )
    has_normals, has_weights = "nx" in wanted, _WEIGHT in wanted
    headless = len(rows) > 0 and rows[0][0] == number
    whole = not any("." in text for _, text in rows)
    if headless and whole and len(names) == 6 and delimiter == "," and _are_halves(table):
        raise MeshError(
            f"{path.name}: 6 columns of whole numbers, the last three of them no normals: decimal commas, it seems. "
            "Write decimals with a point, or name the columns in a first row."
        )
    return Contents(table[:, :3], None, table[:, 3:6] if has_normals else None, table[:, -1] if has_weights else None)


def _are_halves(table: Float[np.ndarray, "p 6"]) -> bool:
    """Whether rows of six whole numbers are three that were cut at their decimal commas: 1,25 read as 1 and 25."""
    return bool(np.median(np.linalg.norm(table[:, 3:6], axis=1)) > 2)  # of normals it is about 1


def read_texts(path: Path, names: Sequence[str]) -> dict[str, list[str]]:
    """Those of the named columns that the header row names, as text; the rows are those of `read`."""
    rows, delimiter = _rows(path)
    header = [cell.lower() for cell in _split(rows[0][1], delimiter)]
    places = {name: header.index(name) for name in names if name in header}
    if not places:
        return {}
    cells = [_split(text, delimiter) for _, text in rows[1:]]
    return {name: [row[place] for row in cells] for name, place in places.items()}


def _rows(path: Path) -> tuple[list[tuple[int, str]], str | None]:
    """Lines that hold something, with their numbers, and what parts their columns."""
    lines = enumerate(decode(path.read_bytes()).split("\n"), start=1)
    rows = [(number, text) for number, line in lines if (text := line.partition("#")[0].strip())]
    if not rows:
        raise MeshError(f"{path.name}: it has no line of numbers.")
    first = rows[0][1]
    return rows, ";" if ";" in first else "," if "," in first else None


def _check_names(path: Path, number: int, names: list[str]) -> None:
    known = [name for name in names if name in (*_POSITION, *_NORMAL, _WEIGHT)]
    n_normal = len(set(_NORMAL) & set(known))
    if not set(_POSITION) <= set(known) or n_normal not in (0, 3) or len(set(known)) < len(known):
        raise MeshError(
            f"{path.name}, line {number}: a header row must name x, y and z, all of nx, ny, nz or none, and none "
            f"twice; this one has {name_rows(names, 8)}. {_EXPECTED}"
        )


def _numbers(
    path: Path, rows: list[tuple[int, str]], delimiter: str | None, places: Sequence[int], n_columns: int
) -> Float[np.ndarray, "p c"]:
    """The columns at `places` of rows that have `n_columns` each."""
    if not rows:
        return np.zeros((0, len(places)))
    texts = [text for _, text in rows]
    # Left to itself numpy takes only the columns asked for, so longer rows are told by counting.
    n_parts = {text.count(delimiter) for text in texts} if delimiter else {len(text.split()) for text in texts}
    if n_parts == {n_columns - 1 if delimiter else n_columns} or '"' in "".join(texts):
        try:
            return np.loadtxt(texts, delimiter=delimiter, usecols=places, ndmin=2, comments=None, quotechar='"')
        except ValueError:
            pass
    _raise_bad_row(path, rows, delimiter, places, n_columns)


def _raise_bad_row(
    path: Path, rows: list[tuple[int, str]], delimiter: str | None, places: Sequence[int], n_columns: int
) -> NoReturn:
    for number, text in rows:
        cells = _split(text, delimiter)
        if len(cells) != n_columns:
            halves = f" {_POINT}" if delimiter == "," and len(cells) == 2 * n_columns else ""
            raise MeshError(
                f"{path.name}, line {number}: {len(cells)} columns, where the first row has {n_columns}.{halves}"
            )
        for place in places:
            if not _is_number(cells[place]):
                raise MeshError(f"{path.name}, line {number}: '{cells[place][:40]}' is not a number. {_POINT}")
    raise MeshError(f"{path.name}: the numbers cannot be read. Write them in plain digits, such as -1.5e-3.")


def _split(text: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return [cell.strip('"') for cell in text.split()]
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter))]
    except csv.Error:  # a cell of more than 100 kB
        return [text]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # Python's own way to write thousands
