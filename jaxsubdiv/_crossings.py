"""Where a surface goes through itself: edges of its triangles that pass through other triangles."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ._surface import RefinedSurface
from .extras import import_extra

_AT_ONCE = 1 << 18  # pairs of an edge and a triangle


class Crossings(NamedTuple):
    """Triangles of a surface that go through others of it.

    Attributes:
        triangles: rows of `surface.triangles()`, in ascending order.
        places: a point of each crossing, one an edge that passes through a triangle, in the unit of the vertices.
        n_triangles: of the whole surface.
    """

    triangles: Int[np.ndarray, "k"]
    places: Float[np.ndarray, "c 3"]
    n_triangles: int


def find_crossings(surface: RefinedSurface) -> Crossings:
    """Find the triangles of a surface that go through others; a quad is two triangles.

    An edge crosses a triangle that has none of its ends where its ends lie strictly on two sides and the point between
    lies inside of the triangle. Triangles that touch, or lie in one plane, do not cross. Pairs that may cross come from
    ipctk's bounding volumes, whose number grows about as that of the triangles.

    Raises:
        ImportError: ipctk, of the extra `contact`, is not installed.
    """
    ipctk = import_extra("ipctk", "contact", "searches for crossings")
    x = np.asfortranarray(np.asarray(surface.vertices, np.float64))
    triangles = np.asarray(surface.triangles())
    kept = np.flatnonzero((triangles != np.roll(triangles, 1, axis=1)).all(axis=1))  # a point or a line crosses nothing
    faces = np.asfortranarray(triangles[kept].astype(np.int32))
    if not len(faces):
        return Crossings(np.zeros(0, int), np.zeros((0, 3)), len(triangles))
    edges = np.asfortranarray(ipctk.edges(faces))
    boxes = ipctk.HashGrid()
    boxes.build(x, edges, faces)
    pairs = [(pair.edge_id, pair.face_id) for pair in boxes.detect_edge_face_candidates()]
    edge, face = np.array(pairs, int).reshape(-1, 2).T
    apart = (edges[edge][:, :, None] != faces[face][:, None, :]).all(axis=(1, 2))
    edge, face = edge[apart], face[apart]
    crosses, places = np.zeros(len(edge), bool), np.zeros((len(edge), 3))
    for some in np.array_split(np.arange(len(edge)), -(-len(edge) // _AT_ONCE) or 1):
        crosses[some], places[some] = _pass_through(x[edges[edge[some]]], x[faces[face[some]]])
    edge, face = edge[crosses], face[crosses]
    # The triangles on both sides of an edge that passes through another one.
    of_edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    keys = of_edges[:, 0].astype(np.int64) * len(x) + of_edges[:, 1]
    ends = np.sort(edges[edge], axis=1)
    beside = np.flatnonzero(np.isin(keys, ends[:, 0].astype(np.int64) * len(x) + ends[:, 1])) // 3
    return Crossings(kept[np.union1d(face, beside)], places[crosses], len(triangles))


def _pass_through(
    ends: Float[np.ndarray, "n 2 3"], corners: Float[np.ndarray, "n 3 3"]
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Whether each edge passes through its triangle, and where it meets the triangle's plane."""
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    a, b, c = (corners[:, i] for i in range(3))
    normal = np.cross(b - a, c - a)
    before, after = (np.einsum("nx,nx->n", normal, end - a) for end in (start, ends[:, 1]))
    split = before * after < 0
    share = np.where(split, before / np.where(split, before - after, 1.0), 0.0)
    place = start + share[:, None] * along
    sides = [np.einsum("nx,nx->n", normal, np.cross(q - p, place - p)) for p, q in ((a, b), (b, c), (c, a))]
    return split & (np.stack(sides) > 0).all(axis=0), place
