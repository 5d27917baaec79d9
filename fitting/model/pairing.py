"""What a sweep needs to know of the scan: pairs, their weights, and the noise that the distances show."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv import corner_weights
from jaxsubdiv.linalg import dot, norm, unit

from ..scan.closest_points import boundary_vertices, nearest_rows
from ..scan.outliers import NEIGHBOURS, is_dense, rows_for_density, scattered_points
from ..scan.scan import Scan
from ..scan.slices import Strokes, find_strokes
from .priors.shifts import SlicePlanes
from .residual import Pairs
from .robust import AbstractLoss, noise_scale

LEAST_NOISE = 1e-4  # in control edges: a perfect scan would have none, and its points infinite weight
_BOUNDARY_SCALE = 1 / 3  # least scale of the loss at an open boundary, in control edges
_ON_BOUNDARY = 1e-3  # how far, in parts of a face, a surface point may lie from a boundary and count as on it
_NEIGHBOURS = 9
_CLEAN = 0.9  # of the points crowded: so few outliers that neighbours can be trusted
_STEEPEST = 0.5  # height over length: by how much the anatomy may turn away beyond a boundary
_ON_SURFACE = 1e-6  # in control edges: the same, where there is no noise and at open boundaries
_NEAR = 0.3  # times the noise: distances of closer points count along the surface's normal
_LEAST_COSINE = 0.5  # between a scan's normal and the surface's: beyond 60 degrees it is the other side of something


class Look(NamedTuple):
    """The scan as seen from one surface; lengths in mm."""

    at: js.SurfacePoint
    """The surface point closest to every scan point."""
    pairs: Pairs
    distances: Float[Array, "p"]
    """Signed, positive outside."""
    weights: Float[Array, "p"]
    """Given weight times the robust one."""
    precisions: Float[Array, "p"]
    """1 / variance of every distance, in 1/mm^2, as far as the point counts."""
    noise: Float[Array, ""]
    """Standard deviation of the Gaussian part of the distances."""
    scale: Float[Array, ""]
    """Of the robust loss: the noise, or what the annealing keeps it at."""
    rms: Float[Array, ""]
    robust_rms: Float[Array, ""]


class Surroundings(NamedTuple):
    """What every scan point has around it."""

    crowded: Bool[Array | np.ndarray, "p"]
    """Whether other points are near, as they are not around scattered outliers."""
    scattered: Bool[Array | np.ndarray, "p"]
    """Whether it and the points near it lie in space, on no surface: it has no say."""
    trusted: Bool[Array | np.ndarray, "p"]
    """Whether what it has in common with its neighbours counts: in a scan of few scattered points, where crowded; not
    in slices, which may be displaced as a whole."""
    neighbours: Int[Array | np.ndarray, "p k"]
    """Rows of the nearest points, without itself."""


def surroundings(scan: Scan) -> Surroundings:
    """The surroundings of a scan, which stay what they are while the surface moves."""
    counted = np.flatnonzero(np.asarray(scan.weights_or_ones()) > 0)  # the others are as if they were not there
    points = np.asarray(scan.points)[counted]
    crowded, scattered = np.zeros((2, scan.n_points), bool)
    neighbours = np.zeros((scan.n_points, min(_NEIGHBOURS, max(len(counted) - 1, 1))), np.int32)
    if len(counted):
        apart = counted[rows_for_density(points)]
        others = points if len(apart) == len(counted) else np.asarray(scan.points)[apart]
        distances, rows = nearest_rows(KDTree(others), points, min(NEIGHBOURS + 1, len(others)))
        crowded[counted] = is_dense(distances[:, -1])
        scattered[counted] = scattered_points(points, crowded[counted])
        if len(others) > 1:
            near = apart[rows[:, 1 : _NEIGHBOURS + 1]]
            neighbours[counted, : near.shape[1]] = near
    clean = scan.slices is None and crowded.sum() > _CLEAN * len(counted)
    return Surroundings(crowded, scattered, crowded & clean, neighbours)


class Scene(NamedTuple):
    """A scan, and what of it stays the same while the surface moves: the `args` of a fit's solver."""

    scan: Scan
    """Without its slices."""
    around: Surroundings
    strokes: Strokes | None
    of_points: Int[Array | np.ndarray, "p"] | None
    """The row of the slice of each point that may be shifted, -1 where it stays; None where none may."""
    open_vertices: Bool[Array | np.ndarray, "v"]
    """Which vertices of the surface lie on a boundary."""
    choice: js.FaceChoice | None = None
    """The faces of the surface that each point may be paired with; None where all may be with any."""


def make_scene(
    scan: Scan, surface: js.RefinedSurface, planes: SlicePlanes | None = None, choice: js.FaceChoice | None = None
) -> Scene:
    """The scene of a scan.

    Args:
        surface: any that has the faces of those to come.
        planes: of the slices that may be shifted.
        choice: the faces that each point may be paired with; default: all.
    """
    of_points = None if planes is None else planes.rows_of(scan)
    open_vertices = boundary_vertices(surface)
    return Scene(scan.drop_slices(), surroundings(scan), find_strokes(scan), of_points, open_vertices, choice)


