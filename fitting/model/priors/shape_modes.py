"""Shapes seen before: the control mesh is a mean shape, moved along modes of variation, and something of its own."""

import dataclasses
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import cross

from ..modes import Modes, shape_modes
from ..procrustes import align_shape
from ..unknowns import AnyArray, Shared
from .base import AbstractVertexPrior, Place, Start, backend

_FIRST = 0.1  # of a control edge: standard deviation of what the modes leave, in the first sweep
_STEPS, _MOST_SCORE = 10, 3.0  # of the scores where a fit starts
_LEAST = 0.05  # of the widest mode: the rest of a family that has no more modes than it shows


@runtime_checkable
class Family(Protocol):
    """Fits of one control mesh, as a `Cohort` is."""

    control: js.Control
    """Vertices and normals `[s, v, 3]`."""


class ShapeModes(eqx.Module):
    """The control meshes of a family: `Priors(shape=...)` takes one, or a `Cohort`, or the `Modes` of `shape_modes`.

    Attributes:
        mean: mean control vertices in mm.
        modes: directions of variation, each of length 1 over all coordinates.
        deviations: standard deviation of the family along each, in mm over all coordinates.
        rest: standard deviation in mm, in each coordinate of a control vertex, of what a member has beside the modes.
            Of a cohort or `Modes`: what each member has beside the modes of the others. None, the default: found from
            the scan, which often says too little of it and leaves the scores little to say.
    """

    mean: Float[Array, "v 3"] = eqx.field(converter=jnp.asarray)
    modes: Float[Array, "k v 3"] = eqx.field(converter=jnp.asarray)
    deviations: Float[Array, "k"] = eqx.field(converter=jnp.asarray)
    rest: Float[Array, ""] | None = eqx.field(
        converter=lambda value: None if value is None else js.strong_float(value), default=None
    )

    def __check_init__(self) -> None:
        shape = self.modes.shape[:1] + self.mean.shape
        if self.mean.ndim != 2 or self.mean.shape[1] != 3 or self.modes.shape != shape or not self.modes.shape[0]:
            raise ValueError(
                f"a shape needs a mean [v, 3] and modes [k, v, 3]; got {self.mean.shape}, {self.modes.shape}."
            )
        if self.deviations.shape != self.modes.shape[:1] or not bool(jnp.all(self.deviations > 0)):
            raise ValueError("a shape needs a positive standard deviation for each of its modes.")
        if self.rest is not None and not bool(self.rest > 0):
            raise ValueError(f"the standard deviation of the rest must be positive; got {self.rest}.")

    @staticmethod
    def of(value: "ShapeModes | Modes | Family | None") -> "ShapeModes | None":
        """From the control meshes of a cohort, or from their modes: those that the family varies along, and as the rest
        what each member has beside the modes of the others."""
        if isinstance(value, Family):
            value = shape_modes(value.control.vertices)
        if not isinstance(value, Modes):
            return value
        some = value.deviations > 1e-6 * value.deviations.max()
        rest = max(
            _deviation_left_out(value.aligned), _LEAST * float(np.max(value.deviations)) / len(value.mean) ** 0.5
        )
        return ShapeModes(value.mean, value.modes[some], value.deviations[some], rest)


def find_scores(mean: AnyArray, modes: AnyArray, vertices: AnyArray) -> Float[np.ndarray, "k"]:
    """The scores, in standard deviations, of the member of a family that lies nearest to control vertices, whatever
    their pose; none beyond three.

    Args:
        mean: `[v, 3]` in mm.
        modes: `[k, v, 3]`, by how much one standard deviation along each moves the vertices, in mm.
        vertices: `[v, 3]` in mm.
    """
    mean, modes, vertices = (np.asarray(rows, np.float64) for rows in (mean, modes, vertices))
    flat, scores = modes.reshape(len(modes), -1), np.zeros(len(modes))
    for _ in range(_STEPS):
        away = align_shape(vertices, mean + np.tensordot(scores, modes, 1), scale=False) - mean
        scores = np.clip(np.linalg.lstsq(flat.T, away.ravel(), rcond=None)[0], -_MOST_SCORE, _MOST_SCORE)
    return scores


def _deviation_left_out(shapes: Float[np.ndarray, "s v 3"]) -> float:
    """How far shapes lie beside the modes of the other shapes, root mean square in each coordinate, in mm."""
    squares = []
    for i, own in enumerate(shapes):
        others = np.delete(shapes, i, axis=0)
        mean = others.mean(axis=0)
        _, widths, modes = np.linalg.svd((others - mean).reshape(len(others), -1), full_matrices=False)
        modes, away = modes[widths > 1e-9 * widths.max(initial=0)], (own - mean).ravel()
        squares.append(np.mean((away - modes.T @ (modes @ away)) ** 2))
    return float(np.sqrt(np.mean(squares)))


