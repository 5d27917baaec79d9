"""Coarse even meshes from dense ones: clusters of vertices, then triangles paired to quads, then relaxed."""

import heapq
import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.spatial import KDTree

from jaxsubdiv.half_edges import Faces, half_edges

from .mesh_topology import MeshTopology, component_labels, face_topology

_SOFTENED = 10  # rounds along a rim: over some cells of the grid that it was cut on
_RELAXED = 8
_TRIES = (1.0, 1.04, 0.96, 1.1, 1.2)  # cluster counts, in parts of the wish: another one often cures a pinch
_FINER = (2, 4, 8, 16, 32)
_KEPT = 0.8  # of the clusters
_COUNT = 0.03  # a rim, or a bubble that went, leaves fewer faces: asked for once more
_AT_MOST = 1.2  # of the faces asked for


class Dense(NamedTuple):
    """A dense mesh of triangles, wound outwards."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "t 3"]

    @property
    def areas(self) -> Float[np.ndarray, "t"]:
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    def normals(self) -> Float[np.ndarray, "v 3"]:
        """Unit, at the vertices."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return _vertex_sum(np.cross(b - a, c - a), self.faces, len(self.vertices))

    def topology(self) -> MeshTopology:
        """Its parts, rims and handles."""
        return face_topology({3: self.faces, 4: np.zeros((0, 4), np.int64)})


