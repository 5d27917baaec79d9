"""A template from many scans that lie anywhere, which the first of them has no more part in than the others."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import jaxsubdiv as js

from ..model.priors import Priors
from ..model.priors.symmetry import find_symmetry
from ..scan.landmarks import match_landmarks
from ..scan.scan import Scan
from ..start.align import align
from ..start.control_mesh import FaceKind, control_mesh
from ..start.symmetric_mesh import make_symmetric
from .cohort import fit_cohort
from .fit_scan import first_control, move_landmarks
from .regroup import Template, refuse_of_one_cohort, regroup


def make_template(
    scans: Sequence[Scan],
    *,
    faces: int = 500,
    kind: FaceKind = "triangle",
    closed: bool | None = None,
    symmetric: bool = False,
    first: int = 0,
    rounds: int = 6,
    landmarks: Sequence[Mapping[str, ArrayLike]] | None = None,
    scheme: js.AbstractScheme | None = None,
    levels: int = 1,
    on_stage: Callable[[str], None] | None = None,
    **options: Any,
) -> Template:
    """Make a template of scans: the control mesh of one, aligned with and fitted to all, and then `regroup`.

    Args:
        scans: in mm, of two subjects or more, each of the whole anatomy.
        faces, kind, closed: of the control mesh, see `control_mesh`.
        symmetric: give the template a mirror plane, about which every vertex has a partner, and keep every mean
            symmetric about it. The mesh is then of triangles.
        first: the scan that the control mesh is made from.
        rounds: how many means are taken at most.
        landmarks: of each scan its positions in mm by name, for alignment and fits, as far as the first scan has them.
        scheme, levels: of the fits; default: `js.Interpolating()`.
        on_stage: told what begins, in a few words.
        options: of `fit_cohort`.

    Raises:
        ValueError: fewer than two scans, or landmarks of more or fewer; or the mesh has no mirror plane.
        ScanError: as `control_mesh`, `align` and `fit_cohort` do.
    """
    refuse_of_one_cohort(options)
    say = on_stage or (lambda words: None)
    if len(scans) < 2 or (landmarks is not None and len(landmarks) != len(scans)):
        n = "none" if landmarks is None else len(landmarks)
        raise ValueError(f"a template needs two scans or more, and landmarks of all or none; got {len(scans)} and {n}.")
    scheme = scheme or js.Interpolating()
    say(f"makes a control mesh of scan {first}")
    mesh = control_mesh(scans[first], faces=faces, kind="triangle" if symmetric else kind, closed=closed)
    mesh = make_symmetric(mesh) if symmetric else mesh.triangulate() if scheme.takes == (3,) else mesh
    partners = find_symmetry(mesh) if symmetric else None
    topology = js.build_topology(js.ControlMesh(mesh.vertices, mesh.faces), scheme, levels)
    places = None if landmarks is None else [match_landmarks(own, landmarks[first]) for own in landmarks]
    say(f"aligns it with {len(scans)} scans")
    found = [align(mesh, scan, landmarks=None if places is None else places[i]) for i, scan in enumerate(scans)]
    if places is not None:
        places = [move_landmarks(own, mesh, one) for own, one in zip(places, found, strict=True)]
    say("fits all")
    priors = options.pop("priors", None) or Priors()
    # Made from the first scan, the control mesh has its noise: that is not expected of any.
    unlike = dataclasses.replace(priors, likeness=jnp.zeros(()), shape=None)
    own: dict[str, Any] = options | (
        {} if partners is None or not np.isfinite(priors.symmetry) else {"symmetry": partners}
    )
    controls = [first_control(one.mesh, scheme) for one in found]
    cohort = fit_cohort(scheme, topology, controls, scans, landmarks=places, priors=unlike, **own)
    return regroup(cohort, rounds=rounds, priors=priors, symmetry=partners, on_stage=on_stage, **options)
