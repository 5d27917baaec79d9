"""A wall that beats: half an ellipsoid around a cavity, open at a valve, whose volumes and contours are known."""

from typing import NamedTuple

import numpy as np

import fitting
import jaxsubdiv as js

GROUPS = ("ENDO", "EPI", "MITRAL_VALVE")
AROUND, UP = 8, 3  # control faces around the axis, and from the apex to the base
HEIGHTS = (-32.0, -24.0, -16.0, -8.0)  # of the slices across the axis, in mm
SHIFTS = np.array([[1.5, 0.5, 0], [-1.0, 0.8, 0], [0.4, -1.6, 0], [-0.9, 0.3, 0], [0, 0, 0], [0, 0, 0]])


class Shape(NamedTuple):
    """Half-axes of lining and outside, and the height of the base; in mm."""

    inner: np.ndarray
    outer: np.ndarray
    base: float

    @property
    def volumes(self) -> tuple[float, float]:
        """Of the cavity and of the wall, in ml."""
        inside, whole = (2 / 3 * np.pi * a**2 * c / 1000 for a, c in (self.inner, self.outer))
        return inside, whole - inside


def shape(phase: float) -> Shape:
    """Of a beat from 0 to 1."""
    squeeze = 0.5 * (1 - np.cos(2 * np.pi * phase))
    inner = np.array([22 - 6 * squeeze, 44 - 6 * squeeze])
    return Shape(inner, inner + np.array([9 + 2 * squeeze, 8 + 1 * squeeze]), -4 * squeeze)


def mesh(of: Shape) -> js.ControlMesh:
    """A control mesh of lining, outside and the rim between."""
    turns = 2 * np.pi * np.arange(AROUND) / AROUND
    vertices, faces, regions = [], {3: [], 4: []}, {3: [], 4: []}
    for layer, (a, c) in enumerate((of.inner, of.outer)):
        first = len(vertices)
        vertices.append((0, 0, of.base - c))
        for angle in np.pi / 2 * np.arange(1, UP + 1) / UP:
            vertices += [
                (a * np.sin(angle) * np.cos(t), a * np.sin(angle) * np.sin(t), of.base - c * np.cos(angle))
                for t in turns
            ]
        for i in range(AROUND):
            j, ring = (i + 1) % AROUND, first + 1
            # The outside is wound outwards, the lining towards the cavity.
            faces[3].append((first, ring + j, ring + i)[:: -1 if layer == 0 else 1])
            regions[3].append(GROUPS[layer])
            for k in range(UP - 1):
                low, high = ring + k * AROUND, ring + (k + 1) * AROUND
                faces[4].append((low + i, low + j, high + j, high + i)[:: -1 if layer == 0 else 1])
                regions[4].append(GROUPS[layer])
    size, ring = len(vertices) // 2, 1 + (UP - 1) * AROUND
    for i in range(AROUND):
        j = (i + 1) % AROUND
        faces[4].append((ring + i, size + ring + i, size + ring + j, ring + j))
        regions[4].append("MITRAL_VALVE")
    return js.ControlMesh(vertices, {k: np.array(rows) for k, rows in faces.items()}, regions=regions[3] + regions[4])


def scan(of: Shape, rng: np.random.Generator, noise: float = 0.2, n: int = 20) -> fitting.Scan:
    """Contours in slices, displaced by `SHIFTS` (what a fit has to find is the opposite), and marks on the valve."""
    points, labels, slices = [], [], []

    def add(rows: list, label: str, number: int) -> None:
        rows = np.array(rows)
        points.append(rows + rng.normal(scale=noise, size=rows.shape) + SHIFTS[number])
        labels.extend([label] * len(rows))
        slices.extend([number] * len(rows))

    turns = 2 * np.pi * np.arange(n) / n
    for (a, c), label in zip((of.inner, of.outer), GROUPS[:2], strict=True):
        for number, height in enumerate(HEIGHTS):
            along = (height - of.base) / c
            if -1 < along < 0:
                r = a * np.sqrt(1 - along**2)
                add([(r * np.cos(t), r * np.sin(t), height) for t in turns], label, number)
        arcs = np.linspace(-np.pi / 2, np.pi / 2, n)
        add([(a * np.sin(t), 0, of.base - c * np.cos(t)) for t in arcs], label, 4)
        add([(0, a * np.sin(t), of.base - c * np.cos(t)) for t in arcs], label, 5)
    a = of.inner[0]
    add([(a, 0, of.base), (-a, 0, of.base)], "MITRAL_VALVE", 4)
    add([(0, a, of.base), (0, -a, of.base)], "MITRAL_VALVE", 5)
    return fitting.Scan(np.concatenate(points), slices=np.array(slices), regions=labels)


def series(n: int, *, noise: float = 0.2, seed: int = 0) -> tuple[list[Shape], list[fitting.Scan], js.ControlMesh]:
    """The shapes and scans of a beat in so many frames, and a template that is none of them."""
    rng = np.random.default_rng(seed)
    shapes = [shape(k / n) for k in range(n)]
    template = mesh(Shape(np.array([19.0, 40.0]), np.array([29.0, 48.0]), -1.0))
    return shapes, [scan(one, rng, noise) for one in shapes], template
