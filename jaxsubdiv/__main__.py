"""Refine a mesh file: `python -m jaxsubdiv IN OUT --levels 3`; compare the schemes on one; or export a surface."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import jax

from . import _compare
from ._admissible import warn_of_folds
from ._control import Control
from ._exports import EXPORTS, Command
from ._io import read_mesh, write_mesh
from ._mesh import ControlMesh
from ._normals import Boundary, Weights
from ._refine import refine
from ._scheme.base import AbstractScheme, OldNormals
from ._scheme.interpolating import Interpolating, Twist
from ._surface import RefinedSurface
from ._topology import MAX_LEVELS, build_topology
from ._within_tolerance import prepare_to_print, refine_within
from .console import simplify_warnings, survive_closed_streams
from .errors import MeshError

_LEVELS = 3
_COMMANDS = {"compare": Command(_compare.parser, _compare.run), **EXPORTS}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns its exit status: 0, or 2 where the input or the arguments cannot be used."""
    with survive_closed_streams(), simplify_warnings():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    words = sys.argv[1:] if arguments is None else list(arguments)
    command = _COMMANDS.get(words[0]) if words else None
    options = _parser().parse_args(words) if command is None else command.parser().parse_intermixed_args(words[1:])
    # A file is refined once: twice the digits cost nothing that one would notice.
    jax.config.update("jax_enable_x64", True)
    try:
        return _run(options) if command is None else command.run(options)
    except (MeshError, OSError, ValueError, ImportError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    mesh = read_mesh(options.input, scale=options.scale, check=not options.repair)
    if options.repair:
        mesh = mesh.repair()
        for sentence in mesh.repairs:
            print(f"repaired: {sentence}")
    print(f"read     {options.input}: {_describe(mesh)}")
    scheme = _scheme(options)
    if options.ignore_normals:
        mesh = ControlMesh(mesh.vertices, mesh.faces)
    control = mesh.control(weights=scheme.weights)
    if mesh.normals is None and scheme.uses_normals and not scheme.recomputes_normals:
        warn_of_folds(mesh, control)  # `build_topology` does where the normals were given
    surface = _refine_as_asked(scheme, mesh, control, options)
    write_mesh(options.output, surface)
    kinds = f"{len(surface.faces[3]):,} triangles, {len(surface.faces[4]):,} quads"
    print(f"wrote    {options.output}: {len(surface.vertices):,} vertices, {kinds}")
    return 0


def _refine_as_asked(
    scheme: AbstractScheme, mesh: ControlMesh, control: Control, options: argparse.Namespace
) -> RefinedSurface:
    """By so many levels, or by those that a tolerance takes; the latter to be printed where it goes to STL."""
    mesh_normals = options.normals_out == "mesh"
    if options.tolerance is None:
        topology = build_topology(
            mesh, scheme, _LEVELS if options.levels is None else options.levels, mesh_normals=mesh_normals
        )
        return refine(scheme, topology, control)
    found = refine_within(scheme, mesh, control, options.tolerance, mesh_normals=mesh_normals)
    print(f"refined  {found.levels} times: the limit is within {found.largest:.3g} of the faces, RMS {found.rms:.3g}")
    return prepare_to_print(found.surface) if Path(options.output).suffix.lower() == ".stl" else found.surface


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv",
        description="Refine a mesh of triangles and quads by interpolating subdivision: every level makes four times "
        "the faces, and the vertices of the input stay where they are.",
        epilog="`jaxsubdiv compare MESH --truth SURFACE` measures all schemes on a mesh, `jaxsubdiv tetrahedra SURFACE "
        "OUT.vtu` fills a surface, and `jaxsubdiv patches MESH OUT.vtu` writes Bézier patches; see their own --help. "
        "Files: .obj .ply .off .stl .npz; .vtp .vtk .gii with the extra `io`. The formats differ in what they "
        "hold: .stl has no quads. Exit status: 0 done, 2 the input or the arguments cannot be used.",
    )
    add = parser.add_argument
    add("input", metavar="IN", help="control mesh")
    add("output", metavar="OUT", help="refined mesh; an older file is replaced once the new one is complete")
    how_fine = parser.add_mutually_exclusive_group()
    how_fine.add_argument(
        "--levels", type=int, metavar="N", help=f"how many levels, 0 to {MAX_LEVELS} (default: {_LEVELS})"
    )
    how_fine.add_argument(
        "--tolerance",
        type=float,
        metavar="MM",
        help="as many levels as bring the flat faces so near to the limit surface, which is measured; .stl is then "
        "written to be printed, in single precision and watertight",
    )
    add(
        "--h",
        type=float,
        nargs="+",
        metavar="H",
        help="tangent length coefficient, one number or one a level; 0 is flat (default: 1)",
    )
    add(
        "--scheme",
        choices=("interpolating", "circle"),
        default="interpolating",
        help="the paper's rules, or rules that reproduce circles (default: interpolating)",
    )
    add("--twist", choices=get_args(Twist), help="of quad centres; only 'zero' is free of the unit (default: zero)")
    add("--weights", choices=get_args(Weights), help="of the face normals around a vertex (default: area)")
    add("--old-normals", choices=get_args(OldNormals), help="what later levels do with them (default: keep)")
    add("--boundary", choices=get_args(Boundary), help="normals of new boundary vertices (default: fan)")
    add("--ignore-normals", action="store_true", help="compute control normals from the faces, whatever the file has")
    add(
        "--normals-out",
        choices=("scheme", "mesh"),
        default="scheme",
        help="the scheme's own normals, or those of the refined mesh (default: scheme)",
    )
    add("--scale", type=float, default=1.0, help="multiplies the coordinates; 1000 for metres to mm (default: 1)")
    add("--repair", action="store_true", help="mend first what can be mended, and say what was done")
    return parser


def _scheme(options: argparse.Namespace) -> AbstractScheme:
    kind = _compare.SCHEMES[options.scheme]
    default = kind()  # pyright: ignore[reportCallIssue]
    names = ("twist", "weights", "old_normals", "boundary")
    chosen = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if chosen and not isinstance(default, Interpolating):
        flags = ", ".join("--" + name.replace("_", "-") for name in chosen)
        raise ValueError(
            f"{flags}: only the scheme 'interpolating' has this choice. Leave it out with '{options.scheme}'."
        )
    if default.h is None:
        if options.h is not None:
            raise ValueError(f"--h: the scheme '{options.scheme}' has no tangent length. Leave it out.")
        return default
    h = [1.0] if options.h is None else options.h
    return kind(h=h[0] if len(h) == 1 else h, **chosen)


def _describe(mesh: ControlMesh) -> str:
    state = "closed" if mesh.is_closed else f"open, {len(mesh.boundary_edges):,} boundary edges"
    normals = "computed" if mesh.normals is None else "given"
    return (
        f"{len(mesh.vertices):,} vertices, {len(mesh.faces[3]):,} triangles, {len(mesh.faces[4]):,} quads, {state}, "
        f"Euler number {mesh.euler_number}, normals {normals}"
    )


if __name__ == "__main__":
    sys.exit(main())
