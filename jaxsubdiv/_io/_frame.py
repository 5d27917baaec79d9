"""The frame that the header of a mesh file names, in the words of 3D Slicer: `SPACE=LPS` in a comment."""

import re
from pathlib import Path

from ..frames import Frame

_BEGIN = 4096  # bytes that may hold a header
_SPACE = re.compile(r"\bSPACE *= *(LPS|RAS)\b", re.IGNORECASE)
# Where each format has comments: elsewhere the word is somebody's name, or chance.
_COMMENTS = {
    ".obj": re.compile(r"^#.*", re.MULTILINE),
    ".ply": re.compile(r"^comment .*", re.MULTILINE),
    ".vtk": re.compile(r"\A.*\n.*"),
    ".stl": re.compile(r"\A.{1,80}", re.DOTALL),
}


def find_space(path: Path) -> Frame | None:
    """The frame that the header names; None where it names none, and for formats without comments."""
    comments = _COMMENTS.get(path.suffix.lower())
    if comments is None:
        return None
    with path.open("rb") as file:
        head = file.read(_BEGIN).decode("latin-1")
    for comment in comments.findall(head):
        if named := _SPACE.search(comment):
            return "LPS" if named[1].upper() == "LPS" else "RAS"
    return None


def space_words(frame: Frame | None) -> str:
    """What a comment says of the frame, for `find_space` and 3D Slicer; nothing of one that is not known."""
    return "" if frame is None else f"SPACE={frame}"
