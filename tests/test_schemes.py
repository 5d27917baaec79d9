"""What the schemes claim of themselves, and what linear ones give beside: stencils, limits, creases."""

import functools

import meshes
import numpy as np
import pytest
from schemes import CASES, PARTS, by_name, control_mesh, over_cases, refined, torus
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv._scheme.base import AbstractScheme
from jaxsubdiv._stage import stage_of

QUAD_SHEET, TRIANGLE_SHEET = meshes.grid(3, 2, bumpy=0.3), meshes.grid(3, 2, "triangle", bumpy=0.3)


def kinds(scheme: AbstractScheme) -> list[str]:
    return [{3: "triangle", 4: "quad"}[size] for size in scheme.takes]


def vertices_of(scheme: AbstractScheme, mesh: js.ControlMesh, levels: int, **options) -> np.ndarray:
    """The refined vertices: by the stencils where there are any, as nothing is compiled for those."""
    topology = js.build_topology(mesh, scheme, levels, **options)
    if scheme.is_linear:
        return js.stencils(scheme, topology) @ mesh.vertices
    return np.asarray(js.refine(scheme, topology, mesh.control()).vertices)


@pytest.mark.parametrize("kind", ["quad", "triangle"])
@pytest.mark.parametrize("name", ["default", "circle", *(c.name for c in CASES if c.reference is None)])
def test_order_is_the_one_claimed(name, kind):
    scheme = by_name(name).with_h(1.0)
    if kind not in kinds(scheme):
        pytest.skip("the scheme does not take these faces")

    def error(n: int) -> float:
        x, y, z = vertices_of(scheme, torus(n, kind), 1).T
        return np.abs(np.hypot(np.hypot(x, y) - 2, z) - 1).max()

    assert abs(np.log2(error(8) / error(16)) - scheme.order) < 0.3


@over_cases(is_linear=True)
def test_linear_schemes_are_their_stencils(case):
    weights = js.stencils(case.scheme, case.topology)
    surface = refined(case, case.subject.control)
    np.testing.assert_allclose(weights @ case.subject.x, surface.vertices, rtol=0, atol=1e-13)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", ["default", "circle", "bezier-triangle"])
def test_other_schemes_have_no_stencils_and_no_limit_masks(name):
    scheme, mesh = by_name(name).scheme, control_mesh(meshes.pyramid())
    with pytest.raises(ValueError, match=rf"{type(scheme).__name__} has no stencils: its vertices are no fixed"):
        js.stencils(scheme, js.build_topology(mesh, scheme, 1))
    with pytest.raises(ValueError, match=rf"{type(scheme).__name__} has no limit masks; the linear schemes do"):
        js.build_topology(mesh, scheme, 1, limit=True)


def euler_number(faces: dict, n: int) -> int:
    return js.ControlMesh(np.zeros((n, 3)), faces, check=False).euler_number


@pytest.mark.parametrize("case", [c for c in CASES if c.reference is None], ids=lambda case: case.name)
def test_euler_number_stays(case):
    mesh = control_mesh(meshes.union(*(meshes.torus(4, 3, kind) for kind in kinds(case.scheme)), PARTS[0]))
    if case.scheme.takes != (3, 4):
        mesh = control_mesh(meshes.torus(4, 3, *kinds(case.scheme)))
    for levels in (1, 2, 3):
        topology = js.build_topology(mesh, case.scheme, levels)
        faces = {size: np.asarray(rows) for size, rows in topology.faces.items()}
        n = 1 + max(rows.max(initial=0) for rows in faces.values())
        assert euler_number(faces, n) == mesh.euler_number
        finer = js.ControlMesh(np.zeros((n, 3)), faces, check=False)
        assert finer.is_closed and len(np.unique(finer.half_edges.start)) == n
        # Neighbours run along their edge in opposite directions.
        sides = finer.half_edges
        assert np.all(np.bincount(sides.edge[sides.start < sides.end]) == 1)


