"""Regions: which of a few named parts each face of a mesh, or each point of a scan, belongs to."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Int


def _check_whole(value: object) -> Int[np.ndarray, "n"]:
    rows = np.asarray(value)
    if rows.ndim != 1 or rows.dtype.kind not in "iu":
        raise ValueError(
            f"regions must be one whole number a row, -1 where it lies in none; got {rows.dtype} of the shape "
            f"{list(rows.shape)}."
        )
    # Larger ones, which a cast would wrap, name no region either way.
    return np.clip(rows, -2, np.iinfo(np.int32).max).astype(np.int32)


def _words(value: object) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(str(name) for name in value)  # pyright: ignore[reportGeneralTypeIssues]


class Regions(eqx.Module):
    """The region of each of some faces or points, by name.

    Attributes:
        rows: the place in `names` of the region of each; -1 where it lies in none.
        names: of the regions.

    Raises:
        ValueError: a row names a region that there is not; a name is empty, or given twice.
    """

    rows: Int[np.ndarray, "n"] = eqx.field(converter=_check_whole)
    names: tuple[str, ...] = eqx.field(converter=_words, static=True)

    def __check_init__(self) -> None:
        wrong = np.flatnonzero((self.rows < -1) | (self.rows >= len(self.names)))
        if len(wrong):
            raise ValueError(
                f"row {wrong[0]} has the region {self.rows[wrong[0]]} of {len(self.names)} names, counted from zero; "
                "-1 is none."
            )
        twice = next((name for i, name in enumerate(self.names) if not name or name in self.names[:i]), None)
        if twice is not None:
            raise ValueError(f"the name '{twice}' of a region is empty or given twice. Each region needs its own.")

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, chosen: np.ndarray) -> "Regions":
        """Those of some rows, by number or by truth."""
        return Regions(self.rows[chosen], self.names)

    def words(self) -> list[str]:
        """The name of the region of each row, empty where it lies in none."""
        return [self.names[row] if row >= 0 else "" for row in self.rows]

    def counts(self) -> Int[np.ndarray, "k"]:
        """How many rows lie in each region."""
        return np.bincount(self.rows[self.rows >= 0], minlength=len(self.names))


def as_regions(value: Any) -> Regions | None:
    """Regions as they are, or from a name a row, where an empty one is none."""
    if value is None or isinstance(value, Regions):
        return value
    if isinstance(value, str) or not all(isinstance(word, str) for word in value):
        raise ValueError("regions are a name each, as text, or `jaxsubdiv.Regions` of whole numbers and their names.")
    names = sorted({str(word) for word in value} - {""})
    place = {name: i for i, name in enumerate(names)} | {"": -1}
    return Regions(np.array([place[str(word)] for word in value], int), tuple(names))
