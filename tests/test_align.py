"""Alignment: the pose is found again from far off, and what cannot be right is told."""

import functools
import json
import warnings

import meshes
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import fitting
import jaxsubdiv as js
from fitting import Landmarks, Scan, ScanError
from fitting.start.align import sample_faces

SIZE = 100.0
FAR = Rotation.from_rotvec(np.array([0.4, -0.7, 0.6]) / np.linalg.norm([0.4, -0.7, 0.6]) * np.pi)
FARTHEST = "upside down and far away"
CORNERS = (3, 40, 77, 110, 130)  # vertices for landmarks


@functools.cache
def bean(closed: bool = True) -> js.ControlMesh:
    """A lump of about 100 mm that no rotation or mirror takes to itself; open, its lower part is cut away."""
    polar = np.linspace(0.12, np.pi - 0.12, 11)
    around = 2 * np.pi * np.arange(18) / 18
    p, a = np.meshgrid(polar, around, indexing="ij")
    x = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=2).reshape(-1, 3)
    at = np.arange(11 * 18).reshape(11, 18)
    rows = np.stack([at[:-1], at[1:], np.roll(at, -1, 1)[1:], np.roll(at, -1, 1)[:-1]], axis=2).reshape(-1, 4)
    faces = [tuple(row) for row in rows]
    if closed:
        faces += [(len(x), *pair) for pair in zip(at[0], np.roll(at[0], -1), strict=True)]
        faces += [(len(x) + 1, *pair) for pair in zip(np.roll(at[-1], -1), at[-1], strict=True)]
        x = np.concatenate([x, [(0, 0, 1), (0, 0, -1)]])
    else:
        faces = [face for face in faces if x[list(face), 2].mean() > -0.3]
    bump = np.exp(-3 * ((x - (0.6, 0.5, 0.4)) ** 2).sum(axis=1)) + 0.5 * np.exp(
        -6 * ((x - (-0.2, -0.9, 0.3)) ** 2).sum(axis=1)
    )
    x = SIZE * x * (0.8, 1.0, 1.3) * (1 + 0.5 * bump[:, None]) + (10, -20, 30)
    mesh = js.ControlMesh(x, faces)
    return js.ControlMesh(x, faces, np.asarray(mesh.control().normals))


