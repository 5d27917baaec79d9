"""How near the surface of a label map is to the anatomy that it was made of, and what others make of the same voxels.

    python tests/bench/fit_labels.py SHARED_DATA [--shapes femur head skull] [--voxels 1 2 3 1x1x5]

A mesh is the truth. Its voxels are those whose middles lie inside, on a grid that is turned against all of its axes,
as patients lie. From these: `fit` is what `jaxsubdiv-fit` does with a label map; `marching cubes` is the stairs
themselves; `windowed sinc` and `Taubin` smooth them, `SurfaceNets` is VTK's. Of those three the first row has the
settings that their libraries start from, the second the best of many for this one case, which nobody knows without the
truth.

The head is `head_colin27.ply`, the femur the Poisson surface of `femur_distal`, the skull one of a mouse, in four times
its size: human-sized, with walls of 2 to 5 mm.
"""

import argparse
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyvista as pv
import trimesh
import vtk
from scipy.spatial.transform import Rotation
from vtk.util.numpy_support import vtk_to_numpy

import fitting
import jaxsubdiv as js
from fitting.start.cloud import clean
from fitting.start.reconstruct import reconstruct

_TURN = Rotation.from_euler("xyz", [17, -23, 31], degrees=True).as_matrix()
_SAMPLES = 20_000
_MARGIN = 4


class Mesh(NamedTuple):
    vertices: np.ndarray
    faces: np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--shapes", nargs="+", choices=tuple(_TRUTHS), default=tuple(_TRUTHS))
    parser.add_argument("--voxels", nargs="+", default=["0.5", "1", "2", "3", "1x1x5"])
    parser.add_argument("--pictures", type=Path, help="a folder for the surfaces, as .ply")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| shape | voxels, mm | | RMS, voxels | 95th percentile, mm | normals, degrees | volume | s | |")
    print("|---|---|---|---|---|---|---|---|---|")
    for shape in options.shapes:
        truth = _TRUTHS[shape](options.data)
        for size in options.voxels:
            spacing = np.resize(np.array(size.split("x"), float), 3)
            volume = voxelise(truth, spacing)
            for name, surface, seconds, note in _surfaces(volume, truth):
                row = f"| {shape} | {size} | {name} | {judge(surface, truth, spacing)} | {seconds:.1f} | {note} |"
                print(row, flush=True)
                if options.pictures:
                    options.pictures.mkdir(exist_ok=True)
                    pv.PolyData.from_regular_faces(*surface).save(options.pictures / f"{shape}_{size}_{name}.ply")


def _head(data: Path) -> Mesh:
    mesh = js.read_mesh(data / "head_colin27.ply")
    return Mesh(np.asarray(mesh.vertices, float), mesh.faces[3])


def _skull(data: Path) -> Mesh:
    mesh = js.read_mesh(sorted((data / "skulls").glob("*.ply"))[0], check=False)
    return Mesh(4 * np.asarray(mesh.vertices, float), mesh.faces[3])


def _femur(_: Path) -> Mesh:
    scan, _ = fitting.example("femur_distal")
    return Mesh(*reconstruct(clean(scan), closed=True).pieces[0])


_TRUTHS: dict[str, Callable[[Path], Mesh]] = {"femur": _femur, "head": _head, "skull": _skull}


def voxelise(truth: Mesh, spacing: np.ndarray) -> fitting.Volume:
    """Which middles of voxels lie inside."""
    local = truth.vertices @ _TURN
    low = local.min(axis=0) - (_MARGIN - np.array([0.31, 0.17, 0.43])) * spacing
    n = np.ceil((local.max(axis=0) - low) / spacing).astype(int) + _MARGIN
    stencil = vtk.vtkPolyDataToImageStencil()
    stencil.SetInputData(pv.PolyData.from_regular_faces((local - low) / spacing, truth.faces))
    stencil.SetOutputWholeExtent(0, n[0] - 1, 0, n[1] - 1, 0, n[2] - 1)
    stencil.SetTolerance(0)
    ones = pv.ImageData(dimensions=n)
    ones["inside"] = np.ones(int(np.prod(n)), np.uint8)
    cut = vtk.vtkImageStencil()
    cut.SetInputData(ones)
    cut.SetStencilConnection(stencil.GetOutputPort())
    cut.SetBackgroundValue(0)
    cut.Update()
    inside = vtk_to_numpy(cut.GetOutput().GetPointData().GetScalars()).reshape(n, order="F")
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = _TURN * spacing, _TURN @ low
    return fitting.Volume((inside.copy(),), affine, "RAS")


