"""Mirror images: which control vertices are, and the prior that keeps a fit symmetric about a plane that it finds."""

from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv.closest import AnyArray
from jaxsubdiv.errors import name_rows
from jaxsubdiv.half_edges import half_edges
from jaxsubdiv.linalg import unit

from ..unknowns import Shared, tangents
from .base import AbstractVertexPrior, Place, Start

_ROUNDS = 3  # of pairing and taking the plane from the pairs: the first plane is from one pair
_PROBES, _PLAUSIBLE = 32, 0.2  # vertices that a plane is tried on, and how near, in edges, half of them must come
_LEVER = 1 / 8  # of an edge: by eq. (2) an edge point moves by so much for a normal that turns by one radian


class Plane(NamedTuple):
    """A mirror."""

    middle: Float[Array | np.ndarray, "3"]
    """A point on it, in mm."""
    normal: Float[Array | np.ndarray, "3"]
    """Of unit length."""

    def mirror(self, points: AnyArray) -> AnyArray:
        """Points `[p, 3]` on the other side."""
        return points - 2 * ((points - self.middle[None]) @ self.normal)[:, None] * self.normal[None]


class Symmetry(NamedTuple):
    """The mirror plane of a control mesh, and which of its vertices are mirror images of each other."""

    partner: Int[np.ndarray, "v"]
    """Of every control vertex the one on the other side; itself where it lies on the plane."""
    plane: Plane

    def mirror(self, vertices: ArrayLike) -> Float[np.ndarray, "v 3"]:
        """Where the vertices of this mesh, moved, would be if each were the mirror image of its partner.

        The plane is the one that leaves the least root mean square between the two: the distance of these from the
        vertices is the asymmetry of the anatomy, in mm.
        """
        vertices = np.asarray(vertices, np.float64)
        return _plane_of(self.partner, vertices).mirror(vertices[self.partner])


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
        if np.median(tree.query(plane.mirror(probes))[0]) > _PLAUSIBLE * edge:
            continue
        partner = own
        for _ in range(_ROUNDS):
            partner = np.asarray(tree.query(plane.mirror(vertices))[1])
            plane = _plane_of(partner, vertices)
        away = np.linalg.norm(plane.mirror(vertices[partner]) - vertices, axis=1)
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


class _Held(NamedTuple):
    """What a sweep holds of the prior."""

    plane: Plane
    turns: Float[Array, "2 3"]
    """Directions that the normal of the plane may turn to."""
    extent: Float[Array, ""]
    """Size of the mesh in mm: a turn of 1 / extent moves its outer parts by 1 mm."""
    lever: Float[Array, ""]
    """By how much the surface moves, in mm, for a normal that turns by one radian."""


class SymmetryPrior(AbstractVertexPrior):
    """Control vertices are the mirror images of their partners, and control normals are, as far as they move the
    surface.

    The plane moves along: a step solves for it too, for a plane that is found from the vertices alone would follow
    them, and they it, little by little.

    Attributes:
        left, right: pairs of control vertices, each once.
        on_plane: those that are their own images.
        deviation: standard deviation in mm.
    """

    name: ClassVar[str] = "symmetry"
    uses: ClassVar[tuple[str, ...]] = ("mirror",)
    left: Int[Array | np.ndarray, "m"]
    right: Int[Array | np.ndarray, "m"]
    on_plane: Int[Array | np.ndarray, "o"]
    partner: Int[Array | np.ndarray, "v"]
    deviation: Float[Array | np.ndarray, ""]
    with_normals: bool = eqx.field(static=True)

    @classmethod
    def make(cls, priors: Any, start: Start) -> "SymmetryPrior | None":
        symmetry = start.inputs.get("symmetry")
        if symmetry is None:
            return None
        partner, own = np.asarray(symmetry.partner), np.arange(len(symmetry.partner))
        left = np.flatnonzero(own < partner)
        alone = np.flatnonzero(own == partner)
        return cls(left, partner[left], alone, partner, priors.symmetry, start.has_normals)

    def shared_unknowns(self) -> dict[str, Shared]:
        return {"mirror": Shared((3,), lasting=False)}

    def hold(self, place: Place, strengths: dict[str, Any]) -> _Held:
        vertices = place.control.vertices
        middle, normal = _plane_of(self.partner, vertices, jnp)
        turns = jnp.stack(tangents(normal[None]), axis=1)[0]
        extent = jnp.sqrt(jnp.mean(jnp.sum((vertices - middle[None]) ** 2, axis=1)))
        return _Held(Plane(middle, normal), turns, extent, _LEVER * js.edge_length(place.topology, vertices))

    def rows(self, place: Place, held: _Held) -> Float[Array, "m"]:
        """Three a pair, one a vertex on the plane; likewise those of the normals."""
        shift, turn = place.shared["mirror"][0], place.shared["mirror"][1:] / held.extent
        normal = unit(held.plane.normal + turn @ held.turns)
        parts = [place.control.vertices - (held.plane.middle + shift * held.plane.normal)[None]]
        if self.with_normals:
            parts.append(held.lever * place.control.normals)
        found = []
        for values in parts:
            image = values - 2 * (values @ normal)[:, None] * normal[None]
            found += [(values[self.left] - image[self.right]).reshape(-1), values[self.on_plane] @ normal]
        return jnp.concatenate(found)

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return self.deviation**-2

    def vertices(self) -> Int[AnyArray, "m 2"]:
        pairs = np.repeat(np.stack([self.left, self.right], axis=1), 3, axis=0)
        alone = np.stack([self.on_plane, np.full(len(self.on_plane), -1)], axis=1)
        return np.concatenate([pairs, alone] * (2 if self.with_normals else 1))


def _plane_of(partner: AnyArray, vertices: AnyArray, xp: Any = np) -> Plane:
    """The plane that leaves the least between vertices and the mirror images of their partners.

    It goes through their middle; with the pairs (a, b) about that, the squares add up to a constant and four times the
    sum of (m . a) (m . b), for the normal m.
    """
    middle = vertices.mean(axis=0)
    y = vertices - middle[None]
    products = y.T @ y[partner]
    return Plane(middle, xp.linalg.eigh(products + products.T)[1][:, 0])


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
