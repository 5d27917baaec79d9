"""`jaxsubdiv-fit`: what the options ask for, done."""

import sys
from collections.abc import Sequence
from pathlib import Path

from jaxsubdiv.console import simplify_warnings, survive_closed_streams

from ..run.names import name_folder
from ..run.surface_files import check_formats
from .exports import check_exports
from .frames import fit_frames
from .inputs import find_sources
from .many import fit_all
from .messages import report_failure
from .one import fit_one
from .options import check_options, make_parser, make_recipe
from .programs import calculate_in_one_thread, keep_compiled_programs
from .template import make_template_of_all


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line: exit status 0, 1 for a fit not to be trusted, 2 for an input of no use, 130 where stopped."""
    with survive_closed_streams(), simplify_warnings():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    parser = make_parser()
    options = parser.parse_args(arguments)
    if (options.control or options.prior) and not options.scans:
        which = "--control" if options.control else "--prior"
        parser.error(f"a control mesh needs a scan to be fitted to: give SCAN to {which}")
    if options.labels and not options.scans:
        parser.error("labels are those of a scan: give SCAN before --labels, which takes all the words that follow")
    if options.carry and not options.control:
        parser.error("--carry takes landmarks of a template to the scan: give the template, --control MESH")
    if not options.series and (options.periodic or options.valves):
        parser.error("--periodic and --valves are of frames: give --series")
    if options.series and not options.control:
        parser.error("--series fits a template to all frames: give --control MESH")
    if options.layers and (options.series or options.template_out or not options.scans):
        parser.error(
            "--layers is of scans that are fitted one by one: give SCAN, and neither --series nor --template-out"
        )
    if options.template_out and (options.control or options.prior or not options.scans):
        parser.error("--template-out makes a template of scans: give scans, and neither --control nor --prior")
    keep_compiled_programs()
    calculate_in_one_thread()
    try:
        check_options(options)
        scans, recipe = find_sources(options), make_recipe(options)
        check_formats(options.surface)
        check_exports(options)
    except (ValueError, OSError, ImportError) as error:
        return report_failure(error)
    try:
        if options.series:
            return fit_frames(scans, options, recipe)
        if options.template_out:
            return make_template_of_all(scans, options, recipe)
        if len(scans) > 1:
            return fit_all(scans, options, recipe)
        scan = scans[0] if scans else None
        folder = Path(options.output or (name_folder(scan.as_file) if scan else f"fit_{options.example}"))
        return fit_one(scan, folder, options, recipe, scan.title() if scan else options.example)["status"]
    except KeyboardInterrupt:
        again = "the same command goes on from the last sweep"
        if options.series or options.template_out:
            again = "the same command begins anew"
        elif len(scans) > 1:
            again += "; with --resume it skips the scans that are done"
        print(f"\nstopped  {again}", file=sys.stderr)
        return 130
