"""The picture of a fit: control mesh, surface with its error, convergence. matplotlib, so that no display is needed."""

import io
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

import jaxsubdiv as js
from jaxsubdiv.console import make_printable
from jaxsubdiv.extras import import_extra

from ..image.slices import Slice
from .result import FitResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = "RdBu_r"  # red where the scan lies outside of the surface, blue inside, white where they meet


def draw_fit(result: FitResult, start: js.ControlMesh, *, title: str = "", slices: Sequence[Slice] = ()) -> "Figure":
    """A figure of a fit: control mesh before and after, the surface, its distance from the scan, convergence.

    Args:
        result: the fit.
        start: the control mesh where the fit started.
        title: above the picture.
        slices: of the image that the scan was seen in, see `cut_slices`: drawn with the surface's contour.

    Returns:
        A matplotlib figure: `.savefig("fit.png")`, or the last line of a notebook's cell.

    Raises:
        ImportError: matplotlib is missing; it comes with the extra `viz`.
    """
    figure = make_figure(15.0, 14.25 if slices else 9.5)
    figure.suptitle(make_printable(title), fontsize=14, parse_math=False)  # a `$` in a name is no formula
    (before, after, smooth), (error, counts, convergence), *below = figure.subplots(3 if slices else 2, 3)
    view, surface = js.view_of(result.surface), result.surface
    for ax, vertices, name in (
        (before, start.vertices, "control mesh at the start, and the scan"),
        (after, np.asarray(result.control.vertices), "control mesh fitted"),
    ):
        js.draw_surface(ax, js.ControlMesh(vertices, start.faces, check=False), view=view, edges=True)
        ax.set_title(name)
    points = result.points @ view.T
    before.scatter(*points[:, :2].T, s=0.4, c="tab:blue", linewidths=0, zorder=3)
    js.draw_surface(smooth, surface, view=view)
    smooth.set_title(f"its surface, {surface.n_faces:,} faces")
    _draw_error(error, result, view)
    _draw_counts(counts, result)
    _draw_convergence(convergence, result)
    for row in below:
        for ax, one in zip(row, slices, strict=True):
            _draw_slice(ax, one, surface)
    return figure


def draw_slices(result: FitResult, slices: Sequence[Slice]) -> "Figure":
    """A figure of the slices alone, with the contour of the fitted surface.

    Raises:
        ImportError: matplotlib is missing; it comes with the extra `viz`.
    """
    figure = make_figure(15.0, 5.0)
    for ax, one in zip(figure.subplots(1, len(slices)), slices, strict=True):
        _draw_slice(ax, one, result.surface)
    return figure


def encode_png(figure: "Figure") -> bytes:
    """A figure as the bytes of a PNG file."""
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def make_figure(width: float, height: float) -> "Figure":
    import_extra("matplotlib", "viz", "pictures")
    from matplotlib.figure import Figure

    class Picture(Figure):
        """A figure that notebooks show where pyplot, which would tell them how, was never imported."""

        def draw(self, renderer: Any) -> None:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Glyph .* missing from")  # names are in all scripts
                super().draw(renderer)

        def _repr_png_(self) -> bytes:
            return encode_png(self)

    return Picture(figsize=(width, height), layout="constrained", dpi=100)


def _draw_slice(ax: Any, one: Slice, surface: js.RefinedSurface) -> None:
    from matplotlib.collections import LineCollection

    ax.imshow(one.grey, cmap="gray", vmin=0, vmax=1, aspect=one.height, interpolation="nearest")
    lines = one.cut(np.asarray(surface.vertices, np.float64), np.asarray(surface.triangles()))
    ax.add_collection(LineCollection(list(lines), colors="tab:orange", linewidths=1.2))
    ax.set_axis_off()
    for letter, x, y in zip(one.sides or (), (0.02, 0.98, 0.5, 0.5), (0.5, 0.5, 0.97, 0.03), strict=False):
        ax.text(x, y, letter, transform=ax.transAxes, color="tab:cyan", ha="center", va="center", fontweight="bold")


def _draw_error(ax: Any, result: FitResult, view: Float[np.ndarray, "3 3"]) -> None:
    limit = _limit(result, 98.0)
    distances = result.refine_to().distances
    colours = js.draw_surface(ax, result.surface, view=view, values=distances, limits=(-limit, limit), cmap=_COLOURS)
    ax.set_title("distance of the scan from it")
    below = ax.inset_axes((0.1, -0.08, 0.8, 0.03))
    bar = ax.figure.colorbar(colours, cax=below, orientation="horizontal")
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
