"""Checkpoints: a fit that was stopped and goes on ends where one that was not stopped does."""

import jax
import numpy as np
import pytest
from posteriors import precision_matrix
from scans import noise, problem

import fitting
import jaxsubdiv as js
from fitting import Free, Priors
from fitting.run.fit import CHECKPOINT


class Stopped(Exception):
    """As if by Ctrl-C."""


def after(sweeps: int):
    """Stop a fit after so many sweeps."""

    def stop(sweep: fitting.Sweep) -> None:
        if sweep.number > sweeps:
            raise Stopped

    return stop


def same(found: object, expected: object) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.asarray(a).dtype == np.asarray(b).dtype


def points() -> np.ndarray:
    return problem().points + noise()


OPTIONS = {
    "smoothness from the scan": {},
    "smoothness as given": {"priors": Priors(bend=0.3)},
    "some vertices, no normals": {"free": Free(vertices=np.arange(12) > 3, normals=False)},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_stopped_fit_ends_where_one_that_was_not_stopped_does(tmp_path, name):
    options = OPTIONS[name] | {"max_sweeps": 8, "tolerance": 1e-9}
    whole = problem().fit(points(), **options)
    with pytest.raises(Stopped):
        problem().fit(points(), checkpoint=tmp_path, on_sweep=after(3), **options)
    assert (tmp_path / CHECKPOINT).is_file()
    numbers = []
    again = problem().fit(points(), checkpoint=tmp_path, on_sweep=lambda sweep: numbers.append(sweep.number), **options)
    assert numbers == list(range(4, len(whole.rms)))  # or it began anew
    for part in ("control", "scheme", "at", "distances", "weights", "rms", "robust_rms", "noise", "start"):
        same(getattr(again, part), getattr(whole, part))
    assert again.result == whole.result and again.report().as_dict() == whole.report().as_dict()
    same(precision_matrix(again), precision_matrix(whole))
    assert not list(tmp_path.iterdir())


def test_fit_can_be_stopped_at_every_sweep(tmp_path):
    whole, fits = problem().fit(points(), max_sweeps=6, tolerance=1e-9), 0
    while True:
        try:
            again = problem().fit(points(), max_sweeps=6, tolerance=1e-9, checkpoint=tmp_path, on_sweep=after(fits + 1))
            break
        except Stopped:
            fits += 1
    assert fits == 5
    same(again.control, whole.control)


@pytest.fixture
def stopped(tmp_path):
    with pytest.raises(Stopped):
        problem().fit(points(), checkpoint=tmp_path, on_sweep=after(1))
    return tmp_path


OTHERS = {
    "scan": lambda p: {"points": points() + 1e-9},
    "control": lambda p: {"control": js.Control(p.start.vertices + 1, p.start.normals)},
    "topology": lambda p: {"topology": js.build_topology(p.mesh, js.Interpolating(), 2)},
    "scheme": lambda p: {"scheme": js.Interpolating(1.1)},
    "free": lambda p: {"free": Free(h=False)},
    "priors": lambda p: {"priors": Priors(stretch=0.1)},
    "loss": lambda p: {"loss": fitting.Tukey()},
    "landmarks": lambda p: {"landmarks": fitting.Landmarks(np.eye(3), [0, 1, 2])},
    "landmark_deviation": lambda p: {"landmark_deviation": 2.0},
    "max_sweeps": lambda p: {"max_sweeps": 9},
    "tolerance": lambda p: {"tolerance": 0.2},
}


@pytest.mark.parametrize("name", OTHERS)
def test_checkpoint_of_another_fit_is_refused_by_what_differs(stopped, name):
    options = {"points": points()} | OTHERS[name](problem())
    with pytest.raises(ValueError, match=f"of another fit, with another {name}\\. Start with what it was"):
        problem().fit(options.pop("points"), checkpoint=stopped, **options)
    assert (stopped / CHECKPOINT).is_file()


def test_checkpoint_that_is_broken_is_refused_by_its_name(stopped):
    file = stopped / CHECKPOINT
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(ValueError, match=r"checkpoint\.npz is no checkpoint: .* Delete it to start anew"):
        problem().fit(points(), checkpoint=stopped)


# From the scan on


def start() -> js.ControlMesh:
    return js.ControlMesh(problem().start.vertices, problem().mesh.faces, problem().start.normals)


def test_checkpoint_of_another_scan_fit_is_refused_by_what_differs(tmp_path):
    how = {"levels": 1, "pose": None, "throw": False, "checkpoint": tmp_path}
    with pytest.raises(Stopped):
        fitting.fit_scan(fitting.Scan(points()), start(), on_sweep=after(1), **how)
    before = sorted(tmp_path.iterdir())
    moved = js.ControlMesh(start().vertices + 1, start().faces)
    for name, change in (("mesh", {"mesh": moved}), ("faces", {"faces": 20}), ("priors", {"priors": Priors(h=0.1)})):
        with pytest.raises(ValueError, match=f"checkpoint_start.npz is of another fit, with another {name}"):
            fitting.fit_scan(**({"scan": fitting.Scan(points()), "mesh": start()} | how | change))
    assert sorted(tmp_path.iterdir()) == before


def test_what_cannot_be_fitted_leaves_no_checkpoint(tmp_path):
    with pytest.raises(fitting.ScanError, match="all scan points lie on one spot"):
        fitting.fit_scan(fitting.Scan(np.ones((20, 3))), start(), pose=None, levels=1, checkpoint=tmp_path)
    assert not list(tmp_path.iterdir())


def test_fit_without_a_checkpoint_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    problem().fit(points(), max_sweeps=2)
    assert not list(tmp_path.iterdir())
