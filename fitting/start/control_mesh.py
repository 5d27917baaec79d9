"""A control mesh made from a scan, where none is given."""

from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

import jaxsubdiv as js
from jaxsubdiv.extras import import_extra
from jaxsubdiv.half_edges import half_edges
from jaxsubdiv.notices import warn

from ..finding import Finding
from ..scan.closest_points import nearest_rows
from ..scan.scan import Scan, ScanError
from .align import sample_faces
from .cloud import Cloud, clean
from .outline import is_better, parts_of_outline
from .parts import Part, PartKind, choose, find_parts, points_of_others
from .reconstruct import reconstruct_smoothly
from .remesh import Coarse, Dense, coarsen, pair_triangles, relax

FaceKind: TypeAlias = Literal["triangle", "quad"]

_LEAST_FACES = 16
_SIZES = (1.0, 5000.0)  # mm: what is smaller or larger is hardly anatomy, but in another unit
_SAMPLES, _FAR_OFF = 10_000, 0.3  # tips of what is long lie off a few faces, too: the fit reaches those
_MORE = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0)  # times the faces asked for
_MAD = 1.4826
_CUT = 4.685
_BENT = 0.2  # cosine


def control_mesh(
    scan: Scan,
    *,
    faces: int = 500,
    kind: FaceKind = "triangle",
    closed: bool | None = None,
    part: PartKind | None = None,
) -> js.ControlMesh:
    """A coarse, even mesh on the scan, with outward normals: manifold, wound outwards, one part unless all are wanted.

    Outliers are dropped, normals estimated (those of the scan are used where it has any) and turned outwards; a Poisson
    surface bridges the holes, is cut back to the points where the scan is open, and coarsened to clusters of equal
    area. Vertices are then put on the points, by local quadrics that average the noise away. `topology_of` tells what
    came out.

    Args:
        scan: in mm. At most 40,000 of its points are looked at.
        faces: about how many.
        kind: "triangle"; or "quad", where an open mesh may keep a few triangles.
        closed: True bridges every gap, False cuts every large one open. None decides: open where over 20 % of the
            closed surface lies far from all points.
        part: of a scan that shows several: the "largest" by area, the one "nearest" to the middle of all points, or
            "all". Default: the largest, with a warning.

    Warns:
        UserWarning: other parts of the scan were left out, though `part` does not ask for one; the text gives their
            shares of the points. Or the scan is so small or large that its unit is hardly mm.

    Raises:
        ValueError: `kind` or `part` is none of these, or `faces` below 16.
        ScanError: fewer than 50 points, all on a line or a plane, or no surface in them; contours in slices that lie
            far apart; faces too few for the topology, or to reach all of the scan.
        ImportError: the extra `mesh` is missing.

    Source: Kazhdan 2006 (Poisson), Hoppe 1992 and Hou 2022 (normals), Valette 2004 (clusters).
    """
    return make_control_mesh(scan, faces=faces, kind=kind, closed=closed, part=part).mesh


class Made(NamedTuple):
    """A control mesh made from a scan."""

    mesh: js.ControlMesh
    findings: tuple[Finding, ...]
    """What speaks against it: parts that were left out, a size of another unit."""
    shown: Bool[np.ndarray, "p"]
    """Points of the scan that do not lie on parts that were left out."""


def make_control_mesh(scan: Scan, *, faces: int, kind: FaceKind, closed: bool | None, part: PartKind | None) -> Made:
    """The same as `control_mesh`, with what was left out; it warns of the findings."""
    if kind not in get_args(FaceKind):
        raise ValueError(f"`kind` is one of {', '.join(get_args(FaceKind))}; got {kind!r}.")
    if part is not None and part not in get_args(PartKind):
        raise ValueError(f"`part` is one of {', '.join(get_args(PartKind))}, or None; got {part!r}.")
    if faces < _LEAST_FACES:
        raise ValueError(f"`faces` must be {_LEAST_FACES} or more; got {faces}.")
    for library in ("pyacvd", "rustworkx"):
        import_extra(library, "mesh", "control meshes made from scans")
    cloud = clean(scan)
    parts = find_parts(cloud, closed)
    thin = closed is None and is_better(scan, cloud, parts)
    parts = parts_of_outline(scan, cloud) if thin else parts
    chosen, others, findings = choose(parts, part)
    findings = (*_unit_doubt(float(np.linalg.norm(np.ptp(cloud.points, axis=0)))), *findings)
    for finding in findings:
        warn(finding.text)
    area = sum(one.dense.areas.sum() for one in chosen)
    meshes = [
        _mesh_of(one, max(_LEAST_FACES, round(faces * one.dense.areas.sum() / area)), kind, thin) for one in chosen
    ]
    points = np.asarray(scan.points, np.float64)
    left_out = points_of_others(points, chosen, others) if others else np.zeros(len(points), bool)
    return Made(_join(meshes), findings, ~left_out)


