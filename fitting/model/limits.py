"""The range of every number that a user may choose, and the check of all of them, in Python as in the command."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer


class _Limit(NamedTuple):
    """What an option may be: `words` say it, and `advice` what to do."""

    words: str
    least: float
    most: float
    whole: bool = False
    advice: str = ""


# Squares of a deviation, and their reciprocals, are far from the ends of single precision; inf leaves a prior out.
_DEVIATION = _Limit(
    "a standard deviation must be positive",
    1e-9,
    np.inf,
    advice=" Give jnp.inf to leave a prior out, else 1e-9 or more.",
)
_KNOWN_DEVIATION = _Limit("a standard deviation must be positive, from 1e-9 to 1e9", 1e-9, 1e9)
_LENGTH = _Limit("it is a length in mm, from 1e-9 to 1e9", 1e-9, 1e9)
_FACES = _Limit("it is a whole number of faces, from 4 to 10 million", 4, 1e7, whole=True)
_SCALE = _Limit("it is a factor of coordinates, from 1e-9 to 1e9", 1e-9, 1e9)
_LIMITS = {
    "levels": _Limit("a fit needs a topology of one level or more, and of 8 at most", 1, 8, whole=True),
    "surface_level": _Limit("a surface is written at a level from 0, the control mesh, to 8", 0, 8, whole=True),
    "max_sweeps": _Limit("it is a whole number, from 0 to 100,000", 0, 1e5, whole=True),
    "tolerance": _Limit("it is a part of the surface's uncertainty, from 0, for all sweeps, to 1e3", 0, 1e3),
    "tolerance_mm": _LENGTH,
    "surface_tolerance": _LENGTH,
    "edge": _LENGTH,
    "patch_level": _Limit("there is a patch a face of the surface at a level from 0 to 5", 0, 5, whole=True),
    "faces": _FACES,
    "most_faces": _FACES,
    "most_points": _Limit("it is a whole number of points, from 4 on", 4, 2**53, whole=True),
    "at_once": _Limit("it is a whole number of subjects, from 1 on", 1, 2**53, whole=True),
    "rounds": _Limit("it is a whole number of rounds, from 1 to 100", 1, 100, whole=True),
    "draws": _Limit("it is a whole number of shapes, from 2 to 10 million", 2, 1e7, whole=True),
    "n_permutations": _Limit("it is a whole number of divisions, from 1 to 10 million", 1, 1e7, whole=True),
    "landmark_deviation": _KNOWN_DEVIATION,
    "bend": _DEVIATION,
    "stretch": _DEVIATION,
    "h of priors": _DEVIATION,
    "symmetry": _DEVIATION,
    "shift": _DEVIATION,
    "frame_change": _DEVIATION,
    "thickness": _DEVIATION,
    "likeness": _Limit("the likeness is a share, from 0 to 1", 0, 1),
    "c": _Limit("the width of a loss is in units of the noise, from 1e-6 to 1e6", 1e-6, 1e6),
    "alpha": _Limit("the shape of a loss is 2 or less", -np.inf, 2),
    "h": _Limit("a tangent length coefficient is a number from 0 to 100", 0, 100),
    "scale": _SCALE,
    "control_scale": _SCALE,
}


def check_numbers(numbers: Mapping[str, Any], names: Mapping[str, str] | None = None) -> None:
    """See that options lie in their ranges; None counts as not given.

    Args:
        numbers: values by the option's name in Python.
        names: other names for the text, such as those of the command line.

    Raises:
        ValueError: one does not; the text names it, and says what it may be.
    """
    for name, value in numbers.items():
        if value is None or isinstance(value, Tracer):  # whose value is not known yet
            continue
        limit, given = _LIMITS[name], np.asarray(value)
        kinds = "iu" if limit.whole else "iuf"
        if given.dtype.kind not in kinds or given.ndim or not limit.least <= given <= limit.most:
            own = f"`{name.split()[0]}`" if names is None else names[name]
            raise ValueError(f"{own}: {limit.words}; got {value}.{limit.advice}")