def empty_look(scene: Scene) -> Look:
    """What is known before the first look: nothing."""
    points = jnp.asarray(scene.scan.points)
    n, none = len(points), jnp.zeros_like(points[:, 0])
    corners, zero = jnp.zeros((n, 4), jnp.int32), jnp.zeros((), points.dtype)
    pairs = Pairs(points, corners, jnp.zeros((n, 4), points.dtype), jnp.zeros_like(points))
    at = js.SurfacePoint(jnp.zeros(n, jnp.int32), jnp.zeros((n, 2), points.dtype))
    return Look(at, pairs, none, none, none, zero, zero, zero, zero)


@eqx.filter_jit
def measure(
    surface: js.RefinedSurface,
    scene: Scene,
    points: Float[Array, "p 3"],
    at: js.SurfacePoint,
    edge: Float[Array, ""],
    floor: Float[Array, ""],
    loss: AbstractLoss,
    covered: Bool[Array | np.ndarray, "v"] | None = None,
) -> Look:
    """Weigh pairs of scan points and their closest points of the surface by how far apart they lie.

    Args:
        points: of the scan, with the shifts of their slices put on.
        at: the closest point of the surface of each.
        edge: length of a control edge in mm.
        floor: the least scale of the loss in mm.
        loss: how a point loses weight with its distance.
        covered: vertices of the boundary that lie where they should: points beyond them do not count.
    """
    scan, around, open_vertices = scene.scan, scene.around, scene.open_vertices
    on, normals = js.evaluate(surface, at)
    away = points - on
    distance, spread = norm(away)[:, 0], scan.relative_deviations()
    given = jnp.where(around.scattered, 0.0, scan.relative_weights())
    corners, inside = corner_weights(surface, at)
    at_boundary = is_on_boundary(open_vertices, corners, inside)
    if scan.normals is not None:
        cosine = dot(unit(scan.normals), normals)[:, 0]
        # Files have normals of either side: the side that most points are on is outside.
        given = jnp.where(cosine * jnp.sign(jnp.sum(cosine)) < _LEAST_COSINE, 0.0, given)
    # Beyond a boundary the distance runs along the surface, and says nothing of the noise across it.
    noise = noise_scale(distance / spread, jnp.where(at_boundary, 0.0, given))
    scale = jnp.maximum(noise, floor)
    # Near a boundary the surface may have to grow, by up to a control edge, to points that go on as it does: what is
    # farther is not covered by the mesh, and outliers lie there in all directions.
    at_its_scale = jnp.where(at_boundary, jnp.maximum(scale, edge * _BOUNDARY_SCALE), scale * spread)
    signed = jnp.where(dot(normals, away)[:, 0] < 0, -distance, distance)
    # What a point has in common with its neighbours is the surface's error, not the point's: a nose that the control
    # mesh has yet to reach is no outlier. Where scattered points are many, they have neighbours of their own kind.
    common = jnp.median(signed[around.neighbours], axis=1)
    shared = around.trusted & (jnp.abs(common) < edge) & ~at_boundary
    own = jnp.where(shared, jnp.minimum(distance, jnp.abs(signed - common)), distance)
    weights = given * loss.weight(own / at_its_scale)
    across = jnp.abs(dot(normals, away))[:, 0]
    goes_on = around.crowded & (distance < edge) & (across < 3 * scale * spread + _STEEPEST * distance)
    if covered is not None:
        goes_on &= ~is_on_boundary(covered, corners, inside)
    weights = jnp.where(at_boundary & ~goes_on, 0.0, weights)
    alike = jnp.ones((), points.dtype)
    if scene.strokes is not None:
        alike = scene.strokes.count_points_a_measurement(signed, weights)
    # The derivative of a distance is along it: across the face, or from the edge or boundary that is closest. But the
    # direction to a point within the noise is itself noise, and in the end rounding, which would move control vertices
    # along the surface, where little holds them; the surface's normal is none.
    side = jnp.where(signed < 0, -1.0, 1.0)
    near = jnp.maximum(jnp.where(at_boundary, 0.0, _NEAR * noise), edge * _ON_SURFACE)
    directions = unit((side * near**2)[:, None] * normals + distance[:, None] * away)
    return Look(
        at=at,
        pairs=Pairs(points, corners, inside, directions),
        distances=signed,
        weights=weights,
        precisions=weights / (scale * spread) ** 2 / alike,
        noise=noise,
        scale=scale,
        rms=_mean_root(distance, scan.relative_weights()),
        robust_rms=_mean_root(distance, weights),
    )


def is_on_boundary(
    boundary: Bool[Array | np.ndarray, "v"],
    corners: Int[Array | np.ndarray, "p 4"],
    corner_weights: Float[Array | np.ndarray, "p 4"],
) -> Bool[Array, "p"]:
    """Which surface points lie on the boundary, of whose vertices `boundary` is true."""
    return jnp.sum(jnp.where(jnp.asarray(boundary)[corners], corner_weights, 0.0), axis=1) > 1 - _ON_BOUNDARY


def _mean_root(distance: Float[Array, "p"], weights: Float[Array, "p"]) -> Float[Array, ""]:
    total = jnp.sum(weights)
    return jnp.sqrt(jnp.sum(weights * distance**2) / jnp.where(total > 0, total, 1.0))
