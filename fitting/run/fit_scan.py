"""From a scan alone, or with a template, to a fit: align or make the control mesh, fit, split where it is coarse."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

import jaxsubdiv as js

from ..finding import Origin
from ..model.limits import check_numbers
from ..model.priors import Priors
from ..model.priors.shape_modes import ShapeModes
from ..model.priors.symmetry import Symmetry, find_symmetry
from ..model.recipe import Settings
from ..report.result import FitResult
from ..scan.closest_points import closest_points, nearest_rows
from ..scan.landmarks import Landmarks
from ..scan.regions import Groups, match_regions
from ..scan.scan import Scan
from ..start.align import Alignment, Kind, align, mirror_image, place_mesh
from ..start.control_mesh import FaceKind, make_control_mesh
from ..start.family import flat_surface, place_member
from ..start.parts import PartKind
from .checkpoint import Checkpoint
from .fit import CHECKPOINT, check, fit
from .memory import memory_of_fit
from .sizes import check_sizes

Outcome: TypeAlias = Literal["tolerance met", "noise reached", "no more faces"]

# Misfit that is a smaller part of the noise than this does not show beside it.
_LEAST_MISFIT = 0.15
_SWELLINGS = 3
CHECKPOINT_START = "checkpoint_start.npz"


class ScanFit(NamedTuple):
    """A fit, and how it came about."""

    result: FitResult
    start: js.ControlMesh
    """Control mesh where the last fit started: aligned, or made from the scan, or split."""
    alignment: Alignment | None
    """None where the control mesh was made from the scan, or was not to be aligned. Of the template's mirror image,
    where that was fitted."""
    splits: int
    """How many times the control mesh was split into four times its faces."""
    outcome: Outcome | None
    """Why no further split was made; None where no tolerance was asked for."""


class _Start(NamedTuple):
    """Where a fit starts."""

    mesh: js.ControlMesh
    scheme: js.AbstractScheme
    alignment: Alignment | None
    splits: int
    origin: Origin
    unseen: Bool[np.ndarray, "f"] | None = None
    """Control faces without scan points, of a mesh that was split; None before."""
    shown: Bool[np.ndarray, "p"] | None = None
    """Points that do not lie on parts of the scan that were left out; None is all."""


def fit_scan(
    scan: Scan,
    mesh: js.ControlMesh | None = None,
    *,
    scheme: js.AbstractScheme | None = None,
    levels: int = Settings.levels,
    faces: int = Settings.faces,
    kind: FaceKind = Settings.kind,
    closed: bool | None = Settings.closed,
    part: PartKind | None = Settings.part,
    pose: Kind | None = Settings.pose,
    mirror: bool = Settings.mirror,
    landmarks: Landmarks | None = None,
    regions: Groups | None = None,
    tolerance_mm: float | None = Settings.tolerance_mm,
    most_faces: int = Settings.most_faces,
    most_points: int | None = Settings.most_points,
    on_stage: Callable[[str], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    keep_checkpoint: bool = False,
    **options: Any,
) -> ScanFit:
    """Fit a scan from end to end.

    Args:
        scan: in mm.
        mesh: the template; default: a control mesh is made from the scan, see `control_mesh`.
        scheme: default: `js.Interpolating()`.
        levels: of refinement, see `Recipe`.
        faces, kind, closed, part: of the control mesh, where it is made; see `control_mesh`. Points of the scan on
            parts that are left out are not fitted.
        pose: how the template may move to the scan before the fit, see `align`; None leaves it where it is. Where
            `priors` have a shape, and the scheme interpolates, the fit then starts from the member of the family that
            the scan shows, see `ShapeModes`.
        mirror: take the template's mirror image, which serves the other side of the body.
        landmarks: places on scan and template, for the alignment and the fit; see `Landmarks`.
        regions: where the template has groups of faces, and the scan labels: the group, or groups, that points of a
            label are paired within, None for any face, before what the names say; see `match_regions`. Points of labels
            that are no group's are paired with any face. The alignment does not look at regions.
        tolerance_mm: split the control mesh by the scheme's own rule, and fit again, until the misfit (see `misfit`) is
            this small, or too small to be told from the noise, or the next split would make too many faces for
            `most_faces` or for two points a control vertex. Where a split mesh has no scan points it is expected to
            stay as it was, whatever the priors say of likeness.
        most_faces: of the control mesh, where it is split.
        most_points: fit no more than so many of the points, drawn at random, and measure them all then. Default: all.
        on_stage: told what begins, in a few words.
        checkpoint: a folder from which a call with the same arguments goes on where it was stopped, see `fit`; where
            the fit started is in it too, in `checkpoint_start.npz`.
        keep_checkpoint: leave both files when the fit has ended, see `fit`.
        options: of `fit`; or `mesh_normals` and `limit`, of `js.build_topology`. Where `priors` ask for symmetry, the
            partners are found on the template as it is given.

    Raises:
        ValueError: a number is out of its range; the priors ask for likeness, or `mirror` for a mirror image, and there
            is no template; or `mirror` is given without a pose.
        ScanError, ValueError, ImportError, RuntimeError: as `align`, `control_mesh` and `fit` do.
    """
    if mesh is None and regions:
        raise ValueError("`regions` are groups of a template's faces, and there is none: give one, or leave them out.")
    # Before anything is computed: what cannot be matched is told at once.
    match = None if mesh is None else match_regions(scan, mesh, regions)
    numbers = {"levels": levels, "faces": faces, "tolerance_mm": tolerance_mm, "most_faces": most_faces}
    numbers |= {"most_points": most_points}
    numbers |= {name: options[name] for name in ("max_sweeps", "tolerance", "landmark_deviation") if name in options}
    check_numbers(numbers)
    check_sizes(scan, mesh)
    priors = options.pop("priors", None) or Priors()
    if mesh is None and priors.likeness is not None and priors.likeness > 0:
        raise ValueError("`Priors.likeness` is to a template, and there is none: give one, or leave the likeness out.")
    # A mesh made from the scan would be found to be very like it, with all of its noise.
    options["priors"] = dataclasses.replace(priors, likeness=0.0) if mesh is None else priors
    say = on_stage or (lambda words: None)
    first = scheme or js.Interpolating()
    of_tables = {name: options.pop(name) for name in ("mesh_normals", "limit") if name in options}
    settings = {"faces": faces, "kind": kind, "closed": closed, "part": part, "pose": pose, "mirror": mirror}
    settings |= {"tolerance_mm": tolerance_mm, "most_faces": most_faces, "most_points": most_points}
    if mirror:
        if mesh is None:
            raise ValueError("`mirror` is of a template, and there is none: give one, or leave `mirror` out.")
        if pose is None:
            raise ValueError("`mirror` takes the template out of its place: let it be aligned by a `pose`.")
        mesh, landmarks = mirror_image(mesh, landmarks)
    kept = before = None
    if checkpoint is not None:
        template = None if mesh is None else (mesh.vertices, mesh.faces, mesh.normals, match)
        inputs = {"scan": scan, "mesh": template, "scheme": first, "levels": levels, "landmarks": landmarks}
        inputs |= {name: value for name, value in options.items() if name not in ("throw", "on_sweep")}
        kept = Checkpoint(Path(checkpoint) / CHECKPOINT_START, inputs | settings | of_tables)
        before = kept.read()
    if before is not None:
        say("goes on where it was stopped")
        try:
            start = _restore_start(before, first, mesh)
        except (KeyError, ValueError, TypeError) as error:
            where = Path(checkpoint or "") / CHECKPOINT_START
            raise ValueError(f"{where} is no checkpoint of a start: {error}. Delete it to start anew.") from None
    elif mesh is None:
        say(f"makes a control mesh of about {faces} faces")
        made = make_control_mesh(scan, faces=faces, kind=kind, closed=closed, part=part)
        origin = Origin(None, made.findings)
        mesh_made = made.mesh.triangulate() if first.takes == (3,) else made.mesh
        start = _Start(mesh_made, first, None, 0, origin, shown=None if made.shown.all() else made.shown)
    elif pose is not None:
        say("aligns the control mesh with the scan")
        alignment = align(mesh, scan, kind=pose, landmarks=landmarks)
        there = alignment.mesh
        if priors.shape is not None and first.interpolates:
            say("looks for the member of the family that the scan shows")
            there = _member(priors.shape, there, scan)
        start = _Start(there, first, alignment, 0, Origin(alignment.pose, alignment.doubts))
    else:
        start = _Start(mesh, first, None, 0, Origin())
    own_partners = options.pop("symmetry", None)
    whole = scan if start.shown is None else scan.rows(start.shown)
    scan = whole if most_points is None else whole.draw(most_points)
    while True:
        # Tables come from the faces alone; normals that would fold the surface are replaced in the fit.
        bare = js.ControlMesh(start.mesh.vertices, start.mesh.faces)
        topology = js.build_topology(bare, start.scheme, levels, **of_tables)
        memory = memory_of_fit(topology, scan.n_points) / 1e9
        say(f"fits {len(start.mesh.vertices):,} control vertices, in about {memory:.1f} GB of memory")
        control = start.mesh.control(weights=first.weights) if start.splits else first_control(start.mesh, first)
        if kept is not None:
            check(start.scheme, topology, control, scan)  # what cannot be fitted leaves no file
            kept.write(_arrays(start))
        # The landmarks' places were those of the template.
        of_first = _place_landmarks(landmarks, mesh, start) if start.splits == 0 else None
        partners = own_partners if start.splits == 0 else None
        if partners is None and mesh is not None and np.isfinite(priors.symmetry):
            partners = _partners(mesh, first, start.splits)
        here = {
            "landmarks": of_first,
            "symmetry": partners,
            "regions": match_regions(scan, start.mesh, regions),
            "checkpoint": checkpoint,
            "keep_checkpoint": keep_checkpoint,
        }
        if start.unseen is not None:
            # Holes stay as they were filled; elsewhere the noise of the scan, which is in the fit now, is not expected.
            here |= {"alike": start.unseen, "priors": dataclasses.replace(priors, likeness=1.0)}
        result = fit(start.scheme, topology, control, scan, **(options | here))
        outcome = _outcome(result, start.mesh, tolerance_mm, most_faces)
        if tolerance_mm is None or outcome is not None:
            break
        finer = split(result.scheme, start.mesh, result.control)
        unseen = np.zeros(finer.n_faces, bool)
        if js.splits_in_four(result.scheme, topology):
            unseen = np.repeat(~_has_points(result), 4)
        start = _Start(finer, result.scheme, start.alignment, start.splits + 1, start.origin, unseen, start.shown)
        if checkpoint is not None:
            (Path(checkpoint) / CHECKPOINT).unlink(missing_ok=True)  # that of the fit before the split
    if kept is not None and not keep_checkpoint:
        kept.remove()
    if scan is not whole:
        say(f"measures all {whole.n_points:,} points")
        result = result.compare_with(whole)
    recipe = dataclasses.replace(result.recipe, scheme=first, priors=priors, **settings)
    result = FitResult(dataclasses.replace(result.fit, origin=start.origin), recipe=recipe)
    return ScanFit(result, start.mesh, start.alignment, start.splits, outcome)


def _has_points(result: FitResult) -> Bool[np.ndarray, "f"]:
    """Control faces that the scan has points on."""
    topology, counted = result.fit.topology, result.inliers & (result.weights > 0)
    owner = js.control_faces_of(result.scheme, topology, result.surface, result.control)
    return np.bincount(owner[np.asarray(result.at.face)[counted]], minlength=owner.max() + 1) > 0


def _partners(template: js.ControlMesh, scheme: js.AbstractScheme, splits: int) -> Symmetry:
    """On the template as it is given: an affine pose leaves no mirror plane, and a fit no exact one."""
    for _ in range(splits):
        template = split(scheme, template, template.control(weights=scheme.weights))
    return find_symmetry(template)


def _place_landmarks(landmarks: Landmarks | None, mesh: js.ControlMesh | None, start: _Start) -> Landmarks | None:
    if landmarks is None or mesh is None or start.alignment is None:
        return landmarks
    there = move_landmarks(landmarks, mesh, start.alignment)
    if start.mesh is start.alignment.mesh or np.ndim(there.on_mesh) == 1:
        return there
    # The mesh has another shape there: on its faces landmarks keep their places.
    before, after = (flat_surface(one.vertices, one.faces) for one in (start.alignment.mesh, start.mesh))
    at = closest_points(before, np.asarray(there.on_mesh))
    return there._replace(on_mesh=np.asarray(js.evaluate(after, at).points))


def _member(shape: ShapeModes, placed: js.ControlMesh, scan: Scan) -> js.ControlMesh:
    """The aligned template with the shape of the family's member that the scan shows; see `place_member`."""
    if len(shape.mean) != len(placed.vertices):
        return placed  # the fit tells what is wrong
    mean, modes = (np.asarray(rows, np.float64) for rows in (shape.mean, shape.modes * shape.deviations[:, None, None]))
    found = place_member(mean, modes, placed, scan)
    return js.ControlMesh(found.vertices, placed.faces, regions=placed.regions, check=False)


