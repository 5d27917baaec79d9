"""Pictures of surfaces in matplotlib axes, rendered by numpy alone: no display is needed, and no GPU."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._mesh import ControlMesh
from ._surface import RefinedSurface
from .extras import import_extra

Numbers: TypeAlias = Sequence[Any] | np.ndarray

CLAY = (0.86, 0.83, 0.78)
_INSIDE = np.array([0.72, 0.78, 0.88])  # what faces seen from their back are multiplied by: darker, and cooler
_LINES = 0.25  # what edges are multiplied by
_KEY = np.array([-0.35, 0.45, 0.82]) / np.linalg.norm([-0.35, 0.45, 0.82])  # over the viewer's left shoulder
_FILL = np.array([0.75, -0.25, 0.6]) / np.linalg.norm([0.75, -0.25, 0.6])
_SHINE = (_KEY + (0, 0, 1)) / np.linalg.norm(_KEY + (0, 0, 1))  # where a normal throws the key light to the viewer
_N_STRIPES = 9  # rings of light, from straight below to straight above
_FINER = 2  # samples a pixel, along either side


def view_of(surface: RefinedSurface | ControlMesh, towards: Numbers | None = None) -> Float[np.ndarray, "3 3"]:
    """Rows: right, up and towards the viewer. `points @ view.T` are places in the picture, and depths.

    Args:
        surface: what is looked at: an open surface's outside, or a closed one's broad side.
        towards: another direction to the viewer, `[3]`.
    """
    if towards is None:
        vertices, normals, faces = _arrays(surface)
        if normals is None:
            a, b, c = np.moveaxis(vertices[_triangles(faces)[0]], 1, 0)
            normals = _unit(np.cross(b - a, c - a))
        direction = np.average(normals, axis=0)
        if np.linalg.norm(direction) < 0.2:  # the normals of a closed surface cancel
            spread = vertices - vertices.mean(axis=0)
            direction = np.linalg.svd(spread[:: max(1, len(spread) // 20_000)], full_matrices=False)[2][2]
    else:
        direction = np.asarray(towards, float)
    direction = direction / np.linalg.norm(direction)
    # Scanners' third axis mostly runs along the body.
    up = np.eye(3)[2] if abs(direction[2]) < 0.8 else np.eye(3)[1]
    right = _unit(np.cross(up, direction))
    return np.stack([right, np.cross(direction, right), direction])


def draw_surface(
    ax: Any,
    surface: RefinedSurface | ControlMesh,
    *,
    view: Numbers | None = None,
    colour: Any = CLAY,
    values: Array | Numbers | None = None,
    limits: Numbers | None = None,
    cmap: Any = "viridis",
    edges: bool = False,
    stripes: bool = False,
    frame: Numbers | None = None,
    pixels: int = 400,
) -> Any:
    """Draw a surface as it is seen from afar, into axes that then have the unit of the surface.

    A refined surface is shaded by its normals, a control mesh face by face. The inside of a surface is bluish.

    Args:
        ax: matplotlib axes. More may be drawn over the surface, at the first two of `points @ view.T`.
        surface: what to draw.
        view: rows right, up and towards the viewer, `[3, 3]`; or the direction to the viewer, `[3]`. Default:
            `view_of(surface)`.
        colour: of the surface, anything that matplotlib takes for one.
        values: a number a vertex, shown in colours; places without one (NaN) keep `colour`.
        limits: least and greatest value of the colours. Default: those of `values`.
        cmap: colour map of the values.
        edges: draw the edges of the faces, as far as they are seen.
        stripes: draw reflection lines: rings of light around the surface, one above the other, as it would mirror them.
            A kink in a line is a jump of the curvature, a gap one of the normals.
        frame: left, right, bottom and top of the part to draw, in the unit of the surface. Default: all of it.
        pixels: of the longer side.

    Returns:
        What `figure.colorbar` takes to explain the values; None without `values`.

    Raises:
        ImportError: matplotlib is missing; it comes with the extra `viz`.
    """
    import_extra("matplotlib.cm", "viz", "pictures")
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize, to_rgb

    vertices, normals, faces = _arrays(surface)
    given = None if view is None else np.asarray(view, float)
    rows = given if given is not None and given.ndim == 2 else view_of(surface, given)
    triangles, is_edge = _triangles(faces)
    corners = (vertices @ rows.T)[triangles]
    if frame is None:
        (left, bottom), (right, top) = corners[..., :2].min(axis=(0, 1)), corners[..., :2].max(axis=(0, 1))
        margin = 0.02 * max(right - left, top - bottom)
        frame = (left - margin, right + margin, bottom - margin, top + margin)
    seen = _rasterise(corners, frame, _FINER * pixels)

    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_back = flat[seen.triangle, 2] < 0
    if normals is None:
        normal = _unit(_face_normals(vertices, faces) @ rows.T)[seen.triangle]
    else:
        normal = _unit(np.einsum("pk,pkx->px", seen.weights, (normals @ rows.T)[triangles[seen.triangle]]))
    normal = np.where(is_back[:, None], -normal, normal)
    colours = np.tile(np.array(to_rgb(colour)), (len(normal), 1))
    mappable = None
    if values is not None:
        numbers = np.asarray(values, float)
        low, high = (np.nanmin(numbers), np.nanmax(numbers)) if limits is None else limits
        mappable = ScalarMappable(Normalize(low, high), cmap)
        here = np.einsum("pk,pk->p", seen.weights, numbers[triangles[seen.triangle]])
        known = ~np.isnan(here)[:, None]
        scaled = np.asarray(colormaps.get_cmap(cmap)(mappable.norm(np.nan_to_num(here))))[:, :3]
        colours = np.where(known, scaled, colours)
    colours = colours * np.where(is_back[:, None], _INSIDE, 1)
    if stripes:
        mirrored = 2 * normal[:, 2:] * normal - (0, 0, 1)
        angle = np.arcsin(np.clip(mirrored[:, 1], -1, 1))
        colours = colours * np.where(np.sin(2 * _N_STRIPES * angle) > 0, 1.1, 0.25)[:, None]
    colours = _light(colours, normal, 0.5 if values is not None or stripes else 1.0)
    if edges:
        colours = colours * (1 - (1 - _LINES) * _edge_cover(corners, is_edge, seen))[:, None]

    image = np.zeros((seen.height * seen.width, 4))
    image[seen.pixel, :3], image[seen.pixel, 3] = np.clip(colours, 0, 1), 1
    image = image.reshape(seen.height, seen.width, 4)
    image = np.stack([image[i::_FINER, j::_FINER] for i in range(_FINER) for j in range(_FINER)]).mean(axis=0)
    image[..., :3] /= np.where(image[..., 3:] > 0, image[..., 3:], 1)
    ax.imshow(image, extent=frame, origin="lower", interpolation="antialiased")
    ax.axis("off")
    return mappable


class _Seen(NamedTuple):
    """What every sample of a picture shows, where it shows anything."""

    pixel: Int[np.ndarray, "p"]
    triangle: Int[np.ndarray, "p"]
    weights: Float[np.ndarray, "p 3"]
    """Barycentric coordinates in the triangle."""
    width: int
    height: int
    scale: float
    """Samples for a unit of length."""


def _rasterise(corners: Float[np.ndarray, "t 3 3"], frame: Numbers, samples: int) -> _Seen:
    """The nearest triangle at every sample: each triangle's rows of samples, then the samples from side to side."""
    left, right, bottom, top = frame
    scale = samples / max(right - left, top - bottom)
    # Whole pixels; the picture is stretched by less than one.
    width, height = (_FINER * max(1, round(scale * side / _FINER)) for side in (right - left, top - bottom))
    flat = (corners[..., :2] - (left, bottom)) * (width / (right - left), height / (top - bottom)) - 0.5
    # Barycentric coordinates as p x + q y + r, a row for every corner.
    x, y = np.moveaxis(flat, (2, 1), (0, 1))
    p, q = np.roll(y, -1, axis=0) - np.roll(y, -2, axis=0), np.roll(x, -2, axis=0) - np.roll(x, -1, axis=0)
    doubled = p[0] * x[0] + q[0] * y[0] - (p[0] * x[1] + q[0] * y[1])
    p, q = p / np.where(doubled == 0, np.nan, doubled), q / np.where(doubled == 0, np.nan, doubled)
    r = -(p * np.roll(x, -1, axis=0) + q * np.roll(y, -1, axis=0))

    first = np.maximum(np.ceil(y.min(axis=0)), 0).astype(int)
    last = np.minimum(np.floor(y.max(axis=0)), height - 1).astype(int)
    of_row, y = _list_between(first, np.where(doubled == 0, first - 1, last))
    p_row, rest = p[:, of_row], q[:, of_row] * y + r[:, of_row]
    crossing = -rest / np.where(p_row == 0, np.nan, p_row)
    start = np.where(p_row > 0, crossing, -np.inf).max(axis=0)
    stop = np.where(p_row < 0, crossing, np.inf).min(axis=0)
    # Rounding must not open gaps between neighbours.
    start = np.ceil(np.clip(start - 1e-9, 0, width)).astype(int)
    stop = np.floor(np.clip(stop + 1e-9, -1, width - 1)).astype(int)
    row, x = _list_between(start, stop)
    triangle, y = of_row[row], y[row]

    by_x, by_y, at_0 = ((part * corners[..., 2].T).sum(axis=0) for part in (p, q, r))  # depths are as linear
    depth = by_x[triangle] * x + by_y[triangle] * y + at_0[triangle]
    pixel = y * width + x
    nearest = np.full(width * height, -np.inf)
    np.maximum.at(nearest, pixel, depth)
    shown = np.flatnonzero(depth == nearest[pixel])
    triangle, x, y = triangle[shown], x[shown], y[shown]
    weights = (p[:, triangle] * x + q[:, triangle] * y + r[:, triangle]).T
    return _Seen(pixel[shown], triangle, weights, width, height, scale)


