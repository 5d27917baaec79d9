"""The parts of a scan: surfaces that do not hang together, and the points of each."""

from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jaxsubdiv.notices import warn

from ..finding import Finding
from ..scan.scan import ScanError
from .cloud import LEAST_POINTS, Cloud, clean_points
from .mesh_topology import MeshTopology
from .reconstruct import is_closed, reconstruct
from .remesh import Dense

PartKind: TypeAlias = Literal["largest", "nearest", "all"]

_NEAR = 2.0  # times the distance to the tenth neighbour: a point that near to a part belongs to it
_MORE = 0.08  # share of the points beside all parts found, above which another part is looked for among them
_ITS_OWN = 0.5  # share of those points that must lie on it
_MOST_PARTS = 12


class Part(NamedTuple):
    """A surface that hangs together, among the points of the scan that lie on it."""

    cloud: Cloud
    dense: Dense
    topology: MeshTopology


def find_parts(cloud: Cloud, closed: bool | None) -> list[Part]:
    """The parts of a scan, that of the most area first.

    A Poisson surface of two objects at once may lose one: normals that are turned wrongly cancel. So what of the points
    lies on no part is looked at again, for itself.
    """
    if cloud.label is not None:
        of_labels: list[Part] = []
        for one in np.unique(cloud.label[cloud.label >= 0]):
            try:
                of_labels += find_parts(take_points(cloud, cloud.label == one)._replace(label=None), closed)
            except ScanError:
                continue  # too small, or no surface
        if of_labels:
            return sorted(of_labels, key=lambda part: -part.dense.areas.sum())
    parts: list[Part] = []
    if len(cloud.points) < LEAST_POINTS:
        raise ScanError(f"{len(cloud.points)} points are too few for a surface; {LEAST_POINTS} are the least.")
    rest, n = _turn_outwards(cloud) if cloud.given else cloud, len(cloud.points)
    found = reconstruct(rest, closed)
    while len(parts) < _MOST_PARTS:
        own = nearest_piece(found.cloud.points, found.cloud.reach, found.pieces)
        if parts and np.mean(own >= 0) < _ITS_OWN:
            break
        for i, dense in enumerate(found.pieces):
            it = own == i
            if it.sum() >= LEAST_POINTS or not parts:
                topology = found.topology if i == 0 else dense.topology()
                part = Part(take_points(found.cloud, it), dense, topology)
                parts.append(part if cloud.given else _orient_outwards(part))
        beside = nearest_piece(rest.points, rest.reach, found.pieces) < 0
        if beside.sum() < max(_MORE * n, LEAST_POINTS):
            break
        try:
            left = clean_points(rest.points[beside], rest.normals[beside] if rest.given else None)
            rest = left._replace(view=rest.view)
            found = reconstruct(rest, closed)
        except ScanError:
            break  # what is left is scattered
    return sorted(parts, key=lambda part: -part.dense.areas.sum())


def take_points(cloud: Cloud, chosen: Bool[np.ndarray, "p"]) -> Cloud:
    """The chosen points, with what is known of each but its label."""
    points, normals, reach = (rows[chosen] for rows in (cloud.points, cloud.normals, cloud.reach))
    return cloud._replace(points=points, normals=normals, reach=reach)


def choose(parts: list[Part], kind: PartKind | None) -> tuple[list[Part], list[Part], tuple[Finding, ...]]:
    """Which parts are to be fitted, which are left out, and what is to be told of it: nothing where the user chose.

    Args:
        kind: "largest", by area; "nearest" to the middle of all points; "all"; None is the largest, and told.
    """
    if kind == "all" or len(parts) == 1:
        return parts, [], ()
    chosen = 0
    if kind == "nearest":
        middle = np.concatenate([part.cloud.points for part in parts]).mean(axis=0)
        chosen = int(np.argmin([np.linalg.norm(part.cloud.points - middle, axis=1).min() for part in parts]))
    others = parts[:chosen] + parts[chosen + 1 :]
    if kind is not None:
        return [parts[chosen]], others, ()
    counts = [len(part.cloud.points) for part in parts]
    shares = [count / sum(counts) for count in counts[1:]]
    text = (
        f"the scan shows {len(parts)} parts; the control mesh has the largest alone. Left out: "
        f"{', '.join(f'{share:.0%}' for share in shares)} of the points. Choose by --part largest, nearest or all "
        "(`part=`)."
    )
    return [parts[0]], others, (Finding("parts_left_out", text, {"parts": len(parts), "share": sum(shares)}),)


def points_of_others(points: Float[np.ndarray, "p 3"], chosen: list[Part], others: list[Part]) -> np.ndarray:
    """Which points lie on parts that were left out."""
    reach = np.full(len(points), np.median(np.concatenate([part.cloud.reach for part in [*chosen, *others]])))
    return nearest_piece(points, reach, [part.dense for part in [*chosen, *others]]) >= len(chosen)


def nearest_piece(points: Float[np.ndarray, "p 3"], reach: Float[np.ndarray, "p"], pieces: list[Dense]) -> np.ndarray:
    """Of every point the nearest piece, -1 where that is farther than twice its reach: on none."""
    owner = np.repeat(np.arange(len(pieces)), [len(piece.vertices) for piece in pieces])
    distance, row = KDTree(np.concatenate([piece.vertices for piece in pieces])).query(points, workers=-1)
    return np.where(distance <= _NEAR * np.maximum(reach, np.median(reach)), owner[row], -1)


def _orient_outwards(part: Part) -> Part:
    """The same with its outside out: of two objects at once, one may come out turned against the other."""
    a, b, c = np.moveaxis(part.dense.vertices[part.dense.faces] - part.dense.vertices.mean(axis=0), 1, 0)
    if not part.topology.is_closed or np.einsum("tx,tx->", a, np.cross(b, c)) >= 0:
        return part
    dense = Dense(part.dense.vertices, part.dense.faces[:, ::-1])
    return Part(part.cloud._replace(normals=-part.cloud.normals), dense, part.topology)


def _turn_outwards(cloud: Cloud) -> Cloud:
    """Normals of a closed scan that all point inwards are turned; an open one may well be seen from inside."""
    if np.sum(cloud.areas[:, None] * (cloud.points - cloud.points.mean(axis=0)) * cloud.normals) > 0:
        return cloud
    turned = cloud._replace(normals=-cloud.normals)
    if not is_closed(turned):
        return cloud
    warn("the normals of the scan point inwards; they were turned.")
    return turned
