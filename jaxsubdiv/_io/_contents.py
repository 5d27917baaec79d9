"""What passes between the front doors and the formats: plain arrays, not yet checked as a mesh."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, Shaped

from .. import notices
from .._regions import Regions
from ..errors import MeshError, name_rows
from ..frames import Frame


class Contents(NamedTuple):
    """The arrays of one file, in its own unit."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Mapping[int, Int[np.ndarray, "_ _"]] | None = None
    """Polygon size (3 or 4) -> corners of the faces of that size, zero-based; None where there are points alone."""
    normals: Float[np.ndarray, "v 3"] | None = None
    weights: Float[np.ndarray, "v"] | None = None
    texts: Mapping[str, list[str]] = MappingProxyType({})
    """Columns of text beside the points, by heading."""
    frame: Frame | None = None
    """What the axes are, where that is known."""
    usual_unit: tuple[str, float] | None = None
    """The unit that programs of the format write, and the scale that takes it to mm; None where it says nothing."""
    regions: Regions | None = None
    """Of the faces, triangles first."""


VertexData = Mapping[str, Shaped[np.ndarray, "v"]]
"""Name -> one number a vertex."""


def warn(path: Path, text: str) -> None:
    """Warn about what a file does to the mesh; the text starts with the file's name."""
    notices.warn(f"{path.name}: {text}")


def as_double(values: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """A copy in float64; what is not finite there is so without a warning, to be named later by its row."""
    with np.errstate(invalid="ignore", over="ignore"):
        return values.astype(np.float64)


def split_quads(path: Path, format_: str, contents: Contents) -> Int[np.ndarray, "t 3"]:
    """The faces for a format that holds no quads: these are split in two, and a warning says so."""
    faces = contents.faces or {}
    triangles, quads = faces.get(3, np.zeros((0, 3), int)), faces.get(4, np.zeros((0, 4), int))
    if not len(quads):
        return triangles
    warn(path, f"{format_} holds triangles only: {len(quads)} quads were split in two along their first diagonal.")
    return np.concatenate([triangles, quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def round_to_single(path: Path, format_: str, vertices: Float[np.ndarray, "v 3"]) -> Float32[np.ndarray, "v 3"]:
    """The vertices for a format that knows no other precision; a warning says by how much they were rounded."""
    with np.errstate(over="ignore"):
        single = vertices.astype(np.float32)
    if not np.isfinite(single).all():
        raise MeshError(f"{path.name}: {format_} holds single precision, and coordinates are beyond it. Scale them.")
    rounding = np.abs(single - vertices).max(initial=0)
    if rounding > 0:
        warn(path, f"{format_} holds single precision: coordinates were rounded, by up to {rounding:.1e}.")
    return single


def check_polygons(path: Path, sizes: Int[np.ndarray, "f"]) -> None:
    """Raise for faces, in the order of the file, that are neither triangles nor quads."""
    wrong = np.flatnonzero((sizes < 3) | (sizes > 4))
    if len(wrong):
        raise MeshError(
            f"{path.name}: faces {name_rows(wrong)}, counted from zero, are neither triangles nor quads (face "
            f"{wrong[0]} has {sizes[wrong[0]]} corners). Split larger faces into triangles and quads, and drop smaller "
            "ones."
        )


def as_indices(path: Path, values: Shaped[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """Vertex indices as int64; text formats give them as floating point."""
    with np.errstate(invalid="ignore"):  # NaN and infinity differ from any integer, and are caught below
        indices = values.astype(np.int64)
    if (indices != values).any():
        raise MeshError(
            f"{path.name}: a face uses the vertex index {values[indices != values][0]}, which is not a whole number."
        )
    return indices


def sort_by_size(
    values: Shaped[np.ndarray, "n"], starts: Int[np.ndarray, "f"], sizes: Int[np.ndarray, "f"]
) -> dict[int, Shaped[np.ndarray, "_ _"]]:
    """Triangles and quads out of one run of numbers: face `i` is `values[starts[i] : starts[i] + sizes[i]]`."""
    return {size: values[starts[sizes == size][:, None] + np.arange(size)] for size in (3, 4)}
