"""The scan: measured points, and what is known of each."""

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv import strong_float
from jaxsubdiv.errors import name_rows
from jaxsubdiv.frames import Frame
from jaxsubdiv.linalg import scale_to_moderate_length

_LABELS, _SLICE = ("label", "contour"), "slice"
_WHOLE = re.compile(r"[+-]?[0-9]{1,9}(\.0*)?")  # as large as 32 bits hold


class ScanError(ValueError):
    """A scan cannot be fitted as it is; the text names the rows and what to do."""


def _convert(value: object) -> Array | None:
    return None if value is None else strong_float(value)


def _convert_directions(value: object) -> Array | None:
    if value is None or isinstance(value, Array):
        return _convert(value)
    rows = np.asarray(value)
    if rows.shape[1:] != (3,):
        return strong_float(rows)  # refused later, by its shape
    directions = scale_to_moderate_length(rows.astype(float))
    return strong_float(directions.astype(rows.dtype) if rows.dtype.kind == "f" else directions)


def _convert_whole(value: object) -> Array | None:
    if value is None:
        return None
    values = np.asarray(value)
    if values.dtype.kind not in "iuf" or not np.all((np.abs(values) < 2.0**31) & (values == np.round(values))):
        raise ScanError("`slices` must be whole numbers below 2^31, one a point: number the slices.")
    return jnp.asarray(values, jnp.int32)


def _convert_regions(value: Any) -> js.Regions | None:
    try:
        return js.as_regions(value)
    except ValueError as error:
        raise ScanError(f"`regions`: {error}") from None


def _convert_faces(value: object) -> np.ndarray | None:
    faces = None if value is None else np.asarray(value)
    if faces is None or not faces.size:
        return None
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ScanError(
            f"`faces` must be triangles, rows of three whole numbers [t, 3]; got {list(faces.shape)} of {faces.dtype}."
        )
    if faces.min() < 0 or faces.max() > np.iinfo(np.int32).max:
        raise ScanError(f"`faces` name points from 0 on; got {faces.min()} to {faces.max()}.")
    return faces.astype(np.int32)


