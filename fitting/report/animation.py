"""A series in motion: a picture that turns while its surface beats."""

import io
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

import jaxsubdiv as js
from jaxsubdiv.extras import import_extra

from .picture import make_figure
from .series import SeriesFit

if TYPE_CHECKING:
    from PIL.Image import Image

_PICTURES = 24  # at least, for one turn
_MILLISECONDS = 80  # of each
_COLOURS = 96  # of a palette


def animate_series(series: SeriesFit, *, pixels: int = 300) -> bytes:
    """An animated GIF of a series: one turn of the surface, and beside it of its cavities, coloured by displacement.

    Args:
        series: the fit.
        pixels: of the height.

    Returns:
        The bytes of the file.

    Raises:
        ImportError: matplotlib is missing; it comes with the extra `viz`.
    """
    import_extra("matplotlib", "viz", "pictures")
    from PIL import Image

    surfaces = [series.surface(k) for k in range(len(series))]
    first = np.asarray(surfaces[0].vertices, np.float64)
    away = [np.linalg.norm(np.asarray(surface.vertices) - first, axis=1) for surface in surfaces]
    limit = max(float(np.percentile(np.concatenate(away), 99)), 1e-6)
    middle = (first.min(axis=0) + first.max(axis=0)) / 2
    radius = 1.05 * max(float(np.linalg.norm(np.asarray(one.vertices) - middle, axis=1).max()) for one in surfaces)
    upright = js.view_of(surfaces[0])
    n = len(surfaces) * -(-_PICTURES // len(surfaces))
    pictures = []
    for i in range(n):
        frame = i % len(surfaces)
        view = Rotation.from_euler("y", 360 * i / n, degrees=True).as_matrix() @ upright
        x, y = (view @ middle)[:2]
        shown = (x - radius, x + radius, y - radius, y + radius)
        views = [surfaces[frame], *_cavities(series, surfaces[frame])]
        pictures.append(_draw(views, view, away[frame], limit, shown, pixels, series.names[frame]))
    most = int(np.argmax([np.mean(one) for one in away]))  # the picture of the most colours
    palette = pictures[most].quantize(_COLOURS)
    pictures = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    file = io.BytesIO()
    pictures[0].save(
        file, "GIF", save_all=True, append_images=pictures[1:], duration=_MILLISECONDS, loop=0, optimize=False
    )
    return file.getvalue()


def _cavities(series: SeriesFit, surface: js.RefinedSurface) -> list[js.RefinedSurface]:
    """The linings of all cavities as seen from the wall, in one surface; none where there are no cavities."""
    parts = [series.measures.parts[i].faces for i in series.measures.cavities]
    if not parts:
        return []
    chosen, t = np.any(parts, axis=0), len(surface.faces[3])
    three, four = (np.asarray(surface.faces[k])[:, ::-1] for k in (3, 4))
    faces = {3: jnp.asarray(three[chosen[:t]]), 4: jnp.asarray(four[chosen[t:]])}
    return [js.RefinedSurface(surface.vertices, -surface.normals, faces)]


def _draw(
    surfaces: list[js.RefinedSurface],
    view: Float[np.ndarray, "3 3"],
    values: Float[np.ndarray, "v"],
    limit: float,
    shown: tuple[float, float, float, float],
    pixels: int,
    name: str,
) -> "Image":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    inches = pixels / 100
    figure = make_figure(inches * (len(surfaces) + 0.25), inches)
    axes = np.atleast_1d(figure.subplots(1, len(surfaces)))
    bar: Any = None
    for ax, surface in zip(axes, surfaces, strict=True):
        bar = js.draw_surface(ax, surface, view=view, values=values, limits=(0.0, limit), frame=shown, pixels=pixels)
    figure.colorbar(bar, ax=list(axes), label=f"mm from the first frame; {name}", shrink=0.8)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
