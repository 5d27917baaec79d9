"""Every scheme and option that the properties are tested over, and what the tests of refinements share.

A new scheme is one more line in `CASES`.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import meshes
import numpy as np
import pytest
from meshes import Mesh

import jaxsubdiv as js
from jaxsubdiv._scheme.bezier_triangle import PatchLevel
from jaxsubdiv._topology import MaskLevel

INTERPOLATING = ("Kobbelt", "ModifiedButterfly")
LEVELS = 2
# One mesh holds what a rule can meet, so that every scheme is compiled once for most of the tests: both kinds of faces,
# closed and open components, valences 1 to 7 and faces that share one vertex only.
BOW_TIE = (np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (-1, 0, 0.5), (-1, -1, 0)]), [(0, 1, 2), (0, 3, 4)])
PARTS = (meshes.mixed_closed(), meshes.fan(7), meshes.grid(3, 2, "mixed", bumpy=0.2), BOW_TIE)
PART = np.repeat(range(len(PARTS)), [len(vertices) for vertices, _ in PARTS])
SHEET = 2
MIXED = meshes.union(*PARTS)
# The like for schemes that take one kind of faces only.
CUT = (MIXED[0], [half for face in MIXED[1] for half in (face[:3], face[::2] + face[3:])[: len(face) - 2]])
TWO_QUADS = (
    np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (-1, 0, 0.5), (-1, -1, 0), (0, -1, 0)]),
    [(0, 1, 2, 3), (0, 4, 5, 6)],
)
QUAD_PARTS = (meshes.cube(), meshes.torus(4, 3), meshes.grid(3, 2, bumpy=0.2), TWO_QUADS)
QUADS = meshes.union(meshes.cube(), meshes.torus(4, 3), meshes.grid(3, 2, bumpy=0.2))
TRIANGLES = meshes.union(meshes.fan(7), meshes.torus(4, 3, "triangle"), meshes.grid(2, 2, "triangle", bumpy=0.2))


class Subject(NamedTuple):
    """A mesh that a scheme takes, the component of each of its vertices, and values on it."""

    mesh: Mesh
    part: np.ndarray
    x: np.ndarray
    n: np.ndarray

    @property
    def control(self) -> js.Control:
        return js.Control(self.x, self.n)


class Case(NamedTuple):
    """A scheme, what `reference.refine` calls it, and the properties that it is known to lack."""

    name: str
    scheme: js.AbstractScheme
    reference: dict[str, Any] | None
    lacks: frozenset[str] = frozenset()

    def with_h(self, h: Any) -> js.AbstractScheme:
        """The same scheme with h in every place, if it has one."""
        if self.scheme.h is None:
            return self.scheme
        return dataclasses.replace(self.scheme, h=np.full(self.scheme.h.shape, h))

    @property
    def subject(self) -> Subject:
        """What most tests refine with this scheme."""
        return _subject(self.scheme.takes)

    @property
    def topology(self) -> js.Topology:
        """Its tables."""
        key = self.scheme.tables_for, self.scheme.recomputes_normals
        if key not in _TOPOLOGIES:
            _TOPOLOGIES[key] = js.build_topology(control_mesh(self.subject.mesh), self.scheme, LEVELS)
        return _TOPOLOGIES[key]


_TOPOLOGIES: dict[tuple[str, bool], js.Topology] = {}


@functools.cache
def _subject(takes: tuple[int, ...]) -> Subject:
    parts = QUAD_PARTS if takes == (4,) else PARTS
    part = np.repeat(range(len(parts)), [len(vertices) for vertices, _ in parts])
    mesh = {(3, 4): MIXED, (3,): CUT, (4,): meshes.union(*QUAD_PARTS)}[takes]
    control = random_control(mesh, seed=5)
    return Subject(mesh, part, np.asarray(control.vertices), np.asarray(control.normals))


def _interpolating(twist: str, weights: str, old_normals: str, boundary: str, h: Any = 1.1) -> Case:
    options = {"twist": twist, "weights": weights, "old_normals": old_normals, "boundary": boundary}
    changed = [value for key, value in options.items() if value != getattr(js.Interpolating(), key)]
    name = "-".join(changed + ["h_by_level"] * np.ndim(h)) or "default"
    # The printed twist adds unit normals to lengths, with signs that go by the first corner.
    lacks = frozenset({"scale", "flat at h = 0", "first corner", "sphere"} if twist == "printed" else {"sphere"})
    return Case(name, js.Interpolating(h, **options), options, lacks)


CASES = [
    # Every two values of two options meet in at least one of the first eight.
    _interpolating("zero", "area", "keep", "fan"),
    _interpolating("printed", "area", "recompute", "chord"),
    _interpolating("zero", "uniform", "recompute", "fan"),
    _interpolating("printed", "uniform", "keep", "chord"),
    _interpolating("zero", "angle", "keep", "chord"),
    _interpolating("printed", "angle", "recompute", "fan"),
    _interpolating("zero", "sphere", "recompute", "chord"),
    _interpolating("printed", "sphere", "keep", "fan"),
    _interpolating("zero", "area", "keep", "fan", h=[1.2, 0.7]),
    Case("circle", js.CirclePreserving(1.1), {"scheme": "circle"}),
    Case("circle-h_by_level", js.CirclePreserving([1.2, 0.7]), {"scheme": "circle"}),
    Case("bezier-triangle", js.BezierTriangle(), None, frozenset({"sphere"})),
    Case("catmull-clark", js.CatmullClark(), None, frozenset({"sphere", "blocks of children"})),
    Case("catmull-clark-edge-only", js.CatmullClark("edge-only"), None, frozenset({"sphere", "blocks of children"})),
    Case("doo-sabin", js.DooSabin(), None, frozenset({"sphere", "blocks of children", "whole polygons"})),
    Case("kobbelt", js.Kobbelt(), None, frozenset({"sphere"})),
    Case("loop", js.Loop(), None, frozenset({"sphere"})),
    Case("loop-warren-edge-only", js.Loop("warren", "edge-only"), None, frozenset({"sphere"})),
    Case("butterfly", js.ModifiedButterfly(), None, frozenset({"sphere"})),
]


def by_name(name: str) -> Case:
    return next(case for case in CASES if case.name == name)


def over_cases(*needs: str, **claims: bool):
    """Run a test for every scheme that does not lack what the test needs, and claims of itself what it asks."""
    cases = [
        case
        for case in CASES
        if not case.lacks.intersection(needs)
        and all(getattr(case.scheme, claim) == value for claim, value in claims.items())
    ]
    return pytest.mark.parametrize("case", cases, ids=lambda case: case.name)


def control_mesh(mesh: Mesh) -> js.ControlMesh:
    """A control mesh with its triangles first, as the library numbers faces."""
    vertices, faces = mesh
    return js.ControlMesh(vertices, sorted(faces, key=len))


def refined(case: Case, control: js.Control) -> js.RefinedSurface:
    """Refine with the faces of the case's own mesh, triangles first."""
    return on_host(js.refine(case.scheme, case.topology, control))


