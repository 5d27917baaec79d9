"""A fit as a folder, and back."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

import jaxsubdiv as js
from jaxsubdiv.archives import read_arrays
from jaxsubdiv.files import replace_file
from jaxsubdiv.frames import Frame

from ..finding import Origin
from ..model.pairing import Look, make_scene
from ..model.priors.boundary import BoundaryCurve
from ..model.priors.landmarks import Anchors
from ..model.priors.shifts import SlicePlanes, find_slice_planes
from ..model.priors.symmetry import symmetry_of
from ..model.priors.valves import ValvePoints
from ..model.recipe import Settings
from ..model.residual import Model, Pairs, analyse
from ..model.unknowns import Variables
from ..scan.frames import Frames
from ..scan.regions import RegionMatch
from ..scan.scan import Scan
from ..solve.strengths import Strengths
from ..solve.sweeps import shift_points
from .record import Fit, choose_faces

_VERSIONS = (3, 4)  # 1 had no likeness, 2 not what held the unknowns; 4 has strengths and shared unknowns by name
_FIT, _RECIPE = "fit.npz", "recipe.json"
_ENDS = ("successful", "nonlinear_max_steps_reached", "nonlinear_divergence", "nonfinite")
_OF_SCAN = ("points", "normals", "weights", "deviations", "slices")
_MOST_FACES = 1 << 23  # of a refined surface; a fit of as many takes 25 GB
_OF_SERIES: dict[str, Any] = {"frames": Frames, "valves": ValvePoints, "slices": SlicePlanes}
_A_POINT = ("face", "uv", "directions", "distances", "weights", "precisions")


def save_fit(
    folder: str | os.PathLike[str], fit: Fit, recipe: Settings, marks: Mapping[str, str] | None = None
) -> None:
    """Write `fit.npz`, all that `load_fit` needs, and `recipe.json`, the settings in words; see `FitResult.save`.

    Args:
        folder: made where there is none.
        fit: what was found.
        recipe: the settings.
        marks: of all that went into the fit, for `read_marks`.
    """
    text, topology, look = recipe.to_json(), fit.topology, fit.look
    own = fit.settings.to_json()
    again = fit.settings.topology(js.ControlMesh(fit.model.template, topology.control_faces))
    if not eqx.tree_equal(again, topology):
        raise ValueError(
            "the fit's topology is not what `build_topology` makes of its control faces: fits with creases cannot be "
            "saved yet. Write the control mesh with `js.write_mesh(path, result.control_mesh)`."
        )
    arrays: dict[str, Any] = {
        "version": _VERSIONS[-1],
        "recipe": text,
        "settings": own,
        "origin": fit.origin.to_json(),
        "result": next(name for name in _ENDS if bool(fit.result == getattr(optx.RESULTS, name))),
        "control_vertices": fit.y.control.vertices,
        "control_normals": fit.y.control.normals,
        "start_normals": fit.start.normals,
        "template": fit.model.template,
        "determined": fit.strengths.determined,
        "annealed": fit.strengths.annealed,
        "hold": fit.hold,
        "shifting": fit.shifting,
        "triangles": topology.control_faces[3],
        "quads": topology.control_faces[4],
        "face": look.at.face,
        "uv": look.at.uv,
        "directions": look.pairs.directions,
        "distances": look.distances,
        "weights": look.weights,
        "precisions": look.precisions,
        "noise": look.noise,
        "scale": look.scale,
        "rms": fit.rms,
        "robust_rms": fit.robust_rms,
    }
    arrays |= {f"strength_{name}": value for name, value in fit.strengths.values.items()}
    arrays |= {f"shared_{name}": value for name, value in fit.y.shared.items()}
    for name in _OF_SCAN:
        arrays[f"scan_{name}"] = getattr(fit.scan, name)
    arrays["frame"] = fit.scan.frame
    arrays |= _arrays_of_regions(fit.scan.regions, fit.regions)
    inputs = fit.inputs
    arrays["alike"] = inputs.get("alike")
    arrays["layers"] = json.dumps(inputs["layers"]) if inputs.get("layers") else None
    arrays["marks"] = None if marks is None else json.dumps(marks)
    if inputs.get("landmarks") is not None:
        arrays |= {f"anchor_{name}": value for name, value in inputs["landmarks"]._asdict().items()}
    if inputs.get("symmetry") is not None:
        arrays["symmetry_partner"] = inputs["symmetry"].partner
    if inputs.get("boundary") is not None:
        arrays |= {f"boundary_{name}": value for name, value in inputs["boundary"]._asdict().items()}
    for name, kind in _OF_SERIES.items():
        if inputs.get("frames") is not None and inputs.get(name) is not None:
            arrays |= {f"{name}_{field}": getattr(inputs[name], field) for field in kind._fields}
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with replace_file(folder / _RECIPE) as path:
        path.write_text(text + "\n", encoding="utf-8")
    with replace_file(folder / _FIT) as path:  # last: where it is, all is
        as_numpy: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
        np.savez(path, **as_numpy)


def read_marks(folder: str | os.PathLike[str]) -> dict[str, str]:
    """Marks of all that went into the saved fit of a folder, as `save_fit` was given them; none where it was not.

    Raises:
        ValueError: the file is damaged; the text names it.
    """
    path = Path(folder) / _FIT
    try:
        marks = read_arrays(path, "marks".__eq__, text=True).get("marks")
        return {} if marks is None else json.loads(str(marks))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def load_fit(folder: str | os.PathLike[str]) -> tuple[Fit, str]:
    """The fit that `save_fit` wrote into a folder, and its recipe as JSON text; see `fitting.load`."""
    path = Path(folder) / _FIT
    if not path.is_file():
        raise FileNotFoundError(f"{folder} has no {_FIT}: it is not the folder of a fit that was saved.")
    try:
        arrays = _read(path)
        recipe = str(arrays["recipe"])
        Settings.from_json(recipe)  # what is wrong with it is told with the file
        with np.errstate(all="ignore"):  # numbers that are no fit's end in what is not finite
            return _restore(arrays), recipe
    except KeyError as error:
        raise ValueError(f"{path}: {error.args[0]!r} is missing: the file is not one of a saved fit.") from None
    except (ValueError, TypeError, IndexError, AttributeError, AssertionError, OverflowError, RecursionError) as error:
        # Arrays of other shapes than a fit has stop its mathematics in as many ways.
        raise ValueError(f"{path}: {error}") from None


def _read(path: Path) -> dict[str, np.ndarray]:
    arrays = {name: array for name, array in read_arrays(path, text=True).items() if array is not None}
    version = int(arrays["version"])
    if version not in _VERSIONS:
        what = "Update it" if version > _VERSIONS[-1] else f"Fit the scan again, by its {_RECIPE}"
        raise ValueError(f"a fit of version {version}, but this release reads version {_VERSIONS[-1]}. {what}.")
    n = len(arrays["scan_points"])
    for name in _A_POINT:
        if len(arrays[name]) != n:
            raise ValueError(f"{name!r} has {len(arrays[name])} rows for {n} scan points.")
    return arrays if version == _VERSIONS[-1] else _update(arrays)


def _update(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of version 3 as those of version 4, but for shifts, and for which faces' shape was expected."""
    arrays = dict(arrays)
    precision, n_faces = arrays.pop("bend_precision"), len(arrays["triangles"]) + len(arrays["quads"])
    arrays["strength_bend"] = precision[:n_faces]
    arrays["strength_likeness"] = arrays.pop("likeness")
    # The recipe was that of the whole fit of a scan, which fits a mesh made from the scan or split in its own way.
    settings = json.loads(str(arrays["recipe"]))
    priors = settings.setdefault("priors", {})
    if len(arrays["expected_rows"]):
        arrays["strength_height"] = precision[n_faces:]
    if not len(arrays["expected_rows"]) and not np.any(arrays["expected_bends"]):
        priors["likeness"] = 0.0
    elif priors.get("likeness") == 0:
        priors["likeness"] = 1.0
    if "h" in arrays:
        arrays["shared_h"] = arrays.pop("h")
        if np.shape(settings["scheme"].get("h", 1.0)) != arrays["shared_h"].shape:
            settings["scheme"]["h"] = arrays["shared_h"].tolist()
    arrays["settings"] = np.asarray(json.dumps(settings))
    arrays["shifting"] = np.asarray("shifts" in arrays)
    return arrays


