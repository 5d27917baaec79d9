"""Frames of a series side by side: many scans, and as many copies of one control mesh, as one scan and one mesh.

The frames are placed far apart, so that what looks for neighbours, such as the search of closest points, finds those of
the own frame. Nothing else depends on where a frame lies.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import jaxsubdiv as js
from jaxsubdiv.closest import AnyArray
from jaxsubdiv.frames import Frame

from .scan import Scan, ScanError

_APART = 2.0  # of the size of all scans together


class Frames(NamedTuple):
    """How the frames of a series stand in one scan."""

    offsets: Float[np.ndarray, "f 3"]
    """Where each was placed, in mm."""
    counts: Int[np.ndarray, "f"]
    """Points of each, which follow each other."""
    periodic: bool
    """Whether the first frame follows the last."""

    @property
    def of_points(self) -> Int[np.ndarray, "p"]:
        """The frame of every point."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @property
    def pairs(self) -> Int[np.ndarray, "m 2"]:
        """Frames that follow each other."""
        n = len(self.counts)
        first = np.arange(n if self.periodic and n > 2 else n - 1)
        return np.stack([first, (first + 1) % n], axis=1)

    def rows_of(self, frame: int) -> slice:
        """The points of a frame."""
        end = int(self.counts[: frame + 1].sum())
        return slice(end - int(self.counts[frame]), end)

    def place_back(self, scan: Scan) -> Scan:
        """The points of all frames where they were measured, with their weights and slices."""
        back = jnp.asarray(self.offsets[self.of_points], scan.points.dtype)
        return Scan(scan.points - back, weights=scan.weights, slices=scan.slices)

    def copy_rows(self, rows: AnyArray) -> AnyArray:
        """Positions `[v, 3]` once for every frame, placed there."""
        dtype = rows.dtype
        return (rows[None] + self.offsets[:, None].astype(dtype)).reshape(-1, 3)


def place_frames(scans: Sequence[Scan], periodic: bool) -> tuple[Scan, Frames]:
    """One scan of the scans of all frames, and where each was placed.

    Raises:
        ScanError: some have normals, weights, slices or labels and others have none; the text names the frame.
    """
    points = [np.asarray(scan.points) for scan in scans]
    size = float(np.linalg.norm(np.ptp(np.concatenate(points), axis=0)))
    n = len(scans)
    side = int(np.ceil(round(n ** (1 / 3), 9)))
    places = np.stack([np.arange(n) % side, np.arange(n) // side % side, np.arange(n) // side**2], axis=1)
    # Whole numbers of mm, so that no digits of a position are lost.
    frames = Frames(
        np.ceil(_APART * size) * places.astype(float), np.array([scan.n_points for scan in scans]), periodic
    )
    names = [f"frame {k}" for k in range(n)]
    parts: dict[str, Any] = {
        name: join_rows(name, [getattr(scan, name) for scan in scans], names)
        for name in ("normals", "deviations", "slices")
    }
    weights = None
    if any(scan.weights is not None for scan in scans):
        weights = np.concatenate([np.asarray(scan.weights_or_ones()) for scan in scans])
    join_rows("regions", [None if scan.regions is None else scan.regions.rows for scan in scans], names)
    frame = join_frames([scan.frame for scan in scans], names)
    words = [word for scan in scans if scan.regions is not None for word in scan.regions.words()]
    placed = [rows + offset.astype(rows.dtype) for rows, offset in zip(points, frames.offsets, strict=True)]
    whole = Scan(np.concatenate(placed), weights=weights, regions=words or None, frame=frame, **parts)
    return whole, frames


def copy_mesh(mesh: js.ControlMesh, frames: Frames) -> js.ControlMesh:
    """A copy of a control mesh for every frame: its vertices, triangles and quads frame by frame."""
    n, v = len(frames.counts), len(mesh.vertices)
    faces = {size: np.concatenate([rows + k * v for k in range(n)]) for size, rows in mesh.faces.items()}
    normals = None if mesh.normals is None else np.tile(mesh.normals, (n, 1))
    regions = None
    if mesh.regions is not None:
        regions = js.Regions(copies_of_faces(mesh.regions.rows, mesh.faces[3], n), mesh.regions.names)
    return js.ControlMesh(frames.copy_rows(mesh.vertices), faces, normals, regions=regions)


def copies_of_faces(rows: AnyArray, triangles: Int[AnyArray, "t 3"], n: int) -> AnyArray:
    """A value a control face, triangles first, for the faces of so many copies, whose triangles stand first too."""
    t = len(triangles)
    return np.concatenate([np.tile(np.asarray(rows)[:t], n), np.tile(np.asarray(rows)[t:], n)])


def check_slices(scans: Sequence[Scan], names: Sequence[str]) -> None:
    """See that a number is the same slice in all frames.

    Raises:
        ScanError: a frame has no slices and others have; or a slice lies in another plane in one frame, whose name and
            slice the text tells.
    """
    if all(scan.slices is None for scan in scans):
        return
    for name, scan in zip(names, scans, strict=True):
        if scan.slices is None:
            raise ScanError(
                f"{name}: the frame has no slices and others have. Number its slices as in the others, or take "
                "`slices` from all."
            )
    numbers = [np.asarray(scan.slices) for scan in scans]
    points = [np.asarray(scan.points, np.float64) for scan in scans]
    size = float(np.linalg.norm(np.ptp(np.concatenate(points), axis=0)))
    for number in np.unique(np.concatenate(numbers)):
        own = [rows[of == number] for rows, of in zip(points, numbers, strict=True)]
        largest = max(range(len(own)), key=lambda k: len(own[k]))
        if len(own[largest]) < 3:
            continue
        middle = own[largest].mean(axis=0)
        _, widths, axes = np.linalg.svd(own[largest] - middle, full_matrices=False)
        if widths[1] < 0.1 * widths[0] or widths[2] > 0.1 * widths[1]:
            continue  # no plane that it could leave
        for name, rows in zip(names, own, strict=True):
            off = float(np.max(np.abs((rows - middle) @ axes[2]), initial=0.0))
            if off > 0.02 * size:
                raise ScanError(
                    f"{name}: slice {number} lies {off:.3g} mm off the plane that it has in {names[largest]}. A number "
                    "must be the same slice in all frames: number the slices alike, or fit the frames one by one."
                )


def join_frames(frames: Sequence[Frame | None], names: Sequence[str]) -> Frame | None:
    """The frame of patient coordinates that several scans have alike.

    Raises:
        ScanError: they differ; the text names two of these.
    """
    for frame, name in zip(frames, names, strict=True):
        if frame != frames[0]:
            raise ScanError(f"{names[0]} has the frame {frames[0]} and {name} {frame}: bring all into one frame.")
    return frames[0]


def join_rows(what: str, parts: Sequence[Any], names: Sequence[str]) -> np.ndarray | None:
    """Rows that several scans have of their points, one after another; None where none has any.

    Raises:
        ScanError: some have and others have not; the text names one of these.
    """
    given = [part is not None for part in parts]
    if not any(given):
        return None
    if not all(given):
        lacking = names[given.index(False)]
        raise ScanError(f"{lacking} has no `{what}` and others have: give them for all, or for none.")
    return np.concatenate([np.asarray(part) for part in parts])
