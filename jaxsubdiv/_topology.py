"""Topology of the refinement: tables, built once in numpy, that the values then run through.

A primal level keeps the vertices that there are and numbers the new ones after them, the edge vertices first, one an
edge, then the face vertices: a coarser level is a prefix of a finer one. A dual level numbers all of its vertices anew.
The tables of the schemes of points and normals are integers alone; those of linear schemes hold weights too.
"""

import operator
from typing import ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from ._admissible import warn_of_folds
from ._creases import Creases, Numbers, sharpen
from ._fans import Fans, as_table, group_corners, mesh_fans
from ._masks import Masks
from ._mesh import ControlMesh
from ._seams import sew
from ._stage import Stage, numbers, stage_of
from .errors import MeshError
from .half_edges import Faces, half_edges

MAX_LEVELS = 8
_MAX_INDEX = np.iinfo(np.int32).max


class AbstractLevel(eqx.Module):
    """Tables of one splitting step, whatever the scheme."""

    edges: eqx.AbstractVar[Int[Array, "e 2"]]
    """Ends of every edge of the mesh that is split."""


class Level(AbstractLevel):
    """Tables of one splitting step, from `v` vertices, `e` edges and `q` quads to `v + e + q` vertices."""

    edges: Int[Array, "e 2"] = eqx.field(converter=as_table)
    """Ends of every edge."""
    wings: Int[Array, "e w"] = eqx.field(converter=as_table)
    """The other neighbours of every edge vertex in the refined mesh, counter-clockwise: `w/2` in the face on the left
    of the edge, `w/2` in the one on its right. With the ends they close the ring `end, left.., start, right..`.
    `w = 2` in a mesh of quads, else 4, where a quad names its centre twice. On a boundary the edge vertex itself stands
    on the right: the ring then runs through its own centre and spans the one-sided fan."""
    quads: Int[Array, "q 4"] = eqx.field(converter=as_table)
    """Corners of every quad."""
    quad_edges: Int[Array, "q 4"] = eqx.field(converter=as_table)
    """Edge that follows each corner of a quad: the row of its edge vertex among the edge vertices."""
    old_fans: Fans | None
    """Corners around the old vertices in the refined mesh; only where their normals are computed anew."""
    seams: Int[Array, "s 2"] | None = None
    """Pairs of boundary edges that are one edge of the surface: their edge vertices lie at one place."""


class MaskLevel(AbstractLevel):
    """Tables of one splitting step of a linear scheme."""

    edges: Int[Array, "e 2"] = eqx.field(converter=as_table)
    masks: Masks
    """Weights of the vertices of the next level over those of this one; where old vertices stay as they are, of the
    new ones alone."""


class LimitMasks(eqx.Module):
    """Where the vertices of the last level lie on the limit surface, and two tangents there."""

    points: Masks
    tangents: tuple[Masks, Masks] | None
    """Their cross product is the normal; None where only the position is known."""
    patches: Int[Array, "f w"] | None = None
    """Vertices whose spline is the limit over each face of the last level, -1 where there is none; see `_patches`."""


class Real(eqx.Module):
    """Which rows of a padded topology are real."""

    control_vertices: Bool[Array, "*batch v"]
    vertices: Bool[Array, "*batch w"]
    """Of the refined vertices."""
    faces: Bool[Array, "*batch f"]
    """Of the refined faces, the triangles first."""


class Topology(eqx.Module):
    """Fixed tables of a refinement: leaves alone, so that meshes of equal sizes share one compilation."""

    levels: tuple[AbstractLevel, ...]
    control_fans: Fans
    """Corners around the control vertices in the control mesh."""
    control_faces: dict[int, Int[Array, "_ _"]]
    faces: dict[int, Int[Array, "_ _"]]
    """Faces of the last level, oriented like those of the control mesh. Under the split of most schemes the descendants
    of control face `i` of a size are the rows `i 4^L` to `(i+1) 4^L - 1` of that size. Catmull-Clark's first level
    makes three quads of a triangle, which then stand before those of the quads. A dual scheme has no such order."""
    fans: Fans | None
    """Corners around the vertices of the last level, its polygons not yet cut into triangles; only where the normals
    are those of the refined mesh."""
    limit: LimitMasks | None
    """Only where they were asked for."""
    mesh_normals: bool = eqx.field(static=True)
    """Whether the last level's normals are those of the refined mesh at the old vertices too."""
    built_for: str = eqx.field(static=True)
    """`tables_for` of the scheme that the tables were built for."""
    real: Real | None = None
    """Which rows are real; None where all are. See `pad_topology`."""

    @property
    def n_control_vertices(self) -> int:
        """Number of control vertices."""
        return self.control_fans.order.shape[-1]

    @property
    def n_control_faces(self) -> int:
        """Number of control faces."""
        return sum(len(faces) for faces in self.control_faces.values())

    @property
    def tells_levels(self) -> bool:
        """Whether the tables tell the faces of every level: those of points and normals do, unless they are padded."""
        return all(isinstance(level, Level) for level in self.levels) and self.real is None

    @property
    def has_seams(self) -> bool:
        """Whether boundary edges are sewn together at some level."""
        return any(isinstance(level, Level) and level.seams is not None for level in self.levels)


