"""Files of a cohort's shapes, for other programs: tables, arrays, the mean surface with its modes, and landmarks."""

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

import jaxsubdiv as js
from jaxsubdiv.files import replace_file

from ..model.groups import GroupDifference
from ..model.mode_quality import ModeQuality
from ..model.modes import Modes
from ..report.cohort import Cohort
from ..scan.landmarks import write_landmarks
from .carry import CarriedLandmarks

_MOST_COLOURED = 5  # modes that the mean surface has as colours


def write_shapes(
    folder: str | os.PathLike[str],
    cohort: Cohort,
    modes: Modes,
    *,
    quality: ModeQuality | None = None,
    difference: GroupDifference | None = None,
    landmarks: Sequence[CarriedLandmarks] | None = None,
) -> None:
    """Write what a cohort's shapes are and how they differ.

    - `scores.csv`: a row a scan: name, whether it converged, centroid size in mm, scores in standard deviations.
    - `modes.csv`: a row a mode: standard deviation in mm, share of the variance, and its quality.
    - `mean.vtp`: the mean shape. At every vertex the standard deviation of the cohort (`spread_mm`), the first five
      modes across the surface at one standard deviation (`mode_1_mm`), and of the groups how far the second lies
      outside the first (`difference_mm`), `p_any` and `q`.
    - `shapes.npz`: all arrays of the arguments, the fitted surfaces and control vertices, and names.
    - `landmarks.csv`: a row a scan and landmark; and for 3D Slicer a file `NAME.mrk.json` of each scan.

    Args:
        folder: made where there is none.
        cohort: the fits.
        modes: of the vertices of the surfaces or of the control meshes.
        quality: of the modes, as `measure_modes` finds it.
        difference: of two groups, as `compare_groups` finds it, of the same vertices.
        landmarks: those of each scan, as `carry_to_cohort` gives them.

    Raises:
        OSError: a file cannot be written.
        ValueError: the modes are of other vertices or another number of shapes, or the landmarks of other scans.
    """
    faces = _faces_of(cohort, modes)
    if difference is not None and len(difference.p_any) != len(modes.mean):
        raise ValueError(f"the difference is of {len(difference.p_any)} vertices, the modes are of {len(modes.mean)}.")
    if landmarks is not None and len(landmarks) != len(cohort):
        raise ValueError(f"there are landmarks of {len(landmarks)} scans, and the cohort has {len(cohort)}.")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    k = len(modes.deviations)
    columns = ["name", "converged", "centroid_size_mm", *(f"mode_{j + 1}" for j in range(k))]
    sizes = zip(cohort.names, cohort.converged, modes.sizes, modes.scores, strict=True)
    _write_table(folder / "scores.csv", columns, [[name, int(end), size, *own] for name, end, size, own in sizes])
    _write_table(folder / "modes.csv", *_table_of_modes(modes, quality))
    mean = js.ControlMesh(modes.mean, faces, check=False)
    js.write_mesh(folder / "mean.vtp", mean, vertex_data=_colours(mean, modes, difference))
    arrays: dict[str, Any] = {
        "names": np.array(cohort.names),
        "control_vertices": cohort.control.vertices,
        "surface_vertices": cohort.surfaces.vertices,
        "triangles": faces[3],
        "quads": faces[4],
    }
    for what, values in (("", modes), ("quality_", quality), ("difference_", difference)):
        arrays |= {} if values is None else {f"{what}{name}": value for name, value in values._asdict().items()}
    if landmarks is not None:
        arrays |= {"landmark_names": np.array(landmarks[0].names), "landmarks": np.stack([m.points for m in landmarks])}
        _write_landmarks(folder, cohort, landmarks)
    as_numpy: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    with replace_file(folder / "shapes.npz") as path:
        np.savez(path, **as_numpy)


def _faces_of(cohort: Cohort, modes: Modes) -> Mapping[int, Int[np.ndarray, "_ c"]]:
    """The faces that the vertices of the modes have."""
    control_faces = cohort.result(0).fit.topology.control_faces
    n_surface, n_control = cohort.surfaces.vertices.shape[1], cohort.control.vertices.shape[1]
    if len(modes.scores) != len(cohort) or len(modes.mean) not in (n_surface, n_control):
        raise ValueError(
            f"the modes are of {len(modes.scores)} shapes of {len(modes.mean)} vertices; the cohort has {len(cohort)} "
            f"of {n_surface}, and {n_control} control vertices. Take those of `cohort.surfaces` or `cohort.control`."
        )
    faces = cohort.surfaces.faces if len(modes.mean) == n_surface else control_faces
    return {size: np.asarray(rows) for size, rows in faces.items()}


def _table_of_modes(modes: Modes, quality: ModeQuality | None) -> tuple[list[str], list[list]]:
    columns = ["mode", "deviation_mm", "share"]
    rows = [[j + 1, *own] for j, own in enumerate(zip(modes.deviations, modes.share, strict=True))]
    if quality is not None:
        columns += [name if name == "compactness" else f"{name}_mm" for name in quality._fields]
        columns[columns.index("compactness")] += "_mm2"
        for row, *own in zip(rows, *quality, strict=False):  # the last mode has none
            row += own
    return columns, rows


def _colours(mesh: js.ControlMesh, modes: Modes, difference: GroupDifference | None) -> dict[str, np.ndarray]:
    normals = _vertex_normals(mesh)
    away = modes.aligned - modes.mean
    spread = np.sqrt(np.sum(away**2, axis=(0, 2)) / max(len(away) - 1, 1))
    found = {"spread_mm": spread}
    across = np.einsum("kvx,vx->kv", modes.modes, normals) * modes.deviations[:, None]
    found |= {f"mode_{j + 1}_mm": row for j, row in enumerate(across[:_MOST_COLOURED])}
    if difference is not None:
        apart = np.sum((difference.means[1] - difference.means[0]) * normals, axis=1)
        found |= {"difference_mm": apart, "p_any": difference.p_any, "q": difference.q}
    return found


def _vertex_normals(mesh: js.ControlMesh) -> Float[np.ndarray, "v 3"]:
    fans = js.build_topology(mesh, js.Interpolating(), 1).control_fans
    return np.asarray(js.estimate_normals(fans, mesh.vertices), np.float64)


def _write_landmarks(folder: Path, cohort: Cohort, landmarks: Sequence[CarriedLandmarks]) -> None:
    rows = []
    for name, scan, own in zip(cohort.names, cohort.scans, landmarks, strict=True):
        write_landmarks(folder / f"{name}.mrk.json", own.positions, frame=scan.frame, deviations=own.deviations)
        rows += [[name, label, *at, own.deviations[label]] for label, at in own.positions.items()]
    _write_table(folder / "landmarks.csv", ["scan", "name", "x", "y", "z", "deviation_mm"], rows)


def _write_table(path: Path, columns: list[str], rows: list[list]) -> None:
    with replace_file(path) as unfinished, unfinished.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
