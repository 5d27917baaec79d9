"""Regions: labels of a scan and groups of a template, and fits that pair each point with its own group."""

import functools
import json

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
import trimesh
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit_command
from fitting.scan.regions import read_groups

GROUPS = ("inner", "outer")
HEART = ("LV_ENDOCARDIAL", "LV_EPICARDIAL", "MITRAL_VALVE_CUT", "RV_FREEWALL", "RV_SEPTUM")
APART = 2.0  # mm between the walls


def shell(finer: int = 1, gap: float = APART) -> js.ControlMesh:
    """Two spheres, one within the other, which is turned inside out: the wall of a bubble."""
    ball = trimesh.creation.icosphere(finer)
    vertices, own = np.asarray(ball.vertices), np.asarray(ball.faces)
    both = np.concatenate([20.0 * vertices, (20.0 + gap) * vertices])
    return js.ControlMesh(both, [*own[:, ::-1], *(own + len(vertices))], regions=np.repeat(GROUPS, len(own)).tolist())


@functools.cache
def shell_points(n: int = 1500) -> tuple[np.ndarray, tuple[str, ...]]:
    """Noisy points of both walls, larger than the mesh by as much as the walls are apart: the inner one lies where the
    mesh has its outer one."""
    rng = np.random.default_rng(0)
    way = rng.normal(size=(n, 3))
    radius = np.repeat([20.0 + APART, 20.0 + 2 * APART], n // 2) + rng.normal(scale=0.05, size=n)
    return way / np.linalg.norm(way, axis=1, keepdims=True) * radius[:, None], tuple(np.repeat(GROUPS, n // 2).tolist())


def fitted(regions: bool = True, **options) -> fitting.FitResult:
    points, words = shell_points()
    scan = fitting.Scan(points, regions=list(words) if regions else None)
    mesh = shell()
    topology = js.build_topology(mesh, js.Interpolating(), 2)
    match = fitting.match_regions(scan, mesh)
    return fitting.fit(
        js.Interpolating(), topology, mesh.control(), scan, regions=match, throw=False, **({"max_sweeps": 12} | options)
    )


@functools.cache
def shell_fit() -> fitting.FitResult:
    return fitted()


def radii(result: fitting.FitResult) -> list[float]:
    """Mean radius of the inner and of the outer sphere."""
    lengths = np.linalg.norm(np.asarray(result.surface.vertices), axis=1)
    inner = np.unique(result.surface.faces[3][: len(result.surface.faces[3]) // 2])
    mask = np.isin(np.arange(len(lengths)), inner)
    return [float(lengths[mask].mean()), float(lengths[~mask].mean())]


# Fits


def test_walls_come_to_their_own_points():
    result = shell_fit()
    np.testing.assert_allclose(radii(result), (20 + APART, 20 + 2 * APART), atol=0.15)
    assert result.rms[-1] < 0.2
    assert_own_faces(result)


@pytest.mark.filterwarnings("ignore:half of the scan")  # twelve vertices are no sphere
def test_the_device_pairs_within_regions_too():
    points, words = (rows[::5] for rows in shell_points())
    scan, mesh = fitting.Scan(points, regions=list(words)), shell(0)
    topology, match = js.build_topology(mesh, js.Interpolating(), 1), fitting.match_regions(scan, mesh)
    how = {"regions": match, "throw": False, "max_sweeps": 2}
    for solver in ("conjugate gradients", "sparse"):
        result = fitting.fit(js.Interpolating(), topology, mesh.control(), scan, linear_solver=solver, **how)
        assert_own_faces(result)


def assert_own_faces(result: fitting.FitResult) -> None:
    face, half, n_inner = np.asarray(result.fit.look.at.face), result.scan.n_points // 2, result.surface.n_faces // 2
    assert (face[:half] < n_inner).all() and (face[half:] >= n_inner).all()


def test_without_regions_a_wall_takes_the_points_of_the_other():
    result, half = fitted(regions=False, max_sweeps=0), len(shell_points()[0]) // 2
    assert (np.asarray(result.at.face)[:half] >= result.surface.n_faces // 2).all()
    assert result.fit.scene.choice is None and result.report().regions == []


def test_points_without_a_group_are_paired_with_any_face():
    points, words = shell_points()
    other = [word if i % 5 else ("valve" if i % 2 else "") for i, word in enumerate(words)]
    scan, mesh = fitting.Scan(points, regions=other), shell()
    result = fitting.fit_scan(scan, mesh, levels=1, pose=None, throw=False, max_sweeps=8).result
    rows = {one.region: one for one in result.report().regions}
    assert list(rows) == ["inner", "outer", "any region"]
    assert rows["any region"].n_points == 300 and sum(one.n_points for one in rows.values()) == len(points)
    np.testing.assert_allclose(radii(result), (20 + APART, 20 + 2 * APART), atol=0.4)


def test_regions_go_along_where_the_mesh_is_split():
    points, words = shell_points()
    bumps = 1 + 0.02 * np.sin(points[:, :1] / 3)
    scan = fitting.Scan(points * bumps, regions=list(words))
    found = fitting.fit_scan(
        scan, shell(), levels=1, pose=None, tolerance_mm=0.01, most_faces=700, throw=False, max_sweeps=8
    )
    assert found.splits == 1
    regions = found.result.control_mesh.regions
    assert regions is not None and regions.counts().tolist() == [320, 320]
    assert regions.names == GROUPS and (regions.rows[:320] == 0).all()
    assert {one.region for one in found.result.report().regions} == set(GROUPS)
    np.testing.assert_allclose(radii(found.result), (20 + APART, 20 + 2 * APART), atol=0.4)


def test_another_scan_is_measured_within_its_regions():
    result, (points, words) = shell_fit(), shell_points()
    swapped = fitting.Scan(points[::3], regions=["outer" if word == "inner" else "inner" for word in words[::3]])
    again = result.compare_with(swapped)
    np.testing.assert_allclose(np.abs(again.distances), APART, atol=0.4)
    assert [round(one.rms) for one in again.report().regions] == [2, 2]


def test_report_has_the_regions():
    report = shell_fit().report()
    assert [(one.region, one.n_points) for one in report.regions] == [("inner", 750), ("outer", 750)]
    assert "RMS in inner" in str(report) and json.loads(report.as_json())["regions"][1]["region"] == "outer"


def test_saved_fits_keep_regions(tmp_path):
    result = shell_fit()
    result.save(tmp_path)
    again = fitting.load(tmp_path)
    assert again.fit.regions.groups == result.fit.regions.groups
    assert again.scan.regions.words() == result.scan.regions.words()
    assert again.control_mesh.regions.words() == result.control_mesh.regions.words()
    for found, expected in zip(again.fit.scene.choice, result.fit.scene.choice, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert again.report().regions == result.report().regions
    np.testing.assert_allclose(again.compare_with(again.scan).distances, result.distances, atol=1e-9)
    arrays = dict(np.load(tmp_path / "fit.npz"))
    np.savez(tmp_path / "fit.npz", **(arrays | {"face_regions": arrays["face_regions"][1:]}))
    with pytest.raises(ValueError, match="'face_regions' has 159 rows for 160 control faces"):
        fitting.load(tmp_path)
    np.savez(tmp_path / "fit.npz", **{name: rows for name, rows in arrays.items() if "region" not in name})
    assert fitting.load(tmp_path).fit.regions is None  # as those saved before there were regions


def test_labels_that_are_given_a_group():
    points, words = shell_points()
    scan = fitting.Scan(points, regions=["a" if word == "inner" else "b" for word in words])
    how = {"levels": 1, "pose": None, "throw": False, "max_sweeps": 1}
    result = fitting.fit_scan(scan, shell(), regions={"A": "INNER", "b": ["outer"]}, **how).result
    assert [one.region for one in result.report().regions] == ["inner", "outer"]
    with pytest.raises(
        ValueError, match=r"put 'b' on 'epi', which is no group of the control mesh\. It has inner, outer"
    ):
        fitting.fit_scan(scan, shell(), regions={"b": "epi"}, **how)
    with pytest.raises(fitting.ScanError, match="are given for c, but the scan has no labels"):
        fitting.fit_scan(fitting.Scan(points), shell(), regions={"c": "inner"}, **how)
    bare = js.ControlMesh(shell().vertices, shell().faces)
    with pytest.raises(ValueError, match="groups of the control mesh, and it has none"):
        fitting.fit_scan(scan, bare, regions={"a": "inner"}, **how)
    with pytest.raises(ValueError, match="groups of a template's faces, and there is none"):
        fitting.fit_scan(scan, regions={"a": "inner"})


def test_regions_of_another_mesh_are_refused():
    p = problem()
    scan, mesh = fitting.Scan(p.points + noise(), regions=["inner"] * len(p.points)), shell()
    with pytest.raises(ValueError, match="are of 160 control faces, and the topology has"):
        p.fit(scan=scan, regions=fitting.match_regions(scan, mesh))


# Names


@pytest.mark.parametrize(
    ("label", "groups"),
    [
        ("lv_endocardial", ("LV_ENDOCARDIAL",)),
        ("SAX_LV_ENDOCARDIAL", ("LV_ENDOCARDIAL",)),
        ("MITRAL VALVE", ("MITRAL_VALVE_CUT",)),
        ("RV", ("RV_FREEWALL", "RV_SEPTUM")),
        ("LAX_RV_ENDOCARDIAL", ()),
        ("V", ()),
        ("-", ()),
    ],
)
def test_groups_by_the_words_of_names(label, groups):
    vertices, faces = meshes.grid(5, 1, "quad")
    mesh = js.ControlMesh(vertices, faces, regions=HEART[: len(faces)])
    match = fitting.match_regions(fitting.Scan(np.eye(3), regions=[label, "", label]), mesh)
    assert dict(match.groups) == ({label: groups} if groups else {})
    assert match.kinds_of(fitting.Scan(np.eye(3), regions=[label, "", label])).tolist() == (
        [0, -1, 0] if groups else [-1] * 3
    )


def test_what_are_no_regions_is_told():
    with pytest.raises(fitting.ScanError, match="there are 2 `regions` for 3 points"):
        fitting.Scan(np.eye(3), regions=["a", "b"])
    with pytest.raises(fitting.ScanError, match="`regions`: regions are a name each"):
        fitting.Scan(np.eye(3), regions=[1, 2, 3])
    with pytest.raises(js.MeshError, match="there are 1 `regions` for 160 faces"):
        js.ControlMesh(shell().vertices, shell().faces, regions=["a"])
    with pytest.raises(ValueError, match="row 1 has the region 2 of 2 names"):
        js.Regions(np.array([0, 2]), ("a", "b"))
    with pytest.raises(ValueError, match="the name 'a' of a region is empty or given twice"):
        js.Regions(np.array([0, 1]), ("a", "a"))
    with pytest.raises(ValueError, match="one whole number a row"):
        js.Regions(np.array([0.5]), ("a",))


def test_labels_of_a_table_are_the_regions(tmp_path):
    path = tmp_path / "heart.csv"
    path.write_text("x,y,z,contour\n0,0,0,LV\n1,0,0,RV\n0,nan,0,RV\n0,1,0,LV\n")
    with pytest.warns(UserWarning, match="not finite"):
        scan = fitting.read_scan(path)
    assert scan.regions.words() == ["LV", "RV", "LV"]
    assert scan.rows(np.array([2, 1])).regions.words() == ["LV", "RV"]
    with pytest.warns(UserWarning, match="not finite"):
        assert fitting.read_scan(path, labels="l").regions.words() == ["LV", "LV"]


def test_groups_in_a_file(tmp_path):
    path = tmp_path / "groups.json"
    path.write_text('{"a": "inner", "b": ["inner", "outer"], "c": null}')
    assert read_groups(path) == {"a": "inner", "b": ["inner", "outer"], "c": None}
    for text in ('{"a": 1}', '{"a": [1]}', "[]", "{"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"groups\.json: "):
            read_groups(path)


# Search


@pytest.mark.parametrize("kind", ["triangle", "quad", "mixed"])
def test_search_is_that_of_the_chosen_faces_alone(kind):
    vertices, faces = meshes.grid(6, 5, kind, bumpy=0.4)
    control = js.ControlMesh(vertices, sorted(faces, key=len))
    surface = js.refine(js.Interpolating(), js.build_topology(control, js.Interpolating(), 2), control.control())
    rng = np.random.default_rng(0)
    points = rng.uniform(vertices.min(axis=0) - 1, vertices.max(axis=0) + 1, (200, 3))
    chosen = rng.integers(3, size=surface.n_faces)[None] == np.arange(3)[:, None]
    rows = rng.integers(-1, 3, size=len(points)).astype(np.int32)
    choice = js.FaceChoice(rows, chosen)
    found = fitting.closest_points(surface, points, choice)
    on_device = jax.jit(js.search_closest)(surface, jnp.asarray(points), choice)
    own = [np.linalg.norm(np.asarray(js.evaluate(surface, at).points) - points, axis=1) for at in (found, on_device)]
    for row in (-1, 0, 1, 2):
        mask = np.ones(surface.n_faces, bool) if row < 0 else chosen[row]
        part = {3: surface.faces[3][mask[: len(surface.faces[3])]], 4: surface.faces[4][mask[len(surface.faces[3]) :]]}
        alone = js.RefinedSurface(surface.vertices, surface.normals, part)
        expected = js.evaluate(alone, fitting.closest_points(alone, points[rows == row])).points
        away = np.linalg.norm(np.asarray(expected) - points[rows == row], axis=1)
        for distances, at in zip(own, (found, on_device), strict=True):
            assert mask[np.asarray(at.face)[rows == row]].all()
            # Of two bent quads, equally near as triangles, either may be taken.
            np.testing.assert_allclose(
                distances[rows == row], away, rtol=1e-9, atol=1e-9 if kind == "triangle" else 0.02
            )


def test_choices_of_no_face_or_of_another_surface_are_refused():
    mesh = shell()
    surface = js.refine(js.Interpolating(), js.build_topology(mesh, js.Interpolating(), 1), mesh.control())
    points, none = np.zeros((2, 3)), np.zeros((1, surface.n_faces), bool)
    with pytest.raises(ValueError, match="no face that point 1 may lie on"):
        fitting.closest_points(surface, points, js.FaceChoice(np.array([-1, 0]), none))
    with pytest.raises(ValueError, match="the choice is among 9 faces; the surface has"):
        fitting.closest_points(surface, points, js.FaceChoice(np.array([0, 0]), none[:, :9]))


# Files


@pytest.mark.parametrize("normals", [False, True])
def test_groups_of_an_obj_file_come_back(tmp_path, normals):
    vertices, faces = meshes.mixed_closed()
    faces = sorted(faces, key=len)
    words = ["" if i % 3 == 0 else f"part {i % 3}" for i in range(len(faces))]
    mesh = js.ControlMesh(vertices, faces, vertices if normals else None, regions=words)
    js.write_mesh(tmp_path / "a.obj", mesh)
    again = js.read_mesh(tmp_path / "a.obj")
    assert again.regions.words() == words and again.regions.names == ("part 1", "part 2")
    np.testing.assert_array_equal(again.faces[4], mesh.faces[4])
    js.write_mesh(tmp_path / "b.obj", again)
    assert (tmp_path / "a.obj").read_bytes() == (tmp_path / "b.obj").read_bytes()


def test_groups_follow_triangles_first(tmp_path):
    path = tmp_path / "a.obj"
    lines = [f"v {x} {y} 0" for y in range(2) for x in range(4)]
    path.write_text(
        "\n".join([*lines, "g left", "f 1 2 6 5", "g right # of all", "f 2 3 7", "g", "f 2 7 6", "g left", "f 3 4 8 7"])
    )
    mesh = js.read_mesh(path)
    assert mesh.regions.words() == ["right", "", "left", "left"]
    assert mesh.triangulate().regions.words() == ["right", "", "left", "left", "left", "left"]
    path.write_text("\n".join([*lines, "g", "f 1 2 6 5"]))
    assert js.read_mesh(path).regions is None


def test_a_repair_keeps_the_groups_of_faces():
    vertices, faces = meshes.grid(3, 2, "quad")
    words = [f"g{i % 2}" for i in range(len(faces))]
    mesh = js.ControlMesh(vertices, [(0, 0, 1, 1), *faces], regions=["lost", *words], check=False)
    assert mesh.repair().regions.words() == words


def test_names_that_obj_does_not_hold_are_refused(tmp_path):
    mesh = js.ControlMesh(np.eye(3), [(0, 1, 2)], regions=["a # b"])
    with pytest.raises(js.MeshError, match="OBJ holds no group of the name 'a # b'"):
        js.write_mesh(tmp_path / "a.obj", mesh)


def test_the_command_tells_which_label_is_of_which_group(tmp_path, command_settings, capsys):
    points, words = shell_points()
    rows = [f"{x},{y},{z},SAX_{word}" for (x, y, z), word in zip(points.tolist(), words, strict=True)]
    (tmp_path / "scan.csv").write_text("\n".join(["x,y,z,label", *rows]) + "\n")
    js.write_mesh(tmp_path / "template.obj", shell())
    (tmp_path / "groups.json").write_text(json.dumps({"SAX_inner": "nowhere"}))
    inputs = [str(tmp_path / "scan.csv"), "--control", str(tmp_path / "template.obj"), "--levels", "2"]

    assert fit_command([*inputs, "-o", str(tmp_path / "out"), "--max-sweeps", "1"]) == 1  # it has not come to rest
    printed = capsys.readouterr().out
    assert "region   SAX_inner: 750 points, on inner" in printed
    assert "RMS in outer" in printed

    assert fit_command([*inputs, "-o", str(tmp_path / "bad"), "--regions", str(tmp_path / "groups.json")]) == 2
    assert "put 'SAX_inner' on 'nowhere', which is no group of the control mesh" in capsys.readouterr().err
