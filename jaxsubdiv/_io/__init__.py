"""Meshes and scan points from files, and meshes to files.

One module a format; this one picks it by the suffix and checks what it gives. Libraries of the extra `io` are loaded by
the formats that need them, when they need them.
"""

import errno
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .._mesh import ControlMesh
from ..errors import MeshError, name_rows
from ..files import replacing
from . import _arrays, _gifti, _obj, _off, _ply, _stl, _table, _vtk
from ._contents import Contents, VertexData, doubles

__all__ = ["PointCloud", "Surface", "read_mesh", "read_points", "write_mesh"]


class PointCloud(NamedTuple):
    """Points of a scan, as the file has them: numpy, finite."""

    points: Float[np.ndarray, "p 3"]
    """In the unit of the file times `scale`."""
    normals: Float[np.ndarray, "p 3"] | None
    """Of any length; None where the file has none."""
    weights: Float[np.ndarray, "p"] | None
    """Dimensionless; None where the file has none."""


@runtime_checkable  # the tests check annotations while they run
class Surface(Protocol):
    """What can be written: a `ControlMesh`, a `RefinedSurface`, or anything with these three."""

    @property
    def vertices(self) -> Any:
        """`[v, 3]`."""
        ...

    @property
    def normals(self) -> Any:
        """`[v, 3]` or None."""
        ...

    @property
    def faces(self) -> Any:
        """`{3: [t, 3], 4: [q, 4]}`."""
        ...


class _Format(NamedTuple):
    read_mesh: Callable[[Path], Contents] | None
    read_points: Callable[[Path], Contents]
    write: Callable[[Path, Contents, VertexData], None] | None
    holds_data: bool = False


_TABLE = _Format(None, _table.read, None)
_VTK = _Format(_vtk.read, _vtk.read, _vtk.write, holds_data=True)
_FORMATS = {
    ".obj": _Format(_obj.read, _obj.read, _obj.write),
    ".ply": _Format(_ply.read, _ply.read, _ply.write, holds_data=True),
    ".off": _Format(_off.read, _off.read, _off.write),
    ".stl": _Format(_stl.read, _stl.read, _stl.write),
    ".vtp": _VTK,
    ".vtk": _VTK,
    ".gii": _Format(_gifti.read, _gifti.read, _gifti.write),
    ".npz": _Format(_arrays.read_npz, _arrays.read_points, _arrays.write),
    ".npy": _Format(None, _arrays.read_points, None),
    **dict.fromkeys((".xyz", ".csv", ".txt", ".asc"), _TABLE),
}


def read_mesh(path: str | os.PathLike[str], *, scale: float | int = 1.0, check: bool = True) -> ControlMesh:
    """A mesh of triangles and quads from a file, with its vertex normals where it has them.

    Vertices, and the faces of one size, keep their order; unused vertices stay. Known suffixes, in any case:

    - `.obj`: texture coordinates, groups and materials are left out. Where the corners at a vertex name several
      different normals, the vertex gets their unit mean, with a warning. Normals that no face names are taken when
      there is one a vertex.
    - `.ply`: text, or binary of either byte order; other properties are left out.
    - `.off`: also NOFF; colours are left out.
    - `.stl`: text or binary; equal corners become one vertex; the normals of the facets are left out.
    - `.vtp`, `.vtk`: polygons (legacy VTK: of a POLYDATA file), needs pyvista.
    - `.gii`: GIfTI, needs nibabel. Coordinates stay as stored: a coordinate transform in the file that is not the
      identity is not applied, and a warning says so.
    - `.npz`: `control_points`, `control_faces`, `control_normals`; or `vertices`, `normals` and `faces`, or `triangles`
      and `quads`.

    Args:
        path: the file.
        scale: factor for the coordinates: 1000 turns metres into mm. A unit is never guessed.
        check: False puts off the checks of `ControlMesh`, so that `repaired()` can be called.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: the file is not what its suffix says, or damaged, or holds no faces or faces of five or more corners,
            or is not a mesh that `ControlMesh` takes. The text names the file and, where it is text, the line.
        ImportError: the format needs a library of the extra `io` which is not installed.
        ValueError: `scale` is not positive and finite.
    """
    path, format_ = _open(path)
    if format_.read_mesh is None:
        raise MeshError(f"{path.name}: {path.suffix} files hold points without faces. Read it with `read_points`.")
    _check_scale(scale)
    contents = format_.read_mesh(path)
    if contents.faces is None:
        raise MeshError(f"{path.name}: it holds points but no faces. Read it with `read_points`.")
    try:
        return ControlMesh(np.asarray(contents.vertices) * scale, contents.faces, contents.normals, check=check)
    except MeshError as error:
        mend = " Read it with check=False to get there." if "repaired()" in str(error) else ""
        raise MeshError(f"{path.name}: {error}{mend}") from None