def _arrays(start: _Start) -> dict[str, Any]:
    """A start as a checkpoint keeps it; the mesh of the alignment follows from the rest."""
    mesh, alignment = start.mesh, start.alignment
    arrays = {"vertices": mesh.vertices, "triangles": mesh.faces[3], "quads": mesh.faces[4], "normals": mesh.normals}
    arrays |= {"h": start.scheme.h, "splits": start.splits, "unseen": start.unseen, "origin": start.origin.to_json()}
    arrays["shown"] = start.shown
    arrays["regions"] = None if mesh.regions is None else mesh.regions.rows
    if alignment is None:
        return arrays
    return arrays | {"transform": alignment.transform, "rms": alignment.rms, "share": alignment.share}


def _restore_start(arrays: dict[str, np.ndarray], scheme: js.AbstractScheme, template: js.ControlMesh | None) -> _Start:
    faces, regions = {3: arrays["triangles"], 4: arrays["quads"]}, None
    if template is not None and template.regions is not None:
        regions = js.Regions(arrays["regions"], template.regions.names)
    mesh = js.ControlMesh(arrays["vertices"], faces, arrays.get("normals"), check=False, regions=regions)
    if scheme.h is not None:
        scheme = eqx.tree_at(lambda s: s.h, scheme, jnp.asarray(arrays["h"]))
    alignment, origin = None, Origin.from_json(str(arrays["origin"]))
    if template is not None and "transform" in arrays and origin.pose is not None:
        numbers = float(arrays["rms"]), float(arrays["share"])
        there = place_mesh(template, arrays["transform"])
        alignment = Alignment(arrays["transform"], there, *numbers, origin.findings, origin.pose)
    return _Start(mesh, scheme, alignment, int(arrays["splits"]), origin, arrays.get("unseen"), arrays.get("shown"))


