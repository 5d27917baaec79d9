"""A surface as Bézier patches, one a face: bicubic on quads, cubic or quartic on triangles."""

import os
from math import comb
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ._control import Control
from ._creases import Creases
from ._io._gismo import check_can_write_xml, write_multipatch
from ._io._vtu import BEZIER_QUAD, BEZIER_TRIANGLE, check_can_write_vtu, write_grid
from ._mesh import ControlMesh
from ._refine import refine_vertices
from ._scheme.base import AbstractScheme
from ._scheme.bezier_triangle import BezierTriangle, corner_uv
from ._scheme.loop import Loop
from ._topology import MAX_LEVELS, Topology, build_topology
from .errors import MeshError
from .half_edges import half_edges

_ENDS = {3: ([0, 1], [1, 2], [2, 0]), 4: ([0, 1], [1, 2], [3, 2], [0, 3])}  # of the sides, in VTK's order
_DEEPER = 3  # levels, of the points that the patches are fitted to: eight pieces a side


class BezierPatches(NamedTuple):
    """Polynomial patches, one a face of a refined surface; neighbours share the points of their common side.

    Attributes:
        points: control points of all patches, in the unit of the mesh. The corners lie on the surface.
        triangles: of every triangular patch its 10 points (cubic) or 15 (quartic), triangles first, in VTK's order: the
            corners, the inner points of the sides from the first to the second corner, on to the third and back to the
            first, then those inside.
        quads: of every bicubic patch its 16 points: the corners; the inner points of the sides from the first to the
            second corner, second to third, fourth to third, first to fourth; and those inside, row by row.
        is_exact: whether a patch, triangles first, is the limit surface itself, but for rounding.
        largest: distance of the surface from the patch, at the same coordinates, so that the patch is no farther: the
            largest, and
        rms: root mean square; both over 8 by 8 places a patch. 0 but for rounding where all are exact.
    """

    points: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "t k"]
    quads: Int[np.ndarray, "q 16"]
    is_exact: Bool[np.ndarray, "f"]
    largest: float
    rms: float

    def summarise(self) -> str:
        """What a command prints: counts, and how far the patches are from the surface."""
        return (
            f"patches  {len(self.is_exact):,}, of these {self.is_exact.sum():,} exact; from the surface: RMS "
            f"{self.rms:.3g}, largest {self.largest:.3g}"
        )


def make_patches(
    scheme: AbstractScheme, mesh: ControlMesh, control: Control, levels: int, *, creases: Creases | None = None
) -> BezierPatches:
    """The surface as Bézier patches, for isogeometric analysis and CAD.

    Catmull-Clark's patches are its limit surface wherever a face has regular corners and no boundary or crease beside
    it; Loop's likewise, as quartic triangles; and those of `BezierTriangle` at level 0 all are. Every other patch has
    its corners on the surface, and its other points are those of least squares to the surface three levels deeper
    (linear schemes: to the limit): first along each side, which both patches share, then inside. So patches meet
    without gaps, but beside one that is not exact with a small bend; more levels make both errors smaller.

    Args:
        scheme: the rules and their `h`, one for all levels.
        mesh: the control mesh; only its faces and its number of vertices matter.
        control: vertices and normals.
        levels: a patch a face of the surface at this level.
        creases: as `build_topology` has them.

    Raises:
        ValueError: the deeper surface has no level; `h` has one value a level; or refined faces have no place in the
            faces before: Doo-Sabin, and level 0 of Catmull-Clark on triangles.
    """
    if levels + _DEEPER > MAX_LEVELS:
        raise ValueError(f"patches are made at levels up to {MAX_LEVELS - _DEEPER}; got {levels}.")
    if scheme.h is not None and scheme.h.ndim:
        raise ValueError("`h` has one value a level, so that there is no deeper surface to fit. Give one `h`.")
    limit = scheme.is_linear
    coarse = build_topology(mesh, scheme, levels, limit=limit, creases=creases)
    deep = build_topology(mesh, scheme, levels + _DEEPER, limit=limit, creases=creases)
    faces, deeper = ({size: np.asarray(topology.faces[size]) for size in (3, 4)} for topology in (coarse, deep))
    if not scheme.is_primal or any(len(deeper[size]) != 4**_DEEPER * len(faces[size]) for size in (3, 4)):
        advice = "Begin at level 1." if scheme.is_primal else "Take another scheme."
        raise ValueError(f"{type(scheme).__name__} does not split these faces into four at every level. {advice}")
    x = np.asarray(refine_vertices(scheme, deep, control), np.float64)
    samples = {size: _take_samples(x, deeper[size], size) for size in (3, 4)}
    degree = 4 if isinstance(scheme, Loop) else 3
    points, patches = _fit_points(faces, samples, degree)
    away = [
        np.linalg.norm(
            weigh_points(size, degree, _list_places(size)) @ points[patches[size]] - samples[size], axis=2
        ).ravel()
        for size in (3, 4)
    ]
    off = np.concatenate(away)
    exact = _find_exact(scheme, coarse, levels)
    quads = patches[4].reshape(-1, 16)  # of Loop, of other degree, there are none
    return BezierPatches(points, patches[3], quads, exact, float(off.max()), float(np.sqrt(np.mean(off**2))))


