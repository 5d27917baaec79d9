"""A control mesh made symmetric: its one half, and the mirror image of that. On the host."""

import warnings

import numpy as np
from jaxtyping import Float, Int

import jaxsubdiv as js

from ..scan.scan import Scan
from .align import align, mirror_image, sample_faces

_SNAP = 0.35  # of an edge: vertices so near the plane are put onto it, so that no slivers are cut
_SAMPLES = 4000


def make_symmetric(mesh: js.ControlMesh) -> js.ControlMesh:
    """A mesh of triangles that is the mirror image of itself: cut at its mirror plane, one half and the image of it.

    The plane is that of the rigid motion that lays the mesh's mirror image onto the mesh. The half that has more area
    is kept. Every vertex has a partner, which `find_symmetry` finds. Groups of faces stay with their half.

    Args:
        mesh: of an anatomy that is symmetric, roughly.

    Raises:
        ValueError: no half is left, or the two halves do not make a manifold mesh.
    """
    mesh = mesh.triangulate()
    middle, normal = find_mirror_plane(mesh)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces[3])
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    away = (vertices - middle) @ normal
    away[np.abs(away) < _SNAP * np.median(np.linalg.norm(edges, axis=2))] = 0.0
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    if areas[(away[faces] > 0).all(axis=1)].sum() < areas[(away[faces] < 0).all(axis=1)].sum():
        away, normal = -away, -normal
    vertices, away, faces = _cut(vertices, away, faces)
    kept = (away[faces] >= 0).all(axis=1) & (away[faces] > 0).any(axis=1)
    faces = faces[kept]
    if not len(faces):
        raise ValueError("the control mesh has nothing beside its mirror plane: is its anatomy symmetric at all?")
    used, faces = np.unique(faces, return_inverse=True)
    faces, vertices, away = faces.reshape(-1, 3), vertices[used], away[used]
    on = away == 0
    vertices = vertices - np.where(on, (vertices - middle) @ normal, 0.0)[:, None] * normal
    image = vertices - 2 * ((vertices - middle) @ normal)[:, None] * normal
    partner = np.where(on, np.arange(len(vertices)), len(vertices) + np.cumsum(~on) - 1)
    both = np.concatenate([faces, partner[faces][:, ::-1]])
    made = js.ControlMesh(np.concatenate([vertices, image[~on]]), both)
    made.check()
    return made


def find_mirror_plane(mesh: js.ControlMesh) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """A point of the plane, in mm, and its unit normal: the mirror that comes nearest to leaving the mesh as it is."""
    image, _ = mirror_image(mesh)
    on = sample_faces(mesh, _SAMPLES).points
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the image would fit better mirrored is what is looked for
        motion = align(image, Scan(on), kind="rigid").transform
    linear, shift = motion[:3, :3], motion[:3, 3]
    # The image's x is 2 c - x: the mirror is this, then the motion.
    flip, about = np.diag([-1.0, 1.0, 1.0]), 2 * np.asarray(mesh.vertices).mean(axis=0) * (1, 0, 0)
    whole, moved = linear @ flip, linear @ about + shift
    values, axes = np.linalg.eigh((whole + whole.T) / 2)
    normal = axes[:, int(np.argmin(values))]
    middle = np.asarray(mesh.vertices).mean(axis=0)
    return 0.5 * (middle + whole @ middle + moved), normal


def _cut(
    vertices: Float[np.ndarray, "v 3"], away: Float[np.ndarray, "v"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Float[np.ndarray, "w"], Int[np.ndarray, "g 3"]]:
    """The triangles, cut where edges cross the plane: each into one and two, or into two."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    ends, of_sides = np.unique(ends, axis=0, return_inverse=True)
    a, b = away[ends].T
    crosses = a * b < 0
    new = np.where(crosses, len(vertices) + np.cumsum(crosses) - 1, -1)
    part = (a / np.where(crosses, a - b, 1.0))[crosses, None]
    at = vertices[ends[crosses, 0]] * (1 - part) + vertices[ends[crosses, 1]] * part
    sides = new[of_sides.reshape(3, -1).T]  # the new vertex between each corner and the next, or -1
    whole = (sides < 0).all(axis=1)
    found = [faces[whole]]
    for turn in range(3):
        (i, j, k), (ij, jk, ki) = np.roll(faces, -turn, axis=1).T, np.roll(sides, -turn, axis=1).T
        two = (ij >= 0) & (ki >= 0)  # corner i is alone on its side
        for rows in ((i, ij, ki), (ij, j, k), (ij, k, ki)):
            found.append(np.stack(rows, axis=1)[two])
        one = (jk >= 0) & (ij < 0) & (ki < 0)  # corner i lies on the plane
        for rows in ((i, j, jk), (i, jk, k)):
            found.append(np.stack(rows, axis=1)[one])
    return np.concatenate([vertices, at]), np.append(away, np.zeros(len(at))), np.concatenate(found)