@functools.cache
def star(k: int, size: int) -> tuple[js.ControlMesh, np.ndarray]:
    """A flat mesh, regular but for a vertex of valence `k` in the middle; and where one split puts its vertices."""
    angles = 2 * np.pi * np.arange(k) / k
    rim = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    after = np.roll(np.arange(k), -1)
    vertices = np.concatenate([np.zeros((1, 3)), rim, rim + rim[after]])[: 1 + k * (size - 2)]
    faces = [(0, 1 + i, 1 + j) if size == 3 else (0, 1 + i, 1 + k + i, 1 + j) for i, j in enumerate(after.tolist())]
    mesh, levels = js.ControlMesh(vertices, faces), 3
    masks = {3: js.ModifiedButterfly(), 4: js.Kobbelt()}[size]
    for _ in range(levels + 1):
        topology = js.build_topology(mesh, masks, 1)
        edges, quads = (mesh.vertices[rows].mean(axis=1) for rows in (topology.levels[0].edges, mesh.faces[4]))
        coarser, mesh = mesh, js.ControlMesh(np.concatenate([mesh.vertices, edges, quads]), topology.faces)
    return coarser, mesh.vertices


@pytest.mark.parametrize("name", ["loop", "loop-warren-edge-only", "butterfly", "catmull-clark", "kobbelt"])
def test_limit_is_smooth_at_every_valence(name):
    # C1 needs eigenvalues 1 > a = a > others (Reif 1995); the regular valence has 1/2, 1/2 and then 1/4.
    scheme = by_name(name).scheme
    size = max(scheme.takes)
    for k in range(3, 13):
        mesh, finer = star(k, size)
        weights = js.stencils(scheme, js.build_topology(mesh, scheme, 1))
        near = (
            np.linalg.norm(mesh.vertices, axis=1) < {3: 0.55, 4: 0.8}[size]
        )  # the rings that the next level's rings depend on
        at = KDTree(finer).query(mesh.vertices[near] / 2)[1]
        own = weights[at][:, np.flatnonzero(near)].toarray()
        np.testing.assert_allclose(own.sum(axis=1), 1, rtol=0, atol=1e-14)
        values = np.linalg.eigvals(own)
        first, second, third, fourth = values[np.argsort(-np.abs(values))][:4]
        np.testing.assert_allclose(first, 1, rtol=0, atol=1e-10)
        np.testing.assert_allclose(second, third, rtol=0, atol=1e-7)
        assert 0.2 < second.real < 0.7 and abs(second.imag) < 1e-7
        assert abs(fourth) < 0.97 * second.real
        if k == {3: 6, 4: 4}[size]:
            np.testing.assert_allclose([second, fourth], [0.5, 0.25], rtol=0, atol=1e-3)


def test_faces_of_doo_sabin_shrink_to_their_middle_by_half():
    for k in range(3, 13):
        faces = {3: np.zeros((0, 3), int), 4: np.zeros((0, 4), int), k: np.arange(k)[None]}
        own = js.DooSabin().masks(stage_of(k, faces)).toarray()[:k]
        values = np.sort(np.linalg.eigvalsh(own))[::-1]
        np.testing.assert_allclose(values[:3], [1, 0.5, 0.5], rtol=0, atol=1e-12)
        assert values[3:].max(initial=0) <= 0.25 + 1e-12


