"""Several normals at one vertex: meshes cut open along creases, and surfaces that are sharp there without a crack."""

import functools
import warnings

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from schemes import control_mesh

import fitting
import jaxsubdiv as js
from jaxsubdiv._scheme.seams import _FADE, project_on_normals

CUBE = js.ControlMesh(*meshes.cube())
SCHEMES = {
    "default": js.Interpolating(1.1),
    "recompute": js.Interpolating(boundary="chord", old_normals="recompute"),
    "circle": js.CirclePreserving(1.1),
}


def over_schemes():
    return pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES.keys())


def cylinder(k: int) -> js.ControlMesh:
    """Radius 1, from z = -1 to 1: two rings of `k` quads, and caps of `k` triangles."""
    angles = 2 * np.pi * np.arange(k) / k
    rings = [np.stack([np.cos(angles), np.sin(angles), np.full(k, z)], axis=1) for z in (-1.0, 0.0, 1.0)]
    i, after = np.arange(k), (np.arange(k) + 1) % k
    quads = np.concatenate([np.stack([i, after, after + k, i + k], axis=1) + first for first in (0, k)])
    caps = [
        np.stack([after, i, 0 * i + 3 * k], axis=1),
        np.stack([i + 2 * k, after + 2 * k, 0 * i + 3 * k + 1], axis=1),
    ]
    return js.ControlMesh(np.concatenate([*rings, [(0, 0, -1), (0, 0, 1)]]), {3: np.concatenate(caps), 4: quads})


def subjects() -> dict[str, js.SplitMesh]:
    """Corners of three creases; a closed crease; one that ends in the surface; one from a boundary to a boundary."""
    sheet = control_mesh(meshes.grid(3, 2, "mixed", bumpy=0.2))
    return {
        "cube": js.split_normals(CUBE, angle=60),
        "cylinder": js.split_normals(cylinder(7), angle=60),
        "dart": js.split_normals(CUBE, [(0, 1), (1, 3)]),
        "sheet": js.split_normals(sheet, [(1, 4), (4, 7), (7, 10)]),
    }


SUBJECTS = subjects()


def all_subjects() -> js.SplitMesh:
    """All of them in one mesh, so that a scheme is compiled once."""
    parts = [(part.mesh.vertices, [tuple(face) for k in (3, 4) for face in part.mesh.faces[k].tolist()]) for part in
             SUBJECTS.values()]  # fmt: skip
    origins = [part.origin for part in SUBJECTS.values()]
    first = np.cumsum([0] + [origin.max() + 1 for origin in origins[:-1]])
    origin = np.concatenate([origin + n for origin, n in zip(origins, first, strict=True)])
    return js.SplitMesh(control_mesh(meshes.union(*parts)), origin)


def over_subjects():
    return pytest.mark.parametrize("split", SUBJECTS.values(), ids=SUBJECTS.keys())


def control_of(split: js.SplitMesh, seed: int = 0, dtype: type = np.float64) -> js.Control:
    """Shared positions moved a little, and normals of any length about those of each side."""
    rng = np.random.default_rng(seed)
    shared = split.mesh.vertices[np.unique(split.origin, return_index=True)[1]]
    vertices = (shared + rng.uniform(-0.1, 0.1, shared.shape))[split.origin]
    own = np.asarray(js.ControlMesh(vertices, split.mesh.faces).control().normals)
    normals = (own + rng.uniform(-0.2, 0.2, own.shape)) * rng.uniform(0.5, 2, (len(own), 1))
    return js.Control(vertices.astype(dtype), normals.astype(dtype))


def places(split: js.SplitMesh, topology: js.Topology) -> np.ndarray:
    """For every refined vertex the first one that lies at its place by the seams."""
    place = np.unique(split.origin, return_index=True)[1][np.unique(split.origin, return_inverse=True)[1]]
    for level in topology.levels:
        n, new = len(place), np.arange(len(level.edges) + len(level.quads))
        one, other = np.asarray(level.seams).T
        new[other] = one
        place = np.concatenate([place, n + new])
    return place