def on_host(surface: js.RefinedSurface) -> js.RefinedSurface:
    """The same in numpy, where small operations cost nothing to compile."""
    return jax.tree.map(np.asarray, surface)


def inherited(topology: js.Topology, values: np.ndarray) -> np.ndarray:
    """A value for every control vertex, handed down to a mean of the parents' values. Labels of components stay."""
    for level in topology.levels:
        if isinstance(level, MaskLevel):
            new = level.masks.matrix() @ values
            # Interpolating schemes have rows for new vertices alone.
            values = np.concatenate([values, new]) if topology.built_for.startswith(INTERPOLATING) else new
        elif isinstance(level, PatchLevel):
            places = [values[np.asarray(at.corners)].mean(axis=1) for at in (level.in_triangles, level.in_quads)]
            values = np.concatenate([values, np.concatenate(places)[np.asarray(level.order)]])
        else:
            parents = [np.asarray(level.edges), np.asarray(level.quads)]
            values = np.concatenate([values, *(values[rows].mean(axis=1) for rows in parents)])
    return values


def random_control(mesh: Mesh, seed: int, bumps: float = 0.05) -> js.Control:
    """The mesh with its vertices moved a little, and with normals of any length within about 60 degrees of its own."""
    rng = np.random.default_rng(seed)
    vertices = mesh[0] + rng.uniform(-bumps, bumps, mesh[0].shape)
    own = np.asarray(js.ControlMesh(vertices, mesh[1]).control().normals)
    return js.Control(vertices, (own + rng.uniform(-0.5, 0.5, own.shape)) * rng.uniform(0.5, 2, (len(own), 1)))


def torus(n: int, kind: str) -> js.ControlMesh:
    """Around the tube `n` cells, with the torus's own normals."""
    vertices, faces = meshes.torus(2 * n, n, kind)
    outward = vertices * (1, 1, 0)
    return js.ControlMesh(vertices, faces, vertices - 2 * outward / np.linalg.norm(outward, axis=1, keepdims=True))
