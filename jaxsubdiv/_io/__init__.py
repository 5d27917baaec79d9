"""Meshes and scan points from files, and meshes to files.

One module a format; this one picks it by the suffix and checks what it gives. Libraries of the extra `io` write
some formats and are loaded when they do; none reads, since what a damaged file announces can end the interpreter there.
"""

import errno
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from .._mesh import ControlMesh
from ..errors import MeshError, check_scale, name_rows
from ..extras import import_extra
from ..files import replace_file
from ..frames import Frame
from ..markups import read_control_points
from . import _arrays, _digitiser, _freesurfer, _gifti, _glb, _markups, _obj, _off, _pcd, _ply, _stl, _table, _vtk, _vtp
from ._contents import Contents, VertexData, as_double, warn
from ._frame import find_space

__all__ = ["PointCloud", "Surface", "check_can_write", "read_frame", "read_mesh", "read_points", "write_mesh"]


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
    library: str | None = None
    """Of the extra `io`, that writing takes."""


_TABLE = _Format(None, _table.read, None)
_MARKUPS = _Format(None, _markups.read, None)
_DIGITISER = _Format(None, _digitiser.read, None)
_FREESURFER = _Format(_freesurfer.read_binary, _freesurfer.read_binary, _freesurfer.write)
_GIFTI_DATA = _Format(_gifti.read, _gifti.read_points, _gifti.write_data, holds_data=True, library="nibabel.gifti")
_FORMATS = {
    ".obj": _Format(_obj.read, _obj.read_points, _obj.write),
    ".ply": _Format(_ply.read, _ply.read_points, _ply.write, holds_data=True),
    ".off": _Format(_off.read, _off.read_points, _off.write),
    ".stl": _Format(_stl.read, _stl.read, _stl.write),
    ".vtp": _Format(_vtp.read, _vtp.read_points, _vtk.write, holds_data=True, library="pyvista"),
    ".vtu": _Format(_vtp.read, _vtp.read_points, None),
    ".vtk": _Format(_vtk.read, _vtk.read_points, _vtk.write, holds_data=True, library="pyvista"),
    ".glb": _Format(_glb.read, _glb.read, _glb.write, holds_data=True),
    ".shape.gii": _GIFTI_DATA,
    ".gii": _Format(_gifti.read, _gifti.read_points, _gifti.write, library="nibabel.gifti"),
    ".npz": _Format(_arrays.read_npz, _arrays.read_points, _arrays.write),
    ".asc": _Format(_freesurfer.read_text, _freesurfer.read_points, None),
    **dict.fromkeys((".surf", ".white", ".pial", ".inflated", ".smoothwm", ".orig", ".sphere"), _FREESURFER),
    ".npy": _Format(None, _arrays.read_points, None),
    ".pcd": _Format(None, _pcd.read, None),
    **dict.fromkeys((".xyz", ".csv", ".txt", ".pts", ".particles"), _TABLE),
    **dict.fromkeys((".hsp", ".elp", ".pos"), _DIGITISER),
    **dict.fromkeys((".json", ".fcsv"), _MARKUPS),
}


