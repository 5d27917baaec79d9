"""Fits as folders and settings as recipes: what comes back is what was saved, or an error says why not."""

import dataclasses
import functools
import json
import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from posteriors import precision_matrix
from scans import N_POINTS, noise, problem

import fitting
import jaxsubdiv as js
from fitting import Free, Priors, Recipe, load_recipe
from fitting.report.saved import save_fit

SCHEMES = (
    js.Interpolating([1.2, 0.9], twist="printed", weights="angle", old_normals="recompute", boundary="chord"),
    js.CirclePreserving(1.1),
    js.BezierTriangle(),
    js.CatmullClark(),
    js.DooSabin(),
    js.Kobbelt(),
    js.Loop("warren"),
    js.ModifiedButterfly(),
)
LOSSES = (fitting.Huber(2.0), fitting.Tukey(), fitting.LeastSquares(), fitting.cauchy(), fitting.Barron(-jnp.inf, 2.5))


@functools.cache
def noisy() -> fitting.FitResult:
    """Of a scan with all that a scan can have."""
    p, rng = problem(), np.random.default_rng(3)
    normals = js.evaluate(js.refine(js.Interpolating(p.h), p.topology, p.truth), p.fit(max_sweeps=0).at).normals
    extra = {"normals": normals, "weights": rng.uniform(0.5, 1, N_POINTS), "deviations": rng.uniform(1, 2, N_POINTS)}
    scan = fitting.Scan(p.points + noise(), **extra)
    return fitting.fit(js.Interpolating(), p.topology, p.start, scan, throw=False)


@pytest.fixture
def saved(tmp_path):
    noisy().save(tmp_path / "new" / "fit")
    return tmp_path / "new" / "fit"


def same(found: object, expected: object) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.asarray(a).dtype == np.asarray(b).dtype


# Fits


def test_what_is_loaded_is_what_was_saved(saved):
    result, again = noisy(), fitting.load(saved)
    assert sorted(path.name for path in saved.iterdir()) == ["fit.npz", "recipe.json"]
    for name in ("control", "scheme", "scan", "at", "distances", "weights", "inliers", "rms", "robust_rms", "start"):
        same(getattr(again, name), getattr(result, name))
    for name in ("vertices", "normals"):
        np.testing.assert_allclose(getattr(again.surface, name), getattr(result.surface, name), atol=1e-12)
    assert again.noise == result.noise and again.result == result.result == optx.RESULTS.successful
    same(again.fit.look.pairs.corners, result.fit.look.pairs.corners)
    assert again.recipe.to_json() == result.recipe.to_json()


def test_report_and_uncertainty_of_a_loaded_fit_are_the_same(saved):
    result, again = noisy(), fitting.load(saved)
    for found, expected in zip(again.uncertainty(), result.uncertainty(), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    found, expected = again.report(uncertainty=True).as_dict(), result.report(uncertainty=True).as_dict()
    assert found.keys() == expected.keys() and found["worst"] == expected["worst"]
    assert found["warnings"] == expected["warnings"] and found["pose"] == expected["pose"]
    assert found["frame"] == expected["frame"] and found["crossings_at"] == expected["crossings_at"]
    for one, other in zip(found["measures"], expected["measures"], strict=True):
        assert one["name"] == other["name"] and one["unit"] == other["unit"]
        np.testing.assert_allclose([one["value"], one["deviation"]], [other["value"], other["deviation"]], rtol=1e-8)
    for name in set(found) - {
        "worst",
        "reason",
        "h",
        "rms_per_sweep",
        "warnings",
        "pose",
        "frame",
        "crossings_at",
        "measures",
    }:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, err_msg=name)


def test_posterior_of_a_loaded_fit_is_the_same(saved):
    """What the refit and the draws are made of."""
    found, expected = map(precision_matrix, (fitting.load(saved), noisy()))
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_fit_of_part_of_the_vertices_and_one_that_did_not_converge_come_back(tmp_path):
    p = problem()
    free = Free(vertices=np.arange(12) > 3)
    result = p.fit(free=free, max_sweeps=1, priors=Priors(bend=0.5, stretch=jnp.inf), loss=fitting.Tukey())
    result.save(tmp_path)
    again = fitting.load(tmp_path)
    assert again.result == optx.RESULTS.nonlinear_max_steps_reached and len(again.rms) == 2
    np.testing.assert_array_equal(again.recipe.free.vertices, free.vertices)
    assert again.report().n_unknowns == result.report().n_unknowns == 8 * 3 + 12 * 2 + 1
    assert float(again.recipe.priors.stretch) == np.inf and isinstance(again.recipe.loss, fitting.Tukey)


