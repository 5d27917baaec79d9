"""What is measured of a surface whose parts bound cavities: volumes, mass, areas, thickness of the wall."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import cross, norm

from ..scan.closest_points import closest_points
from ..start.cavities import Part, find_parts

DENSITY = 1.05  # g/ml, of heart muscle
_ML, _CM2 = 1e-3, 1e-2  # of cubic and of square mm


class Column(NamedTuple):
    """One number that is measured."""

    name: str
    unit: str


class _PartTables(eqx.Module):
    """A part of a refined surface."""

    triangles: Int[np.ndarray, "t 3"]
    rims: tuple[tuple[Int[np.ndarray, "_"], Int[np.ndarray, "_"]], ...]
    """Of every opening the vertices around it, and the next of each."""


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
        surface: any of the series, in its place.
        owner: the control face of every face of the surface.
        mesh: a control mesh, whose `regions` are the groups.
        valves: the groups that close the openings of cavities.
    """

    def __init__(
        self, surface: js.RefinedSurface, owner: Int[np.ndarray, "f"], mesh: js.ControlMesh, valves: Sequence[str]
    ):
        regions = None if mesh.regions is None else js.Regions(mesh.regions.rows[owner], mesh.regions.names)
        refined = js.ControlMesh(surface.vertices, dict(surface.faces), check=False, regions=regions)
        self.parts: tuple[Part, ...] = find_parts(refined, valves)
        self.triangles = refined_triangles(surface, np.ones(len(owner), bool))
        self._tables = [
            _PartTables(refined_triangles(surface, part.faces), tuple((rim, np.roll(rim, -1)) for rim in part.rims))
            for part in self.parts
        ]
        self.is_closed = refined.is_closed
        self.cavities = [i for i, part in enumerate(self.parts) if part.is_cavity]
        self.columns = self._columns()

    @property
    def volumes(self) -> dict[str, int]:
        """The column of the volume of every part that has one of its own, by its name."""
        rows = {column.name: i for i, column in enumerate(self.columns)}
        return {self.parts[i].name: rows[f"volume {self.parts[i].name}"] for i in self._closed()}

    def _closed(self) -> list[int]:
        """Parts whose volume is measured: cavities, or all of a surface that is open."""
        return list(range(len(self.parts))) if not self.is_closed else self.cavities

    def _columns(self) -> list[Column]:
        found = [Column(f"volume {self.parts[i].name}", "ml") for i in self._closed()]
        if self.is_closed:
            found += [Column("wall volume" if self.cavities else "volume", "ml")]
            found += [Column("wall mass", "g")] * bool(self.cavities)
        found += [Column(f"area {part.name}", "cm2") for part in self.parts]
        return found + [Column(f"wall thickness {self.parts[i].name}", "mm") for i in self.cavities]

    def walls(self, surface: js.RefinedSurface) -> list[Walls]:
        """The other side of the wall of every cavity."""
        found = []
        for i in self.cavities:
            triangles = self._tables[i].triangles
            vertices = np.unique(triangles)
            others = np.any([part.faces for j, part in enumerate(self.parts) if j != i], axis=0)
            choice = js.FaceChoice(np.zeros(len(vertices), np.int32), others[None])
            x = np.asarray(surface.vertices)
            at = closest_points(surface, surface.vertices[vertices], choice)
            corners, weights = js.corner_weights(surface, at)
            areas = _vertex_areas(x, triangles)[vertices]
            found.append(Walls(vertices, corners, weights, areas / areas.sum()))
        return found

    def measure(self, surface: js.RefinedSurface, walls: Sequence[Walls]) -> Float[Array, "m"]:
        """The numbers of a surface, in the order of `columns`."""
        x = surface.vertices
        found = [_ML * jnp.abs(_volume(x, self._tables[i])) for i in self._closed()]
        if self.is_closed:
            whole = _ML * _volume(x, _PartTables(self.triangles, ()))
            found += [whole, DENSITY * whole] if self.cavities else [whole]
        found += [_CM2 * jnp.sum(_areas(x, tables.triangles)) for tables in self._tables]
        for wall in walls:
            beyond = js.sum_corners(x, jnp.asarray(wall.corners), jnp.asarray(wall.corner_weights))
            found.append(jnp.sum(jnp.asarray(wall.shares, x.dtype) * norm(x[wall.vertices] - beyond)[:, 0]))
        return jnp.stack(found)

    def shares(self, surface: js.RefinedSurface) -> Float[np.ndarray, "v"]:
        """Of the area of a surface, those of its vertices."""
        areas = _vertex_areas(np.asarray(surface.vertices), self.triangles)
        return areas / areas.sum()

    def displacement(
        self, surface: js.RefinedSurface, first: js.RefinedSurface, shares: Float[np.ndarray, "v"]
    ) -> Float[Array, ""]:
        """How far the surface lies from where it was, in mm: the mean over its area."""
        away = norm(surface.vertices - first.vertices)[:, 0]
        return jnp.sum(jnp.asarray(shares, away.dtype) * away)


def refined_triangles(surface: js.RefinedSurface, faces: Any) -> Int[np.ndarray, "t 3"]:
    """Some faces of a surface, quads cut in two."""
    three, four = (np.asarray(surface.faces[size]) for size in (3, 4))
    quads = four[faces[len(three) :]]
    return np.concatenate([three[faces[: len(three)]], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _volume(x: Float[Array, "v 3"], part: _PartTables) -> Float[Array, ""]:
    """The signed volume, every opening closed by a fan about the middle of its rim."""
    a, b, c = (x[part.triangles[:, i]] for i in range(3))
    volume = jnp.sum(a * cross(b, c)) / 6
    for rim, after in part.rims:
        middle = jnp.broadcast_to(jnp.mean(x[rim], axis=0), (len(rim), 3))
        volume = volume - jnp.sum(middle * cross(x[rim], x[after])) / 6
    return volume


def _areas(x: Float[Array, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Float[Array, "t"]:
    a, b, c = (x[triangles[:, i]] for i in range(3))
    return norm(cross(b - a, c - a))[:, 0] / 2


def _vertex_areas(x: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "v"]:
    """A third of the area of the triangles at every vertex."""
    a, b, c = (x[triangles[:, i]] for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(triangles.ravel(), np.repeat(areas, 3), len(x))
