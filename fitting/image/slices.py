"""Slices of an image through the middle of what was fitted, and where a surface cuts them."""

from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .volume import Label, Volume, mask_of

_LETTERS = {"RAS": ("LR", "PA", "IS"), "LPS": ("RL", "AP", "IS")}  # of the negative and the positive end of each axis
_MOST_UP = ("S", "A")  # what is up on a page, most wanted first
_MARGIN = 0.08  # of the surface's size, shown around it
_OTHERS, _OWN = 0.3, 0.75  # grey of other labels, and of the one that was fitted


class Slice(NamedTuple):
    """One slice, as it is drawn: rows down, columns to the right."""

    grey: Float[np.ndarray, "h w"]
    """From 0 to 1."""
    height: float
    """Of a pixel over its width."""
    sides: tuple[str, str, str, str] | None
    """Letters of the frame's directions to the left, the right, the top and the bottom; None without a frame."""
    to_pixels: Float[np.ndarray, "4 4"]
    """Takes positions in mm to column, row, and the distance from the slice in voxels."""

    def cut(self, vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "s 2 2"]:
        """The line segments, from column and row to column and row, along which a surface passes the slice."""
        corners = (vertices @ self.to_pixels[:3, :3].T + self.to_pixels[:3, 3])[triangles]
        above = corners[:, :, 2] > 0
        passing = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
        corners, above = corners[passing], above[passing]
        alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
        rows = np.arange(len(passing))
        a = corners[rows, alone]
        ends = []
        for step in (1, 2):
            b = corners[rows, (alone + step) % 3]
            part = a[:, 2] / (a[:, 2] - b[:, 2])
            ends.append(a[:, :2] + part[:, None] * (b - a)[:, :2])
        return np.stack(ends, axis=1)


def cut_slices(
    volume: Volume, vertices: Float[np.ndarray, "v 3"], *, label: Label | None = None
) -> tuple[Slice, Slice, Slice]:
    """Three slices, one across each axis of the image, through the middle of a surface.

    Args:
        volume: what the surface was fitted to.
        vertices: of the surface, in mm.
        label: the label that was fitted; None shows grey values.
    """
    at = volume.indices(vertices)
    shape = np.array(volume.layers[0].shape)
    margin = _MARGIN * np.ptp(vertices, axis=0).max() / volume.spacing
    low = np.clip(np.floor(at.min(axis=0) - margin), 0, shape - 2).astype(int)
    high = np.clip(np.ceil(at.max(axis=0) + margin) + 1, low + 2, shape).astype(int)
    middle = np.clip(np.round((at.min(axis=0) + at.max(axis=0)) / 2), 0, shape - 1).astype(int)
    part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    grey = _make_grey(volume, label, part)
    return tuple(_slice(volume, grey, low, high, axis, int(middle[axis])) for axis in range(3))  # pyright: ignore


def _make_grey(volume: Volume, label: Label | None, part: tuple[slice, ...]) -> Float[np.ndarray, "i j k"]:
    if label is not None:
        here = volume._replace(layers=tuple(layer[part] for layer in volume.layers))
        others = np.any([layer != 0 for layer in here.layers], axis=0)
        return np.where(mask_of(here, label), _OWN, _OTHERS * others)
    values = np.nan_to_num(volume.layers[0][part].astype(np.float64))
    dark, bright = np.percentile(values, [1, 99])
    return np.clip((values - dark) / max(bright - dark, 1e-12), 0, 1)


def _slice(
    volume: Volume, grey: Float[np.ndarray, "i j k"], low: np.ndarray, high: np.ndarray, axis: int, number: int
) -> Slice:
    ends = _ends(volume)
    first, second = (other for other in range(3) if other != axis)
    rows, columns = (first, second) if _upness(ends[first]) < _upness(ends[second]) else (second, first)
    values = np.moveaxis(grey.take(number - low[axis], axis=axis), 0, 0 if rows < columns else 1)
    # What points up on a page goes up, and the right side of the body is on the left, as radiologists look.
    flips = {rows: ends[rows][1] in _MOST_UP, columns: ends[columns][1] in ("R", "A")}
    values = values[:: -1 if flips[rows] else 1, :: -1 if flips[columns] else 1]
    to_pixels = np.linalg.inv(volume.affine)[[columns, rows, axis, 3]]
    to_pixels[2, 3] -= number + 1e-6  # no vertex lies in the slice itself
    for row, other in ((0, columns), (1, rows)):
        if flips[other]:
            to_pixels[row] *= -1
            to_pixels[row, 3] += high[other] - 1
        else:
            to_pixels[row, 3] -= low[other]
    letters = [ends[other][:: -1 if flips[other] else 1] for other in (columns, rows)]
    sides = None if volume.frame is None else (letters[0][0], letters[0][1], letters[1][0], letters[1][1])
    return Slice(values, float(volume.spacing[rows] / volume.spacing[columns]), sides, to_pixels)


def _ends(volume: Volume) -> list[str]:
    """For each index the letters of its two ends."""
    axes = volume.affine[:3, :3] / volume.spacing
    # Each has a direction of its own, however oblique.
    order = max(permutations(range(3)), key=lambda order: np.abs(axes[list(order), [0, 1, 2]]).sum())
    ends = []
    for axis, nearest in enumerate(order):
        letters = _LETTERS[volume.frame or "RAS"][nearest]
        ends.append(letters if axes[nearest, axis] > 0 else letters[::-1])
    return ends


def _upness(ends: str) -> int:
    """How early among what is up on a page an axis comes."""
    return next((i for i, letter in enumerate(_MOST_UP) if letter in ends), len(_MOST_UP))