def test_saving_twice_leaves_the_last_and_nothing_else(saved):
    problem().fit(max_sweeps=0).save(saved)
    assert len(fitting.load(saved).rms) == 1
    assert sorted(path.name for path in saved.iterdir()) == ["fit.npz", "recipe.json"]


def test_saving_that_fails_leaves_the_fit_that_was_there(saved, monkeypatch):
    def full(*_, **__):
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="no space left"):
        problem().fit(max_sweeps=0).save(saved)
    assert len(fitting.load(saved).rms) == len(noisy().rms)
    assert sorted(path.name for path in saved.iterdir()) == ["fit.npz", "recipe.json"]


def changed(folder, **arrays) -> None:
    """Rewrite a saved fit; None leaves an array out."""
    with np.load(folder / "fit.npz") as file:
        values = dict(file) | arrays
    np.savez(folder / "fit.npz", **{name: value for name, value in values.items() if value is not None})


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"version": np.array(5)}, "version 5, but this release reads version 4. Update it"),
        ({"version": np.array(1)}, "version 1, but this release reads version 4. Fit the scan again, by its recipe"),
        ({"distances": None}, "'distances' is missing"),
        ({"shared_h": None}, "'shared_h' is missing"),
        ({"uv": np.zeros((5, 2))}, "'uv' has 5 rows for 600 scan points"),
        ({"face": np.full(N_POINTS, 1000)}, "'face' has rows of faces that there are not; the surface has 56"),
        ({"scan_points": np.full((N_POINTS, 3), np.nan)}, "`points` are not finite"),
        ({"quads": np.array([[0, 1, 2, 99]])}, "quad 0 use vertex indices >= 12"),
        ({"recipe": np.array("{}")}, "no recipe"),
        ({"settings": np.array("{}")}, "no recipe"),
    ],
)
def test_folder_that_is_broken_is_refused_by_name(saved, arrays, words):
    changed(saved, **arrays)
    with pytest.raises(ValueError, match=words) as error:
        fitting.load(saved)
    assert str(saved / "fit.npz") in str(error.value)


def test_folder_without_a_fit_and_file_that_is_cut_short_are_refused(saved, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"elsewhere has no fit\.npz"):
        fitting.load(tmp_path / "elsewhere")
    file = saved / "fit.npz"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"fit\.npz: "):
        fitting.load(saved)
    file.write_text("not a fit")
    with pytest.raises(ValueError, match=r"fit\.npz: "):
        fitting.load(saved)


def test_creases_and_schemes_of_your_own_cannot_be_saved(tmp_path):
    class Mine(fitting.AbstractLoss):
        def weight(self, r):
            return jnp.ones_like(r)

    with pytest.raises(ValueError, match=r"a loss of your own, Mine, has no place in a recipe"):
        Recipe(js.Interpolating(), 1, loss=Mine()).to_json()
    p, scheme = problem(), js.CatmullClark()
    edge = p.mesh.half_edges.edges[:1]
    topology = js.build_topology(p.mesh, scheme, 1, creases=js.Creases(edge))
    found = p.fit(max_sweeps=0).fit
    model = eqx.tree_at(lambda one: one.topology, found.model, topology)
    found = dataclasses.replace(found, model=model, settings=Recipe(scheme, 1))
    with pytest.raises(ValueError, match="fits with creases cannot be saved"):
        save_fit(tmp_path / "out", found, found.settings)
    assert not (tmp_path / "out").exists()


# Fits of version 3. Beside each stand the surface, its uncertainty and the report that the release which wrote it gave:
# of a whole scan; and of one in slices, with landmarks, where the shape of a part of the control mesh was expected.

OLD = Path(__file__).parent / "saved_v3"


@pytest.mark.parametrize("name", ["whole", "slices"])
def test_fit_of_version_3_comes_back(name):
    found, expected = fitting.load(OLD / name), np.load(OLD / name / "expected.npz")
    with np.load(OLD / name / "fit.npz") as file:
        assert int(file["version"]) == 3
        for part in ("distances", "weights", "rms", "robust_rms"):
            np.testing.assert_array_equal(getattr(found, part), file[part])
        if name == "slices":
            np.testing.assert_array_equal(found.slices, file["slices"])
            np.testing.assert_allclose(found.shifts, file["shifts"], atol=1e-12)
    np.testing.assert_allclose(found.surface.vertices, expected["vertices"], atol=1e-12)
    np.testing.assert_allclose(found.uncertainty().surface, expected["spread"], rtol=1e-6)
    np.testing.assert_allclose(found.uncertainty().control, expected["control_spread"], rtol=1e-6)
    # Measured anew the scan lies as far off as it did.
    np.testing.assert_allclose(found.compare_with(found.scan).distances, found.distances, atol=1e-9)


