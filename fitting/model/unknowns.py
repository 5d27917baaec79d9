"""The unknowns of a fit: which arrays may move, and in which coordinates."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxsubdiv as js
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

    def __check_init__(self):
        for name, mask in (("vertices", self.vertices), ("normals", self.normals)):
            if not isinstance(mask, bool) and (
                not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.ndim != 1
            ):
                raise ValueError(f"`{name}` must be True, False or a numpy array of booleans, one a control vertex.")
        if not (np.any(self.vertices) or np.any(self.normals) or self.h):
            raise ValueError("nothing is free: let at least one of vertices, normals and h be True.")

    def of(self, scheme: js.AbstractScheme, n_vertices: int) -> "Unknowns":
        """Masks in the place of the unknowns; None where a whole array stays.

        Raises:
            ValueError: a mask has not one row a control vertex, or the scheme has nothing that is free.
        """

        def mask(name: str, of: bool | Bool[np.ndarray, "v"], width: int) -> Array | None:
            if not np.any(of):
                return None
            rows = np.full(n_vertices, of) if isinstance(of, bool) else of
            if len(rows) != n_vertices:
                raise ValueError(f"`Free.{name}` has {len(rows)} rows for {n_vertices} control vertices.")
            return jnp.repeat(jnp.asarray(rows)[:, None], width, axis=1)

        found = Unknowns(
            mask("vertices", self.vertices, 3),
            mask("normals", self.normals, 2) if scheme.uses_normals else None,
            jnp.ones(scheme.h.shape, bool) if self.h and scheme.h is not None else None,
        )
        if found.vertices is None and found.normals is None and found.h is None:
            raise ValueError(
                f"nothing is free: {type(scheme).__name__} has neither normals nor h. Let vertices be True."
            )
        return found


class Unknowns(eqx.Module):
    """Offsets from where a sweep starts, each scaled so that 1 moves the surface by about 1 mm; or which are free."""

    vertices: Float[Array, "v 3"] | Bool[Array, "v 3"] | None
    normals: Float[Array, "v 2"] | Bool[Array, "v 2"] | None
    """Along two tangents of the unit sphere at the normal: its length is no unknown."""
    h: Float[Array, "..."] | Bool[Array, "..."] | None


def no_offset(free: Free, scheme: js.AbstractScheme, control: js.Control) -> Unknowns:
    """The start of a sweep. An array of which a part is free has offsets for all of it; the masks say which count."""
    dtype = control.vertices.dtype
    masks = free.of(scheme, control.vertices.shape[0])
    return Unknowns(
        None if masks.vertices is None else jnp.zeros(masks.vertices.shape, dtype),
        None if masks.normals is None else jnp.zeros(masks.normals.shape, dtype),
        None if masks.h is None else jnp.zeros(masks.h.shape, dtype),
    )


def apply_offset(
    topology: js.Topology, scheme: js.AbstractScheme, control: js.Control, offset: Unknowns
) -> tuple[js.AbstractScheme, js.Control]:
    """Scheme and control with the offset put on: normals that turn become unit, what is not free stays bit for bit."""
    vertices, normals = control.vertices, control.normals
    length = js.edge_length(topology, control.vertices)
    if offset.normals is not None:
        # By eq. (2) an edge point moves by an eighth of the edge for a normal that turns by one radian.
        normals = unit(normals)
        first, second = tangents(normals)
        turn = offset.normals[:, :1] * first + offset.normals[:, 1:] * second
        normals = unit(normals + turn * (8 / length))
    if offset.vertices is not None:
        vertices = vertices + offset.vertices
    if offset.h is not None:
        h = scheme.h + (offset.h / h_effect(length)).astype(scheme.h.dtype)
        scheme = eqx.tree_at(lambda s: s.h, scheme, h)
    return scheme, js.Control(vertices, normals)


def h_effect(length: Float[Array, ""]) -> Float[Array, ""]:
    """How far, in mm, the surface moves for a change of h by one: about a tenth of an edge in a sensible mesh."""
    return 0.1 * length


def tangents(n: Rows) -> tuple[Rows, Rows]:
    """Two unit vectors at right angles to a unit vector and to each other."""
    # The axis that is farthest from the normal never leaves the cross product short.
    least = jnp.argmin(jnp.abs(n), axis=1)
    first = unit(cross(n, jnp.eye(3, dtype=n.dtype)[least]))
    return first, cross(n, first)
