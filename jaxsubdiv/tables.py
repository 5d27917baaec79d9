"""Tables of text: records that Python's `csv` parses, with or without a row of headings."""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .errors import MeshError, name_rows

_DELIMITERS = (";", "\t", ",", " ")  # a blank stands for any white space
_HEADING = 2_000  # characters of a heading at most
_SAMPLE, _BEGIN = 20, 1 << 20  # records from which the delimiter is found, and characters that may hold them
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?(inf|infinity|nan)", re.ASCII | re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_MISSING = {"", "-", "na", "n/a", "null", "none", "-nan(ind)", "nan(ind)", "1.#qnan", "-1.#ind", "1.#inf", "-1.#inf"}
_UNIT = re.compile(r"[(\[][^)\]]*[)\]]")
_COMMENTS = ("#", "//")
_NOT_PLAIN = set('"#/_')  # what quotes, begins comments, or is a number to Python alone
_POINT = "Write decimals with a point."


@dataclass(frozen=True)
class Table:
    """The records of a file, all with as many cells."""

    name: str
    """Of the file, for error texts."""
    headings: list[str]
    """Without units, in small letters; none where the file has no row of headings."""
    line: int
    """Where the headings stand, or the first record."""
    delimiter: str
    n_columns: int
    """Cells of every row."""
    _plain: Float[np.ndarray, "r c"] | None
    """All cells, where each is a plain number: then they are parsed to texts only where somebody asks for these."""
    _parse: Callable[[], list[tuple[int, list[str]]]]

    @cached_property
    def _records(self) -> list[tuple[int, list[str]]]:
        return self._parse()

    @property
    def n_rows(self) -> int:
        """Records beside the headings."""
        return len(self._records) if self._plain is None else len(self._plain)

    @cached_property
    def rows(self) -> list[list[str]]:
        """The cells of every record."""
        return [cells for _, cells in self._records]

    @cached_property
    def lines(self) -> list[int]:
        """The line of the file on which each row begins."""
        return [line for line, _ in self._records]

    def texts(self, place: int) -> list[str]:
        """One column, without the white space around its cells."""
        return [row[place].strip() for row in self.rows]

    def numbers(self, places: Sequence[int]) -> Float[np.ndarray, "r c"]:
        """Columns of numbers; a cell that is empty, or says that there is none, is NaN.

        Raises:
            MeshError: a cell is no number; the text names the line.
        """
        if self._plain is not None:
            return np.take(self._plain, places, axis=1)
        columns = [self._column(place) for place in places]
        return np.stack(columns, axis=1) if columns else np.zeros((self.n_rows, 0))

    def _column(self, place: int) -> Float[np.ndarray, "r"]:
        cells = [row[place] for row in self.rows]
        text = "".join(cells)
        try:
            if text.isascii() and "_" not in text:  # Python takes digits of any script, and its own way of thousands
                return np.fromiter(map(float, cells), np.float64, len(cells))
        except ValueError:
            pass
        if self.delimiter != "," and "," in text and "." in text:
            line = next(line for cell, line in zip(cells, self.lines, strict=True) if "," in cell)
            raise MeshError(
                f"{self.name}, line {line}: the column has both commas and points. {_POINT} Leave out what parts "
                "thousands."
            )
        return np.array([self._number(cell, line) for cell, line in zip(cells, self.lines, strict=True)], np.float64)

    def _number(self, cell: str, line: int) -> float:
        cell = cell.strip()
        if _NUMBER.fullmatch(cell):
            return float(cell)
        if cell.lower() in _MISSING:
            return np.nan
        if self.delimiter != "," and _DECIMAL_COMMA.fullmatch(cell):
            return float(cell.replace(",", "."))
        raise MeshError(f"{self.name}, line {line}: '{cell[:40]}' is not a number. {_POINT}")