@pytest.mark.parametrize("name", ["whole", "slices"])
def test_fit_of_version_3_has_the_report_that_it_had(name, tmp_path):
    found, expected = fitting.load(OLD / name), json.loads((OLD / name / "report.json").read_text())
    assert_same_report(old_report(found), expected)
    found.save(tmp_path)
    assert_same_report(old_report(fitting.load(tmp_path)), expected)


def old_report(found: fitting.FitResult) -> dict:
    """What reports had at that time."""
    newer = ("trusted", "warnings", "pose", "frame", "regions", "crossing_triangles", "crossings_at", "measures")
    return {name: value for name, value in found.report(uncertainty=True).as_dict().items() if name not in newer}


def assert_same_report(found: dict, expected: dict) -> None:
    assert found.keys() == expected.keys()
    for key in found:
        if isinstance(expected[key], str):
            assert found[key] == expected[key]
        elif key in ("worst", "shifts"):
            assert len(found[key]) == len(expected[key])
            for one, other in zip(found[key], expected[key], strict=True):
                assert_same_report(one, other)
        else:
            np.testing.assert_allclose(
                np.asarray(found[key], float), np.asarray(expected[key], float), rtol=1e-6, atol=1e-9, err_msg=key
            )


# Recipes


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: type(scheme).__name__)
def test_recipe_of_every_scheme_comes_back_from_json(scheme):
    again = Recipe.from_json(Recipe(scheme, 3).to_json())
    assert again.scheme == scheme and type(again.scheme) is type(scheme) and again.levels == 3
    same(again.scheme, scheme)


def test_recipes_know_every_scheme_of_the_package():
    public = {kind for kind in vars(js).values() if isinstance(kind, type) and issubclass(kind, js.AbstractScheme)}
    assert public - {js.AbstractScheme} == {type(scheme) for scheme in SCHEMES}


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_recipe_of_every_loss_and_option_comes_back_from_json(loss):
    mask = np.arange(7) % 2 == 0
    recipe = Recipe(
        js.Interpolating(np.pi / 3),
        2,
        Free(vertices=mask, normals=False),
        Priors(bend=0.1, stretch=1 / 3, h=jnp.inf),
        loss,
        max_sweeps=7,
        tolerance=0.03,
        landmark_deviation=0.2,
        faces=80,
        kind="quad",
        closed=False,
        part="nearest",
        pose=None,
        mirror=True,
        tolerance_mm=0.4,
        most_faces=900,
        most_points=3_000,
        mesh_normals=True,
    )
    text = recipe.to_json()
    again = Recipe.from_json(text)
    assert again.to_json() == text
    for field in dataclasses.fields(Recipe):
        if field.name not in ("scheme", "free", "priors", "loss"):
            assert getattr(again, field.name) == getattr(recipe, field.name) != field.default or field.name == "limit"
    for name in ("scheme", "free", "priors", "loss"):
        same(getattr(again, name), getattr(recipe, name))
    assert json.loads(text)["priors"]["h"] == "inf"


def test_recipe_replays_the_fit_bit_for_bit(saved):
    recipe = load_recipe(saved / "recipe.json")
    p = problem()
    mesh = js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals)
    again = recipe.fit(mesh, noisy().scan, throw=False)
    same(again.control, noisy().control)
    np.testing.assert_array_equal(again.rms, noisy().rms)
    assert len(recipe.fit(mesh, noisy().scan, throw=False, max_sweeps=1).rms) == 2


