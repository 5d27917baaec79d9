"""The options of `jaxsubdiv-fit`: what they are, their ranges, and the recipe that they ask for."""

import argparse
import dataclasses
import os
from pathlib import Path
from typing import get_args

import equinox as eqx
import jax.numpy as jnp

import jaxsubdiv as js
from jaxsubdiv import SCHEMES

from ..model.limits import check_numbers
from ..run.folder import CARRIED, LANDMARKS
from ..run.recipe import Recipe, load_cohort, load_recipe
from ..run.surface_files import FORMATS
from ..scan.example import Example
from ..start.parts import PartKind

_CONTACT = 0.25  # `Priors.contact` of --no-crossing
# What --series, --layers and --template-out have no use for.
_UNUSED = {
    "series": "tolerance points boundary landmarks control_landmarks carry mirror surface surface_level "
    "surface_tolerance tetrahedra patches symmetry prior template_out no_crossing details",
    "layers": "outside landmarks control_landmarks carry boundary regions label above labels prior",
    "template_out": "tolerance boundary landmarks control_landmarks regions likeness mirror align part surface "
    "surface_level surface_tolerance tetrahedra patches details no_crossing resume",
}
_MODES = {"series": "a series", "layers": "a fit of layers", "template_out": "a template of scans"}


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv-fit",
        description="Fit a control mesh, with its normals and h, to a scan, so that its smooth subdivision surface is "
        "the anatomy. The control mesh is aligned with the scan first, or made from it where none is given. Without "
        "SCAN it runs an example that ships with the package.",
        epilog="OUT gets control.obj (fitted control mesh with normals), surface.ply (refined surface, with the signed "
        "distance of the scan and the standard deviation of the surface in mm at every vertex, as in .glb, .vtp and "
        ".shape.gii), report.json, fit.html (a page to turn the surface in, without a network), fit.png, and fit.npz "
        "and recipe.json for `fitting.load`; with --carry landmarks.mrk.json and landmarks.csv; of several scans, a "
        "folder each, named by the scan, and where names are alike by its folders too, and summary.csv, and "
        "landmarks.csv with all landmarks. Files take their places together when a fit has ended; until then "
        "checkpoints mark OUT as "
        "unfinished. Lengths are in mm. A fit that was stopped, by Ctrl-C or otherwise, goes on from the last sweep "
        "when the same command is given again. Exit status: 0 the fit converged and nothing speaks against it, 1 it "
        "is not to be trusted (the warnings say why; files are written all the same), 2 an input cannot be used, 130 "
        "stopped by Ctrl-C.",
    )
    add = parser.add_argument
    add(
        "scans",
        nargs="*",
        metavar="SCAN",
        help="points, meshes, label maps or images, or folders of them: .ply .xyz .csv .vtp .nii.gz .nrrd",
    )
    add("--control", metavar="MESH", help="template of triangles and quads to start from; default: made from the scan")
    add(
        "--template-out",
        metavar="MESH",
        help="make one template of all scans, which the first has no more part in than the others, and write it; with "
        "--symmetry it has a mirror plane; OUT, where it is given, gets the fits",
    )
    add(
        "--prior",
        metavar="FITS",
        help="folder of the fits of a family: what the scan lacks is filled as the family varies; without --control, "
        "their mean is the template",
    )
    add("-o", "--output", metavar="OUT", help="folder for the results (default: fit_ and the scan's file, or fits)")
    add("--faces", type=int, help=f"of the control mesh, where it is made (default: {Recipe.faces})")
    add("--kind", choices=("triangle", "quad"), help=f"of these faces (default: {Recipe.kind})")
    add("--closed", action=argparse.BooleanOptionalAction, help="whether the anatomy is; default: found from the scan")
    add("--part", choices=get_args(PartKind), help="of a scan that shows several; default: the largest, with a warning")
    add("--outside", action="store_true", help="fit the points that are seen from outside alone, as of a skull's shell")
    add("--mirror", action="store_true", help="fit the template's mirror image: that of the other side of the body")
    add("--align", choices=("similarity", "rigid", "affine", "none"), help=f"of the template (default: {Recipe.pose})")
    add("--landmarks", metavar="FILE", help="named places on the scan: .mrk.json .json .csv .tsv .fcsv")
    add("--control-landmarks", metavar="FILE", help="the same names on the template")
    add(
        "--carry",
        metavar="FILE",
        help="landmarks on the template, put onto the fitted surface: landmarks.mrk.json and landmarks.csv in OUT",
    )
    add("--symmetry", type=float, metavar="MM", help="keep the fit as symmetric as the template, but for so much")
    add(
        "--likeness",
        type=float,
        metavar="SHARE",
        help="of the template's own shape, expected of the fit; default: found. 0 where it was made from this scan",
    )
    add(
        "--no-crossing",
        action="store_true",
        help="do not let the surface pass through itself; takes longer, and the extra `contact`",
    )
    add("--boundary", metavar="FILE", help="points of the curve that the open surface ends at; `scan`: the scan's rim")
    add("--tolerance", type=float, metavar="MM", help="split the control mesh until the surface is this near the scan")
    add("--points", type=int, metavar="N", help="fit no more than so many, drawn at random; all of them are measured")
    add("--labels", nargs="+", metavar="WORD", default=[], help="only rows of a table whose label holds one of these")
    add(
        "--regions",
        metavar="FILE",
        help="JSON, label of the scan: group of the template's faces; default: by the names",
    )
    add(
        "--layers",
        metavar="FILE",
        help="fit several surfaces at once, such as lining and outside of a wall: JSON, layer: label of its points, "
        "from the inside out; of a label map, the labels of all inside it; OUT gets layers/ with each, and thickness",
    )
    add(
        "--series",
        action="store_true",
        help="the scans are frames of one anatomy in the order of their names: fitted at once, with --control, one "
        "shift a slice; OUT gets series.csv, series.html, series.gif, and frames/ with the surface of each",
    )
    add("--periodic", action="store_true", help="of --series: the first frame follows the last, as in a heartbeat")
    add(
        "--valves",
        nargs="+",
        metavar="GROUP",
        help="of --series: the template's groups that close cavities; default: those whose names hold VALVE",
    )
    add("--label", metavar="LABEL", help="of a label map: a value, a name, or `all`, a fit each; default: the only one")
    add(
        "--above", type=float, metavar="VALUE", help="of a grey image: the value at the surface, which is lower outside"
    )
    add("--scale", type=float, default=1.0, help="multiplies the scan's coordinates; 1000 for metres")
    add("--control-scale", type=float, default=1.0, help="multiplies the control mesh's coordinates")
    add("--levels", type=int, help=f"levels of refinement, 1 to 8 (default: {Recipe.levels})")
    add(
        "--surface",
        nargs="+",
        metavar="FORMAT",
        choices=FORMATS,
        default=["ply"],
        help=f"of the surface's files: {', '.join(FORMATS)} (default: ply)",
    )
    add(
        "--surface-level",
        type=int,
        metavar="N",
        help="levels of the surface that is written, 0 to 8 (default: those of the fit)",
    )
    add(
        "--surface-tolerance",
        type=float,
        metavar="MM",
        help="as many levels as bring the flat faces of that surface so near to its limit, which is measured",
    )
    add(
        "--tetrahedra",
        nargs="?",
        type=float,
        const=True,
        metavar="EDGE",
        help="fill the closed surface for finite elements, with edges of about EDGE mm (default: a twentieth of the "
        "diagonal): tetrahedra.vtu",
    )
    add(
        "--patches",
        nargs="?",
        type=int,
        const=1,
        metavar="N",
        help="the surface as Bézier patches, one a face at level N (default: 1): patches.vtu, and patches.xml of quads",
    )
    add("--scheme", choices=tuple(SCHEMES), help="default: interpolating")
    add("--h", type=float, help="tangent length coefficient at the start, for schemes that have one (default: 1)")
    add("--max-sweeps", type=int, help=f"pairing and solving in turns (default: {Recipe.max_sweeps})")
    add("--details", action="store_true", help="measure curvature, centre, moments of inertia and asymmetry, too")
    add(
        "--recipe", metavar="FILE", help="recipe.json of a fit: its settings; files, --scale and --labels are not in it"
    )
    add(
        "--resume",
        action="store_true",
        help="skip the scans, or the series, that OUT has whole fits of, from the same inputs and options",
    )
    add("--example", choices=get_args(Example), default="head_fragment", help="which, without SCAN")
    return parser