def decode(data: bytes) -> str:
    """Text with any line ends; bytes that are not UTF-8 become replacement characters, since only names have any."""
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"  # spreadsheets write both
    text = data.decode(encoding, errors="replace").removeprefix("\ufeff")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def read_table(path: Path) -> Table:
    """The table of a file of text.

    Semicolons, tabs, commas or white space part the cells; which of them, the first records tell. A cell in quotes may
    hold any of these, line ends and `#`. What follows a `#` is a comment, unless it stands right after a comma or a
    semicolon, and so are lines that begin with `//` or `;`. Decimals may be written with a comma where it does not part
    the cells. A first row of one whole number is the count of the others. The first row holds headings where fewer than
    three of its cells are numbers; a comment right before the numbers holds them where it names x, y and z.

    Raises:
        MeshError: the file holds no such table; the text names it and the line.
    """
    text = decode(path.read_bytes())
    delimiter = _find_delimiter(path, text[:_BEGIN])
    begin = list(islice(_records(path, text, delimiter), 3))  # a count, headings and a row
    count = _leading_count(begin)
    body = begin[count is not None :]
    if not body:
        raise MeshError(f"{path.name}: it has no line of numbers.")
    line, first = body[0]
    headings = [] if _n_numbers(first, delimiter) >= min(3, len(first)) else _headings(first)
    n_before = (count is not None) + bool(headings)
    body = begin[n_before:]
    if not headings:
        headings = _commented_headings(text, line, delimiter, len(first))
    if headings and body and delimiter == " " and len(headings) != len(body[0][1]):
        headings = _headings(_UNIT.sub("", " ".join(first)[:_HEADING]).split())
    n_columns = len(headings or first)

    def parse() -> list[tuple[int, list[str]]]:
        records = list(islice(_records(path, text, delimiter), n_before, None))
        _even_columns(path, records, n_columns, delimiter)
        return records

    plain = _plain_numbers(text.split("\n", body[0][0] - 1)[-1], delimiter, n_columns) if body else None
    table = Table(path.name, headings, line, delimiter, n_columns, plain, parse)
    if count not in (None, table.n_rows):
        raise MeshError(
            f"{path.name}: the first row announces {count} rows, but {table.n_rows} follow. The file is cut off, or "
            "the count is wrong: correct or delete it."
        )
    return table


def _plain_numbers(text: str, delimiter: str, n_columns: int) -> Float[np.ndarray, "r c"] | None:
    """Rows of nothing but plain numbers, ten times as fast as by records; None where anything else is in the text."""
    if not text.isascii() or any(mark in text for mark in _NOT_PLAIN):
        return None
    try:
        values = np.loadtxt(
            StringIO(text), delimiter=None if delimiter == " " else delimiter, comments=None, ndmin=2, dtype=np.float64
        )
    except ValueError:  # who reads the records finds out what is wrong, and on which line
        return None
    return values if values.shape[1] == n_columns else None