def misfit(result: FitResult) -> float:
    """How far the surface is off the scan beside the noise, root mean square in mm.

    Noise differs from point to point; what neighbouring points have in common is the surface's own error, or noise that
    they share. The square of this is the mean product of the signed distances of each inlier and the one next to it.
    `Uncertainty.misfit` has it place by place, and adds what the fit took of the noise.
    """
    inliers = result.inliers
    points, distances = result.points[inliers], result.distances[inliers]
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


def split(scheme: js.AbstractScheme, mesh: js.ControlMesh, control: js.Control) -> js.ControlMesh:
    """A control mesh of these faces, each cut in four by the scheme's rule: the same surface, with more to move."""
    if scheme.h is not None and scheme.h.ndim:  # one h a level: what is left of it serves the split mesh
        scheme = dataclasses.replace(scheme, h=scheme.h[:1])
    bare = js.ControlMesh(control.vertices, mesh.faces, check=False)
    topology, regions = js.build_topology(bare, scheme, 1), mesh.regions
    finer = js.refine(scheme, topology, control)
    if regions is not None:
        regions = regions.take(js.control_faces_of(scheme, topology, finer, control))
    normals = finer.normals if scheme.uses_normals else None
    return js.ControlMesh(finer.vertices, finer.faces, normals, regions=regions)