def read_points(path: str | os.PathLike[str], *, scale: float | int = 1.0) -> PointCloud:
    """Points of a scan from a file, with normals and weights where it has them.

    Every format of `read_mesh`, whose vertices are then the points, used or not, and:

    - `.xyz`, `.csv`, `.txt`, `.asc`: one point a line; commas, semicolons or white space part the columns; `#` begins a
      comment. A header row names the columns, of `x y z nx ny nz weight` in any order; others are left out. Without one
      there are 3 columns, or 6 with the normals.
    - `.npz`: `points`, and `normals` and `weights` if present. `.npy`: one array `[p, 3]`.

    Args:
        path: the file.
        scale: factor for the coordinates: 1000 turns metres into mm. A unit is never guessed.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: the file is not what its suffix says, or damaged, or has no points; or a coordinate, a normal or a
            weight is not finite. The text names the file and the lines or rows.
        ImportError: the format needs a library of the extra `io` which is not installed.
        ValueError: `scale` is not positive and finite.
    """
    path, format_ = _open(path)
    _check_scale(scale)
    contents = format_.read_points(path)
    points = _numbers(path.name, "points", contents.vertices, (None, 3))
    if len(points) == 0:
        raise MeshError(f"{path.name}: it holds no points.")
    n = len(points)
    normals = None if contents.normals is None else _numbers(path.name, "normals", contents.normals, (n, 3))
    weights = None if contents.weights is None else _numbers(path.name, "weights", contents.weights, (n,))
    return PointCloud(points * scale, normals, weights)


def read_texts(path: Path, names: Sequence[str]) -> dict[str, list[str]]:
    """Columns of text beside the points of `read_points`, row by row: those of the names that a table's header has."""
    return _table.read_texts(path, names) if _FORMATS[path.suffix.lower()] is _TABLE else {}


def write_mesh(
    path: str | os.PathLike[str], mesh: Surface, *, vertex_data: Mapping[str, ArrayLike] | None = None
) -> None:
    """Write a mesh to a file of the format that the suffix names, so that it reads back the same bit for bit.

    Suffixes: `.obj`, `.ply`, `.off`, `.vtp`, `.vtk`, `.npz`; and, with less in them, `.stl`, which holds neither quads
    (they are split, with a warning) nor normals nor vertices that no face uses, and `.gii`, which holds neither quads
    (an error) nor double precision (a warning says by how much it rounds).

    The file appears, or takes the place of another, only once it is complete.

    Args:
        path: the file; its folder must be there.
        mesh: a `ControlMesh` or a `RefinedSurface`.
        vertex_data: name -> one number a vertex, shape `[v]`, of any unit: distances, say. Kept by `.ply`, `.vtp` and
            `.vtk`; an error elsewhere.

    Raises:
        FileNotFoundError: the folder does not exist.
        MeshError: the suffix is unknown, the mesh is empty or has numbers that are not finite, or the format cannot
            hold it or the vertex data.
        ImportError: the format needs a library of the extra `io` which is not installed.
    """
    path = Path(path)
    if path.is_dir():
        raise MeshError(f"{path}: this is a folder. Name a file in it.")
    format_ = _format(path)
    if format_.write is None:
        raise MeshError(
            f"{path.name}: {path.suffix} files hold points without faces. Meshes go to {_suffixes('write')}."
        )
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "the folder does not exist, create it first", str(path.parent))
    contents = _contents(path, mesh)
    data = _vertex_data(vertex_data or {}, len(contents.vertices))
    if data and not format_.holds_data:
        raise MeshError(f"{path.name}: {path.suffix} files hold no vertex data. Write {_suffixes('holds_data')}.")
    with replacing(path) as unfinished:
        format_.write(unfinished, contents, data)


