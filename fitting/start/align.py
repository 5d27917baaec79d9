"""Alignment: the template moved to where the scan is, by one linear map and a shift. numpy and scipy, no JAX."""

from itertools import permutations, product
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import polar
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import jaxsubdiv as js
from jaxsubdiv.notices import warn

from ..finding import Finding, Pose
from ..scan.closest_points import nearest_rows
from ..scan.landmarks import Landmarks, Placed, place_landmarks
from ..scan.outliers import dense_points, one_a_cell, rows_for_density
from ..scan.scan import Scan, ScanError

Kind: TypeAlias = Literal["rigid", "similarity", "affine"]

_AT_MOST = 20_000  # points of the scan that are looked at
_COARSE = (250, 1500)  # points of the scan and samples of the template, for every start
_FINE = (1500, 8000)  # for the best starts
_FIRST_STEPS, _COARSE_STEPS, _FINE_STEPS = 5, 12, 40
_COARSE_BEST = 8
_REFINED = 3
_SAME_TURN = 10.0  # degrees: two starts that came so near each other come to one pose
_MOVED = 1e-4  # of the size: a smaller step ends the search
# Along the surface a pair pulls this much of what it pulls across: enough to hold what no point-to-plane row holds
# (a sphere's rotation), too little to stop the slip that makes point-to-plane fast.
_ALONG = 0.1
_COUNTS = 4.0  # times the quantile `keep` of the distances: about 3 to 4 standard deviations
_CUT = 4.685  # Tukey's, in robust standard deviations
_MAD = 1.4826
# A pose far from the one given replaces it only where it is clearly better: a part of a scan fits many places well.
_CLEARLY = 0.75
_NEARBY = 30.0  # degrees
_MIRRORED = 0.6
_FITS = 0.004  # of the size: with so little left, no mirror is looked into
_ALIKE, _ALIKE_IN_PART = 1.1, 1.3
_FAR_ROTATION = 45.0  # degrees: two poses farther apart are two answers
# Of two poses the better one has more points near. Near is this many times the distance that the nearest 30 % of the
# points of the best pose keep: a template in its place explains its own bone of two, one blown up neither.
_NEAR, _SURE = 8.0, 0.3
_APART = 5  # neighbours that tell how far apart the points lie
_FAR_SCALE = 1.5  # people of one kind hardly differ by more
_WHOLE = 0.7  # share of the template with points near, below which a scan shows a part of it
# Sizes that differ by more than this are no two people, but two units.
_SAME_UNIT = 6.0
_UNITS = {10.0: "cm and mm, or dm and cm", 25.4: "inches and mm", 100.0: "m and cm", 1000.0: "m and mm"}
_LANDMARKS_PULL = 0.05  # of all the scan's points


class Alignment(NamedTuple):
    """Where the template goes."""

    transform: Float[np.ndarray, "4 4"]
    """Takes homogeneous positions (x, y, z, 1) on the template to the scan."""
    mesh: js.ControlMesh
    """The control mesh there. Normals turn along, by the inverse transpose and to unit length; None stay None."""
    rms: float
    """Root mean square distance, in mm, of the scan points that count from the control mesh's flat faces."""
    share: float
    """Part of the scan's points that count, 0 to 1: the rest are outliers, or places that the template lacks."""
    doubts: tuple[Finding, ...]
    """Why it may be wrong; empty where nothing speaks against it."""
    pose: Pose
    """The same by its turn, scale and shift, with the shares of scan and template that lie near each other."""


class _Surface(NamedTuple):
    """Samples of the template, even by area."""

    points: Float[np.ndarray, "s 3"]
    normals: Float[np.ndarray, "s 3"]
    spacing: float
    tree: KDTree


class _Moments(NamedTuple):
    centre: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    """Columns, right-handed, the longest first."""
    size: float
    """Root mean square distance from the centre."""


