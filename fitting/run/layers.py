"""`fit_layers`: several surfaces in one fit, such as lining and outside of a wall, or bone and cartilage."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

import jaxsubdiv as js

from ..finding import Finding, Origin
from ..image.boundary import scan_of_label
from ..image.volume import Volume, choose_label
from ..model.priors import Priors
from ..model.recipe import Settings
from ..report.layers import LayersFit
from ..report.result import FitResult
from ..scan.layers import LayerLabels, join_scans, part_scan, stack_meshes
from ..scan.scan import Scan, ScanError
from ..start.control_mesh import FaceKind, make_control_mesh
from ..start.parts import PartKind
from .fit_scan import ScanFit
from .recipe import fit_scan


class LayeredScan(NamedTuple):
    """What a fit of layers starts from: made by `prepare_layers`."""

    scan: Scan
    """Of the points of all layers, labelled by their names."""
    mesh: js.ControlMesh
    """Of all layers, a region each."""
    names: tuple[str, ...]
    is_made: bool
    """Whether the control mesh was made from the scan, and so is in place."""
    findings: tuple[Finding, ...] = ()
    """What speaks against it."""

    def options(self, priors: Priors) -> dict[str, Any]:
        """Those of `fit_scan` that follow."""
        own = {"layers": self.names, "regions": {name: name for name in self.names}, "priors": priors}
        if not self.is_made:
            return own
        # A mesh made from the scan would be found to be very like it, with all of its noise.
        return own | {"pose": None, "mirror": False, "priors": dataclasses.replace(priors, likeness=0.0)}

    def judge(self, found: ScanFit) -> ScanFit:
        """A fit of this with what speaks against where it started."""
        if not self.findings:
            return found
        fit = found.result.fit
        origin = Origin(fit.origin.pose, (*fit.origin.findings, *self.findings))
        again = FitResult(dataclasses.replace(fit, origin=origin), recipe=found.result.recipe)
        return found._replace(result=again)


def fit_layers(
    scan: Scan | Mapping[str, Scan],
    mesh: js.ControlMesh | Mapping[str, js.ControlMesh] | None = None,
    *,
    layers: LayerLabels | None = None,
    faces: int = Settings.faces,
    kind: FaceKind = Settings.kind,
    closed: bool | None = Settings.closed,
    part: PartKind | None = Settings.part,
    priors: Priors | None = None,
    **options: Any,
) -> LayersFit:
    """Fit several layers at once, such as lining and outside of a wall, or bone and cartilage.

    The control meshes of all layers are one, with a region each. Points are paired with their own layer alone. Where
    they are missing, what lies between two layers is as thick as it is beside there; how closely, the scan says (see
    `Priors.thickness`).

    Args:
        scan: one whose labels tell the layers apart, or one for each layer, in mm.
        mesh: the template: one for each layer; one with groups named as the layers are; or one without groups, of which
            every layer gets a copy. Default: a control mesh is made for each layer from its own points.
        layers: the labels of each layer's points, by its name, from the inside out; points of other labels are left
            out. Default: every label is a layer, in the order of their names.
        faces, kind, closed, part: of the control mesh of each layer, where it is made; see `control_mesh`.
        priors: as in `fit`.
        options: more of `fit_scan`; the template of all layers is aligned as one.

    Raises:
        ScanError: the scan has no labels, none of a layer's, or fewer than two layers.
        ValueError: there are other layers than control meshes.
        ScanError, ValueError, ImportError, RuntimeError: as `fit_scan` does.
    """
    layered = prepare_layers(scan, mesh, layers, faces=faces, kind=kind, closed=closed, part=part)
    own = options | layered.options(priors or Priors())
    return LayersFit(layered.judge(fit_scan(layered.scan, layered.mesh, **own)).result)


def prepare_layers(
    scan: Scan | Mapping[str, Scan],
    mesh: js.ControlMesh | Mapping[str, js.ControlMesh] | None,
    layers: LayerLabels | None,
    *,
    faces: int,
    kind: FaceKind,
    closed: bool | None,
    part: PartKind | None,
) -> LayeredScan:
    """Scan and control mesh of all layers; the arguments are those of `fit_layers`."""
    if isinstance(scan, Scan):
        scans = part_scan(scan, layers)
    else:
        scans = dict(scan)
        if layers is not None:
            raise ValueError("`layers` tell labels of one scan apart: leave them out where there is a scan for each.")
    names = tuple(scans)
    if len(names) < 2:
        raise ScanError(f"there are two layers or more; got {', '.join(names) or 'none'}. Fit one by `fit_scan`.")
    if mesh is None:
        made = {
            name: make_control_mesh(own, faces=faces, kind=kind, closed=closed, part=part)
            for name, own in scans.items()
        }
        shown = {name: scans[name].rows(np.flatnonzero(own.shown)) for name, own in made.items()}
        findings = tuple({finding.text: finding for own in made.values() for finding in own.findings}.values())
        stacked = stack_meshes({name: own.mesh for name, own in made.items()})
        return LayeredScan(join_scans(shown), stacked, names, True, findings)
    joined = join_scans(scans)
    if isinstance(mesh, js.ControlMesh):
        if mesh.regions is None:
            return LayeredScan(joined, stack_meshes(dict.fromkeys(names, mesh)), names, False)
        _refuse_others(mesh.regions.names, names, "groups of the control mesh")
        return LayeredScan(joined, mesh, names, False)
    _refuse_others(tuple(mesh), names, "control meshes")
    return LayeredScan(joined, stack_meshes({name: mesh[name] for name in names}), names, False)


def scans_of_volume(volume: Volume, layers: LayerLabels) -> dict[str, Scan]:
    """The boundary of each layer in a label map: of all its labels together.

    A layer has the labels of all that lies inside of it: `{"bone": "femur", "cartilage": ["femur", "cartilage"]}`.
    Such scans have many points; `fit_layers(..., most_points=40_000)` fits a part of them.

    Raises:
        ScanError: there is no such label; see `choose_label` and `scan_of_label`.
    """
    return {
        name: scan_of_label(
            volume, [choose_label(volume, one) for one in ([labels] if isinstance(labels, str) else labels)]
        )
        for name, labels in layers.items()
    }


def _refuse_others(there: tuple[str, ...], names: tuple[str, ...], what: str) -> None:
    lost = [name for name in names if name not in there]
    if lost:
        raise ValueError(f"the layer '{lost[0]}' is none of the {what}, which are {', '.join(there)}.")
