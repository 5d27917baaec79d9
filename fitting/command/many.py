"""Many fits of the command: a folder each, and tables of all."""

import argparse
import csv
import io
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from jaxsubdiv.files import replace_file

from ..run.folder import CARRIED, SUMMARY, reserve_folder
from ..run.names import name_folders
from ..run.recipe import Recipe
from .inputs import Source
from .messages import report_failure
from .one import fit_one

_COLUMNS = (
    "scan",
    "status",
    "seconds",
    "points",
    "rms_mm",
    "percentile_95_mm",
    "noise_mm",
    "misfit_mm",
    "inlier_share",
    "warnings",
)


def fit_all(scans: list[Source], options: argparse.Namespace, recipe: Recipe) -> int:
    """Every scan into a folder of its own, going on after a failure, and a table of all."""
    parent = Path(options.output or "fits")
    counts = Counter(scan.title() for scan in scans)
    titles = [scan.title(whole=counts[scan.title()] > 1) for scan in scans]
    folders = name_folders([scan.as_file for scan in scans])
    rows, summary, landmarks = [], "", []
    try:
        with reserve_folder(parent):
            for number, (scan, title, name) in enumerate(zip(scans, titles, folders, strict=True), 1):
                print(f"\n[{number}/{len(scans)}] {scan.title(whole=True)}")
                rows.append(fit_one(scan, parent / name, options, recipe, title))
                summary = _format_csv(rows, _COLUMNS)
                _write_table(parent / SUMMARY, summary)  # after every scan: the run may be stopped
                if options.carry and rows[-1]["status"] < 2:
                    landmarks += _read_landmark_rows(parent / name / CARRIED, title)
                    columns = dict.fromkeys(column for row in landmarks for column in row)
                    _write_table(parent / CARRIED, _format_csv(landmarks, tuple(columns)))
    except (ValueError, OSError) as error:
        return report_failure(error)
    print(f"\n{summary}\nwrote    {parent / SUMMARY}{f' and {CARRIED}' if landmarks else ''}")
    failed = [row["scan"] for row in rows if row["status"]]
    if failed:
        print(f"{len(failed)} of {len(rows)} did not end well: {', '.join(failed)}", file=sys.stderr)
    return max(row["status"] for row in rows)


def _format_csv(rows: list[dict], columns: Sequence[str]) -> str:
    table = io.StringIO()
    writer = csv.DictWriter(table, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return table.getvalue()


def _read_landmark_rows(path: Path, title: str) -> list[dict]:
    """The landmarks of one scan, as its folder has them."""
    with path.open(encoding="utf-8", newline="") as file:
        return [{"scan": title} | row for row in csv.DictReader(file)]


def _write_table(path: Path, text: str) -> None:
    """Tell where that fails, and go on: the fits of the next scans do not depend on it."""
    try:
        with replace_file(path) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    except OSError as error:
        report_failure(error)