def closed_up(split: js.SplitMesh, topology: js.Topology) -> js.ControlMesh:
    """The refined mesh with one vertex a place."""
    place = places(split, topology)
    faces = {size: place[np.asarray(rows)] for size, rows in topology.faces.items()}
    return js.ControlMesh(np.zeros((len(place), 3)), faces, check=False)


# ---------------------------------------------------------------------------------------------------------- no cracks


@over_subjects()
def test_seams_close_the_refined_mesh(split):
    before = js.ControlMesh(
        split.mesh.vertices, {k: split.origin[rows] for k, rows in split.mesh.faces.items()}, check=False
    )
    for levels in (1, 3):
        after = closed_up(split, js.build_topology(split.mesh, js.Interpolating(), levels, seams=split.origin))
        assert after.euler_number == before.euler_number
        assert len(after.boundary_edges) == len(before.boundary_edges) * 2**levels


@over_schemes()
def test_sides_of_a_seam_are_equal_bit_by_bit_at_every_level(scheme):
    split = all_subjects()
    topology = js.build_topology(split.mesh, scheme, 2, seams=split.origin)
    x = np.asarray(js.refine(scheme, topology, control_of(split, 1, np.float32)).vertices)
    assert x.dtype == np.float32 and np.array_equal(x, x[places(split, topology)])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sides_are_equal_in_a_batch_and_inside_a_larger_program(dtype):
    split, scheme = SUBJECTS["cube"], js.Interpolating()
    topology = js.build_topology(split.mesh, scheme, 3, seams=split.origin)
    batch = jax.tree.map(lambda *rows: jnp.stack(rows), *(control_of(split, seed, dtype) for seed in range(3)))
    turn = jnp.asarray(np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], dtype)
    turned = jax.jit(jax.vmap(lambda control: js.refine(scheme, topology, control).vertices @ turn))(batch)
    x = np.asarray(turned)
    assert np.array_equal(x, x[:, places(split, topology)])


# -------------------------------------------------------------------------------------------------------------- shape


@pytest.mark.parametrize(("scheme", "bound"), [(js.Interpolating(), 0.6e-3), (js.CirclePreserving(), 1e-14)])
def test_rim_of_a_cylinder_is_round_and_sharp(scheme, bound):
    parts = [cylinder(k) for k in (8, 16)]
    union = meshes.union(*((part.vertices, [*part.faces[3].tolist(), *part.faces[4].tolist()]) for part in parts))
    coarse = np.arange(len(union[0])) < len(parts[0].vertices)
    split = js.split_normals(control_mesh(union), angle=60)
    topology = js.build_topology(split.mesh, scheme, 2, seams=split.origin)
    surface = js.refine(scheme, topology, split.mesh.control())
    x, n, place = np.asarray(surface.vertices), np.asarray(surface.normals), places(split, topology)
    copies = np.flatnonzero(place != np.arange(len(place)))
    assert len(copies) == 2 * (8 + 16) * 2**2
    np.testing.assert_allclose(np.abs(x[copies, 2]), 1, atol=1e-14)
    np.testing.assert_allclose(np.sum(n[copies] * n[place[copies]], axis=1), 0, atol=1e-9)
    on_cap = np.abs(n[:, 2]) > 0.5
    np.testing.assert_allclose(np.abs(x[on_cap, 2]), 1, atol=1e-14)
    first = coarse[split.origin].astype(float)
    for level in topology.levels:
        quads = np.asarray(level.quads)
        first = np.concatenate([first, first[np.asarray(level.edges)].mean(axis=1), first[quads].mean(axis=1)])
    off = np.abs(np.linalg.norm(x[copies, :2], axis=1) - 1)
    worst = [off[first[copies] == side].max() for side in (1, 0)]
    assert worst[1] < bound
    assert isinstance(scheme, js.CirclePreserving) or worst[0] / worst[1] > 14  # order 4


