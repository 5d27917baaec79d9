"""Which files are scans, and the name of the folder that each gets."""

import os
import unicodedata
from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path

from ..image.read import is_image, stem
from .folder import CARRIED, SUMMARY, find_results

_SCAN_FILES = {".ply", ".xyz", ".csv", ".txt", ".npz", ".vtp", ".vtk", ".stl", ".obj", ".off", ".gii"}
_SCAN_FILES |= {".vtu", ".glb", ".pcd", ".pts", ".hsp"}
_SEPARATORS = '/\\:*?"<>|'  # of folders, and what no file on Windows may have in its name
_LONGEST = 200  # bytes: file systems take 255, and a file that is being written has a longer name


def find_scans(given: Sequence[Path]) -> list[Path]:
    """The files named, and those in the folders named in order of their names, each once.

    What an earlier fit left in such a folder is none of them.

    Raises:
        ValueError: a folder holds no scan.
    """
    scans = []
    for path in given:
        if not path.is_dir():
            scans.append(path)
            continue
        results = find_results(path)
        inside = sorted(file for file in path.iterdir() if _is_scan(file) and file.name.lower() not in results)
        if not inside:
            raise ValueError(f"the folder {path} holds no scan: {', '.join(sorted(_SCAN_FILES))}.")
        scans += inside
    return list({os.path.abspath(scan): scan for scan in scans}.values())


def _is_scan(file: Path) -> bool:
    return (file.suffix.lower() in _SCAN_FILES or is_image(file)) and not file.is_dir()


def name_folders(scans: Sequence[Path]) -> list[str]:
    """A folder's name for each of these files, no two alike on any file system.

    A scan is named by its stem; where another has that too, by its whole name, and then by more and more of the folders
    that it lies in; where all of that is alike, by a number too.
    """
    choices = [_choices(scan) for scan in scans]
    steps = [0] * len(scans)
    while True:
        names = [options[step] for options, step in zip(choices, steps, strict=True)]
        counts = Counter(map(_key, names))
        more = [
            i
            for i, name in enumerate(names)
            if steps[i] < len(choices[i]) - 1 and (counts[_key(name)] > 1 or _is_bad(name))
        ]
        if not more:
            return _number(names)
        for i in more:
            steps[i] += 1


def name_folder(scan: Path) -> str:
    """The folder's name for a file that is fitted alone: its place below here, so that no other file there has it."""
    path, here = Path(os.path.abspath(scan)), Path.cwd()
    parts = path.relative_to(here).parts if path.is_relative_to(here) else path.parts[1:]
    return _number(["_".join(("fit", *parts))])[0]


def _choices(scan: Path) -> list[str]:
    """Names for one scan, from the shortest on."""
    parts = Path(os.path.abspath(scan)).parts[1:]
    return [stem(scan)] + ["_".join(parts[i:]) for i in reversed(range(len(parts)))]


def _key(name: str) -> str:
    """What names share that some file system takes for one: capitals, accents in two spellings, dots at the end."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold()).rstrip(". ")


def check_names(names: Sequence[str], what: str) -> None:
    """See that files can have these names, in one folder and on any file system.

    Args:
        names: without an ending.
        what: they are the names of, as `layer`.

    Raises:
        ValueError: a name is none of a file, or two are one on some file system; the text has it.
    """
    taken = dict[str, str]()
    for name in names:
        if _is_bad(name) or any(c in _SEPARATORS or not c.isprintable() for c in name):
            raise ValueError(
                f"the {what} {name!r} cannot name a file: leave out {' '.join(_SEPARATORS)}, and take a word of up to "
                f"{_LONGEST} bytes."
            )
        other = taken.setdefault(_key(name), name)
        if other != name:
            raise ValueError(f"the names of the {what}s {other!r} and {name!r} are one on some file systems.")


def _is_bad(name: str) -> bool:
    """Whether a folder cannot have the name, as `..`, or not beside the tables of all."""
    return _key(name) in ("", SUMMARY, CARRIED) or len(os.fsencode(name)) > _LONGEST


def _number(names: list[str]) -> list[str]:
    taken, found = {_key(name) for name in names}, []
    seen: set[str] = set()
    for name in names:
        if _key(name) in seen or _is_bad(name):
            short = os.fsencode(name)[:_LONGEST].decode("utf-8", "ignore")
            name = next(new for i in count(2) if _key(new := f"{short}-{i}") not in taken)
            taken.add(_key(name))
        seen.add(_key(name))
        found.append(name)
    return found
