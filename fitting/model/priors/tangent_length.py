"""The tangent length coefficient h stays near 1."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..unknowns import AnyArray, Shared
from .base import AbstractVertexPrior, Place, Start


class TangentLength(AbstractVertexPrior):
    """h is 1, give or take its standard deviation; it is there wherever h is free, for it brings that unknown.

    Attributes:
        start: h where the fit starts, one or one a level.
        deviation: standard deviation of each.
    """

    name: ClassVar[str] = "h"
    uses: ClassVar[tuple[str, ...]] = ("h",)
    start: Float[Array, "..."]
    deviation: Float[Array | np.ndarray, ""]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "TangentLength | None":
        return cls(start.scheme.h, priors.h) if start.has_h else None

    def shared_unknowns(self) -> dict[str, Shared]:
        # In a sensible mesh the surface moves by about a tenth of an edge for a change of h by one.
        return {"h": Shared(self.start.shape, lever=0.1)}

    def initial_values(self) -> dict[str, Array]:
        return {"h": self.start}

    def rows(self, place: Place, held: None) -> Float[Array, "n"]:
        return jnp.atleast_1d(place.shared["h"]).astype(place.edge.dtype) - 1

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return self.deviation**-2

    def vertices(self) -> Int[AnyArray, "n 0"]:
        return np.zeros((max(self.start.size, 1), 0), int)
