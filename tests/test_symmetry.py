"""Mirror planes of meshes, and the prior that keeps a fit symmetric."""

import functools

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from scans import N_POINTS, analysed, assert_refit_knows_the_fit, noise, problem
from scipy.spatial.transform import Rotation

import fitting
import jaxsubdiv as js
from fitting import Free, Priors, Recipe, Scan, Symmetry, find_symmetry
from fitting.model.priors.symmetry import Plane
from fitting.run import fit_scan as _fit_scan
from fitting.solve import sweeps

STRICT = Priors(symmetry=0.01)


def placed(mesh: meshes.Mesh, seed: int) -> js.ControlMesh:
    """Somewhere, turned, its vertices in another order."""
    (vertices, faces), _, _ = meshes.relabelled(mesh, seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    return js.ControlMesh(np.asarray(vertices) @ turn.T + (30, -20, 10), faces)


def one_sided(seed: int = 0) -> meshes.Mesh:
    """A cuboctahedron with bumps, alike left and right and in no other way."""
    vertices, faces = meshes.mixed_closed()
    vertices = vertices * (24, 18, 15)
    moved = vertices + np.random.default_rng(seed).normal(scale=2.5, size=vertices.shape)
    image = find_symmetry(js.ControlMesh(vertices, faces)).partner
    return (moved + moved[image] * (-1, 1, 1)) / 2, sorted(faces, key=len)


# Finding the plane


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("mesh", "n_on_plane"),
    [(one_sided(), 4), (meshes.fan(5), None), (meshes.torus(7, 5), None), (meshes.grid(5, 4), None)],
)
def test_mirror_plane_is_found_in_any_pose(mesh, n_on_plane, seed):
    mesh = placed(mesh, seed)
    found = find_symmetry(mesh)
    own = np.arange(len(mesh.vertices))
    np.testing.assert_array_equal(found.partner[found.partner], own)
    assert (found.partner != own).any()  # in the plane of a flat mesh it is its own image
    np.testing.assert_allclose(found.plane.mirror(mesh.vertices), mesh.vertices[found.partner], atol=1e-9)
    np.testing.assert_allclose(found.mirror(mesh.vertices), mesh.vertices, atol=1e-9)
    assert n_on_plane is None or (found.partner == own).sum() == n_on_plane


def test_of_several_planes_the_one_across_x_is_taken():
    vertices, faces = meshes.mixed_closed()
    for across, sizes in ((0, (3, 2, 1)), (0, (1, 2, 3)), (0, (1, 1, 1))):
        found = find_symmetry(js.ControlMesh(vertices * sizes, faces))
        np.testing.assert_allclose(np.abs(found.plane.normal), np.eye(3)[across], atol=1e-9)


def test_mesh_without_a_mirror_plane_is_refused_by_its_vertices():
    mesh = js.ControlMesh(*meshes.grid(5, 4, bumpy=1.0))
    with pytest.raises(ValueError, match=r"no mirror plane: .* vertices \d+, .* have no partner within .* \(0\.05 edg"):
        find_symmetry(mesh)


def test_tolerance_is_how_far_a_vertex_may_be_off():
    vertices, faces = one_sided()
    vertices = vertices.copy()
    vertices[4] += (0, 1.5, 0)  # edges are 27 mm long
    with pytest.raises(ValueError, match="no partner"):
        find_symmetry(js.ControlMesh(vertices, faces), tolerance=0.01)
    found = find_symmetry(js.ControlMesh(vertices, faces))
    np.testing.assert_array_equal(found.partner, find_symmetry(js.ControlMesh(*one_sided())).partner)
    asymmetry = np.linalg.norm(found.mirror(vertices) - vertices, axis=1)
    assert 1.0 < asymmetry.max() < 1.5


# The rows


