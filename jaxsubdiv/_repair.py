"""Mending a control mesh, one step after another; each says in a sentence what it did. Loads trimesh.

What a vertex or a face becomes is decided for all rows at once. Only edges with more than two faces, of which a mesh
has few, are looked at one by one.
"""

from collections.abc import Callable, Iterator
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from trimesh.graph import connected_component_labels
from trimesh.grouping import unique_rows

from ._mesh import ControlMesh, check_counts, vector_areas, zero_area
from .errors import MeshError
from .half_edges import Faces, HalfEdges, half_edges

# Doubled vertices of files in single precision differ by 6e-8 of their coordinates where they differ at all, but most
# are exact copies; this is far under the smallest feature and spares vertices that are close on purpose.
_MERGE_WITHIN = 1e-8

# A closed component whose volume is under this part of its area to the power 3/2 has no inside to speak of.
_HOLLOW = 1e-9

_MOST_PASSES = 8  # a mesh that was split is repaired until nothing changes: two or three passes


def repair(mesh: ControlMesh, merge_within: float | None) -> ControlMesh:
    """What `ControlMesh.repair` says.

    Vertices and faces keep their order. A vertex vanishes only where it was merged into an earlier one or is not
    finite; copies made by splitting come last, as among the triangles do those that were quads with a repeated corner.
    """
    check_counts(mesh)
    found, was_split = _repair_once(mesh, merge_within)
    for _ in range(_MOST_PASSES):
        if not was_split:
            break
        # Sheets that were turned after the split may fit one another now.
        again, was_split = _repair_once(found, merge_within)
        if not again.repairs:
            break
        notes = found.repairs + again.repairs
        found = ControlMesh(again.vertices, again.faces, again.normals, repairs=notes, regions=again.regions)
    return found


def _repair_once(mesh: ControlMesh, merge_within: float | None) -> tuple[ControlMesh, bool]:
    """The mesh after one pass, and whether sheets were split."""
    work = _Work(mesh)
    _merge_doubled(work, merge_within)
    _drop_not_finite(work)
    _drop_degenerate(work)
    _drop_repeated(work)
    was_split = _split_crowded_edges(work)
    reversed_faces = _orient(work)
    normals = None if mesh.normals is None else _mend_normals(work, _take_normals(work, mesh.normals), reversed_faces)
    # Vertices doubled on purpose, to part two solids that touch, were merged and split into the same rows again.
    notes = () if _is_unchanged(work, normals) else work.notes
    regions = None if mesh.regions is None else mesh.regions.take(work.origins)
    return ControlMesh(work.vertices, work.faces, normals, repairs=notes, regions=regions), was_split