class Coarse(NamedTuple):
    """A coarse mesh."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Faces


def _vertex_sum(values: Float[np.ndarray, "t 3"], faces: Int[np.ndarray, "t 3"], n: int) -> Float[np.ndarray, "v 3"]:
    total = np.stack([np.bincount(faces.ravel(), np.repeat(values[:, x], 3), minlength=n) for x in range(3)], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.finfo(float).tiny)


def coarsen(dense: Dense, n_triangles: int, topology: MeshTopology) -> Coarse | None:
    """About `n_triangles` even triangles of the same topology; None where they are too few to carry it."""
    euler, share = topology.euler_number, 1.0
    for factor in _TRIES:
        # Of a closed mesh F = 2 (V - euler); a rim has its vertices at half the faces.
        n_vertices = max(4, round(factor * share * (n_triangles / 2 + euler)))
        found = _cluster(dense, n_vertices)
        if share == 1.0 and abs(len(found.faces[3]) / n_triangles - factor) > _COUNT and len(found.faces[3]):
            share = min(factor * n_triangles / len(found.faces[3]), 2.0)
            n_vertices = round(share * n_vertices)
            found = _cluster(dense, n_vertices)
        if _is_whole(found, n_vertices, topology):
            return found
    for finer in _FINER:
        # Deep folds lie closer than a cluster is wide: smaller ones keep the sheets apart, and are merged with care.
        n_vertices = round(finer * max(n_triangles / 2 + euler, n_triangles / 4))
        found = _cluster(dense, n_vertices)
        if _is_whole(found, n_vertices, topology):
            break
    else:
        return None
    found = _collapse(found, n_triangles)
    return found if len(found.faces[3]) <= _AT_MOST * n_triangles else None


def _is_whole(found: Coarse, n_vertices: int, topology: MeshTopology) -> bool:
    """Whether it is a manifold of that topology, of hardly fewer vertices than asked for: a sheet that clusters of both
    of its sides share falls apart, and the rest may be of the same topology."""
    if len(found.vertices) < _KEPT * n_vertices or not _is_manifold(found):
        return False
    return face_topology(found.faces) == topology


def _cluster(dense: Dense, n_vertices: int) -> Coarse:
    """One vertex for each of `n_vertices` clusters of equal area. Valette & Chassery 2004, by pyacvd."""
    import pyacvd

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyacvd 0.4 uses a name that pyvista 0.49 deprecates: nothing a caller can do
        clustering = pyacvd.Clustering(_polydata(dense))
        clustering.cluster(n_vertices)
    cluster = np.asarray(clustering.clusters)
    # Dense faces between three clusters, as they are wound; the library itself leaves a few faces the wrong way round.
    # Where two such faces close on each other, a cluster has no more than two neighbours: both faces go, and it goes.
    corners = cluster[dense.faces]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    _, first, times = np.unique(np.sort(corners, axis=1), axis=0, return_index=True, return_counts=True)
    corners = corners[np.sort(first[times == 1])]
    weights = clustering.area
    total = np.bincount(cluster, weights)
    centres = np.stack([np.bincount(cluster, weights * dense.vertices[:, x]) / total for x in range(3)], axis=1)
    return _largest_part(_compact(centres, corners))


def _collapse(mesh: Coarse, n_triangles: int) -> Coarse:
    """Edges collapsed one by one to their middle, the shortest first; none that would change the topology.

    The link condition: the ends have no neighbours in common but the corners opposite of the edge (Dey et al. 1999).
    """
    x = list(mesh.vertices)
    faces: dict[int, tuple[int, int, int]] = {i: (a, b, c) for i, (a, b, c) in enumerate(mesh.faces[3].tolist())}
    around: list[set[int]] = [set() for _ in x]
    for i, face in faces.items():
        for v in face:
            around[v].add(i)
    sides = half_edges(mesh.faces)
    rim = np.zeros(len(x), bool)
    rim[sides.edges[np.bincount(sides.edge) == 1]] = True
    heap = [(float(np.sum((x[a] - x[b]) ** 2)), a, b) for a, b in sides.edges.tolist()]
    heapq.heapify(heap)
    while heap and len(faces) > n_triangles:
        length, a, b = heapq.heappop(heap)
        both = around[a] & around[b]
        if not both or length != float(np.sum((x[a] - x[b]) ** 2)):
            continue  # gone, or longer than it was
        near_a, near_b = ({v for i in around[k] for v in faces[i]} for k in (a, b))
        if len((near_a & near_b) - {a, b}) != len(both) or len(near_a | near_b) < 6:
            continue
        if rim[a] and rim[b] and len(both) == 2:
            continue  # a chord from rim to rim
        place = x[a] if rim[a] and not rim[b] else x[b] if rim[b] and not rim[a] else (x[a] + x[b]) / 2
        stay = (around[a] | around[b]) - both
        if any(_turns_over(x, faces[i], (a, b), place) for i in stay):
            continue
        for i in both:
            for v in faces.pop(i):
                around[v].discard(i)
        for i in around[b]:
            p, q, r = (a if v == b else v for v in faces[i])
            faces[i] = (p, q, r)
        around[a] |= around[b]
        around[b] = set()
        x[a], rim[a] = place, rim[a] or rim[b]
        for v in {v for i in around[a] for v in faces[i]} - {a}:
            heapq.heappush(heap, (float(np.sum((x[a] - x[v]) ** 2)), a, v))
    return _compact(np.array(x), np.array(list(faces.values())))


def _turns_over(
    x: list[Float[np.ndarray, "3"]],
    face: tuple[int, int, int],
    moved: tuple[int, int],
    place: Float[np.ndarray, "3"],
) -> bool:
    """Whether the face turns by more than about 80 degrees, or becomes a sliver."""
    before = [x[v] for v in face]
    after = [place if v in moved else x[v] for v in face]
    old, new = (np.cross(c[1] - c[0], c[2] - c[0]) for c in (before, after))
    longest = max(float(np.sum((after[i] - after[i - 1]) ** 2)) for i in range(3))
    size = float(np.sqrt(new @ new))
    return bool(old @ new < 0.2 * np.sqrt(old @ old) * size or size < 0.1 * longest)


def _largest_part(mesh: Coarse) -> Coarse:
    """The part with the most faces, where parts that touch in a vertex alone are two.

    A bubble on a neck that is narrower than a cluster ends like that.
    """
    triangles = mesh.faces[3]
    if len(triangles) == 0:
        return mesh
    sides = half_edges(mesh.faces)
    order = np.argsort(sides.edge, kind="stable")
    twice = np.flatnonzero(np.bincount(sides.edge) == 2)
    at = np.searchsorted(sides.edge[order], twice)
    one, two = order[at], order[at + 1]
    part = component_labels(np.stack([sides.face[one], sides.face[two]], axis=1), len(triangles))
    triangles = triangles[part == np.bincount(part).argmax()]
    return _compact(mesh.vertices, triangles)


def _polydata(dense: Dense):
    import pyvista

    faces = np.insert(dense.faces, 0, 3, axis=1).ravel()
    return pyvista.PolyData(dense.vertices.astype(np.float64), faces)


def _compact(vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Coarse:
    used, at = np.unique(triangles, return_inverse=True)
    quads = np.zeros((0, 4), np.int64)
    return Coarse(vertices[used], {3: at.reshape(-1, 3).astype(np.int64), 4: quads})


def _is_manifold(mesh: Coarse) -> bool:
    """Two faces at most at an edge, wound alike, and one fan of faces at every vertex."""
    sides = half_edges(mesh.faces)
    if len(sides.start) == 0:
        return False
    n = len(mesh.vertices)
    if len(np.unique(sides.start.astype(np.int64) * n + sides.end)) < len(sides.start):
        return False
    counts = np.bincount(sides.edge)
    rim = np.bincount(sides.start[counts[sides.edge] == 1], minlength=n)
    # Corners at a vertex, less the pairs that its inner edges join: the number of its fans, where none is a ring.
    inner = np.bincount(sides.edges[counts == 2].ravel(), minlength=n)
    corners = np.bincount(sides.start, minlength=n)
    return bool((counts <= 2).all() and (rim <= 1).all() and ((corners - inner) == rim).all() and not _is_pinched(mesh))


def _is_pinched(mesh: Coarse) -> bool:
    """Whether two rings of faces touch in a vertex: its neighbours then fall into two cycles."""
    sides = half_edges(mesh.faces)
    order = np.argsort(sides.start, kind="stable")
    after = {}
    for v, a, b in zip(
        sides.start[order].tolist(), sides.end[order].tolist(), sides.before[order].tolist(), strict=True
    ):
        after.setdefault(v, {})[a] = b
    for ring in after.values():
        start = next((a for a in ring if a not in ring.values()), next(iter(ring)))
        seen, at = 0, start
        while at in ring and seen <= len(ring):
            at, seen = ring[at], seen + 1
            if at == start:
                break
        if seen != len(ring):
            return True
    return False


# -------------------------------------------------------------------------------------------------------------- quads


def pair_triangles(mesh: Coarse) -> Coarse:
    """Triangles paired to quads, as square as they can be; those that stay over, on an open mesh alone, stay triangles.

    A closed mesh of triangles can always be paired without a rest (Petersen 1891), by a matching of the largest weight.
    """
    import rustworkx

    triangles = mesh.faces[3]
    sides = half_edges(mesh.faces)
    order = np.argsort(sides.edge, kind="stable")
    twice = np.flatnonzero(np.bincount(sides.edge) == 2)
    at = np.searchsorted(sides.edge[order], twice)
    one, two = order[at], order[at + 1]
    # Side a -> b with apex c, and its twin with apex d: the quad c a d b.
    quads = np.stack([sides.before[one], sides.start[one], sides.before[two], sides.end[one]], axis=1)
    weight = np.round(1000 * _squareness(mesh, quads)).astype(int) + 1
    # A vertex that would keep two faces only is no corner of anything.
    valence = np.bincount(sides.edges.ravel(), minlength=len(mesh.vertices))
    weight[(valence[quads[:, 1]] <= 4) | (valence[quads[:, 3]] <= 4)] //= 4
    graph = rustworkx.PyGraph()
    graph.add_nodes_from(range(len(triangles)))
    graph.add_edges_from(list(zip(sides.face[one].tolist(), sides.face[two].tolist(), range(len(quads)), strict=True)))
    pairs = rustworkx.max_weight_matching(graph, max_cardinality=True, weight_fn=lambda row: int(weight[row]))
    chosen = np.array(sorted(graph.get_edge_data(a, b) for a, b in pairs), dtype=int)
    left = np.ones(len(triangles), bool)
    left[sides.face[one[chosen]]] = left[sides.face[two[chosen]]] = False
    return _merge_doublets(Coarse(mesh.vertices, {3: triangles[left], 4: quads[chosen]}))


def _squareness(mesh: Coarse, quads: Int[np.ndarray, "q 4"]) -> Float[np.ndarray, "q"]:
    """1 for a square, 0 where a corner is flat or turned in."""
    x = mesh.vertices[quads]
    ahead, back = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    cosine = np.einsum("qcx,qcx->qc", ahead, back)
    cosine = cosine / (np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2))
    normal = np.cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])
    turn = np.einsum("qcx,qx->qc", np.cross(ahead, back), normal)
    worst = np.abs(np.degrees(np.arccos(np.clip(cosine, -1, 1))) - 90).max(axis=1)
    return np.where((turn > 0).all(axis=1), np.clip(1 - worst / 90, 0, 1), 0)


def _merge_doublets(mesh: Coarse) -> Coarse:
    """Two quads that share both sides at a vertex become the one around it."""
    quads = [tuple(row) for row in mesh.faces[4].tolist()]
    while True:
        sides = half_edges({3: mesh.faces[3], 4: np.array(quads, np.int64).reshape(-1, 4)})
        n = len(mesh.vertices)
        rim = np.zeros(n, bool)
        rim[sides.edges[np.bincount(sides.edge) == 1]] = True
        in_triangles = np.isin(np.arange(n), mesh.faces[3])
        doublets = np.flatnonzero((np.bincount(sides.start, minlength=n) == 2) & ~rim & ~in_triangles)
        if not len(doublets):
            break
        vertex = int(doublets[0])
        one, two = (row for row in quads if vertex in row)
        first, second = (row[row.index(vertex) :] + row[: row.index(vertex)] for row in (one, two))
        joined = (first[1], first[2], first[3], second[2])
        if len(set(joined)) < 4:
            break
        quads = [row for row in quads if row not in (one, two)] + [joined]
    faces = {3: mesh.faces[3], 4: np.array(quads, np.int64).reshape(-1, 4)}
    used = np.unique(np.concatenate([rows.ravel() for rows in faces.values()]))
    return Coarse(mesh.vertices[used], {size: np.searchsorted(used, rows) for size, rows in faces.items()})


# ---------------------------------------------------------------------------------------------------------- relaxation


def relax(mesh: Coarse, dense: Dense, rounds: int = _RELAXED) -> Coarse:
    """Vertices moved along the dense surface to the middle of their neighbours; those of a rim along the rim."""
    sides = half_edges(mesh.faces)
    n = len(mesh.vertices)
    rim = sides.edges[np.bincount(sides.edge) == 1]
    on_rim = np.zeros(n, bool)
    on_rim[rim] = True
    inner, along = averages(sides.edges, n), averages(rim, n)
    normals, tree = dense.normals(), KDTree(dense.vertices)
    dense_rim = _smooth_rim(dense) if on_rim.any() else np.zeros((0, 3))
    edge_of_rim = KDTree(dense_rim) if len(dense_rim) else None
    x = mesh.vertices.copy()
    for _ in range(rounds):
        moved = np.where(on_rim[:, None], x + 0.5 * (along @ x - x), x + 0.5 * (inner @ x - x))
        x = _move_onto(moved, dense.vertices, normals, tree)
        if edge_of_rim is not None:
            x[on_rim] = dense_rim[edge_of_rim.query(moved[on_rim])[1]]
    return Coarse(x, mesh.faces)


def _smooth_rim(dense: Dense) -> Float[np.ndarray, "r 3"]:
    """The dense rim without the steps of its grid."""
    sides = half_edges({3: dense.faces, 4: np.zeros((0, 4), np.int64)})
    rim = sides.edges[np.bincount(sides.edge) == 1]
    used, at = np.unique(rim, return_inverse=True)
    along = averages(at.reshape(-1, 2), len(used))
    x = dense.vertices[used]
    for _ in range(_SOFTENED):
        x = x + 0.5 * (along @ x - x)
    return x


def _move_onto(
    x: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], tree: KDTree
) -> Float[np.ndarray, "n 3"]:
    row = tree.query(x)[1]
    return x - np.einsum("nx,nx->n", x - vertices[row], normals[row])[:, None] * normals[row]


def averages(edges: Int[np.ndarray, "e 2"], n: int) -> csr_matrix:
    """Takes rows of the vertices to the means of those that edges tie them to."""
    both = np.concatenate([edges, edges[:, ::-1]]).T
    matrix = coo_matrix((np.ones(both.shape[1]), (both[0], both[1])), shape=(n, n)).tocsr()
    count = np.maximum(np.asarray(matrix.sum(axis=1)).ravel(), 1)
    return csr_matrix(matrix.multiply(1 / count[:, None]))
