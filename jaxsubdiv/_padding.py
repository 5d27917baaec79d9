"""Topologies of different meshes padded to common sizes: one compiled program for all of them, and batches. numpy.

What is padded copies what is there: a spare row of a table is that of the first edge, quad or vertex, so that spare
vertices lie on real ones, and no rule meets a case there that the mesh does not have. Spare faces have all their
corners at the first control vertex.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ._control import Control
from ._fans import Fan, Fans
from ._surface import RefinedSurface
from ._topology import Level, Real, Topology

_SMALLEST, _GROWTH = 16, 1.25
_CORNERS = 8  # at a vertex, at least: most meshes have no vertex of more faces, and then share a program

# Edges and vertices that a class has room for, a triangle and a quad: those of open sheets of a few hundred faces.
_EDGES, _VERTICES = (1.6, 2.1), (0.6, 1.1)


class _Sizes(NamedTuple):
    """Rows of the tables of the first level."""

    vertices: int
    edges: int
    triangles: int
    quads: int
    seams: int
    wings: int
    corners: int
    """At a vertex, in its fan."""


def pad_topology(topology: Topology, classes: Sequence[int] | None = None) -> Topology:
    """The topology with spare vertices, edges and faces, so that meshes of similar sizes share a compiled program.

    Triangles and quads are each padded to the next size class, edges and vertices in proportion. `refine` on it takes
    `pad_control(topology, control)` and gives arrays of the padded sizes; `topology.real` says which rows are real, and
    `cut_padding` takes out the others. Real rows are those of the topology before, to rounding. Spare vertices lie on
    real ones, and spare faces have no area; leave both out of a loss by the masks.

    Args:
        topology: tables for `Interpolating` or `CirclePreserving`.
        classes: numbers of control faces to pad to, ascending; default: 16, 20, 25, 32 and so on, each a quarter larger
            than the one before. Meshes of triangles, of quads and of both, with seams and without, and those with
            vertices of more than 8 faces are compiled apart.

    Returns:
        Tables of the same levels, with `real`.

    Raises:
        ValueError: the topology is of another scheme, has no vertex, or is padded already; or the mesh is larger than
            the last of the classes.
    """
    return _pad_to_common([topology], classes)[0]


def stack_topologies(topologies: Iterable[Topology], classes: Sequence[int] | None = None) -> Topology:
    """Topologies of different meshes, padded to common sizes and stacked, for `jax.vmap`.

    `jax.vmap(js.refine, (None, 0, 0))` takes them, with the padded controls stacked likewise:
    `jax.tree.map(lambda *rows: jnp.stack(rows), *(js.pad_control(stacked, control) for control in controls))`.

    Args:
        topologies: one or more, of equal numbers of levels.
        classes: as for `pad_topology`.

    Returns:
        Tables whose arrays all have a first axis more: one row a mesh.

    Raises:
        ValueError: there are none, they differ in their levels or options, or one cannot be padded.
    """
    padded = _pad_to_common(list(topologies), classes)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)


def pad_control(topology: Topology, control: Control) -> Control:
    """Control values for a padded topology: spare vertices repeat the first one, which gets their gradients.

    Args:
        topology: from `pad_topology` or `stack_topologies`.
        control: of the mesh as it is, `[v, 3]`.

    Raises:
        ValueError: there are more vertices than the topology has room for.
    """
    n, n_padded = control.vertices.shape[0], topology.n_control_vertices
    if not 0 < n <= n_padded:
        raise ValueError(f"the topology has room for 1 to {n_padded} control vertices; got {n}.")

    def pad(rows: Array) -> Array:
        return jnp.concatenate([rows, jnp.broadcast_to(rows[:1], (n_padded - n, 3))])

    return Control(pad(control.vertices), pad(control.normals))


def cut_padding(topology: Topology, surface: RefinedSurface) -> RefinedSurface:
    """The surface of a padded topology without the padding, as the topology before gives it; outside of `jax.jit`.

    Args:
        topology: from `pad_topology`, or one row of `stack_topologies`.
        surface: what `refine` makes on it.
    """
    if topology.real is None:
        return surface
    vertices, faces = np.asarray(topology.real.vertices), np.asarray(topology.real.faces)
    number = np.cumsum(vertices) - 1
    there = dict(zip((3, 4), np.split(faces, [surface.faces[3].shape[0]]), strict=True))
    kept = {size: jnp.asarray(number[np.asarray(surface.faces[size])[there[size]]], jnp.int32) for size in (3, 4)}
    rows = np.flatnonzero(vertices)
    return RefinedSurface(surface.vertices[rows], surface.normals[rows], kept)


def _pad_to_common(topologies: list[Topology], classes: Sequence[int] | None) -> list[Topology]:
    if not topologies:
        raise ValueError("there are no topologies to stack.")
    for topology in topologies:
        if not all(isinstance(level, Level) for level in topology.levels) or topology.fans is not None:
            raise ValueError(
                f"tables for {topology.built_for} cannot be padded; those for Interpolating and CirclePreserving can."
            )
        if topology.real is not None:
            raise ValueError("the topology is padded already. Pad the one from `build_topology`.")
        if not topology.n_control_vertices:
            raise ValueError("the topology has no vertex.")
    kinds = [_kind(topology) for topology in topologies]
    for i, kind in enumerate(kinds):
        if kind != kinds[0]:
            raise ValueError(
                f"the topologies 0 and {i} differ in their levels or options. Build all with the same scheme, levels "
                "and `mesh_normals`."
            )
    sizes = _common_sizes([_count(topology) for topology in topologies], classes)
    return [_pad(topology, sizes) for topology in topologies]


def _kind(topology: Topology) -> tuple[str, bool, tuple[bool, ...]]:
    """What meshes of one program have in common beside their sizes."""
    recomputed = tuple(level.old_fans is not None for level in topology.levels if isinstance(level, Level))
    return topology.built_for, topology.mesh_normals, recomputed


def _count(topology: Topology) -> _Sizes:
    level = topology.levels[0] if topology.levels else None
    fans = [topology.control_fans, *(level.old_fans for level in topology.levels if isinstance(level, Level))]
    of_level = (0, 0, 0)
    if isinstance(level, Level):
        of_level = len(level.edges), 0 if level.seams is None else len(level.seams), level.wings.shape[1]
    n_edges, n_seams, wings = of_level
    return _Sizes(
        vertices=topology.n_control_vertices,
        edges=n_edges,
        triangles=len(topology.control_faces[3]),
        quads=len(topology.control_faces[4]),
        seams=n_seams,
        wings=wings,
        corners=max(len(fan.next) for fan in itertools.chain.from_iterable(f.groups for f in fans if f is not None)),
    )


def _common_sizes(counts: list[_Sizes], classes: Sequence[int] | None) -> _Sizes:
    """The smallest classes of triangles and quads that hold all meshes with their edges and vertices."""
    most = _Sizes(*map(max, zip(*counts, strict=True)))
    # A spare seam is one of a spare edge.
    n_edges = most.edges + (most.seams > 0)
    allowed = None if classes is None else list(classes)
    triangles, quads = _ascend(most.triangles, allowed), _ascend(most.quads, allowed)
    while True:
        try:
            faces = next(triangles), next(quads)
        except StopIteration:
            raise ValueError(
                f"the classes {allowed} hold no mesh of {most.triangles} triangles, {most.quads} quads, {most.edges} "
                f"edges and {most.vertices} vertices."
            ) from None
        rows, edges = (
            int(np.ceil(np.dot(share, faces))) if any(faces) else most.vertices for share in (_VERTICES, _EDGES)
        )
        if rows >= most.vertices and edges >= n_edges:
            break
    return _Sizes(
        vertices=rows,
        edges=edges if n_edges else 0,
        triangles=faces[0],
        quads=faces[1],
        seams=next(_ascend(most.seams, None)),
        wings=most.wings,
        corners=next(size for size in _sizes(_CORNERS) if size >= most.corners),
    )


def _sizes(smallest: int) -> Iterator[int]:
    return (int(np.ceil(smallest * _GROWTH**i)) for i in itertools.count())


def _ascend(n: int, allowed: list[int] | None) -> Iterator[int]:
    """The classes that hold `n`, the smallest first; what a mesh has none of, it needs no room for."""
    if n == 0:
        return itertools.repeat(0)
    return (size for size in (_sizes(_SMALLEST) if allowed is None else allowed) if size >= n)


def _pad(topology: Topology, sizes: _Sizes) -> Topology:
    n = topology.n_control_vertices
    n_padded, n_edges, n_quads, n_triangles = sizes.vertices, sizes.edges, sizes.quads, sizes.triangles
    place = np.arange(n)
    """Where each vertex stands in the padded numbering."""
    source = np.where(np.arange(n_padded) < n, np.arange(n_padded), 0)
    """The vertex that stands, or is copied, at each padded number."""
    real, control_fans = [_first(n, n_padded)], _pad_fans(topology.control_fans, place, source, sizes.corners)
    levels = []
    for i, level in enumerate(topology.levels):
        assert isinstance(level, Level)
        edges, wings, quads, quad_edges = map(np.asarray, (level.edges, level.wings, level.quads, level.quad_edges))
        e, q = len(edges), len(quads)
        refined = np.concatenate([place, n_padded + np.arange(e), n_padded + n_edges + np.arange(q)])
        wings = np.repeat(refined[wings], sizes.wings // wings.shape[1], axis=1)  # a quad names its centre twice
        wings, itself = _pad_rows(wings, n_edges), n_padded + np.arange(n_edges)[:, None]
        wings = np.where((wings == n_padded) & (itself >= n_padded + e), itself, wings)
        of_edges, of_quads = (
            n + first + np.where(np.arange(padded) < count, np.arange(padded), 0)
            for first, count, padded in ((0, e, n_edges), (e, q, n_quads))
        )
        old = level.old_fans
        levels.append(
            Level(
                edges=_pad_rows(place[edges], n_edges),
                wings=wings,
                quads=_pad_rows(place[quads], n_quads),
                quad_edges=_pad_rows(quad_edges, n_quads),
                old_fans=None if old is None else _pad_fans(old, refined, source, sizes.corners),
                seams=_pad_seams(level, n_edges, sizes.seams * 2**i),
            )
        )
        source = np.concatenate([source, of_edges, of_quads if q else np.zeros(n_quads, int)])
        real += [_first(e, n_edges), _first(q, n_quads)]
        n, n_padded, place = n + e + q, n_padded + n_edges + n_quads, refined
        n_edges, n_quads, n_triangles = 2 * n_edges + 3 * n_triangles + 4 * n_quads, 4 * n_quads, 4 * n_triangles
    n_control_faces, n_faces = {3: sizes.triangles, 4: sizes.quads}, {3: n_triangles, 4: n_quads}
    return Topology(
        levels=tuple(levels),
        control_fans=control_fans,
        control_faces={size: _pad_faces(topology.control_faces[size], n_control_faces[size]) for size in (3, 4)},
        faces={size: _pad_faces(place[np.asarray(topology.faces[size])], n_faces[size]) for size in (3, 4)},
        fans=None,
        limit=None,
        mesh_normals=topology.mesh_normals,
        built_for=topology.built_for,
        real=Real(
            control_vertices=jnp.asarray(real[0]),
            vertices=jnp.asarray(np.concatenate(real)),
            faces=jnp.asarray(np.concatenate([_first(len(topology.faces[size]), n_faces[size]) for size in (3, 4)])),
        ),
    )


def _first(n: int, n_padded: int) -> Bool[np.ndarray, "p"]:
    return np.arange(n_padded) < n


def _pad_rows(rows: Int[np.ndarray, "n k"], n: int) -> Int[np.ndarray, "m k"]:
    """The rows and copies of the first one; where there is none, rows of zeros."""
    first = rows[:1] if len(rows) else np.zeros((1, rows.shape[1]), rows.dtype)
    return np.concatenate([rows, np.repeat(first, n - len(rows), axis=0)])


def _pad_faces(faces: Int[np.ndarray, "n k"] | Int[Array, "n k"], n: int) -> Int[Array, "m k"]:
    spare = np.zeros((n - len(faces), faces.shape[1]), np.int32)
    return jnp.asarray(np.concatenate([np.asarray(faces), spare]), jnp.int32)


def _pad_seams(level: Level, n_edges: int, n: int) -> Int[Array, "s 2"] | None:
    if n == 0:
        return None
    seams = np.zeros((0, 2), np.int32) if level.seams is None else np.asarray(level.seams)
    # The last edge is a spare one: on a seam with itself alone.
    return jnp.asarray(np.concatenate([seams, np.full((n - len(seams), 2), n_edges - 1)]), jnp.int32)


def _pad_fans(fans: Fans, place: Int[np.ndarray, "w"], source: Int[np.ndarray, "p"], width: int) -> Fans:
    """All vertices in one group; a corner that is not there has its centre for both neighbours, and adds nothing."""
    n = fans.order.shape[0]
    sides = np.full((2, width, n), -1)
    for fan in fans.groups:
        sides[0][: len(fan.next), fan.centre] = place[np.asarray(fan.next)]
        sides[1][: len(fan.next), fan.centre] = place[np.asarray(fan.previous)]
    centre = np.arange(len(source))
    after, before = np.where(sides[..., source] < 0, centre, sides[..., source])
    return Fans((Fan(centre=centre, next=after, previous=before),), centre)
