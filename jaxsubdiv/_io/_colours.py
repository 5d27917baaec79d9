"""Colours of numbers, for formats that viewers show without asking: evenly perceived ones, in few support points."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Of values below and above 0: K. Moreland, Diverging color maps for scientific visualization, 2009 (cool to warm).
_DIVERGING = np.array([(59, 76, 192), (141, 176, 254), (221, 221, 221), (244, 154, 123), (180, 4, 38)]) / 255
# Of all others: viridis, by S. van der Walt and N. Smith, in the public domain (CC0).
_RISING = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)]) / 255
_UNKNOWN = 0.5  # grey
_PERCENT = 2.0  # of the values at either end share its colour, so that a few far ones do not bleach the others


class Colours(NamedTuple):
    """Colours of values, and which values have the first and the last one."""

    srgb: Float[np.ndarray, "v 3"]
    """From 0 to 1."""
    first: float
    last: float


def colours_of(values: Float[np.ndarray, "v"]) -> Colours:
    """Blue, white and red about 0 where there are values on both sides of it, else dark to bright; grey where a value
    is not finite."""
    known = values[np.isfinite(values)]
    if not len(known):
        return Colours(np.full((len(values), 3), _UNKNOWN), 0.0, 0.0)
    first, last = np.percentile(known, (_PERCENT, 100 - _PERCENT))
    both = known.min() < 0 < known.max()
    if both:
        last = max(-first, last, np.finfo(float).tiny)
        first = -last
    table = _DIVERGING if both else _RISING
    share = np.clip((values - first) / max(last - first, np.finfo(float).tiny), 0, 1)
    places = np.linspace(0, 1, len(table))
    srgb = np.stack([np.interp(share, places, channel) for channel in table.T], axis=1)
    return Colours(np.where(np.isfinite(values)[:, None], srgb, _UNKNOWN), float(first), float(last))


def to_linear(srgb: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """Light in place of what screens are sent (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