def check_options(options: argparse.Namespace) -> None:
    """See that every option is of use and that numbers lie in their ranges, and name them as they were typed.

    Raises:
        ValueError: an option would be passed over, or is out of its range.
    """
    _refuse_unused(options)
    names = {"tolerance_mm": "tolerance", "most_points": "points"}
    names |= {name: name for name in ("levels", "max_sweeps", "faces", "symmetry", "likeness", "h", "surface_level")}
    names |= {name: name for name in ("scale", "control_scale", "surface_tolerance")}
    names |= {"patch_level": "patches"}
    typed = {name: f"--{option.replace('_', '-')}" for name, option in names.items()}
    check_numbers({name: getattr(options, option) for name, option in names.items()}, typed)
    edge = None if options.tetrahedra is True else options.tetrahedra
    check_numbers({"edge": edge}, {"edge": "--tetrahedra"})
    if options.surface_level is not None and options.surface_tolerance is not None:
        raise ValueError("--surface-tolerance finds the level of the surface: leave --surface-level out.")
    if options.carry and os.path.abspath(options.carry) in _landmark_files(options):
        raise ValueError(f"--carry {options.carry} would be replaced by the landmarks of the fit: give another -o OUT.")


def _refuse_unused(options: argparse.Namespace) -> None:
    usual = make_parser().parse_args([])
    for mode, names in _UNUSED.items():
        if getattr(options, mode) == getattr(usual, mode):
            continue
        for name in names.split():
            if getattr(options, name) != getattr(usual, name):
                raise ValueError(f"--{name.replace('_', '-')} is not of {_MODES[mode]}: leave it out.")


