"""Layers: several surfaces in one fit, what keeps the thickness between them, and how that is measured."""

import argparse
import dataclasses
import functools
import json

import equinox as eqx
import numpy as np
import pytest
import trimesh

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit_command
from fitting.command.exports import write_exports
from fitting.image.volume import Volume
from fitting.run.layers import prepare_layers
from fitting.scan.layers import join_scans, part_scan, read_layers, stack_meshes, take_layer

INNER, GAP, NOISE, BULGE = 20.0, 4.0, 0.05, 4.0


def radius(way: np.ndarray, layer: str) -> np.ndarray:
    """Of two balls that bulge together at the top."""
    angle = np.arccos(np.clip(way[:, 2], -1, 1))
    return INNER + GAP * (layer == "outer") + BULGE * np.exp(-((angle / 0.6) ** 2))


@functools.cache
def scans() -> dict[str, fitting.Scan]:
    """Noisy points of both layers; of the outer one none at the top."""
    rng, found = np.random.default_rng(0), {}
    for layer in ("inner", "outer"):
        way = rng.normal(size=(1500, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        way = way[way[:, 2] < 0.5] if layer == "outer" else way
        found[layer] = fitting.Scan(way * (radius(way, layer) + rng.normal(scale=NOISE, size=len(way)))[:, None])
    return found


def meshes() -> dict[str, js.ControlMesh]:
    ball = trimesh.creation.icosphere(1)
    return {
        layer: js.ControlMesh((INNER + gap) * ball.vertices, {3: ball.faces})
        for layer, gap in (("inner", 0.5), ("outer", GAP + 1))
    }


def fitted(**options) -> fitting.LayersFit:
    usual = {"levels": 2, "pose": None, "throw": False}
    return fitting.fit_layers(scans(), meshes(), **(usual | options))


@functools.cache
def two_layers() -> fitting.LayersFit:
    return fitted()


def error_at_the_top(found: fitting.LayersFit) -> float:
    """RMS of how far the outer layer is off the truth in mm, where it has no points."""
    vertices = np.asarray(found.surface("outer").vertices, np.float64)
    length = np.linalg.norm(vertices, axis=1)
    top = vertices[:, 2] > 0.7 * length
    off = length - radius(vertices / length[:, None], "outer")
    return float(np.sqrt(np.mean(off[top] ** 2)))


# Fits


def test_thickness_is_kept_where_the_outer_layer_was_not_seen():
    found = two_layers()
    assert found.names == ("inner", "outer") and found.result.trusted
    alone = fitted(priors=fitting.Priors(thickness=np.inf))
    assert found.result.fit.model.prior("thickness") is not None
    assert alone.result.fit.model.prior("thickness") is None
    assert error_at_the_top(found) < 0.5 * error_at_the_top(alone)


def test_points_are_paired_with_their_own_layer():
    result = two_layers().result
    n, half = scans()["inner"].n_points, result.surface.n_faces // 2
    face = np.asarray(result.at.face)
    assert (face[:n] < half).all() and (face[n:] >= half).all()
    assert {one.region for one in result.report().regions} == {"inner", "outer"}


def test_layers_are_surfaces_of_their_own():
    found = two_layers()
    for name, mesh in meshes().items():
        own, surface = found.control_mesh(name), found.surface(name)
        np.testing.assert_array_equal(own.faces[3], mesh.faces[3])
        again = js.refine(found.result.scheme, js.build_topology(own, js.Interpolating(), 2), own.control())
        np.testing.assert_allclose(surface.vertices, again.vertices, atol=1e-9)
        np.testing.assert_array_equal(surface.faces[3], again.faces[3])
    with pytest.raises(ValueError, match="'middle' is no region of the control mesh; it has inner, outer"):
        found.surface("middle")


def test_a_given_strength_is_kept():
    found = fitted(priors=fitting.Priors(thickness=0.01), max_sweeps=6)
    np.testing.assert_allclose(found.result.fit.strengths.values["thickness"], 1e4, rtol=1e-6)


def test_layers_may_go_through_each_other_and_not_through_themselves():
    pytest.importorskip("ipctk")
    fit = two_layers().result.fit
    outer = np.arange(len(fit.y.control.vertices)) >= len(meshes()["inner"].vertices)

    def move_outer(rows: np.ndarray, by: tuple[float, float, float]) -> fitting.FitResult:
        moved = fit.y.control.vertices + rows[:, None] * np.array(by)
        return fitting.FitResult(dataclasses.replace(fit, y=eqx.tree_at(lambda y: y.control.vertices, fit.y, moved)))

    aside = move_outer(outer, (10, 0.3, 0.2))
    assert len(js.find_crossings(aside.surface).triangles) > 20
    assert aside.report().crossing_triangles == 0
    assert "surface_crosses_itself" not in [one.name for one in aside.warnings]
    top = outer & (np.asarray(fit.y.control.vertices)[:, 2] > 0.9 * np.asarray(fit.y.control.vertices)[outer, 2].max())
    through = move_outer(top, (0.7, 0.4, -80))
    own = fitting.LayersFit(through)
    expected = np.asarray(own.surface("outer").triangles())[js.find_crossings(own.surface("outer")).triangles]
    assert through.crossings is not None
    of_all = np.asarray(through.surface.triangles())[through.crossings.triangles]
    assert len(expected) and through.report().crossing_triangles == len(expected)
    np.testing.assert_allclose(
        np.asarray(through.surface.vertices)[of_all], np.asarray(own.surface("outer").vertices)[expected]
    )
    assert "surface_crosses_itself" in [one.name for one in through.warnings]


# Thickness and measures


def test_thickness_is_the_distance_across_the_other_layer():
    found, known = two_layers(), two_layers().thickness()
    assert (known.layer, known.other) == ("inner", "outer") and len(known.values) == len(found.result.surface.vertices)
    values, deviations = (found.take_values("inner", rows) for rows in (known.values, known.deviations))
    assert np.isnan(found.take_values("outer", known.values)).all()
    bottom = np.asarray(found.surface("inner").vertices)[:, 2] < 0
    np.testing.assert_allclose(values[bottom], GAP, atol=0.15)
    assert 0.3 < np.sqrt(np.mean((values[bottom] - GAP) ** 2) / np.mean(deviations[bottom] ** 2)) < 3
    back = found.thickness("outer")
    assert (back.layer, back.other) == ("outer", "inner")
    np.testing.assert_allclose(np.nanmedian(back.values), GAP, atol=0.1)
    np.testing.assert_allclose(known.shares.sum(), 1)
    assert np.nanmean(deviations[bottom]) < 0.7 * np.nanmean(deviations[~bottom])  # no points above


def test_deviations_of_thickness_are_those_of_the_covariance():
    found, known = two_layers(), two_layers().thickness()
    surface, posterior = found.result.surface, found.result.posterior
    vertices = np.asarray(surface.vertices)
    rows = np.flatnonzero(known.shares > 0)[::60]
    at = fitting.closest_points(surface, vertices[rows], js.FaceChoice(np.zeros(len(rows), np.int32), outer(found)))
    corners, weights = (np.asarray(part) for part in js.corner_weights(surface, at))
    normals = np.asarray(js.evaluate(surface, at).normals)
    gradients = np.zeros((len(rows), *vertices.shape))
    for i, row in enumerate(rows):
        gradients[i, row] -= normals[i]
        np.add.at(gradients[i], corners[i], weights[i][:, None] * normals[i])
    misfit = found.result.uncertainty().misfit ** 2
    of_both = misfit[rows] + np.sum(weights * misfit[corners], axis=1)
    expected = np.sqrt(np.diag(posterior.covariance_of(gradients)) + of_both)
    np.testing.assert_allclose(known.deviations[rows], expected, rtol=4 / np.sqrt(2 * 512))


def outer(found: fitting.LayersFit) -> np.ndarray:
    return found.result.find_faces("outer")[None]


def test_measures_are_of_each_layer_and_of_what_lies_between():
    found = two_layers()
    rows = {one.name: one for one in found.result.measures()}
    solids = []
    for name in found.names:
        vertices, triangles = found.surface(name).vertices, found.surface(name).triangles()
        solids.append(trimesh.Trimesh(np.asarray(vertices), np.asarray(triangles), process=False))
    inside, whole = (solid.volume / 1e3 for solid in solids)
    np.testing.assert_allclose(rows["volume inner"].value, inside, rtol=1e-9)
    np.testing.assert_allclose(rows["volume between inner and outer"].value, whole - inside, rtol=1e-9)
    np.testing.assert_allclose(rows["area outer"].value, solids[1].area / 1e2, rtol=1e-9)
    np.testing.assert_allclose(rows["thickness inner to outer"].value, found.thickness().mean, rtol=1e-9)
    assert all(one.deviation > 0 for one in rows.values())
    assert found.result.report(uncertainty=True).measures == list(rows.values())


def test_thickness_is_measured_between_any_two_regions():
    known = two_layers().result.thickness("outer", "inner")
    np.testing.assert_allclose(known.mean, GAP, atol=0.2)
    with pytest.raises(ValueError, match="'lid' is no region of the control mesh; it has inner, outer"):
        two_layers().result.thickness("outer", "lid")


def test_saved_layers_are_layers_again(tmp_path):
    two_layers().save(tmp_path)
    again = fitting.LayersFit(fitting.load(tmp_path))
    assert again.names == two_layers().names
    for found, expected in zip(again.result.measures(), two_layers().result.measures(), strict=True):
        assert found.name == expected.name
        np.testing.assert_allclose(found.deviation, expected.deviation, rtol=1e-6)


def test_a_picture_of_thickness_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    found = two_layers()
    figure = fitting.draw_thickness(found.result.surface, found.thickness())
    assert [ax.get_title() for ax in figure.axes[:3]] == ["thickness", "the same from behind", "standard deviation"]
    figure.savefig(tmp_path / "thickness.png")
    assert (tmp_path / "thickness.png").stat().st_size > 10_000


# What is put in


def test_meshes_are_stacked_triangles_first():
    square = js.ControlMesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2, 3)])
    triangle = js.ControlMesh([(0, 0, 1), (1, 0, 1), (1, 1, 1)], [(0, 1, 2)])
    both = stack_meshes({"low": square, "high": triangle})
    assert both.regions is not None and both.regions.words() == ["high", "low"]
    np.testing.assert_array_equal(both.faces[3], [[4, 5, 6]])
    own = take_layer(both, "high")
    np.testing.assert_array_equal(own.vertices, triangle.vertices)
    np.testing.assert_array_equal(own.faces[3], triangle.faces[3])