def read_mesh(path: str | os.PathLike[str], *, scale: float | int = 1.0, check: bool = True) -> ControlMesh:
    """A mesh of triangles and quads from a file, with its vertex normals where it has them.

    Vertices, and the faces of one size, keep their order; unused vertices stay. Known suffixes, in any case:

    - `.obj`: the names of its groups (`g`) are the `regions` of the faces; texture coordinates and materials are left
      out. Where the corners at a vertex name several
      different normals, the vertex gets their unit mean, with a warning. Normals that no face names are taken when
      there is one a vertex. Surfaces of the MNI tools as text have this suffix too, and are read.
    - `.ply`: text, or binary of either byte order; other properties are left out.
    - `.off`: also NOFF; colours are left out.
    - `.stl`: text or binary; equal corners become one vertex; the normals of the facets are left out.
    - `.vtp`, `.vtu`, `.vtk`: polygons and triangle strips, and the triangles and quads of unstructured grids; points
      and lines are left out, and cells of volumes refused.
    - `.surf`, `.white`, `.pial`, `.inflated`, `.smoothwm`, `.orig`, `.sphere`: binary surfaces of FreeSurfer, which
      are known by their first bytes under any other name too (`lh.sphere.reg`). Coordinates stay surface RAS, as
      stored; a warning says where the scanner's RAS is another. `.asc`: the same as text.
    - `.glb`: the triangles of all meshes, as they are stored there: in metres as a rule, told where no `scale` is
      given. A matrix that places a mesh is not applied, and a warning says so.
    - `.gii`: GIfTI. Coordinates stay as stored: a coordinate transform in the file that is not the
      identity is not applied, and a warning says so.
    - `.npz`: `control_points`, `control_faces`, `control_normals`; or `vertices`, `normals` and `faces`, or `triangles`
      and `quads`.

    Args:
        path: the file.
        scale: factor for the coordinates: 1000 turns metres into mm. A unit is never guessed.
        check: False puts off the checks of `ControlMesh`, so that `repair()` can be called.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: the file is not what its suffix says, or damaged, or holds no faces or faces of five or more corners,
            or is not a mesh that `ControlMesh` takes. The text names the file and, where it is text, the line.
        ValueError: `scale` is not positive and finite.
    """
    path, format_ = _open(path)
    if format_.read_mesh is None:
        raise MeshError(f"{path.name}: {path.suffix} files hold points without faces. Read it with `read_points`.")
    check_scale(scale)
    contents = _warn_of_unit(path, format_.read_mesh(path), scale)
    if contents.faces is None:
        raise MeshError(f"{path.name}: it holds points but no faces. Read it with `read_points`.")
    vertices = _numbers(path.name, "vertices", contents.vertices, (None, 3))
    normals = contents.normals
    normals = None if normals is None else _numbers(path.name, "normals", normals, (len(vertices), 3))
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # areas of faces as large as numbers can be
            return ControlMesh(_scale(vertices, scale), contents.faces, normals, check=check, regions=contents.regions)
    except MeshError as error:
        mend = " Read it with check=False to get there." if "repair()" in str(error) else ""
        raise MeshError(f"{path.name}: {error}{mend}") from None


def read_points(path: str | os.PathLike[str], *, scale: float | int = 1.0) -> PointCloud:
    """Points of a scan from a file, with normals and weights where it has them.

    Every format of `read_mesh`, whose vertices are then the points, used or not, whatever its faces are; and:

    - `.xyz`, `.csv`, `.txt`, `.asc`, `.pts` (Leica's, and digitisers'), `.particles` (ShapeWorks): one point a line;
      commas, semicolons, tabs or white space part the columns; `#`, `//` and `;` begin comments. A header row names the
      columns, of `x y z nx ny nz weight` in any order, with units or as ParaView and biv-me write them; others are left
      out. Without one the first three columns are x, y and z, and three others are the normals where their lengths are
      near 1; a warning says what was left out. Decimals may have commas where these do not part the columns; a first
      row may give the number of points.
    - `.npz`: `points`, and `normals` and `weights` if present. `.npy`: one array `[p, 3]`.
    - `.pcd`: text, binary or compressed; x, y, z and normal_x, normal_y, normal_z. A viewpoint is not applied.
    - `.hsp`, `.elp`, `.pos`: heads traced with a Polhemus digitiser, fiducials among the points. Programs write the
      first two in metres and the last in centimetres; without a `scale` a warning says so.
    - `.mrk.json`, `.fcsv`: control points of 3D Slicer, in the frame that the file names; a warning says which.

    Points that are not finite are dropped, and a warning counts them. Normals that are not finite become zero, which
    says that a point has none; `normals` is None where no point has one.

    Args:
        path: the file.
        scale: factor for the coordinates: 1000 turns metres into mm. A unit is never guessed.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: the file is not what its suffix says, or damaged, or has no points; or a weight is not finite. The
            text names the file and the lines or rows.
        ValueError: `scale` is not positive and finite.
    """
    return read_labelled_points(path, (), scale=scale)[0]


def read_labelled_points(
    path: str | os.PathLike[str], names: Sequence[str], *, scale: float | int = 1.0
) -> tuple[PointCloud, dict[str, list[str]]]:
    """The points of `read_points`, and columns of text beside them: those of the names that a table's header has."""
    path, format_ = _open(path)
    check_scale(scale)
    contents = _warn_of_unit(path, format_.read_points(path), scale)
    points = _scale(_numbers(path.name, "points", contents.vertices, (None, 3)), scale)
    n = len(points)
    normals = None if contents.normals is None else _numbers(path.name, "normals", contents.normals, (n, 3))
    weights = None if contents.weights is None else _numbers(path.name, "weights", contents.weights, (n,))
    kept = _finite_rows(points)
    if not kept.any():
        dropped = f" All {n} rows have coordinates that are not finite." if n else ""
        raise MeshError(f"{path.name}: it holds no points.{dropped}")
    if not kept.all():
        rows = name_rows(np.flatnonzero(~kept))
        warn(
            path, f"{n - kept.sum()} of {n} points are not finite (rows {rows}, counted from zero); they were dropped."
        )
    cloud = PointCloud(
        points[kept],
        None if normals is None else _fill_normals(path, normals[kept]),
        None if weights is None else _check_finite(path.name, "weights", weights[kept]),
    )
    texts = {name: contents.texts[name] for name in names if name in contents.texts}
    return cloud, {
        name: [text for text, keep in zip(column, kept, strict=True) if keep] for name, column in texts.items()
    }