@pytest.mark.filterwarnings("ignore:alignment")  # two poses of so plain a shape fit alike
def test_recipe_of_a_fit_of_a_scan_does_all_of_it_again():
    """Alignment and all: another scan is fitted as the one whose recipe it is."""
    p = problem()
    mesh = js.ControlMesh(p.start.vertices, p.mesh.faces, p.start.normals)
    settings = {"pose": "rigid", "tolerance_mm": 0.01, "most_faces": 50, "faces": 90, "kind": "quad", "closed": True}
    settings |= {"levels": 1, "max_sweeps": 3, "landmark_deviation": 0.5}
    how = {"landmarks": fitting.Landmarks(np.asarray(p.truth.vertices)[:4] + (0, 0, 2.0), np.arange(4)), "throw": False}
    scans = [fitting.Scan(p.points + noise(seed)) for seed in range(2)]
    first = fitting.fit_scan(scans[0], mesh, scheme=js.Interpolating(1.1), **settings, **how)
    recipe = Recipe.from_json(first.result.recipe.to_json())
    assert {name: getattr(recipe, name) for name in settings} == settings and recipe.scheme.h == 1.1
    again = recipe.fit_scan(scans[1], mesh, **how)
    by_hand = fitting.fit_scan(scans[1], mesh, scheme=js.Interpolating(1.1), **settings, **how)
    assert again.outcome == by_hand.outcome is not None
    same(again.result.control, by_hand.result.control)
    assert len(recipe.fit_scan(scans[1], mesh, max_sweeps=1, **how).result.rms) == 2  # options come before its own


def test_recipes_of_version_1_have_the_defaults_of_what_they_did_not_know():
    values = json.loads(Recipe(js.Interpolating(), 2).to_json()) | {"version": 1}
    for name in ("landmark_deviation", "faces", "kind", "closed", "pose", "tolerance_mm", "most_faces"):
        values.pop(name)
    assert Recipe.from_json(json.dumps(values)).to_json() == Recipe(js.Interpolating(), 2).to_json()


def test_recipe_that_says_little_has_the_defaults_of_fit():
    short = Recipe.from_json('{"scheme": {"name": "Loop"}, "levels": 2}')
    assert short.to_json() == Recipe(js.Loop(), 2).to_json()
    assert short.max_sweeps == 60 and short.tolerance == 0.1 and short.priors.bend is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "no JSON text"),
        ("[]", "no `scheme` and `levels`"),
        ('{"scheme": {"name": "Loop"}}', "no `scheme` and `levels`"),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "version": 9}', "recipe of version 9"),
        ('{"scheme": {"name": "Loup"}, "levels": 2}', r"`scheme` must have a `name`, one of .*Loop.*; got 'Loup'"),
        ('{"scheme": "Loop", "levels": 2}', "got 'Loop'"),
        ('{"scheme": {"name": "Loop", "h": 1}, "levels": 2}', "`scheme` has no 'h'; it has boundary, variant"),
        ('{"scheme": {"name": "Loop", "variant": "x"}, "levels": 2}', "`scheme` is not as it should be: `variant`"),
        ('{"scheme": {"name": "Loop"}, "levels": 2.5}', "`levels` must be a whole number; got 2.5"),
        ('{"scheme": {"name": "Loop"}, "levels": true}', "`levels` must be a whole number; got True"),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "tolerance": "small"}', "`tolerance` must be a number"),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "limit": 1}', "`limit` must be true or false; got 1"),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "faces": 5.5}', "`faces` must be a whole number; got 5.5"),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "tolerance_mm": "0"}', "`tolerance_mm` must be a number"),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "closed": 1}', "`closed` must be true or false; got 1"),
        (
            '{"scheme": {"name": "Loop"}, "levels": 2, "kind": "hexagon"}',
            '`kind` must be one of "triangle", "quad"; got "hexagon"',
        ),
        (
            '{"scheme": {"name": "Loop"}, "levels": 2, "pose": "none"}',
            '`pose` must be one of "rigid", "similarity", "affine", null; got "none"',
        ),
        (
            '{"scheme": {"name": "Loop"}, "levels": 2, "prior": {}}',
            "a recipe has no 'prior'; it has closed, faces",
        ),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "priors": {"bend": -1}}', "`priors` is not as it should be: .*-1"),
        ('{"scheme": {"name": "Loop"}, "levels": 2, "priors": 3}', "`priors` must be an object"),
    ],
)
def test_recipe_that_is_wrong_is_refused_by_file_and_reason(tmp_path, text, words, as_users_run):
    path = tmp_path / "my.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=words) as error:
        load_recipe(path)
    assert str(error.value).startswith(f"{path}: ")


def test_folder_of_a_fit_can_be_moved(saved, tmp_path):
    shutil.move(saved, tmp_path / "elsewhere")
    same(fitting.load(tmp_path / "elsewhere").control, noisy().control)
