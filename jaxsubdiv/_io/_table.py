"""Points as a table of text: which columns are coordinates, normals and weights."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..errors import MeshError, name_rows
from ..tables import Table, name_columns, read_table
from ._contents import Contents, warn

_POSITION, _NORMAL, _WEIGHT = ("x", "y", "z"), ("nx", "ny", "nz"), "weight"
_WORDS = "|".join(("points?", "positions?", "pos", "coordinates?", "coords?"))
_AXIS = r"[ _:.-]?([xyz012])"
_ALIASES = (
    (re.compile(f"(?:{_WORDS}){_AXIS}"), ""),
    (re.compile(rf"([xyz])(?:[ _-]?(?:{_WORDS})|[ _](?:mm|cm|m|in))"), ""),
    (re.compile(f"(?:normals?|norm|n){_AXIS}"), "n"),
    (re.compile(r"(weight)s?"), ""),
    (re.compile(r"(label|contour)[ _-](?:type|name)"), ""),
    (re.compile(r"(slice|frame)[ _-]?id"), ""),  # guide points of biv-me number the images by the second
)
_SHORT = {"0": "x", "1": "y", "2": "z", "frame": "slice"}
_MOMENT = re.compile(r"(time[ _-]?)?frame|phase")
_NEAR_ONE = 0.05  # normals written with two digits have lengths as far from 1


def read(path: Path) -> Contents:
    """Points, and normals and weights where the file has them; see `tables.read_table` for how rows may be written.

    Headings name the columns in any order, and those of other names are left out. Without headings the first three
    columns are the coordinates, and the first three others whose lengths are near 1, some of them with a minus sign,
    the normals; a warning says what was left out.
    """
    table = read_table(path)
    return _read_by_headings(path, table) if table.headings else _read_by_place(path, table)


def _read_by_headings(path: Path, table: Table) -> Contents:
    names = [_known_name(name) for name in table.headings]
    known = [name for name in names if name in (*_POSITION, *_NORMAL, _WEIGHT)]
    n_normal = len(set(_NORMAL) & set(known))
    if not set(_POSITION) <= set(known) or n_normal not in (0, 3) or len(set(known)) < len(known):
        raise MeshError(
            f"{path.name}, line {table.line}: a header row must name x, y and z, all of nx, ny, nz or none, and none "
            f"twice; this one has {name_rows((name[:40] for name in table.headings), 8)}. Columns of other "
            "names are left out."
        )
    texts = {name: table.texts(place) for place, name in enumerate(names) if name not in known}
    for name, column in texts.items():
        if _MOMENT.fullmatch(name) and (n := len(set(column))) > 1:
            warn(path, f"the column '{name}' has {n} different values: points of several moments are read as one scan. "
                 "Give each moment a file of its own.")  # fmt: skip
    place = {name: names.index(name) for name in known}
    points = table.numbers([place[name] for name in _POSITION])
    normals = table.numbers([place[name] for name in _NORMAL]) if n_normal else None
    weights = table.numbers([place[_WEIGHT]])[:, 0] if _WEIGHT in place else None
    return Contents(points, None, normals, weights, texts)


def _known_name(heading: str) -> str:
    """`x` for `Points:0`, `x coordinate` and the like; other headings stay."""
    for pattern, before in _ALIASES:
        if found := pattern.fullmatch(heading):
            return before + _SHORT.get(found[1], found[1])
    return heading


def _read_by_place(path: Path, table: Table) -> Contents:
    if table.n_columns < 3:
        raise MeshError(
            f"{path.name}, line {table.line}: {table.n_columns} columns. A point needs at least x, y and z, and "
            "columns in another order a first row of headings: x, y, z, nx, ny, nz, weight."
        )
    points = table.numbers(range(3))
    others = {place: column for place in range(3, table.n_columns) if (column := _numbers(table, place)) is not None}
    if table.delimiter == "," and table.n_columns == 6 and _are_halves(table):
        raise MeshError(
            f"{path.name}: 6 columns of whole numbers, the last three of them no normals: decimal commas, it seems. "
            "Write decimals with a point, or name the columns in a first row."
        )
    for first in others:
        places = range(first, first + 3)
        if others.keys() >= set(places) and _are_normals(np.stack([others[place] for place in places], axis=1)):
            normals = np.stack([others[place] for place in places], axis=1)
            break
    else:
        places, normals = (), None
    if left := [place for place in range(3, table.n_columns) if place not in places]:
        taken = f"columns 1, 2, 3 were read as x, y, z{f', {name_columns(places)} as normals' if places else ''}"
        warn(
            path,
            f"there are no headings: {taken}, and {name_columns(left)} left out. Unnamed columns are normals only "
            "where their lengths are near 1. Name the columns in a first row where these are something else.",
        )
    return Contents(points, None, normals)


def _numbers(table: Table, place: int) -> Float[np.ndarray, "p"] | None:
    try:
        return table.numbers([place])[:, 0]
    except MeshError:  # text without a heading
        return None


def _are_normals(rows: Float[np.ndarray, "p 3"]) -> bool:
    """Whether rows are unit normals, absent ones (zero or NaN) aside; colours are never negative."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(rows, axis=1)
        there = np.isfinite(length) & (length > 0)
        return bool(there.any() and (np.abs(length[there] - 1) < _NEAR_ONE).all() and (rows[there] < 0).any())


def _are_halves(table: Table) -> bool:
    """Whether rows of six whole numbers are three that were cut at their decimal commas: 1,25 read as 1 and 25.

    What follows such a comma has no sign. Few colours and no normals look so in all of the rows.
    """
    whole = all(re.fullmatch("[+-]?[0-9]+", cell.strip()) for row in table.rows for cell in row)
    signed = whole and any(row[place].strip()[0] in "+-" for row in table.rows for place in (1, 3, 5))
    return whole and not signed and any(int(cell.strip()[:9]) > 1 for row in table.rows for cell in row[3:])
