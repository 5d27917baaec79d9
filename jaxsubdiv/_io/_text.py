"""Numbers in text: rows of any length, read in bulk, with the line of every row kept for the error texts."""

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float, Int, UInt8

from ..errors import MeshError


class Rows(NamedTuple):
    """Rows of numbers: row `r` is `values[starts[r] : starts[r] + counts[r]]` and stands on line `lines[r]`."""

    values: Float[np.ndarray, "n"]
    starts: Int[np.ndarray, "r"]
    counts: Int[np.ndarray, "r"]
    lines: Int[np.ndarray, "r"]

    def part(self, first: int, last: int) -> "Rows":
        """Rows `first` to `last`, the last not included."""
        return Rows(self.values, self.starts[first:last], self.counts[first:last], self.lines[first:last])

    def table(self, n_columns: int) -> Float[np.ndarray, "r c"]:
        """The first columns of every row; each row must have as many."""
        return self.values[self.starts[:, None] + np.arange(n_columns)]


def parse_rows(path: Path, text: str, lines: Int[np.ndarray, "l"] | int = 1) -> Rows:
    """Numbers between white space, one row a line; blank lines give no row.

    Args:
        path: names the file in error texts.
        text: the numbers.
        lines: line of the file on which each line of `text` stands, or that of the first one.

    Raises:
        MeshError: something is not a number; the text names its line.
    """
    if not text.strip():
        none = np.zeros(0, int)
        return Rows(np.zeros(0), none, none, none)
    raw = np.frombuffer(text.encode(), np.uint8)
    starts = token_starts(raw)
    counts = tokens_per_line(raw, starts)
    if isinstance(lines, int):
        lines = np.arange(lines, lines + len(counts))
    values = parse_numbers(text)
    if len(values) != len(starts):
        _raise_bad_number(path, text, lines)
    filled = counts > 0
    return Rows(values, (np.cumsum(counts) - counts)[filled], counts[filled], lines[filled])


def token_starts(raw: UInt8[np.ndarray, "b"]) -> Int[np.ndarray, "n"]:
    """Where each run of bytes that are not white space begins."""
    blank = (raw == ord(" ")) | ((raw >= ord("\t")) & (raw <= ord("\r")))
    blank[1:] |= ~blank[:-1]  # what follows a byte of a run does not begin one
    return np.flatnonzero(~blank)


def tokens_per_line(raw: UInt8[np.ndarray, "b"], starts: Int[np.ndarray, "n"]) -> Int[np.ndarray, "l"]:
    """How many of the runs that begin at `starts` each line has."""
    line_ends = np.append(np.flatnonzero(raw == ord("\n")), len(raw))
    return np.diff(np.searchsorted(starts, line_ends), prepend=0)


def number_lines(rows: Float[np.ndarray, "r c"], prefix: str = "") -> str:
    """One line a row, in the shortest digits that read back as the same float64."""
    return "".join(f"{prefix}{' '.join(map(repr, row))}\n" for row in rows.tolist())


def face_lines(faces: Iterable[Int[np.ndarray, "_ _"]], prefix: str = "") -> str:
    """One line a face; a prefix with `{}` receives the number of corners."""
    return "".join(
        f"{prefix.format(len(face))}{' '.join(map(str, face))}\n" for block in faces for face in block.tolist()
    )


def parse_numbers(text: str) -> Float[np.ndarray, "n"]:
    """All numbers up to the first thing that is none; three times as fast as `split` and `float`."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy's way to say that it stopped early
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            return np.zeros(0)


def _raise_bad_number(path: Path, text: str, lines: Int[np.ndarray, "l"]) -> NoReturn:
    for line, row in zip(lines, text.split("\n"), strict=False):
        tokens = [token.decode() for token in row.encode().split()]  # of bytes: by ASCII white space, as above
        bad = (
            [token for token in tokens if len(parse_numbers(token)) != 1]
            if len(parse_numbers(row)) != len(tokens)
            else []
        )
        if bad:
            raise MeshError(f"{path.name}, line {line}: {bad[0][:40]!r} is not a number.")
    raise MeshError(f"{path.name}: the numbers cannot be read. Write them in plain digits, such as -1.5e-3.")
