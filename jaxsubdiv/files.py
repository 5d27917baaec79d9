"""Files that are complete or not there: written beside their place, then moved to it."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replace_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A path to write to; what was written takes the place of `path` once the block is left without an error.

    The file has its own name there, in a folder beside its place and so on the same disk: messages give its name, and
    the move is one step.
    """
    path = Path(path).resolve()  # so that a link stays one, and the file behind it is replaced
    with tempfile.TemporaryDirectory(prefix=".unfinished-", dir=path.parent) as folder:
        unfinished = Path(folder) / path.name
        yield unfinished
        if path.exists():
            shutil.copymode(path, unfinished)
        os.replace(unfinished, path)