def _open(path: str | os.PathLike[str]) -> tuple[Path, _Format]:
    """The path of a file that is there and has something in it, and its format."""
    path = Path(path)
    if path.is_dir():
        raise MeshError(f"{path}: this is a folder. Name a file in it.")
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path))
    format_ = _format(path)
    if path.stat().st_size == 0:
        raise MeshError(f"{path.name}: the file is empty. Was it copied to its end?")
    return path, format_


def _format(path: Path) -> _Format:
    format_ = _FORMATS.get(path.suffix.lower())
    if format_ is None:
        raise MeshError(
            f"{path.name}: the suffix '{path.suffix}' is not known. Meshes: {_suffixes('read_mesh')}. Points, besides: "
            f"{', '.join(suffix for suffix, known in _FORMATS.items() if known.read_mesh is None)}."
        )
    return format_


def _suffixes(able_to: str) -> str:
    return ", ".join(suffix for suffix, format_ in _FORMATS.items() if getattr(format_, able_to))


def _check_scale(scale: float | int) -> None:
    if not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"`scale` must be positive and finite; got {scale}. 1000 turns metres into mm.")


def _contents(path: Path, mesh: Surface) -> Contents:
    """The arrays of what is to be written, checked as far as a reader must be able to rely on them."""
    vertices = _numbers(path.name, "vertices", mesh.vertices, (None, 3))
    normals = None if mesh.normals is None else _numbers(path.name, "normals", mesh.normals, (len(vertices), 3))
    faces = {size: np.asarray(mesh.faces.get(size, np.zeros((0, size), int))) for size in (3, 4)}
    if set(mesh.faces) - {3, 4} or any(
        block.dtype.kind not in "iu" or block.shape != (len(block), size) for size, block in faces.items()
    ):
        raise MeshError(f"{path.name}: `faces` must be whole numbers, {{3: [t, 3], 4: [q, 4]}}; nothing is written.")
    faces = {size: block.astype(np.int64) for size, block in faces.items()}  # small unsigned ones overflow at one-based
    corners = np.concatenate([block.ravel() for block in faces.values()])
    if len(corners) == 0 or corners.min() < 0 or corners.max() >= len(vertices):
        raise MeshError(
            f"{path.name}: nothing is written, since the mesh has no faces or faces with vertex indices outside of its "
            f"{len(vertices)} vertices."
        )
    return Contents(vertices, faces, normals)


def _vertex_data(data: Mapping[str, ArrayLike], n_vertices: int) -> VertexData:
    columns = {name: np.asarray(column) for name, column in data.items()}
    for name, column in columns.items():
        if column.shape != (n_vertices,) or column.dtype.kind not in "biuf":
            raise MeshError(
                f"`vertex_data['{name}']` must be one number a vertex, shape [{n_vertices}]; got {column.dtype} of the "
                f"shape {list(column.shape)}."
            )
    # The few types that formats do not know, in the next larger that they do.
    return {
        name: column.astype({"?": "u1", "e": "f4", "g": "f8"}.get(column.dtype.char, column.dtype))
        for name, column in columns.items()
    }


def _numbers(file: str, name: str, values: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Finite float64 of a shape, where None is any length; or an error with the rows that are not."""
    array = np.asarray(values)
    fits = array.ndim == len(shape) and all(n in (None, own) for n, own in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "iuf":
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise MeshError(
            f"{file}: `{name}` must be numbers of the shape [{wanted}]; got {array.dtype} of the shape "
            f"{list(array.shape)}."
        )
    array = doubles(array)
    bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
    if len(bad):
        raise MeshError(f"{file}: {name} {name_rows(bad)}, counted from zero, are not finite. Drop these rows.")
    return array
