"""A series: frames fitted together, whose truth is known, and what is measured of them."""

import csv
import dataclasses
import io
from typing import Any

import beating
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as command
from fitting.model.unknowns import Layout, Variables
from fitting.scan.frames import place_frames
from fitting.solve.arrowhead import solve_preconditioned
from fitting.start.cavities import find_parts, find_valves

N = 4


@pytest.fixture(scope="module")
def truth():
    return beating.series(N)


@pytest.fixture(scope="module")
def found(truth) -> fitting.SeriesFit:
    _, scans, template = truth
    return fitting.fit_series(scans, template, periodic=True, levels=2, throw=False)


def test_shifts_of_slices_are_those_of_all_frames(found):
    assert found.slices.tolist() == list(range(6))
    across = found.shifts[:4] + beating.SHIFTS[:4]  # what is left is a common motion, of which the contours say little
    np.testing.assert_allclose(across - across.mean(axis=0), 0, atol=0.25)
    assert np.linalg.norm(across.mean(axis=0)) < 3.0


def test_volumes_follow_the_beat(found, truth):
    volumes, deviations = found.table.column("volume ENDO")
    true = np.array([shape.volumes[0] for shape in truth[0]])
    np.testing.assert_allclose(volumes, true, rtol=0.07)
    assert np.all(deviations > 0.05) and np.all(deviations < 0.03 * true)
    ejected, deviation = found.table.ejection["ENDO"]
    assert abs(ejected - (1 - true.min() / true.max())) < 0.03
    assert 0 < deviation < 0.03
    wall = found.table.column("wall volume")[0]
    np.testing.assert_allclose(wall, [shape.volumes[1] for shape in truth[0]], rtol=0.07)
    np.testing.assert_allclose(found.table.column("wall mass")[0], 1.05 * wall)