def _mesh_of(part: Part, faces: int, kind: FaceKind, thin: bool) -> js.ControlMesh:
    triangles = faces if kind == "triangle" else 2 * faces
    # The two walls of something thin need clusters as small as it is thick, and its handles are true.
    tries = (coarsen(part.dense, round(more * triangles), part.topology) for more in (_MORE if thin else (1.0,)))
    coarse = next((found for found in tries if found is not None), None)
    if coarse is None and (smooth := _drop_handles(part, triangles)) is not None:
        coarse = coarsen(smooth.dense, triangles, smooth.topology)
        if coarse is not None:
            warn(
                f"{faces} faces are too few for what the scan shows ({part.topology}), so narrow handles were closed "
                f"({smooth.topology}). Ask for more faces where they are true."
            )
            part = smooth
    if coarse is None:
        raise ScanError(
            f"{faces} faces are too few for what the scan shows ({part.topology}). Ask for more faces; if there should "
            "be fewer handles or rims, the points are too sparse or noisy to tell the sheets apart."
        )
    coarse = relax(pair_triangles(coarse) if kind == "quad" else coarse, part.dense)
    vertices, normals = _move_onto_points(coarse, part.dense, part.cloud)
    mesh = js.ControlMesh(vertices, {size: rows.astype(np.int32) for size, rows in coarse.faces.items()}, normals)
    _check_near(mesh, part)
    return mesh


def _drop_handles(part: Part, triangles: int) -> Part | None:
    """The part with fewer handles, where its surface stays within two edges of so many triangles of the points; else
    None."""
    if not part.topology.genus:
        return None
    edge = np.sqrt(4 / 3**0.5 * part.dense.areas.sum() / triangles)
    found = reconstruct_smoothly(part.cloud, part.topology.is_closed)
    off = np.quantile(KDTree(found.pieces[0].vertices).query(part.cloud.points)[0], 0.95)
    if found.topology.genus >= part.topology.genus or off > 2 * edge:
        return None
    return Part(found.cloud, found.pieces[0], found.topology)


def _check_near(mesh: js.ControlMesh, part: Part) -> None:
    """Raise where so few faces leave out a part of what the scan shows."""
    points = part.cloud.points
    off = np.quantile(KDTree(sample_faces(mesh, _SAMPLES).points).query(points)[0], 0.9)
    size = np.linalg.norm(np.ptp(points, axis=0))
    if off > _FAR_OFF * size:
        raise ScanError(
            f"a control mesh of {mesh.n_faces} faces leaves out a part of the scan: a tenth of the points lie over "
            f"{off:.3g} mm from it, for a size of {size:.3g} mm. Ask for more faces."
        )


def _join(meshes: list[js.ControlMesh]) -> js.ControlMesh:
    """One mesh of several that do not hang together."""
    if len(meshes) == 1:
        return meshes[0]
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = {
        size: np.concatenate([mesh.faces[size] + n for mesh, n in zip(meshes, first, strict=False)]).astype(np.int32)
        for size in (3, 4)
    }
    normals = np.concatenate([np.asarray(mesh.normals) for mesh in meshes])
    return js.ControlMesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, normals)


def _unit_doubt(size: float) -> tuple[Finding, ...]:
    if _SIZES[0] <= size <= _SIZES[1]:
        return ()
    text = (
        f"the scan measures {size:.3g} across, which is taken as mm. If it is in another unit, read it with `scale=`: "
        "1000 for metres, 0.001 for micrometres."
    )
    return (Finding("unit", text, {"scan": size}),)