class Scan(eqx.Module):
    """Measured points of a surface.

    Attributes:
        points: positions in mm.
        normals: outward normals of any length, or None.
        weights: how much each point counts, not negative, or None where all count alike. Only their ratio counts; a
            point of weight 0 is as if it were not there.
        deviations: standard deviation of each point's distance, positive, or None where all are alike. Only their ratio
            counts: how large the noise is, the fit finds out.
        slices: the number of the slice that each point lies in, or None where the scan is not made of slices. `fit`
            shifts each within its plane.
        faces: triangles between the points `[t, 3]`, or None. A control mesh made from the scan takes from them its
            parts, and which side is out where there are no normals; `fit` looks at the points alone, and a saved fit
            does not keep them.
        frame: what the axes are, "RAS" (x to the right, y to the front, z up) or "LPS" (x to the left, y to the back, z
            up); None where that is not known. Nothing is turned by it: landmarks and results name it.
        outlined: whether the faces are all of the surface that was seen, as the outline of a label is. A saved fit does
            not keep it.
        view: of a scan that was seen in an image `[4, 4]`, takes positions to the unit cube that the image shows. A
            control mesh made from the scan ends there, as an open surface: what lies beyond was not seen. A saved fit
            does not keep it.
        regions: the part of the anatomy that each point was labelled as, or None: `jaxsubdiv.Regions`, or a name each,
            empty where a point has none. A fit to a template with groups of faces pairs each point with its own.

    Raises:
        ScanError: there is no point, a value is not finite, a weight is negative, a deviation is not positive, a
            slice has no whole number, faces are no triangles between the points, or lengths differ.
    """

    points: Float[Array, "p 3"] = eqx.field(converter=strong_float)
    normals: Float[Array, "p 3"] | None = eqx.field(converter=_convert_directions, default=None)
    weights: Float[Array, "p"] | None = eqx.field(converter=_convert, default=None)
    deviations: Float[Array, "p"] | None = eqx.field(converter=_convert, default=None)
    slices: Int[Array, "p"] | None = eqx.field(converter=_convert_whole, default=None)
    faces: Int[np.ndarray, "t 3"] | None = eqx.field(converter=_convert_faces, default=None)
    frame: Frame | None = eqx.field(static=True, default=None)
    outlined: bool = eqx.field(static=True, default=False)
    view: Float[np.ndarray, "4 4"] | None = None
    regions: js.Regions | None = eqx.field(converter=_convert_regions, default=None)

    def __check_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[-1] != 3 or len(self.points) == 0:
            raise ScanError(f"a scan needs points of the shape [p, 3], at least one; got {list(self.points.shape)}.")
        for name, values, shape in (
            ("points", self.points, self.points.shape),
            ("normals", self.normals, self.points.shape),
            ("weights", self.weights, self.points.shape[:1]),
            ("deviations", self.deviations, self.points.shape[:1]),
            ("slices", self.slices, self.points.shape[:1]),
        ):
            if values is None:
                continue
            if values.shape != shape:
                raise ScanError(f"`{name}` must have the shape {list(shape)}; got {list(values.shape)}.")
            finite = np.isfinite(np.asarray(values)).reshape(len(values), -1).all(axis=1)
            if not finite.all():
                raise ScanError(f"`{name}` are not finite in rows {name_rows(np.flatnonzero(~finite))}. Drop the rows.")
        if self.regions is not None and len(self.regions) != len(self.points):
            raise ScanError(f"there are {len(self.regions)} `regions` for {len(self.points)} points. Give one each.")
        if self.faces is not None and not (0 <= self.faces.min() and self.faces.max() < len(self.points)):
            raise ScanError(f"`faces` name points that there are not: the scan has {len(self.points)}.")
        if self.weights is not None:
            negative = np.flatnonzero(np.asarray(self.weights) < 0)
            if len(negative):
                raise ScanError(f"`weights` are negative in rows {name_rows(negative)}. Give 0 to ignore a point.")
            if not float(self.weights.sum()) > 0:
                raise ScanError("all `weights` are 0: nothing is left to fit. Give None where all points count alike.")

        if self.deviations is not None:
            bad = np.flatnonzero(np.asarray(self.deviations) <= 0)
            if len(bad):
                raise ScanError(
                    f"`deviations` are not positive in rows {name_rows(bad)}. Give a weight of 0 to ignore a point."
                )

    @property
    def n_points(self) -> int:
        """Number of points."""
        return self.points.shape[0]

    def weights_or_ones(self) -> Float[Array, "p"]:
        """The weights, 1 each where there are none."""
        return jnp.ones_like(self.points[:, 0]) if self.weights is None else self.weights

    def relative_weights(self) -> Float[Array, "p"]:
        """The weights over the mean of those that are not 0, 1 each where there are none."""
        if self.weights is None:
            return self.weights_or_ones()
        weights = self.weights / jnp.max(self.weights)  # so that no sum leaves the range of single precision
        return weights / jnp.mean(weights, where=weights > 0)

    def draw(self, n: int) -> "Scan":
        """At most `n` of the points that count, drawn at random, always the same."""
        if n >= self.n_points:
            return self
        counted = np.arange(self.n_points) if self.weights is None else np.flatnonzero(np.asarray(self.weights) > 0)
        if n >= len(counted):
            return self.rows(counted)
        return self.rows(np.sort(np.random.default_rng(0).choice(counted, n, replace=False)))

    def rows(self, chosen: Bool[np.ndarray, "p"] | Int[np.ndarray, "q"]) -> "Scan":
        """Some of the points, with all that is known of each."""
        of_all = {"faces", "frame", "outlined", "view", "regions"}
        own = {name: value for name, value in vars(self).items() if name not in of_all and value is not None}
        faces = None
        if self.faces is not None:
            new = np.full(self.n_points, -1)
            new[chosen] = np.arange(len(new[chosen]))
            faces = new[self.faces][(new[self.faces] >= 0).all(axis=1)]
        return Scan(
            **{name: value[chosen] for name, value in own.items()},
            faces=faces,
            frame=self.frame,
            view=self.view,
            regions=None if self.regions is None else self.regions.take(chosen),
        )

    def drop_slices(self) -> "Scan":
        """The same points, each for itself, without their labels."""
        return Scan(self.points, self.normals, self.weights, self.deviations)

    def relative_deviations(self) -> Float[Array, "p"]:
        """The deviations over their root mean square, 1 each where there are none."""
        if self.deviations is None:
            return jnp.ones_like(self.points[:, 0])
        return self.deviations / jnp.sqrt(jnp.mean(self.deviations**2))