class _Map(NamedTuple):
    """x -> linear @ x + shift, template to scan."""

    linear: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]

    def __call__(self, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return x @ self.linear.T + self.shift

    def map_back(self, x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return (x - self.shift) @ np.linalg.inv(self.linear).T


class _Pairs(NamedTuple):
    """Scan points beside their closest samples, in the scan's frame."""

    at: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    gap: Float[np.ndarray, "p 3"]
    across: Float[np.ndarray, "p"]
    """Signed distance along the normal."""
    beside: Float[np.ndarray, "p"]
    """Distance along the surface, less what the spacing of the samples explains: past a rim, or none."""

    @property
    def distance(self) -> Float[np.ndarray, "p"]:
        return np.hypot(self.across, self.beside)

    @property
    def past_rim(self) -> Bool[np.ndarray, "p"]:
        return self.beside > np.abs(self.across)


class _Found(NamedTuple):
    pose: _Map
    score: float
    """Root mean square distance of the part `keep` of the points that lies nearest."""
    distances: Float[np.ndarray, "p"]
    """Of all of them, sorted."""

    def near_score(self, near: float) -> float:
        """The same of all points, none of them farther than `near`, so that the rest of a scan has no say.

        Source: Torr and Zisserman 2000 (MSAC).
        """
        return float(np.sqrt(np.mean(np.minimum(self.distances, near) ** 2)))


def align(
    mesh: js.ControlMesh,
    scan: Scan,
    *,
    kind: Kind = "similarity",
    landmarks: Landmarks | tuple[Any, ...] | None = None,
    keep: float = 0.6,
    refine: bool = True,
) -> Alignment:
    """The control mesh moved to the scan, never mirrored.

    Starts are the pose as given, the same moved onto the scan's middle, turned there by 30 and 60 degrees and with its
    axes in every other order, and the 24 proper ways to lay the principal axes of the template on the scan's; or the
    landmarks alone, where they fix a pose. From each a short trimmed ICP runs on few points; the best ones are refined,
    point to plane with Tukey's weights. A pose near the given one is taken unless another is clearly better. Scattered
    outliers are dropped first. The same input gives the same answer.

    Args:
        mesh: the template, open or closed. Its flat faces are what the scan is compared with.
        scan: in mm. At most 20,000 of its points are looked at.
        kind: what may change: "rigid" turns and shifts, "similarity" also scales, "affine" also shears.
        landmarks: places on the scan and on the template, see `Landmarks`. Three or more that do not lie on a line fix
            the start; after that they pull softly beside the points.
        keep: part of the scan, outliers aside, that surely has a counterpart on the template. Lower it for a scan that
            shows more than the template has.
        refine: False ends after the landmarks alone, which must then fix the pose.

    Warns:
        UserWarning: one for each of `doubts`: mirrored, ambiguous, little of the scan used, another unit or size,
            landmarks far from their places.

    Raises:
        ScanError: fewer than 10 points, all on a line or one spot; a template without extent; landmarks that do not
            match; sizes that differ by six times or more, where no landmarks are given. The text names the likely unit.

    Source: Besl & McKay 1992 (ICP); Chetverikov 2002 (trimmed); Chen & Medioni 1991 (point to plane); Umeyama 1991.
    """
    if kind not in get_args(Kind):
        raise ValueError(f"`kind` is one of {', '.join(get_args(Kind))}; got {kind!r}.")
    if not 0 < keep <= 1:
        raise ValueError(f"`keep` is a part of the scan, over 0 and up to 1; got {keep}.")
    mesh.check()
    placed = None if landmarks is None else place_landmarks(landmarks, mesh)
    doubts: list[Finding] = []
    start = None if placed is None else _landmark_pose(placed, kind)
    if scan.weights is not None:
        scan = scan.rows(np.asarray(scan.weights) > 0)  # the others are as if they were not there
    points = _thin(np.asarray(scan.points, np.float64))
    if not refine:
        if start is None:
            raise ScanError("without `refine` the landmarks must fix the pose: give three or more, not on a line.")
        found = _Found(start, 0.0, np.zeros(0))
        return _finish(mesh, scan, points, found, [], sample_faces(mesh, _FINE[1]), placed, keep, doubts)

    moments, of_mesh = _moments(points, "scan"), _moments(sample_faces(mesh, _FINE[1]).points, "template")
    unit = _unit_doubt(moments.size, of_mesh.size)
    if unit and start is None:
        raise ScanError(unit)
    doubts += [Finding("unit", unit, {"scan": moments.size, "template": of_mesh.size})] if unit else []

    poses = _starts(of_mesh, moments, kind) if start is None else [start]
    surface, few = sample_faces(mesh, _COARSE[1]), _rows(points, _COARSE[0])
    free = "similarity" if kind == "affine" else kind
    best = _best_starts(poses, few, surface, free, keep, placed)
    surface, many = sample_faces(mesh, _FINE[1]), _rows(points, _FINE[0])
    fine = [_search(found.pose, many, surface, free, keep, placed, _FINE_STEPS) for found in best]
    fine = [one for one in fine if np.isfinite(one.score)] or fine
    near = _near_distance(fine)
    chosen = min(
        fine, key=lambda one: one.near_score(near) * (_CLEARLY if _angle(one.pose.linear) < 2 * _NEARBY else 1)
    )
    # Of those that came to nearly one pose, the one whose nearer points lie nearest.
    chosen = min((one for one in fine if _turn_between(one, chosen) < _SAME_TURN), key=lambda one: one.score)
    others: list[_Found] = []
    if start is None:
        own = _search(chosen.pose, few, sample_faces(mesh, _COARSE[1]), free, keep, None, _COARSE_STEPS)
        fits = np.quantile(own.distances, _SURE) < _FITS * moments.size
        other = own if fits else _align_mirrored(mesh, few, of_mesh, moments, free, keep)
        as_it_is, mirrored = (one.near_score(_near_distance([own, other])) for one in (own, other))
        if mirrored < _MIRRORED * as_it_is:
            doubts.append(
                Finding(
                    "mirrored",
                    f"the scan fits better as a mirror image ({mirrored:.2g} against {as_it_is:.2g} mm): it shows the "
                    "other side of the body, or an axis was flipped or two axes were exchanged when it was written. "
                    "Undo that, or give --mirror (`mirror=True`), which takes the template's mirror image.",
                    {"mirrored": mirrored, "as_it_is": as_it_is},
                )
            )
        else:
            others = [one for one in fine if one is not chosen]
    pose = chosen.pose
    if kind == "affine":
        pose = _search(pose, many, surface, kind, keep, placed, _FINE_STEPS).pose
    return _finish(mesh, scan, many, chosen._replace(pose=pose), others, surface, placed, keep, doubts)


# --------------------------------------------------------------------------------------------------- what is compared


def sample_faces(mesh: js.ControlMesh, n: int) -> _Surface:
    """About `n` samples of the faces, quads as two triangles: low-discrepancy, so that they are even without a seed."""
    triangles = np.concatenate([mesh.faces[3], mesh.faces[4][:, [0, 1, 2]], mesh.faces[4][:, [0, 2, 3]]])
    a, b, c = np.moveaxis(mesh.vertices[triangles], 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1) / 2
    total = np.cumsum(area)
    sequence = (np.arange(n)[:, None] * (1 / 1.2207440846, 1 / 1.2207440846**2, 1 / 1.2207440846**3)) % 1
    face = np.searchsorted(total, (np.arange(n) + 0.5) / n * total[-1])
    u, v = sequence[:, 0], sequence[:, 1]
    u, v = np.where(u + v > 1, 1 - u, u)[:, None], np.where(u + v > 1, 1 - v, v)[:, None]
    points = a[face] + u * (b - a)[face] + v * (c - a)[face]
    unit = normal[face] / (2 * area[face, None])
    return _Surface(points, unit, float(np.sqrt(total[-1] / n)), KDTree(points))


def _thin(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "q 3"]:
    """The scan without what is scattered, at an even density."""
    if len(points) < 10:
        raise ScanError(f"a scan of {len(points)} points cannot be aligned; 10 are the least.")
    points = _rows(points, _AT_MOST)
    points = points[rows_for_density(points)]
    dense = points[dense_points(points)]
    extent = np.ptp(dense, axis=0).max()
    cell = extent / 40
    rows = one_a_cell(dense, cell) if cell > 0 else np.arange(len(dense))
    return dense[rows] if len(rows) >= 100 else dense


def _rows(points: Float[np.ndarray, "p 3"], n: int) -> Float[np.ndarray, "q 3"]:
    """`n` of the points, drawn alike every time."""
    return points if len(points) <= n else points[np.random.default_rng(0).choice(len(points), n, replace=False)]


def _moments(points: Float[np.ndarray, "n 3"], name: str) -> _Moments:
    centre = points.mean(axis=0)
    x = points - centre
    _, width, axes = np.linalg.svd(x if len(x) > 2 else np.repeat(x, 3, axis=0), full_matrices=False)
    if width[1] <= 1e-6 * width[0] or width[0] <= 1e-12 * np.abs(centre).max():
        where = "one spot" if width[0] <= 1e-12 * np.abs(centre).max() else "a line"
        raise ScanError(
            f"all points of the {name} lie on {where}, near {np.round(centre, 3).tolist()}: no pose follows."
        )
    axes = axes.T
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return _Moments(centre, axes, float(np.sqrt((x**2).sum(axis=1).mean())))


def _unit_doubt(scan: float, template: float) -> str:
    """Empty where the sizes may be those of one unit."""
    ratio = max(scan, template) / min(scan, template)
    if ratio < _SAME_UNIT:
        return ""
    near = min(_UNITS, key=lambda unit: abs(np.log(ratio / unit)))
    small, large = ("scan", "template") if scan < template else ("template", "scan")
    factor = near if scan < template else 1 / near
    return (
        f"the {large} is {ratio:.3g} times as large as the {small} (rms radius {max(scan, template):.3g} against "
        f"{min(scan, template):.3g}): about {near:g}, so the units are likely {_UNITS[near]}. Read the scan with "
        f"scale={factor:.4g}, or bring the template to mm; give landmarks where the scan truly shows a small part."
    )


# ------------------------------------------------------------------------------------------------------------- starts


def _starts(template: _Moments, scan: _Moments, kind: Kind) -> list[_Map]:
    """The pose as given comes first."""
    sizes = [1.0] if kind == "rigid" else [1.0, scan.size / template.size]
    poses = [_Map(np.eye(3), np.zeros(3))]
    turns = [(size, np.eye(3)) for size in sizes]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    nearby = Rotation.from_rotvec(_NEARBY * np.concatenate([axes, 2 * axes]), degrees=True).as_matrix()
    turns += [(sizes[0], turn) for turn in [*nearby, *_quarter_turns()[1:]]]
    turns += [(sizes[-1], scan.axes @ turn @ template.axes.T) for turn in _quarter_turns()]
    return poses + [_centre(size * turn, template, scan) for size, turn in turns]


def _centre(linear: Float[np.ndarray, "3 3"], template: _Moments, scan: _Moments) -> _Map:
    """Takes the template's middle to the scan's."""
    return _Map(linear, scan.centre - linear @ template.centre)


def _quarter_turns() -> list[Float[np.ndarray, "3 3"]]:
    """The 24 rotations that take a cube to itself, none at all first."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0:
            found.append(turn)
    return found


def _landmark_pose(placed: Placed, kind: Kind) -> _Map | None:
    """The map of least squares that takes the landmarks of the template to the scan's; None where many do."""
    weights = placed.weights / placed.weights.sum()
    centres = weights @ placed.mesh, weights @ placed.scan
    x, y = placed.mesh - centres[0], placed.scan - centres[1]
    root = np.sqrt(weights)[:, None]
    widths = [np.linalg.svd(root * rows, compute_uv=False) for rows in (x, y)]
    if any(len(w) < 2 or w[1] <= 1e-3 * w[0] or w[0] == 0 for w in widths):
        return None
    if kind == "affine" and len(x) >= 4 and all(w[2] > 1e-2 * w[0] for w in widths):
        linear = np.linalg.lstsq(root * x, root * y)[0].T
        if np.linalg.det(linear) > 0:
            return _Map(linear, centres[1] - linear @ centres[0])
    u, s, vt = np.linalg.svd((weights[:, None] * y).T @ x)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])  # of two answers the one that does not mirror
    scale = 1.0 if kind == "rigid" else (s @ sign) / np.sum(widths[0] ** 2)
    linear = scale * (u * sign) @ vt
    return _Map(linear, centres[1] - linear @ centres[0])