def test_one_template_without_groups_is_that_of_every_layer():
    mesh, how = meshes()["inner"], {"faces": 100, "kind": "triangle", "closed": None, "part": None}
    layered = prepare_layers(scans(), mesh, None, **how)
    np.testing.assert_array_equal(layered.mesh.vertices[:42], layered.mesh.vertices[42:])
    assert layered.names == ("inner", "outer") and layered.scan.n_points == sum(s.n_points for s in scans().values())
    assert not layered.is_made and layered.options(fitting.Priors())["layers"] == layered.names
    grouped = stack_meshes(meshes())
    assert prepare_layers(scans(), grouped, None, **how).mesh is grouped


def labelled() -> fitting.Scan:
    return fitting.Scan(np.arange(12.0).reshape(4, 3), regions=["a", "b", "c", "a"])


def test_labels_choose_the_points_of_each_layer():
    parts = part_scan(labelled(), {"one": ["a"], "two": ["b", "c"]})
    joined = join_scans(parts)
    assert joined.regions is not None and joined.regions.words() == ["one", "one", "two", "two"]
    np.testing.assert_array_equal(joined.points, np.asarray(labelled().points)[[0, 3, 1, 2]])
    assert list(part_scan(labelled(), None)) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ({"one": "a", "two": "x"}, "the layer 'two' has no points: the scan has no label 'x'. It has a, b, c"),
        ({"one": "a", "two": ["b", "a"]}, "the label 'a' is of the layers 'one' and 'two'"),
        ({"one": "a"}, "there are two layers or more; got one"),
    ],
)
def test_layers_that_cannot_be_told_apart_are_refused(layers, message):
    with pytest.raises(fitting.ScanError, match=message):
        fitting.fit_layers(labelled(), layers=layers)


