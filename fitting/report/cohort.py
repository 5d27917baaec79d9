"""What `fit_cohort` returns: many fits of one control mesh, and each of them as `fit` gives it."""

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.files import replace_file

from ..finding import Finding
from ..scan.scan import Scan
from .result import FitResult

COHORT = "cohort.json"
CHECKPOINT_OF_COHORT = "checkpoint_of_cohort_{}.npz"
"""A file of what `fit_cohort` has finished, by what it is."""


@final
@dataclasses.dataclass(frozen=True)
class Cohort:
    """Many scans fitted with one control mesh: row `i` of every array belongs to scan `i`, and vertices correspond.

    Attributes:
        control: control vertices (mm) and unit normals `[s, v, 3]`.
        h: the fitted tangent length coefficients, one row a scan; None where the scheme has none.
        surfaces: vertices and normals `[s, w, 3]` of the refined surfaces; the faces are those of all.
        converged: which fits came to rest, and not where they started far from the scan. The others are what there was
            when the sweeps ran out or went astray.
        sweeps: how many each took.
        rms, robust_rms: as in `FitResult`, at the start and after every sweep; NaN beyond the last.
        noise: standard deviation of the Gaussian part of each scan's distances, in mm.
        weights: how much each point counts at the end, `[s, p]`; 0 past a scan's last point.
        scans: what was fitted.
        names: of the scans, for files; default: their numbers.
        failed: why a scan could not be fitted, by its name, of those that were left out.
    """

    control: js.Control
    h: Float[Array, "s ..."] | None
    surfaces: js.RefinedSurface
    converged: Bool[np.ndarray, "s"]
    sweeps: Int[np.ndarray, "s"]
    rms: Float[np.ndarray, "s sweeps"]
    robust_rms: Float[np.ndarray, "s sweeps"]
    noise: Float[np.ndarray, "s"]
    weights: Float[np.ndarray, "s p"]
    scans: tuple[Scan, ...]
    names: tuple[str, ...]
    _results: Callable[[int], FitResult]
    failed: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, results: Sequence[FitResult], names: Sequence[str] | None = None) -> "Cohort":
        """A cohort of fits of one control mesh, however they were made.

        Args:
            results: two or more need the same control faces, levels and scheme.
            names: of the scans, one each; default: their numbers.

        Raises:
            ValueError: there are no fits, their control meshes do not correspond, or names are missing.
        """
        results = tuple(results)
        if not results:
            raise ValueError("a cohort needs one fit or more.")
        first = results[0]
        for i, other in enumerate(results):
            faces = (one.fit.topology.control_faces for one in (first, other))
            same = eqx.tree_equal(*faces) and first.surface.vertices.shape == other.surface.vertices.shape
            if not same or type(first.scheme) is not type(other.scheme):
                raise ValueError(
                    f"fit {i} has another control mesh, scheme or number of levels than fit 0: the vertices of a "
                    "cohort correspond. Fit all scans with one template, in the same way."
                )
        controls, surfaces = [one.control for one in results], [one.surface for one in results]
        h = [one.scheme.h for one in results]
        return cls(
            control=jax.tree.map(lambda *rows: jnp.stack(rows), *controls),
            h=None if first.scheme.h is None else jnp.stack([jnp.asarray(one) for one in h]),
            surfaces=js.RefinedSurface(
                jnp.stack([one.vertices for one in surfaces]),
                jnp.stack([one.normals for one in surfaces]),
                first.surface.faces,
            ),
            converged=np.array([bool(one.result == optx.RESULTS.successful) for one in results]),
            sweeps=np.array([len(one.rms) - 1 for one in results]),
            rms=pad_rows([one.rms for one in results], np.nan),
            robust_rms=pad_rows([one.robust_rms for one in results], np.nan),
            noise=np.array([one.noise for one in results]),
            weights=pad_rows([one.weights for one in results], 0.0),
            scans=tuple(one.scan for one in results),
            names=name_subjects(len(results), names),
            _results=results.__getitem__,
        )

    def __len__(self) -> int:
        return len(self.scans)

    def result(self, i: int) -> FitResult:
        """The fit of scan `i` as `fit` gives it, with report, uncertainty and `save`; made when it is asked for."""
        return self._results(i)

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the fits into a folder, made where there is none, for `fitting.load_cohort`.

        Each fit has a folder of its name in it, as `FitResult.save` writes it, and `cohort.json` has the names in their
        order. That file is written last; then the checkpoints of `fit_cohort` that are in the folder go.

        Raises:
            OSError: a folder cannot be made or written.
            ValueError: a fit cannot be saved, see `FitResult.save`.
        """
        folder = Path(folder)
        for i, name in enumerate(self.names):
            self.result(i).save(folder / name)
        with replace_file(folder / COHORT) as path:
            path.write_text(json.dumps({"names": self.names}, indent=2) + "\n", encoding="utf-8")
        for left in folder.glob(CHECKPOINT_OF_COHORT.format("*")):
            left.unlink(missing_ok=True)

    @functools.cached_property
    def warnings(self) -> tuple[tuple[Finding, ...], ...]:
        """What speaks against the fit of each scan, as `FitResult.warnings` has it; made when first asked for."""
        return tuple(tuple(self.result(i).warnings) for i in range(len(self)))

    @property
    def trusted(self) -> Bool[np.ndarray, "s"]:
        """Which fits nothing speaks against."""
        return np.array([not found for found in self.warnings])


def name_subjects(n: int, names: Sequence[str] | None) -> tuple[str, ...]:
    """Names of n subjects, each fit for a folder; by default their numbers, all as long.

    Raises:
        ValueError: there are more or fewer names, two are the same, or one is no name of a folder.
    """
    if names is None:
        return tuple(f"{i:0{len(str(max(n - 1, 0)))}d}" for i in range(n))
    names = tuple(names)
    if len(names) != n:
        raise ValueError(f"there are {n} scans and {len(names)} names: give one each.")
    for i, name in enumerate(names):
        if name in ("", ".", "..") or set(name) & set('/\\:*?"<>|') or name in names[:i]:
            raise ValueError(f"{name!r} cannot name a scan: names are different, and each is one of a folder.")
    return names


def pad_rows(rows: Sequence[Float[np.ndarray, "_"]], value: float) -> Float[np.ndarray, "s m"]:
    """Rows of different lengths as one array."""
    found = np.full((len(rows), max(map(len, rows))), value)
    for row, own in zip(found, rows, strict=True):
        row[: len(own)] = own
    return found