# ------------------------------------------------------------------------------------------------------------- search


def _search(
    pose: _Map,
    points: Float[np.ndarray, "p 3"],
    surface: _Surface,
    kind: Kind,
    keep: float,
    placed: Placed | None,
    steps: int,
) -> _Found:
    """Iterated closest points from `pose`."""
    size = float(np.sqrt(points.var(axis=0).sum()))
    generators = _generators(kind)
    for _ in range(steps):
        pairs = _pairs(pose, points, surface)
        moved, pose = _step(pose, pairs, _weights(pairs, keep), generators, placed, size)
        if not (0.1 * size < _spread(pose, surface) < 10 * size):
            # Shrunk into the scan, or blown up until it is a plane.
            return _Found(pose, np.inf, np.full(len(points), np.inf))
        if moved < _MOVED:
            break
    distance = np.sort(_pairs(pose, points, surface).distance)
    return _Found(pose, float(np.sqrt(np.mean(distance[: max(1, round(keep * len(distance)))] ** 2))), distance)


def _best_starts(
    poses: list[_Map],
    points: Float[np.ndarray, "p 3"],
    surface: _Surface,
    kind: Kind,
    keep: float,
    placed: Placed | None,
) -> list[_Found]:
    """The best few after a short search from each; the first pose, the one given, is always among them."""
    found = [_search(pose, points, surface, kind, keep, placed, _FIRST_STEPS) for pose in poses]
    found = _choose_apart(found, _COARSE_BEST)
    found = [_search(one.pose, points, surface, kind, keep, placed, _COARSE_STEPS) for one in found]
    return _choose_apart(found, _REFINED)