def check_can_write_patches(path: str | os.PathLike[str]) -> None:
    """See that patches can be written to a file.

    Raises:
        MeshError: another suffix than .vtu and .xml.
        FileNotFoundError: the folder is not there.
        ImportError: pyvista, of the extras `io` and `simulation`, is not installed, for `.vtu`.
    """
    _ = check_can_write_xml(path) if Path(path).suffix.lower() == ".xml" else check_can_write_vtu(path)


def write_patches(path: str | os.PathLike[str], patches: BezierPatches) -> None:
    """Write Bézier patches to a file.

    - `.vtu`: VTK's Bézier triangles and quadrilaterals, which ParaView draws and VTK evaluates. `is_exact` is 1 where
      a patch is the limit surface.
    - `.xml`: a multi-patch geometry of G+Smo, the library for isogeometric analysis, with the sides that patches have
      in common: quads alone.

    Raises:
        MeshError: another suffix, or triangles for `.xml`.
        FileNotFoundError: the folder is not there.
        ImportError: pyvista, of the extras `io` and `simulation`, is not installed, for `.vtu`.
    """
    path = Path(path)
    if path.suffix.lower() != ".xml":
        cells = [(BEZIER_TRIANGLE, patches.triangles), (BEZIER_QUAD, patches.quads)]
        write_grid(path, patches.points, cells, {"is_exact": patches.is_exact.astype(np.uint8)})
        return
    if len(patches.triangles):
        raise MeshError(
            f"{path.name}: G+Smo's patches are quads, and {len(patches.triangles)} of these are triangles. Write a "
            ".vtu file, or fit a control mesh of quads."
        )
    write_multipatch(path, patches.points[patches.quads[:, _order_by_rows()]], patches.quads[:, :4])


def _order_by_rows() -> Int[np.ndarray, "16"]:
    """Where the points of a bicubic patch stand in VTK's order, row by row, the first coordinate running first."""
    place = {powers: i for i, powers in enumerate(_list_exponents(4, 3))}
    return np.array([place[i, j] for j in range(4) for i in range(4)])


def weigh_points(size: int, degree: int, uv: Float[np.ndarray, "s 2"]) -> Float[np.ndarray, "s k"]:
    """Weights of the points of a patch, in VTK's order, at places of its face."""
    u, v = uv.T
    powers = _list_exponents(size, degree)
    if size == 3:
        scale = np.array([comb(degree, a) * comb(degree - a, b) for a, b in powers])
        return scale * np.stack([u**a * v**b * (1 - u - v) ** (degree - a - b) for a, b in powers], axis=1)
    scale = np.array([comb(degree, a) * comb(degree, b) for a, b in powers])
    terms = [u**a * (1 - u) ** (degree - a) * v**b * (1 - v) ** (degree - b) for a, b in powers]
    return scale * np.stack(terms, axis=1)


def _list_exponents(size: int, degree: int) -> list[tuple[int, int]]:
    """Of u and v in the weight of every point, in VTK's order."""
    d, inner = degree, range(1, degree)
    if size == 4:
        corners = [(0, 0), (d, 0), (d, d), (0, d)]
        sides = [*((i, 0) for i in inner), *((d, i) for i in inner), *((i, d) for i in inner), *((0, i) for i in inner)]
        return corners + sides + [(i, j) for j in inner for i in inner]
    corners = [(0, 0), (d, 0), (0, d)]
    sides = [*((i, 0) for i in inner), *((d - i, i) for i in inner), *((0, d - i) for i in inner)]
    # Up to degree 4 the points inside are one, or the corners of a triangle.
    return corners + sides + ([(1, 1)] if d == 3 else [(1, 1), (2, 1), (1, 2)])


