"""Boundary curves: where open surfaces end."""

import functools

import equinox as eqx
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from posteriors import precision_matrix
from scans import assert_refit_knows_the_fit

import fitting
import jaxsubdiv as js
from fitting import BoundaryCurve, Free, Priors, Scan, ScanError, boundary_of
from fitting.model import pairing
from fitting.model.priors import Place, Start
from fitting.model.priors.boundary import BoundaryPrior, pair_with_boundary
from fitting.solve import derivatives, sweeps

N_POINTS = 400


def square(first: float, last: float, n: int = 12) -> np.ndarray:
    """Points along the sides of a square in the plane z = 0."""
    t = first + (last - first) * (np.arange(n) + 0.5) / n
    low, high = np.full(n, first), np.full(n, last)
    rows = [np.stack(side, axis=1) for side in ((t, low), (t, high), (low, t), (high, t))]
    return np.concatenate([np.column_stack([side, np.zeros(n)]) for side in rows])


@functools.cache
def sheet() -> tuple[js.ControlMesh, js.Topology]:
    """Flat, of 20 mm, with its first corner at the origin."""
    vertices, faces = meshes.grid(2, 2, "quad")
    mesh = js.ControlMesh(10 * vertices, faces)
    return mesh, js.build_topology(mesh, js.Interpolating(), 1)


def scan(reach: float) -> Scan:
    """Points of the plane, to so many mm beyond the sheet."""
    rng = np.random.default_rng(0)
    rows = rng.uniform(-reach, 20 + reach, (N_POINTS, 2))
    return Scan(np.column_stack([rows, rng.normal(scale=0.1, size=N_POINTS)]))


@functools.cache
def fitted(reach: float, with_curve: bool, deviation: float = 0.2) -> fitting.FitResult:
    """The sheet; the curve is a square that goes by 1 mm around it."""
    curve = BoundaryCurve(square(-1.0, 21.0), deviation) if with_curve else None
    return fit(scan(reach), curve)


def fit(points: Scan, curve: BoundaryCurve | None) -> fitting.FitResult:
    mesh, topology = sheet()
    free = Free(normals=False, h=False)
    return fitting.fit(js.Interpolating(), topology, mesh.control(), points, free=free, boundary=curve, throw=False)


def place_of(surface: js.RefinedSurface, edge: float = 10.0) -> Place:
    """Where the rows of a prior on the sheet are evaluated."""
    mesh, topology = sheet()
    control = mesh.control()
    return Place(js.Interpolating(), topology, control, {}, surface, control.vertices, jnp.asarray(edge))


def prior_of(curve: BoundaryCurve, surface: js.RefinedSurface) -> BoundaryPrior:
    """The prior of a curve, on the sheet."""
    mesh, topology = sheet()
    scheme, control = js.Interpolating(), mesh.control()
    owner = js.control_faces_of(scheme, topology, surface, control)
    made = BoundaryPrior.make(
        Priors(), Start(scheme, topology, control, surface, owner, False, False, {"boundary": curve})
    )
    assert made is not None
    return made


def flat() -> js.RefinedSurface:
    mesh, topology = sheet()
    return js.refine(js.Interpolating(), topology, mesh.control())


def off(found: fitting.FitResult, curve: np.ndarray) -> float:
    """Root mean square distance of the curve's points from the boundary of the surface."""
    prior, place = prior_of(BoundaryCurve(curve, 1.0), found.surface), place_of(found.surface)
    away = np.asarray(prior.rows(place, prior.hold(place, {})))
    return float(np.sqrt(np.sum(away**2) / len(curve)))


# Boundaries and what lies near them


def test_boundary_of_a_mesh_is_its_open_edges():
    mesh, topology = sheet()
    points = boundary_of(mesh)
    assert len(points) == 8 and not (points == (10, 10, 0)).all(axis=1).any()
    assert len(boundary_of(js.refine(js.Interpolating(), topology, mesh.control()))) == 16
    with pytest.raises(ScanError, match="the mesh is closed"):
        boundary_of(js.ControlMesh(*meshes.cube()))


