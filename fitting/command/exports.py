"""What the command writes for other programs: a level by tolerance, tetrahedra, and Bézier patches."""

import argparse
from pathlib import Path

import jax.numpy as jnp

import jaxsubdiv as js
from jaxsubdiv.extras import import_extra

from ..report.at_level import SurfaceAtLevel
from ..report.result import FitResult
from ..run.folder import PATCHES, TETRAHEDRA
from ..scan.layers import take_faces

_FAILURES = (ValueError, RuntimeError, OSError, MemoryError)


def check_exports(options: argparse.Namespace) -> None:
    """See that the libraries of what is asked for are there, before anything is fitted.

    Raises:
        ImportError: one is not; the text names the extra.
    """
    if options.no_crossing:
        import_extra("ipctk", "contact", "fits with --no-crossing")
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
                _take_closed_layers(result, at), edge=None if options.tetrahedra is True else options.tetrahedra
            )
            js.write_tetrahedra(folder / TETRAHEDRA, filled)
            print(filled.summarise())
            written.append(TETRAHEDRA)
        except _FAILURES as error:
            print(f"note     no tetrahedra: {_explain(error)}")
    if options.patches is not None:
        try:
            _ = result.refine_to(0)
            patches = js.make_patches(result.scheme, _make_bare_mesh(result), result.control, options.patches)
            for name in PATCHES[: 1 if len(patches.triangles) else 2]:  # the second takes quads alone
                js.write_patches(folder / name, patches)
                written.append(name)
            print(patches.summarise())
        except _FAILURES as error:
            print(f"note     no patches: {_explain(error)}")
    return written


def _take_closed_layers(result: FitResult, at: SurfaceAtLevel) -> js.RefinedSurface | dict[str, js.RefinedSurface]:
    """The surface of every layer by its name; layers that share vertices are left as one surface, with one inside."""
    regions, surface = result.control_mesh.regions, at.surface
    if not result.layers or regions is None:
        return surface
    of_faces = regions.rows[js.control_faces_of(result.scheme, at.topology, surface, result.control)]
    parts = [take_faces(surface.faces, of_faces == regions.names.index(name)) for name in result.layers]
    if sum(len(vertices) for vertices, _ in parts) > len(surface.vertices):
        return surface
    return {
        name: js.RefinedSurface(
            surface.vertices[vertices],
            surface.normals[vertices],
            {size: jnp.asarray(rows) for size, rows in faces.items()},
        )
        for name, (vertices, faces) in zip(result.layers, parts, strict=True)
    }


def _explain(error: Exception) -> str:
    return str(error) or "it takes more memory than there is"


def _make_bare_mesh(result: FitResult) -> js.ControlMesh:
    """Without the fitted normals, which may be such as the tables warn of."""
    return js.ControlMesh(result.control.vertices, result.fit.topology.control_faces, check=False)
