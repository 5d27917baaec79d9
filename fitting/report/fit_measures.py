"""What is measured of the surface of one fit, with standard deviations from its posterior.

To first order a measure is Gaussian about that of the fit. Its variance follows from its derivative by the vertices of
the surface, theirs by the unknowns, and the covariance of these.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxsubdiv as js
from jaxsubdiv.linalg import cross, dot, norm

from ..scan.closest_points import closest_points
from ..start.cavities import find_valves
from .layer_measures import LayerMeasures
from .measures import Column, Measures
from .posterior import Posterior
from .quantities import (
    QUANTILES,
    crossing_points,
    find_bands,
    find_crossing,
    measure_crossing,
    measure_curvature,
    measure_solid,
)

Numbers: TypeAlias = Sequence[Any] | np.ndarray | Array

_DRAWS, _STEP = 128, 0.1  # a standard deviation of so many is right to 6 %; how far along each


class Measure(NamedTuple):
    """A number that a surface is measured by.

    Attributes:
        name, unit: what it is, and in what.
        value: of the fitted surface.
        deviation: its standard deviation, posterior to scan and priors; without what the control mesh cannot follow.
    """

    name: str
    unit: str
    value: float
    deviation: float

    def __str__(self) -> str:
        return f"{self.value:.5g} +- {self.deviation:.2g} {self.unit}"


def measure_surface(
    posterior: Posterior, mesh: js.ControlMesh, valves: Sequence[str] | None = None
) -> tuple[Measure, ...]:
    """Measure the surface of a fit.

    Args:
        posterior: of the fit.
        mesh: its control mesh, with groups where it has any.
        valves: the groups that close the openings of cavities; default: those whose names say so.

    Raises:
        ValueError: a group is none of the mesh.
    """
    surface, structure = posterior.fit.surface(), posterior.equations.structure
    layers: tuple[str, ...] = posterior.fit.inputs.get("layers") or ()
    if layers and valves is None:
        assert mesh.regions is not None
        region = mesh.regions.rows[structure.patches.owner]
        chosen = {name: region == mesh.regions.names.index(name) for name in layers}
        of_layers = LayerMeasures(posterior.fit.topology, surface, chosen)
        return measure_by(posterior, of_layers.measure, of_layers.columns)
    measures = Measures(posterior.fit.topology, surface, structure.patches.owner, mesh, find_valves(mesh, valves))
    walls = measures.walls(surface)
    return measure_by(posterior, lambda of: measures.measure(of, walls), measures.columns)


def measure_by(
    posterior: Posterior, quantity: Callable[[js.RefinedSurface], Float[Array, "m"]], columns: Sequence[Column]
) -> tuple[Measure, ...]:
    """Measure the surface of a fit by a function of your own.

    Args:
        posterior: of the fit.
        quantity: takes a refined surface to numbers, differentiable in its vertices. The normals stay what they are.
        columns: name and unit of each number.
    """
    surface = posterior.fit.surface()

    def of_vertices(vertices: Float[Array, "v 3"]) -> Float[Array, "m"]:
        return quantity(js.RefinedSurface(vertices, surface.normals, surface.faces))

    values, back = jax.vjp(of_vertices, surface.vertices)
    (gradients,) = jax.vmap(back)(np.eye(len(values), dtype=values.dtype))
    variances = np.diag(posterior.covariance_of(np.asarray(gradients, np.float64)))
    return _measures(columns, np.asarray(values, np.float64), variances)


def measure_details(posterior: Posterior) -> tuple[Measure, ...]:
    """Curvature, of what is closed its centre and moments of inertia, and how far a fit is from its mirror image.

    Standard deviations are to first order, by differences along 128 random draws: they are right to 6 %.

    Args:
        posterior: of the fit.
    """
    fit, surface = posterior.fit, posterior.fit.surface()
    areas, faces = np.asarray(surface.vertex_areas(), np.float64), surface.faces
    curvature = [np.asarray(one, np.float64) for one in measure_curvature(surface.vertices, faces)]
    bands = [find_bands(one, areas) for one in curvature]
    columns = [
        Column(f"{name} curvature {share:.0%}", unit)
        for name, unit in (("mean", "1/mm"), ("Gaussian", "1/mm2"))
        for share in QUANTILES
    ]
    topology, triangles = fit.topology, np.asarray(surface.triangles())
    mesh = js.ControlMesh(fit.y.control.vertices, topology.control_faces, check=False)
    is_solid = mesh.is_closed and not fit.inputs.get("layers")
    if is_solid:
        columns += [Column(f"centre {axis}", "mm") for axis in "xyz"]
        columns += [Column(f"moment of inertia {i}", "g cm2") for i in (1, 2, 3)]
    symmetry = fit.inputs.get("symmetry")
    if not fit.model.scheme.is_primal:
        symmetry = None  # the control vertices are not on the surface
    if symmetry is not None:
        columns.append(Column("RMS distance from the mirror image", "mm"))

    def quantity(vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "m"]:
        x = jnp.asarray(vertices, surface.vertices.dtype)
        parts = [weights @ np.asarray(one) for weights, one in zip(bands, measure_curvature(x, faces), strict=True)]
        parts += [np.asarray(one) for one in measure_solid(x, triangles)] if is_solid else []
        if symmetry is not None:
            own = vertices[: len(mesh.vertices)]
            away = np.linalg.norm(symmetry.mirror(own) - own, axis=1)
            parts.append(np.sqrt(np.mean(away**2, keepdims=True)))
        return np.concatenate(parts)

    vertices = np.asarray(surface.vertices, np.float64)
    steps = np.moveaxis(_STEP * posterior.displace(posterior.draws(_DRAWS)), 2, 0)
    slopes = np.stack([quantity(vertices + step) - quantity(vertices - step) for step in steps]) / (2 * _STEP)
    return _measures(columns, quantity(vertices), np.mean(slopes**2, axis=0))


def measure_landmarks(
    posterior: Posterior, landmarks: Mapping[str, Numbers], angles: Sequence[tuple[str, str, str]] = ()
) -> tuple[Measure, ...]:
    """Distances between landmarks on the surface of a fit, and angles at them; see `FitResult.measure_landmarks`."""
    names, surface = list(landmarks), posterior.fit.surface()
    lost = sorted({name for angle in angles for name in angle} - set(names))
    if lost or len(names) < 2:
        raise ValueError(
            f"'{lost[0]}' is none of the landmarks {', '.join(names)}." if lost else "give two landmarks or more."
        )
    places = np.array([np.asarray(landmarks[name], np.float64) for name in names]).reshape(-1, 3)
    corners, weights = js.corner_weights(surface, closest_points(surface, places))
    first, second = np.array(list(combinations(range(len(names)), 2))).T
    a, b, c = np.array([[names.index(name) for name in angle] for angle in angles], int).reshape(-1, 3).T
    columns = [Column(f"distance {names[i]} - {names[j]}", "mm") for i, j in zip(first, second, strict=True)]
    columns += [Column(f"angle {' - '.join(angle)}", "degrees") for angle in angles]

    def quantity(of: js.RefinedSurface) -> Float[Array, "m"]:
        at = js.sum_corners(of.vertices, corners, weights)
        one, other = at[a] - at[b], at[c] - at[b]
        turned = jnp.arctan2(norm(cross(one, other))[:, 0], dot(one, other)[:, 0])
        return jnp.concatenate([norm(at[first] - at[second])[:, 0], jnp.rad2deg(turned)])

    return measure_by(posterior, quantity, columns)


class CrossSection(NamedTuple):
    """Where a plane passes a fitted surface.

    Attributes:
        area: inside of the contours; None where one of them is open, as the surface is.
        perimeter: length of all contours.
        contours: points of each in their order, in mm; a closed one does not repeat its first.
    """

    area: Measure | None
    perimeter: Measure
    contours: tuple[Float[np.ndarray, "_ 3"], ...]


def measure_cross_section(posterior: Posterior, origin: Numbers, normal: Numbers) -> CrossSection:
    """Cut the surface of a fit by a plane; see `FitResult.cross_section`."""
    place, direction = np.asarray(origin, np.float64), np.asarray(normal, np.float64)
    if place.shape != (3,) or direction.shape != (3,) or not np.isfinite([place, direction]).all():
        raise ValueError(f"`origin` and `normal` are three finite numbers each; got {origin} and {normal}.")
    length = float(np.linalg.norm(direction))
    if length == 0:
        raise ValueError("`normal` has no length: give the direction that the plane is across.")
    direction, surface = direction / length, posterior.fit.surface()
    vertices = np.asarray(surface.vertices, np.float64)
    crossing = find_crossing(vertices, np.asarray(surface.triangles()), place, direction)
    if not len(crossing.edges):
        heights = (vertices - place) @ direction
        raise ValueError(
            f"the plane does not pass the surface, which lies {heights.min():.4g} to {heights.max():.4g} mm from it "
            "along `normal`."
        )

    def quantity(of: js.RefinedSurface) -> Float[Array, "m"]:
        return measure_crossing(crossing_points(of.vertices, crossing, place, direction), direction)

    area, perimeter = measure_by(posterior, quantity, [Column("area", "mm2"), Column("perimeter", "mm")])
    points = np.asarray(crossing_points(surface.vertices, crossing, place, direction), np.float64)
    contours = tuple(_contour(points[rows], crossing.is_closed) for rows in crossing.contours)
    return CrossSection(area if crossing.is_closed else None, perimeter, contours)


def _contour(ends: Float[np.ndarray, "s 2 3"], is_closed: bool) -> Float[np.ndarray, "_ 3"]:
    return ends[:, 0] if is_closed else np.concatenate([ends[:, 0], ends[-1:, 1]])


def _measures(
    columns: Sequence[Column], values: Float[np.ndarray, "m"], variances: Float[np.ndarray, "m"]
) -> tuple[Measure, ...]:
    rows = zip(columns, values.tolist(), np.sqrt(np.maximum(variances, 0)).tolist(), strict=True)
    return tuple(Measure(column.name, column.unit, value, deviation) for column, value, deviation in rows)
