"""What a fit makes small, row by row: distances to the scan, and what is known of surfaces beforehand.

Every row is over the standard deviation that is expected of it, so that half the squared sum of all is the negative
logarithm of a probability: of the scan given the surface, times that of the surface.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv import strong_float, sum_corners
from jaxsubdiv.half_edges import HalfEdges, half_edges
from jaxsubdiv.linalg import cross, dot, norm, take, unit

from .priors.boundary import Rim
from .unknowns import Unknowns, apply_offset

# A normal that leans less than this, as a cosine, from the faces around it keeps the surface smooth; it may be a little
# under it, by the softness, at a standard deviation of the spread.
_MARGIN, _MARGIN_SOFTNESS, _MARGIN_SPREAD = 0.2, 0.1, 0.02


def _positive(value: object) -> Float[Array, ""]:
    value = strong_float(value)
    if not bool(value > 0):
        raise ValueError(f"a standard deviation must be positive; got {value}. Give jnp.inf to leave a prior out.")
    return value


def _if_given(converter: Callable[[object], Float[Array, ""]]) -> Callable[[object], Float[Array, ""] | None]:
    return lambda value: None if value is None else converter(value)


class Priors(eqx.Module):
    """What is known of a surface before it is measured, each as the standard deviation that is expected.

    A prior of the standard deviation `jnp.inf` is left out.

    Attributes:
        bend: of the bend asymmetry of an edge in mm (see `bend_asymmetry`): small is smooth. None, the default: found
            from the scan, place by place, as that which makes the scan most probable (see `_evidence`).
        stretch: of the change of a control edge along the surface, against the control mesh where the fit starts, as a
            part of the edge's length. It keeps the control vertices in their places where the scan does not.
        h: of the tangent length coefficient about 1.
        symmetry: of the departure of a control vertex from the mirror image of its partner in mm, in each coordinate;
            of control normals, by as much as they move the surface. Default: left out. The mirror plane moves along
            with the mesh; `fit` finds the partners, or is given them (see `find_symmetry`).
        likeness: how much of the control mesh's own bend asymmetry, where the fit starts, is expected of the surface,
            from 0 to 1; `bend` is then of the departure from that. No standard deviation, unlike the others. Unless it
            is 0, the control mesh's curvature is expected too (see `bend_height`), as closely as the scan shows place
            by place: holes of the scan are filled as the control mesh is shaped. None, the default: the likeness that
            makes the scan most probable, about 0.9 where the control mesh is the same anatomy of another person and
            about 0 where its details say nothing of the scan's; and 0 where `bend` is given. Give 0 where the control
            mesh was made from this very scan or fitted to it before, for its noise would be expected again. With `bend`
            given, nothing is expected of curvature.
        shift: of how far breathing displaced a slice of the scan, in mm, along each of two axes of the slice's plane.

    Raises:
        ValueError: a standard deviation is not positive, or the likeness not from 0 to 1.
    """

    bend: Float[Array, ""] | None = eqx.field(converter=_if_given(_positive), default=None)
    stretch: Float[Array, ""] = eqx.field(converter=_positive, default=0.2)
    h: Float[Array, ""] = eqx.field(converter=_positive, default=0.05)
    symmetry: Float[Array, ""] = eqx.field(converter=_positive, default=np.inf)
    shift: Float[Array, ""] = eqx.field(converter=_positive, default=3.0)
    likeness: Float[Array, ""] | None = eqx.field(converter=_if_given(strong_float), default=None)

    def __check_init__(self):
        if self.likeness is not None and not bool((self.likeness >= 0) & (self.likeness <= 1)):
            raise ValueError(f"the likeness is a share, from 0 to 1; got {self.likeness}.")


class Pairs(NamedTuple):
    """Scan points and the surface points paired with them, as one sweep holds them fixed."""

    points: Float[Array, "p 3"]
    corners: Int[Array, "p 4"]
    """Vertices of the refined surface around each surface point."""
    corner_weights: Float[Array, "p 4"]
    directions: Float[Array, "p 3"]
    """Unit vectors along which the distance is measured, from the surface to the point: the surface slides freely
    across them."""


class Anchors(NamedTuple):
    """Landmarks: places of the surface, and where the scan has them."""

    points: Float[Array, "l 3"]
    face: Int[Array, "l"]
    corners: Int[Array, "l 4"]
    corner_weights: Float[Array, "l 4"]
    deviations: Float[Array, "l"]
    """Standard deviations in mm."""


class Expected(NamedTuple):
    """What is expected of bends, in mm; see `Priors.likeness`."""

    bends: Float[Array | np.ndarray, "b"]
    """Their asymmetry."""
    rows: Int[Array | np.ndarray, "g"]
    """The bends whose heights are expected."""
    heights: Float[Array | np.ndarray, "g"]

    def only(self, other: "Expected") -> "Expected":
        """No more than what the other one says something of."""
        rows, mine, _ = np.intersect1d(self.rows, other.rows, return_indices=True)
        return Expected(np.where(np.asarray(other.bends) != 0, self.bends, 0.0), rows, np.asarray(self.heights)[mine])

    def times(self, bends: Any, heights: Any) -> "Expected":
        """With factors of the bends and of the heights."""
        return Expected(bends * self.bends, self.rows, heights * self.heights)


class Start(NamedTuple):
    """Where a sweep starts, and what it holds fixed: the arguments of its residuals."""

    scheme: js.AbstractScheme
    topology: js.Topology
    control: js.Control
    template: Float[Array, "v 3"]
    """Control vertices of the template, moved to `control` as a whole: what edges are compared with."""
    anchors: Anchors | None
    edges: Int[Array | np.ndarray, "e 2"]
    """Control edges."""
    bend_edges: Int[Array | np.ndarray, "b 2"]
    """Edges of which the bends are compared."""
    rim: Rim | None = None
    expected: Expected | None = None
    """None is a bend asymmetry of 0, and any heights."""


class Rows(NamedTuple):
    """Residuals before they are weighed; in mm where nothing else is said."""

    distance: Float[Array | np.ndarray, "p"]
    bend: Float[Array | np.ndarray, "b"]
    height: Float[Array | np.ndarray, "g"]
    stretch: Float[Array | np.ndarray, "s"]
    """Three a control edge, as parts of its length."""
    margin: Float[Array | np.ndarray, "c"]
    """One a corner of the control faces, over its own standard deviation."""
    landmark: Float[Array | np.ndarray, "l"]
    """Three a landmark, over its standard deviation."""
    rim: Float[Array | np.ndarray, "r"]
    """Two a point of the boundary curve, over its standard deviation."""
    h: Float[Array | np.ndarray, "n"]
    """h - 1."""


def residuals(offset: Unknowns, start: Start, pairs: Pairs) -> Rows:
    """All rows at an offset from the start; no distances, so that a perfect fit has a derivative too."""
    vertices, rows = surface_and_priors(offset, start)
    return rows._replace(distance=signed_distances(vertices, pairs))


def signed_distances(vertices: Float[Array, "v 3"], pairs: Pairs) -> Float[Array, "p"]:
    """How far the surface points lie from their scan points, along the directions held fixed."""
    away = sum_corners(vertices, pairs.corners, pairs.corner_weights) - pairs.points
    return dot(pairs.directions, away)[:, 0]


def surface_and_priors(offset: Unknowns, start: Start) -> tuple[Float[Array, "v 3"], Rows]:
    """The surface's vertices and the rows of the priors at an offset from the start."""
    scheme, control = apply_offset(start.topology, start.scheme, start.control, offset)
    surface = js.refine(scheme, start.topology, control)
    dtype = surface.vertices.dtype
    none, own = jnp.zeros((0,), dtype), with_control_vertices(start.topology, scheme, control, surface)
    bends, heights = bend_asymmetry(own, start.bend_edges), none
    if start.expected is not None:
        bends = bends - start.expected.bends
        heights = bend_height(own, jnp.asarray(start.bend_edges)[start.expected.rows]) - start.expected.heights
    return surface.vertices, Rows(
        distance=none,
        bend=bends,
        height=heights,
        stretch=_stretch(start, control),
        margin=_margin_rows(start.topology, control) if scheme.uses_normals else none,
        landmark=none if start.anchors is None else _anchor_rows(start.anchors, surface),
        rim=none if start.rim is None else start.rim.rows(surface.vertices),
        h=none if offset.h is None else jnp.atleast_1d(scheme.h).astype(dtype) - 1,
    )


