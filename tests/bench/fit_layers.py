"""The femoral cartilage of a knee from a label map of MRI: its thickness, and volumes beside those of the voxels.

    python tests/bench/fit_layers.py ../shared/data/labels/knee_mri.nrrd [--picture cartilage_thickness.png]

Bone and cartilage are fitted as layers. Where no voxel of cartilage is near the bone the thickness is known to be 0.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.spatial import KDTree

import fitting
from fitting.report.coverage import weighted_quantile

BONE, CARTILAGE = 5, 1
_THICK = 0.5  # mm: less is taken for no cartilage
_AWAY = 3.0  # mm from the voxels of the cartilage: the bone is bare there


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("--picture", type=Path, help="where the picture of the thickness goes")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    volume, began = fitting.read_volume(options.labels), time.perf_counter()
    layers = {"bone": str(BONE), "cartilage": [str(BONE), str(CARTILAGE)]}
    scans = fitting.scans_of_volume(volume, layers)
    found = fitting.fit_layers(scans, faces=2000, most_points=40_000, throw=False)
    known, result = found.thickness(), found.result
    n_points = sum(scan.n_points for scan in scans.values())
    seconds = time.perf_counter() - began
    print(f"{len(result.control.vertices):,} control vertices, 40,000 of {n_points:,} points, {seconds:.0f} s")
    print(f"warnings: {' '.join(f'{one.name}: {one.text}' for one in result.warnings) or 'none'}\n")
    print_volumes(found, volume)
    print_thickness(found, known, volume)
    if options.picture is not None:
        fitting.draw_thickness(result.surface, known).savefig(options.picture)


def print_volumes(found: fitting.LayersFit, volume: fitting.Volume) -> None:
    """In ml, of the fit and of the voxels."""
    values, ml = volume.layers[0], volume.voxel_volume / 1000
    bone, cartilage = (float(np.count_nonzero(values == label)) * ml for label in (BONE, CARTILAGE))
    own = {one.name: one.value for one in found.result.measures()}
    fitted = [own[f"volume {name}"] for name in ("bone", "cartilage", "between bone and cartilage")]
    print("| | bone | bone and cartilage | between |\n| --- | ---: | ---: | ---: |")
    for name, row in (("fit", fitted), ("voxels of the labels", (bone, bone + cartilage, cartilage))):
        print(f"| {name} | {' | '.join(f'{value:.1f}' for value in row)} |")


def print_thickness(found: fitting.LayersFit, known: fitting.Thickness, volume: fitting.Volume) -> None:
    """In mm, of the fit and of the voxels; and where the bone is bare, with its standard deviation."""
    values = volume.layers[0]
    area = float(np.asarray(found.surface("bone").vertex_areas()).sum()) / 100
    thick = known.values > _THICK
    there, shares = known.values[thick], known.shares[thick] / known.shares[thick].sum()
    print(
        f"\nthicker than {_THICK} mm on {area * known.shares[thick].sum():.0f} cm2: mean {shares @ there:.2f}, median "
        f"{weighted_quantile(there, shares, 0.5):.2f}, 95th percentile {weighted_quantile(there, shares, 0.95):.2f} mm"
    )
    touching = (values == CARTILAGE) & binary_dilation(values == BONE)
    inside = np.asarray(distance_transform_edt((values == BONE) | (values == CARTILAGE), sampling=volume.spacing))
    print(
        f"voxels of the cartilage that touch the bone: {np.median(inside[touching]):.2f} mm below the outside, median"
    )
    of_layer = np.flatnonzero(known.shares > 0)
    places = np.asarray(found.result.surface.vertices, np.float64)[of_layer]
    voxels = volume.positions(np.argwhere(values == CARTILAGE).astype(float))
    to_cartilage = np.asarray(KDTree(voxels).query(places)[0])
    bare = of_layer[to_cartilage > _AWAY]
    off, deviations = known.values[bare], known.deviations[bare]
    shares = known.shares[bare] / known.shares[bare].sum()
    print(
        f"bare bone, over {_AWAY:g} mm from the cartilage, {area * known.shares[bare].sum():.0f} cm2: RMS "
        f"{np.sqrt(shares @ off**2):.3f} mm, of the standard deviations {np.sqrt(shares @ deviations**2):.3f} mm; "
        f"{shares @ (np.abs(off) < deviations):.0%} of the area within one of 0"
    )


if __name__ == "__main__":
    main()
