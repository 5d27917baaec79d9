"""A fit as a folder, and back."""

import os
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

import jaxsubdiv as js
from jaxsubdiv import corner_weights
from jaxsubdiv.files import replacing

from ..model.pairing import Look
from ..model.priors.boundary import BoundaryCurve
from ..model.priors.shifts import find_shifts
from ..model.priors.symmetry import symmetry_of
from ..model.recipe import Recipe
from ..model.residual import Anchors, Expected, Pairs
from ..scan.scan import Scan
from ..solve.problem import Found, Problem
from .result import FitResult

_VERSION = 3  # 1 had no likeness, 2 not what held the unknowns
_FIT, _RECIPE = "fit.npz", "recipe.json"
_ENDS = ("successful", "nonlinear_max_steps_reached", "nonlinear_divergence", "nonfinite")
_A_POINT = ("face", "uv", "directions", "distances", "weights", "precisions")


def save(folder: str | os.PathLike[str], result: FitResult) -> None:
    """Write `fit.npz`, all that `load` needs, and `recipe.json`, the settings in words; see `FitResult.save`."""
    recipe, start, problem, seen, scan = result.recipe, result.start, result._problem, result._seen, result.scan
    if recipe is None or start is None:
        raise ValueError("this fit does not know its settings: only what `fit` returned can be saved.")
    text, found, topology = recipe.to_json(), problem.found(), problem.topology
    again = recipe.topology(js.ControlMesh(found.template, topology.control_faces))
    if not eqx.tree_equal(again, topology):
        raise ValueError(
            "the fit's topology is not what `build_topology` makes of its control faces: fits with creases cannot be "
            "saved yet. Write the control mesh with `js.write_mesh(path, result.control_mesh)`."
        )
    arrays: dict[str, Any] = {
        "version": _VERSION,
        "recipe": text,
        "result": next(name for name in _ENDS if bool(result.result == getattr(optx.RESULTS, name))),
        "control_vertices": result.control.vertices,
        "control_normals": result.control.normals,
        "start_normals": start.normals,
        "template": found.template,
        "bend_precision": found.bend_precision,
        "likeness": found.likeness,
        "determined": found.determined,
        "annealed": found.annealed,
        "hold": found.hold,
        "triangles": topology.control_faces[3],
        "quads": topology.control_faces[4],
        "face": seen.at.face,
        "uv": seen.at.uv,
        "directions": seen.pairs.directions,
        "distances": seen.distances,
        "weights": seen.weights,
        "precisions": seen.precisions,
        "noise": seen.noise,
        "scale": seen.scale,
        "rms": result.rms,
        "robust_rms": result.robust_rms,
    }
    arrays |= {f"expected_{name}": value for name, value in found.expected._asdict().items()}
    optional = {"h": result.scheme.h} | {f"scan_{name}": value for name, value in vars(scan).items()}
    if result._shifts is not None:
        optional |= {"slices": result.slices, "shifts": result.shifts}
    if found.anchors is not None:
        optional |= {f"anchor_{name}": value for name, value in found.anchors._asdict().items()}
    if found.symmetry is not None:
        optional |= {"symmetry_partner": found.symmetry.partner}
    if found.curve is not None:
        optional |= {"boundary_points": found.curve.points, "boundary_deviation": found.curve.deviation}
    arrays |= {name: value for name, value in optional.items() if value is not None}
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / _FIT) as path:
        as_numpy: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
        np.savez(path, **as_numpy)
    with replacing(folder / _RECIPE) as path:
        path.write_text(text + "\n", encoding="utf-8")