def read_scan(path: str | Path, *, scale: float = 1.0, labels: str | Sequence[str] = ()) -> Scan:
    """A scan from a file of points: PLY, XYZ, CSV, TXT, NPZ, VTP, or any mesh file, whose vertices are then the points.

    Faces of a mesh file are kept, see `Scan.faces`. A column `slice` of a CSV file, or another table with a header row,
    numbers the slices, and `frameID` does so in guide points of biv-me (`GPFile_000.txt`). Points that are not finite
    are dropped, with a warning; see `jaxsubdiv.read_points` for all that a file may hold. The frame is what the file
    says, see `jaxsubdiv.read_frame`. A column `label` or `contour` names the regions, see `Scan.regions`.

    Args:
        path: the file.
        scale: multiplies the coordinates. A file of points does not say its unit; 1000 takes metres to mm.
        labels: only the rows of a table whose column `label` or `contour` holds one of these texts, in capitals or not.

    Raises:
        MeshError: the file cannot be read; the text names the file and the line.
        ScanError: it holds no points, or none of these labels, and the text lists those that there are; or a slice has
            no whole number.
    """
    path = Path(path)
    cloud, columns = js.read_labelled_points(path, (*_LABELS, _SLICE), scale=scale)
    slices = None if _SLICE not in columns else _numbers(path, columns[_SLICE])
    words = [labels] if isinstance(labels, str) else list(labels)
    of_rows = next((columns[name] for name in _LABELS if name in columns), [])
    if not words:
        faces = _faces_between(path, cloud.points, scale)
        return _scan(path, *cloud, None, slices, faces, js.read_frame(path), regions=of_rows or None)
    chosen = np.array([any(word.casefold() in one.casefold() for word in words) for one in of_rows], bool)
    if not chosen.any():
        there = ", ".join(sorted(set(of_rows))) or "no column `label` or `contour`"
        wanted = " or ".join(f"'{word}'" for word in words)
        raise ScanError(f"{path.name}: no row has a label that holds {wanted}. It has: {there}.")
    kept = (None if rows is None else rows[chosen] for rows in (*cloud, None, slices))
    own = [one for one, is_kept in zip(of_rows, chosen, strict=True) if is_kept]
    return _scan(path, *kept, None, js.read_frame(path), regions=own)


def _scan(path: Path, *parts: np.ndarray | Frame | None, regions: list[str] | None = None) -> Scan:
    try:
        with np.errstate(over="ignore"):  # what passes single precision is not finite, and told as such
            return Scan(*parts, regions=regions)  # pyright: ignore[reportArgumentType]
    except ScanError as error:
        raise ScanError(f"{path.name}: {error}") from None


def _faces_between(path: Path, points: Float[np.ndarray, "p 3"], scale: float) -> Int[np.ndarray, "t 3"] | None:
    """Triangles of a mesh file whose vertices are the points, quads cut in two; None where they cannot be had."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the points have been read: what there is to tell was told
            mesh = js.read_mesh(path, scale=scale, check=False)
    except (js.MeshError, ImportError):
        return None
    if not np.array_equal(mesh.vertices, points):
        return None
    quads = mesh.faces[4]
    return np.concatenate([mesh.faces[3], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _numbers(path: Path, texts: list[str]) -> Int[np.ndarray, "p"]:
    bad = next((text for text in texts if not _WHOLE.fullmatch(text)), None)
    if bad is not None:
        raise ScanError(
            f"{path.name}: the column `{_SLICE}` has '{bad[:40]}', which is no whole number of up to nine digits. "
            "Number the slices, or rename the column where it is something else."
        )
    return np.array([int(text.partition(".")[0]) for text in texts])
