"""Voxels and where they lie; the labels that they name."""

from collections import Counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from jaxsubdiv.frames import Frame

from ..scan.scan import ScanError

_MOST_LABELS = 4096  # more whole numbers than these are grey values
_MOST_VALUE = 2**53  # of floats, larger ones are no whole numbers
_PART = 1 << 18  # voxels that are counted at a time
_GREY = "so it is an image and no label map: give --above VALUE (`above=`), which is the grey value of the surface."


class Label(NamedTuple):
    """A structure that a label map shows."""

    value: int
    """Of its voxels."""
    name: str
    """As the file names it; empty where it does not."""
    layer: int = 0
    """Of the volume's layers: those of structures that overlap differ."""

    def __str__(self) -> str:
        return f"{self.value} {self.name}".rstrip()


class Volume(NamedTuple):
    """An image or a label map."""

    layers: tuple[Shaped[np.ndarray, "i j k"], ...]
    """Values of the voxels; more than one array only where labels overlap."""
    affine: Float[np.ndarray, "4 4"]
    """Takes the index of a voxel to the position of its middle, in mm."""
    frame: Frame | None
    """What the axes of the positions are: x to the right, y to the front, z up, or x to the left, y to the back, z up.
    None where the file does not say."""
    labels: tuple[Label, ...] = ()
    """Those that the file names."""

    @property
    def spacing(self) -> Float[np.ndarray, "3"]:
        """From voxel to voxel along each index, in mm."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    @property
    def voxel_volume(self) -> float:
        """In mm^3."""
        return float(abs(np.linalg.det(self.affine[:3, :3])))

    def positions(self, index: Float[np.ndarray, "*p 3"]) -> Float[np.ndarray, "*p 3"]:
        """Where places between voxels lie, in mm."""
        return index @ self.affine[:3, :3].T + self.affine[:3, 3]

    def indices(self, points: Float[np.ndarray, "*p 3"]) -> Float[np.ndarray, "*p 3"]:
        """Where positions in mm lie among the voxels."""
        return (points - self.affine[:3, 3]) @ np.linalg.inv(self.affine[:3, :3]).T

    def pad(self, before: tuple[int, int, int], after: tuple[int, int, int]) -> "Volume":
        """The same with so many voxels of background along each index before and after it."""
        affine = self.affine.copy()
        affine[:3, 3] = self.positions(-np.array(before, float))
        widths = tuple(zip(before, after, strict=True))
        return self._replace(layers=tuple(np.pad(layer, widths) for layer in self.layers), affine=affine)

    def rescale(self, scale: float) -> "Volume":
        """The same with positions in another unit."""
        affine = self.affine.copy()
        affine[:3] *= scale
        return self._replace(affine=affine)


class Found(NamedTuple):
    """A label that has voxels."""

    label: Label
    voxels: int

    def describe(self, volume: Volume) -> str:
        """`3 tibia (12.5 ml)`."""
        return f"{self.label} ({self.voxels * volume.voxel_volume / 1000:.3g} ml)"


def find_labels(volume: Volume) -> list[Found]:
    """The labels that have voxels, in the order of layers and values; 0 is the background.

    Raises:
        ScanError: the values are no labels, or there is nothing but background.
    """
    names = {(label.layer, label.value): label for label in volume.labels}
    found = []
    for layer, values in enumerate(volume.layers):
        for value, count in _count(values).items():
            if value:
                label = names.get((layer, value), Label(value, "", layer))
                found.append(Found(label, count))
    if not found:
        raise ScanError("it has no label: all of its voxels are 0.")
    return found


def choose_label(volume: Volume, wanted: str | int | None) -> Label:
    """The label of a value or a name, in capitals or not; None is the only one.

    Raises:
        ScanError: there is no such label, or there are several; the text lists them with their volumes.
    """
    found = find_labels(volume)
    there = ", ".join(one.describe(volume) for one in found)
    if wanted is None:
        if len(found) > 1:
            raise ScanError(f"it has {len(found)} labels; choose one by --label (`label=`), or all: {there}.")
        return found[0].label
    word = str(wanted).strip().casefold()
    named = [one.label for one in found if word in (str(one.label.value), one.label.name.casefold())]
    if not named:
        raise ScanError(f"no voxel has the label '{wanted}'. It has: {there}.")
    if len(named) > 1:
        raise ScanError(
            f"several labels are called '{wanted}': {', '.join(map(str, named))}. Give another of its names."
        )
    return named[0]


def mask_of(volume: Volume, label: Label) -> Shaped[np.ndarray, "i j k"]:
    """Which voxels have a label."""
    return volume.layers[label.layer] == label.value


def _count(values: Shaped[np.ndarray, "i j k"]) -> dict[int, int]:
    """How many voxels have each value, in the order of the values; part by part, for large volumes."""
    flat = values.ravel(order="K")
    parts = [flat[i : i + _PART] for i in range(0, len(flat), _PART)]
    low, high = (flat.min(), flat.max()) if parts else (0, 0)
    if values.dtype.kind == "f" and not (
        np.isfinite(low) and np.isfinite(high) and all(np.array_equal(part, np.round(part)) for part in parts)
    ):
        raise ScanError(f"its voxels are no whole numbers, {_GREY}")
    counts: Counter[int] = Counter()
    for part in parts if 0 <= low and high < _MOST_VALUE else ():
        if high < _PART:
            numbers = np.bincount(part.astype(np.intp))
            there = np.flatnonzero(numbers)
            numbers = numbers[there]
        else:
            there, numbers = np.unique(part, return_counts=True)
        counts.update(dict(zip(map(int, there), map(int, numbers), strict=True)))
        if len(counts) > _MOST_LABELS:
            break
    if not 0 < len(counts) <= _MOST_LABELS:
        raise ScanError(f"its voxels go from {low:g} to {high:g}, {_GREY}")
    return dict(sorted(counts.items()))