def bezier(p: np.ndarray, n: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a PN triangle, or of the bicubic patch with zero twist, as control nets."""
    k = len(p)
    n = n / np.linalg.norm(n, axis=1, keepdims=True)

    def near(i: int, j: int) -> np.ndarray:
        return (2 * p[i] + p[j] - np.dot(p[j] - p[i], n[i]) * n[i]) / 3

    def middle(i: int, j: int) -> np.ndarray:
        d, s = p[j] - p[i], n[i] + n[j]
        h = s - 2 * np.dot(d, s) / np.dot(d, d) * d
        return h / np.linalg.norm(h)

    points, normals = [], []
    if k == 3:
        mean = sum(near(i, j) for i in range(3) for j in range(3) if i != j) / 6
        inner = mean + (mean - p.mean(axis=0)) / 2
        for a, b in ((i, j) for i in range(steps + 1) for j in range(steps + 1 - i)):
            t = (1 - (a + b) / steps, a / steps, b / steps)
            sides = [(i, j) for i in range(3) for j in range(3) if i != j]
            points.append(
                sum(t[i] ** 3 * p[i] for i in range(3))
                + sum(3 * t[i] ** 2 * t[j] * near(i, j) for i, j in sides)
                + 6 * t[0] * t[1] * t[2] * inner
            )
            normals.append(
                sum(t[i] ** 2 * n[i] for i in range(3))
                + sum(t[i] * t[j] * middle(i, j) for i, j in ((0, 1), (1, 2), (2, 0)))
            )
    else:
        place, net = {0: (0, 0), 1: (3, 0), 2: (3, 3), 3: (0, 3)}, np.zeros((4, 4, 3))
        for i, (a, b) in place.items():
            along_u, along_v = {0: (1, 3), 1: (0, 2), 2: (3, 1), 3: (2, 0)}[i]
            net[a, b] = p[i]
            net[abs(a - 1), b], net[a, abs(b - 1)] = near(i, along_u), near(i, along_v)
            net[abs(a - 1), abs(b - 1)] = near(i, along_u) + near(i, along_v) - p[i]
        middles = [middle(i, (i + 1) % 4) for i in range(4)]
        centre = sum(middles) / np.linalg.norm(sum(middles))
        normal_net = np.array([[n[0], middles[3], n[3]], [middles[0], centre, middles[2]], [n[1], middles[1], n[2]]])
        for a, b in ((i / steps, j / steps) for i in range(steps + 1) for j in range(steps + 1)):
            cubic = [np.array([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3]) for t in (a, b)]
            quadratic = [np.array([(1 - t) ** 2, t * (1 - t), t**2]) for t in (a, b)]
            points.append(np.einsum("i,j,ijx->x", *cubic, net))
            normals.append(np.einsum("i,j,ijx->x", *quadratic, normal_net))
    normals = np.array(normals)
    return np.array(points), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_bezier_triangles_are_those_of_vlachos():
    rng, levels = np.random.default_rng(0), 3
    x, n = rng.normal(size=(2, 7, 3))
    mesh = js.ControlMesh(x, [(0, 1, 2), (3, 4, 5, 6)])
    scheme = js.BezierTriangle()
    surface = js.refine(scheme, js.build_topology(mesh, scheme, levels), js.Control(x, n))
    patches = [bezier(x[face], n[face], 2**levels) for face in ([0, 1, 2], [3, 4, 5, 6])]
    expected = [np.concatenate(rows) for rows in zip(*patches, strict=True)]
    at = KDTree(expected[0]).query(surface.vertices)[1]
    assert len(np.unique(at)) == len(at) == len(expected[0])
    np.testing.assert_allclose(surface.vertices, expected[0][at], rtol=0, atol=1e-14)
    np.testing.assert_allclose(surface.normals, expected[1][at], rtol=0, atol=1e-14)


def test_first_level_of_bezier_triangles_has_the_points_of_the_paper():
    case = by_name("bezier-triangle")
    mesh = control_mesh(case.subject.mesh)
    ours, paper = (
        js.refine(scheme, js.build_topology(mesh, scheme, 1), case.subject.control).vertices
        for scheme in (js.BezierTriangle(), js.Interpolating())
    )
    np.testing.assert_allclose(ours, paper, rtol=0, atol=1e-14)


WITH_LIMIT = ["loop", "loop-warren-edge-only", "catmull-clark", "catmull-clark-edge-only"]


@pytest.mark.parametrize("name", WITH_LIMIT)
def test_limit_masks_give_the_same_from_every_level(name):
    scheme = by_name(name).scheme
    parts = [mesh for mesh in (*PARTS[:3], meshes.grid(2, 2, "mixed")) if name.startswith("catmull")]
    mesh = control_mesh(meshes.union(*(parts or [meshes.fan(7), meshes.grid(3, 3, "triangle", bumpy=0.2)])))
    n, found = len(mesh.vertices), []
    for levels in (0, 1, 3):
        topology = js.build_topology(mesh, scheme, levels, limit=True)
        x = vertices_of(scheme, mesh, levels)
        points = topology.limit.points.matrix() @ x
        normals = np.cross(*(tangent.matrix() @ x for tangent in topology.limit.tangents))[:n]
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        found.append((points[:n], normals / np.where(length > 0, length, 1)))
    for points, normals in found[1:]:
        np.testing.assert_allclose(points, found[0][0], rtol=0, atol=1e-13)
        np.testing.assert_allclose(normals, found[0][1], rtol=0, atol=1e-12)
    near = vertices_of(scheme, mesh, 5)[:n]
    assert np.abs(near - found[0][0]).max() < 0.01 < np.abs(mesh.vertices - found[0][0]).max()


def test_middles_of_faces_of_doo_sabin_are_on_the_limit():
    scheme, mesh = js.DooSabin(), control_mesh(meshes.union(meshes.mixed_closed(), (QUAD_SHEET[0] + 9, QUAD_SHEET[1])))
    topology = js.build_topology(mesh, scheme, 0, limit=True)
    limit = topology.limit.points.matrix() @ mesh.vertices
    fine = vertices_of(scheme, mesh, 6)
    assert KDTree(fine).query(limit)[0].max() < 0.02
    assert np.linalg.norm(limit - mesh.vertices, axis=1).mean() > 0.1


def test_refine_puts_out_the_limit_and_its_normals():
    scheme, mesh = js.CatmullClark(), control_mesh(QUAD_SHEET)
    topology = js.build_topology(mesh, scheme, 1, limit=True)
    surface = js.refine(scheme, topology, mesh.control())
    np.testing.assert_allclose(surface.vertices, js.stencils(scheme, topology) @ mesh.vertices, rtol=0, atol=1e-14)
    x = vertices_of(scheme, mesh, 1)
    normals = np.cross(*(tangent.matrix() @ x for tangent in topology.limit.tangents))
    expected = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(surface.normals, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("name", [*WITH_LIMIT, "doo-sabin", "butterfly"])
def test_interpolating_control_has_its_limit_at_the_points(name):
    scheme = by_name(name).scheme
    mesh = control_mesh(meshes.grid(4, 3, kinds(scheme)[-1], bumpy=0.3))
    topology = js.build_topology(mesh, scheme, 0, limit=scheme.is_linear and not scheme.interpolates)
    control = js.interpolating_control(scheme, topology, mesh.vertices)
    np.testing.assert_allclose(js.stencils(scheme, topology) @ control.vertices, mesh.vertices, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(control.normals, axis=1), 1, rtol=0, atol=1e-14)


def test_interpolating_control_says_what_it_cannot_do():
    mesh = control_mesh(meshes.cube())
    scheme = js.CatmullClark()
    topology = js.build_topology(mesh, scheme, 0, limit=True)
    with pytest.raises(ValueError, match="no control vertices reach these points: the closest limit misses by"):
        js.interpolating_control(scheme, topology, mesh.vertices + np.random.default_rng(0).normal(size=(8, 3)))
    with pytest.raises(ValueError, match=r"one a control vertex, shape \[8, 3\]; got \[7, 3\]"):
        js.interpolating_control(scheme, topology, mesh.vertices[1:])
    with pytest.raises(ValueError, match=r"has no limit masks\. Build it with `limit=True`"):
        js.interpolating_control(scheme, js.build_topology(mesh, scheme, 1), mesh.vertices)
    with pytest.raises(ValueError, match="DooSabin needs a topology of 0 levels here"):
        dual = js.build_topology(mesh, js.DooSabin(), 1, limit=True)
        js.interpolating_control(js.DooSabin(), dual, mesh.vertices)
    with pytest.raises(ValueError, match=r"built for CatmullClark.*, not for Loop"):
        js.stencils(js.Loop(), topology)


@pytest.mark.parametrize(
    ("scheme", "mesh", "words"),
    [
        (js.Loop(), meshes.pyramid(), r"Loop takes triangles only, but the mesh has 1 quads \(face 0\).*triangulate"),
        (js.ModifiedButterfly(), meshes.cube(), "ModifiedButterfly takes triangles only, but the mesh has 6 quads"),
        (
            js.Kobbelt(),
            meshes.pyramid(),
            r"Kobbelt takes quads only, but the mesh has 4 triangles .*one level of Catmull",
        ),
    ],
)
def test_faces_that_a_scheme_does_not_take_are_an_error(scheme, mesh, words):
    with pytest.raises(js.MeshError, match=words):
        js.build_topology(js.ControlMesh(*mesh), scheme, 1)


def test_triangulated_meshes_are_taken():
    mesh = js.ControlMesh(*meshes.pyramid(), normals=np.eye(5, 3) + 1).triangulate()
    assert mesh.faces[3].tolist()[-2:] == [[3, 2, 1], [3, 1, 0]] and len(mesh.faces[4]) == 0
    assert mesh.is_closed and mesh.normals is not None
    assert js.build_topology(mesh, js.Loop(), 1).faces[3].shape == (24, 3)


def test_each_linear_scheme_needs_tables_of_its_own():
    mesh = js.ControlMesh(*meshes.octahedron())
    topology = js.build_topology(mesh, js.Loop(), 1)
    for scheme in (js.Loop("warren"), js.Interpolating(), js.BezierTriangle(), js.ModifiedButterfly()):
        with pytest.raises(ValueError, match=r"the topology was built for Loop\(.*needs its own, for .*Build it with"):
            js.refine(scheme, topology, mesh.control())


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: js.Loop("other"), "`variant` must be one of 'loop', 'warren'; got 'other'"),
        (lambda: js.Loop(boundary="other"), "`boundary` must be one of 'edge-and-corner', 'edge-only'; got 'other'"),
        (lambda: js.CatmullClark("other"), "`boundary` must be one of 'edge-and-corner', 'edge-only'; got 'other'"),
    ],
)
def test_options_of_linear_schemes_must_be_known(as_users_run, build, words):
    with pytest.raises(ValueError, match=words):
        build()


def test_sharp_edges_stay_and_semi_sharp_ones_lie_between():
    scheme, mesh = js.CatmullClark(), control_mesh(meshes.cube())
    top = [tuple(edge) for edge in mesh.half_edges.edges if np.all(mesh.vertices[edge][:, 2] == 1)]
    refine = functools.partial(vertices_of, scheme, mesh, 4)
    reach = [np.linalg.norm(refine(creases=js.Creases(top, sharp)), axis=1).max() for sharp in (0, 0.5, 1, 2, 3, 10)]
    assert np.all(np.diff(reach) > 0.001)
    # Sharp for ever, the edges are the cubic B-spline of the square, in its plane.
    along = refine(creases=js.Creases(top, 10))
    assert np.sum(np.abs(along[:, 2] - 1) < 1e-14) == 17**2
    smooth = vertices_of(scheme, mesh, 2)
    np.testing.assert_allclose(vertices_of(scheme, mesh, 2, creases=js.Creases()), smooth, rtol=0, atol=1e-15)


def test_creases_that_are_not_there_are_an_error():
    scheme, mesh = js.CatmullClark(), control_mesh(meshes.cube())
    build = functools.partial(js.build_topology, mesh, scheme, 1)
    for creases, words in (
        (js.Creases([(0, 7)]), r"creases \(0, 7\) are not edges of the mesh"),
        (js.Creases([(0, 99)]), r"creases \(0, 99\) are not edges of the mesh"),
        (js.Creases(vertices=[8, -1]), "sharp vertices 8, -1 are not in the mesh, which has 8 vertices"),
        (js.Creases([(0, 1)], [1, 2]), r"`sharpness` must be one number or 1, one each; got shape \[2\]"),
        (js.Creases(vertices=[0], vertex_sharpness=-1), "`vertex_sharpness` must not be negative; got -1.0"),
    ):
        with pytest.raises(js.MeshError, match=words):
            build(creases=creases)
    with pytest.raises(ValueError, match="Interpolating has no creases; CatmullClark and Loop do"):
        js.build_topology(mesh, js.Interpolating(), 1, creases=js.Creases([(0, 1)]))
    with pytest.raises(ValueError, match="some creases are still sharp after the last level"):
        build(creases=js.Creases([(0, 1)], 2.5), limit=True)


def test_margin_is_the_least_cosine_with_the_corners_of_the_faces():
    vertices, faces = meshes.cube()
    mesh = js.ControlMesh(vertices, faces)
    np.testing.assert_allclose(js.admissible_margin(mesh), 1 / np.sqrt(3), rtol=1e-12)
    normals = np.tile([(0.0, 0, 2)], (8, 1))
    normals[3] = 0
    margin = js.admissible_margin(mesh, js.Control(vertices, normals))
    np.testing.assert_allclose(margin, np.where(vertices[:, 2] > 0, 0, -1) * (np.arange(8) != 3), atol=1e-15)
    with pytest.raises(ValueError, match=r"as many vertices and normals as the mesh, \[8, 3\]"):
        js.admissible_margin(mesh, js.Control(vertices[1:], normals[1:]))


def test_normals_that_would_fold_the_surface_are_warned_of():
    vertices, faces = meshes.octahedron()
    mesh = js.ControlMesh(vertices, faces, np.where(np.arange(6)[:, None] == 2, -1, 1) * vertices)
    with pytest.warns(UserWarning, match=r"the normals of vertices 2 point to the back of .* \(margin down to -0.58\)"):
        js.build_topology(mesh, js.Interpolating(), 1)
    js.build_topology(mesh, js.Interpolating(old_normals="recompute"), 1)
    js.build_topology(mesh, js.Loop(), 1)
