"""Mirror images: which control vertices are, and the prior that keeps a fit symmetric about a plane that it finds.

The rows of the prior tie vertices on opposite sides of the mesh, so that they lie in no control face; but they are
linear in the vertices, and their derivatives need no program. The plane moves along: a step solves for it too.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv.errors import name_rows
from jaxsubdiv.half_edges import half_edges
from jaxsubdiv.linalg import unit

from ...scan.closest_points import AnyArray
from ..unknowns import Unknowns, tangents

_ROUNDS = 3  # of pairing and taking the plane from the pairs: the first plane is from one pair
_PROBES, _PLAUSIBLE = 32, 0.2  # vertices that a plane is tried on, and how near, in edges, half of them must come
_LEVER = 1 / 8  # of an edge: by eq. (2) an edge point moves by so much for a normal that turns by one radian

Solve = Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, "n k"]]


class Plane(NamedTuple):
    """A mirror."""

    middle: Float[Array | np.ndarray, "3"]
    """A point on it, in mm."""
    normal: Float[Array | np.ndarray, "3"]
    """Of unit length."""

    def mirrored(self, points: AnyArray) -> AnyArray:
        """Points `[p, 3]` on the other side."""
        return points - 2 * ((points - self.middle[None]) @ self.normal)[:, None] * self.normal[None]


class Symmetry(NamedTuple):
    """The mirror plane of a control mesh, and which of its vertices are mirror images of each other."""

    partner: Int[np.ndarray, "v"]
    """Of every control vertex the one on the other side; itself where it lies on the plane."""
    plane: Plane

    def mirrored(self, vertices: ArrayLike) -> Float[np.ndarray, "v 3"]:
        """Where the vertices of this mesh, moved, would be if each were the mirror image of its partner.

        The plane is the one that leaves the least root mean square between the two: the distance of these from the
        vertices is the asymmetry of the anatomy, in mm.
        """
        vertices = np.asarray(vertices, np.float64)
        return _plane_of(self.partner, vertices).mirrored(vertices[self.partner])


def find_symmetry(mesh: js.ControlMesh, *, tolerance: float = 0.05) -> Symmetry:
    """The mirror plane of a mesh, which templates of symmetric anatomy have.

    Of several planes it is the one most nearly across x, which is left to right in scanners' coordinates.

    Args:
        mesh: in any pose.
        tolerance: how far a vertex may be from the mirror image of its partner, in edges (root mean square length).

    Raises:
        ValueError: there is no plane about which every vertex has a partner; the text names those that have none.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    a, b = half_edges({size: np.asarray(faces) for size, faces in mesh.faces.items()}).edges.T
    edge = float(np.sqrt(np.mean(np.sum((vertices[a] - vertices[b]) ** 2, axis=1))))
    near, tree = tolerance * edge, KDTree(vertices)
    probes = vertices[:: max(len(vertices) // _PROBES, 1)]
    own = np.arange(len(vertices))
    best, lonely = None, own
    for plane in _candidates(vertices, near):
        if np.median(tree.query(plane.mirrored(probes))[0]) > _PLAUSIBLE * edge:
            continue
        partner = own
        for _ in range(_ROUNDS):
            partner = np.asarray(tree.query(plane.mirrored(vertices))[1])
            plane = _plane_of(partner, vertices)
        away = np.linalg.norm(plane.mirrored(vertices[partner]) - vertices, axis=1)
        alone = np.flatnonzero((away > near) | (partner[partner] != own))
        if (partner == own).all():  # a flat mesh is its own image in its own plane
            continue
        if len(alone) < len(lonely):
            lonely = alone
        if not len(alone) and (best is None or abs(plane.normal[0]) > abs(best.plane.normal[0]) + 1e-6):
            best = Symmetry(partner, plane)
    if best is None:
        raise ValueError(
            f"the control mesh has no mirror plane: about the best one vertices {name_rows(lonely)} have no partner "
            f"within {near:.3g} mm ({tolerance:g} edges). Give a larger `tolerance`, a mesh that is symmetric, or a "
            "`Symmetry` found on the template before it was changed."
        )
    return best


def symmetry_of(partner: ArrayLike, vertices: Float[np.ndarray, "v 3"]) -> Symmetry:
    """The symmetry of vertices whose partners are known.

    Raises:
        ValueError: there are not as many, or some are not the partners of their partners.
    """
    partner, n_vertices = np.asarray(partner), len(vertices)
    if partner.shape != (n_vertices,):
        raise ValueError(f"`symmetry` has {len(partner)} partners for {n_vertices} control vertices.")
    wrong = (partner < 0) | (partner >= n_vertices)
    wrong[~wrong] = partner[partner[~wrong]] != np.flatnonzero(~wrong)
    if wrong.any():
        raise ValueError(
            f"`symmetry`: vertices {name_rows(np.flatnonzero(wrong))} are not the partners of their partners. Take it "
            "from `find_symmetry`."
        )
    return Symmetry(partner, _plane_of(partner, np.asarray(vertices, np.float64)))


class Mirror(NamedTuple):
    """The prior about one place: what a sweep holds of it, and the refit."""

    left: Int[Array | np.ndarray, "m"]
    right: Int[Array | np.ndarray, "m"]
    """Pairs of control vertices, each once."""
    on_plane: Int[Array | np.ndarray, "o"]
    plane: Plane
    deviation: Float[Array | np.ndarray, ""]
    lever: Float[Array | np.ndarray, ""] | None
    """By how much the surface moves, in mm, for a normal that turns by one radian; None where normals are not tied."""

    def rows(self, control: js.Control, xp: Any = np) -> AnyArray:
        """Departures from symmetry over their standard deviation: three a pair, one a vertex on the plane; likewise
        those of the normals."""
        parts: list[AnyArray] = [control.vertices - self.plane.middle[None]]
        if self.lever is not None:
            parts.append(self.lever * control.normals)
        found = []
        for values in parts:
            image = values - 2 * (values @ self.plane.normal)[:, None] * self.plane.normal[None]
            found += [(values[self.left] - image[self.right]).reshape(-1), values[self.on_plane] @ self.plane.normal]
        return xp.concatenate(found) / self.deviation


class Ties(NamedTuple):
    """The rows of a mirror about one place, and their derivatives."""

    rows: Float[np.ndarray, "m"]
    by: sp.csr_array
    """By the unknowns `[m, n]`, the plane held."""
    by_plane: Float[np.ndarray, "m 3"]
    """By a shift of the plane and its two turns."""

    def with_plane(self, step: Float[np.ndarray, "n"], solve: Solve, is_free: np.ndarray) -> Float[np.ndarray, "n"]:
        """The step of unknowns and plane together, from the step with the plane held.

        Without it a strong prior would hold a mesh that starts beside its place where it is: the plane, found from the
        vertices, would follow them, and they it, little by little.

        Args:
            solve: with the matrix of the step with the plane held.
            is_free: which unknowns it is of.
        """
        across = self.by.T @ self.by_plane
        moved = solve(across[is_free])
        own = self.by_plane.T @ self.by_plane - across[is_free].T @ moved
        shift = np.linalg.lstsq(own, -(self.by_plane.T @ self.rows + across.T @ step), rcond=None)[0]
        step = step.copy()
        step[is_free] -= moved @ shift
        return step


def mirror_at(
    symmetry: Symmetry, deviation: float, topology: js.Topology, control: js.Control, zero: Unknowns
) -> Mirror:
    """The prior about a control mesh, whose best plane it takes.

    Args:
        deviation: standard deviation in mm.
        zero: the unknowns.
    """
    partner, own = np.asarray(symmetry.partner), np.arange(len(symmetry.partner))
    left = np.flatnonzero(own < partner)
    vertices = np.asarray(control.vertices, np.float64)
    return Mirror(
        left,
        partner[left],
        np.flatnonzero(own == partner),
        _plane_of(partner, vertices),
        np.asarray(float(deviation)),
        None if zero.normals is None else np.asarray(_LEVER * float(js.edge_length(topology, control.vertices))),
    )


def ties(mirror: Mirror, control: js.Control, zero: Unknowns) -> Ties:
    """Rows and derivatives about a control whose normals are unit."""
    vertices, normals = (np.asarray(part, np.float64) for part in (control.vertices, unit(control.normals)))
    rows = mirror.rows(js.Control(vertices, normals))
    n_vertices, width = len(vertices), 3 * (zero.vertices is not None) + 2 * (zero.normals is not None)
    n = n_vertices * width + (0 if zero.h is None else zero.h.size)
    left, right, alone, m = (np.asarray(part) for part in (*mirror[:3], mirror.plane.normal))

    def picked(which: Int[np.ndarray, "k"]) -> sp.csr_array:
        return sp.csr_array((np.ones(len(which)), (np.arange(len(which)), which)), shape=(len(which), n_vertices))

    pairs = sp.kron(picked(left), np.eye(3)) - sp.kron(picked(right), np.eye(3) - 2 * np.outer(m, m))
    fold = sp.vstack([pairs, sp.kron(picked(alone), m[None])])
    # How three coordinates a vertex move with the unknowns: of the vertices, then of the normals times the lever.
    at, blocks = np.arange(n_vertices), []
    if zero.vertices is None:
        blocks.append(sp.csr_array((3 * n_vertices, n)))
    else:
        blocks.append(_placed(np.tile(np.eye(3), (n_vertices, 1, 1)), width * at, n))
    parts = [(vertices - mirror.plane.middle, 1.0)]
    if mirror.lever is not None:
        parts.append((float(mirror.lever) * normals, 0.0))
        both = np.stack([np.asarray(part, np.float64) for part in tangents(unit(control.normals))], axis=2)
        blocks.append(_placed(both, width * at + width - 2, n))  # the unknowns are scaled by the lever
    by = sp.vstack([fold @ block for block in blocks]).tocsr() / float(mirror.deviation)

    u, w = np.linalg.svd(m[None])[2][1:]
    by_plane = []
    for values, shifts in parts:
        there = values[right]
        turns = [2 * ((there @ t)[:, None] * m + (there @ m)[:, None] * t) for t in (u, w)]
        of_pairs = np.stack([np.tile(-2 * shifts * m, (len(there), 1)), *turns], axis=2).reshape(-1, 3)
        of_alone = np.stack([np.full(len(alone), -shifts), values[alone] @ u, values[alone] @ w], axis=1)
        by_plane += [of_pairs, of_alone]
    return Ties(rows, by, np.concatenate(by_plane) / float(mirror.deviation))


def _placed(blocks: Float[np.ndarray, "v 3 c"], first: Int[np.ndarray, "v"], n: int) -> sp.csr_array:
    """Rows of three a vertex, each block from its first column on."""
    n_vertices, _, width = blocks.shape
    columns = np.broadcast_to((first[:, None] + np.arange(width))[:, None], blocks.shape)
    ends = np.arange(0, 3 * n_vertices * width + 1, width)
    return sp.csr_array((blocks.ravel(), columns.ravel(), ends), shape=(3 * n_vertices, n))


def _plane_of(partner: Int[np.ndarray, "v"], vertices: Float[np.ndarray, "v 3"]) -> Plane:
    """The plane that leaves the least between vertices and the mirror images of their partners.

    It goes through their middle; with the pairs (a, b) about that, the squares add up to a constant and four times the
    sum of (m . a) (m . b), for the normal m.
    """
    middle = vertices.mean(axis=0)
    y = vertices - middle
    products = y.T @ y[partner]
    return Plane(middle, np.linalg.eigh(products + products.T)[1][:, 0])


def _candidates(vertices: Float[np.ndarray, "v 3"], near: float) -> Iterator[Plane]:
    """Planes that could be mirrors: all those that can be, and the principal ones, which noise moves least.

    A mirror leaves the middle where it is, and so every distance from it. It takes the farthest vertex to another at
    its distance, or leaves it; then the one farthest from the line between goes to another, or stays too: all planes.
    """
    middle = vertices.mean(axis=0)
    y = vertices - middle
    normals = list(np.linalg.eigh(y.T @ y)[1].T)
    radius = np.linalg.norm(y, axis=1)
    first = int(np.argmax(radius))
    along = y[first] / max(radius[first], np.finfo(float).tiny)
    second = int(np.argmax(np.linalg.norm(y - (y @ along)[:, None] * along, axis=1)))
    for one in (first, second):
        others = np.flatnonzero(np.abs(radius - radius[one]) <= 2 * near)
        normals += list((y[one] - y[others])[others != one])
    normals.append(np.cross(y[first], y[second]))
    for normal in normals:
        length = np.linalg.norm(normal)
        if length > 0:
            yield Plane(middle, normal / length)
