"""A refinement of every kind of face, for tests of what is true of it."""

import meshes
import numpy as np
from schemes import by_name, on_host

import jaxsubdiv as js

DEFAULT = by_name("default")
CONTROL, X, N, PART = DEFAULT.subject.control, DEFAULT.subject.x, DEFAULT.subject.n, DEFAULT.subject.part


def refine(scheme: js.AbstractScheme, mesh: meshes.Mesh, levels: int, normals=None) -> js.RefinedSurface:
    """Refine a mesh with the normals given, or with its own."""
    checked = js.ControlMesh(*mesh, normals)
    return on_host(js.refine(scheme, js.build_topology(checked, scheme, levels), checked.control()))


def unit(rows) -> np.ndarray:
    return np.asarray(rows) / np.linalg.norm(rows, axis=-1, keepdims=True)
