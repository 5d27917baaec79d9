"""A template's landmarks on the surface that was fitted: the same places, where the anatomy of the scan has them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

import jaxsubdiv as js
from jaxsubdiv.notices import warn

from ..report.cohort import Cohort
from ..report.coverage import unit
from ..report.result import FitResult
from ..scan.closest_points import closest_points
from ..scan.landmarks import Landmarks
from ..scan.scan import ScanError
from ..start.align import mirror_image
from .fit_scan import first_control, split


class CarriedLandmarks(NamedTuple):
    """A template's landmarks on a fitted surface, row by row."""

    names: tuple[str, ...]
    points: Float[np.ndarray, "l 3"]
    """In mm, where the scan is."""
    covariances: Float[np.ndarray, "l 3 3"]
    """Of each place, in mm^2: posterior to scan and priors, with the misfit across the surface (see `Uncertainty`). How
    the surface may slide along itself is in it only as far as the priors say: a scan without landmarks shows where the
    surface is, and not which of its places is which. How far the template's landmarks are off themselves is not in it,
    nor how an offset turns with the surface."""
    offsets: Float[np.ndarray, "l"]
    """How far in mm each lies from the fitted surface, positive outside."""
    at: js.SurfacePoint
    """Where on the fitted surface."""

    @property
    def positions(self) -> dict[str, Float[np.ndarray, "3"]]:
        """By name, for `write_landmarks` and `match_landmarks`."""
        return dict(zip(self.names, self.points, strict=True))

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of each in mm, in all directions together: the root of the trace of its covariance."""
        of_all = np.sqrt(np.maximum(np.trace(self.covariances, axis1=1, axis2=2), 0))
        return dict(zip(self.names, of_all.tolist(), strict=True))


def carry_landmarks(
    template: js.ControlMesh, result: FitResult, landmarks: Mapping[str, ArrayLike]
) -> CarriedLandmarks:
    """Put a template's landmarks onto the surface that it was fitted to.

    Each landmark is at the point of the template's refined surface that is closest to it: a face, and where in it. The
    fit moves that point; there the landmark is again. Where it does not lie on the template's surface, it keeps its
    offset in the frame that the surface has there, of its normal and a side of the face, in proportion to the size of
    the surface.

    Args:
        template: as it was given to `fit_scan`, before any alignment.
        result: of the fit; where it asked for the mirror image or was split, that is taken into account.
        landmarks: positions on the template by name, as `read_landmarks` gives them.

    Raises:
        ScanError: a position is not three finite numbers, or the control mesh of the fit does not come from the
            template.

    Warns:
        UserWarning: landmarks lie farther than a control edge from the template's surface.
    """
    names = tuple(landmarks)
    places = _positions(landmarks)
    recipe, topology = result.recipe, result.fit.topology
    mesh = template
    if recipe.mirror:
        mesh, mirrored = mirror_image(template, Landmarks(places, places))
        assert mirrored is not None
        places = np.asarray(mirrored.on_mesh)
    scheme = recipe.scheme
    control = first_control(mesh, scheme)
    while mesh.n_faces < topology.n_control_faces:
        mesh = split(scheme, mesh, control)
        control = mesh.control(weights=scheme.weights)
    faces = {size: np.asarray(rows) for size, rows in topology.control_faces.items()}
    if len(mesh.vertices) != len(result.control.vertices) or any(
        not np.array_equal(mesh.faces[size], faces[size]) for size in (3, 4)
    ):
        raise ScanError(
            f"landmarks cannot be carried: the fit's control mesh of {topology.n_control_faces} faces is not that of "
            f"the template, which has {template.n_faces}, nor one that it is split into. Give the template of this fit."
        )
    before = js.refine(scheme, topology, control)
    at = closest_points(before, places)
    on_template, there = _find_stand(before, at), _find_stand(result.surface, at)
    off = places - on_template.points
    _warn_of_far(names, off, float(js.edge_length(topology, control.vertices)))
    grown = float(np.sqrt(result.surface.areas().sum() / before.areas().sum()))
    within = grown * np.einsum("lix,lx->li", on_template.axes, off)
    points = there.points + np.einsum("li,lix->lx", within, there.axes)
    offsets = np.linalg.norm(within, axis=1) * np.where(within[:, 2] < 0, -1.0, 1.0)
    corners, weights = (np.asarray(rows) for rows in js.corner_weights(result.surface, at))
    misfit = np.sum(weights * result.uncertainty().misfit[corners] ** 2, axis=1)
    normals = there.axes[:, 2]
    across = normals[:, :, None] * normals[:, None, :]
    covariances = result.posterior.covariances(at) + misfit[:, None, None] * across
    return CarriedLandmarks(names, points, covariances, offsets, at)


def carry_to_cohort(
    template: js.ControlMesh, cohort: Cohort, landmarks: Mapping[str, ArrayLike]
) -> tuple[CarriedLandmarks, ...]:
    """A template's landmarks on every surface of a cohort, as `carry_landmarks` puts them there.

    The rows of all belong together: `np.stack([one.points for one in carried])` has the shape `[s, l, 3]` that
    `shape_modes`, `compare_groups` and `measure_modes` take.

    Args:
        template: where the fits of the cohort started, before any alignment.
        cohort: the fits.
        landmarks: positions on the template by name.

    Raises:
        ScanError: as `carry_landmarks` does.
    """
    return tuple(carry_landmarks(template, cohort.result(i), landmarks) for i in range(len(cohort)))


class _Stand(NamedTuple):
    """Where one stands on a surface."""

    points: Float[np.ndarray, "l 3"]
    axes: Float[np.ndarray, "l 3 3"]
    """Rows: along the first side of the face, to the left of it, and out of the surface."""


def _find_stand(surface: js.RefinedSurface, at: js.SurfacePoint) -> _Stand:
    points, normals = (np.asarray(rows, np.float64) for rows in js.evaluate(surface, at))
    corners, _ = js.corner_weights(surface, at)
    ends = np.asarray(surface.vertices, np.float64)[np.asarray(corners)[:, :2]]
    side = ends[:, 1] - ends[:, 0]
    along = unit(side - np.sum(side * normals, axis=1, keepdims=True) * normals)
    return _Stand(points, np.stack([along, np.cross(normals, along), normals], axis=1))


def _positions(landmarks: Mapping[str, ArrayLike]) -> Float[np.ndarray, "l 3"]:
    rows = {name: np.asarray(position, np.float64) for name, position in landmarks.items()}
    if not rows:
        raise ScanError("there are no landmarks to carry: give their positions on the template by name.")
    bad = [name for name, position in rows.items() if position.shape != (3,) or not np.isfinite(position).all()]
    if bad:
        raise ScanError(f"the landmarks {', '.join(bad)} are not three finite numbers x, y, z on the template.")
    return np.stack(list(rows.values()))


def _warn_of_far(names: tuple[str, ...], off: Float[np.ndarray, "l 3"], edge: float) -> None:
    distances = np.linalg.norm(off, axis=1)
    far = np.flatnonzero(distances > edge)
    if len(far):
        worst = far[np.argmax(distances[far])]
        warn(
            f"{len(far)} of {len(names)} landmarks lie farther from the template's surface than a control edge, "
            f"{edge:.3g} mm: {', '.join(names[i] for i in far)}; '{names[worst]}' by {distances[worst]:.3g} mm. Are "
            "they in the template's frame and unit?"
        )