def test_points_lie_on_their_own_region_of_their_own_frame(found):
    result = found.result
    owner = js.control_faces_of(result.scheme, result.fit.topology, result.surface, result.control)[result.at.face]
    counted = np.asarray(result.scan.weights_or_ones()) > 0
    groups = np.array(result.fit.regions.faces.words())[owner]
    assert np.all(groups[counted] == np.array(result.scan.regions.words())[counted])
    assert np.all(np.array(result.scan.regions.words())[~counted] == "MITRAL_VALVE")
    size = len(found.template.vertices)
    corners = np.full(len(result.fit.topology.control_faces[3]) + len(result.fit.topology.control_faces[4]), -1)
    corners[:] = np.concatenate([result.fit.topology.control_faces[k][:, 0] for k in (3, 4)])
    np.testing.assert_array_equal(corners[owner] // size, found.frames.of_points)


def test_a_frame_is_its_part_of_the_whole(found, truth):
    for frame in range(N):
        np.testing.assert_allclose(found.scan(frame).points, truth[1][frame].points, atol=1e-9)
        on = js.evaluate(found.surface(frame), fitting.closest_points(found.surface(frame), found.points(frame)))
        near = np.linalg.norm(np.asarray(on.points) - found.points(frame), axis=1)
        assert np.sqrt(np.mean(near**2)) < 0.5
        assert found.rms(frame) < 0.3
    assert found.control_mesh(1).regions is not None
    assert len(found.surface(0, levels=3).vertices) > len(found.surface(0).vertices)


def test_deviations_are_those_of_draws(found):
    """By surfaces drawn from the posterior, whose volumes need no derivative."""
    column, frame, fit = found.measures.volumes["ENDO"], 2, found.result.fit
    layout, v = fit.model.layout, len(found.template.vertices)
    own = Layout(v, True, True, tuple((name, of) for name, of in layout.shared if name == "h"))
    drawn = found.result.posterior.draws(100, seed=1)
    edge = js.edge_length(fit.topology, fit.y.control.vertices)
    start = Variables(found.control(frame), {"h": fit.y.shared["h"]})
    walls = found.measures.walls(found.surface(frame))
    rows = slice(frame * own.n_own, (frame + 1) * own.n_own)

    @eqx.filter_jit
    def volume(vector):
        moved = own.retract(start, own.split(vector), edge)
        scheme = eqx.tree_at(lambda s: s.h, found.result.scheme, moved.shared["h"])
        return found.measures.measure(js.refine(scheme, found.topology(), moved.control), walls)[column]

    vectors = np.concatenate([drawn[rows], drawn[layout.columns("h")]])
    volumes = [float(volume(jnp.asarray(vector))) for vector in vectors.T]
    assert 0.75 < np.std(volumes) / found.table.deviations[frame, column] < 1.3


def test_is_saved_and_read_again(found, tmp_path):
    found.save(tmp_path)
    again = fitting.load_series(tmp_path)
    assert again.names == found.names and again.valves == found.valves
    assert again.frames.periodic
    for frame in (0, N - 1):
        np.testing.assert_array_equal(again.surface(frame).vertices, found.surface(frame).vertices)
    np.testing.assert_allclose(again.shifts, found.shifts)
    found.table.write_csv(tmp_path / "series.csv")
    lines = (tmp_path / "series.csv").read_text().splitlines()
    assert len(lines) == N + 1 and lines[0].startswith("frame,volume ENDO [ml],volume ENDO sd [ml]")
    assert float(lines[1].split(",")[1]) == pytest.approx(found.table.values[0, 0], rel=1e-5)
    assert "ejection fraction ENDO" in str(found.table)
    with pytest.raises(KeyError, match="no measure 'mass'; there are volume ENDO"):
        found.table.column("mass")
    with pytest.raises(FileNotFoundError, match=r"no series\.json"):
        fitting.load_series(tmp_path / "nothing")
    (tmp_path / "series.json").write_text('{"names": ["one"], "valves": []}')
    with pytest.raises(ValueError, match="1 names, but the fit beside it is not of as many frames"):
        fitting.load_series(tmp_path)


def test_the_prior_is_of_the_change_from_frame_to_frame(found):
    """Of the last to the first too; where the frames were placed does not count."""
    model = found.result.fit.model
    rows = model.prior("series").rows(model.place(found.result.fit.y), None).reshape(N, -1, 3)
    controls = [np.asarray(found.control(k).vertices) for k in range(N)]
    changes = [controls[j] - controls[i] for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    np.testing.assert_allclose(rows, changes, atol=1e-9)


def test_a_beat_closes_and_a_growth_does_not(truth):
    """The last frame is tied to the first where the series is periodic, and there alone."""
    _, frames = place_frames(truth[1], True)
    assert frames.pairs.tolist() == [[0, 1], [1, 2], [2, 3], [3, 0]]
    _, frames = place_frames(truth[1], False)
    assert frames.pairs.tolist() == [[0, 1], [1, 2], [2, 3]]
    _, frames = place_frames(truth[1][:2], True)
    assert frames.pairs.tolist() == [[0, 1]]


def test_conjugate_gradients_solve():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(30, 30))
    matrix = root @ root.T + 30 * np.eye(30)
    sides = rng.normal(size=(30, 3))
    solved = solve_preconditioned(lambda x: matrix @ x, lambda x: x / np.diag(matrix)[:, None], sides)
    exact = np.linalg.solve(matrix, sides)
    assert np.linalg.norm(solved - exact) < 0.02 * np.linalg.norm(exact)


def test_parts_and_valves(truth):
    template = truth[2]
    assert find_valves(template) == ("MITRAL_VALVE",)
    parts = find_parts(template, ("MITRAL_VALVE",))
    assert [(part.name, part.is_cavity, [len(rim) for rim in part.rims]) for part in parts] == [
        ("ENDO", True, [beating.AROUND]),
        ("EPI", False, [beating.AROUND]),
    ]
    with pytest.raises(ValueError, match="`valves`: 'AORTA' is no group of the control mesh; it has"):
        find_valves(template, ["AORTA"])


def test_what_cannot_be_fitted_is_named(truth):
    _, scans, template = truth
    fit = fitting.fit_series
    with pytest.raises(fitting.ScanError, match="two frames or more; got 1"):
        fit(scans[:1], template)
    with pytest.raises(ValueError, match="4 frames and 1 names"):
        fit(scans, template, names=["one"])
    few = scans[1].rows(np.arange(5))
    with pytest.raises(fitting.ScanError, match="frame 1: the frame has 5 points, where most have"):
        fit([scans[0], few, *scans[2:]], template)
    bare = dataclasses.replace(scans[2], slices=None)
    with pytest.raises(fitting.ScanError, match="late: the frame has no slices and others have"):
        fit([scans[0], bare], template, names=["early", "late"])
    numbers = np.asarray(scans[1].slices)
    swapped = dataclasses.replace(scans[1], slices=np.where(numbers < 2, 1 - numbers, numbers))
    with pytest.raises(fitting.ScanError, match=r"frame 1: slice 0 lies .* mm off the plane that it has in frame 0"):
        fit([scans[0], swapped], template)
    unlabelled = dataclasses.replace(scans[1], regions=None)
    with pytest.raises(fitting.ScanError, match="frame 1 has no `regions` and others have"):
        place_frames([scans[0], unlabelled], False)
    with pytest.raises(ValueError, match="a series is fitted without"):
        fit(scans, template, priors=fitting.Priors(symmetry=1.0))


class Stopped(Exception):
    """As if by Ctrl-C."""


def test_a_series_that_was_stopped_goes_on(truth, tmp_path):
    _, scans, template = truth
    told, numbers = [], []

    def stop(sweep: fitting.Sweep) -> None:
        if sweep.number > 1:
            raise Stopped

    how: dict[str, Any] = {"periodic": True, "levels": 2, "max_sweeps": 3, "pose": None, "throw": False}
    whole = fitting.fit_series(scans, template, **how)
    how["checkpoint"] = tmp_path
    with pytest.raises(Stopped):
        fitting.fit_series(scans, template, on_sweep=stop, **how)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint.npz", "checkpoint_start.npz"]
    with pytest.raises(ValueError, match=r"checkpoint_start\.npz is of another fit, with another periodic\. Start"):
        fitting.fit_series(scans, template, **(how | {"periodic": False}))
    again = fitting.fit_series(
        scans, template, on_sweep=lambda sweep: numbers.append(sweep.number), on_stage=told.append, **how
    )
    assert numbers == [2, 3] and told[0] == "goes on where it was stopped" and len(told) == 2
    np.testing.assert_array_equal(again.result.control.vertices, whole.result.control.vertices)
    np.testing.assert_array_equal(again.result.rms, whole.result.rms)
    assert not list(tmp_path.iterdir())


def test_few_points_warn_and_name_the_frame(truth):
    from fitting.run.series import _check_frames

    scans = [scan for scan in truth[1]]
    scans[2] = scans[2].rows(np.arange(40))
    with pytest.warns(UserWarning, match=r"third \(40\): far fewer points than most frames have"):
        _check_frames(scans, ["first", "second", "third", "fourth"])


def write_frames(folder, scans, template):
    """Scans as tables and the template beside them."""
    folder.mkdir()
    for number, scan in enumerate(scans):
        with (folder / f"frame_{number}.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("x", "y", "z", "label", "slice"))
            for point, label, number_of_slice in zip(
                np.asarray(scan.points).tolist(), scan.regions.words(), np.asarray(scan.slices).tolist(), strict=True
            ):
                writer.writerow([*point, label, number_of_slice])
    js.write_mesh(folder.parent / "template.obj", template)
    return [str(folder), "--control", str(folder.parent / "template.obj"), "--series"]


@pytest.mark.usefixtures("command_settings")
def test_the_command_fits_a_folder_of_frames(found, truth, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("fitting.report.animation._PICTURES", 2 * N)
    arguments = write_frames(tmp_path / "frames", truth[1], truth[2])
    out = tmp_path / "out"
    assert command([*arguments, "--periodic", "--max-sweeps", "2", "-o", str(out)]) == 1
    told = capsys.readouterr().out
    assert "frame    frame_3:" in told and "region   ENDO:" in told and "ejection fraction ENDO" in told
    assert "WARNING  the fit did not converge" in told
    again = fitting.load_series(out)
    assert again.names == tuple(f"frame_{k}" for k in range(N)) and again.frames.periodic
    for name in again.names:
        assert js.read_mesh(out / "frames" / f"{name}.obj").regions is not None
        assert len(js.read_mesh(out / "frames" / f"{name}.ply").vertices) == len(found.surface(0).vertices)
    with (out / "series.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == list(again.names)
    assert float(rows[0]["volume ENDO [ml]"]) > float(rows[2]["volume ENDO [ml]"]) > 0
    page = (out / "series.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 6 and "data:image/gif;base64," in page and page.count("<tr>") == N + 1
    image = pytest.importorskip("PIL.Image").open(io.BytesIO((out / "series.gif").read_bytes()))
    assert image.n_frames == 2 * N
    assert not [path for path in out.iterdir() if path.name.startswith((".", "checkpoint"))]
    again = [*arguments, "--periodic", "--max-sweeps", "2", "-o", str(out), "--resume"]
    assert command(again) == 1 and "done     before" in capsys.readouterr().out
    assert command([*again, "--h", "1.1"]) == 2
    assert "holds a fit with another frames. Without --resume" in capsys.readouterr().err


@pytest.mark.usefixtures("command_settings")
def test_the_command_refuses_what_is_no_series(truth, tmp_path, capsys):
    arguments = write_frames(tmp_path / "frames", truth[1][:1], truth[2])
    assert command([*arguments, "-o", str(tmp_path / "out")]) == 2
    assert "two frames or more; got 1" in capsys.readouterr().err
    assert command([*arguments, "--tolerance", "1"]) == 2
    assert "--tolerance is not of a series" in capsys.readouterr().err
    for wrong, words in ((["--series"], "give --control MESH"), (["--periodic"], "give --series")):
        with pytest.raises(SystemExit):
            command([arguments[0], *wrong])
        assert words in capsys.readouterr().err
