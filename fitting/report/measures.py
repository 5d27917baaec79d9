"""What is measured of a surface whose parts bound cavities: volumes, mass, areas, thickness of the wall."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import norm

from ..scan.closest_points import closest_points
from ..start.cavities import Part, find_parts

DENSITY = 1.05  # g/ml, of heart muscle
ML, CM2 = 1e-3, 1e-2  # of cubic and of square mm


class Column(NamedTuple):
    """One number that is measured."""

    name: str
    unit: str


class Walls(NamedTuple):
    """Of every cavity the places of the wall's other side that are closest to it, as one surface has them."""

    vertices: Int[np.ndarray, "w"]
    corners: Int[Array | np.ndarray, "w 4"]
    corner_weights: Float[Array | np.ndarray, "w 4"]
    shares: Float[np.ndarray, "w"]
    """Of the cavity's area."""


class Measures:
    """The numbers that a surface is measured by, with their tables: the same for all frames of a series.

    Args:
        topology: tables of the surface.
        surface: any of the series, in its place.
        owner: the control face of every face of the surface.
        mesh: a control mesh, whose `regions` are the groups.
        valves: the groups that close the openings of cavities.
    """

    def __init__(
        self,
        topology: js.Topology,
        surface: js.RefinedSurface,
        owner: Int[np.ndarray, "f"],
        mesh: js.ControlMesh,
        valves: Sequence[str],
    ):
        regions = None if mesh.regions is None else js.Regions(mesh.regions.rows[owner], mesh.regions.names)
        refined = js.ControlMesh(surface.vertices, dict(surface.faces), check=False, regions=regions)
        self.parts: tuple[Part, ...] = find_parts(refined, valves)
        self._whole = js.losses.surface_part(topology)
        self._parts = [js.losses.surface_part(topology, part.faces) for part in self.parts]
        self.is_closed: bool = refined.is_closed
        self.cavities: list[int] = [i for i, part in enumerate(self.parts) if part.is_cavity]
        self.columns: list[Column] = self._columns()

    @property
    def volumes(self) -> dict[str, int]:
        """The column of the volume of every part that has one of its own, by its name."""
        rows = {column.name: i for i, column in enumerate(self.columns)}
        return {self.parts[i].name: rows[f"volume {self.parts[i].name}"] for i in self._find_closed()}

    def _find_closed(self) -> list[int]:
        """Parts whose volume is measured: cavities, or all of a surface that is open."""
        return list(range(len(self.parts))) if not self.is_closed else self.cavities

    def _columns(self) -> list[Column]:
        found = [Column(f"volume {self.parts[i].name}", "ml") for i in self._find_closed()]
        if self.is_closed:
            found += [Column("wall volume" if self.cavities else "volume", "ml")]
            found += [Column("wall mass", "g")] * bool(self.cavities)
        found += [Column(f"area {part.name}", "cm2") for part in self.parts]
        return found + [Column(f"wall thickness {self.parts[i].name}", "mm") for i in self.cavities]

    def walls(self, surface: js.RefinedSurface) -> list[Walls]:
        """The other side of the wall of every cavity."""
        found = []
        for i in self.cavities:
            vertices = np.unique(self._parts[i].triangles)
            others = np.any([part.faces for j, part in enumerate(self.parts) if j != i], axis=0)
            choice = js.FaceChoice(np.zeros(len(vertices), np.int32), others[None])
            at = closest_points(surface, surface.vertices[vertices], choice)
            corners, weights = js.corner_weights(surface, at)
            found.append(Walls(vertices, corners, weights, _shares(surface, self._parts[i])[vertices]))
        return found

    def measure(self, surface: js.RefinedSurface, walls: Sequence[Walls]) -> Float[Array, "m"]:
        """The numbers of a surface, in the order of `columns`."""
        x = surface.vertices
        found = [ML * jnp.abs(js.losses.enclosed_volume(surface, part=self._parts[i])) for i in self._find_closed()]
        if self.is_closed:
            whole = ML * js.losses.enclosed_volume(surface, part=self._whole)
            found += [whole, DENSITY * whole] if self.cavities else [whole]
        found += [CM2 * js.losses.surface_area(surface, part=part) for part in self._parts]
        for wall in walls:
            beyond = js.sum_corners(x, jnp.asarray(wall.corners), jnp.asarray(wall.corner_weights))
            found.append(jnp.sum(jnp.asarray(wall.shares, x.dtype) * norm(x[wall.vertices] - beyond)[:, 0]))
        return jnp.stack(found)

    def shares(self, surface: js.RefinedSurface) -> Float[np.ndarray, "v"]:
        """Of the area of a surface, those of its vertices."""
        return _shares(surface, self._whole)

    def displacement(
        self, surface: js.RefinedSurface, first: js.RefinedSurface, shares: Float[np.ndarray, "v"]
    ) -> Float[Array, ""]:
        """How far the surface lies from where it was, in mm: the mean over its area."""
        away = norm(surface.vertices - first.vertices)[:, 0]
        return jnp.sum(jnp.asarray(shares, away.dtype) * away)


def _shares(surface: js.RefinedSurface, part: js.losses.SurfacePart) -> Float[np.ndarray, "v"]:
    """Of the area of a part, those of the surface's vertices."""
    faces = {3: part.triangles, 4: np.zeros((0, 4), np.int32)}
    areas = np.asarray(js.RefinedSurface(surface.vertices, surface.normals, faces).vertex_areas(), np.float64)
    return areas / areas.sum()
