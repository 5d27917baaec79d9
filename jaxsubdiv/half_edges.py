"""Half-edges: who is beside whom in a mesh of triangles and quads. numpy only.

A half-edge is one side of one face, and runs counter-clockwise around it. Half-edges are numbered triangle by triangle,
corner by corner, then quad by quad: side `c` of triangle `f` is `3 f + c`, side `c` of quad `f` is `3 t + 4 f + c`.
Side `c` starts at corner `c`. Faces are numbered likewise: the triangles first, then the quads. Inside a dual
refinement there are larger polygons too; they follow by size.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

Faces = dict[int, Int[np.ndarray, "_ _"]]
"""Polygon size (3 and 4, both always present) -> corners of the faces of that size, counter-clockwise."""


class HalfEdges(NamedTuple):
    """Ends, edge and face of every half-edge."""

    start: Int[np.ndarray, "s"]
    end: Int[np.ndarray, "s"]
    before: Int[np.ndarray, "s"]
    """The corner before `start` in the same face."""
    face: Int[np.ndarray, "s"]
    edge: Int[np.ndarray, "s"]
    edges: Int[np.ndarray, "e 2"]
    """Ends of every edge, the smaller vertex first; edges sorted."""


def half_edges(faces: Faces) -> HalfEdges:
    """Half-edges of a mesh, and the edges that they lie on. The only place that sorts."""
    start = _find_corners(faces, 0)
    end = _find_corners(faces, 1)
    before = _find_corners(faces, -1)
    sizes = np.concatenate([np.full(len(faces[size]), size) for size in sorted(faces)])
    face = np.repeat(np.arange(len(sizes)), sizes)
    low, high = np.minimum(start, end).astype(np.int64), np.maximum(start, end).astype(np.int64)
    stride = int(high.max(initial=0)) + 1
    keys, edge = np.unique(low * stride + high, return_inverse=True)
    return HalfEdges(start, end, before, face, edge, np.stack(np.divmod(keys, stride), axis=1))


def _find_corners(faces: Faces, ahead: int) -> Int[np.ndarray, "s"]:
    """For every half-edge the corner that lies `ahead` of its start."""
    return np.concatenate([np.roll(faces[size], -ahead, axis=1).ravel() for size in sorted(faces)])
