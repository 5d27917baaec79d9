"""What one fit of the command starts from: its scan, template, landmarks, rim and regions."""

import argparse
import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxsubdiv as js
from jaxsubdiv.frames import Frame, convert_frame

from ..image.boundary import suggest_settings
from ..image.read import Seen, is_image, read_labels, read_scan, read_seen, read_volume, stem
from ..image.volume import Label
from ..model.priors.boundary import BoundaryCurve, boundary_of
from ..run.checkpoint import marks_of
from ..run.layers import LayeredScan, prepare_layers, scans_of_volume
from ..run.names import check_names, find_scans
from ..run.recipe import Recipe, find_fits, load
from ..scan.example import example
from ..scan.landmarks import FramedLandmarks, Landmarks, match_landmarks, read_framed_landmarks, read_landmarks
from ..scan.layers import read_layers
from ..scan.outside import choose_outside
from ..scan.regions import Groups, match_regions, read_groups
from ..scan.scan import Scan

_EXAMPLE_NOISE = 3.0  # mm: the example starts from a control mesh that is wrong, to show that the fit mends it


class Source(NamedTuple):
    """Where a scan comes from."""

    path: Path
    label: Label | str | None = None
    """Of a label map."""

    def title(self, whole: bool = False) -> str:
        """The file's name, or all of its path, and the label where it is one of all."""
        name = str(self.path) if whole else self.path.name
        return f"{name}, {self.label}" if isinstance(self.label, Label) else name

    @property
    def as_file(self) -> Path:
        """A file of the same name with the label in it, which tells its folder from those of other labels."""
        if self.label is None:
            return self.path
        word = str(self.label.name or self.label.value) if isinstance(self.label, Label) else self.label
        name = f"{stem(self.path)}_{word}"
        return self.path.with_name("".join(c if c.isalnum() or c in "-_ " else "_" for c in name))


class Job(NamedTuple):
    """One scan to fit."""

    name: str
    scan: Scan
    mesh: js.ControlMesh | None
    landmarks: Landmarks | None
    boundary: BoundaryCurve | None = None
    seen: Seen | None = None
    carried: FramedLandmarks | None = None
    """Places on the control mesh, to be carried to the fit."""
    regions: Groups | None = None
    layered: LayeredScan | None = None
    """Where several layers are fitted at once: scan and control mesh are those of all of them."""


def find_sources(options: argparse.Namespace) -> list[Source]:
    """Every scan of the files and folders that were named, one a label where all are asked for."""
    if options.label is not None and options.above is not None:
        raise ValueError("give --label, which is of a label map, or --above, of a grey image, not both.")
    sources: list[Source] = []
    for path in find_scans([Path(scan) for scan in options.scans]):
        if not is_image(path):
            sources.append(Source(path))
        elif options.label != "all":
            sources.append(Source(path, options.label))
        else:
            sources += [Source(path, label) for label in read_labels(path)]
    return sources


def read_inputs(scan: Source | None, options: argparse.Namespace, recipe: Recipe) -> Job:
    if scan is None:
        print(
            f"example  {options.example}, its control vertices moved by noise of {_EXAMPLE_NOISE:g} mm in each "
            "coordinate"
        )
        points, mesh = example(options.example)
        noise = np.random.default_rng(0).normal(scale=_EXAMPLE_NOISE, size=mesh.vertices.shape)
        return Job(options.example, points, js.ControlMesh(mesh.vertices + noise, mesh.faces, mesh.normals), None)
    file, seen = scan.path, None
    if options.layers is not None:
        return _read_layers(scan, options, recipe)
    if is_image(file) and not options.labels:
        seen = read_seen(file, scale=options.scale, label=scan.label, above=options.above)
        points = seen.scan
    else:
        points = read_scan(file, scale=options.scale, labels=options.labels, label=options.label, above=options.above)
    if options.outside:
        n = points.n_points
        points = choose_outside(points)
        print(f"outside  {points.n_points:,} of {n:,} points are seen from there")
    mesh, of_mesh = _read_template(options, recipe, points.frame)
    landmarks = carried = None
    if (options.landmarks is None) != (options.control_landmarks is None) or (options.landmarks and mesh is None):
        raise ValueError(
            "landmarks are places on both sides: give --landmarks FILE for the scan, --control-landmarks FILE for the "
            "control mesh, and --control MESH."
        )
    if options.landmarks is not None:
        landmarks = match_landmarks(
            read_landmarks(options.landmarks, scale=options.scale, frame=points.frame),
            read_landmarks(options.control_landmarks, scale=options.control_scale, frame=of_mesh),
        )
    if options.carry is not None:
        carried = read_framed_landmarks(options.carry, scale=options.control_scale, frame=of_mesh)
    if mesh is None:
        _refuse_without_template(options, "symmetry", "likeness")
    regions = None
    if options.regions is not None:
        if mesh is None:
            raise ValueError("regions are groups of a template's faces: give --control MESH to --regions.")
        regions = read_groups(options.regions)
    boundary = None
    if options.boundary == "scan":
        boundary = BoundaryCurve(boundary_of(js.read_mesh(file, scale=options.scale, check=False)))
    elif options.boundary is not None:
        boundary = BoundaryCurve(js.read_points(options.boundary, scale=options.scale).points)
    return Job(scan.title(), points, mesh, landmarks, boundary, seen, carried, regions)


