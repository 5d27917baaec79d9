"""One level's mesh while its tables are built, and how it splits. numpy only.

Only the control mesh is sorted; the edges of every finer level follow from those of the coarser one by arithmetic.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .half_edges import Faces, HalfEdges, half_edges

INFINITE = 10.0
"""Sharpness that refinement does not wear off, as in OpenSubdiv."""


class Stage(NamedTuple):
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
    level: int
    """How many splits lie behind it."""
    edge_sharpness: Float[np.ndarray, "e"] | None = None
    """Of every edge, 0 where it is smooth; None where no edge is a crease."""
    vertex_sharpness: Float[np.ndarray, "v"] | None = None
    """Likewise for the vertices."""
    seams: Int[np.ndarray, "s 2"] | None = None
    """Pairs of boundary edges, which run opposite ways, that are one edge of the surface; None where there are none."""


def stage_of(n_vertices: int, faces: Faces, sides: HalfEdges | None = None, level: int = 0) -> Stage:
    """A mesh with its edges found by sorting."""
    sides = half_edges(faces) if sides is None else sides
    n_edges, side = len(sides.edges), numbers(len(sides.start))
    forward = sides.start < sides.end
    left, right = np.full((2, n_edges), -1, np.int32)
    left[sides.edge[forward]] = side[forward]
    right[sides.edge[~forward]] = side[~forward]
    turned = left < 0  # a boundary edge whose only face runs against it: take it the other way round
    left, right = np.where(turned, right, left), np.where(turned, left, right)
    edges = np.where(turned[:, None], sides.edges[:, ::-1], sides.edges).astype(np.int32)
    face_edges, first = {}, 0
    for size in sorted(faces):
        n_sides = size * len(faces[size])
        face_edges[size] = sides.edge[first : first + n_sides].reshape(-1, size).astype(np.int32)
        first += n_sides
    return Stage(n_vertices, faces, face_edges, edges, left, right, level)


class Sides(NamedTuple):
    """What lies beside every side of a mesh, for the rules that walk around it."""

    start: Int[np.ndarray, "s"]
    next: Int[np.ndarray, "s"]
    """The side that follows in the same face."""
    before: Int[np.ndarray, "s"]
    """The side before it in the same face."""
    twin: Int[np.ndarray, "s"]
    """The side of the other face that runs back along the same edge, or -1 on a boundary."""
    edge: Int[np.ndarray, "s"]
    face: Int[np.ndarray, "s"]
    size: Int[np.ndarray, "s"]
    """Number of corners of the side's face."""

    @property
    def end(self) -> Int[np.ndarray, "s"]:
        """Where every side ends."""
        return self.start[self.next]

    @property
    def around(self) -> Int[np.ndarray, "s"]:
        """The side that leaves the same vertex next, counter-clockwise; -1 where there is a boundary between."""
        return self.twin[self.before]


def sides_of(stage: Stage) -> Sides:
    """Neighbours of the sides of a mesh."""
    start, ahead, before, edge, size, first = [], [], [], [], [], 0
    for corners, faces in sorted(stage.faces.items()):
        side = first + numbers(faces.size).reshape(-1, corners)
        start.append(faces.ravel())
        ahead.append(np.roll(side, -1, axis=1).ravel())
        before.append(np.roll(side, 1, axis=1).ravel())
        edge.append(stage.face_edges[corners].ravel())
        size.append(np.full(faces.size, corners))
        first += faces.size
    sizes = np.concatenate(size)
    n_faces = sum(map(len, stage.faces.values()))
    per_face = np.concatenate([np.full(len(faces), corners) for corners, faces in sorted(stage.faces.items())])
    twin = np.full(first, -1, np.int32)
    twin[stage.left] = stage.right
    inner = stage.right >= 0
    twin[stage.right[inner]] = stage.left[inner]
    return Sides(
        np.concatenate(start),
        np.concatenate(ahead),
        np.concatenate(before),
        twin,
        np.concatenate(edge),
        np.repeat(numbers(n_faces), per_face),
        sizes,
    )


def numbers(n: int) -> Int[np.ndarray, "n"]:
    """0 to n - 1 in 32 bits: the tables are bound by memory, and twice as fast to build so."""
    return np.arange(n, dtype=np.int32)