@pytest.mark.parametrize("free", [Free(), Free(normals=False), Free(vertices=False, h=False)])
def test_rows_and_their_derivatives_by_the_plane(free):
    p = problem()
    normals = p.start.normals / np.linalg.norm(p.start.normals, axis=1, keepdims=True)
    control = js.Control(p.start.vertices, normals)
    options = {"free": free, "priors": Priors(symmetry=0.5), "symmetry": find_symmetry(p.mesh)}
    model, y = analysed(js.Interpolating(), p.topology, control, **options)
    prior, place = model.prior("symmetry"), model.place(y)
    held, pairs = prior.hold(place, {}), np.arange(12) < find_symmetry(p.mesh).partner
    departure = np.asarray(control.vertices) - find_symmetry(p.mesh).mirror(control.vertices)
    rows = np.asarray(prior.rows(place, held))
    n = 3 * pairs.sum()
    np.testing.assert_allclose(rows[:n].reshape(-1, 3), departure[pairs], atol=1e-12)
    assert len(rows) == (2 if np.any(free.normals) else 1) * (
        n + (find_symmetry(p.mesh).partner == np.arange(12)).sum()
    )
    np.testing.assert_allclose(prior.precisions({}), 0.5**-2)

    def rows_by_plane(change):
        """Of a mirror that is shifted along its normal, and turned."""
        turned = held.plane.normal + (change[1:] / held.extent) @ held.turns
        plane = Plane(held.plane.middle + change[0] * held.plane.normal, turned / jnp.linalg.norm(turned))
        off, leaning = (control.vertices - plane.mirror(control.vertices)[prior.partner]), []
        found = [off[prior.left].reshape(-1), (control.vertices[prior.on_plane] - plane.middle[None]) @ plane.normal]
        if np.any(free.normals):
            across = Plane(jnp.zeros(3), plane.normal)
            leaning = control.normals - across.mirror(control.normals)[prior.partner]
            found += [held.lever * leaning[prior.left].reshape(-1)]
            found += [held.lever * control.normals[prior.on_plane] @ plane.normal]
        return jnp.concatenate(found)

    def rows_by_unknown(change):
        return prior.rows(place._replace(shared={**place.shared, "mirror": change}), held)

    by, expected = (jax.jit(jax.jacfwd(of))(jnp.zeros(3)) for of in (rows_by_unknown, rows_by_plane))
    np.testing.assert_allclose(by, expected, atol=1e-12)


# The prior


@functools.cache
def bumpy() -> tuple[js.ControlMesh, np.ndarray, np.ndarray]:
    """A shape with bumps, points on it, and which of them the scan does not have: one side of one end."""
    p, mesh = problem(), js.ControlMesh(*one_sided(5))
    surface = js.refine(js.Interpolating(p.h), p.topology, mesh.control())
    points = np.asarray(js.sample(surface, N_POINTS, jax.random.key(0)).points)
    return mesh, points, (points[:, 0] > 8) & (points[:, 1] > -5)


@functools.cache
def fitted(symmetry: float, beside: float = 0.0) -> fitting.FitResult:
    """From the mesh without bumps, by so many mm beside its place."""
    p, (_, points, hole) = problem(), bumpy()
    start = p.mesh.control()
    start = js.Control(start.vertices + jnp.array([[beside, 0.0, 0.0]]), start.normals)
    return p.fit(
        points + 0.15 * noise(), weights=np.where(hole, 0.0, 1.0), control=start, priors=Priors(symmetry=symmetry)
    )


def off(found: fitting.FitResult, where: np.ndarray) -> float:
    """Root mean square distance of the surface from the points of the shape."""
    points = bumpy()[1][where]
    away = js.evaluate(found.surface, fitting.closest_points(found.surface, points)).points - points
    return float(jnp.sqrt(jnp.mean(jnp.sum(away**2, axis=1))))


def test_hole_is_filled_from_the_other_side():
    hole = bumpy()[2]
    assert 100 < hole.sum() < 200
    without, strict = fitted(np.inf), fitted(0.01)
    assert off(strict, hole) < 0.5 * off(without, hole)
    assert off(strict, ~hole) < 1.1 * off(without, ~hole)


