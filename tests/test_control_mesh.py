"""Control meshes made from scans: sound, even, on the scan, of the right topology."""

import functools
import re
import sys

import meshes
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxsubdiv as js
from fitting import Scan, ScanError, control_mesh, topology_of
from fitting.start.align import sample_faces
from fitting.start.orient import orient, plane_fits
from fitting.start.poisson import poisson
from fitting.start.remesh import Coarse, _collapse, pair_triangles

needs_extra = pytest.mark.skipif(
    any(not __import__("importlib.util").util.find_spec(name) for name in ("pyvista", "pyacvd", "rustworkx")),
    reason="a control mesh from a scan needs the extra `mesh`",
)
R = 80.0  # mm


def ball(n: int = 4000, sigma: float = 0.0, seed: int = 0) -> np.ndarray:
    """Points on an ellipsoid of half axes 80, 64 and 96 mm."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    x = R * x / np.linalg.norm(x, axis=1, keepdims=True) * (1.0, 0.8, 1.2)
    return x + rng.normal(scale=sigma, size=x.shape) if sigma else x


def off_ball(x: np.ndarray) -> np.ndarray:
    """Distances from that ellipsoid, to first order."""
    y = x / (R, 0.8 * R, 1.2 * R)
    level = np.sum(y**2, axis=1) - 1
    return level / np.linalg.norm(2 * y / (R, 0.8 * R, 1.2 * R), axis=1)


def ring(n: int = 6000, sigma: float = 0.5) -> np.ndarray:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, 2 * np.pi, (2, 2 * n))
    keep = rng.uniform(0, 3, 2 * n) < 2 + np.cos(v)  # even by area
    u, v = u[keep][:n], v[keep][:n]
    x = 30 * np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)
    return x + rng.normal(scale=sigma, size=x.shape)


def sheet(n: int = 3000) -> np.ndarray:
    """A saddle of 120 by 100 mm, seen from above."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-60, 60, n), rng.uniform(-50, 50, n)
    return np.stack([x, y, 0.004 * (x**2 - y**2)], axis=1) + rng.normal(scale=0.2, size=(n, 3))


def check_sound(mesh: js.ControlMesh, n_faces: int, kind: str) -> None:
    """Manifold and wound alike is what `ControlMesh` checks; here the rest of what is promised of every mesh."""
    assert mesh.n_faces == pytest.approx(n_faces, rel=0.1)
    assert len(mesh.faces[4 if kind == "triangle" else 3]) <= (0 if mesh.is_closed else 6)
    edge = np.linalg.norm(np.diff(mesh.vertices[mesh.half_edges.edges], axis=1)[:, 0], axis=1)
    assert edge.std() < 0.25 * edge.mean()
    valence = np.bincount(mesh.half_edges.edges.ravel())
    assert 3 <= valence.max() <= 9
    assert mesh.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1)
    for faces in filter(len, mesh.faces.values()):
        areas = js._mesh.vector_areas(mesh.vertices[faces])
        assert (np.einsum("fx,fkx->fk", areas, mesh.normals[faces]) > 0).mean() > 0.99


@functools.cache
def of_ball(kind: str) -> js.ControlMesh:
    return control_mesh(Scan(ball(sigma=0.5)), faces=300, kind=kind)


@needs_extra
@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_closed(kind):
    mesh = of_ball(kind)
    check_sound(mesh, 300, kind)
    assert topology_of(mesh) == (1, 0, 0, 2)
    assert np.sqrt(np.mean(off_ball(mesh.vertices) ** 2)) < 0.35  # less than the noise
    true = mesh.vertices / np.square((1.0, 0.8, 1.2))
    cosine = np.sum(true / np.linalg.norm(true, axis=1, keepdims=True) * mesh.normals, axis=1)
    assert np.degrees(np.arccos(cosine)).mean() < 4  # and outwards


@needs_extra
@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_open(kind):
    mesh = control_mesh(Scan(sheet()), faces=150, kind=kind)
    check_sound(mesh, 150, kind)
    assert topology_of(mesh) == (1, 1, 0, 1)
    x, y, z = mesh.vertices.T
    assert np.sqrt(np.mean((z - 0.004 * (x**2 - y**2)) ** 2)) < 0.4
    np.testing.assert_allclose([np.ptp(x), np.ptp(y)], [120, 100], rtol=0.06)  # the rim is where the points end


@needs_extra
def test_ring():
    mesh = control_mesh(Scan(ring()), faces=400)
    check_sound(mesh, 400, "triangle")
    assert topology_of(mesh) == (1, 0, 1, 0)