def judge(surface: Mesh, truth: Mesh, spacing: np.ndarray) -> str:
    """Distances both ways, each surface by its area; normals where the truth is."""
    to_truth, _ = _distances(surface, truth)
    to_surface, turned = _distances(truth, surface)
    off = np.concatenate([to_truth, to_surface])
    volumes = [trimesh.Trimesh(*mesh, process=False).volume for mesh in (surface, truth)]
    rms = np.sqrt(np.mean(off**2)) / np.prod(spacing) ** (1 / 3)
    shrunk = 100 * (volumes[0] / volumes[1] - 1)
    return f"{rms:.3f} | {np.quantile(off, 0.95):.2f} | {turned.mean():.1f} | {shrunk:+.2f} %"


def _distances(of: Mesh, to: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """From samples of one surface to the other, in mm, and the angles between the normals there, in degrees."""
    first, second = (trimesh.Trimesh(*mesh, process=False) for mesh in (of, to))
    points, rows = trimesh.sample.sample_surface(first, _SAMPLES, seed=1)
    target = pv.PolyData.from_regular_faces(*to)
    cells, nearest = target.find_closest_cell(points, return_closest_point=True)
    cosine = np.einsum("px,px->p", first.face_normals[rows], second.face_normals[cells])
    return np.linalg.norm(points - nearest, axis=1), np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _surfaces(volume: fitting.Volume, truth: Mesh) -> Iterator[tuple[str, Mesh, float, str]]:
    """Every method's surface, its seconds, and a note."""
    began = time.perf_counter()
    scan = fitting.scan_of_label(volume, fitting.choose_label(volume, None))
    result = fitting.fit_scan(scan, throw=False, **fitting.suggest_settings(scan)).result
    seconds = time.perf_counter() - began
    surface = Mesh(np.asarray(result.surface.vertices, float), np.asarray(result.surface.triangles()))
    warned = " ".join(finding.name for finding in result.warnings)
    yield "fit", surface, seconds, f"{len(result.control.vertices)} control vertices {warned}"
    image = pv.ImageData(dimensions=volume.layers[0].shape, spacing=volume.spacing)
    image["label"] = volume.layers[0].ravel(order="F")
    began = time.perf_counter()
    stairs = image.contour([0.5], "label", method="flying_edges")
    taken = time.perf_counter() - began
    yield "marching cubes", _placed(stairs, volume), taken, ""
    for name, methods in _peers(image, stairs).items():
        made = []
        for note, method in methods:
            began = time.perf_counter()
            found = _placed(method(), volume)
            made.append((name, found, time.perf_counter() - began, note))
        yield made[0]
        yield min(made, key=lambda row: np.mean(_distances(truth, row[1])[0] ** 2))


def _peers(image: pv.ImageData, stairs: pv.PolyData) -> dict[str, list[tuple[str, Callable[[], pv.PolyData]]]]:
    """Of every peer its settings: first those that it starts from."""

    def sinc(n: int, band: float) -> pv.PolyData:
        return stairs.smooth_taubin(n_iter=n, pass_band=band, normalize_coordinates=True, boundary_smoothing=False)

    def taubin(n: int, nu: float) -> pv.PolyData:
        mesh = trimesh.Trimesh(stairs.points, stairs.regular_faces, process=False)
        trimesh.smoothing.filter_taubin(mesh, lamb=0.5, nu=nu, iterations=n)
        return pv.PolyData.from_regular_faces(np.asarray(mesh.vertices), mesh.faces)

    def nets(n: int, relaxation: float, reach: float) -> pv.PolyData:
        return image.contour_labels(
            "all", scalars="label", smoothing_iterations=n, smoothing_relaxation=relaxation, smoothing_distance=reach
        ).triangulate()

    step = float(np.linalg.norm(image.spacing))
    return {
        "windowed sinc": [
            (f"{n} x, {band}", lambda n=n, band=band: sinc(n, band))
            for n, band in [(20, 0.1)] + [(n, band) for n in (20, 50, 100) for band in (0.1, 0.05, 0.02, 0.01)]
        ],
        "Taubin": [
            (f"{n} x, {nu}", lambda n=n, nu=nu: taubin(n, nu))
            for n, nu in [(10, 0.5)] + [(n, nu) for n in (10, 30, 100) for nu in (0.5, 0.53)]
        ],
        "SurfaceNets": [
            (f"{n} x, {relaxation}, {reach:.2g} mm", lambda n=n, r=relaxation, d=reach: nets(n, r, d))
            for n, relaxation, reach in [(16, 0.5, step)]
            + [(n, r, d * step) for n in (16, 50, 100) for r in (0.2, 0.5) for d in (0.5, 1.0)]
        ],
    }


def _placed(mesh: pv.PolyData, volume: fitting.Volume) -> Mesh:
    """From the image's own mm to the patient's."""
    return Mesh(volume.positions(np.asarray(mesh.points, float) / volume.spacing), np.asarray(mesh.regular_faces))


if __name__ == "__main__":
    main()