# ------------------------------------------------------------------------------------------------------------ placing


def _move_onto_points(
    coarse: Coarse, dense: Dense, cloud: Cloud
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
    """Vertices on the points and normals there, by a quadric through the points around each; where a hole is, the dense
    surface's own."""
    x = coarse.vertices
    sides = half_edges(coarse.faces)
    edge = float(np.linalg.norm(np.diff(x[sides.edges], axis=1), axis=2).mean())
    # Wide enough to average the noise, no wider than half the way to the next vertex: an edge would be rounded off.
    width = float(
        np.clip(1.6 * cloud.spacing + 2 * cloud.noise, 1.5 * cloud.spacing, max(0.4 * edge, 1.5 * cloud.spacing))
    )
    normal = dense.normals()[KDTree(dense.vertices).query(x)[1]]
    k = int(np.clip(np.pi * (2 * width / cloud.spacing) ** 2, 12, 150))
    distance, rows = nearest_rows(KDTree(cloud.points), x, min(k, len(cloud.points)))
    first, second = _tangents(normal)
    offset = cloud.points[rows] - x[:, None]
    u, v, h = (np.einsum("vkx,vx->vk", offset, axis) / width for axis in (first, second, normal))
    terms = np.stack([np.ones_like(u), u, v, u * u / 2, u * v, v * v / 2], axis=2)
    # The other side of a thin part lies as near as this one; its normals tell.
    near = np.exp(-((distance / width) ** 2)) * (np.einsum("vkx,vx->vk", cloud.normals[rows], normal) > 0.3)
    weight, found = near, np.zeros((len(x), 6))
    for _ in range(4):
        normal_matrix = np.einsum("vka,vkb,vk->vab", terms, terms, weight, optimize=True)
        # A little of a flat plane, which matters where points are few or lie to one side.
        ridge = 1e-3 * np.maximum(weight.sum(axis=1), 1e-9)[:, None] * np.array([1e-6, 1e-3, 1e-3, 1, 1, 1])
        right = np.einsum("vka,vk,vk->va", terms, h, weight, optimize=True)
        found = np.linalg.solve(normal_matrix + ridge[:, :, None] * np.eye(6), right[:, :, None])[:, :, 0]
        residual = np.abs(h - np.einsum("vka,va->vk", terms, found))
        scale = np.maximum(_MAD * np.median(np.where(near > 0.1, residual, np.nan_to_num(residual)), axis=1), 1e-6)
        weight = near * np.maximum(1 - (residual / (_CUT * scale[:, None])) ** 2, 0) ** 2
    # Enough points, on all sides, and no step that is larger than what the dense surface can be off.
    centre = (
        np.stack([(weight * u).sum(axis=1), (weight * v).sum(axis=1)], axis=1)
        / np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    )
    step = found[:, 0] * width
    sure = (weight.sum(axis=1) > 4) & (np.linalg.norm(centre, axis=1) < 0.5) & (np.abs(step) < 0.3 * edge)
    x = np.where(sure[:, None], x + step[:, None] * normal, x)
    turned = normal - found[:, 1:2] * first - found[:, 2:3] * second
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    turned = np.where((sure & (np.einsum("vx,vx->v", turned, normal) > 0.7))[:, None], turned, normal)
    return x, _correct_normals(x, coarse, turned)


def _correct_normals(
    x: Float[np.ndarray, "v 3"], coarse: Coarse, normals: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v 3"]:
    """The normals, but where a face would bend back on itself under one.

    In a fold narrower than the faces the middle of the faces' own normals serves better than the true one.
    """
    own, least = np.zeros_like(x), np.ones(len(x))
    for size in (3, 4):
        rows = coarse.faces[size]
        areas = js.vector_areas(x[rows])
        unit = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), np.finfo(float).tiny)
        for corner in rows.T:
            np.add.at(own, corner, areas)
            np.minimum.at(least, corner, np.einsum("fx,fx->f", unit, normals[corner]))
    length = np.linalg.norm(own, axis=1, keepdims=True)
    own = np.divide(own, length, out=normals.copy(), where=length > 0)
    return np.where((least < _BENT)[:, None], own, normals)


def _tangents(normal: Float[np.ndarray, "v 3"]) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normal, first)
