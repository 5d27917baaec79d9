"""Control normals do not lean from the faces around them so far that the surface folds."""

from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js

from ..unknowns import AnyArray
from .base import AbstractFacePrior, Place, Start

# A normal that leans less than this, as a cosine, from the faces around it keeps the surface smooth; it may be a little
# under it, by the softness, at a standard deviation of the spread.
_MARGIN, _SOFTNESS, _SPREAD = 0.2, 0.1, 0.02


class Margin(AbstractFacePrior):
    """The cosine between a control normal and each face at its vertex is above a margin; see `js.admissible_margin`."""

    name: ClassVar[str] = "margin"
    n_triangles: int = eqx.field(static=True)
    n_quads: int = eqx.field(static=True)

    @classmethod
    def make(cls, priors: Any, start: Start) -> "Margin | None":
        if not start.scheme.uses_normals:
            return None
        return cls(*(len(start.topology.control_faces[size]) for size in (3, 4)))

    def rows(self, place: Place, held: None) -> Float[Array, "m"]:
        """One a corner of the control faces, over its own standard deviation."""
        margin = js.corner_cosines(place.control.vertices, place.control.normals, place.topology.control_faces)
        return jax.nn.softplus((_MARGIN - margin) / _SOFTNESS) * (_SOFTNESS / _SPREAD)

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return 1.0

    def faces(self, held: Any) -> Int[AnyArray, "m"]:
        quads = self.n_triangles + np.arange(self.n_quads)
        return np.concatenate([np.tile(np.arange(self.n_triangles), 3), np.tile(quads, 4)])
