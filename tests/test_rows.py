"""The rows of a fit, worked out by hand; and offsets of the unknowns."""

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scans import analysed, hold_everything, problem, rms
from schemes import control_mesh, inherited

import jaxsubdiv as js
from fitting import Free, Priors, Residual
from fitting.model.priors.bend import bend_asymmetry
from fitting.model.residual import Model, Pairs
from fitting.model.unknowns import Unknowns, Variables, tangents


def on_shape(shape: str, levels: int = 2) -> tuple[js.RefinedSurface, np.ndarray]:
    """A sheet bent onto a shape, with the normals of the shape, refined vertices too; and its edges to compare."""
    mesh = control_mesh(meshes.grid(3, 2, "mixed"))
    topology = js.build_topology(mesh, js.Interpolating(), levels)
    x, y, _ = inherited(topology, mesh.vertices).T / 3
    ball = np.stack([np.cos(x) * np.cos(y), np.sin(x) * np.cos(y), np.sin(y)], axis=1)
    vertices, normals = {
        "plane": (np.stack([x, y, 2 * x - y], axis=1), np.tile([-2, 1, 1], (len(x), 1)) / 6**0.5),
        "cylinder": (np.stack([7 * np.cos(x), 7 * np.sin(x), 20 * y], axis=1), ball * (1, 1, 0) / np.cos(y)[:, None]),
        "sphere": (30 * ball + (5, 6, 7), ball),
        "inside of a sphere": (30 * ball, -ball),
        "ellipsoid": (ball * (3, 2, 1), ball / (3, 2, 1) / np.linalg.norm(ball / (3, 2, 1), axis=1, keepdims=True)),
    }[shape]
    surface = js.RefinedSurface(jnp.asarray(vertices), jnp.asarray(normals), topology.faces)
    return surface, compared(topology)


def compared(topology: js.Topology) -> np.ndarray:
    """The edges whose bends a fit compares."""
    control = js.Control(*np.random.default_rng(0).normal(size=(2, topology.n_control_vertices, 3)))
    return np.asarray(analysed(js.Interpolating(), topology, control)[0].prior("bend").edges)


@pytest.mark.parametrize("shape", ["plane", "cylinder", "sphere", "inside of a sphere"])
@pytest.mark.parametrize("levels", [1, 2])
def test_bend_asymmetry_is_zero_where_every_edge_is_a_circular_arc_or_straight(shape, levels):
    np.testing.assert_allclose(bend_asymmetry(*on_shape(shape, levels)), 0, atol=1e-13)


def test_bend_asymmetry_sees_a_bend_that_changes():
    control_edges, finer_edges = (bend_asymmetry(*on_shape("ellipsoid", levels)) for levels in (1, 2))
    # It goes with the third power of the edge, and the finer edges are half as long.
    assert rms(control_edges) > 0.01 and 4 < rms(control_edges) / rms(finer_edges) < 16


def test_bend_asymmetry_sees_a_normal_that_leans():
    surface, edges = on_shape("plane")
    leaning = np.asarray(surface.normals).copy()
    leaning[5] = (0, 0, 1)
    surface = js.RefinedSurface(surface.vertices, jnp.asarray(leaning), surface.faces)
    found = bend_asymmetry(surface, edges)
    a, b = np.asarray(surface.vertices)[edges].swapaxes(0, 1)
    at_leaning = (edges == 5).any(axis=1)
    np.testing.assert_allclose(found, np.where(at_leaning, (b - a)[:, 2] / 2, 0), atol=1e-13)
    assert np.abs(found[at_leaning]).max() > 0.05


@pytest.mark.parametrize(("levels", "at"), [(1, 0), (2, 1), (3, 1)])
def test_bend_asymmetry_is_taken_over_the_first_level_or_the_control_edges(levels, at):
    topology = js.build_topology(control_mesh(meshes.grid(3, 2, "mixed")), js.Interpolating(), levels)
    found, level = compared(topology), topology.levels[at]
    assert {frozenset(edge) for edge in found.tolist()} == {
        frozenset(edge) for edge in np.asarray(level.edges).tolist()
    }


