"""Fits of real scans, by `fitting.fit_scan` as it is: how near they come, what they cost, and what they look like.

    pip install -e '.[bench]' && OPENBLAS_NUM_THREADS=1 python tests/bench/fit_real.py --pictures real

Prints a Markdown table, lengths in mm. Every case has a process of its own and is fitted twice: at first it compiles.
With --pictures each leaves a picture and its fit (`fitting.load`) in that folder, and montage.png shows some of them.

Two of the scans ship with the package. The others are taken from ../shared/data beside the repository, or from --data;
a case whose file is not there is skipped. Where other programs run, the threads of numpy's BLAS wait for each other and
count as CPU time: hence the variable.
"""

import argparse
import dataclasses
import multiprocessing
import resource
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import fitting
import jaxsubdiv as js

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
NOISE = 3.0  # mm: what `jaxsubdiv-fit` moves the control mesh of its example by
HEART = "heart_guidepoints_a.csv"
MONTAGE = ("femur", "head", "cortex", "heart-lv")  # no person's own face


@dataclasses.dataclass(frozen=True)
class Case:
    """A scan, what is fitted to it, and what `fit_scan` is told besides."""

    scan: str
    """A file, or the name of an example."""
    control: str | None = None
    """The file of a template; "shipped" and "noisy" are the example's own; None makes one from the scan."""
    labels: tuple[str, ...] = ()
    boundary: bool = False
    """Whether the surface ends where the scan's own mesh does."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    towards: tuple[float, float, float] | None = None
    """From where the montage looks."""

    def files(self, data: Path) -> list[Path]:
        own = [data / self.scan] if Path(self.scan).suffix else []
        return own + ([data / "control" / self.control] if Path(self.control or "").suffix else [])

    def read(self, data: Path) -> tuple[fitting.Scan, js.ControlMesh | None, dict[str, Any]]:
        """Scan, template, and the options of `fit_scan`."""
        options = dict(self.options)
        if not Path(self.scan).suffix:
            scan, mesh = fitting.example(self.scan)  # type: ignore[arg-type]
            noise = np.random.default_rng(0).normal(scale=NOISE, size=mesh.vertices.shape)
            if self.control == "noisy":
                mesh = js.ControlMesh(mesh.vertices + noise, mesh.faces, mesh.normals)
            return scan, None if self.control is None else mesh, options
        scan = fitting.read_scan(data / self.scan, labels=self.labels)
        mesh = None if self.control is None else js.read_mesh(data / "control" / self.control)
        if self.boundary:
            edge = fitting.boundary_of(js.read_mesh(data / self.scan, check=False))
            options["boundary"] = fitting.BoundaryCurve(edge)
        return scan, mesh, options


CASES = {
    "head-fragment": Case("head_fragment", "noisy"),
    "femur": Case("femur_distal"),
    "face": Case("face_laser.vtp", "face_quad.obj"),
    "face-boundary": Case("face_laser.vtp", "face_quad.obj", boundary=True),
    "ct": Case("head_fragment_ct.stl"),
    "ct-mixed": Case("head_fragment_ct.stl", "head_fragment_mixed.obj"),
    "digitised": Case("head_digitised_a.xyz"),
    "digitised-quad": Case("head_digitised_a.xyz", "head_quad.obj"),
    "head": Case("head_colin27.ply", "head_quad.obj", towards=(-0.7, 1, 0.3)),
    "head-tri": Case("head_colin27.ply", "head_tri.obj"),
    "cortex": Case("cortex_left_colin27.surf.gii", options={"faces": 4400, "levels": 2}, towards=(-1, 0, 0.2)),
    "heart-lv": Case(HEART, "heart_lv_quad.obj", ("LV_ENDOCARDIAL",)),
    "heart-lv-still": Case(
        HEART, "heart_lv_quad.obj", ("LV_ENDOCARDIAL",), options={"free": fitting.Free(shifts=False)}
    ),
    "heart-wall": Case(HEART, "heart_wall_quad.obj"),
    "heart-wall-still": Case(HEART, "heart_wall_quad.obj", options={"free": fitting.Free(shifts=False)}),
}


def run(name: str, data: Path, pictures: Path | None) -> dict[str, Any]:
    """Fit a case twice: its row of the table."""
    case, row = CASES[name], {"case": name}
    for times in ("first", "warm"):
        scan, mesh, options = case.read(data)
        wall, cpu = time.perf_counter(), time.process_time()
        found = fitting.fit_scan(scan, mesh, throw=False, **options)
        row |= {f"wall_{times}": time.perf_counter() - wall, f"cpu_{times}": time.process_time() - cpu}
    row["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # KiB on Linux
    if pictures is not None:
        title = f"{name}: {case.scan}, {case.control or 'made from it'}"
        fitting.draw_fit(found.result, found.start, title=title).savefig(pictures / f"{name}.png")
        found.result.save(pictures / name)
    report, far = found.result.report(), np.linalg.norm(found.result.shifts, axis=1)
    row |= {"scan": case.scan, "control": "made from it" if case.control is None else case.control}
    row |= {"misfit": fitting.misfit(found.result), "self_intersecting": len(found.result.crossings.triangles)}
    row |= {"moved": f"{len(far)}, {np.sqrt(np.mean(far**2)):.2f}, {far.max():.2f}" if len(far) else ""}
    return row | report.as_dict()


COLUMNS = {
    "case": "{case}",
    "scan": "{scan}",
    "points": "{n_points:,}",
    "control mesh": "{control}",
    "vertices": "{n_control_vertices:,}",
    "RMS at the start": "{rms_start:.2f}",
    "RMS": "{rms:.3f}",
    "of inliers": "{rms_inliers:.3f}",
    "95th percentile": "{percentile_95:.2f}",
    "maximum": "{maximum:.1f}",
    "noise": "{noise:.3f}",
    "misfit": "{misfit:.3f}",
    "inliers": "{inlier_share:.1%}",
    "coverage": "{coverage:.1%}",
    "shifts: slices, RMS, largest": "{moved}",
    "self-intersecting triangles": "{self_intersecting}",
    "least margin": "{least_margin:.2f}",
    "converged": "{converged}",
    "sweeps": "{sweeps}",
    "CPU s, first": "{cpu_first:.1f}",
    "CPU s, warm": "{cpu_warm:.1f}",
    "wall s, first": "{wall_first:.1f}",
    "wall s, warm": "{wall_warm:.1f}",
    "peak GB": "{peak_gb:.2f}",
}


def line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def draw_montage(names: Sequence[str], pictures: Path) -> None:
    """Fitted control meshes above, the distances of the scans from their surfaces below."""
    from matplotlib.figure import Figure
    from PIL import Image

    figure = Figure(figsize=(3.2 * len(names), 6.2), layout="constrained", dpi=90)
    for name, (above, below) in zip(names, figure.subplots(2, len(names), squeeze=False).T, strict=True):
        result = fitting.load(pictures / name)
        view = js.view_of(result.surface, CASES[name].towards)
        js.draw_surface(above, result.control_mesh, view=view, edges=True)
        above.set_title(f"{name}\n{result.scan.n_points:,} points, {len(result.control.vertices):,} vertices", size=10)
        values = result.refine_to().distances
        limit = float(np.percentile(np.abs(result.distances), 95))
        colours = js.draw_surface(
            below, result.surface, view=view, values=values, limits=(-limit, limit), cmap="RdBu_r"
        )
        bar = figure.colorbar(colours, ax=below, orientation="horizontal", shrink=0.7, aspect=30, pad=0.02)
        bar.set_label(f"mm; RMS {result.rms[-1]:.2f} mm", size=9)
    figure.savefig(pictures / "montage.png")
    with Image.open(pictures / "montage.png") as image:
        few = image.convert("RGB").quantize(256)  # colours: a third of the size
    few.save(pictures / "montage.png", optimize=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--data", type=Path, default=DATA, help=f"folder of the scans (default: {DATA})")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="for a picture and the fit of every case")
    options = parser.parse_args(arguments)
    if options.pictures is not None:
        options.pictures.mkdir(parents=True, exist_ok=True)
    print(line(list(COLUMNS)))
    print("|---|---|--:|---" + "|--:" * (len(COLUMNS) - 4) + "|", flush=True)
    skipped, done = [], []
    for name in options.cases:
        missing = [path for path in CASES[name].files(options.data) if not path.is_file()]
        if missing:
            skipped.append(f"{name}: {', '.join(map(str, missing))} not there")
            continue
        # A process each: what one compiled or left in memory must not count for the next.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            row = process.submit(run, name, options.data, options.pictures).result()
        print(line([text.format(**row) for text in COLUMNS.values()]), flush=True)
        done.append(name)
    for why in skipped:
        print(f"\nSkipped, {why}; name its folder with --data.")
    shown = [name for name in MONTAGE if name in done]
    if options.pictures is not None and shown:
        draw_montage(shown, options.pictures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
