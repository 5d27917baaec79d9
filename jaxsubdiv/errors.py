"""The one error that a mesh or a mesh file can raise, how it names rows, and the check of a file's unit."""

import math
from collections.abc import Iterable


class MeshError(ValueError):
    """A mesh or a mesh file cannot be used as it is.

    The text names what is wrong, where (faces, rows, file and line), and what to do.
    """


def name_rows(rows: Iterable[object], most: int = 5) -> str:
    """`12, 40 (+3 more)`: the first rows in full, the rest as a count.

    Args:
        rows: what to name, in the order in which to name it.
        most: how many are named before the rest is counted.
    """
    rows = list(rows)
    named = ", ".join(str(row) for row in rows[:most])
    return named if len(rows) <= most else f"{named} (+{len(rows) - most} more)"


def check_scale(scale: float | int) -> None:
    """Raise a ValueError for a factor of coordinates that takes them nowhere."""
    if not (math.isfinite(scale) and scale > 0):
        raise ValueError(f"`scale` must be positive and finite; got {scale}. 1000 turns metres into mm.")
