"""Layers of one fit: each as a surface and a control mesh of its own, and how thick what lies between is."""

import os
from typing import final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import jaxsubdiv as js

from ..scan.layers import take_faces, take_layer
from .result import FitResult
from .thickness import Thickness


@final
class LayersFit:
    """Several surfaces that were fitted at once; made by `fit_layers`.

    Attributes:
        result: the fit of all layers as one control mesh with a region each: its report, measures, posterior and so on.
        names: of the layers, from the inside out.
    """

    def __init__(self, result: FitResult):
        """
        Args:
            result: of `fit_layers`, or of `fit` with `layers`; a loaded one serves, too.

        Raises:
            ValueError: the fit has no layers.
        """
        self.result: FitResult = result
        self.names: tuple[str, ...] = result.layers
        if not self.names:
            raise ValueError("the fit has no layers: fit by `fit_layers`, or `fit(..., layers=...)`.")

    def control_mesh(self, name: str) -> js.ControlMesh:
        """The fitted control mesh of a layer, with its normals.

        Raises:
            ValueError: there is no such layer.
        """
        return take_layer(self.result.control_mesh, name)

    def surface(self, name: str) -> js.RefinedSurface:
        """The refined surface of a layer.

        Raises:
            ValueError: there is no such layer.
        """
        surface = self.result.surface
        vertices, faces = self._places(name)
        tables = {size: jnp.asarray(rows) for size, rows in faces.items()}
        return js.RefinedSurface(surface.vertices[vertices], surface.normals[vertices], tables)

    def take_values(self, name: str, values: Float[np.ndarray, "v"]) -> Float[np.ndarray, "w"]:
        """Values at the vertices of `result.surface`, of those of one layer in the order of `surface(name)`."""
        return values[self._places(name)[0]]

    def _places(self, name: str) -> tuple[Int[np.ndarray, "w"], dict[int, np.ndarray]]:
        return take_faces(self.result.surface.faces, self.result.find_faces(name))

    def thickness(self, layer: str | None = None, other: str | None = None) -> Thickness:
        """How thick what lies between two layers is, at every vertex of one of them; see `FitResult.thickness`.

        Args:
            layer: default: the first.
            other: default: the one that follows it, or comes before the last.
        """
        first = self.names[0] if layer is None else layer
        if other is None:
            if first not in self.names:
                raise ValueError(f"'{first}' is none of the layers {', '.join(self.names)}.")
            k = self.names.index(first)
            other = self.names[k + 1 if k + 1 < len(self.names) else k - 1]
        return self.result.thickness(first, other)

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the fit for `fitting.load`; `LayersFit(fitting.load(folder))` is this again."""
        self.result.save(folder)
