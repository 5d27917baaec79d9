"""What a prior is: rows that a fit makes small beside the distances, and what they depend on.

A prior is one file in this folder: its rows, in JAX, its tables, in numpy, and its precisions. One line in the register
of `fitting/model/priors/__init__.py` makes it part of fits, cohorts, saved fits, recipes and posteriors.

Half the squared sum of all rows, each over its standard deviation, is the negative logarithm of a probability: of the
scan given the surface, times that of the surface.
"""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.core import Tracer
from jaxtyping import Array, Float, Int

import jaxsubdiv as js

from ..unknowns import AnyArray, Shared


def backend(*values: Any) -> Any:
    """numpy for values that are known, jax.numpy while a program is traced."""
    return jnp if any(isinstance(value, Tracer) for value in values) else np


class Place(NamedTuple):
    """Where rows are evaluated: the variables, and the surface that they make."""

    scheme: js.AbstractScheme
    topology: js.Topology
    control: js.Control
    shared: dict[str, Array]
    """Values of the shared unknowns."""
    surface: js.RefinedSurface | None
    """None for priors that do not look at it."""
    template: Float[Array, "v 3"]
    """Control vertices where the fit started."""
    edge: Float[Array, ""]
    """Length of a control edge there, in mm."""
    before: js.RefinedSurface | None = None
    """The level before the last, where its normals are those of the surface: who asks for these alone spares a program
    the normals of the last level, which cost most."""

    @property
    def mesh(self) -> js.RefinedSurface:
        """A surface that has the control vertices and those of the first level on it, if there are two levels or more:
        the refined one or an earlier level of it, or the control mesh of a dual scheme."""
        if self.before is not None:
            return self.before
        if self.scheme.is_primal and self.surface is not None:
            return self.surface
        normals = js.estimate_normals(self.topology.control_fans, self.control.vertices)
        return js.RefinedSurface(self.control.vertices, normals, self.topology.control_faces)


class Start(NamedTuple):
    """Where a fit starts, on the host, and what its user gave: all that a prior makes its tables from."""

    scheme: js.AbstractScheme
    topology: js.Topology
    control: js.Control
    surface: js.RefinedSurface
    owner: Int[np.ndarray, "g"]
    """The control face of every face of the surface."""
    has_normals: bool
    """Whether any control normal is free."""
    has_h: bool
    """Whether h is free."""
    inputs: dict[str, Any]
    """What belongs to this scan alone, by name: landmarks, boundary, symmetry, alike, slices."""


class AbstractPrior(eqx.Module):
    """Rows that are small where the surface is as it is expected to be.

    A prior is made by `make(priors, start)`, from the settings `Priors` and what the scan brings; None leaves it out.
    """

    name: ClassVar[str]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "AbstractPrior | None":
        """The prior with its tables, built in numpy; it may raise."""
        raise NotImplementedError

    def shared_unknowns(self) -> dict[str, Shared]:
        """The unknowns that the prior brings along, which all rows share."""
        return {}

    def initial_values(self) -> dict[str, Array]:
        """Values of those that last, where the fit starts."""
        return {}

    def hold(self, place: Place, strengths: dict[str, Any]) -> Any:
        """What stays fixed during a sweep that starts from here: arrays."""
        return None

    def rows(self, place: Place, held: Any) -> Float[Array, "m"]:
        """Departures from what is expected, in mm where nothing else is said."""
        raise NotImplementedError

    def precisions(self, strengths: dict[str, Any]) -> Any:
        """1 / variance of the rows: an array of them, or one for all."""
        raise NotImplementedError

    def strip_strengths(self) -> "AbstractPrior":
        """The prior without what only its strengths depend on: whether those are given or found, one compiled program
        has its rows."""
        return self

    @property
    def n_strengths(self) -> int:
        """How many strengths, 1 / variances of its rows, the prior has that a fit finds or anneals."""
        return 0

    def first_strengths(self) -> Float[AnyArray, "s"]:
        """Those of the first sweep."""
        raise NotImplementedError

    def given_strengths(self) -> Float[AnyArray, "s"] | None:
        """Those that the settings ask for; None where they are found from the scan."""
        return None

    def strength_rows(self) -> Int[AnyArray, "m"]:
        """Which strength that of each row is; -1 for rows whose variance is known."""
        raise NotImplementedError


class AbstractFacePrior(AbstractPrior):
    """A prior each of whose rows depends on the unknowns of one control face's neighbourhood, and on h."""

    def faces(self, held: Any) -> Int[AnyArray, "m"]:
        """The control face of every row."""
        raise NotImplementedError

    def differentiate_shifts(self, held: Any) -> sp.csr_array | None:
        """Derivatives of the rows by the shifts of slices, two a slice; None where there are none."""
        return None


class AbstractVertexPrior(AbstractPrior):
    """A prior whose rows each depend on few control vertices anywhere, and on shared unknowns; not on the surface."""

    uses: ClassVar[tuple[str, ...]] = ()
    """Names of the shared unknowns that its rows depend on."""
    is_distant: ClassVar[bool] = False
    """Whether its rows couple vertices that lie far from each other over the surface, many of them."""

    def vertices(self) -> Int[AnyArray, "m c"]:
        """The control vertices of every row."""
        raise NotImplementedError


class AbstractSurfacePrior(AbstractPrior):
    """A prior whose rows each depend on few vertices of the surface, anywhere on it, and of which every sweep has
    another number: so that no compiled program has to know it, their derivatives are found in numpy."""

    def corners(self, held: Any) -> Int[AnyArray, "m c"]:
        """The vertices of the surface of every row."""
        raise NotImplementedError

    def linearise(
        self, vertices: Float[np.ndarray, "v 3"], held: Any
    ) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m c 3"]]:
        """The rows, and their derivatives by the coordinates of these vertices."""
        raise NotImplementedError
