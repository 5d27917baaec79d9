"""The picture of a fit: control mesh, surface with its error, convergence. matplotlib, so that no display is needed."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

import jaxsubdiv as js

from ._correspondence import nearest_rows
from ._result import FitResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = "RdBu_r"  # red where the scan lies outside of the surface, blue inside, white where they meet
_CLAY = np.array([0.82, 0.80, 0.77])
_FROM_LIGHT = np.array([-0.35, 0.45, 0.82])  # over the viewer's left shoulder
_NEAREST = 8


def draw_fit(result: FitResult, start: js.ControlMesh, *, title: str = "") -> "Figure":
    """A figure of a fit: control mesh before and after, the surface, its distance from the scan, convergence.

    Args:
        result: the fit.
        start: the control mesh where the fit started.
        title: above the picture.

    Returns:
        A matplotlib figure: `.savefig("fit.png")`, or the last line of a notebook's cell.

    Raises:
        ImportError: matplotlib is missing; it comes with the extra `viz`.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install 'jaxsubdiv[viz]'") from error
    figure = Figure(figsize=(15, 9.5), layout="constrained", dpi=100)
    figure.suptitle(title, fontsize=14)
    (before, after, smooth), (error, counts, convergence) = figure.subplots(2, 3)
    view, surface = view_of(result.surface), result.surface
    for ax, vertices, name in (
        (before, start.vertices, "control mesh at the start, and the scan"),
        (after, np.asarray(result.control.vertices), "control mesh fitted"),
    ):
        _draw(ax, vertices, start.faces, view, edges=True)
        ax.set_title(name)
    points = np.asarray(result.scan.points) @ view.T
    before.scatter(*points[:, :2].T, s=0.4, c="tab:blue", linewidths=0, zorder=3)
    _draw(smooth, np.asarray(surface.vertices), surface.faces, view, normals=np.asarray(surface.normals))
    smooth.set_title(f"its surface, {surface.n_faces:,} faces")
    _draw_error(error, result, view)
    _draw_counts(counts, result)
    _draw_convergence(convergence, result)
    return figure


def surface_distances(result: FitResult) -> Float[np.ndarray, "v"]:
    """Signed distance of the scan at every vertex of the surface, in mm: the mean of the nearest points' distances.

    NaN farther from the scan than its points are from one another, many times over: there is nothing to tell there.
    """
    points, vertices = np.asarray(result.scan.points), np.asarray(result.surface.vertices)
    tree = KDTree(points)
    spacing = np.median(nearest_rows(tree, points, min(2, len(points)))[0][:, -1])
    away, nearest = nearest_rows(tree, vertices, min(_NEAREST, len(points)))
    known = away[:, 0] <= 5 * spacing + np.abs(result.distances)[nearest[:, 0]]
    return np.where(known, result.distances[nearest].mean(axis=1), np.nan)


def view_of(surface: js.RefinedSurface) -> Float[np.ndarray, "3 3"]:
    """Rows: right, up and towards the viewer, looking at an open surface's outside, or a closed one's broad side."""
    vertices, normals = np.asarray(surface.vertices), np.asarray(surface.normals)
    towards = np.average(normals, axis=0)
    _, _, axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)
    if np.linalg.norm(towards) < 0.2:  # the normals of a closed surface cancel
        towards = axes[2]
    towards = towards / np.linalg.norm(towards)
    # Scanners' third axis mostly runs along the body.
    up = np.eye(3)[2] if abs(towards[2]) < 0.8 else np.eye(3)[1]
    right = np.cross(up, towards)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _draw(
    ax: Any,
    vertices: Float[np.ndarray, "v 3"],
    faces: Mapping[int, Any],
    view: Float[np.ndarray, "3 3"],
    *,
    colours: Float[np.ndarray, "f 3"] | None = None,
    normals: Float[np.ndarray, "v 3"] | None = None,
    edges: bool = False,
) -> None:
    """Faces from back to front, shaded by the vertex normals, or flat where there are none."""
    from matplotlib.collections import PolyCollection

    seen = vertices @ view.T
    polygons = [np.asarray(faces[size]) for size in (3, 4)]
    corners = [seen[polygon] for polygon in polygons]
    if normals is None:
        towards = np.concatenate([np.cross(c[:, 2] - c[:, 0], c[:, -1] - c[:, 1]) for c in corners])
    else:
        towards = np.concatenate([normals[polygon].mean(axis=1) for polygon in polygons]) @ view.T
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), np.finfo(float).tiny)
    towards *= np.where(towards[:, 2:] < 0, -1, 1)  # the inside of an open surface is lit too
    light = np.clip(towards @ _FROM_LIGHT / np.linalg.norm(_FROM_LIGHT), 0, 1)
    colours = np.tile(_CLAY, (len(light), 1)) if colours is None else colours
    shaded = np.clip(colours * (0.35 + 0.7 * light[:, None]), 0, 1)

    flat = [polygon[:, :2] for c in corners for polygon in c]
    order = np.argsort(np.concatenate([c[..., 2].mean(axis=1) for c in corners]))
    # Lines in the colour of their faces close the hairlines between them.
    lines, width = ((0.25, 0.25, 0.25), 0.5) if edges else (shaded[order], 0.3)
    ax.add_collection(
        PolyCollection([flat[i] for i in order], facecolors=shaded[order], edgecolors=lines, linewidths=width)
    )
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.axis("off")


def _draw_error(ax: Any, result: FitResult, view: Float[np.ndarray, "3 3"]) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    surface, distances = result.surface, surface_distances(result)
    limit = _limit(result, 98.0)
    scale = Normalize(-limit, limit)
    at_faces = np.concatenate([distances[np.asarray(surface.faces[size])].mean(axis=1) for size in (3, 4)])
    known = ~np.isnan(at_faces)[:, None]
    colours = np.where(known, colormaps[_COLOURS](scale(np.nan_to_num(at_faces)))[:, :3], _CLAY)
    _draw(ax, np.asarray(surface.vertices), surface.faces, view, colours=colours, normals=np.asarray(surface.normals))
    ax.set_title("distance of the scan from it")
    below = ax.inset_axes((0.1, -0.08, 0.8, 0.03))
    bar = ax.figure.colorbar(ScalarMappable(scale, _COLOURS), cax=below, orientation="horizontal")
    bar.set_label("mm, outside is positive")


def _limit(result: FitResult, percentile: float) -> float:
    """A distance in mm that so many of the inliers stay within: outliers would bleach everything else."""
    inliers = np.abs(result.distances[result.inliers])
    return max(float(np.percentile(inliers, percentile)), 1e-6) if len(inliers) else 1.0


def _draw_counts(ax: Any, result: FitResult) -> None:
    limit = 1.2 * _limit(result, 100.0)
    ax.hist(np.clip(result.distances, -limit, limit), bins=80, color="tab:blue")
    ax.set_xlabel("signed distance, mm (the ends hold what is beyond)")
    ax.set_ylabel("scan points")
    ax.set_title(f"RMS {result.rms[-1]:.3f} mm, {np.mean(result.inliers):.0%} within 3 x the noise")
    ax.grid(True, alpha=0.3)


def _draw_convergence(ax: Any, result: FitResult) -> None:
    ax.semilogy(result.robust_rms, marker="o", markersize=3, color="tab:blue")
    ax.set_xlabel("sweep")
    ax.set_ylabel("RMS distance by robust weights, mm")
    ax.set_title("convergence")
    ax.grid(True, which="both", alpha=0.3)