def _list_between(first: Int[np.ndarray, "n"], last: Int[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
    """All whole numbers from `first` to `last` of every row, and the row of each."""
    counts = np.maximum(last - first + 1, 0)
    row = np.repeat(np.arange(len(counts)), counts)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts) + first[row]


def _light(
    colours: Float[np.ndarray, "p 3"], normal: Float[np.ndarray, "p 3"], strength: float
) -> Float[np.ndarray, "p 3"]:
    """Two lights and a soft shine; with less strength colours stay what they are."""
    key, fill, shine = np.clip(np.einsum("px,lx->lp", normal, (_KEY, _FILL, _SHINE)), 0, 1)
    light = 1 + strength * (0.36 + 0.62 * key + 0.14 * fill - 1)
    for _ in range(5):
        shine = shine * shine
    return colours * light[:, None] + (0.1 * strength * shine)[:, None]


def _edge_cover(
    corners: Float[np.ndarray, "t 3 3"], is_edge: Bool[np.ndarray, "t 3"], seen: _Seen
) -> Float[np.ndarray, "p"]:
    """How much of a sample lies under a line a pixel wide along the edges."""
    flat = corners[..., :2]
    opposite = np.linalg.norm(np.roll(flat, -1, axis=1) - np.roll(flat, -2, axis=1), axis=2)
    doubled = np.abs(_cross2(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]))
    heights = seen.scale * doubled[:, None] / np.maximum(opposite, np.finfo(float).tiny)
    away = np.where(is_edge[seen.triangle], seen.weights * heights[seen.triangle], np.inf).min(axis=1)
    return np.clip(0.5 * _FINER + 0.5 - away, 0, 1)


