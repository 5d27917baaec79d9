"""The unknowns of a fit: which arrays may move, and in which coordinates.

Most unknowns belong to a control vertex: its position, and two turns of its normal. The others are shared by all rows:
the tangent length coefficient h, the shifts of slices, and what else a prior brings along. A solver steps by offsets,
each scaled so that 1 moves the surface by about 1 mm.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxsubdiv as js
from jaxsubdiv.closest import AnyArray
from jaxsubdiv.linalg import Rows, cross, unit


class Free(eqx.Module):
    """What a fit may change.

    Attributes:
        vertices: the control vertices: all, none, or those where a mask `[v]` is True.
        normals: the directions of the control normals, likewise.
        h: the tangent length coefficient, one or one a level, as the scheme has it.
        shifts: the slices of the scan, where it has any (`Scan.slices`), each within its plane.

    What a scheme does not have, or does not look at, is not free.

    Raises:
        ValueError: nothing is free, or a mask is no array of booleans.
    """

    vertices: bool | Bool[np.ndarray, "v"] = eqx.field(default=True)
    normals: bool | Bool[np.ndarray, "v"] = eqx.field(default=True)
    h: bool = eqx.field(default=True)
    shifts: bool = eqx.field(default=True)

    def __check_init__(self) -> None:
        for name, mask in (("vertices", self.vertices), ("normals", self.normals)):
            if not isinstance(mask, bool) and (
                not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.ndim != 1
            ):
                raise ValueError(f"`{name}` must be True, False or a numpy array of booleans, one a control vertex.")
        if not (np.any(self.vertices) or np.any(self.normals) or self.h):
            raise ValueError("nothing is free: let at least one of vertices, normals and h be True.")

    def masks(self, scheme: js.AbstractScheme, n_vertices: int) -> dict[str, Bool[np.ndarray, "v"] | bool]:
        """Which vertices and normals may move, and whether h may, by name; False for what the scheme does not have.

        Raises:
            ValueError: a mask has not one row a control vertex, or the scheme has nothing that is free.
        """

        def mask(name: str, rows: bool | Bool[np.ndarray, "v"]) -> Bool[np.ndarray, "v"] | bool:
            if not np.any(rows):
                return False
            rows = np.full(n_vertices, rows) if isinstance(rows, bool) else rows
            if len(rows) != n_vertices:
                raise ValueError(f"`Free.{name}` has {len(rows)} rows for {n_vertices} control vertices.")
            return rows

        found = {
            "vertices": mask("vertices", self.vertices),
            "normals": mask("normals", self.normals) if scheme.uses_normals else False,
            "h": self.h and scheme.h is not None,
        }
        if not any(np.any(one) for one in found.values()):
            raise ValueError(
                f"nothing is free: {type(scheme).__name__} has neither normals nor h. Let vertices be True."
            )
        return found


class Variables(eqx.Module):
    """What a fit finds: the `y` of its solver.

    Attributes:
        control: control vertices in mm, and unit normals.
        shared: values of the unknowns that all rows share, by name: "h", "shifts" and so on.
    """

    control: js.Control
    shared: dict[str, Array]


class Unknowns(eqx.Module):
    """Offsets from `Variables`, each scaled so that 1 moves the surface by about 1 mm."""

    vertices: Float[Array, "v 3"] | None
    normals: Float[Array, "v 2"] | None
    """Along two tangents of the unit sphere at the normal: its length is no unknown."""
    shared: dict[str, Array]


class Shared(NamedTuple):
    """An unknown that all rows share, as the prior that brings it describes it."""

    shape: tuple[int, ...]
    lever: float | None = None
    """How many control edges the surface moves by, about, where the value changes by 1; None where the value is in mm.
    """
    lasting: bool = True
    """Whether the value is kept from sweep to sweep; or the unknown only lets a step move along with it."""
    common: bool = False
    """Whether it is a common motion of all vertices, about which they are damped."""


class Layout(eqx.Module):
    """How the unknowns stand in one vector: vertex by vertex, its position and then its normal; then what is shared."""

    n_vertices: int = eqx.field(static=True)
    has_vertices: bool = eqx.field(static=True)
    has_normals: bool = eqx.field(static=True)
    shared: tuple[tuple[str, Shared], ...] = eqx.field(static=True)

    @property
    def width(self) -> int:
        """Number of unknowns that each control vertex has."""
        return 3 * self.has_vertices + 2 * self.has_normals

    @property
    def n_own(self) -> int:
        """Number of unknowns that belong to a control vertex."""
        return self.n_vertices * self.width

    @property
    def n(self) -> int:
        """Number of all unknowns."""
        return self.n_own + sum(math.prod(of.shape) for _, of in self.shared)

    def columns(self, name: str) -> slice:
        """Where a shared unknown stands."""
        first = self.n_own
        for other, of in self.shared:
            size = math.prod(of.shape)
            if other == name:
                return slice(first, first + size)
            first += size
        raise KeyError(name)

    def repeat_per_unknown(self, rows: AnyArray, xp: Any = np) -> AnyArray:
        """A value a control vertex `[v]` as one an unknown of a vertex `[n_own]`."""
        return xp.repeat(rows, self.width)

    def split(self, vector: Float[Array, "n"]) -> Unknowns:
        """A vector of all unknowns as offsets."""
        table = vector[: self.n_own].reshape(self.n_vertices, self.width)
        first = 3 * self.has_vertices
        return Unknowns(
            table[:, :first] if self.has_vertices else None,
            table[:, first:] if self.has_normals else None,
            {name: vector[self.columns(name)].reshape(of.shape) for name, of in self.shared},
        )

    def join(self, offset: Unknowns, xp: Any = np) -> AnyArray:
        """The inverse of `split`."""
        parts = [xp.asarray(part) for part in (offset.vertices, offset.normals) if part is not None]
        own = [xp.concatenate(parts, axis=1).reshape(-1)] if parts else []
        return xp.concatenate(own + [xp.asarray(offset.shared[name]).reshape(-1) for name, _ in self.shared])

    def retract(self, y: Variables, offset: Unknowns, edge: Float[Array, ""]) -> Variables:
        """The variables with an offset put on: normals that turn become unit, what is not free stays bit for bit.

        Args:
            edge: length of a control edge of `y` in mm.
        """
        vertices, normals, shared = y.control.vertices, y.control.normals, dict(y.shared)
        if offset.normals is not None:
            # By eq. (2) an edge point moves by an eighth of the edge for a normal that turns by one radian.
            normals = unit(normals)
            first, second = tangents(normals)
            turn = offset.normals[:, :1] * first + offset.normals[:, 1:] * second
            normals = unit(normals + turn * (8 / edge))
        if offset.vertices is not None:
            vertices = vertices + offset.vertices
        for name, of in self.shared:
            change = offset.shared[name]
            change = change if of.lever is None else change / (of.lever * edge)
            shared[name] = shared[name] + change.astype(shared[name].dtype) if name in shared else change
        return Variables(js.Control(vertices, normals), shared)


def tangents(n: Rows) -> tuple[Rows, Rows]:
    """Two unit vectors at right angles to a unit vector and to each other."""
    # The axis that is farthest from the normal never leaves the cross product short.
    least = jnp.argmin(jnp.abs(n), axis=1)
    first = unit(cross(n, jnp.eye(3, dtype=n.dtype)[least]))
    return first, cross(n, first)
