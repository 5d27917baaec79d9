"""What is measured of one fit, with standard deviations. tests/test_series.py has cavities, valves and walls."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import fitting
import jaxsubdiv as js


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
