"""A template of the command: one control mesh made from many scans."""

import argparse
from pathlib import Path

import numpy as np

import jaxsubdiv as js
from jaxsubdiv.console import colour

from ..run.folder import reserve_folder
from ..run.names import name_folders
from ..run.recipe import Recipe
from ..run.template import make_template
from .inputs import Source, read_inputs
from .messages import describe_size, report_failure
from .one import REFUSALS

_MOST_POINTS = 5000  # of a scan, where none are asked for: all scans are fitted in one program


def make_template_of_all(scans: list[Source], options: argparse.Namespace, recipe: Recipe) -> int:
    """Write the template, and the fits that it is the mean of where a folder for them is named."""
    try:
        js.check_can_write(options.template_out)
        names = name_folders([scan.as_file for scan in scans])
        given = options.symmetry
        options.symmetry = None  # of the template that is made, which no file has
        chosen = []
        for scan, name in zip(scans, names, strict=True):
            job = read_inputs(scan, options, recipe)
            print(f"scan     {name}: {job.scan.n_points:,} points, {describe_size(np.asarray(job.scan.points))}")
            chosen.append(job.scan.draw(recipe.most_points or _MOST_POINTS))
        found = make_template(
            chosen,
            faces=recipe.faces,
            kind=recipe.kind,
            closed=recipe.closed,
            symmetric=given is not None,
            scheme=recipe.scheme,
            levels=options.levels or 1,
            on_stage=lambda words: print(f"now      {words}"),
            priors=recipe.priors,
            max_sweeps=recipe.max_sweeps,
            names=[str(name) for name in names],
        )
        js.write_mesh(options.template_out, found.mesh)
        print(f"wrote    {options.template_out}: {len(found.mesh.vertices):,} vertices, {found.mesh.n_faces:,} faces")
        if options.output:
            with reserve_folder(Path(options.output)):
                found.cohort.save(options.output)
            print(f"wrote    the fits to {options.output}, for --prior")
    except REFUSALS as error:
        return report_failure(error)
    doubted = [name for name, trusted in zip(found.cohort.names, found.cohort.trusted, strict=True) if not trusted]
    if doubted:
        print(colour(f"WARNING  fits not to be trusted: {', '.join(doubted)}"))
    if not found.at_rest:
        print(colour(f"WARNING  the last mean still moved by {found.moved[-1]:.3g} mm: it depends on the first scan"))
    return 0 if found.at_rest and not doubted else 1