def scan_of(
    mesh: js.ControlMesh, n: int = 4000, sigma: float = 0.5, outliers: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Points on the flat faces, with noise, among outliers that fill the bounding box."""
    rng = np.random.default_rng(seed)
    points = rng.permutation(sample_faces(mesh, n).points)
    points = points + rng.normal(scale=sigma, size=points.shape)
    count = round(outliers * n)
    low, high = points.min(axis=0), points.max(axis=0)
    points[:count] = rng.uniform(1.1 * low - 0.1 * high, 1.1 * high - 0.1 * low, (count, 3))
    return points


def off(found: fitting.Alignment, scale: float, rotation: Rotation, shift: np.ndarray, mesh: js.ControlMesh) -> float:
    """RMS distance, in mm, of the vertices from where they belong."""
    expected = scale * rotation.apply(np.array(mesh.vertices)) + shift
    return float(np.sqrt(np.mean(np.sum((found.mesh.vertices - expected) ** 2, axis=1))))


def quietly(*arguments, **options) -> fitting.Alignment:
    """An alignment whose doubts are read from the record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fitting.align(*arguments, **options)


ABOUT = Rotation.from_rotvec(30 * np.array([0.6, 0.0, 0.8]), degrees=True)
NONE, SHIFT = Rotation.identity(), np.array([8.0, -4.0, 6.0])
STARTS = {
    "near": (0.95, Rotation.from_rotvec([0.1, 0.05, -0.05]), SHIFT),
    "30 degrees, larger": (1.2, ABOUT, SHIFT),
    "30 degrees, smaller": (0.8, ABOUT.inv(), SHIFT),
    FARTHEST: (1.0, FAR, 50 * SHIFT),
    "axes in another order": (1.0, Rotation.from_matrix(np.eye(3)[[1, 2, 0]]), np.zeros(3)),
}


@pytest.mark.parametrize(("start", "closed"), [*((start, start != "near") for start in STARTS), (FARTHEST, False)])
def test_finds_the_pose(start, closed):
    mesh, (scale, rotation, shift) = bean(closed), STARTS[start]
    points = scale * rotation.apply(scan_of(mesh)) + shift
    found = fitting.align(mesh, Scan(points))
    assert off(found, scale, rotation, shift, mesh) < 1.0
    assert found.doubts == ()
    assert found.share > 0.95
    assert found.rms == pytest.approx(0.5 * scale, rel=0.3)


@pytest.mark.parametrize("outliers", [0.05, 0.6])
def test_outliers(outliers):
    mesh, (scale, rotation, shift) = bean(), STARTS["30 degrees, smaller"]
    points = scale * rotation.apply(scan_of(mesh, 8000, outliers=outliers)) + shift
    found = fitting.align(mesh, Scan(points))
    assert off(found, scale, rotation, shift, mesh) < 1.5
    assert found.share == pytest.approx(1 - outliers, abs=0.25)  # some outliers lie near the surface by chance


def test_a_hole_moves_the_moments_but_not_the_pose():
    mesh, (scale, rotation, shift) = bean(), STARTS[FARTHEST]
    points = scan_of(mesh)
    points = points[np.linalg.norm(points - mesh.vertices[30], axis=1) > 70]
    found = fitting.align(mesh, Scan(scale * rotation.apply(points) + shift))
    assert off(found, scale, rotation, shift, mesh) < 1.5


def test_of_a_partial_scan_the_pose_as_given_wins():
    mesh, (scale, rotation, shift) = bean(), STARTS["near"]
    points = scan_of(mesh, 12_000)
    points = points[points[:, 0] > 45]  # one side: its moments are not the template's
    found = fitting.align(mesh, Scan(scale * rotation.apply(points) + shift))
    assert off(found, scale, rotation, shift, mesh) < 5


def test_keep_lets_the_scan_show_more_than_the_template():
    whole = bean()
    faces = [face for size in (3, 4) for face in whole.faces[size] if whole.vertices[face, 0].mean() > 55]
    part = js.ControlMesh(whole.vertices, faces)
    rotation = Rotation.from_rotvec([0.1, 0.1, -0.1])
    scan = Scan(rotation.apply(scan_of(whole, 8000)))
    rows = np.unique(np.concatenate(faces))[[0, 9, 17]]
    marks = (rotation.apply(whole.vertices[rows]), rows)
    low, high = (
        off(quietly(part, scan, keep=keep, landmarks=marks), 1.0, rotation, np.zeros(3), part) for keep in (0.15, 1.0)
    )
    assert low < 2.0 < 10 < high


def test_kinds():
    mesh = bean()
    stretch = np.array([1.15, 1.0, 0.9])
    scan = Scan(ABOUT.apply(scan_of(mesh) * stretch))
    rows = np.array(CORNERS)[:3]  # three give the start and no shear: that must come from the points
    marks = (ABOUT.apply(mesh.vertices[rows] * stretch), rows)
    found = {kind: fitting.align(mesh, scan, kind=kind, landmarks=marks) for kind in ("rigid", "similarity", "affine")}
    linear = {kind: one.transform[:3, :3] for kind, one in found.items()}
    np.testing.assert_allclose(linear["rigid"] @ linear["rigid"].T, np.eye(3), atol=1e-9)
    gram = linear["similarity"] @ linear["similarity"].T
    np.testing.assert_allclose(gram, gram[0, 0] * np.eye(3), atol=1e-9)
    assert abs(gram[0, 0] - 1) > 1e-3
    np.testing.assert_allclose(linear["affine"], ABOUT.as_matrix() * stretch, atol=0.03)
    assert found["affine"].rms < 0.5 * min(found["rigid"].rms, found["similarity"].rms)


def test_normals_stay_at_right_angles():
    mesh = bean()
    found = fitting.align(mesh, Scan(scan_of(mesh) * (1.2, 1.0, 0.85)), kind="affine")
    assert mesh.normals is not None and found.mesh.normals is not None
    tangents = np.cross(mesh.normals, (0.3, 0.5, 0.8)) @ found.transform[:3, :3].T
    np.testing.assert_allclose(np.sum(found.mesh.normals * tangents, axis=1), 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found.mesh.normals, axis=1), 1)
    x = np.c_[mesh.vertices, np.ones(len(mesh.vertices))] @ found.transform.T
    np.testing.assert_allclose(found.mesh.vertices, x[:, :3])
    bare = js.ControlMesh(mesh.vertices, mesh.faces)
    marks = (mesh.vertices[list(CORNERS)], np.array(CORNERS))
    assert fitting.align(bare, Scan(scan_of(mesh)), landmarks=marks).mesh.normals is None


