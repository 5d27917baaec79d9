"""Fit a control mesh to a scan: `python -m fitting SCAN --control MESH -o OUT`; without arguments, an example."""

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import get_args

import jax
import numpy as np
import optimistix as optx

import jaxsubdiv as js
from jaxsubdiv._files import replacing
from jaxsubdiv._warnings import plain_warnings

from ._example import Example, example
from ._fit import Sweep, fit
from ._picture import draw_fit, surface_distances
from ._result import FitResult
from ._scan import Scan, read_scan

_EXAMPLE_NOISE = 3.0  # mm: the example starts from a control mesh that is wrong, to show that the fit mends it
_SCHEMES = {"interpolating": js.Interpolating, "circle": js.CirclePreserving}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; exit status 0, 1 where the fit did not converge, 2 where the input cannot be used."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if (options.scan is None) != (options.control is None):
        parser.error(
            "a scan needs a control mesh to start from, and a control mesh a scan: give SCAN and --control MESH"
        )
    _keep_compiled_programs()
    try:
        with plain_warnings():
            return _run(options)
    except (js.MeshError, ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    folder = Path(options.output or f"fit_{Path(options.scan).stem if options.scan else options.example}")
    scan, mesh, name = _inputs(options)
    print(f"scan     {scan.n_points:,} points, {_size(np.asarray(scan.points))}")
    print(f"control  {len(mesh.vertices):,} vertices, {mesh.n_faces:,} faces, {_size(mesh.vertices)}")
    scheme = _SCHEMES[options.scheme](options.h)
    topology = js.build_topology(mesh, scheme, options.levels)
    print("fitting  the first sweep compiles the program, which takes seconds once and is kept for the next run")
    began = time.perf_counter()
    with _Progress(options.max_sweeps) as progress:
        result = fit(
            scheme,
            topology,
            mesh.control(weights=scheme.weights),
            scan,
            max_sweeps=options.max_sweeps,
            throw=False,
            on_sweep=progress.update,
        )
    print(f"done     in {time.perf_counter() - began:.1f} s\n\n{result.report()}\n")
    _save(folder, result, mesh, name)
    return 0 if result.result == optx.RESULTS.successful else 1


def _inputs(options: argparse.Namespace) -> tuple[Scan, js.ControlMesh, str]:
    if options.scan is not None:
        mesh = js.read_mesh(options.control, scale=options.control_scale)
        return read_scan(options.scan, scale=options.scale), mesh, Path(options.scan).name
    print(
        f"example  {options.example}, its control vertices moved by noise of {_EXAMPLE_NOISE:g} mm in each coordinate"
    )
    scan, mesh = example(options.example)
    noise = np.random.default_rng(0).normal(scale=_EXAMPLE_NOISE, size=mesh.vertices.shape)
    return scan, js.ControlMesh(mesh.vertices + noise, mesh.faces, mesh.normals), options.example


def _save(folder: Path, result: FitResult, start: js.ControlMesh, name: str) -> None:
    """The fit as files, each complete or not there at all."""
    folder.mkdir(parents=True, exist_ok=True)
    fitted = js.ControlMesh(result.control.vertices, start.faces, result.control.normals, check=False)
    js.write_mesh(folder / "control.obj", fitted)
    js.write_mesh(folder / "surface.ply", result.surface, vertex_data={"distance_mm": surface_distances(result)})
    with replacing(folder / "report.json") as path:
        path.write_text(result.report().as_json() + "\n", encoding="utf-8")
    written = ["control.obj", "surface.ply", "report.json"]
    try:
        with replacing(folder / "fit.png") as path:
            draw_fit(result, start, title=name).savefig(path)
        written.append("fit.png")
    except ImportError as error:
        print(f"note     no picture: {error}")
    print(f"wrote    {', '.join(written)} in {folder}")


class _Progress:
    """A bar where tqdm is installed, else a line a sweep."""

    def __init__(self, max_sweeps: int):
        self._max_sweeps = max_sweeps

    def __enter__(self) -> "_Progress":
        try:
            from tqdm import tqdm
        except ImportError:
            self._bar = None
        else:
            self._bar = tqdm(total=self._max_sweeps, unit="sweep", desc="sweeps at most", leave=False, disable=None)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    @property
    def update(self) -> Callable[[Sweep], None]:
        return self._update

    def _update(self, sweep: Sweep) -> None:
        if self._bar is None:
            print(f"sweep {sweep.number:3d}  RMS {sweep.rms:.3f} mm")
        else:
            self._bar.set_postfix_str(f"RMS {sweep.rms:.3f} mm")
            self._bar.update()


def _size(points: np.ndarray) -> str:
    return " x ".join(f"{extent:.0f}" for extent in np.ptp(points, axis=0)) + " mm"


def _keep_compiled_programs() -> None:
    """Keep compiled programs from run to run, unless the environment says where already."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxsubdiv"
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv-fit",
        description="Fit a control mesh, with its normals and h, to a scan, so that its smooth subdivision surface is "
        "the anatomy. Without SCAN it runs an example that ships with the package.",
        epilog="OUT gets control.obj (fitted control mesh with normals), surface.ply (refined surface, with the signed "
        "distance of the scan in mm at every vertex), report.json and fit.png. Scan and control mesh must be roughly "
        "aligned, and both in mm. Exit status: 0 converged, 1 not converged (files are written all the same), 2 the "
        "input cannot be used.",
    )
    parser.add_argument("scan", nargs="?", metavar="SCAN", help="points: .ply .xyz .csv .txt .npz .vtp, or a mesh file")
    parser.add_argument("--control", metavar="MESH", help="control mesh of triangles and quads to start from")
    parser.add_argument(
        "-o", "--output", metavar="OUT", help="folder for the results (default: fit_ and the scan's name)"
    )
    parser.add_argument("--scale", type=float, default=1.0, help="multiplies the scan's coordinates; 1000 for metres")
    parser.add_argument("--control-scale", type=float, default=1.0, help="multiplies the control mesh's coordinates")
    parser.add_argument("--levels", type=int, default=3, help="levels of refinement, 1 to 8 (default: 3)")
    parser.add_argument("--scheme", choices=tuple(_SCHEMES), default="interpolating", help="default: interpolating")
    parser.add_argument("--h", type=float, default=1.0, help="tangent length coefficient at the start (default: 1)")
    parser.add_argument("--max-sweeps", type=int, default=60, help="pairing and solving in turns (default: 60)")
    parser.add_argument("--example", choices=get_args(Example), default="head_fragment", help="which, without SCAN")
    return parser


if __name__ == "__main__":
    sys.exit(main())
