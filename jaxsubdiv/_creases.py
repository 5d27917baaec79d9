"""Semi-sharp creases of a control mesh, for the schemes that know them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Int
from numpy.typing import ArrayLike

from ._stage import INFINITE, Stage
from .errors import MeshError, name_rows

Numbers: TypeAlias = ArrayLike | Sequence[Any] | float | int
"""What numpy makes an array of; the checks of annotations in the tests take no plain `ArrayLike` for that."""


@dataclass(frozen=True)
class Creases:
    """Sharp edges and vertices of a control mesh. What is not named is smooth.

    A sharpness of s is sharp for s levels and smooth after that; between whole numbers the two rules are blended, and
    from 10 on it is sharp for ever. Ends of a single sharp edge stay smooth (darts), two make a crease, three a corner.

    Args:
        edges: `[n, 2]`, ends of every sharp edge, in either order.
        sharpness: of these edges, one for all or one each.
        vertices: `[m]`, sharp vertices.
        vertex_sharpness: of these vertices, one for all or one each.

    Source: DeRose, Kass & Truong, Subdivision surfaces in character animation, 1998, in the form that OpenSubdiv gives
    it (Sdc, creasing method "uniform").
    """

    edges: Numbers = ()
    sharpness: Numbers = INFINITE
    vertices: Numbers = ()
    vertex_sharpness: Numbers = INFINITE


def sharpen(stage: Stage, creases: Creases) -> Stage:
    """The mesh with its creases.

    Raises:
        MeshError: an edge or a vertex that is not in the mesh, or a sharpness that is negative or not one each.
    """
    edges, vertices = np.asarray(creases.edges, np.int64).reshape(-1, 2), np.asarray(creases.vertices, np.int64).ravel()
    stride = stage.n_vertices
    at = edge_rows(stage, edges)
    outside = vertices[(vertices < 0) | (vertices >= stride)]
    if len(outside):
        raise MeshError(f"sharp vertices {name_rows(outside)} are not in the mesh, which has {stride} vertices.")
    edge_sharpness, vertex_sharpness = np.zeros(len(stage.edges)), np.zeros(stride)
    edge_sharpness[at] = _values("sharpness", creases.sharpness, len(edges))
    vertex_sharpness[vertices] = _values("vertex_sharpness", creases.vertex_sharpness, len(vertices))
    return stage._replace(edge_sharpness=edge_sharpness, vertex_sharpness=vertex_sharpness)


def edge_rows(stage: Stage, edges: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
    """Which edges of the mesh these are, given by their ends in either order; `MeshError` where there is none."""
    stride = stage.n_vertices
    keys = np.sort(stage.edges, axis=1).astype(np.int64) @ (stride, 1)
    order = np.argsort(keys)
    wanted = np.sort(edges, axis=1) @ (stride, 1)
    at = order[np.searchsorted(keys[order], wanted).clip(max=len(keys) - 1)]
    missing = (keys[at] != wanted) | ((edges < 0) | (edges >= stride)).any(axis=1)
    if missing.any():
        raise MeshError(f"creases {name_rows(f'({a}, {b})' for a, b in edges[missing])} are not edges of the mesh.")
    return at


def _values(name: str, values: Numbers, n: int) -> np.ndarray:
    rows = np.asarray(values, np.float64)
    if rows.ndim > 1 or (rows.ndim == 1 and len(rows) != n):
        raise MeshError(f"`{name}` must be one number or {n}, one each; got shape {list(rows.shape)}.")
    if not np.all(rows >= 0):
        raise MeshError(f"`{name}` must not be negative; got {rows.min()}.")
    return np.minimum(np.broadcast_to(rows, n), INFINITE)