def test_what_does_not_match_is_refused():
    with pytest.raises(fitting.ScanError, match="layers are told apart by labels, and the scan has none"):
        fitting.fit_layers(fitting.Scan(np.eye(3)))
    with pytest.raises(ValueError, match="the layer 'outer' is none of the control meshes, which are inner"):
        fitting.fit_layers(scans(), {"inner": meshes()["inner"]})
    with pytest.raises(fitting.ScanError, match="the layer 'two' has no `normals` and others have"):
        points = np.eye(3)
        join_scans({"one": fitting.Scan(points, points), "two": fitting.Scan(points)})
    with pytest.raises(fitting.ScanError, match="the layer 'one' has the frame RAS and the layer 'two' LPS"):
        join_scans({"one": fitting.Scan(points, frame="RAS"), "two": fitting.Scan(points, frame="LPS")})
    mesh = meshes()["inner"]
    topology = js.build_topology(mesh, js.Interpolating(), 1)
    with pytest.raises(ValueError, match="the layer 'inner' is no region of the control mesh; it has none"):
        fitting.fit(js.Interpolating(), topology, mesh.control(), scans()["inner"], layers=("inner", "outer"))


def test_layers_of_a_label_map_are_what_lies_inside():
    grid = np.linalg.norm(np.stack(np.meshgrid(*[np.arange(-12, 13)] * 3, indexing="ij")), axis=0)
    values = np.where(grid < 6, 2, np.where(grid < 9, 1, 0)).astype(np.uint8)
    affine = np.eye(4)
    affine[:3, 3] = -12
    parts = fitting.scans_of_volume(Volume((values,), affine, "RAS"), {"bone": "2", "cartilage": ["2", "1"]})
    lengths = [float(np.median(np.linalg.norm(np.asarray(one.points), axis=1))) for one in parts.values()]
    np.testing.assert_allclose(lengths, [6, 9], atol=0.6)
    with pytest.raises(fitting.ScanError, match="no voxel has the label '7'"):
        fitting.scans_of_volume(Volume((values,), affine, "RAS"), {"bone": "7"})


