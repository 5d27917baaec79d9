"""Topology of the refinement: integer tables, built once in numpy, that the values then run through.

A level splits every triangle and every quad into four. Its new vertices are the edge vertices, one an edge, then the
face vertices, one a quad, both numbered after the vertices that there are: a coarser level is a prefix of a finer one.
Only the control mesh is sorted; the edges of every finer level follow from those of the coarser one by arithmetic.
"""

import operator
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int

from ._fans import Fans, as_table, group_corners, mesh_fans
from ._half_edges import Faces
from ._mesh import ControlMesh

MAX_LEVELS = 8
_MAX_INDEX = np.iinfo(np.int32).max


class Level(eqx.Module):
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


class Topology(eqx.Module):
    """Fixed tables of a refinement: integer leaves alone, so that meshes of equal sizes share one compilation."""

    levels: tuple[Level, ...]
    control_fans: Fans
    """Corners around the control vertices in the control mesh."""
    control_faces: dict[int, Int[Array, "_ _"]]
    faces: dict[int, Int[Array, "_ _"]]
    """Faces of the last level. The descendants of control face `i` of a size are the rows `i 4^L` to `(i+1) 4^L - 1`
    of that size, oriented like it."""
    mesh_normals: bool = eqx.field(static=True)
    """Whether the last level's normals are those of the refined mesh at the old vertices too."""

    @property
    def n_control_vertices(self) -> int:
        """Number of control vertices."""
        return self.control_fans.order.shape[0]


@runtime_checkable  # the tests check annotations while they run
class RecomputesNormals(Protocol):
    """What the tables need to know of a scheme."""

    @property
    def recomputes_normals(self) -> bool: ...


def build_topology(
    mesh: ControlMesh, scheme: RecomputesNormals, levels: int, *, mesh_normals: bool = False
) -> Topology:
    """Tables for refining `mesh` by `levels` levels.

    Args:
        mesh: the control mesh; only its faces and its number of vertices matter here.
        scheme: the scheme that will run on the tables: some need more of them than others.
        levels: how many splitting steps, 0 to 8; each makes four times the faces (eq. (7)).
        mesh_normals: put out, at the last level, the normals (4)-(6) of the refined mesh at every vertex, instead of
            the scheme's own. They differ only at vertices older than the last level.

    Raises:
        ValueError: `levels` is no whole number from 0 to 8, or the refined mesh would outgrow 32-bit indices.
        MeshError: the mesh was made with `check=False` and does not pass.
    """
    mesh.check()
    levels = _checked_levels(mesh, levels)
    stage = _first_stage(mesh)
    tables = []
    for i in range(levels):
        recompute = scheme.recomputes_normals or (mesh_normals and i == levels - 1)
        tables.append(_level(stage, recompute))
        stage = _split(stage)
    return Topology(
        levels=tuple(tables),
        control_fans=mesh_fans(len(mesh.vertices), mesh.half_edges),
        control_faces=jax.tree.map(as_table, mesh.faces),
        faces=jax.tree.map(as_table, stage.faces),
        mesh_normals=mesh_normals,
    )


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


class _Stage(NamedTuple):
    """One level's mesh while its tables are built. Sides are half-edges, numbered as in `_half_edges`."""

    n_vertices: int
    faces: Faces
    face_edges: dict[int, Int[np.ndarray, "_ _"]]
    """Edge that follows each corner of every face."""
    edges: Int[np.ndarray, "e 2"]
    left: Int[np.ndarray, "e"]
    """The side that runs along the edge from its first end to its second."""
    right: Int[np.ndarray, "e"]
    """The side that runs back, or -1 on a boundary."""


def _first_stage(mesh: ControlMesh) -> _Stage:
    sides = mesh.half_edges
    n_edges, numbers = len(sides.edges), _numbers(len(sides.start))
    forward = sides.start < sides.end
    left, right = np.full((2, n_edges), -1, np.int32)
    left[sides.edge[forward]] = numbers[forward]
    right[sides.edge[~forward]] = numbers[~forward]
    turned = left < 0  # a boundary edge whose only face runs against it: take it the other way round
    left, right = np.where(turned, right, left), np.where(turned, left, right)
    edges = np.where(turned[:, None], sides.edges[:, ::-1], sides.edges).astype(np.int32)
    n_triangle_sides = 3 * len(mesh.faces[3])
    face_edges = {
        3: sides.edge[:n_triangle_sides].reshape(-1, 3).astype(np.int32),
        4: sides.edge[n_triangle_sides:].reshape(-1, 4).astype(np.int32),
    }
    return _Stage(len(mesh.vertices), mesh.faces, face_edges, edges, left, right)


def _numbers(n: int) -> Int[np.ndarray, "n"]:
    """0 to n - 1 in 32 bits: the tables are bound by memory, and twice as fast to build so."""
    return np.arange(n, dtype=np.int32)


def _level(stage: _Stage, recompute: bool) -> Level:
    return Level(
        edges=stage.edges,
        wings=_wings(stage),
        quads=stage.faces[4],
        quad_edges=stage.face_edges[4],
        old_fans=_old_fans(stage) if recompute else None,
    )


