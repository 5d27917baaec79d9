"""Several normals at one vertex: a control mesh cut open along its creases, and the seams that hold it together."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ._creases import Numbers, edge_rows
from ._mesh import ControlMesh, vector_areas
from ._stage import Sides, Stage, numbers, sides_of, stage_of
from .errors import MeshError, name_rows
from .half_edges import Faces
from .notices import warn


class SplitMesh(NamedTuple):
    """A control mesh with a vertex for every normal."""

    mesh: ControlMesh
    origin: Int[np.ndarray, "w"]
    """For every vertex that of the mesh before. Those come first and keep their numbers, the copies follow."""


def split_normals(mesh: ControlMesh, edges: Numbers | None = None, *, angle: float | int | None = None) -> SplitMesh:
    """Cut a mesh open along its creases, so that every side of a crease has normals of its own.

    The refined surface is as sharp along the creases as the normals say, and has no crack when the cuts are told as
    seams: `build_topology(split.mesh, scheme, levels, seams=split.origin)`. Where a crease ends inside the surface its
    last vertex stays one, with one normal. A mesh that came cut open (files have a vertex for every normal) needs no
    cutting: its `origin` is `np.unique(mesh.vertices, axis=0, return_inverse=True)[1]`.

    To differentiate in the positions that the sides share, refine `Control(shared[origin], normals)`.

    Args:
        mesh: the control mesh. Where it has normals, single vertices keep theirs; copies get those of their own side,
            by (4)-(6), and where the mesh has none `mesh.control()` computes all of them so.
        edges: `[n, 2]`, ends of the creases, in either order.
        angle: in degrees; without `edges`: every edge at which two faces are turned by more than this.

    Raises:
        MeshError: an edge that is not in the mesh.
        ValueError: neither or both of `edges` and `angle` are given.

    Warns:
        UserWarning: a crease of one edge, with both ends inside the surface: each has one normal, and nothing is sharp.
    """
    mesh.check()
    if (edges is None) == (angle is None):
        raise ValueError("say where the creases are: either by `edges`, or by `angle` in degrees.")
    stage = stage_of(len(mesh.vertices), mesh.faces, mesh.half_edges)
    sides = sides_of(stage)
    sharp = np.zeros(len(stage.edges), bool)
    if edges is None:
        sharp = _turning_angle(mesh, stage, sides) > np.radians(float(angle or 0.0))
    else:
        sharp[edge_rows(stage, np.asarray(edges, np.int64).reshape(-1, 2))] = True
    corner, origin = _split_vertices(stage, sides, sharp)
    inside = np.flatnonzero(sharp & (stage.right >= 0))
    left, right = stage.left[inside], stage.right[inside]
    joined = (corner[left] == corner[sides.next[right]]) & (corner[right] == corner[sides.next[left]])
    if joined.any():
        warn(
            f"creases {name_rows(f'({a}, {b})' for a, b in stage.edges[inside[joined]])} end inside the surface at "
            "both ends, where there is one normal: they stay smooth. A crease has two edges or more, or starts at a "
            "boundary or another crease.",
        )
    faces: Faces = {}
    first = 0
    for size, rows in sorted(mesh.faces.items()):
        faces[size] = corner[first : first + rows.size].reshape(rows.shape)
        first += rows.size
    split = ControlMesh(mesh.vertices[origin], faces)
    if mesh.normals is None:
        return SplitMesh(split, origin)
    several = np.bincount(origin)[origin] > 1
    own = np.asarray(split.control().normals, np.float64)
    return SplitMesh(ControlMesh(split.vertices, faces, np.where(several[:, None], own, mesh.normals[origin])), origin)


def _turning_angle(mesh: ControlMesh, stage: Stage, sides: Sides) -> Float[np.ndarray, "e"]:
    """Angle between the faces at every edge; 0 at a boundary."""
    normals = np.concatenate([vector_areas(mesh.vertices[rows]) for _, rows in sorted(mesh.faces.items())])
    a, b = normals[sides.face[stage.left]], normals[sides.face[stage.right]]
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ex,ex->e", a, b))
    return np.where(stage.right < 0, 0.0, angle)


def _split_vertices(
    stage: Stage, sides: Sides, sharp: Bool[np.ndarray, "e"]
) -> tuple[Int[np.ndarray, "s"], Int[np.ndarray, "w"]]:
    """The vertex of every corner once the sharp edges are cut, and the old vertex of each."""
    import scipy.sparse  # here and not above: plain refining never needs it

    n, n_sides = stage.n_vertices, len(sides.start)
    # Corners around a vertex stay together as far as no sharp edge comes between; at other vertices all of them do.
    here = np.flatnonzero((sides.around >= 0) & ~sharp[sides.edge[sides.before]])
    first = np.zeros(n, np.int64)
    first[sides.start[::-1]] = numbers(n_sides)[::-1]
    at_crease = np.zeros(n, bool)
    at_crease[stage.edges[sharp]] = True
    whole = np.flatnonzero(~at_crease[sides.start])
    pairs = np.concatenate([here, whole]), np.concatenate([sides.around[here], first[sides.start[whole]]])
    graph = scipy.sparse.coo_array((np.ones(len(pairs[0]), bool), pairs), shape=(n_sides, n_sides))
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, first_side = np.unique(part, return_index=True)
    order = np.lexsort((first_side, sides.start[first_side]))
    owner = sides.start[first_side[order]]
    copy = np.append(False, owner[1:] == owner[:-1]) if len(owner) else np.zeros(0, bool)
    label = np.empty(len(order), np.int64)
    label[order] = np.where(copy, n - 1 + np.cumsum(copy), owner)
    return label[part], np.concatenate([np.arange(n), owner[copy]])


def sew(stage: Stage, vertices: Float[np.ndarray, "v 3"], origin: Numbers) -> Stage:
    """The mesh with its seams: the pairs of boundary edges whose ends have the same origins.

    Raises:
        MeshError: `origin` is not one number a vertex; vertices of one origin do not lie at one place; more than two
            boundary edges lie on one another, or two that run the same way.
    """
    of = np.asarray(origin)
    if of.shape != (stage.n_vertices,) or not np.issubdtype(of.dtype, np.integer):
        raise MeshError(
            f"`seams` must be one whole number a vertex, [{stage.n_vertices}], equal where vertices are one place; got "
            f"{of.dtype} of shape {list(of.shape)}."
        )
    _, first, of = np.unique(of, return_index=True, return_inverse=True)
    apart = np.flatnonzero((vertices != vertices[first[of]]).any(axis=1))
    if len(apart):
        raise MeshError(
            f"vertices {name_rows(apart)} are sewn to others that lie elsewhere. Give all copies of a vertex one "
            "position: `vertices[origin]`."
        )
    outer = np.flatnonzero(stage.right < 0)
    ends = of[stage.edges[outer]]
    keys = np.sort(ends, axis=1) @ (len(first), 1)
    order = np.argsort(keys, kind="stable")
    _, start, counts = np.unique(keys[order], return_index=True, return_counts=True)
    crowded = outer[order[start[counts > 2]]]
    if len(crowded):
        raise MeshError(
            f"more than two sides meet at the seams {name_rows(f'({a}, {b})' for a, b in stage.edges[crowded])}. A "
            "surface cannot branch: leave the further sides out of the seam."
        )
    one, other = (outer[order[start[counts == 2] + i]] for i in (0, 1))
    along = (of[stage.edges[one]] == of[stage.edges[other]]).all(axis=1)
    if along.any():
        raise MeshError(
            f"the sides of the seams {name_rows(f'({a}, {b})' for a, b in stage.edges[one[along]])} are oriented "
            "oppositely. Reverse the faces of one side."
        )
    return stage._replace(seams=np.stack([one, other], axis=1).astype(np.int32)) if len(one) else stage
