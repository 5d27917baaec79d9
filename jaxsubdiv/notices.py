"""Warnings that point at the line of the user's own code that led to them, however many calls away it is."""

import sys
import warnings

# What stands between: this software, and libraries that call it back.
_BETWEEN = {"jaxsubdiv", "fitting", "jax", "jaxlib", "equinox", "jaxtyping", "beartype", "optimistix", "lineax"}
_BETWEEN |= {"contextlib", "functools"}


def warn(text: str) -> None:
    """Warn, at the nearest line that is neither of this software nor of a library that it is called back by."""
    frame, level = sys._getframe(), 1  # a `stacklevel` of 1 is this line
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _BETWEEN:
        frame, level = frame.f_back, level + 1
    warnings.warn(text, stacklevel=level)
