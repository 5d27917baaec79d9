"""Refine a mesh file: `python -m jaxsubdiv IN OUT --levels 3`; or compare the schemes on one."""

import argparse
import sys
from collections.abc import Sequence
from typing import get_args

import jax

from . import _compare
from ._admissible import warn_of_folds
from ._io import read_mesh, write_mesh
from ._mesh import ControlMesh
from ._normals import Boundary, Weights
from ._refine import refine
from ._scheme.base import AbstractScheme, OldNormals
from ._scheme.interpolating import Interpolating, Twist
from ._topology import MAX_LEVELS, build_topology
from .console import simplify_warnings, survive_closed_streams
from .errors import MeshError


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns its exit status: 0, or 2 where the input or the arguments cannot be used."""
    with survive_closed_streams(), simplify_warnings():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    words = sys.argv[1:] if arguments is None else list(arguments)
    comparing = words[:1] == ["compare"]
    options = _compare.parser().parse_args(words[1:]) if comparing else _parser().parse_args(words)
    # A file is refined once: twice the digits cost nothing that one would notice.
    jax.config.update("jax_enable_x64", True)
    try:
        return _compare.run(options) if comparing else _run(options)
    except (MeshError, OSError, ValueError, ImportError) as error:
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
    topology = build_topology(mesh, scheme, options.levels, mesh_normals=options.normals_out == "mesh")
    surface = refine(scheme, topology, control)
    write_mesh(options.output, surface)
    kinds = f"{len(surface.faces[3]):,} triangles, {len(surface.faces[4]):,} quads"
    print(f"wrote    {options.output}: {len(surface.vertices):,} vertices, {kinds}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv",
        description="Refine a mesh of triangles and quads by interpolating subdivision: every level makes four times "
        "the faces, and the vertices of the input stay where they are.",
        epilog="`jaxsubdiv compare MESH --truth SURFACE` measures all schemes on a mesh; see its own --help. "
        "Files: .obj .ply .off .stl .npz; .vtp .vtk .gii with the extra `io`. The formats differ in what they "
        "hold: .stl has no quads. Exit status: 0 done, 2 the input or the arguments cannot be used.",
    )
    add = parser.add_argument
    add("input", metavar="IN", help="control mesh")
    add("output", metavar="OUT", help="refined mesh; an older file is replaced once the new one is complete")
    add("--levels", type=int, default=3, metavar="N", help=f"how many levels, 0 to {MAX_LEVELS} (default: 3)")
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
