"""What is measured of layers: the volume inside and the area of each, and what lies between one and the next."""

from collections.abc import Mapping
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxsubdiv as js
from jaxsubdiv.linalg import dot, take

from .measures import CM2, ML, Column
from .thickness import find_gap


class LayerMeasures:
    """The numbers that layers are measured by, with their tables.

    Args:
        topology: tables of the surface of all layers.
        surface: where the measuring begins: thickness is between the places that are closest there.
        layers: the faces of each, from the inside out.
    """

    def __init__(self, topology: js.Topology, surface: js.RefinedSurface, layers: Mapping[str, Bool[np.ndarray, "f"]]):
        self._parts = [js.losses.surface_part(topology, faces) for faces in layers.values()]
        pairs = list(pairwise(layers.items()))
        gaps = [(a, b, find_gap(surface, one, other)) for (a, one), (b, other) in pairs]
        self._gaps = [gap for *_, gap in gaps if len(gap.vertices)]
        self.columns: list[Column] = [Column(f"volume {name}", "ml") for name in layers]
        self.columns += [Column(f"volume between {a} and {b}", "ml") for (a, _), (b, _) in pairs]
        self.columns += [Column(f"area {name}", "cm2") for name in layers]
        self.columns += [Column(f"thickness {a} to {b}", "mm") for a, b, gap in gaps if len(gap.vertices)]

    def measure(self, surface: js.RefinedSurface) -> Float[Array, "m"]:
        """The numbers of a surface, in the order of `columns`. Volumes of open layers are those under flat caps."""
        x = surface.vertices
        volumes = [ML * jnp.abs(js.losses.enclosed_volume(surface, part=part)) for part in self._parts]
        found = [*volumes, *(b - a for a, b in pairwise(volumes))]
        found += [CM2 * js.losses.surface_area(surface, part=part) for part in self._parts]
        for gap in self._gaps:
            beyond = js.sum_corners(x, jnp.asarray(gap.corners), jnp.asarray(gap.corner_weights, x.dtype))
            away = dot(jnp.asarray(gap.directions, x.dtype), beyond - take(x, jnp.asarray(gap.vertices)))[:, 0]
            found.append(jnp.sum(jnp.asarray(gap.shares, x.dtype) * away))
        return jnp.stack(found)