@needs_extra
@pytest.mark.parametrize("outliers", [0.2, 0.6])
def test_outliers(outliers):
    points, rng = ball(10_000, sigma=0.5), np.random.default_rng(1)
    n = round(outliers * len(points))
    points[:n] = 1.2 * R * rng.uniform(-1, 1, (n, 3)) * (1.0, 0.8, 1.2)
    mesh = control_mesh(Scan(points), faces=300)
    assert topology_of(mesh) == (1, 0, 0, 2)
    assert np.sqrt(np.mean(off_ball(mesh.vertices) ** 2)) < 0.7


@needs_extra
def test_a_hole_is_bridged_and_closed_says_when():
    points = ball(6000, sigma=0.3)
    points = points[np.linalg.norm(points - (R, 0, 0), axis=1) > 45]
    assert topology_of(control_mesh(Scan(points), faces=200)) == (1, 0, 0, 2)
    opened = control_mesh(Scan(points), faces=200, closed=False)
    assert topology_of(opened) == (1, 1, 0, 1)
    rim = opened.vertices[np.unique(opened.boundary_edges)]
    assert np.linalg.norm(rim - (R, 0, 0), axis=1).min() > 36


@needs_extra
def test_half_is_open_and_closed_says_when():
    points = ball(6000, sigma=0.3)
    points = points[points[:, 2] > 0]
    assert topology_of(control_mesh(Scan(points), faces=200)) == (1, 1, 0, 1)
    assert topology_of(control_mesh(Scan(points), faces=200, closed=True)) == (1, 0, 0, 2)


@needs_extra
def test_uneven_density_and_noise():
    points = np.concatenate([ball(1500, 2.0), [x for x in ball(12_000, 2.0, seed=1) if x[2] > 20]])
    mesh = control_mesh(Scan(points), faces=200)
    assert topology_of(mesh) == (1, 0, 0, 2)
    assert np.sqrt(np.mean(off_ball(mesh.vertices) ** 2)) < 2.0


@needs_extra
def test_normals_of_the_scan_say_what_is_outside():
    x = sheet()
    up = np.tile((0.0, 0.0, 1.0), (len(x), 1))
    for sign in (1, -1):
        mesh = control_mesh(Scan(x, sign * up), faces=100)
        assert mesh.normals is not None and (sign * mesh.normals[:, 2] > 0).all()
    x = ball()
    with pytest.warns(UserWarning, match="the normals of the scan point inwards; they were turned"):
        mesh = control_mesh(Scan(x, -x), faces=100)
    assert mesh.normals is not None and (np.sum(mesh.normals * mesh.vertices, axis=1) > 0).all()


@needs_extra
def test_points_of_no_weight_do_not_count():
    points = np.concatenate([ball(), ball() + (300, 0, 0)])
    mesh = control_mesh(Scan(points, weights=np.repeat([1.0, 0.0], 4000)), faces=100)
    assert np.abs(mesh.vertices).max() < 110


@needs_extra
def test_other_parts_are_told():
    points = np.concatenate([ball(4000), 0.4 * ball(1000) + (300, 0, 0)])
    with pytest.warns(UserWarning, match=r"the scan shows 2 parts; .* Left out: 20% of the points"):
        mesh = control_mesh(Scan(points), faces=200)
    assert np.abs(mesh.vertices).max() < 110
    assert topology_of(mesh) == (1, 0, 0, 2)


@needs_extra
def test_turning_the_scan_turns_the_mesh():
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2])
    mesh = control_mesh(Scan(turn.apply(ball()) + 5000.0), faces=200)
    assert np.abs(off_ball(turn.inv().apply(mesh.vertices - 5000.0))).max() < 1.0
    np.testing.assert_array_equal(
        control_mesh(Scan(ball()), faces=100).vertices, control_mesh(Scan(ball()), faces=100).vertices
    )


# ------------------------------------------------------------------------------------------------------------- refused

LINE = np.arange(90.0)[:, None] * (1, 2, 3)
REFUSED = {
    "few": (ball(40), "40 points of different places are too few to make a control mesh of; 50 are the least"),
    "spot": (np.ones((500, 3)), r"all points lie on one spot, \[1.0, 1.0, 1.0\]: no surface follows"),
    "line": (LINE, "all points lie on a line: no surface follows"),
    "plane": (ball(200) * (1, 1, 0), "all points lie on a plane: no surface follows. Was a coordinate lost"),
}


@needs_extra
@pytest.mark.parametrize("case", REFUSED)
def test_refuses(case):
    points, words = REFUSED[case]
    with pytest.raises(ScanError, match=words):
        control_mesh(Scan(points))