def _wings(stage: _Stage) -> Int[np.ndarray, "e w"]:
    """Other neighbours of every edge vertex: the next edge vertices in a triangle, the centre of a quad."""
    n, n_edges = stage.n_vertices, len(stage.edges)
    n_quads = len(stage.faces[4])
    centres = np.repeat(n + n_edges + _numbers(n_quads), 4)
    width = 2 if len(stage.faces[3]) else 1
    sides = []
    for ahead in range(1, width + 1):
        in_triangle = n + np.roll(stage.face_edges[3], -ahead, axis=1).ravel()
        sides.append(np.concatenate([in_triangle, centres]))
    beside = np.stack(sides, axis=1)
    itself = (n + _numbers(n_edges))[:, None]
    right = np.where(stage.right[:, None] < 0, itself, beside[stage.right])
    return np.concatenate([beside[stage.left], right], axis=1)


def _split(stage: _Stage) -> _Stage:
    """The mesh of the next level. Every face keeps its place: its four children stand at `4 i` to `4 i + 3`.

    Child `c` of a face lies at corner `c` and starts there; the fourth child of a triangle is its middle. Edge `i`
    becomes `2 i` and `2 i + 1`, each running the way of its parent; then come three inner edges a triangle, from the
    edge vertex of side `c` to that of side `c - 1`, and four a quad, from the edge vertex of side `c` to the centre.
    """
    n, n_edges = stage.n_vertices, len(stage.edges)
    triangles, quads = stage.faces[3], stage.faces[4]
    n_triangles, n_quads = len(triangles), len(quads)
    first_quad_side = 12 * n_triangles

    def inner(size: int) -> Int[np.ndarray, "_ _"]:
        count = len(stage.faces[size])
        return (2 * n_edges + (3 * n_triangles if size == 4 else 0) + _numbers(size * count)).reshape(count, size)

    def back(table: Int[np.ndarray, "_ _"]) -> Int[np.ndarray, "_ _"]:
        return np.roll(table, 1, axis=1)

    def halves(size: int) -> tuple[Int[np.ndarray, "_ _"], Int[np.ndarray, "_ _"]]:
        """The half of each side's edge at the start of the side, and the half at its end."""
        edge = stage.face_edges[size]
        runs_back = stage.edges[edge, 0] != stage.faces[size]
        return 2 * edge + runs_back, 2 * edge + ~runs_back

    q3, q4 = n + stage.face_edges[3], n + stage.face_edges[4]
    centre = np.broadcast_to((n + n_edges + _numbers(n_quads))[:, None], (n_quads, 4))
    (near3, far3), (near4, far4) = halves(3), halves(4)
    inner3, inner4 = inner(3), inner(4)

    corner_children = np.stack([triangles, q3, back(q3)], axis=2)
    corner_edges = np.stack([near3, inner3, back(far3)], axis=2)
    middle_edges = np.roll(inner3, -1, axis=1)
    faces = {
        3: np.concatenate([corner_children, q3[:, None]], axis=1).reshape(-1, 3),
        4: np.stack([quads, q4, centre, back(q4)], axis=2).reshape(-1, 4),
    }
    face_edges = {
        3: np.concatenate([corner_edges, middle_edges[:, None]], axis=1).reshape(-1, 3),
        4: np.stack([near4, inner4, back(inner4), back(far4)], axis=2).reshape(-1, 4),
    }

    # The sides of the children, by corner of the parent: child `c` and which of its own sides.
    child3 = 4 * _numbers(n_triangles)[:, None] + _numbers(3)
    child4 = 4 * _numbers(n_quads)[:, None] + _numbers(4)
    middle_side = 3 * (4 * _numbers(n_triangles)[:, None] + 3) + _numbers(3)
    starts = np.concatenate([(3 * child3).ravel(), (first_quad_side + 4 * child4).ravel()])
    ends = np.concatenate(
        [(3 * np.roll(child3, -1, 1) + 2).ravel(), (first_quad_side + 4 * np.roll(child4, -1, 1) + 3).ravel()]
    )
    middle = n + _numbers(n_edges)
    no_right = stage.right < 0
    right_start, right_end = (np.where(no_right, -1, sides[stage.right]) for sides in (starts, ends))
    return _Stage(
        n_vertices=n + n_edges + n_quads,
        faces=faces,
        face_edges=face_edges,
        edges=np.concatenate(
            [
                np.stack([stage.edges[:, 0], middle, middle, stage.edges[:, 1]], axis=1).reshape(-1, 2),
                np.stack([q3, back(q3)], axis=2).reshape(-1, 2),
                np.stack([q4, centre], axis=2).reshape(-1, 2),
            ]
        ),
        left=np.concatenate(
            [
                np.stack([starts[stage.left], ends[stage.left]], axis=1).ravel(),
                (3 * child3 + 1).ravel(),
                (first_quad_side + 4 * child4 + 1).ravel(),
            ]
        ),
        right=np.concatenate(
            [
                np.stack([right_end, right_start], axis=1).ravel(),
                back(middle_side).ravel(),
                (first_quad_side + 4 * np.roll(child4, -1, 1) + 2).ravel(),
            ]
        ),
    )


def _old_fans(stage: _Stage) -> Fans:
    """Corners around the old vertices in the refined mesh: there the neighbours are edge vertices."""
    start = np.concatenate([stage.faces[size].ravel() for size in (3, 4)])
    edge = [stage.face_edges[size] for size in (3, 4)]
    after = np.concatenate([e.ravel() for e in edge])
    before = np.concatenate([np.roll(e, 1, axis=1).ravel() for e in edge])
    return group_corners(stage.n_vertices, start, stage.n_vertices + after, stage.n_vertices + before)