# The command


def test_command_fits_layers(tmp_path, capsys):
    rows = ["x,y,z,label"]
    for name, scan in scans().items():
        rows += [f"{','.join(f'{x:.3f}' for x in point)},{name.upper()}" for point in np.asarray(scan.points).tolist()]
    (tmp_path / "wall.csv").write_text("\n".join(rows))
    js.write_mesh(tmp_path / "ball.obj", meshes()["inner"])
    (tmp_path / "layers.json").write_text(json.dumps({"inner": "INNER", "outer": ["OUTER"]}))
    arguments = [str(tmp_path / "wall.csv"), "--layers", str(tmp_path / "layers.json"), "--control"]
    arguments += [str(tmp_path / "ball.obj"), "--align", "none", "--levels", "2", "--max-sweeps", "2"]
    status = fit_command([*arguments, "-o", str(tmp_path / "out")])
    assert status in (0, 1), capsys.readouterr().err
    found = sorted(path.name for path in (tmp_path / "out" / "layers").iterdir())
    assert found == sorted(
        [f"{name}{end}" for name in ("inner", "outer") for end in (".ply", "_control.obj")] + ["inner_thickness.png"]
    )
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "thickness inner to outer" in [one["name"] for one in report["measures"]]
    again = fitting.LayersFit(fitting.load(tmp_path / "out"))
    inner = js.read_mesh(tmp_path / "out" / "layers" / "inner.ply")
    np.testing.assert_allclose(inner.vertices, again.surface("inner").vertices, atol=1e-4)
    (tmp_path / "layers.json").write_text(json.dumps({"inner": "INNER"}))
    assert fit_command([*arguments, "-o", str(tmp_path / "other")]) == 2
    assert "two or more" in capsys.readouterr().err
    for wrong, words in ((("LV/endo", "epi"), "'LV/endo' cannot name a file"), (("Epi", "epi"), "are one on some")):
        (tmp_path / "layers.json").write_text(json.dumps(dict(zip(wrong, ("INNER", "OUTER"), strict=True))))
        assert fit_command([*arguments, "-o", str(tmp_path / "other")]) == 2
        assert words in capsys.readouterr().err


def test_tetrahedra_of_layers_are_a_region_each(tmp_path, monkeypatch):
    result, given = two_layers().result, []

    def fill(surfaces, edge):
        given.append(surfaces)
        raise ValueError("enough")

    monkeypatch.setattr(js, "fill_with_tetrahedra", fill)
    for levels in (1, 2):
        options = argparse.Namespace(tetrahedra=3.0, patches=None)
        assert write_exports(tmp_path, result, result.refine_to(levels), options) == []
    assert [list(surfaces) for surfaces in given] == 2 * [["inner", "outer"]]
    assert len(given[0]["inner"].faces[3]) == 80 * 4
    for name in ("inner", "outer"):
        np.testing.assert_array_equal(given[1][name].vertices, two_layers().surface(name).vertices)
        np.testing.assert_array_equal(given[1][name].faces[3], two_layers().surface(name).faces[3])


def test_layers_files_are_read(tmp_path):
    path = tmp_path / "layers.json"
    path.write_text('{"endo": "LV", "epi": ["A", "B"]}')
    assert read_layers(path) == {"endo": ["LV"], "epi": ["A", "B"]}
    path.write_text('{"endo": null, "epi": "A"}')
    with pytest.raises(ValueError, match="layers are written"):
        read_layers(path)