@needs_extra
def test_refuses_contours_that_lie_far_apart():
    angles, heights = np.linspace(0, 2 * np.pi, 180, endpoint=False), np.linspace(-25, 25, 51)
    slices, angles = (grid.ravel() for grid in np.meshgrid(np.arange(51), angles, indexing="ij"))
    radius = np.sqrt(30**2 - heights[slices] ** 2)
    tube = np.stack([radius * np.cos(angles), radius * np.sin(angles), heights[slices]], axis=1)
    apart = slices % 10 == 0
    words = r"contours in slices 10\.\d mm apart, with a point every 0\.\d mm.*Give a template \(--control"
    with pytest.raises(ScanError, match=words):
        control_mesh(Scan(tube[apart], slices=slices[apart]), faces=100)
    # Many points along a contour, or each of them twice, or one number for all: no reason to refuse.
    control_mesh(Scan(ball(), slices=np.zeros(len(ball()), int)), faces=60)
    along = np.repeat(tube, 2, axis=0)
    control_mesh(Scan(along, slices=np.repeat(slices, 2)), faces=60)
    together = control_mesh(Scan(tube, slices=slices), faces=100)
    inside = np.abs(together.vertices[:, 2]) < 24
    np.testing.assert_allclose(np.linalg.norm(together.vertices[inside], axis=1), 30, atol=0.5)


@needs_extra
@pytest.mark.parametrize("scale", [0.001, 1000.0])
def test_scan_that_is_hardly_in_mm_is_told(scale):
    points = ball() * scale
    size = np.linalg.norm(np.ptp(points, axis=0))
    with pytest.warns(UserWarning, match=re.escape(f"the scan measures {size:.3g} across") + ", which is taken as mm"):
        made = control_mesh(Scan(points), faces=60)
    np.testing.assert_allclose(np.ptp(made.vertices, axis=0), np.ptp(points, axis=0), rtol=0.2)  # nothing is guessed


@needs_extra
def test_refuses_too_few_faces():
    with pytest.raises(ScanError, match=r"30 faces are too few for what the scan shows \(1 part, closed, genus [1-9]"):
        control_mesh(Scan(lattice()), faces=30)
    mesh = control_mesh(Scan(lattice()), faces=600)
    assert topology_of(mesh) == (1, 0, 5, -8)


def lattice() -> np.ndarray:
    """Points on the edges of a cube, each a bar: genus 5."""
    h, out = 6.0, []
    rng = np.random.default_rng(0)
    for axis in range(3):
        for a in (-40.0, 40.0):
            for b in (-40.0, 40.0):
                x = rng.uniform(-h, h, (1500, 3))
                side = rng.integers(0, 2, 1500)
                other = [i for i in range(3) if i != axis]
                x[np.arange(1500), np.array(other)[side]] = np.where(rng.uniform(size=1500) < 0.5, -h, h)
                x[:, axis] = rng.uniform(-40 - h, 40 + h, 1500)
                x[:, other[0]] += a
                x[:, other[1]] += b
                out.append(x)
            if axis < 3:
                continue
    x = np.concatenate(out)
    # What lies inside of another bar is no surface; the ends of the bars are the corners' outer sides.
    y = np.abs(np.abs(x) - 40) < h - 1e-9
    x = x[y.sum(axis=1) < 2]
    ends = rng.uniform(-h, h, (3000, 3))
    ends[np.arange(3000), rng.integers(0, 3, 3000)] = h
    corners = np.where(rng.uniform(size=(3000, 3)) < 0.5, -1.0, 1.0)
    return np.concatenate([x, corners * (40 + ends)])


def test_refuses_settings(as_users_run):
    with pytest.raises(ValueError, match="`kind` is one of triangle, quad; got 'hexagon'"):
        control_mesh(Scan(ball()), kind="hexagon")
    with pytest.raises(ValueError, match="`faces` must be 16 or more; got 4"):
        control_mesh(Scan(ball()), faces=4)


def test_without_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyacvd", None)
    with pytest.raises(ImportError, match=r"need pyacvd, .*pip install 'jaxsubdiv\[mesh\]'"):
        control_mesh(Scan(ball()))


# --------------------------------------------------------------------------------------------------------------- parts


@pytest.mark.parametrize(
    ("mesh", "expected", "words"),
    [
        (meshes.icosahedron(), (1, 0, 0, 2), "1 part, closed, genus 0, Euler number 2"),
        (meshes.torus(6, 5), (1, 0, 1, 0), "1 part, closed, genus 1, Euler number 0"),
        (meshes.grid(3, 4, "mixed"), (1, 1, 0, 1), "1 part, open (1 boundary loop), genus 0, Euler number 1"),
        (meshes.two_components(), (2, None, 0, None), "2 parts"),
    ],
)
def test_topology(mesh, expected, words):
    found = topology_of(js.ControlMesh(*mesh))
    assert all(a == b for a, b in zip(found, expected, strict=True) if b is not None)
    assert str(found).startswith(words)
    assert found.euler_number == 2 * found.parts - 2 * found.genus - found.boundary_loops
    assert found.is_closed == (found.boundary_loops == 0)


