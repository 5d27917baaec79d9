"""`jaxsubdiv-fit --template-out` and `--prior`: a template of many scans, and their family as a prior."""

import numpy as np
import pytest
import test_template

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit

pytestmark = pytest.mark.usefixtures("command_settings")


def run(*arguments) -> int:
    return fit([str(argument) for argument in arguments])


def test_a_template_of_a_folder_and_a_fit_by_its_family(tmp_path, capsys):
    folder, out = tmp_path / "scans", tmp_path / "fits"
    folder.mkdir()
    for name, scan in zip("abc", test_template.bodies(), strict=True):
        np.savetxt(folder / f"{name}.xyz", np.asarray(scan.points))
    status = run(
        folder, "--template-out", tmp_path / "mean.obj", "-o", out, "--faces", 60, "--levels", 1, "--max-sweeps", 20
    )
    text = capsys.readouterr().out
    assert status in (0, 1) and f"wrote    {tmp_path / 'mean.obj'}" in text
    mean, cohort = js.read_mesh(tmp_path / "mean.obj"), fitting.load_cohort(out)
    assert cohort.names == ("a", "b", "c")
    aligned = fitting.shape_modes(np.stack([*np.asarray(cohort.control.vertices), mean.vertices])).aligned
    np.testing.assert_allclose(aligned[3], aligned[:3].mean(axis=0), atol=0.2)

    part = np.asarray(test_template.bodies()[1].points)
    middle = part - part.mean(axis=0)
    along = np.linalg.svd(middle, full_matrices=False)[2][0]
    np.savetxt(tmp_path / "part.xyz", part[middle @ along > -8])
    run(tmp_path / "part.xyz", "--prior", out, "-o", tmp_path / "part", "--levels", 1, "--max-sweeps", 20)
    assert "looks for the member of the family" in capsys.readouterr().out
    found = fitting.load(tmp_path / "part")
    assert found.recipe.priors.shape is not None and len(found.control.vertices) == len(mean.vertices)
    lost = part[middle @ along < -8]
    on = np.asarray(js.evaluate(found.surface, fitting.closest_points(found.surface, lost)).points)
    assert np.sqrt(np.mean(np.sum((on - lost) ** 2, axis=1))) < 1.5  # of a body 53 mm long


def test_what_cannot_be_combined_is_told(tmp_path, capsys):
    np.savetxt(tmp_path / "a.xyz", np.asarray(test_template.bodies()[0].points))
    with pytest.raises(SystemExit):
        run(tmp_path / "a.xyz", "--template-out", tmp_path / "t.obj", "--control", tmp_path / "c.obj")
    assert run(tmp_path / "a.xyz", "--template-out", tmp_path / "t.obj") == 2
    assert "a template needs two scans or more" in capsys.readouterr().err
    assert run(tmp_path / "a.xyz", "--prior", tmp_path) == 2
    assert "no folders with saved fits" in capsys.readouterr().err