def hybrid_split(stage: Stage) -> Stage:
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
        return (2 * n_edges + (3 * n_triangles if size == 4 else 0) + numbers(size * count)).reshape(count, size)

    def shift_back(table: Int[np.ndarray, "_ _"]) -> Int[np.ndarray, "_ _"]:
        return np.roll(table, 1, axis=1)

    def halves(size: int) -> tuple[Int[np.ndarray, "_ _"], Int[np.ndarray, "_ _"]]:
        """The half of each side's edge at the start of the side, and the half at its end."""
        edge = stage.face_edges[size]
        runs_back = stage.edges[edge, 0] != stage.faces[size]
        return 2 * edge + runs_back, 2 * edge + ~runs_back

    q3, q4 = n + stage.face_edges[3], n + stage.face_edges[4]
    centre = np.broadcast_to((n + n_edges + numbers(n_quads))[:, None], (n_quads, 4))
    (near3, far3), (near4, far4) = halves(3), halves(4)
    inner3, inner4 = inner(3), inner(4)

    corner_children = np.stack([triangles, q3, shift_back(q3)], axis=2)
    corner_edges = np.stack([near3, inner3, shift_back(far3)], axis=2)
    middle_edges = np.roll(inner3, -1, axis=1)
    faces = {
        3: np.concatenate([corner_children, q3[:, None]], axis=1).reshape(-1, 3),
        4: np.stack([quads, q4, centre, shift_back(q4)], axis=2).reshape(-1, 4),
    }
    face_edges = {
        3: np.concatenate([corner_edges, middle_edges[:, None]], axis=1).reshape(-1, 3),
        4: np.stack([near4, inner4, shift_back(inner4), shift_back(far4)], axis=2).reshape(-1, 4),
    }

    # The sides of the children, by corner of the parent: child `c` and which of its own sides.
    child3 = 4 * numbers(n_triangles)[:, None] + numbers(3)
    child4 = 4 * numbers(n_quads)[:, None] + numbers(4)
    middle_side = 3 * (4 * numbers(n_triangles)[:, None] + 3) + numbers(3)
    starts = np.concatenate([(3 * child3).ravel(), (first_quad_side + 4 * child4).ravel()])
    ends = np.concatenate(
        [(3 * np.roll(child3, -1, 1) + 2).ravel(), (first_quad_side + 4 * np.roll(child4, -1, 1) + 3).ravel()]
    )
    middle = n + numbers(n_edges)
    no_right = stage.right < 0
    right_start, right_end = (np.where(no_right, -1, sides[stage.right]) for sides in (starts, ends))
    return Stage(
        n_vertices=n + n_edges + n_quads,
        faces=faces,
        face_edges=face_edges,
        edges=np.concatenate(
            [
                np.stack([stage.edges[:, 0], middle, middle, stage.edges[:, 1]], axis=1).reshape(-1, 2),
                np.stack([q3, shift_back(q3)], axis=2).reshape(-1, 2),
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
                shift_back(middle_side).ravel(),
                (first_quad_side + 4 * np.roll(child4, -1, 1) + 2).ravel(),
            ]
        ),
        level=stage.level + 1,
        edge_sharpness=_wear(stage.edge_sharpness, 2, 2 * n_edges + 3 * n_triangles + 4 * n_quads),
        vertex_sharpness=_wear(stage.vertex_sharpness, 1, n + n_edges + n_quads),
        seams=_halve(stage.seams),
    )


def _halve(seams: Int[np.ndarray, "s 2"] | None) -> Int[np.ndarray, "t 2"] | None:
    """Seams of the next level: the first half of one edge lies on the second half of the other."""
    return None if seams is None else np.concatenate([2 * seams + (0, 1), 2 * seams + (1, 0)]).astype(np.int32)


def _wear(sharpness: Float[np.ndarray, "n"] | None, children: int, total: int) -> Float[np.ndarray, "m"] | None:
    """Sharpness of the children, one less than their parent's; what is new beside them is smooth.

    Source: DeRose, Kass & Truong, Subdivision surfaces in character animation, 1998, the uniform rule.
    """
    if sharpness is None:
        return None
    worn = np.zeros(total)
    worn[: children * len(sharpness)] = np.repeat(wear(sharpness), children)
    return worn


