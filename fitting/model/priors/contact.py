"""Contact: places of the surface that come near each other repel, so that the surface does not pass through itself."""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsubdiv import sum_corners
from jaxsubdiv.linalg import dot

from ..unknowns import AnyArray
from .base import AbstractSurfacePrior, Place, Start


class Contacts(NamedTuple):
    """Pairs of places of the surface that lie near each other, as one sweep holds them."""

    corners: Int[Array | np.ndarray, "c 4"]
    """Vertices of the surface that the two places lie between: of one of them and of a triangle, or of two edges."""
    weights: Float[Array | np.ndarray, "c 4"]
    """Of these vertices, so that their weighted sum is the second place less the first."""
    directions: Float[Array | np.ndarray, "c 3"]
    """Unit vectors from the first place to the second."""
    reach: Float[Array | np.ndarray, "c"]
    """Places that are nearer than this, in mm, repel."""
    gap: Float[Array | np.ndarray, "c"]
    """How far they are apart where the sweep starts, in mm."""


def no_contacts(dtype: Any = np.float64) -> Contacts:
    """None at all."""
    none = np.zeros(0, dtype)
    return Contacts(np.zeros((0, 4), np.int32), np.zeros((0, 4), dtype), np.zeros((0, 3), dtype), none, none)


class ContactPrior(AbstractSurfacePrior):
    """The distance d between two places is their reach r or more, give or take the distance g where the sweep starts: a
    row (r - d) / g for each pair that is nearer.

    From sweep to sweep that is a barrier, whose slope -(r - d) / d^2 rises without bounds as the places come together
    and starts from the reach with no jump; as g is held, one step opens a gap, however narrow. The direction between
    the places is held too, and so are the places: as they lie nearest to each other, moving them changes the distance
    to second order only.

    Attributes:
        reach: as a part of the heights of the triangles there.
    """

    name: ClassVar[str] = "contact"
    reach: Float[Array | np.ndarray, ""]

    @classmethod
    def make(cls, priors: Any, start: Start) -> "ContactPrior | None":
        return cls(priors.contact) if float(priors.contact) > 0 else None

    def hold(self, place: Place, strengths: dict[str, Any]) -> Contacts:
        """None: they are found on the host, see `CrossingGuard.find_contacts`."""
        return Contacts(*map(jnp.asarray, no_contacts(np.dtype(place.edge.dtype))))

    def rows(self, place: Place, held: Contacts) -> Float[Array, "c"]:
        assert place.surface is not None
        dtype = place.edge.dtype
        corners, *others = map(jnp.asarray, held)
        weights, directions, reach, gap = (part.astype(dtype) for part in others)
        apart = sum_corners(place.surface.vertices, corners, weights)
        return jnp.maximum(reach - dot(directions, apart)[:, 0], 0.0) / gap

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return 1.0

    def corners(self, held: Contacts) -> Int[AnyArray, "c 4"]:
        return held.corners

    def linearise(
        self, vertices: Float[np.ndarray, "v 3"], held: Contacts
    ) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "c 4 3"]]:
        corners, weights, directions, reach, gap = (np.asarray(part) for part in held)
        distance = np.einsum("ci,cx,cix->c", weights, directions, vertices[corners])
        slope = np.where(distance < reach, -1 / gap, 0.0)
        by = slope[:, None, None] * weights[:, :, None] * directions[:, None, :]
        return np.maximum(reach - distance, 0.0) / gap, by
