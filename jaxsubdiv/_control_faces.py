"""Which control face the faces and edges of a refinement belong to: how `build_topology` lays them out. numpy only."""

import numpy as np
from jaxtyping import Array, Float, Int

from ._control import Control
from ._scheme.base import AbstractScheme
from ._surface import RefinedSurface
from ._topology import Topology
from .half_edges import HalfEdges, half_edges


def control_edges(topology: Topology) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "e"]]:
    """Edges of the control mesh, each once, and a control face of each: either of two will do."""
    sides = _control_sides(topology)
    face = np.zeros(len(sides.edges), int)
    face[sides.edge] = sides.face
    return sides.edges, face


def child_edge_faces(topology: Topology) -> Int[np.ndarray, "b"]:
    """A control face of every edge of the first refined mesh, of a split in four: the halves of the control edges, then
    three in each triangle and four in each quad."""
    _, face = control_edges(topology)
    return np.concatenate([np.repeat(face, 2), _control_sides(topology).face])


def splits_in_four(scheme: AbstractScheme, topology: Topology) -> bool:
    """Whether the descendants of a control face are the rows that the paper's split gives them."""
    n, faces = 4 ** len(topology.levels), topology.faces
    four = all(len(faces[size]) == n * len(of_control) for size, of_control in topology.control_faces.items())
    return four and scheme.is_primal  # a dual scheme's torus of quads has as many faces


def control_faces_of(
    scheme: AbstractScheme, topology: Topology, surface: RefinedSurface, control: Control
) -> Int[np.ndarray, "g"]:
    """The control face that every face of the surface descends from; where the split keeps no order, the nearest."""
    if splits_in_four(scheme, topology):
        n = 4 ** len(topology.levels)
        return np.arange(topology.n_control_faces * n) // n

    def centres(vertices: Array, faces: dict) -> Float[np.ndarray, "f 3"]:
        return np.concatenate([np.asarray(vertices)[np.asarray(faces[size])].mean(axis=1) for size in (3, 4)])

    from scipy.spatial import KDTree  # here and not above: refining never needs it

    tree = KDTree(centres(control.vertices, topology.control_faces))
    return np.asarray(tree.query(centres(surface.vertices, surface.faces))[1])


def faces_of_levels(topology: Topology) -> list[dict[int, Int[Array, "_ _"]]]:
    """The faces of every level, the control mesh first.

    Raises:
        ValueError: the tables are of a linear scheme, or padded.
    """
    if not topology.tells_levels:
        raise ValueError(
            "only tables of points and normals that are not padded tell the faces of their levels: take those of each "
            "level from `build_topology`."
        )
    found = [topology.faces]
    for _ in topology.levels:
        # Child `c` of a face starts at its corner `c`; the fourth child of a triangle is its middle.
        found.insert(0, {size: rows.reshape(-1, 4, size)[:, :size, 0] for size, rows in found[0].items()})
    return found


def _control_sides(topology: Topology) -> HalfEdges:
    """Half-edges of the control mesh."""
    return half_edges({size: np.asarray(faces) for size, faces in topology.control_faces.items()})
