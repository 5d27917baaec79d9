"""The inside of closed surfaces as tetrahedra, for finite elements, made by fTetWild."""

import os
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from . import notices
from ._crossings import find_crossings
from ._distance import closest_on_mesh
from ._io import Surface
from ._io._vtu import TETRAHEDRON, write_grid
from ._regions import Regions
from ._surface import RefinedSurface
from ._tetrahedron_quality import TetrahedronQuality, measure_shapes, measure_tetrahedra
from ._tetwild import run_tetwild
from .extras import import_extra
from .half_edges import half_edges

_EDGE, _TOLERANCE = 1 / 20, 1e-3  # of the diagonal of the bounding box, fTetWild's own
_POINTS_AT_ONCE = 64


class Tetrahedra(NamedTuple):
    """The inside of surfaces.

    Attributes:
        points: in the unit of the surfaces.
        cells: corners of the tetrahedra: the first three turn counter-clockwise seen from the fourth, as VTK, meshio
            and scikit-fem have them.
        regions: of the tetrahedra, named by the surfaces.
        quality: measured.
    """

    points: Float[np.ndarray, "n 3"]
    cells: Int[np.ndarray, "m 4"]
    regions: Regions
    quality: TetrahedronQuality

    def summarise(self) -> str:
        """What a command prints: counts, regions, quality."""
        names, counts = self.regions.names, self.regions.counts()
        of_regions = ", ".join(f"{name} {count:,}" for name, count in zip(names, counts.tolist(), strict=True))
        quality = str(self.quality).replace("\n", "\n         ")
        return (
            f"tetra    {len(self.cells):,} tetrahedra of {len(self.points):,} points: {of_regions}\n         {quality}"
        )


def fill_with_tetrahedra(
    surfaces: Surface | Mapping[str, Surface],
    *,
    edge: float | int | None = None,
    tolerance: float | int | None = None,
    cavities: Sequence[str] = (),
) -> Tetrahedra:
    """Fill closed surfaces with tetrahedra, for finite elements.

    Surfaces that lie in one another bound regions: a tetrahedron belongs to the innermost surface around it, and
    neighbouring regions share their points. The boundary of the tetrahedra is near the surface, not on its vertices:
    fTetWild remeshes it within the tolerance. No two runs give the same tetrahedra.

    Args:
        surfaces: a closed surface, or several by name. The faces of each point outwards; a part of a surface that
            points inwards bounds a cavity of it.
        edge: length of edge to aim at, in the unit of the surfaces; default: a twentieth of the diagonal of the
            bounding box.
        tolerance: how far the boundary may lie from the surfaces, in their unit; default: a thousandth of the diagonal.
        cavities: names of surfaces whose inside stays empty.

    Raises:
        ValueError: a surface is open, its faces point inwards, numbers are not finite or positive, a cavity lies in no
            surface that is filled, or nothing is left inside.
        ImportError: pytetwild or ipctk, of the extra `simulation`, is not installed.
        RuntimeError: fTetWild failed.

    Warns:
        UserWarning: surfaces go through themselves or one another, so that what is inside is in doubt; or some
            tetrahedra are inverted.

    Source: Y. Hu, T. Schneider, B. Wang, D. Zorin & D. Panozzo, Fast tetrahedral meshing in the wild, 2020.
    """
    import_extra("pytetwild", "simulation", "tetrahedra")
    named = dict(surfaces) if isinstance(surfaces, Mapping) else {"solid": surfaces}
    unknown = [name for name in cavities if name not in named]
    if unknown or not named or not set(named) - set(cavities):
        raise ValueError(
            f"`cavities`: {', '.join(map(repr, unknown or cavities))} of the surfaces {', '.join(map(repr, named))}. "
            "A cavity is one of the surfaces, and another one lies around it."
        )
    meshes = [_Triangles(name, surface) for name, surface in named.items()]
    x = np.concatenate([mesh.x for mesh in meshes])
    diagonal = float(np.linalg.norm(np.ptp(x, axis=0)))
    edge = _check_length("edge", edge, _EDGE * diagonal)
    tolerance = _check_length("tolerance", tolerance, _TOLERANCE * diagonal)
    nesting = _Nesting(meshes, np.array([mesh.name in cavities for mesh in meshes]))
    before = np.cumsum([0, *(len(mesh.x) for mesh in meshes)])
    rows = [first + mesh.turn(mesh.name in cavities) for first, mesh in zip(before, meshes, strict=False)]
    triangles = np.concatenate(rows)
    _warn_of_crossings(x, triangles)
    points, cells = run_tetwild(x, triangles, edge, tolerance / diagonal)
    owner = nesting.find_owners(points[cells].mean(axis=1))
    filled = ~nesting.is_cavity[owner]
    used, corners = np.unique(cells[filled], return_inverse=True)
    points, cells, owner = points[used], corners.reshape(-1, 4), owner[filled]
    if not len(cells):
        raise ValueError(
            "nothing is inside of the surfaces: are there parts that point inwards, or is `edge` too long?"
        )
    row = np.cumsum(~nesting.is_cavity) - 1
    regions = Regions(row[owner], tuple(mesh.name for mesh in meshes if mesh.name not in cavities))
    quality = measure_tetrahedra(points, cells, regions, x, triangles, nesting.measure_volume())
    if quality.n_inverted:
        notices.warn(f"{quality.n_inverted} of {len(cells)} tetrahedra are inverted: a calculation on them would fail.")
    return Tetrahedra(points, cells, regions, quality)


