"""Cells of VTK's files: polygons, strips and the cells of unstructured grids, as triangles and quads."""

from pathlib import Path

import numpy as np
from jaxtyping import Int

from ..errors import MeshError
from ._contents import check_polygons, sort_by_size

_Blocks = dict[int, Int[np.ndarray, "_ _"]]

_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD = 5, 6, 7, 8, 9
_SURFACE = (_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD)
_NO_SURFACE = (0, 1, 2, 3, 4)  # none, points and lines: left out, as in files of polygons
_NAMES = {10: "tetrahedra", 11: "voxels", 12: "hexahedra", 13: "wedges", 14: "pyramids"} | {
    **{22: "quadratic triangles", 23: "quadratic quads", 24: "quadratic tetrahedra", 25: "quadratic hexahedra"},
    **{42: "polyhedra", 69: "Lagrange triangles", 70: "Lagrange quads", 71: "Lagrange tetrahedra"},
    **{72: "Lagrange hexahedra"},
}


def polygons(path: Path, ends: Int[np.ndarray, "f"], corners: Int[np.ndarray, "c"]) -> _Blocks | None:
    """Faces whose corners end at `ends`; None where there are none."""
    if len(ends) == 0:
        return None
    sizes = np.diff(ends, prepend=0)
    check_polygons(path, sizes)
    _check_corners(path, ends, corners)
    return sort_by_size(corners, ends - sizes, sizes)


def strips(path: Path, ends: Int[np.ndarray, "s"], corners: Int[np.ndarray, "c"]) -> Int[np.ndarray, "t 3"]:
    """The triangles of strips, whose corners end at `ends`: each corner from the third on makes one with the two before
    it, turned the other way round for every second one."""
    sizes = np.diff(ends, prepend=0)
    if (short := np.flatnonzero(sizes < 3)).size:
        raise MeshError(
            f"{path.name}: triangle strip {short[0]}, counted from zero, has {sizes[short[0]]} corners, where three "
            "are the fewest. It is damaged."
        )
    _check_corners(path, ends, corners)
    counts = sizes - 2
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    first = np.repeat(ends - sizes, counts) + number
    odd = number % 2
    return corners[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)]


def surface_cells(
    path: Path, types: Int[np.ndarray, "n"], ends: Int[np.ndarray, "n"], corners: Int[np.ndarray, "c"]
) -> _Blocks | None:
    """The triangles and quads of an unstructured grid; None where it has neither. Points and lines are left out.

    Raises:
        MeshError: there are cells of other kinds, such as those of volumes.
    """
    others = ~np.isin(types, _SURFACE + _NO_SURFACE)
    if others.any():
        kind = int(types[others][0])
        raise MeshError(
            f"{path.name}: it holds {np.sum(types == kind)} {_NAMES.get(kind, f'cells of the type {kind}')}, which are "
            "no flat triangles or quads. Take its surface first: pyvista.read(...).extract_surface().save(...)."
        )
    starts = np.append(0, ends[:-1])
    if (np.diff(ends, prepend=0) < 0).any():
        raise MeshError(f"{path.name}: the offsets of its cells do not ascend. It is damaged.")
    _check_corners(path, ends, corners)

    def of(*kinds: int) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Int[np.ndarray, "k"]]:
        """Where the corners of each of these cells end, among their own; likewise the sizes, and the corners."""
        chosen = np.isin(types, kinds)
        sizes = (ends - starts)[chosen]
        own_ends = np.cumsum(sizes)
        places = np.arange(sizes.sum()) + np.repeat(starts[chosen] - (own_ends - sizes), sizes)
        return own_ends, sizes, corners[places]

    own_ends, sizes, own = of(_TRIANGLE, _POLYGON, _PIXEL, _QUAD)
    kinds = types[np.isin(types, (_TRIANGLE, _POLYGON, _PIXEL, _QUAD))]
    wanted = np.select([kinds == _TRIANGLE, kinds == _POLYGON], [3, sizes], 4)
    if (wrong := np.flatnonzero(sizes != wanted)).size:
        raise MeshError(
            f"{path.name}: a cell of {wanted[wrong[0]]} corners has {sizes[wrong[0]]}. The file is damaged: its types "
            "and offsets do not fit."
        )
    last = (own_ends - 1)[kinds == _PIXEL]  # of pixels, which name their corners row by row
    own[last], own[last - 1] = own[last - 1], own[last]
    faces = polygons(path, own_ends, own)
    strip_ends, _, strip_corners = of(_STRIP)
    return append_triangles(faces, strips(path, strip_ends, strip_corners))


def append_triangles(faces: _Blocks | None, more: Int[np.ndarray, "t 3"]) -> _Blocks | None:
    """The faces, and more triangles after theirs; None where there are none at all."""
    if faces is None:
        return {3: more, 4: np.zeros((0, 4), more.dtype)} if len(more) else None
    return faces | {3: np.concatenate([faces[3], more])}


def _check_corners(path: Path, ends: Int[np.ndarray, "f"], corners: Int[np.ndarray, "c"]) -> None:
    if len(ends) and ends[-1] > len(corners):
        raise MeshError(f"{path.name}: the faces need {ends[-1]} corners, but there are {len(corners)}. It is damaged.")