@runtime_checkable  # the tests check annotations while they run
class BuildsTables(Protocol):
    """What the tables need to know of a scheme."""

    takes: ClassVar[tuple[int, ...]]
    uses_normals: ClassVar[bool]
    takes_creases: ClassVar[bool]
    takes_seams: ClassVar[bool]

    @property
    def tables_for(self) -> str: ...
    @property
    def recomputes_normals(self) -> bool: ...
    def level(self, stage: Stage, recompute: bool) -> AbstractLevel: ...
    def split(self, stage: Stage) -> Stage: ...
    def limit(self, stage: Stage) -> LimitMasks: ...


def build_topology(
    mesh: ControlMesh,
    scheme: BuildsTables,
    levels: int,
    *,
    mesh_normals: bool = False,
    creases: Creases | None = None,
    seams: Numbers | None = None,
    limit: bool = False,
) -> Topology:
    """Tables for refining `mesh` by `levels` levels.

    Args:
        mesh: the control mesh; only its faces and its number of vertices matter here.
        scheme: the scheme that will run on the tables: each has tables of its own, and some more than others.
        levels: how many splitting steps, 0 to 8; each makes four times the faces (eq. (7)).
        mesh_normals: put out, at the last level, the normals (4)-(6) of the refined mesh at every vertex, instead of
            the scheme's own. They differ only at vertices older than the last level. Linear schemes know no others.
        creases: sharp edges and vertices, for `CatmullClark` and `Loop`.
        seams: `[v]`, equal numbers for control vertices that are one place with several normals, for `Interpolating`
            and `CirclePreserving`: `origin` from `split_normals`. Boundary edges with equal ends become one edge of
            the surface, at right angles to the normals of both sides.
        limit: after the last level, move every vertex to its place on the limit surface, and put out the normals there:
            for linear schemes.

    Raises:
        ValueError: `levels` is no whole number from 0 to 8, the refined mesh would outgrow 32-bit indices, or the
            scheme knows no creases, seams or limit masks.
        MeshError: the mesh was made with `check=False` and does not pass, the scheme does not take faces of this kind,
            a crease is not an edge of the mesh, or seams do not fit the vertices.

    Warns:
        UserWarning: a normal that the mesh was given is not admissible, and the scheme keeps it; see
            `admissible_margin`.
    """
    mesh.check()
    _check_faces(mesh, scheme)
    levels = _checked_levels(mesh, levels)
    if mesh.normals is not None and scheme.uses_normals and not scheme.recomputes_normals:
        warn_of_folds(mesh)
    stage = stage_of(len(mesh.vertices), mesh.faces, mesh.half_edges)
    if creases is not None:
        if not scheme.takes_creases:
            raise ValueError(
                f"{type(scheme).__name__} has no creases; CatmullClark and Loop do. In Interpolating and "
                "CirclePreserving several normals at a vertex make one: see `split_normals`."
            )
        stage = sharpen(stage, creases)
    if seams is not None:
        if not scheme.takes_seams:
            raise ValueError(f"{type(scheme).__name__} has no seams; Interpolating and CirclePreserving do.")
        stage = sew(stage, mesh.vertices, seams)
    tables = []
    for i in range(levels):
        recompute = scheme.recomputes_normals or (mesh_normals and i == levels - 1)
        tables.append(scheme.level(stage, recompute))
        stage = scheme.split(stage)
    faces = cut_polygons(stage.faces)
    return Topology(
        levels=tuple(tables),
        control_fans=mesh_fans(len(mesh.vertices), mesh.half_edges),
        control_faces=jax.tree.map(as_table, mesh.faces),
        faces=jax.tree.map(as_table, faces),
        fans=None if scheme.uses_normals else mesh_fans(stage.n_vertices, half_edges(stage.faces)),
        limit=scheme.limit(stage) if limit else None,
        mesh_normals=mesh_normals,
        built_for=scheme.tables_for,
    )