def bend_asymmetry(surface: js.RefinedSurface, edges: Int[Array | np.ndarray, "b 2"]) -> Float[Array, "b"]:
    """By how much the surface bends more at one end of an edge than at the other, in mm, edge by edge.

    It is half of the height of each end over the tangent plane at the other, one less the other:
    (n_a + n_b) . (x_b - x_a) / 2. It vanishes on spheres, on cylinders and for every circular arc, so that it smooths
    without shrinking; and it ties normals to the geometry, for a normal that leans bends its edges unevenly.
    """
    a, b = jnp.asarray(edges).T
    return 0.5 * _along(surface, a, b, take(surface.normals, a) + take(surface.normals, b))


def bend_height(surface: js.RefinedSurface, edges: Int[Array | np.ndarray, "g 2"]) -> Float[Array, "g"]:
    """How high the ends of an edge lie over the tangent planes of each other, in mm, on average; below is negative.

    (n_a - n_b) . (x_b - x_a) / 2: half the curvature along the edge, times its length squared.
    """
    a, b = jnp.asarray(edges).T
    return 0.5 * _along(surface, a, b, take(surface.normals, a) - take(surface.normals, b))


def _along(
    surface: js.RefinedSurface, a: Int[Array, "b"], b: Int[Array, "b"], vectors: Float[Array, "b 3"]
) -> Float[Array, "b"]:
    return dot(vectors, take(surface.vertices, b) - take(surface.vertices, a))[:, 0]


