"""Residuals, each a vector in mm: the distance to the scan, and what is known of surfaces beforehand."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv._control import strong_float
from jaxsubdiv._linalg import dot, take
from jaxsubdiv._surface import sum_corners

from ._free import Unknowns, apply_offset, edge_length, h_effect

_DAMPING = 0.01


class Priors(eqx.Module):
    """What is known of a surface before it is measured, each as a weight beside the mean square distance to the scan.

    Attributes:
        fairness: of the mean square bend asymmetry (see `bend_asymmetry`) in the last sweeps.
        fairness_start: the same in the first sweep. It halves from sweep to sweep: a stiff start finds its way past
            noise in the control mesh, a soft end follows the scan.
        h: of the displacement that h - 1 stands for, squared.
        along: of the distance along the surface, beside that across it. It holds the control vertices in their places;
            the rest slides freely, so that the last sweeps converge fast. At an open boundary it is 1.
    """

    fairness: Float[Array, ""] = eqx.field(converter=strong_float, default=0.01)
    fairness_start: Float[Array, ""] = eqx.field(converter=strong_float, default=1.0)
    h: Float[Array, ""] = eqx.field(converter=strong_float, default=0.1)
    along: Float[Array, ""] = eqx.field(converter=strong_float, default=0.003)

    def fairness_in(self, sweep: int) -> Float[Array, ""]:
        """The weight of fairness in a sweep, counted from 0."""
        return jnp.maximum(self.fairness, self.fairness_start * 0.5**sweep)


class Correspondence(NamedTuple):
    """Scan points and the surface points paired with them, as one sweep holds them fixed."""

    points: Float[Array, "p 3"]
    corners: Int[Array, "p 4"]
    """Vertices of the refined surface around each surface point."""
    corner_weights: Float[Array, "p 4"]
    normals: Float[Array, "p 3"]
    """Normals of the surface there."""
    weights: Float[Array, "p"]
    """Weights of the pairs, of mean 1."""
    at_boundary: Bool[Array, "p"]
    """Whether the surface ends there: then the whole distance counts, for the surface may have to grow."""


class Start(NamedTuple):
    """Where a sweep starts, and what it holds fixed: the arguments of its residuals."""

    scheme: js.AbstractScheme
    topology: js.Topology
    control: js.Control
    pairs: Correspondence
    priors: Priors
    fairness: Float[Array, ""]


def residuals(offset: Unknowns, start: Start) -> tuple[Array, ...]:
    """Everything whose mean square a sweep makes small; no distances, so that a perfect fit has a gradient too."""
    scheme, control = apply_offset(start.topology, start.scheme, start.control, offset)
    surface = js.refine(scheme, start.topology, control)
    dtype = surface.vertices.dtype
    away = sum_corners(surface.vertices, start.pairs.corners, start.pairs.corner_weights) - start.pairs.points
    root = jnp.sqrt(start.pairs.weights)[:, None]
    along = jnp.sqrt(jnp.where(start.pairs.at_boundary, 1.0, start.priors.along.astype(dtype)))[:, None]
    asymmetry = bend_asymmetry(start.topology, surface)
    bend = h_effect(edge_length(start.topology, start.control.vertices)) * (scheme.h.astype(dtype) - 1)
    # optimistix starts with the damping 1, whatever the residuals: scaled by this, the mean square over the scan gives
    # each control vertex 1 / _DAMPING on the diagonal of the normal equations.
    scale = start.control.vertices.shape[0] / _DAMPING
    return (
        _mean(root * dot(start.pairs.normals, away), scale),
        _mean(root * along * away, scale),
        *(_mean(level, scale * start.fairness.astype(dtype)) for level in asymmetry),
        _mean(bend[None], scale * start.priors.h.astype(dtype)),
    )


def bend_asymmetry(topology: js.Topology, surface: js.RefinedSurface) -> tuple[Float[Array, "e 1"], ...]:
    """By how much the surface bends more at one end of an edge than at the other, in mm, edge by edge.

    It is half of the height of each end over the tangent plane at the other, one less the other:
    (n_a + n_b) . (x_b - x_a) / 2. It vanishes on spheres, on cylinders and for every circular arc, so that it smooths
    without shrinking; and it ties normals to the geometry, for a normal that leans bends its edges unevenly.

    Taken over the control edges, and over the edges of the first level where there is one to spare.
    """

    def of(level: int) -> Float[Array, "e 1"]:
        a, b = topology.levels[level].edges.T
        d = take(surface.vertices, b) - take(surface.vertices, a)
        return 0.5 * dot(take(surface.normals, a) + take(surface.normals, b), d)

    return tuple(of(level) for level in range(min(2, len(topology.levels))))


def _mean(rows: Float[Array, "n *k"], weight: Float[Array, ""] | float) -> Float[Array, "n *k"]:
    """Rows whose squared sum is `weight` times the mean square of the rows given."""
    return rows * jnp.sqrt(weight / rows.shape[0])
