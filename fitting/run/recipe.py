"""The settings of a fit as a small JSON file, which fits the next scan in the same way, from the points on."""

import dataclasses
import functools
import json
import os
from pathlib import Path
from typing import Any

import jaxsubdiv as js

from ..model.recipe import Settings
from ..report.cohort import COHORT, Cohort, name_subjects
from ..report.result import FitResult
from ..report.saved import load_fit
from ..scan.regions import match_regions
from ..scan.scan import Scan
from . import fit as _fit
from . import fit_scan as _fit_scan
from .fit_scan import ScanFit


@dataclasses.dataclass(frozen=True)
class Recipe(Settings):
    __doc__ = Settings.__doc__

    def fit(self, mesh: js.ControlMesh, scan: Scan, **options: Any) -> FitResult:
        """Fit a control mesh to a scan in this way.

        Args:
            mesh: where the fit starts, roughly aligned with the scan and in mm. Where it has groups of faces, labels of
                the scan are matched with them by their names, see `match_regions`.
            scan: the measured points in mm.
            options: more for `fit`, such as `throw` and `on_sweep`; they come before the recipe's own.
        """
        own = {"free": self.free, "priors": self.priors, "loss": self.loss}
        own |= {"max_sweeps": self.max_sweeps, "tolerance": self.tolerance}
        own |= {"landmark_deviation": self.landmark_deviation, "regions": match_regions(scan, mesh)}
        control = mesh.control(weights=self.scheme.weights)
        return fit(self.scheme, self.topology(mesh), control, scan, **(own | options))

    def fit_scan(self, scan: Scan, mesh: js.ControlMesh | None = None, **options: Any) -> ScanFit:
        """Fit a scan from end to end in this way, as `fit_scan` does.

        Args:
            scan: in mm.
            mesh: the template; default: a control mesh is made from the scan.
            options: more for `fit_scan`, such as `landmarks` and `throw`; they come before the recipe's own.
        """
        own = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return fit_scan(scan, mesh, **(own | options))


def load_recipe(path: str | os.PathLike[str]) -> Recipe:
    """The recipe of a file, such as the `recipe.json` of a saved fit: `load_recipe(path).fit_scan(scan)`.

    Raises:
        OSError: there is no such file.
        ValueError: it is no recipe; the text names the file and what is wrong.
    """
    try:
        return Recipe.from_json(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def _add_recipe(result: FitResult) -> FitResult:
    """The result with settings that can fit the next scan."""
    settings = result.recipe
    result.recipe = Recipe(**{field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)})
    return result


@functools.wraps(_fit.fit)
def fit(*arguments: Any, **options: Any) -> FitResult:
    return _add_recipe(_fit.fit(*arguments, **options))


@functools.wraps(_fit_scan.fit_scan)
def fit_scan(*arguments: Any, **options: Any) -> ScanFit:
    found = _fit_scan.fit_scan(*arguments, **options)
    return found._replace(result=_add_recipe(found.result))


def load(folder: str | os.PathLike[str]) -> FitResult:
    """The fit that `FitResult.save` wrote into a folder, with its report, its uncertainty and its refit.

    Numbers come in JAX's default floating dtype. `recipe.json` is not read; it is for fits of other scans.

    Args:
        folder: the one that was saved to.

    Raises:
        FileNotFoundError: there is no saved fit in the folder.
        ValueError: the file is damaged, incomplete or of a later version; the text names it and says what is wrong.
    """
    found, recipe = load_fit(folder)
    return FitResult(found, recipe=Recipe.from_json(recipe))


def load_cohort(folder: str | os.PathLike[str]) -> Cohort:
    """The cohort that `Cohort.save` wrote into a folder, or one of all fits in the folders of `jaxsubdiv-fit`.

    The order is that of the saved cohort; of other fits, that of the names of their folders.

    Args:
        folder: with a folder of each fit in it.

    Raises:
        FileNotFoundError: there are no saved fits in the folder, or one of the cohort's is missing.
        ValueError: a file is damaged, or the fits do not have one control mesh; see `Cohort.of`.
    """
    folder = Path(folder)
    names = find_fits(folder)
    try:
        return Cohort.of([load(folder / name) for name in names], names)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from None


def find_fits(folder: Path) -> tuple[str, ...]:
    """The names of the folders with fits in a cohort's folder, in the cohort's order or that of the names.

    Raises:
        FileNotFoundError: there are none.
        ValueError: the file of the cohort is damaged.
    """
    names = _saved_names(folder / COHORT)
    if names is None:
        names = tuple(sorted(path.parent.name for path in folder.glob("*/fit.npz")))
    if not names:
        raise FileNotFoundError(f"{folder} has no folders with saved fits in it: it is not that of a cohort.")
    return names


def _saved_names(path: Path) -> tuple[str, ...] | None:
    """The names in a saved cohort's file, in their order; None where there is no such file."""
    if not path.is_file():
        return None
    try:
        names = json.loads(path.read_text(encoding="utf-8"))["names"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError("'names' is no list of words")
        return name_subjects(len(names), names)
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: {error}. It is not the file of a saved cohort.") from None
