"""From a scan alone, or with a template, to a fit: align or make the control mesh, fit, split where it is coarse."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

import jaxsubdiv as js

from ._align import Alignment, align
from ._control_mesh import control_mesh
from ._correspondence import nearest_rows
from ._fit import fit
from ._landmarks import Landmarks
from ._result import FitResult
from ._scan import Scan
from ._symmetry import find_symmetry

Outcome: TypeAlias = Literal["tolerance met", "noise reached", "no more faces"]

# Misfit that is a smaller part of the noise than this does not show beside it.
_LEAST_MISFIT = 0.15
_SWELLINGS = 3


class ScanFit(NamedTuple):
    """A fit, and how it came about."""

    result: FitResult
    start: js.ControlMesh
    """Control mesh where the last fit started: aligned, or made from the scan, or split."""
    alignment: Alignment | None
    """None where the control mesh was made from the scan, or was not to be aligned."""
    splits: int
    """How many times the control mesh was split into four times its faces."""
    outcome: Outcome | None
    """Why no further split was made; None where no tolerance was asked for."""


def fit_scan(
    scan: Scan,
    mesh: js.ControlMesh | None = None,
    *,
    scheme: js.AbstractScheme | None = None,
    levels: int = 2,
    faces: int = 500,
    kind: Literal["triangle", "quad"] = "triangle",
    closed: bool | None = None,
    pose: Literal["rigid", "similarity", "affine"] | None = "similarity",
    landmarks: Landmarks | None = None,
    tolerance_mm: float | None = None,
    most_faces: int = 10_000,
    on_stage: Callable[[str], None] | None = None,
    **options: Any,
) -> ScanFit:
    """Fit a scan from end to end.

    Args:
        scan: in mm.
        mesh: the template; default: a control mesh is made from the scan, see `control_mesh`.
        scheme: default: `js.Interpolating()`.
        levels: of refinement.
        faces, kind, closed: of the control mesh, where it is made; see `control_mesh`.
        pose: how the template may move to the scan before the fit, see `align`; None leaves it where it is.
        landmarks: places on scan and template, for the alignment and the fit; see `Landmarks`.
        tolerance_mm: split the control mesh by the scheme's own rule, and fit again, until the misfit (see `misfit`) is
            this small, or too small to be told from the noise, or the next split would make too many faces for
            `most_faces` or for two points a control vertex.
        most_faces: of the control mesh, where it is split.
        on_stage: told what begins, in a few words.
        options: of `fit`. Where `priors` ask for symmetry, the partners are found on the template as it is given.

    Raises:
        ScanError, ValueError, ImportError, RuntimeError: as `align`, `control_mesh` and `fit` do.
    """
    say = on_stage or (lambda words: None)
    scheme, alignment = scheme or js.Interpolating(), None
    given = mesh  # an affine pose leaves no mirror plane, and a fit no exact one
    if mesh is None:
        say(f"makes a control mesh of about {faces} faces")
        mesh = control_mesh(scan, faces=faces, kind=kind, closed=closed)
        if scheme.takes == (3,):
            mesh = mesh.triangulated()
    elif pose is not None:
        say("aligns the control mesh with the scan")
        alignment = align(mesh, scan, kind=pose, landmarks=landmarks)
        landmarks = None if landmarks is None else moved(landmarks, mesh, alignment)
        mesh = alignment.mesh
    priors, splits = options.get("priors"), 0
    while True:
        if priors is not None and np.isfinite(priors.symmetry) and given is not None and "symmetry" not in options:
            options["symmetry"] = find_symmetry(given)
        say(f"fits {len(mesh.vertices):,} control vertices")
        # Tables come from the faces alone; normals that would fold the surface are replaced in the fit.
        topology = js.build_topology(js.ControlMesh(mesh.vertices, mesh.faces), scheme, levels)
        control = mesh.control(weights=scheme.weights)
        if splits == 0 and not scheme.interpolates:
            control = js.Control(_swollen(mesh, scheme), control.normals)
        result = fit(scheme, topology, control, scan, landmarks=landmarks, **options)
        outcome = _outcome(result, mesh, tolerance_mm, most_faces)
        if tolerance_mm is None or outcome is not None:
            return ScanFit(result, mesh, alignment, splits, outcome)
        scheme, splits = result.scheme, splits + 1
        landmarks = None  # their places were those of the template
        options.pop("symmetry", None)  # and so were its partners
        mesh = _split(result.scheme, mesh, result.control)
        given = None if given is None else _split(result.scheme, given, given.control(weights=scheme.weights))


def misfit(result: FitResult) -> float:
    """How far the surface is off the scan beside the noise, root mean square in mm.

    Noise differs from point to point; what neighbouring points have in common is the surface's own error, or noise that
    they share. The square of this is the mean product of the signed distances of each inlier and the one next to it.
    """
    inliers = result.inliers
    points, distances = np.asarray(result.scan.points)[inliers], result.distances[inliers]
    if len(points) < 2:
        return 0.0
    _, nearest = nearest_rows(KDTree(points), points, 2)
    return float(np.sqrt(max(np.mean(distances * distances[nearest[:, 1]]), 0.0)))


def _outcome(result: FitResult, mesh: js.ControlMesh, tolerance_mm: float | None, most_faces: int) -> Outcome | None:
    if tolerance_mm is None:
        return None
    off = misfit(result)
    if off <= tolerance_mm:
        return "tolerance met"
    # Of few points the mean product is not 0 even where nothing is shared: two standard deviations of it.
    by_chance = 2 * result.noise**2 / result.inliers.sum() ** 0.5
    if off**2 <= (_LEAST_MISFIT * result.noise) ** 2 + by_chance:
        return "noise reached"
    too_many = 4 * mesh.n_faces > most_faces or 8 * len(mesh.vertices) > result.scan.n_points
    return "no more faces" if too_many else None


def _split(scheme: js.AbstractScheme, mesh: js.ControlMesh, control: js.Control) -> js.ControlMesh:
    """A control mesh of these faces, each cut in four by the scheme's rule: the same surface, with more to move."""
    if scheme.h is not None and scheme.h.ndim:  # one h a level: what is left of it serves the split mesh
        scheme = dataclasses.replace(scheme, h=scheme.h[:1])
    fitted = js.ControlMesh(control.vertices, mesh.faces, control.normals, check=False)
    finer = js.refine(scheme, js.build_topology(fitted, scheme, 1), control)
    return js.ControlMesh(finer.vertices, finer.faces, finer.normals if scheme.uses_normals else None)


def _swollen(mesh: js.ControlMesh, scheme: js.AbstractScheme) -> Float[np.ndarray, "v 3"]:
    """Control vertices whose limit surface, which shrinks from them, goes nearly through those of the mesh."""
    bare = js.ControlMesh(mesh.vertices, mesh.faces)
    limit = js.stencils(scheme, js.build_topology(bare, scheme, 0, limit=True))[: len(mesh.vertices)]
    vertices = mesh.vertices
    for _ in range(_SWELLINGS):  # not to the end: that would swell noise most of all
        vertices = vertices + (mesh.vertices - limit @ vertices)
    return vertices


def moved(landmarks: Landmarks, mesh: js.ControlMesh, alignment: Alignment) -> Landmarks:
    """Landmarks whose places on the template moved along with it."""
    on_mesh = np.asarray(landmarks.on_mesh)
    if on_mesh.ndim == 1:
        return landmarks
    to = alignment.transform
    return landmarks._replace(on_mesh=on_mesh @ to[:3, :3].T + to[:3, 3])
