"""What kind of surface a control mesh is: parts, rims, handles."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import jaxsubdiv as js
from jaxsubdiv.half_edges import Faces, half_edges


class MeshTopology(NamedTuple):
    """Counts that no bending changes."""

    parts: int
    """Pieces without a common edge or vertex."""
    boundary_loops: int
    """Rims; 0 for a closed mesh. Rims that touch in a vertex count as one."""
    genus: int
    """Handles, of all parts together: 0 for a ball or a sheet, 1 for a ring."""
    euler_number: int
    """Vertices less edges plus faces: 2 parts - 2 genus - boundary_loops."""

    @property
    def is_closed(self) -> bool:
        """True where there is no rim."""
        return self.boundary_loops == 0

    def __str__(self) -> str:
        rims = (
            "closed"
            if self.is_closed
            else f"open ({self.boundary_loops} boundary loop{'s' * (self.boundary_loops > 1)})"
        )
        return (
            f"{self.parts} part{'s' * (self.parts > 1)}, {rims}, genus {self.genus}, Euler number {self.euler_number}"
        )


def topology_of(mesh: js.ControlMesh) -> MeshTopology:
    """Parts, boundary loops and genus of a mesh; vertices without faces do not count."""
    return face_topology(mesh.faces)


def face_topology(faces: Faces) -> MeshTopology:
    """The same for faces alone, which must be wound alike."""
    sides = half_edges(faces)
    n = int(sides.start.max(initial=-1)) + 1
    used = np.unique(sides.start)
    label = component_labels(sides.edges, n)
    parts = len(np.unique(label[used]))
    rim = sides.edges[np.bincount(sides.edge, minlength=len(sides.edges)) == 1]
    loops = len(np.unique(component_labels(rim, n)[rim.ravel()])) if len(rim) else 0
    euler = len(used) - len(sides.edges) + sum(len(rows) for rows in faces.values())
    return MeshTopology(parts, loops, (2 * parts - loops - euler) // 2, euler)


def component_labels(edges: Int[np.ndarray, "e 2"], n: int) -> Int[np.ndarray, "v"]:
    """Of each of `n` nodes the component that it lies in."""
    return connected_components(coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(n, n)), directed=False)[1]
