"""What is measured of one fit, with standard deviations. tests/test_series.py has cavities, valves and walls."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import fitting
import jaxsubdiv as js
from fitting.model.priors.symmetry import symmetry_of
from fitting.report.quantities import (
    crossing_points,
    find_crossing,
    measure_crossing,
    measure_curvature,
    measure_solid,
)


@functools.cache
def femur() -> fitting.FitResult:
    scan, mesh = fitting.example("femur_distal")
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    return fitting.fit(js.Interpolating(), topology, mesh.control(), scan, max_sweeps=2, throw=False)


def solid(surface: js.RefinedSurface) -> trimesh.Trimesh:
    return trimesh.Trimesh(np.asarray(surface.vertices), np.asarray(surface.triangles()), process=False)


def test_volume_and_area_are_those_of_the_surface():
    volume, area = femur().measures()
    assert (volume.name, volume.unit, area.name, area.unit) == ("volume", "ml", "area surface", "cm2")
    expected = solid(femur().surface)
    np.testing.assert_allclose([volume.value, area.value], [expected.volume / 1e3, expected.area / 1e2], rtol=1e-9)


def test_deviations_are_those_of_draws():
    fit, n = femur().fit, 300
    drawn = jnp.asarray(femur().posterior.draws(n, seed=1))
    split, y = fit.model.layout.split, fit.y
    edge = js.edge_length(fit.topology, y.control.vertices)
    part = js.losses.surface_part(fit.topology)

    def measure(offset):
        surface = fit.model.refine(fit.model.layout.retract(y, split(offset), edge))
        return jnp.stack([js.losses.enclosed_volume(surface, part=part) / 1e3, js.losses.surface_area(surface) / 1e2])

    spread = np.std(jax.lax.map(measure, drawn.T), axis=0)
    # The deviation of a standard deviation of n draws is that over sqrt(2 n); four of these.
    expected = [one.deviation for one in femur().measures()]
    np.testing.assert_allclose(spread, expected, rtol=4 / np.sqrt(2 * n))


def test_report_has_the_measures():
    report = femur().report(uncertainty=True)
    assert report.measures == list(femur().measures()) and femur().report().measures == []
    rows = dict(report.as_rows())
    assert rows["volume"] == str(report.measures[0]) and rows["volume"].endswith(" ml")
    assert report.as_dict()["measures"][1] == femur().measures()[1]._asdict()


def test_valves_that_are_no_groups_are_named():
    with pytest.raises(ValueError, match="'mitral' is no group of the control mesh"):
        femur().measures(valves=["mitral"])


# Details: curvature, the solid, cross-sections, landmarks


def displaced(surface: js.RefinedSurface, step: np.ndarray) -> js.RefinedSurface:
    return js.RefinedSurface(surface.vertices + step, surface.normals, surface.faces)


def spread_by_draws(quantity, n: int = 200) -> np.ndarray:
    """Standard deviations of numbers of the surface, over surfaces drawn from the posterior, to first order."""
    posterior, surface = femur().posterior, femur().surface
    moved = np.moveaxis(posterior.displace(posterior.draws(n, seed=2)), 2, 0)
    return np.std([quantity(displaced(surface, step)) for step in moved], axis=0)


def assert_near(found, expected, n: int = 200) -> None:
    """Four times the deviation of a standard deviation of so many draws."""
    np.testing.assert_allclose(found, expected, rtol=4 / np.sqrt(2 * n))


def test_displacements_are_those_of_the_refined_surface():
    fit, posterior = femur().fit, femur().posterior
    offset = 1e-4 * posterior.draws(1, seed=3)[:, 0]
    edge = js.edge_length(fit.topology, fit.y.control.vertices)
    moved = [
        fit.model.refine(fit.model.layout.retract(fit.y, fit.model.layout.split(jnp.asarray(by * offset)), edge))
        for by in (1.0, -1.0)
    ]
    expected = (np.asarray(moved[0].vertices) - np.asarray(moved[1].vertices)) / 2
    found = posterior.displace(offset[:, None])[..., 0]
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_the_solid_is_that_of_trimesh():
    own = {one.name: one for one in femur().measures(details=True)}
    expected = solid(femur().surface)
    found = [own[f"centre {axis}"].value for axis in "xyz"]
    np.testing.assert_allclose(found, expected.center_mass, rtol=1e-9)
    moments = np.sort(np.linalg.eigvalsh(expected.moment_inertia)) * 1e-5
    np.testing.assert_allclose([own[f"moment of inertia {i}"].value for i in (1, 2, 3)], moments, rtol=1e-9)
    expected = spread_by_draws(lambda s: solid(s).center_mass)
    np.testing.assert_allclose([own[f"centre {axis}"].deviation for axis in "xyz"], expected, rtol=0.3)


def test_moments_have_the_derivatives_of_differences():
    ball = trimesh.creation.icosphere(1)
    x = jnp.asarray(ball.vertices * [3.0, 2.0, 1.0] + [5.0, 0.0, 1.0])
    way = jnp.asarray(np.random.default_rng(0).normal(size=x.shape))

    def numbers(t):
        return jnp.concatenate(measure_solid(x + t * way, ball.faces))

    step = 1e-5
    by_differences = (numbers(step) - numbers(-step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(numbers)(0.0), by_differences, rtol=1e-6)


def test_curvature_of_a_ball_is_known_and_has_deviations():
    ball = trimesh.creation.icosphere(3, radius=20.0)
    faces = {3: jnp.asarray(ball.faces), 4: jnp.zeros((0, 4), int)}
    mean, gaussian = measure_curvature(jnp.asarray(ball.vertices), faces)
    np.testing.assert_allclose(mean, 1 / 20, rtol=1e-6)
    np.testing.assert_allclose(gaussian, 1 / 400, rtol=1e-6)
    found = {one.name: one for one in femur().measures(details=True)}
    quantiles = [found[f"mean curvature {share}"] for share in ("5%", "50%", "95%")]
    own, _ = measure_curvature(femur().surface.vertices, femur().surface.faces)
    order = np.argsort(own)
    at = np.cumsum(np.asarray(femur().surface.vertex_areas())[order])
    expected = np.interp([0.05, 0.5, 0.95], at / at[-1], np.asarray(own)[order])
    np.testing.assert_allclose([one.value for one in quantiles], expected, atol=0.1 * np.ptp(expected))
    assert all(0 < one.deviation < 0.05 for one in quantiles) and quantiles[0].unit == "1/mm"


def test_a_plane_through_a_ball_cuts_a_circle():
    ball = trimesh.creation.icosphere(3, radius=20.0)
    x, way = np.asarray(ball.vertices), np.array([2.0, 1.0, 2.0]) / 3
    crossing = find_crossing(x, np.asarray(ball.faces), 12 * way, way)
    assert crossing.is_closed and [len(one) for one in crossing.contours] == [len(crossing.edges)]
    ends = crossing_points(jnp.asarray(x), crossing, 12 * way, way)
    np.testing.assert_allclose(measure_crossing(ends, way), [np.pi * 16**2, 2 * np.pi * 16], rtol=0.01)
    turned = find_crossing(x, np.asarray(ball.faces), 12 * way, -way)  # the side that is looked from does not matter
    assert measure_crossing(crossing_points(jnp.asarray(x), turned, 12 * way, -way), -way)[0] > 0
    half = np.asarray(ball.faces)[(x[ball.faces][..., 0] > -5).all(axis=1)]
    opened = find_crossing(x, half, np.zeros(3), np.array([0.1, 1.0, 0.2]))
    assert not opened.is_closed and len(opened.contours) == 1


def test_cross_section_is_that_of_trimesh_with_deviations():
    centre, way = solid(femur().surface).center_mass, np.array([0.1, 0.2, 1.0])
    found = femur().cross_section(centre, way)
    section = solid(femur().surface).section(way, centre)
    np.testing.assert_allclose(found.perimeter.value, section.length, rtol=1e-9)
    joined = sum(np.linalg.norm(np.roll(one, -1, axis=0) - one, axis=1).sum() for one in found.contours)
    np.testing.assert_allclose(joined, section.length, rtol=1e-9)
    assert found.area is not None and found.area.value > 0
    expected = spread_by_draws(lambda s: solid(s).section(way, centre).length)
    assert_near(found.perimeter.deviation, expected)
    with pytest.raises(ValueError, match="the plane does not pass the surface, which lies"):
        femur().cross_section((0, 0, 1e4), (0, 0, 1))
    with pytest.raises(ValueError, match="`normal` has no length"):
        femur().cross_section((0, 0, 0), (0, 0, 0))


def test_distances_and_angles_between_landmarks():
    surface = femur().surface
    rows = [10, 300, 700]
    places = {name: np.asarray(surface.vertices)[row] for name, row in zip("abc", rows, strict=True)}
    *distances, angle = femur().measure_landmarks(places, [("a", "b", "c")])
    assert [one.name for one in distances] == ["distance a - b", "distance a - c", "distance b - c"]

    def numbers(s):
        a, b, c = np.asarray(s.vertices)[rows]
        one, other = a - b, c - b
        cosine = one @ other / np.linalg.norm(one) / np.linalg.norm(other)
        return np.array([*(np.linalg.norm(p - q) for p, q in ((a, b), (a, c), (b, c))), np.rad2deg(np.arccos(cosine))])

    np.testing.assert_allclose([one.value for one in (*distances, angle)], numbers(surface), rtol=1e-6)
    assert_near([one.deviation for one in (*distances, angle)], spread_by_draws(numbers))
    with pytest.raises(ValueError, match="'d' is none of the landmarks a, b, c"):
        femur().measure_landmarks(places, [("a", "b", "d")])


def test_asymmetry_is_measured_where_the_fit_has_a_plane():
    fit, n = femur().fit, len(femur().control.vertices)
    alone = symmetry_of(np.arange(n), np.asarray(fit.model.template))  # every vertex is its own mirror image
    result = fitting.FitResult(dataclasses.replace(fit, inputs=fit.inputs | {"symmetry": alone}))
    *_, off = result.measures(details=True)
    x = np.asarray(result.control.vertices) - np.asarray(result.control.vertices).mean(axis=0)
    across = np.linalg.svd(x, full_matrices=False)[1][2] / np.sqrt(n)
    assert off.name == "RMS distance from the mirror image" and off.unit == "mm"
    np.testing.assert_allclose(off.value, 2 * across, rtol=1e-6)
    assert 0 < off.deviation < 0.5 and off in result.report(uncertainty=True, details=True).measures