def test_deviation_is_how_far_the_fit_departs_from_symmetry():
    partners = find_symmetry(problem().mesh)
    asymmetry = []
    for deviation in (np.inf, 0.1, 0.01):
        vertices = fitted(deviation).control.vertices
        asymmetry.append(float(np.abs(partners.mirror(vertices) - vertices).max()))
    assert asymmetry[0] > 3 * asymmetry[1] > 9 * asymmetry[2] and asymmetry[2] < 0.01


def test_normals_are_tied_too():
    found, partners = fitted(0.01), find_symmetry(problem().mesh)
    plane = _plane(found)
    normals = np.asarray(found.control.normals)[partners.partner]
    image = normals - 2 * (normals @ plane.normal)[:, None] * plane.normal
    np.testing.assert_allclose(image, found.control.normals, atol=0.01)


def _plane(found: fitting.FitResult) -> Plane:
    """The plane of a fit."""
    return Plane(*map(np.asarray, found.fit.gather_held().priors["symmetry"].plane))


def test_plane_moves_along_with_the_mesh(monkeypatch):
    """However strong the prior is, a mesh that starts beside its place gets there as soon as without."""
    everywhere = np.ones(N_POINTS, bool)
    found, straight = fitted(0.01, beside=4.0), fitted(0.01)
    assert len(found.rms) <= len(straight.rms) + 2 and off(found, everywhere) < 1.1 * off(straight, everywhere)
    loose = sweeps.active_unknowns

    def hold_the_plane(model, shifting, xp=np):
        names = [name for name, of in model.layout.shared for _ in range(int(np.prod(of.shape, dtype=int)))]
        return loose(model, shifting, xp) & (np.array(names) != "mirror")

    monkeypatch.setattr(sweeps, "active_unknowns", hold_the_plane)
    held = fitted.__wrapped__(0.01, beside=4.0)
    assert len(held.rms) > len(found.rms) + 10 or off(held, everywhere) > 3 * off(found, everywhere)


def test_uncertainty_falls_where_symmetry_tells():
    without, strict = (fitted(deviation).uncertainty().control for deviation in (np.inf, 0.01))
    in_hole = np.argmax(without)
    assert strict[in_hole] < 0.2 * without[in_hole]
    # Each knows its partner, about the plane, to within the prior's own deviation; where the plane lies is not known.
    fit, equations = fitted(0.01).fit, fitted(0.01).posterior.equations
    layout, partner = fit.model.layout, find_symmetry(problem().mesh).partner
    names = [name for name, of in layout.shared for _ in range(int(np.prod(of.shape, dtype=int)))]
    about_plane = equations.factorise(equations.data.add(equations.prior), fit.loose, np.array(names) != "mirror")
    covariance = about_plane.solve(np.eye(layout.n))[: layout.n_own, : layout.n_own]
    blocks = covariance.reshape(12, layout.width, 12, layout.width)[np.arange(12), :3, np.arange(12), :3]
    variance = np.einsum("vi,vij,vj->v", fit.y.control.normals, blocks, fit.y.control.normals)
    assert np.abs(variance - variance[partner]).max() < 1.1 * 0.01**2
    assert np.all(variance <= strict**2 * (1 + 1e-9))


def test_refit_keeps_what_the_prior_says():
    found = fitted(0.01)
    assert_refit_knows_the_fit(found)
    points, partners = np.array(found.scan.points), find_symmetry(problem().mesh)
    _, again = found.refit()(jnp.asarray(points))
    np.testing.assert_allclose(again.vertices, found.control.vertices, atol=0.02)
    points[points[:, 0] < -8, 0] -= 0.3  # where the other side has its hole
    _, moved = found.refit()(jnp.asarray(points))
    change = np.asarray(moved.vertices - again.vertices)
    assert np.abs(change).max() > 0.25
    apart = partners.mirror(moved.vertices) - np.asarray(moved.vertices)
    assert np.abs(apart).max() < 0.08