def test_faces_of_a_dual_scheme_belong_to_the_nearest_control_face():
    # A torus of quads has four times as many after Doo-Sabin's split too, but in another order.
    mesh, scheme = control_mesh(meshes.torus(8, 6)), js.DooSabin()
    topology = js.build_topology(mesh, scheme, 1)
    surface = js.refine(scheme, topology, mesh.control())
    assert surface.n_faces == 4 * mesh.n_faces
    of_faces, of_surface = (
        np.asarray(vertices)[np.asarray(faces[4])].mean(axis=1)
        for vertices, faces in ((mesh.vertices, mesh.faces), (surface.vertices, surface.faces))
    )
    apart = np.linalg.norm(of_surface[:, None] - of_faces, axis=2)
    owner = js.control_faces_of(scheme, topology, surface, mesh.control())
    np.testing.assert_allclose(apart[np.arange(len(owner)), owner], apart.min(axis=1), rtol=1e-6)


def one_triangle(h: float, lean: float) -> tuple[js.Interpolating, js.Topology, js.Control]:
    """A flat triangle of sides 3, 4 and 5 mm; the normal at its first corner leans along the side of 3."""
    mesh = js.ControlMesh([(0, 0, 0), (3, 0, 0), (0, 4, 0)], [(0, 1, 2)])
    normals = np.array([(np.sin(lean), 0, np.cos(lean)), (0, 0, 1), (0, 0, 1)])
    return js.Interpolating(h), js.build_topology(mesh, js.Interpolating(), 1), js.Control(mesh.vertices, normals)