def test_same_input_same_answer():
    mesh, scan = bean(), Scan(scan_of(bean(), outliers=0.2))
    marks = (mesh.vertices[list(CORNERS)], np.array(CORNERS))
    first, second = (fitting.align(mesh, scan, landmarks=marks).transform for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_mirrored_scan_is_told_and_not_followed():
    mesh, swap = bean(), np.eye(3)[[1, 0, 2]]
    with pytest.warns(UserWarning, match="fits better as a mirror image .* two axes were exchanged"):
        found = fitting.align(mesh, Scan(scan_of(mesh) @ swap.T))
    assert np.linalg.det(found.transform[:3, :3]) > 0
    assert "mirror" in found.doubts[0].text


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1e-3, "units are likely m and mm. Read the scan with scale=1000,"),
        (1 / 25.4, "inches and mm. Read the scan with scale=25.4,"),
        (0.1, "cm and mm, or dm and cm. Read the scan with scale=10,"),
        (1000, "m and mm. Read the scan with scale=0.001,"),
    ],
)
def test_another_unit_is_named(factor, words):
    with pytest.raises(ScanError, match=words):
        fitting.align(bean(), Scan(scan_of(bean()) * factor))


def ellipsoid() -> js.ControlMesh:
    """Three half turns take it to itself."""
    vertices, faces = meshes.icosahedron()
    return js.ControlMesh(50 * vertices * (1.0, 0.8, 0.6), faces)


def test_two_answers_are_told():
    mesh, quarter = ellipsoid(), Rotation.from_rotvec([0, 0, np.pi / 2])
    with pytest.warns(UserWarning, match="alignment: two poses fit alike"):
        found = fitting.align(mesh, Scan(quarter.apply(scan_of(mesh, sigma=0.2))))
    assert "two poses fit alike" in found.doubts[0].text
    assert fitting.align(mesh, Scan(scan_of(mesh, sigma=0.2))).doubts == ()  # the pose as given says which


def test_nothing_in_common():
    rng = np.random.default_rng(0)
    found = quietly(bean(), Scan(rng.uniform(-100, 100, (3000, 3))))
    assert any("mm off where it fits best" in doubt.text for doubt in found.doubts)


# ---------------------------------------------------------------------------------------------------------- landmarks


def test_landmarks_fix_what_points_cannot():
    mesh, rotation = ellipsoid(), Rotation.from_rotvec([0, 0, np.pi])
    scan, rows = Scan(rotation.apply(scan_of(mesh))), np.arange(6)
    on_scan = rotation.apply(np.array(mesh.vertices[rows])) + np.random.default_rng(0).normal(scale=1.0, size=(6, 3))
    without = quietly(mesh, scan)
    by_index = fitting.align(mesh, scan, landmarks=(on_scan, rows))
    by_position = fitting.align(mesh, scan, landmarks=Landmarks(on_scan, mesh.vertices[rows]))
    np.testing.assert_array_equal(by_index.transform, by_position.transform)
    assert off(by_index, 1.0, rotation, np.zeros(3), mesh) < 1
    assert off(without, 1.0, rotation, np.zeros(3), mesh) > 20


@pytest.mark.parametrize("kind", ["rigid", "similarity", "affine"])
def test_landmarks_alone(kind):
    mesh, (scale, rotation, shift) = bean(), STARTS[FARTHEST]
    rows = np.array(CORNERS)
    linear = scale * rotation.as_matrix() @ (np.diag([1.1, 1.0, 0.9]) if kind == "affine" else np.eye(3))
    x = mesh.vertices @ linear.T + shift
    found = fitting.align(mesh, Scan(x), kind=kind, landmarks=(x[rows], rows), refine=False)
    np.testing.assert_allclose(found.transform[:3, :3], linear, atol=1e-9)
    np.testing.assert_allclose(found.mesh.vertices, x, atol=1e-6)