def _expected_faces(arrays: dict[str, np.ndarray], model: Model) -> Bool[np.ndarray, "f"] | None:
    """The control faces whose shape a fit of version 3 expected; None where it was that of all, or of none."""
    bend: Any = model.prior("bend")
    if not np.any(np.asarray(bend.template)):
        return None
    told = arrays["expected_bends"] != 0
    told[arrays["expected_rows"]] = True
    n = model.topology.n_control_faces
    alike = (np.bincount(bend.of_rows, told, n) > 0) | (np.bincount(bend.of_rows, minlength=n) == 0)
    return None if alike.all() else alike


def _project_shifts(arrays: dict[str, np.ndarray], planes: SlicePlanes) -> Float[np.ndarray, "s 2"]:
    """The shifts of version 3, which are vectors, along the axes of their slices' planes."""
    if "shifts" not in arrays:
        return np.zeros((len(planes.numbers), 2))
    if not np.array_equal(planes.numbers, arrays["slices"]):
        raise ValueError("'slices' are not those of the scan that may move.")
    return np.einsum("sx,sjx->sj", arrays["shifts"], planes.planes)


def _frame_of(arrays: dict[str, np.ndarray]) -> Frame | None:
    frame = str(arrays["frame"]) if "frame" in arrays else None
    if frame not in ("RAS", "LPS", None):
        raise ValueError(f"'frame' is '{frame[:20]}', neither RAS nor LPS.")
    return frame