class _Work:
    """The faces of a mesh under repair, where they and their corners come from, and what was done to them."""

    def __init__(self, mesh: ControlMesh):
        self.input = mesh
        self.faces: Faces = dict(mesh.faces)
        self.sources: Faces = dict(mesh.faces)  # for every corner its vertex in the input
        self.origins = np.arange(mesh.n_faces)  # for every face its row in the input
        self.rows = np.arange(len(mesh.vertices))  # for every vertex its row in the input
        self.notes: list[str] = []

    @property
    def vertices(self) -> Float[np.ndarray, "v 3"]:
        return self.input.vertices[self.rows]

    @property
    def corners(self) -> Int[np.ndarray, "s"]:
        """The corners of all faces in a row, numbered as half-edges are."""
        return _flatten(self.faces)

    def set_corners(self, corners: Int[np.ndarray, "s"]) -> None:
        triangles, quads = np.split(corners, [self.faces[3].size])
        self.faces = {3: triangles.reshape(-1, 3), 4: quads.reshape(-1, 4)}

    def split_by_size(self, rows: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """One value a face, parted into those of the triangles and those of the quads."""
        return zip((3, 4), np.split(rows, [len(self.faces[3])]), strict=True)

    def take_vertices(self, order: Int[np.ndarray, "n"]) -> None:
        """Make these the vertices; those left out are used by no face."""
        place = np.zeros(len(self.rows), int)
        place[order] = np.arange(len(order))
        self.set_corners(place[self.corners])
        self.rows = self.rows[order]

    def drop_faces(self, bad: Bool[np.ndarray, "f"], which: str, after: str = "") -> None:
        """Drop faces and note it: `which` follows the word "faces", `after` ends the sentence."""
        if not bad.any():
            return
        if bad.all():
            raise MeshError(f"nothing is left of the mesh: its repair drops the last {_count(bad, 'face')}, {which}.")
        self.sources = {size: self.sources[size][~part] for size, part in self.split_by_size(bad)}
        self.faces = {size: self.faces[size][~part] for size, part in self.split_by_size(bad)}
        self.origins = self.origins[~bad]
        self.notes.append(f"Dropped {_count(bad, 'face')} {which}{after}.")


def _flatten(faces: Faces) -> Int[np.ndarray, "s"]:
    return np.concatenate([faces[3].ravel(), faces[4].ravel()])


def _count(flags: np.ndarray | np.integer | int, one: str, more: str | None = None) -> str:
    n = int(np.sum(flags))
    return f"{n} {one if n == 1 else more or one + 's'}"


def _is_unchanged(work: _Work, normals: Float[np.ndarray, "v 3"] | None) -> bool:
    before, after = work.input, (work.vertices, work.faces[3], work.faces[4])
    same = map(np.array_equal, (before.vertices, before.faces[3], before.faces[4]), after)
    return all(same) and (before.normals is None or normals is None or np.array_equal(before.normals, normals))


# ------------------------------------------------------------------------------------------ doubled vertices, bad faces


def _merge_doubled(work: _Work, within: float | None) -> None:
    """Merge vertices in use that are close, or linked by a chain of close ones, into the first of them."""
    if within is not None and not 0 <= within < np.inf:
        raise MeshError(f"`merge_within` must be a length, zero or more; got {within}.")
    used = np.unique(work.corners)
    used = used[_is_finite(work.vertices[used])]
    if len(used) == 0:
        return
    at = work.vertices[used]
    if within is None:
        within = _MERGE_WITHIN * float(np.linalg.norm(np.ptp(at, axis=0)))
    # Exact copies first: a thousand of them would be half a million close pairs.
    distinct, place = np.unique(at, axis=0, return_inverse=True)
    pairs = KDTree(distinct).query_pairs(within, output_type="ndarray")
    label = connected_component_labels(pairs, node_count=len(distinct))[place.ravel()]
    _, first, group = np.unique(label, return_index=True, return_inverse=True)
    into = np.arange(len(work.rows))
    into[used] = used[first[group]]
    merged = into != np.arange(len(into))
    if merged.any():
        work.set_corners(into[work.corners])
        work.take_vertices(np.flatnonzero(~merged))
        which = _count(merged, "doubled vertex", "doubled vertices")
        work.notes.append(f"Merged {which} into others no further than {within:.3g} away.")


def _is_finite(rows: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    return np.asarray(np.isfinite(rows).all(axis=1))


def _drop_not_finite(work: _Work) -> None:
    bad = ~_is_finite(work.vertices)
    if bad.any():
        work.notes.append(f"Dropped {_count(bad, 'vertex', 'vertices')} whose coordinates are not finite.")
        in_face = np.concatenate([bad[work.faces[size]].any(axis=1) for size in (3, 4)])
        work.drop_faces(in_face, "with a corner that is not finite", _count_opened(work, in_face))
        work.take_vertices(np.flatnonzero(~bad))


def _drop_degenerate(work: _Work) -> None:
    """Make triangles of quads with a repeated corner, and drop faces of fewer than three corners or without area."""
    _shrink_quads(work)
    distinct = np.concatenate([_distinct_corners(work.faces[size]) for size in (3, 4)])
    work.drop_faces(distinct < 3, "with fewer than three distinct corners")
    flat = zero_area(work.vertices, work.faces)
    work.drop_faces(flat, "without area", _count_opened(work, flat))


def _shrink_quads(work: _Work) -> None:
    quads = work.faces[4]
    repeats = quads == np.roll(quads, -1, axis=1)
    shrink = (repeats.sum(axis=1) == 1) & (_distinct_corners(quads) == 3)
    if shrink.any():
        (_, of_triangles), (_, of_quads) = work.split_by_size(work.origins)
        work.origins = np.concatenate([of_triangles, of_quads[shrink], of_quads[~shrink]])
        work.faces, work.sources = (
            {
                3: np.concatenate([faces[3], faces[4][shrink][~repeats[shrink]].reshape(-1, 3)]),
                4: faces[4][~shrink],
            }
            for faces in (work.faces, work.sources)
        )
        work.notes.append(f"Made {_count(shrink, 'triangle')} of quads with a repeated corner.")


def _distinct_corners(faces: Int[np.ndarray, "f k"]) -> Int[np.ndarray, "f"]:
    return 1 + (np.diff(np.sort(faces, axis=1), axis=1) != 0).sum(axis=1)


def _count_opened(work: _Work, dropped: Bool[np.ndarray, "f"]) -> str:
    """Says how many edges lose one of their two faces, if any."""
    sides = half_edges(work.faces)
    gone = np.bincount(sides.edge, weights=dropped[sides.face])
    left = np.bincount(sides.edge) - gone
    # A folded quad has two sides on one edge; where both go, an open edge was open before.
    opened = (left == 1) & (gone % 2 == 1)
    return _describe_opened(opened)


def _describe_opened(opened: np.ndarray | np.integer) -> str:
    return f", which opened {_count(opened, 'boundary edge')}" if np.any(opened) else ""


def _drop_repeated(work: _Work) -> None:
    repeated = []
    for size in (3, 4):
        again = np.ones(len(work.faces[size]), bool)
        again[unique_rows(np.sort(work.faces[size], axis=1))[0]] = False
        repeated.append(again)
    work.drop_faces(np.concatenate(repeated), "with the same corners as an earlier one")


# ------------------------------------------------------------------------------------------------------------ splitting


def _split_crowded_edges(work: _Work) -> bool:
    """Give sheets that meet in an edge of more than two faces their own vertices there; returns whether any do.

    The faces at such an edge are paired into sheets. A fan is a set of corners at one vertex that are joined through
    edges, across paired faces only.
    """
    sides = half_edges(work.faces)
    counts = np.bincount(sides.edge)
    crowded = counts > 2
    if not crowded.any():
        return False
    corners = _make_corner_lookup(work.vertices, work.faces)
    at_edges = np.split(_find_sides(sides, crowded), np.cumsum(counts[crowded])[:-1])
    after = _find_next_corners(work.faces)
    given, sound = _given_edges(_flatten(work.sources), after)
    signs = np.ones(len(work.origins), int) if sound else _signs(work, sides)[0]
    sheets = [_pair_up(corners, sides, signs, given, at) for at in at_edges]
    fans = _fans(sides, after, sheets)
    _detach_sheets(fans, after, sides, sheets)
    at_crowded = crowded[sides.edge]
    at_crowded[after] |= at_crowded.copy()  # the corner where a side ends is at its edge as well
    n_copied = _copy_fans(work, fans, at_crowded)
    opened = np.sum(np.bincount(half_edges(work.faces).edge) == 1) - np.sum(counts == 1)
    work.notes.append(
        f"Split the surface at {_count(crowded, 'edge')} with more than two faces: copied "
        f"{_count(n_copied, 'vertex', 'vertices')}{_describe_opened(opened)}."
    )
    return True


def _copy_fans(work: _Work, fans: Int[np.ndarray, "s"], at_crowded: Bool[np.ndarray, "s"]) -> int:
    """Copy the vertex for every fan at a crowded edge but the first of the vertex; returns the number of copies.

    Fans elsewhere, as those of a vertex where two cones touch, share theirs as before. In the order of the vertices a
    copy takes the place that its first corner's vertex had in the input, so that solids which only touch come back
    as they were; further copies of one vertex come last.
    """
    _, first, fans = np.unique(fans, return_index=True, return_inverse=True)
    vertex = work.corners[first].astype(int)
    touching = np.flatnonzero(np.bincount(fans, weights=at_crowded))
    touching = touching[np.argsort(first[touching])]
    copied = np.delete(touching, np.unique(vertex[touching], return_index=True)[1])
    # The merged position and not the one before merging, which could leave a face without area.
    work.rows = np.concatenate([work.rows, work.rows[vertex[copied]]])
    vertex[copied] = len(work.rows) - len(copied) + np.arange(len(copied))
    work.set_corners(vertex[fans])
    places = work.rows.copy()
    places[vertex[touching]] = _flatten(work.sources)[first[touching]]
    further = np.ones(len(places), bool)
    further[np.unique(places, return_index=True)[1]] = False
    work.take_vertices(np.lexsort((places, further)))
    return len(copied)


def _make_corner_lookup(vertices: Float[np.ndarray, "v 3"], faces: Faces) -> Callable[[int], Float[np.ndarray, "k 3"]]:
    """Positions of the corners of the face in a row."""
    n_triangles = len(faces[3])
    return lambda row: vertices[faces[3][row] if row < n_triangles else faces[4][row - n_triangles]]


def _find_sides(sides: HalfEdges, chosen: Bool[np.ndarray, "e"]) -> Int[np.ndarray, "n"]:
    """The half-edges on the chosen edges, edge by edge."""
    rows = np.flatnonzero(chosen[sides.edge])
    return rows[np.argsort(sides.edge[rows], kind="stable")]


def _pairs_of_sides(sides: HalfEdges) -> Int[np.ndarray, "n 2"]:
    """The two half-edges on every edge of two faces."""
    return _find_sides(sides, np.bincount(sides.edge) == 2).reshape(-1, 2)


def _given_edges(sources: Int[np.ndarray, "s"], after: Int[np.ndarray, "s"]) -> tuple[Int[np.ndarray, "s"], bool]:
    """For every half-edge the label of its edge in the input, and whether the faces there were joined and agreed.

    They do in a mesh that was split before: its sheets, which a merge brings together, are the same again.
    """
    ends = np.stack([sources, sources[after]], axis=1)
    _, edge, counts = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    agree = len(np.unique(ends, axis=0)) == len(ends)
    return edge.ravel(), agree and bool(counts.max() == 2)


def _pair_up(
    corners_of: Callable[[int], Float[np.ndarray, "k 3"]],
    sides: HalfEdges,
    signs: Int[np.ndarray, "f"],
    given: Int[np.ndarray, "s"],
    at: Int[np.ndarray, "n"],
) -> list[tuple[int, ...]]:
    """Sheets that pass through one edge, one or two half-edges each.

    Faces belong together where they agree on their outside: those first that shared an edge of the input; then the
    flatter their fold the better, and of equal folds the convex one, so that solids that touch in an edge come apart.
    """
    corners = [corners_of(face) for face in sides.face[at]]
    signs = signs[sides.face[at]]
    normal = _unit(np.concatenate([vector_areas(c[None]) for c in corners])) * signs[:, None]
    middle = np.stack([c.mean(axis=0) for c in corners])
    forward = (sides.start[at] < sides.end[at]) == (signs > 0)
    fold = np.round(np.arccos(np.clip(normal @ normal.T, -1, 1)), 6)
    fitting = [(i, j) for i, j in combinations(range(len(at)), 2) if forward[i] != forward[j]]
    joined = given[at]
    fitting.sort(
        key=lambda ij: (joined[ij[0]] != joined[ij[1]], fold[ij], normal[ij[0]] @ (middle[ij[1]] - middle[ij[0]]) > 0)
    )
    sheets, single = [], set(range(len(at)))
    for pair in fitting:
        if single.issuperset(pair):
            single.difference_update(pair)
            sheets.append(tuple(int(at[i]) for i in pair))
    return sheets + [(int(at[i]),) for i in sorted(single)]


def _find_next_corners(faces: Faces) -> Int[np.ndarray, "s"]:
    """For every corner the next one of its face."""
    triangles, quads = np.split(np.arange(faces[3].size + faces[4].size), [faces[3].size])
    return np.concatenate([np.roll(f, -1, axis=1).ravel() for f in (triangles.reshape(-1, 3), quads.reshape(-1, 4))])


def _fans(sides: HalfEdges, after: Int[np.ndarray, "s"], sheets: list[list[tuple[int, ...]]]) -> Int[np.ndarray, "s"]:
    """For every corner the label of its fan."""
    paired = [sheet for edge in sheets for sheet in edge if len(sheet) == 2]
    a, b = np.concatenate([_pairs_of_sides(sides), np.array(paired, dtype=int).reshape(-1, 2)]).T
    same_way = sides.start[a] == sides.start[b]
    links = np.concatenate(
        [
            np.stack([a, np.where(same_way, b, after[b])], axis=1),
            np.stack([after[a], np.where(same_way, after[b], b)], axis=1),
        ]
    )
    return connected_component_labels(links, node_count=len(after)).astype(int)


def _detach_sheets(
    fans: Int[np.ndarray, "s"], after: Int[np.ndarray, "s"], sides: HalfEdges, sheets: list[list[tuple[int, ...]]]
) -> None:
    """Where two sheets of an edge share the fans at both its ends, cut the faces of one of them off; in place.

    That happens where the crease is so short that the sheets are joined around its ends.
    """
    joined, new = fans.copy(), len(fans)
    for edge in sheets:
        seen = set()
        for sheet in edge:
            corners = np.array([[s, after[s]] for s in sheet])
            swap = sides.start[corners[:, 0]] > sides.end[corners[:, 0]]
            corners[swap] = corners[swap, ::-1]
            ends = tuple(joined[corners[0]])
            if ends in seen:
                fans[corners] = new, new + 1
                new += 2
            seen.add(ends)


# ---------------------------------------------------------------------------------------------------------- orientation


def _orient(work: _Work) -> Bool[np.ndarray, "f"]:
    """Orient neighbours alike and closed components outwards; returns which faces were reversed."""
    signs, part = _signs(work, half_edges(work.faces))
    reverse = signs < 0
    whole = (np.bincount(part, weights=reverse) == np.bincount(part))[part]
    n_parts = len(np.unique(part[whole]))
    if (reverse & ~whole).any():
        work.notes.append(f"Reversed {_count(reverse & ~whole, 'face')} to agree with the rest of the surface.")
    if n_parts:
        work.notes.append(f"Turned {_count(n_parts, 'closed component')} ({_count(whole, 'face')}) outwards.")
    for size, backwards in work.split_by_size(reverse):
        for faces in (work.faces, work.sources):
            turned = faces[size].copy()
            turned[backwards] = np.roll(turned[backwards, ::-1], 1, axis=1)  # the first corner stays the first
            faces[size] = turned
    return reverse


def _signs(work: _Work, sides: HalfEdges) -> tuple[Int[np.ndarray, "f"], Int[np.ndarray, "f"]]:
    """-1 for faces to reverse, and the component of every face; components are joined by edges of two faces.

    A component without open edges is turned outwards, another keeps the orientation of the greater part of its area.
    """
    signs, part = _agreeing_signs(work, sides)
    vertices = work.vertices - work.vertices.mean(axis=0)  # so that rounding does not swamp the volume
    areas = np.concatenate([vector_areas(vertices[work.faces[size]]) for size in (3, 4)])
    middles = np.concatenate([vertices[work.faces[size]].mean(axis=1) for size in (3, 4)])
    size = np.linalg.norm(areas, axis=1)
    volume = np.bincount(part, signs * np.einsum("fx,fx->f", middles, areas)) / 3
    total, votes = np.bincount(part, size), np.bincount(part, signs * size)
    decides = np.where(_is_closed(part, sides) & (np.abs(volume) > _HOLLOW * total**1.5), volume, votes)
    first = np.unique(part, return_index=True)[1]
    decides = np.where(np.abs(decides) > 0, decides, signs[first])
    return np.where(decides[part] < 0, -signs, signs), part


def _agreeing_signs(work: _Work, sides: HalfEdges) -> tuple[Int[np.ndarray, "f"], Int[np.ndarray, "f"]]:
    """Signs that make neighbours agree, one of the two choices for every component, and the components.

    Every face stands for two nodes of a graph, one for each of its orientations, `n` rows apart. Neighbours are linked
    where they agree, so that a surface of two sides falls into two parts and one of one side does not.
    """
    n = len(work.origins)
    pairs = _pairs_of_sides(sides)
    left, right = sides.face[pairs].T
    agree = sides.start[pairs[:, 0]] != sides.start[pairs[:, 1]]
    ups = np.stack([left, np.where(agree, right, right + n)], axis=1)
    downs = np.stack([left + n, np.where(agree, right + n, right)], axis=1)
    up, down = connected_component_labels(np.concatenate([ups, downs]), node_count=2 * n).reshape(2, n).astype(int)
    if (up == down).any():
        raise MeshError(
            f"{work.input.name_faces(work.origins[up == down])} cannot be oriented alike: they form a surface of one "
            "side, such as a Moebius band, which has no outside. Cut it open along a row of edges."
        )
    part = np.unique(np.minimum(up, down), return_inverse=True)[1]
    return np.where(up < down, 1, -1), part


def _is_closed(part: Int[np.ndarray, "f"], sides: HalfEdges) -> Bool[np.ndarray, "_"]:
    """For every component whether each of its edges has an even number of its faces."""
    keys = part[sides.face].astype(np.int64) * len(sides.edges) + sides.edge
    keys, counts = np.unique(keys, return_counts=True)
    return np.bincount(keys // len(sides.edges), weights=counts % 2) == 0


# -------------------------------------------------------------------------------------------------------------- normals


def _take_normals(work: _Work, given: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "v 3"]:
    """Every vertex's normal in the input. Where several were merged and differ, the unit mean of those that are finite.

    NaN where nothing is left of that mean. Counted are the vertices whose faces came along.
    """
    normals = given[work.rows]
    pairs = np.unique(np.stack([work.corners, _flatten(work.sources)], axis=1), axis=0)
    vertex, values = pairs[:, 0], given[pairs[:, 1]]
    used, first = np.unique(vertex, return_index=True)
    normals[used] = values[first]
    differ = np.unique(vertex[(values != normals[vertex]).any(axis=1)])
    counted = np.isin(vertex, differ) & _is_finite(values)
    total = np.zeros_like(normals)
    np.add.at(total, vertex[counted], _unit(values[counted]))
    remains = np.linalg.norm(total[differ], axis=1, keepdims=True) > 1e-6
    normals[differ] = np.where(remains, _unit(total[differ]), np.nan)
    return normals


def _mend_normals(
    work: _Work, normals: Float[np.ndarray, "v 3"], reversed_faces: Bool[np.ndarray, "f"]
) -> Float[np.ndarray, "v 3"]:
    """Compute normals that are not finite from the faces, and reverse those that reversed faces left pointing inwards.

    A normal is reversed where at least one face of its vertex was and it points against the sum of all of them: it had
    gone with the faces that were wrong. One that already pointed along the new orientation stays.
    """
    vertices = work.vertices
    total = np.zeros_like(vertices)
    touched = np.zeros(len(total), bool)
    for size, part in work.split_by_size(reversed_faces):
        faces = work.faces[size]
        np.add.at(total, faces, vector_areas(vertices[faces])[:, None])
        touched[faces[part]] = True
    bad = ~_is_finite(normals)
    normals = np.where(bad[:, None], _unit(total), normals)
    against = touched & ~bad & (np.einsum("vx,vx->v", normals, total) < 0)
    if bad.any():
        work.notes.append(f"Computed {_count(bad, 'normal')} from the faces: not finite, or opposed when merged.")
    if against.any():
        work.notes.append(f"Reversed {_count(against, 'normal')} along with the faces.")
    return np.where(against[:, None], -normals, normals)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Rows of unit length; zero where they are zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