def test_weights_of_landmarks():
    mesh, rows = bean(), np.array(CORNERS)
    on_scan = mesh.vertices[rows] + np.where(np.arange(len(rows)) == 2, 10, 0)[:, None]
    scan, weights = Scan(mesh.vertices), np.where(np.arange(len(rows)) == 2, 0, 1)
    ignored = fitting.align(mesh, scan, landmarks=(on_scan, rows, weights), refine=False)
    counted = fitting.align(mesh, scan, landmarks=(on_scan, rows), refine=False)
    np.testing.assert_allclose(ignored.transform, np.eye(4), atol=1e-9)
    assert np.abs(counted.transform - np.eye(4)).max() > 1


def test_landmarks_never_mirror():
    mesh, rows = bean(), np.array(CORNERS)
    flipped = mesh.vertices * (-1, 1, 1)
    found = quietly(mesh, Scan(flipped), landmarks=(flipped[rows], rows), refine=False)
    assert np.linalg.det(found.transform[:3, :3]) > 0
    assert any("landmarks far from their place: rows" in doubt.text for doubt in found.doubts)


def test_one_landmark_does_not_fix_a_pose():
    mesh = bean()
    with pytest.raises(ScanError, match="give three or more, not on a line"):
        fitting.align(mesh, Scan(scan_of(mesh)), landmarks=(mesh.vertices[[4]], [4]), refine=False)
    found = fitting.align(mesh, Scan(scan_of(mesh)), landmarks=(mesh.vertices[[4]], np.array([4])))
    assert off(found, 1.0, NONE, np.zeros(3), mesh) < 1


LANDMARKS = {"LPA": [-1.7, 73.3, 0.0], "RPA": [1.7, -73.3, 0.0], "Nasion": [104.0, 0.0, 0.0]}


def test_reads_landmarks(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps(LANDMARKS | {"coils": [[1, 2, 3], [4, 5, 6]]}))
    (tmp_path / "b.csv").write_text("name,x,y,z\nlpa, -1.7, 73.3, 0\n\nnasion,104,0,0\n")
    (tmp_path / "bare.csv").write_text("lpa,-0.0017,0.0733,0\n")
    a, b = fitting.read_landmarks(tmp_path / "a.json"), fitting.read_landmarks(tmp_path / "b.csv")
    assert list(a) == ["LPA", "RPA", "Nasion", "coils 1", "coils 2"]
    np.testing.assert_array_equal(a["coils 2"], [4, 5, 6])
    np.testing.assert_allclose(fitting.read_landmarks(tmp_path / "bare.csv", scale=1000.0)["lpa"], [-1.7, 73.3, 0])
    both = fitting.match_landmarks(a, b)
    np.testing.assert_array_equal(both.on_scan, [LANDMARKS["LPA"], LANDMARKS["Nasion"]])
    np.testing.assert_array_equal(both.on_mesh, [b["lpa"], b["nasion"]])
    np.testing.assert_array_equal(fitting.match_landmarks(a, {"rpa": 7, "lpa ": 5}).on_mesh, [5, 7])
    with pytest.raises(ScanError, match=r"no landmark is named on both sides: the scan has LPA.*the mesh has tip"):
        fitting.match_landmarks(a, {"tip": 3})