def test_polyhedra_with_a_normal_a_face_stay_what_they_are():
    split = js.split_normals(CUBE, angle=60)
    topology = js.build_topology(split.mesh, js.Interpolating(1.1), 2, seams=split.origin)
    surface = js.refine(js.Interpolating(1.1), topology, split.mesh.control())
    np.testing.assert_allclose(np.abs(surface.vertices).max(axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(np.abs(surface.normals).max(axis=1), 1, atol=1e-14)


def test_tangents_of_a_seam_are_at_right_angles_to_both_normals():
    split = SUBJECTS["cube"]
    control, origin = control_of(split, 2), split.origin
    topology = js.build_topology(split.mesh, js.Interpolating(), 1, seams=origin)
    level = topology.levels[0]
    x, n = np.asarray(control.vertices), np.asarray(control.normals)
    points = np.asarray(js.refine(js.Interpolating(), topology, control).vertices)[len(x) :]
    for one, other in np.asarray(level.seams):
        (a, b), (b_too, a_too) = np.asarray(level.edges)[[one, other]]
        d, bend = x[b] - x[a], np.zeros(3)
        for sign, left, right in ((1, n[a], n[a_too]), (-1, n[b], n[b_too])):
            t = np.cross(left, right) / np.linalg.norm(np.cross(left, right))
            bend += sign * (d @ t) * t
        np.testing.assert_allclose(points[one], (x[a] + x[b]) / 2 + bend / 8, rtol=0, atol=1e-14)


@pytest.mark.parametrize("scheme", [js.Interpolating(1.2), js.Interpolating()])
def test_where_the_normals_agree_edge_points_are_the_ordinary_ones(scheme):
    split = js.split_normals(CUBE, angle=60)
    control = CUBE.control()
    shared = js.Control(control.vertices[split.origin], control.normals[split.origin])
    for turned in (shared, js.Control(shared.vertices, shared.normals.at[8:].multiply(-1.0))):
        topology = js.build_topology(split.mesh, scheme, 1, seams=split.origin)
        x = np.asarray(js.refine(scheme, topology, turned).vertices)
        smooth = np.asarray(js.refine(scheme, js.build_topology(CUBE, scheme, 1), control).vertices)
        for row in x[len(split.origin) :]:
            assert np.linalg.norm(smooth - row, axis=1).min() < 1e-14


def test_one_missing_normal_leaves_that_of_the_other_side():
    d, n, zero = jnp.array([[1.0, 2.0, 3.0]]), jnp.array([[0.6, 0.8, 0.0]]), jnp.zeros((1, 3))
    expected = np.sum(d * n) * n
    for left, right in ((n, n), (n, zero), (zero, n), (n, -n)):
        np.testing.assert_allclose(project_on_normals(d, left, right), expected, rtol=0, atol=1e-15)
    assert not project_on_normals(d, zero, zero).any()


# -------------------------------------------------------------------------------------------------------- derivatives


@functools.cache
def value_and_slopes(name: str):
    """Compiled: a function of h, the shared positions and the normals, and its derivatives."""
    split, scheme = SUBJECTS["dart"], SCHEMES[name]
    topology = js.build_topology(split.mesh, scheme, 1, seams=split.origin)

    def value(h, shared, normals):
        surface = js.refine(type(scheme)(h), topology, js.Control(shared[split.origin], normals))
        return jnp.sum(jnp.sin(3 * surface.vertices)) + jnp.sum(jnp.sin(3 * surface.normals))

    return jax.jit(jax.value_and_grad(value, argnums=(0, 1, 2)))


@pytest.mark.parametrize("name", ["default", "circle"])
def test_derivatives_agree_with_central_differences(name):
    start, rng = control_of(SUBJECTS["dart"], 3), np.random.default_rng(0)
    at = jnp.asarray(1.1), start.vertices[:8], start.normals
    _, slopes = value_and_slopes(name)(*at)
    for i, slope in enumerate(slopes):
        along = jnp.asarray(rng.normal(size=slope.shape))
        ahead, back = (
            value_and_slopes(name)(*(x + s * along if i == j else x for j, x in enumerate(at)))[0]
            for s in (1e-5, -1e-5)
        )
        np.testing.assert_allclose(jnp.vdot(slope, along), (ahead - back) / 2e-5, rtol=0, atol=1e-7)


@pytest.mark.parametrize("turned", [0.0, 0.3, 0.9, 1.0, 1.1, 3.0])
def test_fading_has_a_continuous_derivative(turned):
    d, n = jnp.array([[0.3, 1.0, -0.4]]), jnp.array([[0.0, 0.0, 1.0]])

    def rule(angle):
        return project_on_normals(d, n, jnp.stack([jnp.sin(angle), 0 * angle, jnp.cos(angle)])[None])

    angle = turned * 2 * np.arcsin(_FADE / 2)
    _, slope = jax.jvp(rule, (jnp.asarray(angle),), (jnp.asarray(1.0),))
    differences = (rule(angle + 1e-7) - rule(angle - 1e-7)) / 2e-7
    np.testing.assert_allclose(slope, differences, rtol=0, atol=1e-3 if turned == 1 else 1e-5)
    assert np.abs(slope).max() < 2 / _FADE


@pytest.mark.parametrize("name", ["default", "circle"])
def test_derivatives_are_finite_where_formulas_have_none(name):
    split = SUBJECTS["dart"]
    start = control_of(split)
    x, n = start.vertices[:8], start.normals
    agree = n[split.origin]
    opposite = agree * jnp.where(jnp.arange(len(n)) < 8, 1.0, -1.0)[:, None]
    along_edge = n.at[0].set(x[1] - x[0])
    for vertices, normals in (
        (x, agree), (x, opposite), (x, 0 * n), (x, n.at[:8].set(0.0)), (x, along_edge), (0 * x, n), (0 * x, 0 * n)
    ):  # fmt: skip
        for leaf in jax.tree.leaves(value_and_slopes(name)(jnp.asarray(1.1), vertices, normals)):
            assert np.isfinite(leaf).all() and np.abs(leaf).max() < 1e4


# ------------------------------------------------------------------------------------------------------------ cutting


def test_cut_keeps_the_old_vertices_first_and_copies_them_behind():
    split = js.split_normals(CUBE, angle=60)
    assert np.array_equal(split.origin[:8], np.arange(8)) and np.array_equal(np.bincount(split.origin), [3] * 8)
    assert np.array_equal(split.mesh.vertices, CUBE.vertices[split.origin])
    assert np.array_equal(split.origin[split.mesh.faces[4]], CUBE.faces[4])
    assert len(js.split_normals(CUBE, angle=100).origin) == 8 and split.mesh.normals is None


def test_normals_stay_where_a_vertex_stays_one_and_are_of_their_side_elsewhere():
    given = CUBE.vertices / np.sqrt(3)
    split = js.split_normals(js.ControlMesh(CUBE.vertices, CUBE.faces, given), [(0, 1), (1, 3)])
    copies = np.flatnonzero(split.origin == 1)
    single = np.setdiff1d(np.arange(len(split.origin)), copies)
    assert split.mesh.normals is not None and len(copies) == 2
    assert np.array_equal(split.mesh.normals[single], given[split.origin[single]])
    own = js.ControlMesh(split.mesh.vertices, split.mesh.faces).control().normals
    np.testing.assert_allclose(split.mesh.normals[copies], own[copies], rtol=0, atol=1e-15)


def test_fans_that_share_a_vertex_stay_together_where_there_is_no_crease():
    bow_tie = js.ControlMesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (-1, 0, 0.5), (-1, -1, 0)], [(0, 1, 2), (0, 3, 4)])
    assert np.array_equal(js.split_normals(bow_tie, angle=30).origin, np.arange(5))


