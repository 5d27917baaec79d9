"""Frames of medical images: which way x, y and z point in a person."""

from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float

Frame: TypeAlias = Literal["RAS", "LPS"]

AXES: dict[str, str] = {"RAS": "right, anterior, superior", "LPS": "left, posterior, superior"}
"""Where x, y and z point to: RAS is that of NIfTI and FreeSurfer, LPS that of DICOM, ITK and the files of 3D Slicer."""


def convert_frame(positions: Float[np.ndarray, "*n 3"], own: Frame, wanted: Frame) -> Float[np.ndarray, "*n 3"]:
    """Positions of one frame in the other: x and y change their signs, or nothing does."""
    return positions if own == wanted else positions * np.array([-1.0, -1.0, 1.0])
