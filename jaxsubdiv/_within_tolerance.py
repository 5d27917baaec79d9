"""As many levels as bring the flat faces of a surface within a tolerance of its limit, and surfaces to print."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from . import notices
from ._control import Control
from ._creases import Creases
from ._distance import closest_on_mesh
from ._mesh import ControlMesh
from ._refine import refine, refine_vertices
from ._scheme.base import AbstractScheme
from ._surface import RefinedSurface
from ._topology import MAX_LEVELS, build_topology
from .half_edges import half_edges

_DEEPER = 2
_MOST_FACES = 1 << 22  # of the deeper surface, whose tables take about 1 GB


class WithinTolerance(NamedTuple):
    """A refined surface, and how far the limit is from its faces.

    Attributes:
        surface: with as few levels as will do.
        levels: how many.
        largest: distance of the limit from the triangles of `surface`, in the unit of the mesh: the largest, and
        rms: root mean square, both over the vertices of the surface two levels deeper.
    """

    surface: RefinedSurface
    levels: int
    largest: float
    rms: float


def refine_within(
    scheme: AbstractScheme,
    mesh: ControlMesh,
    control: Control,
    tolerance: float | int,
    *,
    mesh_normals: bool = False,
    limit: bool = False,
    creases: Creases | None = None,
) -> WithinTolerance:
    """Refine until the flat triangles of the surface are within a tolerance of the limit surface.

    The limit is measured at the vertices of the surface that is refined two levels deeper. Those of a linear scheme are
    moved to the limit itself. For other schemes what all deeper levels add is left out, about a fifteenth of the
    deviation. Distances are exact, from each vertex to the nearest triangle; a quad is two triangles.

    Args:
        scheme: the rules and their `h`, one for all levels.
        mesh: the control mesh; only its faces and its number of vertices matter.
        control: vertices and normals.
        tolerance: the largest deviation, in the unit of the mesh.
        mesh_normals, limit, creases: as `build_topology` has them.

    Raises:
        ValueError: the tolerance is not positive, `h` has one value a level, the mesh has more than a quarter of a
            million faces, or no level reaches the tolerance before the surface has so many.
    """
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise ValueError(f"the tolerance must be a positive length in the unit of the mesh; got {tolerance}.")
    if scheme.h is not None and scheme.h.ndim:
        raise ValueError("`h` has one value a level, so that there is no deeper surface to measure. Give one `h`.")
    most = _MOST_FACES // 4**_DEEPER
    if mesh.n_faces > most:
        raise ValueError(
            f"the mesh has {mesh.n_faces:,} faces, and the deviation from the limit is measured on surfaces of up to "
            f"{most:,}. Give a level, or a coarser control mesh."
        )
    largest = np.inf
    for levels in range(MAX_LEVELS - _DEEPER + 1):
        if mesh.n_faces * 4**levels > most:
            break
        topology = build_topology(mesh, scheme, levels, mesh_normals=mesh_normals, limit=limit, creases=creases)
        surface = refine(scheme, topology, control)
        away = _measure_from_limit(scheme, mesh, control, surface, levels, creases)
        largest, rms = float(away.max()), float(np.sqrt(np.mean(away**2)))
        if largest <= tolerance:
            return WithinTolerance(surface, levels, largest, rms)
    raise ValueError(
        f"a tolerance of {tolerance:g} is not reached: the finest surface that is measured lies {largest:.3g} off its "
        "limit. Give a greater tolerance, or a finer control mesh."
    )


def prepare_to_print(surface: RefinedSurface) -> RefinedSurface:
    """The surface as binary STL holds it: triangles, and vertices rounded to single precision.

    A vertex is rounded once, so that all of its triangles have it bit for bit, and readers of the file weld them into
    a watertight surface again where `surface` is closed.

    Warns:
        UserWarning: the surface is open, or so fine that some vertices coincide once they are rounded.
    """
    triangles = np.asarray(surface.triangles())
    single = np.asarray(surface.vertices, np.float32)
    sides = half_edges({3: triangles})
    n_open = int(np.sum(np.bincount(sides.edge, minlength=len(sides.edges)) == 1))
    if n_open:
        notices.warn(
            f"the surface has {n_open} boundary edges: it is not watertight, and a printer needs a closed one."
        )
    used = np.unique(triangles)
    n_before, n_after = (len(np.unique(x[used], axis=0)) for x in (np.asarray(surface.vertices), single))
    n_merged = n_before - n_after  # vertices that lie on one another as given are not rounded together
    if n_merged:
        notices.warn(
            f"{n_merged} vertices coincide with others in single precision: some triangles become lines. Refine less."
        )
    faces = {3: jnp.asarray(triangles, jnp.int32), 4: jnp.zeros((0, 4), jnp.int32)}
    return RefinedSurface(jnp.asarray(single), jnp.asarray(surface.normals, jnp.float32), faces)


def _measure_from_limit(
    scheme: AbstractScheme,
    mesh: ControlMesh,
    control: Control,
    surface: RefinedSurface,
    levels: int,
    creases: Creases | None,
) -> Float[np.ndarray, "w"]:
    topology = build_topology(mesh, scheme, levels + _DEEPER, limit=scheme.is_linear, creases=creases)
    deeper = np.asarray(refine_vertices(scheme, topology, control), np.float64)
    used = np.unique(np.concatenate([np.asarray(faces).ravel() for faces in topology.faces.values()]))
    corners = np.asarray(surface.vertices, np.float64)[np.asarray(surface.triangles())]
    return closest_on_mesh(deeper[used], corners)[0]