def test_seams_of_a_mesh_that_comes_cut_are_found_by_position():
    split = SUBJECTS["cylinder"]
    origin = np.unique(split.mesh.vertices, axis=0, return_inverse=True)[1].ravel()
    ours, theirs = (
        js.build_topology(split.mesh, js.Interpolating(), 2, seams=seams) for seams in (split.origin, origin)
    )
    for a, b in zip(ours.levels, theirs.levels, strict=True):
        assert np.array_equal(*(np.unique(np.sort(level.seams, axis=1), axis=0) for level in (a, b)))


def test_without_copies_nothing_changes():
    ours = js.build_topology(CUBE, js.Interpolating(), 2, seams=np.arange(8))
    assert jax.tree.structure(ours) == jax.tree.structure(js.build_topology(CUBE, js.Interpolating(), 2))
    assert not ours.has_seams


def test_a_crease_of_one_edge_inside_the_surface_is_told():
    with pytest.warns(UserWarning, match=r"creases \(0, 1\) end inside the surface at both ends"):
        split = js.split_normals(CUBE, [(1, 0)])
    assert len(split.origin) == 8
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        js.split_normals(CUBE, [(0, 1), (1, 3)])


def test_what_cannot_be_is_an_error():
    split = SUBJECTS["cube"]

    def build(mesh=split.mesh, scheme=None, seams=split.origin):
        js.build_topology(mesh, scheme or js.Interpolating(), 1, seams=seams)

    with pytest.raises(ValueError, match="either by `edges`, or by `angle`"):
        js.split_normals(CUBE)
    with pytest.raises(js.MeshError, match=r"creases \(0, 7\) are not edges of the mesh"):
        js.split_normals(CUBE, [(0, 7)])
    with pytest.raises(js.MeshError, match=r"one whole number a vertex, \[24\].* of shape \[8\]"):
        build(seams=np.arange(8))
    with pytest.raises(js.MeshError, match=r"vertices 8, 9, .* are sewn to others that lie elsewhere"):
        moved = split.mesh.vertices + np.where(np.arange(24) < 8, 0, 0.1)[:, None]
        build(js.ControlMesh(moved, split.mesh.faces))
    flaps = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)])
    three = js.ControlMesh(flaps[[0, 1, 2, 0, 1, 3, 0, 1, 4]], [(0, 1, 2), (4, 3, 5), (6, 7, 8)])
    with pytest.raises(js.MeshError, match=r"more than two sides meet at the seams \(0, 1\)"):
        build(three, seams=[0, 1, 2, 0, 1, 3, 0, 1, 4])
    two = js.ControlMesh(flaps[[0, 1, 2, 0, 1, 3]], [(0, 1, 2), (3, 4, 5)])
    with pytest.raises(js.MeshError, match=r"the sides of the seams \(0, 1\) are oriented oppositely"):
        build(two, seams=[0, 1, 2, 0, 1, 3])
    for scheme in (js.CatmullClark(), js.BezierTriangle()):
        with pytest.raises(ValueError, match="has no seams; Interpolating and CirclePreserving do"):
            build(scheme=scheme)
    topology = js.build_topology(split.mesh, js.Interpolating(), 1, seams=split.origin)
    scan = fitting.Scan(np.random.default_rng(0).normal(size=(100, 3)))
    with pytest.raises(ValueError, match="a mesh with seams cannot be fitted"):
        fitting.fit(js.Interpolating(), topology, split.mesh.control(), scan)


def test_places_of_the_control_mesh_are_evaluated_on_both_sides_alike():
    split = js.split_normals(cylinder(8), angle=60)
    scheme = js.Interpolating()
    topology = js.build_topology(split.mesh, scheme, 2, seams=split.origin)
    edge = np.linspace(0, 1, 5)
    n_triangles = len(split.mesh.faces[3])
    lower = js.SurfacePoint(np.full(5, n_triangles), np.stack([edge, 0 * edge], axis=1))
    cap = js.SurfacePoint(np.zeros(5, int), np.stack([0 * edge + 1 - edge[::-1], 0 * edge], axis=1))
    control = split.mesh.control()
    side, flat = (js.evaluate_control(scheme, topology, control, at) for at in (lower, cap))
    np.testing.assert_allclose(side.points, np.asarray(flat.points)[::-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(flat.normals, np.tile((0.0, 0.0, -1.0), (5, 1)), atol=1e-12)
