"""The surfaces of all levels, from one program."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scans import analysed

import jaxsubdiv as js

MESH = js.ControlMesh(*meshes.mixed_closed())
LEVELS = 2


@pytest.mark.parametrize("scheme", [js.Interpolating(), js.Interpolating([0.8, 1.2]), js.CirclePreserving()])
def test_every_level_is_the_surface_of_so_many_levels(scheme):
    topology, control = js.build_topology(MESH, scheme, LEVELS), MESH.control()
    surfaces = js.refine_levels(scheme, topology, control)
    assert len(surfaces) == LEVELS + 1
    for levels, found in enumerate(surfaces):
        own = scheme if scheme.h.ndim == 0 else js.Interpolating(scheme.h[:levels])
        expected = js.refine(own, js.build_topology(MESH, scheme, levels), control)
        np.testing.assert_allclose(found.vertices, expected.vertices, atol=1e-14)
        np.testing.assert_allclose(found.normals, expected.normals, atol=1e-14)
        jax.tree.map(np.testing.assert_array_equal, found.faces, expected.faces)


def test_coarse_level_has_the_gradient_of_its_own():
    scheme, control = js.Interpolating(), MESH.control()
    topology, early = (js.build_topology(MESH, scheme, levels) for levels in (LEVELS, 1))

    def sum_squares(vertices, refine):
        return jnp.sum(refine(js.Control(vertices, control.normals)).vertices[12:] ** 2)

    found = jax.grad(sum_squares)(control.vertices, lambda moved: js.refine_levels(scheme, topology, moved)[1])
    expected = jax.grad(sum_squares)(control.vertices, lambda moved: js.refine(scheme, early, moved))
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("scheme", [js.BezierTriangle(), js.Loop(), js.CirclePreserving()])
def test_rows_of_a_fit_have_a_surface_whatever_the_scheme(scheme):
    mesh = js.ControlMesh(*meshes.octahedron())
    topology = js.build_topology(mesh, scheme, 1)
    model, y = analysed(scheme, topology, mesh.control())
    place = model.place_of(y)
    assert (place.before is not None) == topology.tells_levels == isinstance(scheme, js.CirclePreserving)
    np.testing.assert_allclose(place.surface.vertices, js.refine(scheme, topology, y.control).vertices, atol=1e-14)


def test_tables_that_do_not_tell_their_levels_are_refused():
    with pytest.raises(ValueError, match="faces of their levels"):
        js.refine_levels(js.CatmullClark(), js.build_topology(MESH, js.CatmullClark(), 1), MESH.control())
    padded = js.pad_topology(js.build_topology(MESH, js.Interpolating(), 1))
    with pytest.raises(ValueError, match="not padded"):
        js.refine_levels(js.Interpolating(), padded, js.pad_control(padded, MESH.control()))