def test_orients_points():
    x = ball(2000)
    normals, off, near = plane_fits(x)
    normals = normals * np.random.default_rng(0).choice([-1, 1], (len(x), 1))
    found = orient(x, normals, near)
    assert (np.sum(found * x, axis=1) > 0).all()
    assert off.max() < 2


def test_poisson_is_one_inside():
    x = ball(8000)
    true = x / np.square((1.0, 0.8, 1.2))
    normals = true / np.linalg.norm(true, axis=1, keepdims=True)
    # Samples of the stretched sphere are uneven: each stands for the area that its direction was stretched to.
    areas = 4 * np.pi * R**2 / len(x) * 0.8 * 1.2 * np.linalg.norm(true / R, axis=1)
    found = poisson(x, normals, areas, cell=4.0, smoothing=4.0)
    inside, outside = found.evaluate(np.zeros((1, 3)))[0], found.values[0, 0, 0]
    assert inside - outside == pytest.approx(1, abs=0.1)
    assert found.evaluate(x).std() < 0.06
    assert (np.sum(found.outward_vectors(x) * normals, axis=1) > 0).all()


def test_collapsing_keeps_the_topology():
    vertices, faces = meshes.torus(16, 12, "triangle")
    mesh = _collapse(Coarse(vertices, {3: np.array(faces), 4: np.zeros((0, 4), int)}), 60)
    assert len(mesh.faces[3]) == 60
    assert topology_of(js.ControlMesh(*mesh)) == (1, 0, 1, 0)
    fewest = _collapse(mesh, 4)  # no torus has so few: it stops before
    assert topology_of(js.ControlMesh(*fewest)) == (1, 0, 1, 0)


@pytest.mark.skipif(not __import__("importlib.util").util.find_spec("rustworkx"), reason="pairing needs rustworkx")
@pytest.mark.parametrize("mesh", [meshes.icosahedron(), meshes.torus(8, 6, "triangle"), meshes.grid(5, 4, "triangle")])
def test_pairs_all_triangles(mesh):
    vertices, faces = mesh
    found = pair_triangles(Coarse(np.asarray(vertices, float), {3: np.array(faces), 4: np.zeros((0, 4), int)}))
    before, after = js.ControlMesh(vertices, faces), js.ControlMesh(*found)
    assert len(found.faces[3]) == 0
    assert topology_of(after) == topology_of(before)
    if not before.is_closed:  # the squares that were cut in halves come back
        np.testing.assert_allclose(np.linalg.norm(js._mesh.vector_areas(found.vertices[found.faces[4]]), axis=1), 1)


# ---------------------------------------------------------------------------------------------------------- real scans

REAL = {
    "femur_distal_points.npz": (1, 0, 0, 2),
    "head_fragment_points.npz": (1, 1, 0, 1),
    "face_laser.vtp": (1, 1, 0, 1),
    "head_fragment_ct.stl": (1, 2, 0, 0),
    "cortex_left_colin27.surf.gii": (1, 0, 0, 2),
    "head_digitised_a.xyz": (1, 1, 0, 1),
}


@needs_extra
@pytest.mark.parametrize("name", REAL)
def test_real_scans(shared_data, name):
    path = shared_data / name
    points = np.load(path)["points"] if path.suffix == ".npz" else np.asarray(js.read_points(path).points, np.float64)
    mesh = control_mesh(Scan(points), faces=1000, kind="quad" if "face" in name else "triangle")
    check_sound(mesh, 1000, "quad" if "face" in name else "triangle")
    assert topology_of(mesh) == REAL[name]
    size = np.ptp(points, axis=0).max()
    near = KDTree(sample_faces(mesh, 20_000).points).query(points)[0]
    assert np.median(near) < 0.012 * size
    assert np.median(KDTree(points).query(mesh.vertices)[0]) < 0.03 * size


@needs_extra
def test_face_is_seen_from_outside(shared_data):
    scan = js.read_mesh(shared_data / "face_laser.vtp")
    mesh = control_mesh(Scan(scan.vertices), faces=200)
    row = KDTree(scan.vertices).query(mesh.vertices)[1]
    assert mesh.normals is not None
    assert (np.sum(mesh.normals * np.asarray(scan.control().normals)[row], axis=1) > 0).mean() > 0.98
