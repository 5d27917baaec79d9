"""The subcommands that write a surface for other programs: `jaxsubdiv tetrahedra` and `jaxsubdiv patches`."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ._bezier_patches import check_can_write_patches, make_patches, write_patches
from ._io import read_mesh
from ._io._vtu import check_can_write_vtu
from ._scheme import SCHEMES
from ._tetrahedra import fill_with_tetrahedra, write_tetrahedra


class Command(NamedTuple):
    """A subcommand."""

    parser: Callable[[], argparse.ArgumentParser]
    run: Callable[[argparse.Namespace], int]


def _make_tetrahedra_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv tetrahedra",
        description="Fill closed surfaces with tetrahedra for finite elements. Of surfaces in one another each "
        "bounds a region, named by its file; a tetrahedron belongs to the innermost one around it.",
        epilog="Needs the extra `simulation`. Exit status: 0 done, 2 the input or the arguments cannot be used.",
    )
    add = parser.add_argument
    add("surfaces", nargs="+", metavar="SURFACE", help="closed surface, refined as fine as its shape is to be kept")
    add("output", metavar="OUT", help="the tetrahedra, .vtu")
    add("--edge", type=float, metavar="MM", help="length of edge to aim at (default: a twentieth of the diagonal)")
    add("--tolerance", type=float, metavar="MM", help="of the boundary (default: a thousandth of the diagonal)")
    add(
        "--cavity",
        action="append",
        metavar="SURFACE",
        default=[],
        help="a surface whose inside stays empty; for several give --cavity again",
    )
    add("--scale", type=float, default=1.0, help="multiplies the coordinates; 1000 for metres to mm (default: 1)")
    return parser


def _fill(options: argparse.Namespace) -> int:
    check_can_write_vtu(options.output)
    files = [Path(file) for file in (*options.surfaces, *options.cavity)]
    names = [file.stem for file in files]
    if len(set(names)) < len(names):
        raise ValueError("two surfaces have the same name without their folder and suffix: regions need names apart.")
    surfaces = {name: read_mesh(file, scale=options.scale) for name, file in zip(names, files, strict=True)}
    cavities = names[len(options.surfaces) :]
    filled = fill_with_tetrahedra(surfaces, edge=options.edge, tolerance=options.tolerance, cavities=cavities)
    write_tetrahedra(options.output, filled)
    print(filled.summarise())
    print(f"wrote    {options.output}")
    return 0


def _make_patches_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv patches",
        description="Write the smooth surface of a control mesh as Bézier patches, for isogeometric analysis and CAD.",
        epilog="The extra `io` writes .vtu. Exit status: 0 done, 2 the input or the arguments cannot be used.",
    )
    add = parser.add_argument
    add("input", metavar="MESH", help="control mesh")
    add("output", metavar="OUT", help=".vtu, Bézier cells of VTK; or .xml, a geometry of G+Smo, of quads alone")
    add("--scheme", choices=tuple(SCHEMES), default="interpolating", help="default: interpolating")
    add("--levels", type=int, default=1, metavar="N", help="a patch a face at this level, 0 to 5 (default: 1)")
    add("--scale", type=float, default=1.0, help="multiplies the coordinates; 1000 for metres to mm (default: 1)")
    return parser


def _write_patches(options: argparse.Namespace) -> int:
    check_can_write_patches(options.output)
    mesh = read_mesh(options.input, scale=options.scale)
    scheme = SCHEMES[options.scheme]()  # pyright: ignore[reportCallIssue]
    patches = make_patches(scheme, mesh, mesh.control(weights=scheme.weights), options.levels)
    write_patches(options.output, patches)
    print(patches.summarise())
    print(f"wrote    {options.output}")
    return 0


EXPORTS = {
    "tetrahedra": Command(_make_tetrahedra_parser, _fill),
    "patches": Command(_make_patches_parser, _write_patches),
}
