"""What the command writes for other programs: a level by tolerance, tetrahedra, and Bézier patches."""

import argparse
from pathlib import Path

import jaxsubdiv as js
from jaxsubdiv.extras import import_extra

from ..report.at_level import SurfaceAtLevel
from ..report.result import FitResult
from ..run.folder import PATCHES, TETRAHEDRA


def check_exports(options: argparse.Namespace) -> None:
    """See that the libraries of what is asked for are there, before anything is fitted.

    Raises:
        ImportError: one is not; the text names the extra.
    """
    modules = ["pyvista"] if options.patches is not None else []
    modules += ["pyvista", "pytetwild", "ipctk"] if options.tetrahedra is not None else []
    for module in modules:
        import_extra(module, "simulation", "--tetrahedra and --patches")


def find_level(result: FitResult, options: argparse.Namespace) -> int | None:
    """Find the level that the surface is written at: `--surface-level`, or the first within `--surface-tolerance`.

    Returns:
        the level, or None for that of the fit.

    Raises:
        ValueError: the tolerance is not reached, or the surface has no other level.
    """
    if options.surface_tolerance is None:
        return options.surface_level
    _ = result.refine_to(0)  # raises where the surface has no other level
    settings = result.fit.settings
    found = js.refine_within(
        result.scheme,
        _make_bare_mesh(result),
        result.control,
        options.surface_tolerance,
        mesh_normals=settings.mesh_normals,
        limit=settings.limit,
    )
    print(
        f"refined  {found.levels} times: the limit is within {found.largest:.3g} mm of the surface's faces, RMS "
        f"{found.rms:.3g}"
    )
    return found.levels


def write_exports(folder: Path, result: FitResult, at: SurfaceAtLevel, options: argparse.Namespace) -> list[str]:
    """Write the tetrahedra and patches that the options ask for.

    A file that cannot be made is left out with a note, so that the fit itself is not lost.

    Returns:
        the names of the files.
    """
    written = []
    if options.tetrahedra is not None:
        try:
            filled = js.fill_with_tetrahedra(
                at.surface, edge=None if options.tetrahedra is True else options.tetrahedra
            )
            js.write_tetrahedra(folder / TETRAHEDRA, filled)
            print(filled.summarise())
            written.append(TETRAHEDRA)
        except (ValueError, RuntimeError) as error:
            print(f"note     no tetrahedra: {error}")
    if options.patches is not None:
        try:
            _ = result.refine_to(0)
            patches = js.make_patches(result.scheme, _make_bare_mesh(result), result.control, options.patches)
            for name in PATCHES[: 1 if len(patches.triangles) else 2]:  # the second takes quads alone
                js.write_patches(folder / name, patches)
                written.append(name)
            print(patches.summarise())
        except ValueError as error:
            print(f"note     no patches: {error}")
    return written


def _make_bare_mesh(result: FitResult) -> js.ControlMesh:
    """Without the fitted normals, which may be such as the tables warn of."""
    return js.ControlMesh(result.control.vertices, result.fit.topology.control_faces, check=False)