def _landmark_files(options: argparse.Namespace) -> list[str]:
    """Where the named output folder gets landmarks."""
    return [os.path.abspath(Path(options.output or "fits") / name) for name in (LANDMARKS, CARRIED)]


def make_recipe(options: argparse.Namespace) -> Recipe:
    """The settings: those of a recipe, or the defaults, and before them what was given beside it."""
    recipe = Recipe(js.Interpolating()) if options.recipe is None else load_recipe(options.recipe)
    scheme = recipe.scheme if options.scheme is None else SCHEMES[options.scheme]()  # pyright: ignore[reportCallIssue]
    if options.h is not None:
        if scheme.h is None:
            raise ValueError(f"the scheme {type(scheme).__name__} has no h: leave --h out.")
        scheme = eqx.tree_at(lambda s: s.h, scheme, jnp.asarray(options.h, scheme.h.dtype))
    given = {name: getattr(options, name) for name in ("levels", "faces", "kind", "closed", "part", "max_sweeps")}
    given |= {"tolerance_mm": options.tolerance, "most_points": options.points}
    given = {name: value for name, value in given.items() if value is not None}
    if options.align is not None:
        given["pose"] = None if options.align == "none" else options.align
    if options.mirror:
        given["mirror"] = True
    asked = {name: getattr(options, name) for name in ("symmetry", "likeness") if getattr(options, name) is not None}
    if options.no_crossing:
        asked["contact"] = _CONTACT
    if options.prior is not None:
        asked["shape"] = load_cohort(options.prior)
    if asked:
        given["priors"] = dataclasses.replace(recipe.priors, **asked)
    return dataclasses.replace(recipe, scheme=scheme, **given)