def wear(sharpness: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """What one level leaves of a sharpness."""
    return np.where(sharpness >= INFINITE, INFINITE, np.maximum(sharpness - 1, 0))


def quad_split(stage: Stage) -> Stage:
    """Every face into one quad a corner: around a vertex in its middle.

    The quads of a face stand together, in the order of its corners; the faces in theirs, triangles first. Quads alone
    are split by arithmetic; what else there is at the first level is sorted once more.
    """
    if not sum(len(faces) for size, faces in stage.faces.items() if size != 4):
        return hybrid_split(stage)
    n, n_edges = stage.n_vertices, len(stage.edges)
    quads, first_centre = [], n + n_edges
    for size, faces in sorted(stage.faces.items()):
        after = n + stage.face_edges[size]
        centre = np.broadcast_to((first_centre + numbers(len(faces)))[:, None], faces.shape)
        quads.append(np.stack([faces, after, centre, np.roll(after, 1, axis=1)], axis=2).reshape(-1, 4))
        first_centre += len(faces)
    split = stage_of(first_centre, {3: np.zeros((0, 3), np.int32), 4: np.concatenate(quads)}, level=stage.level + 1)
    edge_sharpness = None
    if stage.edge_sharpness is not None:
        parent = split.edges.max(axis=1) - n  # an edge of a parent joins an old vertex to an edge vertex
        halves = (split.edges.min(axis=1) < n) & (parent < n_edges)
        worn = wear(stage.edge_sharpness)
        edge_sharpness = np.where(halves, worn[np.where(halves, parent, 0)], 0.0)
    return split._replace(
        edge_sharpness=edge_sharpness, vertex_sharpness=_wear(stage.vertex_sharpness, 1, first_centre)
    )


def ring_positions(sides: Sides) -> Int[np.ndarray, "s"]:
    """Place of every side among those that leave the same vertex, counter-clockwise: on a boundary from the boundary
    side on, else from the side of the smallest number."""
    n = len(sides.start)
    first = np.full(int(sides.start.max(initial=-1)) + 1, n)
    np.minimum.at(first, sides.start, numbers(n))
    on_boundary = np.zeros(len(first), bool)
    on_boundary[sides.start[sides.twin < 0]] = True
    heads = np.concatenate([np.flatnonzero(sides.twin < 0), first[~on_boundary & (first < n)]])
    position, at, step, around = np.zeros(n, np.int32), heads, 0, sides.around
    while len(heads):
        position[at] = step
        at, step = around[at], step + 1
        further = (at >= 0) & (at != heads)
        heads, at = heads[further], at[further]
    return position


def dual_split(stage: Stage) -> Stage:
    """A vertex a corner of every face, in the order of the sides, then two a boundary edge, one near each end.

    Faces: one a face, then a quad an edge, then one a vertex, each kind of size together. A vertex that has but two
    corners gets no face. At a boundary the faces of its edges and vertices end in the edges' own new vertices. A vertex
    that two fans of faces share comes apart.
    """
    sides, n_sides = sides_of(stage), sum(faces.size for faces in stage.faces.values())
    outer = np.flatnonzero(stage.right < 0)
    near = np.full(n_sides, -1)  # of a boundary side: the new vertex near its start; the one near its end follows
    near[stage.left[outer]] = n_sides + 2 * np.arange(len(outer))
    by_size: dict[int, list[np.ndarray]] = {3: [], 4: []}
    first = 0
    for size, faces in sorted(stage.faces.items()):
        by_size.setdefault(size, []).append(first + np.arange(faces.size).reshape(-1, size))
        first += faces.size
    left, right = stage.left, stage.right
    ends = np.where(right < 0, (near[left], near[left] + 1), (sides.next[right], right))
    by_size[4].append(np.stack([sides.next[left], left, *ends], axis=1))

    position, around = ring_positions(sides), sides.around
    # Chains of corners around a vertex: closed ones, and open ones that end in the boundary's own vertices.
    heads = np.flatnonzero(position == 0)
    chains, at = [heads], around[heads]
    alive = (at >= 0) & (at != heads)
    while alive.any():
        chains.append(np.where(alive, at, -1))
        at = np.where(alive, around[at], at)
        alive = alive & (at >= 0) & (at != heads)
    rows = np.stack(chains, axis=1)
    opens = sides.twin[heads] < 0
    lengths = (rows >= 0).sum(axis=1)
    for length in np.unique(lengths):
        for is_open in (False, True):
            some = rows[(lengths == length) & (opens == is_open)][:, :length]
            if is_open:
                last = sides.before[some[:, -1]]
                some = np.concatenate([near[some[:, :1]], some, near[last][:, None] + 1], axis=1)
            if len(some) and some.shape[1] > 2:
                by_size.setdefault(some.shape[1], []).append(some)
    faces = {
        size: np.concatenate(rows).astype(np.int32) if rows else np.zeros((0, size), np.int32)
        for size, rows in sorted(by_size.items())
    }
    return stage_of(n_sides + 2 * len(outer), faces, level=stage.level + 1)