def _check_faces(mesh: ControlMesh, scheme: BuildsTables) -> None:
    kinds = {3: "triangles", 4: "quads"}
    both = "take a scheme for both, such as Interpolating or CatmullClark"
    ways = {
        3: f"Cut the quads with `mesh.triangulate()`, or {both}.",
        4: f"Make quads of all faces first, as one level of CatmullClark does, or {both}.",
    }
    first = 0
    for size, faces in mesh.faces.items():
        if len(faces) and size not in scheme.takes:
            other = next(iter(scheme.takes))
            raise MeshError(
                f"{type(scheme).__name__} takes {kinds[other]} only, but the mesh has {len(faces)} {kinds[size]} "
                f"({mesh.name_faces(np.arange(first, first + len(faces)))}). {ways[other]}"
            )
        first += len(faces)


def cut_polygons(faces: Faces) -> Faces:
    """Faces of five and more corners as triangles around their first corner, after the triangles that there are."""
    cut = [faces[3]]
    for size in sorted(set(faces) - {3, 4}):
        rows = faces[size]
        fans = [np.stack([rows[:, 0], rows[:, i], rows[:, i + 1]], axis=1) for i in range(1, size - 1)]
        cut.append(np.stack(fans, axis=1).reshape(-1, 3))
    return {3: np.concatenate(cut), 4: faces[4]}


def _checked_levels(mesh: ControlMesh, levels: int) -> int:
    try:
        levels = operator.index(levels)
    except TypeError:
        raise ValueError(f"`levels` must be a whole number from 0 to {MAX_LEVELS}; got {levels!r}.") from None
    if not 0 <= levels <= MAX_LEVELS:
        raise ValueError(f"`levels` must lie between 0 and {MAX_LEVELS}; got {levels}.")
    largest = mesh.n_faces * 4 ** (levels + 1)  # bounds the half-edges and the vertices of the last level
    if largest > _MAX_INDEX:
        raise ValueError(
            f"{mesh.n_faces} faces refined {levels} times need indices up to {largest:,}, more than 32 bits hold. "
            "Refine fewer levels, or cut the mesh in parts."
        )
    return levels


def point_normal_level(stage: Stage, recompute: bool) -> Level:
    """Tables for a scheme of points and normals, with those around the old vertices if their normals change."""
    return Level(
        edges=stage.edges,
        wings=_wings(stage),
        quads=stage.faces[4],
        quad_edges=stage.face_edges[4],
        old_fans=_old_fans(stage) if recompute else None,
        seams=None if stage.seams is None else as_table(stage.seams),
    )


def _wings(stage: Stage) -> Int[np.ndarray, "e w"]:
    """Other neighbours of every edge vertex: the next edge vertices in a triangle, the centre of a quad."""
    n, n_edges = stage.n_vertices, len(stage.edges)
    n_quads = len(stage.faces[4])
    centres = np.repeat(n + n_edges + numbers(n_quads), 4)
    width = 2 if len(stage.faces[3]) else 1
    sides = []
    for ahead in range(1, width + 1):
        in_triangle = n + np.roll(stage.face_edges[3], -ahead, axis=1).ravel()
        sides.append(np.concatenate([in_triangle, centres]))
    beside = np.stack(sides, axis=1)
    itself = (n + numbers(n_edges))[:, None]
    right = np.where(stage.right[:, None] < 0, itself, beside[stage.right])
    return np.concatenate([beside[stage.left], right], axis=1)


def _old_fans(stage: Stage) -> Fans:
    """Corners around the old vertices in the refined mesh: there the neighbours are edge vertices."""
    start = np.concatenate([stage.faces[size].ravel() for size in (3, 4)])
    edge = [stage.face_edges[size] for size in (3, 4)]
    after = np.concatenate([e.ravel() for e in edge])
    before = np.concatenate([np.roll(e, 1, axis=1).ravel() for e in edge])
    return group_corners(stage.n_vertices, start, stage.n_vertices + after, stage.n_vertices + before)