def _triangles(faces: dict[int, np.ndarray]) -> tuple[Int[np.ndarray, "t 3"], Bool[np.ndarray, "t 3"]]:
    """Triangles, then the halves of the quads; and whether the side across from each corner is an edge of the mesh."""
    quads = faces[4]
    halves = np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    of_halves = np.tile([(True, False, True), (True, True, False)], (len(quads), 1))
    return np.concatenate([faces[3], halves]), np.concatenate([np.ones((len(faces[3]), 3), bool), of_halves])


def _face_normals(vertices: Float[np.ndarray, "v 3"], faces: dict[int, np.ndarray]) -> Float[np.ndarray, "t 3"]:
    """Of the face that each triangle is, or is half of; not unit."""
    corners = [vertices[faces[size]] for size in (3, 4)]
    of_faces = [np.cross(c[:, 2] - c[:, 0], c[:, -1] - c[:, 1]) for c in corners]
    return np.concatenate([of_faces[0], np.repeat(of_faces[1], 2, axis=0)])


def _arrays(
    surface: RefinedSurface | ControlMesh,
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"] | None, dict[int, np.ndarray]]:
    """Vertices, normals where they shade smoothly, and faces, on the host."""
    is_refined = isinstance(surface, RefinedSurface)
    normals = np.asarray(surface.normals, float) if is_refined else None
    faces = {size: np.asarray(surface.faces[size]) for size in (3, 4)}
    return np.asarray(surface.vertices, float), normals, faces


def _cross2(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _unit(rows: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), np.finfo(float).tiny)