def write_tetrahedra(path: str | os.PathLike[str], tetrahedra: Tetrahedra) -> None:
    """Write tetrahedra to a VTU file, which ParaView, meshio and so the usual programs for finite elements read.

    Every tetrahedron has `region`, a number from 1 up, `scaled_jacobian`, and `smallest_angle` in degrees. The field
    data have the number of every region by its name. Points are in double precision.

    Raises:
        MeshError: the file has another suffix than .vtu.
        FileNotFoundError: its folder is not there.
        ImportError: pyvista, of the extras `io` and `simulation`, is not installed.
    """
    angles, jacobians, _ = measure_shapes(tetrahedra.points, tetrahedra.cells)
    data = {"region": tetrahedra.regions.rows + 1, "scaled_jacobian": jacobians, "smallest_angle": angles}
    numbers = {name: i + 1 for i, name in enumerate(tetrahedra.regions.names)}
    write_grid(path, tetrahedra.points, [(TETRAHEDRON, tetrahedra.cells)], data, numbers)


class _Triangles:
    """A closed surface whose faces point outwards, as triangles."""

    def __init__(self, name: str, surface: Surface):
        faces = {size: np.asarray(surface.faces.get(size, np.zeros((0, size), int)), np.int64) for size in (3, 4)}
        quads = faces[4]
        corners = np.concatenate([faces[3], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        used, corners = np.unique(corners, return_inverse=True)
        self.name, self.x = name, np.asarray(surface.vertices, np.float64)[used]
        self.triangles = corners.reshape(-1, 3)
        if not len(corners) or not np.isfinite(self.x).all():
            raise ValueError(f"the surface '{name}' has no faces, or vertices that are not finite.")
        sides = half_edges({3: self.triangles})
        n_open = int(np.sum(np.bincount(sides.edge, minlength=len(sides.edges)) != 2))
        if n_open:
            raise ValueError(
                f"the surface '{name}' has no inside: {n_open} of its edges have one face, or more than two. Close its "
                "openings first, or fit a closed control mesh (`closed=True`)."
            )
        a, b, c = (self.x[self.triangles[:, i]] - self.x.mean(axis=0) for i in range(3))
        self.volume = float(np.einsum("tx,tx->", a, np.cross(b, c)) / 6)
        if self.volume <= 0:
            raise ValueError(f"the faces of the surface '{name}' point inwards: turn them, `faces[:, ::-1]`.")

    def turn(self, inwards: bool) -> Int[np.ndarray, "t 3"]:
        return self.triangles[:, ::-1] if inwards else self.triangles

    def encloses(self, points: Float[np.ndarray, "p 3"]) -> np.ndarray:
        """Which points are inside: around these the surface winds once."""
        blocks = -(-len(points) // _POINTS_AT_ONCE)
        padded = np.pad(points, ((0, blocks * _POINTS_AT_ONCE - len(points)), (0, 0)), mode="edge")
        middle = self.x.mean(axis=0)  # single precision is enough once the origin is near
        corners = jnp.asarray(self.x[self.triangles] - middle, jnp.float32)
        blocked = jnp.asarray((padded - middle).reshape(blocks, _POINTS_AT_ONCE, 3), jnp.float32)
        return np.asarray(_count_windings(corners, blocked)).reshape(-1)[: len(points)] > 0.5


@jax.jit
def _count_windings(corners: Float[Array, "t 3 3"], points: Float[Array, "b p 3"]) -> Float[Array, "b p"]:
    """How often triangles wind around points. Source: A. Van Oosterom & J. Strackee, 1983, eq. (8)."""

    def of_block(block: Float[Array, "p 3"]) -> Float[Array, "p"]:
        a, b, c = (corners[None, :, i] - block[:, None] for i in range(3))
        dot, size = partial(jnp.einsum, "ptx,ptx->pt"), partial(jnp.linalg.norm, axis=2)
        a_size, b_size, c_size = size(a), size(b), size(c)
        over = dot(a, jnp.cross(b, c))
        under = a_size * b_size * c_size + dot(a, b) * c_size + dot(b, c) * a_size + dot(c, a) * b_size
        return jnp.sum(jnp.arctan2(over, under), axis=1) / jnp.asarray(2 * np.pi, over.dtype)

    return jax.lax.map(of_block, points)


class _Nesting:
    """Which surfaces lie in one another, and which of them stay empty.

    Attributes:
        meshes: the surfaces.
        is_cavity: of each whether its inside stays empty.
        parents: of each the smallest surface around it; -1 where there is none.

    Raises:
        ValueError: a cavity lies in no surface that is filled.
    """

    def __init__(self, meshes: Sequence[_Triangles], is_cavity: Bool[np.ndarray, "k"]):
        self.meshes, self.is_cavity = meshes, is_cavity
        self.parents = np.array([self._find_parent(mesh) for mesh in meshes])
        for mesh, cavity, parent in zip(meshes, is_cavity, self.parents, strict=True):
            if cavity and (parent < 0 or is_cavity[parent]):
                around = "no surface" if parent < 0 else f"the cavity '{meshes[parent].name}'"
                raise ValueError(
                    f"the cavity '{mesh.name}' lies in {around}. A cavity lies in a surface that is filled: leave it "
                    "out, or see that all surfaces have the same unit and place."
                )

    def _find_parent(self, mesh: _Triangles) -> int:
        some = mesh.x[:: -(-len(mesh.x) // _POINTS_AT_ONCE)]
        around = [
            (other.volume, i)
            for i, other in enumerate(self.meshes)
            if other.volume > mesh.volume and other.encloses(some).mean() > 0.5
        ]
        return min(around)[1] if around else -1

    def find_owners(self, middles: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
        """Of every tetrahedron that fTetWild keeps the innermost surface around its middle.

        fTetWild keeps what more surfaces than cavities lie around, so in nested surfaces some of a cavity, too. It
        moves boundaries within the tolerance: a middle that it would not have kept belongs to the nearest surface, and
        beside a cavity to what lies around that.
        """
        if np.sum(~self.is_cavity) == 1:
            return np.full(len(middles), np.flatnonzero(~self.is_cavity)[0])
        around = np.stack([mesh.encloses(middles) for mesh in self.meshes])
        owner = np.full(len(middles), -1)
        for i in np.argsort([-mesh.volume for mesh in self.meshes]):
            owner[around[i]] = i
        balance = np.where(self.is_cavity, -1, 1) @ around
        moved = (owner < 0) | (self.is_cavity[owner] & (balance <= 0))
        if moved.any():
            away = [closest_on_mesh(middles[moved], mesh.x[mesh.triangles])[0] for mesh in self.meshes]
            nearest = np.argmin(away, axis=0)
            owner[moved] = np.where(self.is_cavity, self.parents, np.arange(len(self.meshes)))[nearest]
        return owner

    def measure_volume(self) -> float:
        """Of what is filled."""
        filled = np.append(~self.is_cavity, False)  # the last one: outside of all
        return float(
            sum(
                mesh.volume * (int(filled[i]) - int(filled[parent]))
                for i, (mesh, parent) in enumerate(zip(self.meshes, self.parents, strict=True))
            )
        )


def _check_length(name: str, value: float | int | None, usual: float) -> float:
    value = usual if value is None else float(value)
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"`{name}` must be a positive length in the unit of the surface; got {value}.")
    return value


def _warn_of_crossings(x: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> None:
    faces = {3: jnp.asarray(triangles, jnp.int32), 4: jnp.zeros((0, 4), jnp.int32)}
    crossings = find_crossings(RefinedSurface(jnp.asarray(x), jnp.zeros_like(jnp.asarray(x)), faces))
    if len(crossings.triangles):
        where = ", ".join(f"{value:.4g}" for value in crossings.places[0])
        notices.warn(
            f"{len(crossings.triangles)} of {len(triangles)} triangles go through others, first at ({where}): what is "
            "inside is in doubt there. Look at the tetrahedra, or mend the surfaces first."
        )