def test_point_is_paired_with_the_place_that_a_search_through_all_finds():
    rng = np.random.default_rng(0)
    a, b, points = rng.normal(size=(70, 3)), rng.normal(size=(70, 3)), 2 * rng.normal(size=(300, 3))
    b[:5], b[5:9] = a[:5], a[5:9] + 40 * (b[5:9] - a[5:9])  # of no length, and long ones
    rows, n = np.arange(70), len(points)
    ends = np.stack([rows, rows + 70], axis=1)
    vertices, up = jnp.asarray(np.concatenate([a, b])), jnp.asarray(np.tile((0.0, 0, 1), (140, 1)))
    prior = BoundaryPrior(jnp.asarray(points), jnp.ones(n), jnp.array(1.0), ends, rows, np.arange(140))
    found = pair_with_boundary(prior, js.RefinedSurface(vertices, up, {}), jnp.array(1.0))
    which, along = np.asarray(found.side), np.asarray(found.along)
    away = np.linalg.norm(a[which] + along[:, None] * (b - a)[which] - points, axis=1)
    squared = np.sum((b - a) ** 2, axis=1)
    best = np.clip(np.einsum("psk,sk->ps", points[:, None] - a, b - a) / np.maximum(squared, 1e-300), 0, 1)
    expected = np.linalg.norm(a + best[..., None] * (b - a) - points[:, None], axis=2)
    assert ((along >= 0) & (along <= 1)).all()
    np.testing.assert_allclose(away, expected.min(axis=1), atol=1e-12)


@pytest.mark.parametrize(
    ("point", "distance"),
    [((5, -3, 4), 5.0), ((5, 2, 0), 2.0), ((7, 0, 0), 0.0), ((-3, -4, 12), 13.0), ((20, 20, 0), 0.0)],
)
def test_rows_are_distances_across_the_boundary(point, distance):
    surface = flat()
    prior, place = prior_of(BoundaryCurve(np.array([point], float), 0.5), surface), place_of(surface)
    rim = prior.hold(place, {})
    np.testing.assert_allclose(np.linalg.norm(prior.rows(place, rim)), distance / 0.5, atol=1e-9)
    directions = np.asarray(rim.directions)[0]
    np.testing.assert_allclose(directions @ directions.T, np.eye(2), atol=1e-9)
    ends = np.asarray(prior.ends)[np.asarray(rim.side)[0]]
    beside = (np.asarray(surface.faces[4])[..., None] == ends).any(axis=1).all(axis=1)
    owner = js.control_faces_of(place.scheme, place.topology, surface, place.control)
    assert owner[beside].tolist() == prior.faces(rim)[:1].tolist() == prior.faces(rim)[1:].tolist()


def test_boundary_slides_along_the_curve_but_not_across():
    surface = flat()
    prior = prior_of(BoundaryCurve(np.array([(7.0, -2.0, 1.0), (7.0, 0.0, 0.0)]), 1.0), surface)
    rim = prior.hold(place_of(surface), {})
    rows = prior.rows(place_of(surface), rim)
    for shift, change in (((3.0, 0, 0), 0.0), ((0, 3.0, 0), 3.0), ((0, 0, 3.0), 3.0)):
        moved = js.RefinedSurface(surface.vertices + jnp.array([shift]), surface.normals, surface.faces)
        changed = np.reshape(prior.rows(place_of(moved), rim) - rows, (2, 2))
        np.testing.assert_allclose(np.linalg.norm(changed, axis=1), change, atol=1e-9)


def test_curve_speaks_of_the_boundary_near_it():
    surface = flat()
    curve = BoundaryCurve(np.array([(-1.0, y, 0) for y in range(21)]), 1.0)
    held = prior_of(curve, surface).hold(place_of(surface, edge=4.0), {}).covered
    np.testing.assert_array_equal(held, np.asarray(surface.vertices)[:, 0] < 1e-9)


def test_points_that_fill_up_the_curve_say_nothing():
    """As in a cohort, whose curves have different numbers of points."""
    surface, curve = flat(), BoundaryCurve(np.array([(-1.0, y, 0) for y in range(21)]), 1.0)
    prior, place = prior_of(curve, surface), place_of(surface, edge=4.0)
    points, counts = jnp.pad(prior.points, ((0, 5), (0, 0))), jnp.pad(prior.counts, (0, 5))
    filled = eqx.tree_at(lambda one: (one.points, one.counts), prior, (points, counts))
    np.testing.assert_array_equal(filled.hold(place, {}).covered, prior.hold(place, {}).covered)
    np.testing.assert_array_equal(filled.precisions({}), np.repeat([1.0, 0.0], [42, 10]))