def _list_places(size: int) -> Float[np.ndarray, "s 2"]:
    """Where the vertices of the deeper surface lie in a face, each once."""
    return np.unique(corner_uv(size, _DEEPER).reshape(-1, 2), axis=0) / 2**_DEEPER


def _take_samples(x: Float[np.ndarray, "w 3"], deeper: Int[np.ndarray, "g k"], size: int) -> Float[np.ndarray, "f s 3"]:
    """The surface at these places of every face."""
    _, first = np.unique(corner_uv(size, _DEEPER).reshape(-1, 2), axis=0, return_index=True)
    return x[deeper.reshape(-1, 4**_DEEPER * size)[:, first]]


def _fit_points(
    faces: dict[int, Int[np.ndarray, "_ _"]], samples: dict[int, Float[np.ndarray, "_ _ 3"]], degree: int
) -> tuple[Float[np.ndarray, "n 3"], dict[int, Int[np.ndarray, "_ _"]]]:
    """Control points of all patches, and those of each: at corners, along sides, inside."""
    outer = _number_outer_points(faces, degree)
    found, patches = [np.zeros((max(rows.max(initial=-1) for rows in outer.values()) + 1, 3))], {}
    n = len(found[0])
    for size, rows in outer.items():
        weights, known = weigh_points(size, degree, _list_places(size)), size
        for side in range(size):
            # The first side after the corners, and so on: its inner points weigh only where the places are on it.
            own = slice(known, known + degree - 1)
            ends = _ENDS[size][side]
            on_side = np.isclose(weights[:, [*ends, *range(own.start, own.stop)]].sum(axis=1), 1)
            on_side &= (weights[:, ends] < 1).all(axis=1)
            if side == 0:
                corner = np.argmax(weights[:, :size], axis=0)
                found[0][rows[:, :size]] = samples[size][:, corner]
            rest = samples[size][:, on_side] - weights[on_side][:, ends] @ found[0][rows[:, ends]]
            found[0][rows[:, own]] = np.linalg.pinv(weights[on_side, own]) @ rest
            known = own.stop
        around, inside = weights[:, :known], weights[:, known:]
        rest = samples[size] - around @ found[0][rows]
        found.append((np.linalg.pinv(inside) @ rest).reshape(-1, 3))
        own = n + np.arange(len(found[-1])).reshape(len(rows), inside.shape[1])
        patches[size] = np.concatenate([rows, own], axis=1)
        n += len(found[-1])
    return np.concatenate(found), patches


def _number_outer_points(faces: dict[int, Int[np.ndarray, "_ _"]], degree: int) -> dict[int, Int[np.ndarray, "_ _"]]:
    """Numbers of the points at the corners of every face and along its sides; faces share those of a common side."""
    sides, inner = half_edges(faces), degree - 1
    used, corners = np.unique(np.concatenate([faces[size].ravel() for size in (3, 4)]), return_inverse=True)
    along = len(used) + inner * sides.edge[:, None] + np.arange(inner)  # from the smaller vertex to the larger one
    along = np.where((sides.start < sides.end)[:, None], along, along[:, ::-1])
    split = faces[3].size
    found = {}
    for size, own in ((3, slice(split)), (4, slice(split, None))):
        of_sides = along[own].reshape(-1, size, inner)
        if size == 4:
            of_sides[:, 2:] = of_sides[:, 2:, ::-1]  # VTK's last two sides run against the others
        found[size] = np.concatenate([corners[own].reshape(-1, size), of_sides.reshape(-1, size * inner)], axis=1)
    return found


def _find_exact(scheme: AbstractScheme, topology: Topology, levels: int) -> Bool[np.ndarray, "f"]:
    n = {size: len(topology.faces[size]) for size in (3, 4)}
    found = {size: np.full(n[size], isinstance(scheme, BezierTriangle) and levels == 0) for size in (3, 4)}
    if topology.limit is not None and topology.limit.patches is not None:
        table = np.asarray(topology.limit.patches)
        found[table.shape[1] // 4] = table[:, 0] >= 0
    return np.concatenate([found[3], found[4]])