def _choose_apart(found: list[_Found], n: int) -> list[_Found]:
    """The first, the best `n` of the others, and up to `n` more that are turned differently from all of these."""
    others = sorted(found[1:], key=lambda one: one.score)
    apart = others[:n]
    for one in others[n:]:
        if len(apart) < 2 * n and all(_turn_between(one, other) > _SAME_TURN for other in apart):
            apart.append(one)
    return found[:1] + apart


def _spread(pose: _Map, surface: _Surface) -> float:
    return float(np.sqrt(pose(surface.points[::50]).var(axis=0).sum()))


def _pairs(pose: _Map, points: Float[np.ndarray, "p 3"], surface: _Surface) -> _Pairs:
    """Closest samples are sought in the template's frame, so that its tree stays; distances are the scan's."""
    row = surface.tree.query(pose.map_back(points))[1]
    at = pose(surface.points[row])
    normals = surface.normals[row] @ np.linalg.inv(pose.linear)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    gap = points - at
    across = np.einsum("px,px->p", gap, normals)
    beside = np.sqrt(np.maximum(np.einsum("px,px->p", gap, gap) - across**2, 0))
    spacing = surface.spacing * np.cbrt(np.linalg.det(pose.linear))
    return _Pairs(at, normals, gap, across, np.maximum(beside - spacing, 0))