# Fits


@pytest.mark.parametrize("reach", [-2.0, 4.0], ids=["scan stops short", "scan goes past"])
def test_boundary_lies_on_the_curve(reach):
    curve = square(-1.0, 21.0)
    assert off(fitted(reach, True), curve) < 0.1
    assert off(fitted(reach, False), curve) > 0.7


def test_points_beyond_the_curve_do_not_count():
    found = fitted(4.0, True)
    beyond = np.abs(np.asarray(found.scan.points)[:, :2] - 10).max(axis=1) > 11.5
    assert not np.any(found.weights[beyond]) and found.weights[~beyond].mean() > 0.8
    assert fitted(4.0, False).weights[beyond].mean() > 0.5


def test_deviation_says_how_near_the_boundary_stays():
    curve = square(-1.0, 21.0)
    assert off(fitted(-2.0, True, 5.0), curve) > 2 * off(fitted(-2.0, True), curve)


def test_curve_along_a_part_leaves_the_rest_to_the_scan():
    side = np.array([(-1.0, y, 0.0) for y in range(21)])
    x = np.asarray(fit(scan(2.0), BoundaryCurve(side, 0.1)).control.vertices)[:, 0]
    assert abs(x.min() + 1) < 0.2 and 21.2 < x.max() < 24.5


def test_new_pairs_compile_nothing():
    fit(scan(-2.0), BoundaryCurve(square(-1.0, 21.0), 0.2))  # anew: programs may have been forgotten since the last
    programs = derivatives.differentiate, sweeps.hold_priors, sweeps._retract, pairing.measure
    before = [program._cached._cache_size() for program in programs]
    fit(scan(1.0), BoundaryCurve(square(-0.5, 20.5), 0.3))
    assert [program._cached._cache_size() for program in programs] == before


def test_uncertainty_falls_where_the_curve_tells():
    with_curve, without = (precision_matrix(fitted(-2.0, given)) for given in (True, False))
    spread = [np.sqrt(np.diag(np.linalg.inv(matrix))).reshape(9, 3)[:, :2] for matrix in (with_curve, without)]
    corner = 0
    assert (spread[0][corner] < 0.5 * spread[1][corner]).all()


def test_saved_fit_knows_its_curve(tmp_path):
    found = fitted(-2.0, True)
    found.save(tmp_path)
    again = fitting.load(tmp_path)
    np.testing.assert_allclose(precision_matrix(again), precision_matrix(found), rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(again.uncertainty().surface, found.uncertainty().surface, rtol=1e-9)


def test_refit_keeps_the_boundary_on_the_curve():
    found = fitted(-2.0, True)
    assert_refit_knows_the_fit(found)
    _, control = found.refit()(found.scan.points + jnp.array([[2.0, 0, 0.5]]))
    x, _, z = np.asarray(control.vertices).T
    assert abs(x.min() + 1) < 0.2 and abs(x.max() - 21) < 0.2 and z[4] > 0.4


# What cannot be


@pytest.mark.parametrize(
    ("curve", "error", "words"),
    [
        (BoundaryCurve(np.zeros((0, 3))), ScanError, r"points of the shape \[b, 3\], at least one; got \[0, 3\]"),
        (BoundaryCurve(np.zeros((4, 2))), ScanError, r"got \[4, 2\]"),
        (BoundaryCurve(np.array([(0, 0, 0), (0, np.nan, 0)])), ScanError, "not finite in rows 1. Drop them"),
        (BoundaryCurve(np.zeros((4, 3)), 0.0), ScanError, "deviation of `boundary` must be positive and finite; got 0"),
    ],
)
@pytest.mark.usefixtures("as_users_run")
def test_curves_that_cannot_be_are_refused(curve, error, words):
    with pytest.raises(error, match=words):
        fit(scan(0.0), curve)


def test_closed_mesh_has_no_boundary_for_a_curve():
    mesh = js.ControlMesh(10 * meshes.cube()[0], meshes.cube()[1])
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    with pytest.raises(ValueError, match="the control mesh is closed: it has no boundary that could lie on the curve"):
        fitting.fit(js.Interpolating(), topology, mesh.control(), scan(0.0), boundary=BoundaryCurve(square(0.0, 1.0)))
