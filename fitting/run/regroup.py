"""A cohort fitted again from its own mean, until the mean no longer depends on where the first fits started."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxsubdiv as js

from ..model.limits import check_numbers
from ..model.modes import shape_modes
from ..model.priors import Priors
from ..model.priors.symmetry import Symmetry
from ..model.procrustes import align_shape
from ..report.cohort import Cohort
from ..report.record import Fit
from ..scan.closest_points import closest_points
from ..scan.landmarks import Landmarks
from .cohort import fit_cohort

_AT_REST = 0.02  # of a control edge: a mean that moves across itself by less is the same


class Template(NamedTuple):
    """The mean of a cohort, as the control mesh that its fits start from."""

    mesh: js.ControlMesh
    """In mm, about the origin, turned as the first subject."""
    cohort: Cohort
    """The last fits, from the mean before this one."""
    moved: Float[np.ndarray, "rounds"]
    """How far each round moved the mean surface across itself: root mean square in mm."""
    at_rest: bool
    """Whether the last round moved it by less than a fiftieth of a control edge."""


def regroup(
    cohort: Cohort,
    *,
    rounds: int = 6,
    priors: Priors | None = None,
    symmetry: Symmetry | None = None,
    on_stage: Callable[[str], None] | None = None,
    **options: Any,
) -> Template:
    """Fit the scans of a cohort again from its mean shape, and again from the mean of these, until it rests.

    The mean keeps the subjects' mean size. Every fit starts from the mean, moved onto the subject's last fit, with the
    landmarks, boundary, regions and settings that it had.

    Args:
        cohort: the first fits.
        rounds: how many means are taken at most.
        priors: of the new fits; default: those of the cohort.
        symmetry: the partners of the control vertices, to keep the mean symmetric; see `find_symmetry`.
        on_stage: told what begins, in a few words.
        options: more for `fit_cohort`; they come before the cohort's own.

    Raises:
        ValueError, ScanError: as `fit_cohort` does; or an option is of one cohort alone, as a checkpoint is.

    Source: A. Guimond et al., Average brain models: a convergence study, 2000.
    """
    check_numbers({"rounds": rounds})
    refuse_of_one_cohort(options)
    say = on_stage or (lambda words: None)
    first = cohort.result(0).fit
    told, topology, scheme = first.settings, first.topology, first.settings.scheme
    own: dict[str, Any] = {"free": told.free, "priors": priors or told.priors, "loss": told.loss}
    own |= {"max_sweeps": told.max_sweeps, "tolerance": told.tolerance, "names": cohort.names}
    own |= {"landmark_deviation": told.landmark_deviation}
    fits = [cohort.result(i).fit for i in range(len(cohort))]
    for name in ("boundary", "regions"):
        if first.inputs.get(name) is not None:
            own[name] = [one.inputs[name] for one in fits]
    if np.isfinite(own["priors"].symmetry):
        own["symmetry"] = first.inputs.get("symmetry") or symmetry
    mean, moved, rests = _mean_shape(cohort, symmetry), [], False
    dtype = cohort.control.vertices.dtype
    edge = float(js.edge_length(topology, jnp.asarray(mean, dtype)))
    for number in range(1, rounds + 1):
        say(f"fits all from their mean, round {number}")
        shapes = np.asarray(cohort.control.vertices, np.float64)
        controls = [_control(scheme, topology, align_shape(mean, shape), dtype) for shape in shapes]
        here = dict(own)
        if first.inputs.get("landmarks") is not None:
            here["landmarks"] = [_carry_landmarks(*one, told) for one in zip(fits, controls, strict=True)]
        cohort = fit_cohort(scheme, topology, controls, cohort.scans, **(here | options))
        last, mean = mean, _mean_shape(cohort, symmetry)
        moved.append(_distance(scheme, topology, last, mean, dtype))
        rests = moved[-1] < _AT_REST * edge
        if rests:
            break
    faces = {size: np.asarray(rows) for size, rows in topology.control_faces.items()}
    regions = None if first.regions is None else first.regions.faces
    return Template(js.ControlMesh(mean, faces, regions=regions), cohort, np.array(moved), bool(rests))


def refuse_of_one_cohort(options: dict[str, Any]) -> None:
    """Refuse options of `fit_cohort` that several cohorts, one after another, cannot have."""
    for name in ("checkpoint", "skip_bad"):
        if options.get(name):
            raise ValueError(f"`{name}` is of one cohort, and a template takes several: leave it out.")


def _mean_shape(cohort: Cohort, symmetry: Symmetry | None) -> Float[np.ndarray, "v 3"]:
    shapes = np.asarray(cohort.control.vertices, np.float64)
    mean = shape_modes(shapes).mean if len(shapes) > 1 else shapes[0]
    return mean if symmetry is None else 0.5 * (mean + symmetry.mirror(mean))


def _control(scheme: js.AbstractScheme, topology: js.Topology, vertices: np.ndarray, dtype: Any) -> js.Control:
    placed = jnp.asarray(vertices, dtype)
    return js.Control(placed, js.estimate_normals(topology.control_fans, placed))


def _carry_landmarks(found: Fit, control: js.Control, told: Any) -> Landmarks:
    """The landmarks of a fit at the same places of the surface, where that starts now."""
    anchors = found.inputs["landmarks"]
    surface = js.refine(told.scheme, found.topology, control)
    on_mesh = js.sum_corners(surface.vertices, anchors.corners, anchors.corner_weights)
    weights = (told.landmark_deviation / np.asarray(anchors.deviations)) ** 2
    return Landmarks(np.asarray(anchors.points), np.asarray(on_mesh), weights)


def _distance(
    scheme: js.AbstractScheme, topology: js.Topology, last: np.ndarray, mean: np.ndarray, dtype: Any
) -> float:
    """Root mean square distance in mm from the one mean surface to the other, laid on each other."""
    before, after = (
        js.refine(scheme, topology, _control(scheme, topology, vertices, dtype))
        for vertices in (last, align_shape(mean, last, scale=False))
    )
    points = np.asarray(after.vertices)
    on = np.asarray(js.evaluate(before, closest_points(before, points)).points)
    return float(np.sqrt(np.mean(np.sum((on - points) ** 2, axis=1))))