def _weights(pairs: _Pairs, keep: float) -> Float[np.ndarray, "p"]:
    """Tukey's, against a scale that looks at the nearer half of the part `keep` alone; 0 past the template's rim."""
    distance = pairs.distance
    # The median of the part that is nearest: what is wrong in shape, such as another nose, shall not steer the pose.
    scale = max(_MAD * np.quantile(distance, keep / 2), 1e-9 * np.abs(pairs.at).max())
    weights = np.maximum(1 - (distance / (_CUT * scale)) ** 2, 0) ** 2
    return np.where(pairs.past_rim, 0, weights)


def _generators(kind: Kind) -> Float[np.ndarray, "k 3 3"]:
    """Directions in which the linear part may move."""
    if kind == "affine":
        return np.eye(9).reshape(9, 3, 3)
    turns = np.zeros((3, 3, 3))
    for i in range(3):
        turns[i, (i + 2) % 3, (i + 1) % 3], turns[i, (i + 1) % 3, (i + 2) % 3] = 1, -1
    return turns if kind == "rigid" else np.concatenate([turns, np.eye(3)[None]])


def _step(
    pose: _Map,
    pairs: _Pairs,
    weights: Float[np.ndarray, "p"],
    generators: Float[np.ndarray, "k 3 3"],
    placed: Placed | None,
    size: float,
) -> tuple[float, _Map]:
    """One Gauss-Newton step, and how far it moved in parts of the size."""
    total = weights.sum()
    if total <= 0:
        return 0.0, pose
    centre = weights @ pairs.at / total
    k = len(generators)
    by_column = generators.transpose(2, 1, 0).reshape(3, 3 * k)
    normal, right = np.zeros((k + 3, k + 3)), np.zeros(k + 3)

    def add(at, gap, weight, directions=None):
        linear = ((at - centre) / size @ by_column).reshape(len(at), 3, k)
        fields = np.concatenate([linear, np.broadcast_to(np.eye(3), (len(at), 3, 3))], axis=2)
        if directions is None:
            rows, gap, weight = fields.reshape(-1, k + 3), gap.ravel(), np.repeat(weight, 3)
        else:
            rows, gap = np.einsum("pa,pak->pk", directions, fields), np.einsum("pa,pa->p", directions, gap)
        weighted = (rows * weight[:, None]).T
        normal[:] += weighted @ rows
        right[:] += weighted @ gap

    add(pairs.at, pairs.gap, weights, pairs.normals)
    add(pairs.at, pairs.gap, _ALONG * weights)
    if placed is not None:
        at = pose(placed.mesh)
        add(at, placed.scan - at, _LANDMARKS_PULL * total * placed.weights / placed.weights.sum())
    found = np.linalg.lstsq(normal, right)[0]
    change, shift = np.einsum("k,kab->ab", found[:k] / size, generators), found[k:]
    if k == 9:
        turn = np.eye(3) + np.clip(change, -0.3, 0.3)
    else:
        turn = Rotation.from_rotvec([change[2, 1], change[0, 2], change[1, 0]]).as_matrix()
        turn = turn * np.exp(np.clip(np.trace(change) / 3, -0.3, 0.3))
    moved = float(np.abs(found).max() / size)
    return moved, _Map(turn @ pose.linear, turn @ (pose.shift - centre) + centre + shift)