def bend_edges(scheme: js.AbstractScheme, topology: js.Topology) -> Int[Array | np.ndarray, "b 2"]:
    """The edges whose bends are compared: those of the first level, or the control edges where there is one alone."""
    if len(topology.levels) == 1 or not splits_in_four(scheme, topology):
        return control_edges(topology)
    return topology.levels[1].edges


def control_edges(topology: js.Topology) -> Int[np.ndarray, "e 2"]:
    """Edges of the control mesh, each once."""
    return _sides(topology).edges


def splits_in_four(scheme: js.AbstractScheme, topology: js.Topology) -> bool:
    """Whether the descendants of a control face are the rows that the paper's split gives them."""
    n, faces = 4 ** len(topology.levels), topology.faces
    four = all(len(faces[size]) == n * len(of_control) for size, of_control in topology.control_faces.items())
    return four and scheme.is_primal  # a dual scheme's torus of quads has as many faces


def with_control_vertices(
    topology: js.Topology, scheme: js.AbstractScheme, control: js.Control, surface: js.RefinedSurface
) -> js.RefinedSurface:
    """The surface that a control mesh was refined to; or the mesh itself, where its vertices are not on that."""
    if scheme.is_primal:
        return surface
    normals = js.estimate_normals(topology.control_fans, control.vertices)
    return js.RefinedSurface(control.vertices, normals, topology.control_faces)


def _stretch(start: Start, control: js.Control) -> Float[Array, "s"]:
    a, b = jnp.asarray(start.edges).T

    def along(rows: Float[Array, "v 3"]) -> Float[Array, "e 3"]:
        return take(rows, b) - take(rows, a)

    change = along(control.vertices) - along(start.template)
    n = start.control.normals
    across = unit(take(n, a) + take(n, b))
    length = jnp.maximum(norm(along(start.template)), 1e-3 * js.edge_length(start.topology, start.template))
    return ((change - dot(across, change) * across) / length).reshape(-1)


