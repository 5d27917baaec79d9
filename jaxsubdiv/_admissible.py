"""How far normals are from folding the surface."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._control import Control
from ._mesh import ControlMesh
from .errors import name_rows
from .linalg import cross, dot, take, unit
from .notices import warn


def corner_cosines(
    vertices: Float[Array, "v 3"], normals: Float[Array, "v 3"], faces: dict[int, Int[Array, "..."]]
) -> Float[Array, "c"]:
    """The cosine between the vertex normal and the corner normal, eq. (5), at every corner of every face.

    Under 0 the normal points to the back of the face. 0, with gradient 0, where either normal vanishes. The least at
    a vertex is its `admissible_margin`.

    Args:
        vertices: positions, in any unit.
        normals: one a vertex, of any length.
        faces: `{3: [T, 3], 4: [Q, 4]}`; the corners of the triangles come first, the first corners before the second.
    """
    rows, normals = [], unit(normals)
    for _, of_size in sorted(faces.items()):
        corners = take(vertices, of_size)  # at once: every gather is a loop to compile in the derivative
        after, before = (jnp.roll(corners, step, axis=1) - corners for step in (-1, 1))
        rows.append(dot(take(normals, of_size), unit(cross(after, before)))[..., 0].T.reshape(-1))
    return jnp.concatenate(rows)


def admissible_margin(mesh: ControlMesh, control: Control | None = None) -> Float[np.ndarray, "v"]:
    """For every control vertex the least cosine between its normal and the corner normals of its faces.

    Above 0.05 the surface of the point-normal schemes is smooth there. Below about -0.05 at triangles, and -0.2 at
    quads, kept normals fold it; `Interpolating(old_normals="recompute")` does not. 0 where a vertex has no normal, 1
    where it has no faces.

    Args:
        mesh: the control mesh.
        control: its vertices and normals, if they are not those of `mesh.control()`.
    """
    given = mesh.control() if control is None else control
    x, n = np.asarray(given.vertices, np.float64), np.asarray(given.normals, np.float64)
    if x.shape != mesh.vertices.shape or n.shape != x.shape:
        raise ValueError(
            f"the control must have as many vertices and normals as the mesh, {list(mesh.vertices.shape)}; got "
            f"{list(x.shape)} and {list(n.shape)}."
        )
    sides, margin = mesh.half_edges, np.ones(len(x))
    here = x[sides.start]
    corner = np.cross(x[sides.end] - here, x[sides.before] - here)
    length = np.linalg.norm(n, axis=1)[sides.start] * np.linalg.norm(corner, axis=1)
    cosine = np.einsum("sx,sx->s", n[sides.start], corner) / np.where(length > 0, length, 1)
    np.minimum.at(margin, sides.start, cosine)
    return margin


def warn_of_folds(mesh: ControlMesh, control: Control | None = None) -> None:
    """Warn where a control normal points to the back of one of its vertex's own faces."""
    margin = admissible_margin(mesh, control)
    bad = np.flatnonzero(margin < -1e-6)
    if len(bad):
        worst = bad[np.argsort(margin[bad])]
        warn(
            f"the normals of vertices {name_rows(worst)} point to the back of one of their faces (margin down to "
            f"{margin.min():.2f}): the surface may fold there. Turn them, leave them out so that they are computed "
            'from the faces, or refine with old_normals="recompute".',
        )
