"""The corners around every vertex of a mesh, as dense tables. numpy builds them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .half_edges import HalfEdges


def as_table(rows: Int[np.ndarray, "..."]) -> Int[Array, "..."]:
    """A finished table of indices, moved to the device in 32 bits."""
    return jnp.asarray(rows, jnp.int32)


class Fan(eqx.Module):
    """Vertices that have equally many faces, and the corners of those faces at them."""

    centre: Int[Array, "m"] = eqx.field(converter=as_table)
    next: Int[Array, "k m"] = eqx.field(converter=as_table)
    """The neighbour after the vertex in each of its `k` faces."""
    previous: Int[Array, "k m"] = eqx.field(converter=as_table)
    """The neighbour before the vertex in the same face."""


class Fans(eqx.Module):
    """Every vertex with the corners around it, grouped by their number, so that each group is a dense table."""

    groups: tuple[Fan, ...]
    order: Int[Array, "v"] = eqx.field(converter=as_table)
    """Where each vertex stands in the groups laid end to end."""


def mesh_fans(n_vertices: int, sides: HalfEdges) -> Fans:
    """Corners around the vertices of a mesh."""
    return group_corners(n_vertices, sides.start, sides.end, sides.before)


def group_corners(
    n_vertices: int, start: Int[np.ndarray, "s"], after: Int[np.ndarray, "s"], before: Int[np.ndarray, "s"]
) -> Fans:
    """Corners `(before, start, after)` by the vertex `start`, in groups of equal counts."""
    by_vertex = np.argsort(start, kind="stable")
    counts = np.bincount(start, minlength=n_vertices)
    first = np.cumsum(counts) - counts
    groups, members = [], []
    for count in np.unique(counts):
        vertices = np.flatnonzero(counts == count)
        rows = by_vertex[first[vertices] + np.arange(count)[:, None]]
        groups.append(Fan(centre=vertices, next=after[rows], previous=before[rows]))
        members.append(vertices)
    order = np.empty(n_vertices, dtype=np.int64)
    order[np.concatenate(members)] = np.arange(n_vertices)
    return Fans(tuple(groups), order)