class _Held(NamedTuple):
    """What a sweep holds of the prior."""

    shape: Float[Array, "v 3"]
    """The member of the family with the scores where the sweep starts, moved to the mesh as a whole."""
    modes: Float[Array, "k v 3"]
    """By how much a score moves it, turned likewise."""
    scores: Float[Array, "k"]
    middle: Float[Array, "3"]
    extent: Float[Array, ""]
    """Size of the mesh in mm: a turn of 1 / extent moves its outer parts by 1 mm."""


class ShapePrior(AbstractVertexPrior):
    """Control vertices lie where the family has them, by scores that a step solves for, give or take the rest.

    The scores are Gaussian, of standard deviation 1 in the deviations of the modes. The pose, rigid, is solved for too.

    Attributes:
        mean: in mm.
        modes: displacements in mm at a score of 1.
        first: scores where the fit starts.
        rest: standard deviation in mm of what the modes leave, or None where it is found from the scan.
    """

    name: ClassVar[str] = "shape"
    uses: ClassVar[tuple[str, ...]] = ("scores", "pose")
    mean: Float[Array, "v 3"]
    modes: Float[Array, "k v 3"]
    first: Float[Array, "k"]
    rest: Float[Array, ""] | None
    widest: float = eqx.field(static=True)
    """How far the widest mode moves a vertex, root mean square, in control edges."""
    edge: float = eqx.field(static=True)
    """Length of a control edge in mm."""

    @classmethod
    def make(cls, priors: Any, start: Start) -> "ShapePrior | None":
        shape = priors.shape
        if shape is None:
            return None
        if shape.mean.shape != start.control.vertices.shape:
            raise ValueError(
                f"`Priors.shape` is of meshes of {len(shape.mean)} control vertices; this one has "
                f"{len(start.control.vertices)}. Take the modes of control meshes that correspond to it."
            )
        edge = float(js.edge_length(start.topology, start.control.vertices))
        widest = float(shape.deviations.max()) / len(shape.mean) ** 0.5
        dtype = start.control.vertices.dtype
        modes = shape.modes * shape.deviations[:, None, None]
        first = jnp.asarray(find_scores(shape.mean, modes, start.control.vertices), dtype)
        return cls(shape.mean.astype(dtype), modes.astype(dtype), first, shape.rest, widest / edge, edge)

    def strip_strengths(self) -> "ShapePrior":
        return dataclasses.replace(self, rest=None)

    @property
    def n_strengths(self) -> int:
        return 1

    def first_strengths(self) -> Float[AnyArray, "1"]:
        xp = backend(self.rest)
        return xp.full(1, xp.asarray(_FIRST * self.edge if self.rest is None else self.rest) ** -2.0)

    def given_strengths(self) -> Float[AnyArray, "1"] | None:
        return None if self.rest is None else self.first_strengths()

    def strength_rows(self) -> Int[AnyArray, "m"]:
        return np.append(np.zeros(self.mean.size, int), np.full(len(self.modes), -1))

    def shared_unknowns(self) -> dict[str, Shared]:
        return {"scores": Shared((len(self.modes),), lever=self.widest), "pose": Shared((6,), lasting=False)}

    def initial_values(self) -> dict[str, Array]:
        return {"scores": self.first}

    def hold(self, place: Place, strengths: dict[str, Any]) -> _Held:
        vertices, scores = place.control.vertices, place.shared["scores"].astype(self.mean.dtype)
        shape = self.mean + jnp.tensordot(scores, self.modes, 1)
        there = align_shape(shape, vertices, jnp, scale=False)
        middle = there.mean(axis=0)
        # A rigid motion of the shape turns each mode as a vector: by the moved shape with it, less that without.
        a, b = shape - shape.mean(axis=0)[None], there - middle[None]
        u, _, vt = jnp.linalg.svd(b.T @ a)
        turn = u @ vt
        extent = jnp.sqrt(jnp.mean(jnp.sum(b**2, axis=1)))
        return _Held(there, self.modes @ turn.T, scores, middle, extent)

    def rows(self, place: Place, held: _Held) -> Float[Array, "m"]:
        """Three a control vertex in mm, and then the scores."""
        scores, pose = place.shared["scores"].astype(self.mean.dtype), place.shared["pose"]
        member = held.shape + jnp.tensordot(scores - held.scores, held.modes, 1) + pose[None, :3]
        arms = held.shape - held.middle[None]
        turned = cross(jnp.broadcast_to(pose[None, 3:] / held.extent, arms.shape), arms)
        return jnp.concatenate([(place.control.vertices - member - turned).reshape(-1), scores])

    def precisions(self, strengths: dict[str, Any]) -> Any:
        xp = jnp if isinstance(strengths[self.name], Array) else np
        n, k = self.mean.size, len(self.modes)
        of_rest = xp.broadcast_to(xp.asarray(strengths[self.name])[0], (n,))
        return xp.concatenate([of_rest, xp.ones(k, of_rest.dtype)])

    def vertices(self) -> Int[AnyArray, "m 1"]:
        rows = np.append(np.repeat(np.arange(len(self.mean)), 3), np.full(len(self.modes), -1))
        return rows[:, None]
