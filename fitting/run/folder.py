"""The folder of a fit: of one run at a time, and with one fit in it, whole, or with a checkpoint as its mark."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .fit import CHECKPOINT
from .fit_scan import CHECKPOINT_START
from .surface_files import SURFACE_FILES

try:
    import fcntl
except ImportError:  # Windows: folders are not locked there
    fcntl = None

SUMMARY = "summary.csv"
FIT = "fit.npz"
"""What `fitting.load` reads; it is put in place after all other files."""
LANDMARKS, CARRIED = "landmarks.mrk.json", "landmarks.csv"
"""Landmarks that were carried to the fit, for 3D Slicer and as a table; beside the summary, a table of those of all."""
TETRAHEDRA, PATCHES = "tetrahedra.vtu", ("patches.vtu", "patches.xml")
TABLE_OF_SERIES, PAGE_OF_SERIES, NAMES_OF_SERIES = "series.csv", "series.html", "series.json"
ANIMATION = "series.gif"
FRAMES = "frames"
"""The folder in that of a series with the files of every frame."""
LAYERS, LAYER_CONTROL, LAYER_THICKNESS = "layers", "_control.obj", "_thickness.png"
"""The folder in that of a layered fit with the files of every layer, and how the names of two of these files end."""
RESULTS = ("control.obj", "surface.ply", "report.json", "fit.html", "recipe.json", "fit.png", FIT)
"""Of a fit without options."""
_SERIES = (TABLE_OF_SERIES, PAGE_OF_SERIES, NAMES_OF_SERIES, ANIMATION)
_EXPORTS = (TETRAHEDRA, *PATCHES)
_PLACED = (
    *SURFACE_FILES,
    *_EXPORTS,
    LANDMARKS,
    CARRIED,
    *_SERIES,
    *(name for name in RESULTS if name not in SURFACE_FILES),
)
_UNFINISHED = ".unfinished-"  # the folders of `jaxsubdiv.files.replace_file` and of `fill_folder`
_OURS = {*_PLACED, CHECKPOINT, CHECKPOINT_START, SUMMARY}


def find_results(folder: Path) -> set[str]:
    """Names of files that are results where they lie in this folder: of a fit only if it holds one, whole or not."""
    return _OURS if (folder / FIT).exists() or is_unfinished(folder) else {SUMMARY, CARRIED}


@contextmanager
def reserve_folder(folder: Path) -> Iterator[None]:
    """Make a folder, see that it can be written, keep other runs out of it, and clean up what killed ones left.

    Folders that were made and are empty at the end go again.

    Raises:
        OSError: the folder cannot be made or written.
        ValueError: another run is working in it.
    """
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _lock(folder):
            _clean(folder)
            with tempfile.TemporaryFile(dir=folder):
                pass
            yield
    finally:
        with suppress(OSError):  # a folder that holds something stays, and so do those around it
            for one in made:
                one.rmdir()


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """The system lets go of the folder when the process ends, in whatever way."""
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"another run is working in {folder}. Wait for it, or give another folder with -o."
            ) from None
        except OSError:  # a disk that knows no locks
            pass
        yield
    finally:
        os.close(handle)


def _clean(folder: Path) -> None:
    """Remove what a killed run was writing; files of other names are somebody's own."""
    for left in folder.glob(f"{_UNFINISHED}*/"):
        with suppress(OSError):
            for inner in (FRAMES, LAYERS):
                shutil.rmtree(left / inner, ignore_errors=True)
            for name in _OURS:
                (left / name).unlink(missing_ok=True)
            left.rmdir()
    if not (folder / CHECKPOINT_START).exists():  # a run that ended was killed while it removed its checkpoint
        (folder / CHECKPOINT).unlink(missing_ok=True)


def is_unfinished(folder: Path) -> bool:
    """Whether a run was stopped before its fit was whole in the folder."""
    return (folder / CHECKPOINT_START).exists()


def _remove_layers(folder: Path) -> None:
    """Remove the files of an earlier fit's layers, and the folder where nothing else lies in it."""
    for control in folder.glob(f"*{LAYER_CONTROL}"):
        name = control.name.removesuffix(LAYER_CONTROL)
        of_surface = (file.replace("surface", name, 1) for file in SURFACE_FILES)
        for file in (*of_surface, f"{name}{LAYER_THICKNESS}", control.name):
            (folder / file).unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def fill_folder(folder: Path) -> Iterator[Path]:
    """A folder to write the files of a fit to; they take their places together once the block is left without an error.

    The checkpoint, which marks the folder as unfinished, goes last. What an earlier fit left and this one did not write
    goes too.
    """
    new = Path(tempfile.mkdtemp(prefix=_UNFINISHED, dir=folder))
    try:
        yield new
        _remove_layers(folder / LAYERS)
        for inner in (FRAMES, LAYERS):
            if (new / inner).is_dir():  # file by file: the folder may hold others
                (folder / inner).mkdir(exist_ok=True)
                for file in (new / inner).iterdir():
                    os.replace(file, folder / inner / file.name)
        for name in _PLACED:
            if (new / name).exists():
                os.replace(new / name, folder / name)
            else:
                (folder / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    for name in (CHECKPOINT_START, CHECKPOINT):
        (folder / name).unlink(missing_ok=True)