# ------------------------------------------------------------------------------------------------------------- doubts


def _turn_between(one: _Found, other: _Found) -> float:
    """Degrees between two poses."""
    return _angle(one.pose.linear @ np.linalg.inv(other.pose.linear))


def _angle(linear: Float[np.ndarray, "3 3"]) -> float:
    """Degrees by which a similarity turns."""
    turn = linear / np.cbrt(np.linalg.det(linear))
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


def _near_distance(found: list[_Found]) -> float:
    """How far from the best of some poses a point still counts as near."""
    finite = (float(np.quantile(one.distances, _SURE)) for one in found if np.isfinite(one.score))
    return _NEAR * min(finite, default=0.0)


def _other_answers(chosen: _Found, others: list[_Found], share_of_template: float) -> list[Finding]:
    """Two poses far from each other that fit alike: a sphere, say. The pose as given needs no such excuse."""
    if _angle(chosen.pose.linear) < 2 * _NEARBY:
        return []
    # A scan of a part leaves more poses: one that is clearly worse on the whole may be right on another's body.
    alike = _ALIKE if share_of_template > _WHOLE else _ALIKE_IN_PART
    near = _near_distance([chosen, *others])
    for other in others:
        angle = _turn_between(other, chosen)
        as_near = other.near_score(near) < alike * chosen.near_score(near)
        if angle > _FAR_ROTATION and other.score < alike * chosen.score and as_near:
            return [
                Finding(
                    "two_poses_alike",
                    f"two poses fit alike ({chosen.score:.2g} and {other.score:.2g} mm), {angle:.0f} degrees apart: "
                    "turn the template to about the right pose, or give landmarks.",
                    {"score": chosen.score, "other": other.score, "apart": angle},
                )
            ]
    return []


def _align_mirrored(
    mesh: js.ControlMesh, points: np.ndarray, template: _Moments, scan: _Moments, kind: Kind, keep: float
) -> _Found:
    """The best fit to the template seen in a mirror, from the starts that the template itself had."""
    flip = np.diag([-1.0, 1.0, 1.0])
    surface = sample_faces(mesh, _COARSE[1])
    x = surface.points @ flip
    surface = surface._replace(points=x, normals=surface.normals @ flip, tree=KDTree(x))
    axes = flip @ template.axes @ np.diag([1.0, 1.0, -1.0])
    poses = _starts(template._replace(centre=flip @ template.centre, axes=axes), scan, kind)
    return min(_best_starts(poses, points, surface, kind, keep, None), key=lambda found: found.score)