def _arrays_of_regions(of_scan: js.Regions | None, match: RegionMatch | None) -> dict[str, Any]:
    arrays = {}
    if of_scan is not None:
        arrays |= {"scan_regions": of_scan.rows, "scan_region_names": json.dumps(of_scan.names)}
    if match is not None:
        arrays |= {"face_regions": match.faces.rows, "face_region_names": json.dumps(match.faces.names)}
        arrays["region_groups"] = json.dumps(dict(match.groups))
    return arrays


def _regions_of(arrays: dict[str, np.ndarray], what: str) -> js.Regions | None:
    if f"{what}_regions" not in arrays:
        return None
    return js.Regions(arrays[f"{what}_regions"], json.loads(str(arrays[f"{what}_region_names"])))


def _match_of(arrays: dict[str, np.ndarray], n_faces: int) -> RegionMatch | None:
    faces = _regions_of(arrays, "face")
    if faces is None:
        return None
    if len(faces) != n_faces:
        raise ValueError(f"'face_regions' has {len(faces)} rows for {n_faces} control faces.")
    groups = json.loads(str(arrays["region_groups"]))
    return RegionMatch(faces, tuple((label, tuple(names)) for label, names in groups.items()))


def _restore(arrays: dict[str, np.ndarray]) -> Fit:
    def put_on_device(name: str) -> Array:
        values = arrays[name]
        return jnp.asarray(values, jnp.result_type(float) if values.dtype.kind == "f" else None)

    settings = Settings.from_json(str(arrays["settings"]))
    scheme, mesh = settings.scheme, js.ControlMesh(arrays["template"], {3: arrays["triangles"], 4: arrays["quads"]})
    if mesh.n_faces * 4 ** min(max(settings.levels, 0), 99) > _MOST_FACES:
        raise ValueError(f"{settings.levels} levels of {mesh.n_faces} faces are more than a fit has. It is damaged.")
    topology = settings.topology(mesh)
    start = js.Control(put_on_device("template"), put_on_device("start_normals"))
    of_points: dict[str, Any] = {name: arrays.get(f"scan_{name}") for name in _OF_SCAN}
    scan = Scan(**of_points, frame=_frame_of(arrays), regions=_regions_of(arrays, "scan"))
    inputs: dict[str, Any] = {"alike": arrays.get("alike"), "regions": _match_of(arrays, mesh.n_faces)}
    inputs["layers"] = tuple(json.loads(str(arrays["layers"]))) if "layers" in arrays else ()
    if "anchor_points" in arrays:
        inputs["landmarks"] = Anchors(*(put_on_device(f"anchor_{name}") for name in Anchors._fields))
    if "symmetry_partner" in arrays:
        inputs["symmetry"] = symmetry_of(arrays["symmetry_partner"], arrays["template"])
    if "boundary_points" in arrays:
        inputs["boundary"] = BoundaryCurve(arrays["boundary_points"], float(arrays["boundary_deviation"]))
    for name, kind in _OF_SERIES.items():
        if f"{name}_{kind._fields[0]}" in arrays:
            inputs[name] = kind(*(arrays[f"{name}_{field}"] for field in kind._fields))
    frames: Frames | None = inputs.get("frames")
    if frames is not None and frames.counts.sum() != scan.n_points:
        raise ValueError(f"'frames_counts' are of {frames.counts.sum()} points; the scan has {scan.n_points}.")
    if settings.free.shifts and frames is None:
        inputs["slices"] = find_slice_planes(scan)
    of_fit = scheme, topology, start, settings.free, settings.priors
    model, first = analyse(*of_fit, inputs)
    if int(arrays["version"]) == 3 and (alike := _expected_faces(arrays, model)) is not None:
        inputs["alike"] = alike
        model, first = analyse(*of_fit, inputs)
    if int(arrays["version"]) == 3 and "shifts" in first.shared:
        planes = inputs["slices"]
        assert planes is not None
        arrays["shared_shifts"] = _project_shifts(arrays, planes)
    shared = {name: put_on_device(f"shared_{name}") for name in first.shared}
    for name, value in shared.items():
        if value.shape != (usual := first.shared[name]).shape:
            raise ValueError(f"'shared_{name}' has the shape {list(value.shape)} and not {list(usual.shape)}.")
    y = Variables(js.Control(put_on_device("control_vertices"), put_on_device("control_normals")), shared)
    surface = model.refine(y)
    face = arrays["face"]
    if not ((face >= 0) & (face < surface.n_faces)).all():
        raise ValueError(f"'face' has rows of faces that there are not; the surface has {surface.n_faces}.")
    shifting = bool(arrays["shifting"])
    scene = make_scene(scan, surface, inputs.get("slices"), choose_faces(inputs["regions"], model, y, scan))
    points = scan.points
    if shifting and scene.of_points is not None:
        points = points + shift_points(model, y.shared["shifts"], scene.of_points).astype(points.dtype)
    at = js.SurfacePoint(face, put_on_device("uv"))
    rms, robust_rms = arrays["rms"], arrays["robust_rms"]
    look = Look(
        at=at,
        pairs=Pairs(points, *js.corner_weights(surface, at), put_on_device("directions")),
        distances=put_on_device("distances"),
        weights=put_on_device("weights"),
        precisions=put_on_device("precisions"),
        noise=put_on_device("noise"),
        scale=put_on_device("scale"),
        rms=jnp.asarray(rms[-1], jnp.result_type(float)),
        robust_rms=jnp.asarray(robust_rms[-1], jnp.result_type(float)),
    )
    values = {prior.name: arrays[f"strength_{prior.name}"] for prior in model.priors if prior.n_strengths}
    values["likeness"] = arrays["strength_likeness"]
    hold = np.zeros(model.layout.n)
    hold[: len(arrays["hold"])] = arrays["hold"]
    return Fit(
        model=model,
        y=y,
        scene=scene,
        look=jax.tree.map(np.asarray, look),
        strengths=Strengths(values, np.asarray(arrays["determined"]), np.asarray(arrays["annealed"])),
        hold=hold,
        shifting=shifting,
        scan=scan,
        start=start,
        inputs=inputs,
        settings=settings,
        rms=rms,
        robust_rms=robust_rms,
        result=getattr(optx.RESULTS, str(arrays["result"])),
        origin=Origin.from_json(str(arrays["origin"])) if "origin" in arrays else Origin(),
    )
