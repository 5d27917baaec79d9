"""Parts of a surface, and the caps that close them: tables, built once in numpy."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Int

from ._fans import as_table
from ._topology import Topology
from .half_edges import half_edges


class SurfacePart(eqx.Module):
    """Some faces of a surface, and the rims where they end; made by `surface_part`.

    Attributes:
        triangles: the faces, a quad as two.
        rims: sides of these faces that no other of them has, from start to end as the face runs along them.
        rim: which closed rim each of these sides belongs to.
        n_rims: number of rims.
    """

    triangles: Int[Array, "t 3"] = eqx.field(converter=as_table)
    rims: Int[Array, "r 2"] = eqx.field(converter=as_table)
    rim: Int[Array, "r"] = eqx.field(converter=as_table)
    n_rims: int = eqx.field(static=True)


def surface_part(topology: Topology, faces: Bool[np.ndarray | Array, "f"] | None = None) -> SurfacePart:
    """A part of the refined surface, for its area and for the volume that it encloses with flat caps over its rims.

    Args:
        topology: tables of the surface.
        faces: which of its faces, triangles first and then quads; default: all. `control_faces_of` names the control
            face of each, and `ControlMesh.regions` the region of that.

    Raises:
        ValueError: there are other than as many marks as faces, or no face is marked.
    """
    whole = {size: np.asarray(topology.faces[size]) for size in (3, 4)}
    n_triangles, n = len(whole[3]), len(whole[3]) + len(whole[4])
    marked = np.ones(n, bool) if faces is None else np.asarray(faces, bool)
    if marked.shape != (n,) or not marked.any():
        raise ValueError(
            f"`faces` must mark some of the {n} faces of the refined surface; got {int(marked.sum())} marks in the "
            f"shape {list(marked.shape)}."
        )
    chosen = {3: whole[3][marked[:n_triangles]], 4: whole[4][marked[n_triangles:]]}
    sides = half_edges(chosen)
    open_ = np.flatnonzero(np.bincount(sides.edge, minlength=len(sides.edges))[sides.edge] == 1)
    rims = np.stack([sides.start[open_], sides.end[open_]], axis=1)
    n_rims, rim = _rims(rims)
    halves = np.stack([chosen[4][:, [0, 1, 2]], chosen[4][:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    return SurfacePart(np.concatenate([chosen[3], halves]), rims, rim, n_rims)


def _rims(sides: Int[np.ndarray, "r 2"]) -> tuple[int, Int[np.ndarray, "r"]]:
    """The number of connected rims, and the one that each side is in."""
    if not len(sides):
        return 0, np.zeros(0, np.int32)
    import scipy.sparse.csgraph  # here and not above: refining never needs it

    n = int(sides.max()) + 1
    graph = scipy.sparse.coo_array((np.ones(len(sides)), (sides[:, 0], sides[:, 1])), shape=(n, n))
    _, component = scipy.sparse.csgraph.connected_components(graph, directed=False)
    used, rim = np.unique(component[sides[:, 0]], return_inverse=True)
    return len(used), rim
