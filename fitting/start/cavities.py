"""Cavities of a wall: the parts of a surface between its valves, and which of them bound a cavity."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

import jaxsubdiv as js
from jaxsubdiv.half_edges import half_edges

from .mesh_topology import component_labels

_VALVE_WORDS = ("VALVE", "ORIFICE", "ANNULUS")


class Part(NamedTuple):
    """A part of a surface that valves, or its boundary, bound."""

    name: str
    """Of its groups."""
    faces: Bool[np.ndarray, "f"]
    """Which control faces it has, triangles first."""
    is_cavity: bool
    """Whether the surface is wound outwards from a wall, and this part towards a cavity of that."""
    rims: tuple[Int[np.ndarray, "_"], ...]
    """Control vertices around each of its openings, in the order of its faces."""


def find_valves(mesh: js.ControlMesh, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """The groups of a mesh that are valves: those given, or those whose names say so.

    Raises:
        ValueError: a given group is none of the mesh.
    """
    there = () if mesh.regions is None else mesh.regions.names
    if names is None:
        return tuple(name for name in there if any(word in name.upper() for word in _VALVE_WORDS))
    lost = sorted(set(names) - set(there))
    if lost:
        raise ValueError(f"`valves`: '{lost[0]}' is no group of the control mesh; it has {', '.join(there) or 'none'}.")
    return tuple(names)


def find_parts(mesh: js.ControlMesh, valves: Sequence[str]) -> tuple[Part, ...]:
    """The parts of a mesh that are left when the faces of its valves are taken away."""
    words = np.array([""] * mesh.n_faces if mesh.regions is None else mesh.regions.words())
    sides = half_edges(mesh.faces)
    kept = ~np.isin(words, list(valves))
    inside = kept[sides.face]
    pairs = np.stack([sides.face[inside], mesh.n_faces + sides.edge[inside]], axis=1)
    labels = component_labels(pairs, mesh.n_faces + len(sides.edges))[: mesh.n_faces]
    found, is_closed = [], mesh.is_closed
    for label in np.unique(labels[kept]):
        faces = kept & (labels == label)
        own = faces[sides.face]
        alone = own & (np.bincount(sides.edge[own], minlength=len(sides.edges))[sides.edge] == 1)
        rims = _loops(sides.start[alone], sides.end[alone])
        names = [name for name in dict.fromkeys(words[faces].tolist()) if name]
        volume = _closed_volume(mesh, faces, rims)
        is_cavity = bool(rims) and is_closed and volume < 0  # an open mesh bounds no wall
        found.append(Part("+".join(names) or "surface", faces, is_cavity, rims))
    return tuple(found)


def _loops(start: Int[np.ndarray, "s"], end: Int[np.ndarray, "s"]) -> tuple[Int[np.ndarray, "_"], ...]:
    """Closed loops of directed edges."""
    after, loops = dict(zip(start.tolist(), end.tolist(), strict=True)), []
    while after:
        loop = [next(iter(after))]
        while (following := after.pop(loop[-1], None)) is not None and following != loop[0]:
            loop.append(following)
        loops.append(np.array(loop))
    return tuple(loops)


def _closed_volume(mesh: js.ControlMesh, faces: Bool[np.ndarray, "f"], rims: Sequence[Int[np.ndarray, "_"]]) -> float:
    """The signed volume of some faces, their openings closed by fans."""
    x, t = mesh.vertices, len(mesh.faces[3])
    quads = mesh.faces[4][faces[t:]]
    triangles = np.concatenate([mesh.faces[3][faces[:t]], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    a, b, c = (x[triangles[:, i]] for i in range(3))
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
    for rim in rims:
        a, b = x[rim], x[np.roll(rim, -1)]
        volume -= float(x[rim].mean(axis=0) @ np.cross(a, b).sum(axis=0) / 6)
    return volume
