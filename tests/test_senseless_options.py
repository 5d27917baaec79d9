"""Options of the functions that make no sense are refused by name."""

import jax
import numpy as np
import pytest
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit_command
from fitting.command.inputs import Job, mark_job
from fitting.command.options import make_parser
from fitting.run.checkpoint import find_differing

pytestmark = pytest.mark.usefixtures("command_settings")


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0])
@pytest.mark.parametrize("name", ["bend", "stretch", "h", "symmetry", "shift"])
def test_senseless_deviations_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"`{name}`: a standard deviation must be positive; got {value}"):
        fitting.Priors(**{name: value})


@pytest.mark.parametrize("make", [fitting.Huber, fitting.Tukey, fitting.cauchy, fitting.geman_mcclure])
@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_senseless_losses_are_refused_by_name(make, value):
    with pytest.raises(ValueError, match=f"`c`: the width of a loss .*; got {value}"):
        make(value)


def test_senseless_shapes_of_a_loss_are_refused_by_name():
    for alpha in (np.nan, 3.0):
        with pytest.raises(ValueError, match="`alpha`: the shape of a loss"):
            fitting.Barron(alpha)
    assert fitting.Barron(-np.inf).alpha == -np.inf


@pytest.mark.parametrize(
    ("mode", "words", "named"),
    [
        (["--layers", "x.json"], ["--outside"], "--outside is not of a fit of layers"),
        (["--layers", "x.json"], ["--control-landmarks", "a.csv"], "--control-landmarks is not of a fit of layers"),
        (["--layers", "x.json"], ["--label", "all"], "--label is not of a fit of layers"),
        (["--layers", "x.json"], ["--prior", "fits"], "--prior is not of a fit of layers"),
        (["--series", "--control", "c.obj"], ["--details"], "--details is not of a series"),
        (["--template-out", "t.obj"], ["--tetrahedra"], "--tetrahedra is not of a template of scans"),
        (["--template-out", "t.obj"], ["--patches", "2"], "--patches is not of a template of scans"),
        (["--template-out", "t.obj"], ["--no-crossing"], "--no-crossing is not of a template of scans"),
        (["--template-out", "t.obj"], ["--surface", "glb"], "--surface is not of a template of scans"),
    ],
)
def test_options_that_a_mode_passes_over_are_refused_before_anything_is_read(mode, words, named, capsys):
    assert fit_command(["nowhere.csv", *mode, *words]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--mirror"], ["--symmetry", "1"], ["--likeness", "0.5"]])
def test_options_of_a_template_are_refused_where_layers_have_none(option, tmp_path, capsys):
    (tmp_path / "layers.json").write_text('{"endo": "A", "epi": "B"}')
    assert fit_command(["nowhere.csv", "--layers", str(tmp_path / "layers.json"), *option]) == 2
    assert f"give --control MESH to {option[0]}" in capsys.readouterr().err


def test_details_are_among_the_marks_of_a_fit():
    recipe, job = fitting.Recipe(js.Interpolating()), Job("one", fitting.Scan(np.eye(3)), None, None)
    plain, detailed = (mark_job(job, recipe, make_parser().parse_args(words)) for words in ([], ["--details"]))
    assert find_differing(plain, detailed) == ["details"]


OPTIONS = {"max_sweeps": -1, "tolerance": np.nan, "landmark_deviation": 0.0}
MORE = {"levels": 0, "faces": 1, "tolerance_mm": -1.0, "most_faces": 0, "most_points": 0}


@pytest.mark.parametrize("name", [*OPTIONS, *MORE])
def test_senseless_options_of_the_functions_are_refused_by_name(name):
    p, value = problem(), (OPTIONS | MORE)[name]
    scan, mesh = fitting.Scan(p.points), js.ControlMesh(p.start.vertices, p.mesh.faces)
    calls = [
        lambda: fitting.fit_scan(scan, mesh, **{name: value}),
        lambda: fitting.Recipe(js.Interpolating(), **{name: value}),
    ]
    if name in OPTIONS:
        calls.append(lambda: fitting.fit(js.Interpolating(), p.topology, p.start, scan, **{name: value}))
        calls.append(lambda: fitting.fit_cohort(js.Interpolating(), p.topology, p.start, [scan], **{name: value}))
    for call in calls:
        with pytest.raises(ValueError, match=f"`{name}`: .*; got {value}"):
            call()


@pytest.mark.parametrize("factor", [1e-30, 1e-6, 1e6, 1e30])
def test_weights_of_one_size_count_as_none(factor):
    p = problem()
    plain = p.fit(p.points + noise(), max_sweeps=4)
    found = p.fit(p.points + noise(), max_sweeps=4, weights=np.full(len(p.points), factor))
    np.testing.assert_allclose(found.control.vertices, plain.control.vertices, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.noise, plain.noise, rtol=1e-9)


@pytest.mark.parametrize("factor", [1e-20, 1e20])
@pytest.mark.parametrize("control", [True, False])
def test_coordinates_out_of_range_are_refused(factor, control):
    p = problem()
    mesh = js.ControlMesh(p.start.vertices * factor, p.mesh.faces) if control else None
    with pytest.raises(fitting.ScanError, match=r"the scan measures .*: a fit takes sizes from 1e-06 to 1e\+08, in mm"):
        fitting.fit_scan(fitting.Scan(p.points * factor), mesh)


@pytest.mark.parametrize("length", [1e-200, 1e200])
def test_only_directions_of_normals_count(length):
    p, normals = problem(), problem().points
    jax.config.update("jax_enable_x64", False)
    try:
        scan, mesh = fitting.Scan(p.points, normals * length), js.ControlMesh(p.mesh.vertices, p.mesh.faces)
        again = js.ControlMesh(mesh.vertices, mesh.faces, mesh.vertices * length).control()
    finally:
        jax.config.update("jax_enable_x64", True)
    for found, given in ((scan.normals, normals), (again.normals, mesh.vertices)):
        found, given = (np.float64(rows) for rows in (found, given))
        given = given / np.linalg.norm(given, axis=1, keepdims=True)
        np.testing.assert_allclose(found / np.linalg.norm(found, axis=1, keepdims=True), given, atol=1e-6)