def two_points() -> Pairs:
    """One over the middle of the triangle, one beside its second corner, where the surface ends."""
    return Pairs(
        points=jnp.array([(1.0, 1.0, 5.0), (3.5, 0.0, 0.0)]),
        corners=jnp.array([(0, 1, 2, 2), (1, 1, 2, 2)]),
        corner_weights=jnp.array([(0.5, 0.25, 0.25, 0.0), (1.0, 0.0, 0.0, 0.0)]),
        directions=jnp.array([(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]),
    )


def rows_of(h: float, lean: float, pairs: Pairs, template=None) -> dict[str, np.ndarray]:
    """The rows on the leaning triangle, of a sweep that starts from the template with h = 1."""
    scheme, topology, control = one_triangle(h, lean)
    start = control if template is None else js.Control(jnp.asarray(template), control.normals)
    model, y = analysed(js.Interpolating(1.0), topology, start, priors=Priors(bend=1.0))
    held = hold_everything(model, y, pairs, np.zeros(2, int))
    return Residual(model).rows(Variables(control, {"h": scheme.h}), held)


def test_rows_are_those_worked_out_by_hand():
    rows = rows_of(1.5, 0.2, two_points(), template=[(0.0, 0, 0), (2, 0, 0), (0, 4, 1)])
    np.testing.assert_allclose(rows["distance"], [-5, -0.5], rtol=1e-12)
    # Only the side of 3 leaves the first corner along the lean: 3 sin(lean) / 2.
    np.testing.assert_allclose(np.sort(np.abs(rows["bend"])), [0, 0, 1.5 * np.sin(0.2)], rtol=1e-12, atol=1e-12)
    # The side of 3 was 2 long; the others were off in z alone, which is nearly across.
    stretch = np.linalg.norm(np.reshape(rows["stretch"], (3, 3)), axis=1)
    of_three = np.argmax(stretch)
    np.testing.assert_allclose(stretch[of_three], 0.5 * np.cos(0.1), rtol=1e-12)
    np.testing.assert_array_less(np.delete(stretch, of_three), 0.27)
    expected = np.log1p(np.exp((0.2 - np.array([np.cos(0.2), 1, 1])) / 0.1)) * 0.1 / 0.02
    np.testing.assert_allclose(rows["margin"], expected, rtol=1e-12)
    np.testing.assert_allclose(rows["h"], [0.5], rtol=1e-12)
    assert set(rows) == {"distance", "bend", "stretch", "margin", "h"}


def test_margin_grows_as_a_normal_leans_over():
    margins = [float(rows_of(1.0, lean, two_points())["margin"][0]) for lean in (0.0, 1.0, 1.4, 1.7)]
    assert margins[0] < 0.01 and np.all(np.diff(margins) > 0) and margins[-1] > 10


def test_rows_have_finite_derivatives_at_a_perfect_fit():
    scheme, topology, control = one_triangle(h=1.0, lean=0.0)
    model, y = analysed(scheme, topology, control)
    pairs = two_points()._replace(points=jnp.array([(0.75, 1.0, 0.0), (3.0, 0.0, 0.0)]))
    held = hold_everything(model, y, pairs, np.zeros(2, int))
    of_offsets = Residual(model).recentre(y)
    by = jax.jacfwd(of_offsets)(of_offsets.zero, held)
    assert np.allclose(Residual(model).rows(y, held)["distance"], 0)
    assert all(np.isfinite(part).all() for part in jax.tree.leaves(by))
    assert np.any(by["distance"].vertices) and np.any(by["bend"].normals)


def test_tangents_are_orthonormal_and_turn_to_the_normal():
    n = np.random.default_rng(0).normal(size=(50, 3))
    n = np.concatenate([np.eye(3), -np.eye(3), n / np.linalg.norm(n, axis=1, keepdims=True), [[0.5**0.5, 0.5**0.5, 0]]])
    first, second = tangents(jnp.asarray(n))
    frames = np.stack([n, first, second], axis=1)
    np.testing.assert_allclose(frames @ frames.swapaxes(1, 2), np.tile(np.eye(3), (len(n), 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=1e-14)


def started(h=1.0, free: Free | None = None) -> tuple[Model, Variables]:
    p = problem()
    unit = js.Control(p.start.vertices, p.start.normals / np.linalg.norm(p.start.normals, axis=1, keepdims=True))
    levels = np.size(h)
    topology = p.topology if levels == 1 else js.build_topology(p.mesh, js.Interpolating(), levels)
    return analysed(js.Interpolating(h), topology, unit, free=free)


def offset_of(model: Model, values) -> Unknowns:
    """Offsets of all unknowns, from a value or one for each."""
    return model.layout.split(jnp.broadcast_to(jnp.asarray(values, float), (model.layout.n,)))


@pytest.mark.parametrize("h", [1.2, [1.2, 0.7]])
def test_offset_of_zero_changes_nothing(h):
    model, y = started(h)
    found = model.retract(y, offset_of(model, 0))
    np.testing.assert_array_equal(found.control.vertices, y.control.vertices)
    np.testing.assert_allclose(found.control.normals, y.control.normals, rtol=0, atol=4e-16)
    np.testing.assert_array_equal(found.shared["h"], y.shared["h"])
    np.testing.assert_array_equal(model.scheme_at(found).h, h)


@pytest.mark.parametrize("size", [0.01, 1, 1e6])
def test_offset_leaves_normals_unit(size):
    model, y = started()
    offset = offset_of(model, size * np.random.default_rng(0).normal(size=model.layout.n))
    np.testing.assert_allclose(np.linalg.norm(model.retract(y, offset).control.normals, axis=1), 1, atol=1e-14)


@pytest.mark.parametrize("free", [Free(True, False, False), Free(False, True, False), Free(False, False, True)])
def test_offset_of_one_moves_the_surface_by_about_a_millimetre(free):
    (model, y), small = started(free=free), 1e-3
    before, after = (model.refine(model.retract(y, offset_of(model, size))) for size in (0, small))
    moved = np.linalg.norm(after.vertices - before.vertices, axis=1) / small
    assert 0.3 < moved.max() < 3


def test_nothing_free_is_refused():
    p = problem()
    for nothing in (False, np.zeros(12, bool)):
        with pytest.raises(ValueError, match="nothing is free: let at least one of vertices, normals and h be True"):
            Free(nothing, False, False)
    with pytest.raises(ValueError, match=r"`Free\.vertices` has 11 rows for 12 control vertices"):
        p.fit(free=Free(vertices=np.ones(11, bool)))


def test_control_vertices_that_are_fixed_stay_bit_for_bit():
    p, mask = problem(), np.arange(12) % 3 > 0
    found = p.fit(free=Free(vertices=mask, normals=mask), max_sweeps=4)
    start = p.start.normals / np.linalg.norm(p.start.normals, axis=1, keepdims=True)
    np.testing.assert_array_equal(found.control.vertices[~mask], p.start.vertices[~mask])
    np.testing.assert_allclose(found.control.normals[~mask], start[~mask], rtol=0, atol=1e-15)
    assert np.abs(found.control.vertices - p.start.vertices)[mask].max(axis=1).min() > 0.01
