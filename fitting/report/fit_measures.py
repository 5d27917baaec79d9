"""What is measured of the surface of one fit, with standard deviations from its posterior.

To first order a measure is Gaussian about that of the fit. Its variance follows from its derivative by the vertices of
the surface, theirs by the unknowns, and the covariance of these.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

import jaxsubdiv as js

from ..start.cavities import find_valves
from .measures import Measures
from .posterior import Posterior


class Measure(NamedTuple):
    """A number that a surface is measured by.

    Attributes:
        name, unit: what it is, and in what.
        value: of the fitted surface.
        deviation: its standard deviation, posterior to scan and priors; without what the control mesh cannot follow.
    """

    name: str
    unit: str
    value: float
    deviation: float

    def __str__(self) -> str:
        return f"{self.value:.5g} +- {self.deviation:.2g} {self.unit}"


def measure_surface(
    posterior: Posterior, mesh: js.ControlMesh, valves: Sequence[str] | None = None
) -> tuple[Measure, ...]:
    """Measure the surface of a fit.

    Args:
        posterior: of the fit.
        mesh: its control mesh, with groups where it has any.
        valves: the groups that close the openings of cavities; default: those whose names say so.

    Raises:
        ValueError: a group is none of the mesh.
    """
    surface, structure = posterior.fit.surface(), posterior.equations.structure
    measures = Measures(posterior.fit.topology, surface, structure.patches.owner, mesh, find_valves(mesh, valves))
    walls = measures.walls(surface)

    def measure(vertices: Float[Array, "v 3"]) -> Float[Array, "m"]:
        return measures.measure(js.RefinedSurface(vertices, surface.normals, surface.faces), walls)

    values, back = jax.vjp(measure, surface.vertices)
    (gradients,) = jax.vmap(back)(np.eye(len(values), dtype=values.dtype))
    variances = np.diag(posterior.covariance_of(np.asarray(gradients, np.float64)))
    rows = zip(measures.columns, values.tolist(), np.sqrt(np.maximum(variances, 0)).tolist(), strict=True)
    return tuple(Measure(column.name, column.unit, value, deviation) for column, value, deviation in rows)