def read_frame(path: str | os.PathLike[str]) -> Frame | None:
    """What a file of points or of a mesh says its axes are: "LPS" or "RAS"; None where it does not say.

    3D Slicer writes `SPACE=LPS` into comments of `.ply`, `.obj`, `.stl` and `.vtk` files, and its control points
    (`.mrk.json`, `.fcsv`) name their frame. Nothing is turned by it; see `jaxsubdiv.frames.convert_frame`.

    Raises:
        FileNotFoundError: there is no such file.
        MeshError: the suffix is not known, the file is empty, or holds no control points as its suffix says.
    """
    path, format_ = _open(path)
    return read_control_points(path).frame if format_ is _MARKUPS else find_space(path)


def _warn_of_unit(path: Path, contents: Contents, scale: float | int) -> Contents:
    """The contents, after a warning where their format has a unit of its own and no scale was given."""
    if contents.usual_unit is not None and scale == 1:
        unit, to_mm = contents.usual_unit
        warn(path, f"{path.suffix} files are in {unit} as a rule; a scale of {to_mm:g} takes these to mm.")
    return contents


def _fill_normals(path: Path, normals: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"] | None:
    """The normals, zero where they are not finite; None where no point has one."""
    finite = _finite_rows(normals)
    if not finite.all():
        warn(path, f"{(~finite).sum()} of {len(finite)} normals are not finite; these points count as without one.")
        normals = np.where(finite[:, None], normals, 0)
    return normals if normals.any() else None


def write_mesh(
    path: str | os.PathLike[str],
    mesh: Surface,
    *,
    vertex_data: Mapping[str, ArrayLike] | None = None,
    frame: Frame | None = None,
) -> None:
    """Write a mesh to a file of the format that the suffix names, so that it reads back the same bit for bit.

    Suffixes: `.obj`, which alone keeps the regions of the faces, as groups, `.ply`, `.off`, `.vtp`, `.vtk`, `.npz`;
    and, with less in them, where quads are split with a warning, and another says by how much coordinates are rounded
    to single precision:

    - `.stl`: no normals, and no vertices that no face uses; not rounded.
    - `.gii`: GIfTI, as Connectome Workbench opens it: no normals, which it allows no room, and vertex data in a file of
      their own, `.shape.gii`, written of the same mesh.
    - `.surf`, `.white`, `.pial` and the other names of FreeSurfer that `read_mesh` knows: no normals.
    - `.glb`: glTF, for web pages and slides. The vertices are in mm as they are here, in a node that takes mm with z up
      to the metres with y up that glTF has, x staying x, so that programs show the true size; `read_mesh` gives mm
      again. Of the vertex data the first colour the surface: blue and red below and above 0 where there are both, dark
      to bright otherwise, grey where a value is not finite. All are kept as attributes too, `_DISTANCE_MM` for
      `distance_mm`; glTF has no NaN, so that these are 0 there, and so is `_DISTANCE_MM_KNOWN`, which is 1 elsewhere.

    The file appears, or takes the place of another, only once it is complete.

    Args:
        path: the file; its folder must be there.
        mesh: a `ControlMesh` or a `RefinedSurface`.
        vertex_data: name -> one number a vertex, shape `[v]`, of any unit: distances, say. Kept by `.ply`, `.vtp` and
            `.vtk`, `.glb` and `.shape.gii`; an error elsewhere.
        frame: what the axes are, where that is known: a comment of `.ply`, `.obj`, `.stl` and `.vtk` files says it to
            3D Slicer and `read_frame`, and the others leave it out.

    Raises:
        FileNotFoundError: the folder does not exist.
        MeshError: the suffix is unknown, the mesh is empty or has numbers that are not finite, or the format cannot
            hold it or the vertex data.
        ImportError: the format needs a library of the extra `io` which is not installed.
    """
    path = Path(path)
    if path.is_dir():
        raise MeshError(f"{path}: this is a folder. Name a file in it.")
    format_, write = _check_writable(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "the folder does not exist, create it first", str(path.parent))
    contents = _contents(path, mesh)._replace(frame=frame)
    data = _vertex_data(vertex_data or {}, len(contents.vertices))
    if data:
        _check_holds_data(path, format_)
    with replace_file(path) as unfinished:
        write(unfinished, contents, data)


def check_can_write(path: str | os.PathLike[str], *, vertex_data: bool = False) -> None:
    """See that `write_mesh` knows the suffix and has its library, before there is a mesh to write.

    Args:
        path: the file; neither it nor its folder need be there.
        vertex_data: whether it is to hold some.

    Raises:
        MeshError: meshes are not written to files of this suffix, or not with vertex data.
        ImportError: a library of the extra `io` is not installed.
    """
    path = Path(path)
    format_, _ = _check_writable(path)
    if vertex_data:
        _check_holds_data(path, format_)
    if format_.library is not None:
        import_extra(format_.library, "io", f"{path.suffix} files")


def _check_writable(path: Path) -> tuple[_Format, Callable[[Path, Contents, VertexData], None]]:
    format_ = _format(path)
    if format_.write is None:
        held = "points without faces" if format_.read_mesh is None else "meshes that are only read"
        raise MeshError(f"{path.name}: {path.suffix} files hold {held}. Meshes go to {_suffixes('write')}.")
    return format_, format_.write


def _check_holds_data(path: Path, format_: _Format) -> None:
    if not format_.holds_data:
        raise MeshError(f"{path.name}: {path.suffix} files hold no vertex data. Write {_suffixes('holds_data')}.")


def _open(path: str | os.PathLike[str]) -> tuple[Path, _Format]:
    """The path of a file that is there and has something in it, and its format."""
    path = Path(path)
    if path.is_dir():
        raise MeshError(f"{path}: this is a folder. Name a file in it.")
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such file", str(path))
    known = _known_format(path)
    if known is None and _freesurfer.is_binary(path):  # `lh.sphere.reg` and the like
        known = _FREESURFER
    format_ = known or _format(path)
    if path.stat().st_size == 0:
        raise MeshError(f"{path.name}: the file is empty. Was it copied to its end?")
    return path, format_


def _known_format(path: Path) -> _Format | None:
    """The format of a suffix, which may have two parts."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    return _FORMATS.get("".join(suffixes[-2:])) or _FORMATS.get(path.suffix.lower())


def _format(path: Path) -> _Format:
    format_ = _known_format(path)
    if format_ is None:
        raise MeshError(
            f"{path.name}: the suffix '{path.suffix}' is not known. Meshes: {_suffixes('read_mesh')}. Points, besides: "
            f"{', '.join(suffix for suffix, known in _FORMATS.items() if known.read_mesh is None)}."
        )
    return format_


def _suffixes(able_to: str) -> str:
    able = {suffix: format_ for suffix, format_ in _FORMATS.items() if getattr(format_, able_to)}
    return ", ".join(
        suffix for suffix, format_ in able.items() if format_ is not _GIFTI_DATA or able_to == "holds_data"
    )


def _contents(path: Path, mesh: Surface) -> Contents:
    """The arrays of what is to be written, checked as far as a reader must be able to rely on them."""
    vertices = _check_finite(path.name, "vertices", _numbers(path.name, "vertices", mesh.vertices, (None, 3)))
    normals = mesh.normals
    if normals is not None:
        normals = _check_finite(path.name, "normals", _numbers(path.name, "normals", normals, (len(vertices), 3)))
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
    return Contents(vertices, faces, normals, regions=getattr(mesh, "regions", None))


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
    """Float64 of a shape, where None is any length."""
    array = np.asarray(values)
    fits = array.ndim == len(shape) and all(n in (None, own) for n, own in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "iuf":
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise MeshError(
            f"{file}: `{name}` must be numbers of the shape [{wanted}]; got {array.dtype} of the shape "
            f"{list(array.shape)}."
        )
    return as_double(array)


def _check_finite(file: str, name: str, array: np.ndarray) -> np.ndarray:
    """The array, or an error with the rows that are not finite."""
    bad = np.flatnonzero(~_finite_rows(array))
    if len(bad):
        raise MeshError(f"{file}: {name} {name_rows(bad)}, counted from zero, are not finite. Drop these rows.")
    return array


def _finite_rows(array: np.ndarray) -> Bool[np.ndarray, "n"]:
    return np.asarray(np.isfinite(array).all(axis=tuple(range(1, array.ndim))))


def _scale(array: np.ndarray, scale: float | int) -> np.ndarray:
    # What passes the largest number is not finite, and told as such; NaN of some makes warn of any arithmetic.
    with np.errstate(over="ignore", invalid="ignore"):
        return array * scale