def load(folder: str | os.PathLike[str]) -> FitResult:
    """The fit that `FitResult.save` wrote into a folder, with its report, its uncertainty and its refit.

    Numbers come in JAX's default floating dtype. `recipe.json` is not read; it is for fits of other scans.

    Args:
        folder: the one that was saved to.

    Raises:
        FileNotFoundError: there is no saved fit in the folder.
        ValueError: the file is damaged, incomplete or of a later version; the text names it and says what is wrong.
    """
    path = Path(folder) / _FIT
    if not path.is_file():
        raise FileNotFoundError(f"{folder} has no {_FIT}: it is not the folder of a fit that was saved.")
    try:
        return _restored(_read(path))
    except KeyError as error:
        raise ValueError(f"{path}: {error.args[0]!r} is missing: the file is not one of a saved fit.") from None
    except (ValueError, TypeError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: {error}") from None


def _read(path: Path) -> dict[str, np.ndarray]:
    with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
        arrays = dict(file)
    version = int(arrays["version"])
    if version != _VERSION:
        what = "Update it" if version > _VERSION else f"Fit the scan again, by its {_RECIPE}"
        raise ValueError(f"a fit of version {version}, but this release reads version {_VERSION}. {what}.")
    n = len(arrays["scan_points"])
    for name in _A_POINT:
        if len(arrays[name]) != n:
            raise ValueError(f"{name!r} has {len(arrays[name])} rows for {n} scan points.")
    return arrays


def _restored(arrays: dict[str, np.ndarray]) -> FitResult:
    def on_device(name: str) -> Array:
        values = arrays[name]
        return jnp.asarray(values, jnp.result_type(float) if values.dtype.kind == "f" else None)

    recipe = Recipe.from_json(str(arrays["recipe"]))
    scheme = recipe.scheme
    if scheme.h is not None:
        scheme = eqx.tree_at(lambda s: s.h, scheme, on_device("h"))
    topology = recipe.topology(js.ControlMesh(arrays["template"], {3: arrays["triangles"], 4: arrays["quads"]}))
    control = js.Control(on_device("control_vertices"), on_device("control_normals"))
    start = js.Control(on_device("template"), on_device("start_normals"))
    surface = js.refine(scheme, topology, control)
    face = arrays["face"]
    if not ((face >= 0) & (face < surface.n_faces)).all():
        raise ValueError(f"'face' has rows of faces that there are not; the surface has {surface.n_faces}.")

    of_scan = ("points", "normals", "weights", "deviations", "slices")
    scan = Scan(**{name: arrays.get(f"scan_{name}") for name in of_scan})
    shifts = None
    if "shifts" in arrays:
        shifts = find_shifts(scan)
        if shifts is None or not np.array_equal(shifts.slices, arrays["slices"]):
            raise ValueError("'slices' are not those of the scan that may move.")
        shifts = shifts.at(arrays["shifts"])
    points = scan.points if shifts is None else shifts.put_on(scan).points
    at = js.SurfacePoint(face, on_device("uv"))
    rms, robust_rms = arrays["rms"], arrays["robust_rms"]
    seen = Look(
        at=at,
        pairs=Pairs(points, *corner_weights(surface, at), on_device("directions")),
        distances=on_device("distances"),
        weights=on_device("weights"),
        precisions=on_device("precisions"),
        noise=on_device("noise"),
        scale=on_device("scale"),
        rms=jnp.asarray(rms[-1], jnp.result_type(float)),
        robust_rms=jnp.asarray(robust_rms[-1], jnp.result_type(float)),
    )
    anchors = None
    if "anchor_points" in arrays:
        anchors = Anchors(*(on_device(f"anchor_{name}") for name in Anchors._fields))
    symmetry = None
    if "symmetry_partner" in arrays:
        symmetry = symmetry_of(arrays["symmetry_partner"], arrays["template"])
    curve = None
    if "boundary_points" in arrays:
        curve = BoundaryCurve(arrays["boundary_points"], float(arrays["boundary_deviation"]))
    problem = Problem(recipe.scheme, topology, start, recipe.free, recipe.priors, anchors, symmetry, curve)
    expected = Expected(*(arrays[f"expected_{name}"] for name in Expected._fields))
    of_bends = arrays["bend_precision"], expected, float(arrays["likeness"])
    of_sweeps = float(arrays["determined"]), bool(arrays["annealed"]), arrays["hold"]
    problem.tell(Found(arrays["template"], *of_bends, *of_sweeps, anchors))
    return FitResult(
        control=control,
        scheme=scheme,
        surface=surface,
        scan=scan,
        rms=rms,
        robust_rms=robust_rms,
        result=getattr(optx.RESULTS, str(arrays["result"])),
        problem=problem,
        seen=seen,
        recipe=recipe,
        start=start,
        shifts=shifts,
    )
