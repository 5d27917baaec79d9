"""A small fit for many tests: one mesh of one number of points, so that all of them run one compiled program."""

import functools
from typing import NamedTuple

import jax
import meshes
import numpy as np

import fitting
import jaxsubdiv as js
from fitting import Free, Priors
from fitting.model.residual import Held, Model, Pairs, analyse
from fitting.model.unknowns import Variables
from fitting.solve.strengths import first_strengths

N_POINTS = 600
SIGMA = 0.3  # mm: the noise of a noisy scan


class Problem(NamedTuple):
    """A surface that is known, points on it, and a control mesh that is off by about a millimetre."""

    mesh: js.ControlMesh
    topology: js.Topology
    truth: js.Control
    h: float
    points: np.ndarray
    start: js.Control

    def fit(self, points: np.ndarray | None = None, **options) -> fitting.FitResult:
        """From the start, with h = 1."""
        weights = options.pop("weights", None)
        scan = fitting.Scan(self.points if points is None else points, weights=weights)
        arguments = {"scheme": js.Interpolating(), "topology": self.topology, "control": self.start, "throw": False}
        return fitting.fit(**(arguments | {"scan": scan} | options))


@functools.cache
def problem() -> Problem:
    vertices, faces = meshes.mixed_closed()
    mesh = js.ControlMesh(vertices * (24, 18, 15), sorted(faces, key=len))
    topology, truth, h = js.build_topology(mesh, js.Interpolating(), 1), mesh.control(), 1.2
    points = js.sample(js.refine(js.Interpolating(h), topology, truth), N_POINTS, jax.random.key(0)).points
    rng = np.random.default_rng(0)
    vertices, normals = (
        rows + rng.normal(scale=s, size=rows.shape) for rows, s in ((truth.vertices, 0.6), (truth.normals, 0.1))
    )
    return Problem(mesh, topology, truth, h, np.asarray(points), js.Control(vertices, normals))


def noise(seed: int = 0) -> np.ndarray:
    """Of a scan, in mm."""
    return np.random.default_rng(seed).normal(scale=SIGMA, size=(N_POINTS, 3))


def analysed(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    control: js.Control,
    *,
    free: Free | None = None,
    priors: Priors | None = None,
    **inputs,
) -> tuple[Model, Variables]:
    """The model of a fit that starts here, and its variables there."""
    return analyse(scheme, topology, control, free or Free(), priors or Priors(), inputs)


def hold_everything(model: Model, y: Variables, pairs: Pairs, faces: np.ndarray) -> Held:
    """What a first sweep from here would hold, with pairs of weight 1."""
    strengths = first_strengths(model).values
    precisions = {prior.name: prior.precisions(strengths) for prior in model.priors}
    held = model.hold(model.place(y, model.refine(y)), strengths)
    return Held(pairs, faces, None, None, np.ones(len(faces)), held, precisions)


def assert_refit_knows_the_fit(result: fitting.FitResult) -> None:
    """Its cost has the slope that the equations of the fit's sweeps have: nothing that they know is left out."""
    fixed = result.refit()._fixed
    gradient = result.fit.equations().gradient
    expected, size = np.asarray(fixed.whitening).T @ gradient, float(np.linalg.norm(fixed.left))
    np.testing.assert_allclose(fixed.left, expected, rtol=1e-3, atol=1e-3 * size)


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))