def test_saved_fit_knows_its_symmetry(tmp_path):
    found = fitted(0.01)
    found.save(tmp_path)
    again = fitting.load(tmp_path)
    np.testing.assert_allclose(again.uncertainty().surface, found.uncertainty().surface, rtol=1e-9)
    assert float(again.recipe.priors.symmetry) == 0.01
    with np.load(tmp_path / "fit.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "fit.npz", **(arrays | {"symmetry_partner": np.arange(11)}))
    with pytest.raises(ValueError, match=r"fit\.npz: `symmetry` has 11 partners for 12 control vertices"):
        fitting.load(tmp_path)


def test_recipe_knows_the_prior_and_finds_the_partners():
    recipe = Recipe.from_json(fitted(0.01).recipe.to_json())
    assert float(recipe.priors.symmetry) == 0.01
    assert float(Recipe.from_json(Recipe(js.Interpolating(), 1).to_json()).priors.symmetry) == np.inf
    found = recipe.fit(problem().mesh, fitted(0.01).scan)
    np.testing.assert_allclose(found.control.vertices, fitted(0.01).control.vertices, atol=1e-9)


# What cannot be


@pytest.mark.parametrize(
    ("partner", "words"),
    [
        (np.arange(11), "has 11 partners for 12 control vertices"),
        (np.array([1, 2, 0, *range(3, 12)]), "vertices 0, 1, 2 are not the partners of their partners"),
        (np.array([12, *range(1, 12)]), "vertices 0 are not the partners"),
    ],
)
def test_partners_that_cannot_be_are_refused(partner, words):
    given = Symmetry(partner, find_symmetry(problem().mesh).plane)
    with pytest.raises(ValueError, match=words):
        problem().fit(priors=STRICT, symmetry=given)


def test_partners_without_a_deviation_are_refused():
    with pytest.raises(ValueError, match=r"say how near in mm, too: Priors\(symmetry=1\.0\)"):
        problem().fit(symmetry=find_symmetry(problem().mesh))


def test_start_that_is_not_symmetric_needs_partners():
    p = problem()
    control = js.Control(p.start.vertices + 2 * noise()[:12], p.start.normals)
    with pytest.raises(ValueError, match="no mirror plane"):
        p.fit(priors=STRICT, control=control)
    found = p.fit(priors=STRICT, control=control, symmetry=find_symmetry(p.mesh))
    assert np.abs(find_symmetry(p.mesh).mirror(found.control.vertices) - found.control.vertices).max() < 0.05


def test_fit_scan_takes_the_partners_from_the_template_and_its_split(monkeypatch):
    """Not from the fitted mesh, which is not exactly symmetric."""
    seen, outcomes = [], iter((None, "no more faces"))

    def told(scheme, topology, control, scan, *, symmetry, **options):
        seen.append((symmetry, topology.n_control_vertices))
        return fitted(0.1)

    monkeypatch.setattr(_fit_scan, "fit", told)
    monkeypatch.setattr(_fit_scan, "_outcome", lambda *_: next(outcomes))
    mesh, points, _ = bumpy()
    found = fitting.fit_scan(Scan(points), mesh, levels=1, pose=None, tolerance_mm=0.01, priors=Priors(symmetry=1.0))
    assert found.splits == 1 and [len(symmetry.partner) for symmetry, _ in seen] == [12, len(found.start.vertices)]
    assert [n for _, n in seen] == [12, len(found.start.vertices)]
    np.testing.assert_array_equal(seen[1][0].partner[:12], seen[0][0].partner)
    asymmetry = np.abs(seen[1][0].mirror(found.start.vertices) - found.start.vertices).max()
    assert 1e-3 < asymmetry < 0.5