def _finish(
    mesh: js.ControlMesh,
    scan: Scan,
    points: Float[np.ndarray, "q 3"],
    chosen: _Found,
    others: list[_Found],
    surface: _Surface,
    placed: Placed | None,
    keep: float,
    doubts: list[Finding],
) -> Alignment:
    """The record, with the numbers over points drawn from the whole scan."""
    pose = chosen.pose
    # The limit comes from the cleaned scan, where nearly all points count; the share is of the scan as it came.
    # Where only half of them lie on the template, the nearest 30 % tell.
    surely, mostly = np.quantile(_pairs(pose, points, surface).distance, [_SURE, keep])
    limit = min(_COUNTS * mostly, 2 * _COUNTS * surely)
    pairs = _pairs(pose, _rows(np.asarray(scan.points, np.float64), 5000), surface)
    counts = (pairs.distance <= limit) & ~pairs.past_rim
    share = float(counts.mean())
    rms = float(np.sqrt(np.mean(pairs.across[counts] ** 2))) if share else np.inf
    size = _spread(pose, surface)
    found = _describe(pose, surface, _rows(np.asarray(scan.points, np.float64), _AT_MOST), limit, share)
    if share and rms > 0.1 * size:
        text = f"the template is {rms:.3g} mm off where it fits best, for a size of {size:.3g} mm."
        doubts.append(Finding("template_off", text, {"rms": rms, "size": size}))
    if share < 0.25:
        text = f"only {100 * share:.0f} % of the scan's points lie near the template."
        doubts.append(Finding("few_points_near_template", text, {"share": share}))
    if placed is not None:
        off = np.linalg.norm(pose(placed.mesh) - placed.scan, axis=1)
        bad = np.flatnonzero((off > 0.2 * size) & (placed.weights > 0))
        if len(bad):
            named = ", ".join(f"{row} ({off[row]:.3g} mm)" for row in bad[:5])
            text = f"landmarks far from their place: rows {named}. Were they exchanged, or left and right?"
            doubts.append(Finding("landmarks_far", text, {"rows": len(bad), "farthest": float(off.max())}))
    else:
        doubts += _scale_doubt(found.scaled) + _other_answers(chosen, others, found.share_of_template)
    for doubt in doubts:
        warn(f"alignment: {doubt.text}")
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = pose.linear, pose.shift
    return Alignment(transform, place_mesh(mesh, transform), rms, share, tuple(doubts), found)


def _describe(pose: _Map, surface: _Surface, points: Float[np.ndarray, "p 3"], limit: float, share: float) -> Pose:
    """A map by its turn, scale and shift, and how much of scan and template lie near each other."""
    scale = float(np.cbrt(np.linalg.det(pose.linear)))
    turn, _ = polar(pose.linear)
    middle = surface.points.mean(axis=0, keepdims=True)
    there = pose(surface.points)
    # Where points lie far apart, none may be as near to a sample of the template as it is to the surface between them.
    tree = KDTree(points)
    apart = nearest_rows(tree, points, min(_APART, len(points)))[0][:, -1]
    near = tree.query(there)[0] <= np.hypot(limit, 2 * np.median(apart))
    moved = float(np.linalg.norm(pose(middle) - middle))
    return Pose(_angle(turn), scale, moved, share, float(near.mean()))


def _scale_doubt(scaled: float) -> list[Finding]:
    if 1 / _FAR_SCALE <= scaled <= _FAR_SCALE:
        return []
    text = (
        f"the template was scaled by {scaled:.2f} to fit: is it another kind of anatomy, or does the scan show more, "
        "or less, than the template? Keep its size by --align rigid, or give landmarks."
    )
    return [Finding("scaled_far", text, {"scaled": scaled})]


def mirror_image(mesh: js.ControlMesh, landmarks: Landmarks | None = None) -> tuple[js.ControlMesh, Landmarks | None]:
    """The mesh as a mirror shows it, in its place, with its faces wound outwards; and the landmarks on it."""
    flip, about = np.array([-1.0, 1.0, 1.0]), 2 * mesh.vertices.mean(axis=0) * (1, 0, 0)
    normals = None if mesh.normals is None else mesh.normals * flip
    faces = {size: rows[:, ::-1] for size, rows in mesh.faces.items()}
    if landmarks is not None and np.ndim(landmarks.on_mesh) == 2:
        landmarks = landmarks._replace(on_mesh=np.asarray(landmarks.on_mesh, np.float64) * flip + about)
    return js.ControlMesh(mesh.vertices * flip + about, faces, normals, regions=mesh.regions), landmarks


def place_mesh(mesh: js.ControlMesh, transform: Float[np.ndarray, "4 4"]) -> js.ControlMesh:
    """The mesh where an alignment puts it."""
    pose, normals = _Map(transform[:3, :3], transform[:3, 3]), mesh.normals
    if normals is not None:
        normals = normals @ np.linalg.inv(pose.linear)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return js.ControlMesh(pose(mesh.vertices), mesh.faces, normals, regions=mesh.regions)