def _read_layers(scan: Source, options: argparse.Namespace, recipe: Recipe) -> Job:
    """The layers that a file names, of a table with labels or of a label map."""
    layers, faces = read_layers(options.layers), recipe.faces
    check_names(list(layers), "layer")
    if options.control is None:
        _refuse_without_template(options, "symmetry", "likeness", "mirror")
    if is_image(scan.path):
        points = scans_of_volume(read_volume(scan.path, scale=options.scale), layers)
        frame, labels = next(iter(points.values())).frame, None
        if options.faces is None and options.recipe is None:
            faces = max(suggest_settings(one)["faces"] for one in points.values())
    else:
        points = read_scan(scan.path, scale=options.scale)
        frame, labels = points.frame, layers
    mesh = None if options.control is None else _read_template(options, recipe, frame)[0]
    how = {"kind": recipe.kind, "closed": recipe.closed, "part": recipe.part}
    layered = prepare_layers(points, mesh, labels, faces=faces, **how)
    return Job(scan.title(), layered.scan, layered.mesh, None, layered=layered)


def _refuse_without_template(options: argparse.Namespace, *names: str) -> None:
    for name in names:
        if getattr(options, name) not in (None, False):
            raise ValueError(f"{name} is that of a template: give --control MESH to --{name}.")


def _read_template(
    options: argparse.Namespace, recipe: Recipe, of_scan: Frame | None
) -> tuple[js.ControlMesh | None, Frame | None]:
    """The template in the frame of the scan where both files say theirs, and the frame that it is in."""
    if options.control is None:
        return (None, None) if options.prior is None else (_mean_of_family(Path(options.prior), recipe), of_scan)
    mesh, own = js.read_mesh(options.control, scale=options.control_scale), js.read_frame(options.control)
    if own is None:  # a template that stays where it is lies in the frame of the scan
        return mesh, of_scan if recipe.pose is None else None
    if of_scan is None or own == of_scan:
        return mesh, own
    print(f"note     the control mesh was turned from {own}, as its file says, to the scan's {of_scan}")
    normals = None if mesh.normals is None else convert_frame(mesh.normals, own, of_scan)
    turned = convert_frame(mesh.vertices, own, of_scan)
    return js.ControlMesh(turned, mesh.faces, normals, regions=mesh.regions), of_scan


def _mean_of_family(folder: Path, recipe: Recipe) -> js.ControlMesh:
    """The mean of the fits in a folder, as a template."""
    one, shape = load(folder / find_fits(folder)[0]).control_mesh, recipe.priors.shape
    assert shape is not None
    return js.ControlMesh(np.asarray(shape.mean, np.float64), one.faces, regions=one.regions)


def suggest_for_image(recipe: Recipe, scan: Scan, options: argparse.Namespace) -> Recipe:
    """What suits an image, where neither the options nor a recipe say otherwise."""
    given = {"faces": options.faces, "most_points": options.points}
    if options.recipe is not None:
        return recipe
    return dataclasses.replace(
        recipe, **{name: value for name, value in suggest_settings(scan).items() if given[name] is None}
    )


def mark_job(job: Job, recipe: Recipe, options: argparse.Namespace) -> dict[str, str]:
    """What tells this fit from any other, by the names of what went in."""
    inputs = {f"{name} of the scan": value for name, value in vars(job.scan).items() if name != "regions"}
    if job.mesh is not None and (match := match_regions(job.scan, job.mesh, job.regions)) is not None:
        inputs["regions"] = match, job.scan.regions  # labels that no fit looks at are none of its inputs
    inputs["control mesh"] = None if job.mesh is None else (job.mesh.vertices, job.mesh.faces, job.mesh.normals)
    inputs |= {"landmarks": job.landmarks, "boundary": job.boundary}
    inputs |= {} if job.layered is None else {"layers": job.layered.names}
    inputs |= {} if job.carried is None else {"carried landmarks": job.carried}
    inputs |= {"details": True} if options.details else {}
    if (options.surface, options.surface_level) != (["ply"], None):
        inputs["surface format or level"] = options.surface, options.surface_level
    for name in ("surface_tolerance", "tetrahedra", "patches"):
        inputs |= {} if getattr(options, name) is None else {name.replace("_", " "): getattr(options, name)}
    return marks_of(inputs | {field.name: getattr(recipe, field.name) for field in dataclasses.fields(recipe)})