def _records(path: Path, text: str, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Records that hold something, each with the line on which it begins."""
    inside = False  # a record: then the line goes on with a cell in quotes, and holds no comment

    def lines() -> Iterator[str]:
        nonlocal inside
        for line in text.split("\n"):
            goes_on, inside = inside, True  # until the record ends, and the loop below says so
            yield (line if goes_on else _cut_comment(line, delimiter)) + "\n"

    # Most files have neither comments nor quotes, and go through the parser as they are, which is twice as fast.
    plain = not any(mark in text for mark in ('"', "#", "//", *(";" if delimiter != ";" else ("\n;", "; "))))
    given = StringIO(text.replace("\t", " ") if delimiter == " " else text) if plain else lines()
    parser = csv.reader(given, delimiter=delimiter, skipinitialspace=True, strict=True)
    begin = 1
    try:
        for cells in parser:
            if delimiter == " " and cells and not cells[-1]:
                cells.pop()  # of white space at the end
            if len(cells) > 1 or any(cells):  # where delimiters stand alone, a row has no numbers
                yield begin, cells
            inside, begin = False, parser.line_num + 1
    except csv.Error as error:
        raise MeshError(
            f"{path.name}, line {begin}: the row cannot be parsed ({error}). Close its quotes, and put nothing between "
            "them and the next column."
        ) from None


def _cut_comment(line: str, delimiter: str) -> str:
    begin = line.lstrip()
    # With semicolons an empty first cell begins a line as such a comment does.
    if begin.startswith(_COMMENTS) or (begin[:1] == ";" and (delimiter != ";" or begin[1:2].isspace())):
        return ""
    if "#" in line:
        at, before, n_quotes = -1, 0, 0
        while (at := line.find("#", at + 1)) >= 0:
            n_quotes, before = n_quotes + line.count('"', before, at), at
            if n_quotes % 2 == 0 and line[at - 1] not in ",;":
                line = line[:at]
                break
    return line.replace("\t", " ") if delimiter == " " else line


def _find_delimiter(path: Path, text: str) -> str:
    """The first of the delimiters that parts the first records alike, with three numbers in each."""
    for delimiter in _DELIMITERS:
        try:
            records = list(islice(_records(path, text, delimiter), _SAMPLE))
        except MeshError:
            continue
        body = records[_leading_count(records) is not None :]
        if body and _n_numbers(body[0][1], delimiter) < 3:
            heading = _UNIT.sub("", " ".join(body[0][1])[:_HEADING]).split() if delimiter == " " else body[0][1]
            body = [(0, heading), *body[1:]] if len(body) > 1 and len(body[1][1]) != len(body[0][1]) else body
        if len({len(cells) for _, cells in body}) == 1 and _n_numbers(body[-1][1], delimiter) >= 3:
            return delimiter
    # None does: the one that stands in the first row shows best what is wrong with the others.
    first = next((line for line in text.split("\n") if _cut_comment(line, " ").strip()), "")
    return next((delimiter for delimiter in _DELIMITERS if delimiter in first.strip()), " ")


def _leading_count(records: list[tuple[int, list[str]]]) -> int | None:
    if len(records) < 2 or len(records[1][1]) < 3:
        return None
    cells = [cell.strip() for cell in records[0][1] if cell.strip()]
    return int(cells[0]) if len(cells) == 1 and re.fullmatch("[0-9]{1,18}", cells[0]) else None


def _n_numbers(cells: list[str], delimiter: str) -> int:
    return sum(bool(_NUMBER.fullmatch(cell) or (delimiter != "," and _DECIMAL_COMMA.fullmatch(cell))) for cell in cells)


def _headings(cells: list[str]) -> list[str]:
    return [_UNIT.sub("", cell[:_HEADING]).strip().lower() or cell.strip().lower() for cell in cells]


def _commented_headings(text: str, line: int, delimiter: str, n_columns: int) -> list[str]:
    """Headings in the comment right before the first record, where it names x, y and z and all other columns."""
    before = text.split("\n", line)[line - 2] if line > 1 else ""
    words = before[:_HEADING].strip().lstrip("#/; \t")
    words = words.replace("\t", " ") if delimiter == " " else words
    cells = _headings(next(csv.reader([words], delimiter=delimiter, skipinitialspace=True), []))
    return cells if len(cells) == n_columns and {"x", "y", "z"} <= set(cells) else []


def _even_columns(path: Path, records: list[tuple[int, list[str]]], n_columns: int, delimiter: str) -> None:
    """Leave out empty cells past the last column; raise where a row has more or fewer than the first."""
    for line, cells in records:
        while len(cells) > n_columns and not cells[-1]:
            cells.pop()  # of a delimiter at the end of the line
        if len(cells) != n_columns:
            halves = f" {_POINT}" if delimiter == "," and len(cells) == 2 * n_columns else ""
            raise MeshError(
                f"{path.name}, line {line}: {len(cells)} columns, where the first row has {n_columns}.{halves}"
            )


def name_columns(places: Sequence[int]) -> str:
    """`column 4` or `columns 4, 5, 6`, counted from one."""
    return f"column{'s' * (len(places) > 1)} {name_rows((place + 1 for place in places), 8)}"