def first_control(mesh: js.ControlMesh, scheme: js.AbstractScheme) -> js.Control:
    """The control that a fit of a mesh starts from: the surface goes, nearly, through the vertices of the mesh."""
    control = mesh.control(weights=scheme.weights)
    return control if scheme.interpolates else js.Control(_swell(mesh, scheme), control.normals)


def _swell(mesh: js.ControlMesh, scheme: js.AbstractScheme) -> Float[np.ndarray, "v 3"]:
    """Control vertices whose limit surface, which shrinks from them, goes nearly through those of the mesh."""
    bare = js.ControlMesh(mesh.vertices, mesh.faces)
    limit = js.stencils(scheme, js.build_topology(bare, scheme, 0, limit=True))[: len(mesh.vertices)]
    vertices = mesh.vertices
    for _ in range(_SWELLINGS):  # not to the end: that would swell noise most of all
        vertices = vertices + (mesh.vertices - limit @ vertices)
    return vertices


def move_landmarks(landmarks: Landmarks, mesh: js.ControlMesh, alignment: Alignment) -> Landmarks:
    """Landmarks whose places on the template moved along with it."""
    on_mesh = np.asarray(landmarks.on_mesh)
    if on_mesh.ndim == 1:
        return landmarks
    to = alignment.transform
    return landmarks._replace(on_mesh=on_mesh @ to[:3, :3].T + to[:3, 3])
