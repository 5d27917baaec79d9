"""A member of a family of shapes put where a scan is: pose and scores found together. On the host."""

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

import jaxsubdiv as js

from ..scan.closest_points import closest_points
from ..scan.scan import Scan

_FIRST_STEPS, _STEPS, _POINTS = 8, 30, 1500  # of every start; of the best one
_LEADING, _AWAY = 2, 1.5  # other starts: along so many modes, by so many standard deviations either way
_CUT = 4.685  # Tukey's, in robust standard deviations
_MAD = 1.4826
_ALONG = 0.1  # of the pull across a face: flat faces would slide along each other without end
_MOVED, _ROUNDING = 1e-4, 1e-9  # of the size: a smaller step ends the search; points that lie on a member
Faces: TypeAlias = Mapping[int, Int[np.ndarray, "_ c"]]


class Member(NamedTuple):
    """A member of a family where a scan is."""

    vertices: Float[np.ndarray, "v 3"]
    """In mm, in the scan's frame."""
    scores: Float[np.ndarray, "k"]
    """In standard deviations of the family."""


def place_member(
    mean: Float[np.ndarray, "v 3"],
    modes: Float[np.ndarray, "k v 3"],
    placed: js.ControlMesh,
    scan: Scan,
) -> Member:
    """The member of a family that lies nearest to a scan, of the more probable ones.

    From every start, points are paired with their closest places on the flat faces in turns with Gauss-Newton steps on
    pose and scores together, with Tukey's weights. Neighbouring points share what the family lacks: all points together
    count no more than the control vertices do. Starts are the mean where it was put, and there the members that lie 1.5
    standard deviations away along the first two modes.

    Args:
        mean: of the family, in mm.
        modes: by how much one standard deviation along each moves the vertices, in mm.
        placed: the mean, or another mesh with its vertices, aligned with the scan.
        scan: in mm; it may show a part.

    Source: T. Cootes et al., Active shape models, 1995; S. Bouaziz et al., Dynamic 2D/3D registration, 2014 (pose and
    shape by one system).
    """
    points = np.asarray(scan.points, np.float64)
    if scan.weights is not None:
        points = points[np.asarray(scan.weights) > 0]
    points = points[np.random.default_rng(0).permutation(len(points))[:_POINTS]]
    place = _Place.of(mean, placed.vertices)
    starts = [np.zeros(len(modes))]
    for mode in range(min(_LEADING, len(modes))):
        starts += [way * _AWAY * np.eye(len(modes))[mode] for way in (-1, 1)]
    found = [_search(place, scores, mean, modes, placed.faces, points, _FIRST_STEPS) for scores in starts]
    off = [_pair(place.apply(mean + np.tensordot(scores, modes, 1)), placed.faces, points) for place, scores in found]
    near = 3 * min(np.median(pairs.distances) for pairs in off) + np.finfo(float).tiny
    # Source: Torr and Zisserman 2000 (MSAC): farther points have no say.
    best = int(np.argmin([np.mean(np.minimum(pairs.distances / near, 1.0) ** 2) for pairs in off]))
    place, scores = _search(*found[best], mean, modes, placed.faces, points, _STEPS)
    return Member(place.apply(mean + np.tensordot(scores, modes, 1)), scores)


class _Place(NamedTuple):
    """x -> turn @ x + shift."""

    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, shape: Float[np.ndarray, "v 3"], there: Float[np.ndarray, "v 3"]) -> "_Place":
        """The rigid motion that takes a shape nearest to its vertices there."""
        shape, there = np.asarray(shape, np.float64), np.asarray(there, np.float64)
        turn = Rotation.align_vectors(there - there.mean(axis=0), shape - shape.mean(axis=0))[0]
        return cls(turn.as_matrix(), there.mean(axis=0) - turn.apply(shape.mean(axis=0)))

    def apply(self, x: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
        """Positions there."""
        return x @ self.turn.T + self.shift


def flat_surface(vertices: Float[np.ndarray, "v 3"], faces: Faces) -> js.RefinedSurface:
    """The flat faces of a mesh, without normals."""
    there = jnp.asarray(vertices)
    return js.RefinedSurface(there, jnp.zeros_like(there), {size: jnp.asarray(rows) for size, rows in faces.items()})


class _Pairs(NamedTuple):
    """Points beside their closest places on the flat faces of a member."""

    corners: Int[np.ndarray, "p 4"]
    inside: Float[np.ndarray, "p 4"]
    """Weights of the corners."""
    on: Float[np.ndarray, "p 3"]
    sides: Float[np.ndarray, "p 3"]
    """Unit normals of the faces."""
    distances: Float[np.ndarray, "p"]


def _pair(vertices: Float[np.ndarray, "v 3"], faces: Faces, points: Float[np.ndarray, "p 3"]) -> _Pairs:
    surface = flat_surface(vertices, faces)
    corners, inside = (np.asarray(rows) for rows in js.corner_weights(surface, closest_points(surface, points)))
    on = np.einsum("pc,pcx->px", inside, vertices[corners])
    first = vertices[corners[:, 0]]
    sides = np.cross(vertices[corners[:, 1]] - first, vertices[corners[:, 2]] - first)
    sides /= np.maximum(np.linalg.norm(sides, axis=1, keepdims=True), np.finfo(float).tiny)
    return _Pairs(corners, inside, on, sides, np.linalg.norm(points - on, axis=1))


def _search(
    place: _Place,
    scores: Float[np.ndarray, "k"],
    mean: Float[np.ndarray, "v 3"],
    modes: Float[np.ndarray, "k v 3"],
    faces: Faces,
    points: Float[np.ndarray, "p 3"],
    steps: int,
) -> tuple[_Place, Float[np.ndarray, "k"]]:
    """Where one start leads."""
    counted, size = min(1.0, len(mean) / len(points)), float(np.linalg.norm(np.ptp(mean, axis=0)))
    there = place.apply(mean + np.tensordot(scores, modes, 1))
    for _ in range(steps):
        pairs = _pair(there, faces, points)
        scale = _MAD * float(np.median(pairs.distances)) + _ROUNDING * size
        weights = np.maximum(1 - (pairs.distances / (_CUT * scale)) ** 2, 0) ** 2 * counted / scale**2
        middle = there.mean(axis=0)
        turns = np.stack([np.cross(axis, pairs.on - middle) for axis in np.eye(3)])
        shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
        of_modes = np.einsum("pc,kpcx->kpx", pairs.inside, (modes @ place.turn.T)[:, pairs.corners])
        motions, gap = np.concatenate([shifts, turns, of_modes]), points - pairs.on
        across = np.sum(motions * pairs.sides, axis=2)
        normal = (across * weights) @ across.T + _ALONG * np.einsum("ipx,jpx,p->ij", motions, motions, weights)
        side = (across * weights) @ np.sum(gap * pairs.sides, axis=1)
        side += _ALONG * np.einsum("ipx,px,p->i", motions, gap, weights)
        normal[6:, 6:] += np.eye(len(modes))
        side[6:] -= scores
        step = np.linalg.lstsq(normal, side, rcond=None)[0]
        turn = Rotation.from_rotvec(step[3:6]).as_matrix()
        place = _Place(turn @ place.turn, turn @ (place.shift - middle) + middle + step[:3])
        scores = scores + step[6:]
        before, there = there, place.apply(mean + np.tensordot(scores, modes, 1))
        if np.abs(there - before).max() < _MOVED * size:
            break
    return place, scores