def _anchor_rows(anchors: Anchors, surface: js.RefinedSurface) -> Float[Array, "l"]:
    on = sum_corners(surface.vertices, anchors.corners, anchors.corner_weights)
    return ((on - anchors.points) / anchors.deviations[:, None]).reshape(-1)


def _margin_rows(topology: js.Topology, control: js.Control) -> Float[Array, "c"]:
    rows, normals = [], unit(control.normals)
    for _, faces in sorted(topology.control_faces.items()):
        corners = take(control.vertices, faces)  # at once: every gather is a loop to compile in the derivative
        after, before = (jnp.roll(corners, step, axis=1) - corners for step in (-1, 1))
        rows.append(dot(take(normals, faces), unit(cross(after, before)))[..., 0].T.reshape(-1))
    margin = jnp.concatenate(rows)
    return jax.nn.softplus((_MARGIN - margin) / _MARGIN_SOFTNESS) * (_MARGIN_SOFTNESS / _MARGIN_SPREAD)


class RowFaces(NamedTuple):
    """The control face that every row lies in. Field by field as `Rows`."""

    distance: Int[np.ndarray, "p"]
    bend: Int[np.ndarray, "b"]
    height: Int[np.ndarray, "g"]
    stretch: Int[np.ndarray, "s"]
    margin: Int[np.ndarray, "c"]
    landmark: Int[np.ndarray, "l"]
    rim: Int[np.ndarray, "r"]
    """None yet: every sweep pairs the boundary anew."""
    h: Int[np.ndarray, "n"]


def prior_faces(
    scheme: js.AbstractScheme, topology: js.Topology, anchors: Anchors | None, owner: Int[np.ndarray, "g"], n_h: int
) -> RowFaces:
    """The faces of all rows but the distances' and the heights'.

    Args:
        owner: the control face of every face of the surface.
    """
    triangles, quads = (np.asarray(topology.control_faces[size]) for size in (3, 4))
    sides = _sides(topology)
    of_edge = np.zeros(len(sides.edges), int)
    of_edge[sides.edge] = sides.face  # either of two will do
    bends = of_edge
    if len(bend_edges(scheme, topology)) != len(of_edge):
        # As `build_topology` lays them out: halves of the control edges, three in a triangle, four in a quad.
        bends = np.concatenate([np.repeat(of_edge, 2), sides.face])
    corners = [np.tile(np.arange(len(triangles)), 3), np.tile(len(triangles) + np.arange(len(quads)), 4)]
    return RowFaces(
        distance=np.zeros(0, int),
        bend=bends,
        height=np.zeros(0, int),
        stretch=np.repeat(of_edge, 3),
        margin=np.concatenate(corners) if scheme.uses_normals else np.zeros(0, int),
        landmark=np.zeros(0, int) if anchors is None else np.repeat(owner[np.asarray(anchors.face)], 3),
        rim=np.zeros(0, int),
        h=np.zeros(n_h, int),
    )


def control_faces_of(
    scheme: js.AbstractScheme, topology: js.Topology, surface: js.RefinedSurface, control: js.Control
) -> Int[np.ndarray, "g"]:
    """The control face that every face of the surface descends from; where the split keeps no order, the nearest."""
    triangles, quads = (len(topology.control_faces[size]) for size in (3, 4))
    if splits_in_four(scheme, topology):
        return np.arange((triangles + quads) * 4 ** len(topology.levels)) // 4 ** len(topology.levels)

    def centres(vertices: Array, faces: dict) -> Float[np.ndarray, "f 3"]:
        return np.concatenate([np.asarray(vertices)[np.asarray(faces[size])].mean(axis=1) for size in (3, 4)])

    tree = KDTree(centres(control.vertices, topology.control_faces))
    return np.asarray(tree.query(centres(surface.vertices, surface.faces))[1])


def _sides(topology: js.Topology) -> HalfEdges:
    """Half-edges of the control mesh."""
    return half_edges({size: np.asarray(faces) for size, faces in topology.control_faces.items()})