BAD_FILES = {
    "a.json": ('{"lpa": [1, 2]}', r"a\.json, 'lpa': a landmark is three finite numbers x, y, z; got \[1, 2\]"),
    "b.json": ("{", r"b\.json is no JSON"),
    "c.json": ("[1]", r"c\.json: landmarks in JSON are an object of names"),
    "d.csv": ("lpa,1,2,3\nrpa,1,x,3\n", r"d\.csv, line 2: 'x' is not a number"),
    "e.csv": ("lpa,1,2,3\nlpa,1,2,3\n", r"e\.csv, line 2: a landmark of the name 'lpa' came before"),
    "f.csv": ("name,x,y,z\n", r"f\.csv holds no landmarks"),
    "g.txt": ("lpa 1 2 3", r"landmarks are read from \.json, \.csv, \.tsv and \.fcsv files, not from \.txt"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_refuses_landmark_files(tmp_path, name):
    text, words = BAD_FILES[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(ScanError, match=words):
        fitting.read_landmarks(tmp_path / name)


def test_refuses_a_missing_file(tmp_path):
    with pytest.raises(ScanError, match=r"landmarks cannot be read from .*none\.json"):
        fitting.read_landmarks(tmp_path / "none.json")


X = np.arange(9.0).reshape(3, 3)
BAD_LANDMARKS = {
    "no such vertex": ((X, np.array([0, 1, 900])), "there is no vertex 900 in a mesh of 200 vertices"),
    "lengths": ((X, np.array([0, 1])), "3 on the scan, 2 on the mesh, 3 weights"),
    "not finite": ((np.where(X == 4, np.nan, X), X), "`on_scan` is not finite in rows 1"),
    "shape": ((X, X[:, :2]), r"`on_mesh` must be positions \[l, 3\], or vertex indices \[l\]; got \[3, 2\]"),
    "weights": ((X, X, [-1, 1, 1]), "`weights` must be finite and not negative"),
}


@pytest.mark.parametrize("case", BAD_LANDMARKS)
def test_refuses_landmarks(case):
    landmarks, words = BAD_LANDMARKS[case]
    with pytest.raises(ScanError, match=words):
        fitting.align(bean(), Scan(scan_of(bean())), landmarks=landmarks)


# ------------------------------------------------------------------------------------------------------------ bad input

LINE = np.arange(50.0)[:, None] * (1, 2, 3)
BAD_SCANS = {
    "few": (X, "a scan of 3 points cannot be aligned; 10 are the least"),
    "spot": (np.full((50, 3), 7.0), r"all points of the scan lie on one spot, near \[7.0, 7.0, 7.0\]"),
    "line": (LINE, "all points of the scan lie on a line"),
}


@pytest.mark.parametrize("case", BAD_SCANS)
def test_refuses_scans(case):
    points, words = BAD_SCANS[case]
    with pytest.raises(ScanError, match=words):
        fitting.align(bean(), Scan(points))


def test_refuses_settings(as_users_run):
    scan = Scan(scan_of(bean()))
    with pytest.raises(ValueError, match="`kind` is one of rigid, similarity, affine; got 'projective'"):
        fitting.align(bean(), scan, kind="projective")
    with pytest.raises(ValueError, match="`keep` is a part of the scan, over 0 and up to 1; got 60"):
        fitting.align(bean(), scan, keep=60)


# ----------------------------------------------------------------------------------------------------------- real scans


def test_digitised_head_in_other_axes(shared_data):
    mesh = js.read_mesh(shared_data / "control" / "head_quad.obj")
    scan = fitting.read_scan(shared_data / "head_digitised_a.xyz")
    found = fitting.align(mesh, scan)
    to_scan = found.transform[:3, :3] / np.cbrt(np.linalg.det(found.transform[:3, :3]))
    # Right, front, up on the template; front, left, up on the scan. The head is held about 10 degrees otherwise.
    expected = np.array([(0, 1, 0), (-1, 0, 0), (0, 0, 1)])
    assert Rotation.from_matrix(to_scan @ expected.T).magnitude() < np.radians(20)
    assert found.share > 0.9
    # The same places on the template, as far as this tells, a few mm off; the template itself upside down.
    fiducials = fitting.read_landmarks(shared_data / "head_digitised_a.fiducials.json")
    assert list(fiducials) == ["lpa", "rpa", "nasion", "coils 1", "coils 2"]
    back = np.linalg.inv(found.transform)
    noise = np.random.default_rng(0).normal(scale=2, size=(5, 3))
    places = [FAR.apply(back[:3, :3] @ x + back[:3, 3] + e) for x, e in zip(fiducials.values(), noise, strict=True)]
    on_mesh = dict(zip(fiducials, places, strict=True))
    turned = js.ControlMesh(FAR.apply(np.array(mesh.vertices)), mesh.faces)
    marked = fitting.align(turned, scan, landmarks=fitting.match_landmarks(fiducials, on_mesh))
    assert np.linalg.norm(marked.mesh.vertices - found.mesh.vertices, axis=1).max() < 8
    assert marked.doubts == ()


@pytest.mark.parametrize("turned", [0, 180])
def test_femur(shared_data, turned):
    mesh = js.read_mesh(shared_data / "control" / "femur_tri.obj")
    points = np.load(shared_data / "femur_distal_points.npz")["points"]
    rotation = Rotation.from_rotvec(np.radians(turned) * np.array([0.6, 0.8, 0.0]))
    found = fitting.align(mesh, Scan(rotation.apply(points)))
    assert off(found, 1.0, rotation, np.zeros(3), mesh) < 1.0
    assert KDTree(rotation.apply(points)).query(found.mesh.vertices)[0].mean() < 1.0
