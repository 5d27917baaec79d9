"""One anatomy through time: control vertices move little from one frame to the next."""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js

from ...scan.frames import Frames
from ..unknowns import AnyArray
from .base import AbstractVertexPrior, Place, Start, backend

_FIRST = 0.02  # of a control edge: standard deviation of a change in the first sweep, where that is to be found


class SeriesPrior(AbstractVertexPrior):
    """From frame to frame every control vertex changes its place by little, in each coordinate.

    Attributes:
        before, after: control vertices of consecutive frames that are the same vertex, in a mesh that has a copy for
            every frame (see `copy_mesh`).
        apart: how far apart the frames were placed, in mm: the difference of both where nothing moves.
        deviation: standard deviation of the change in mm, or None where it is found from the scans.
        edge: length of a control edge in mm.
    """

    name: ClassVar[str] = "series"
    is_distant: ClassVar[bool] = True
    before: Int[Array | np.ndarray, "m"]
    after: Int[Array | np.ndarray, "m"]
    apart: Float[Array | np.ndarray, "m 3"]
    deviation: Float[Array | np.ndarray, ""] | None
    edge: float = eqx.field(static=True)

    @classmethod
    def make(cls, priors: Any, start: Start) -> "SeriesPrior | None":
        frames: Frames | None = start.inputs.get("frames")
        left_out = priors.frame_change is not None and not np.isfinite(priors.frame_change)
        if frames is None or left_out or not len(frames.pairs):
            return None
        edge = float(js.edge_length(start.topology, start.control.vertices))
        own = np.arange(len(start.control.vertices) // len(frames.counts))
        before, after = ((len(own) * some[:, None] + own).ravel() for some in frames.pairs.T)
        apart = np.repeat(frames.offsets[frames.pairs[:, 1]] - frames.offsets[frames.pairs[:, 0]], len(own), axis=0)
        return cls(before, after, apart, priors.frame_change, edge)

    def strip_strengths(self) -> "SeriesPrior":
        return dataclasses.replace(self, deviation=None)

    @property
    def n_strengths(self) -> int:
        return 1

    def first_strengths(self) -> Float[AnyArray, "1"]:
        xp = backend(self.deviation)
        return xp.full(1, xp.asarray(_FIRST * self.edge if self.deviation is None else self.deviation) ** -2.0)

    def given_strengths(self) -> Float[AnyArray, "1"] | None:
        return None if self.deviation is None else self.first_strengths()

    def strength_rows(self) -> Int[AnyArray, "m"]:
        return np.zeros(3 * len(self.before), int)

    def rows(self, place: Place, held: None) -> Float[Array, "m"]:
        """Three a vertex and pair of frames, in mm."""
        vertices = place.control.vertices
        change = vertices[self.after] - vertices[self.before] - jnp.asarray(self.apart, vertices.dtype)
        return change.reshape(-1)

    def precisions(self, strengths: dict[str, Any]) -> Any:
        return strengths[self.name][np.zeros(3 * len(self.before), int)]

    def vertices(self) -> Int[AnyArray, "m 2"]:
        return np.repeat(np.stack([self.before, self.after], axis=1), 3, axis=0)
