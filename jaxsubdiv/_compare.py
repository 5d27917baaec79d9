"""Every scheme on one control mesh against the surface that it stands for: `python -m jaxsubdiv compare`."""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ._distance import closest_on_mesh
from ._draw import draw_surface, view_of
from ._io import read_mesh
from ._mesh import ControlMesh
from ._refine import refine
from ._scheme import SCHEMES
from ._stencils import interpolating_control
from ._surface import RefinedSurface, sample
from ._topology import MAX_LEVELS, build_topology
from .files import replace_file

N_SAMPLES = 20_000


class Row(NamedTuple):
    """How one scheme does."""

    name: str
    triangles: int
    """Faces of the refined surface, a quad counted as two."""
    rms: float
    """Distance of points on the surface, drawn by area, from the true one; in the unit of the mesh."""
    largest: float
    normals: float
    """Root mean square angle between the surface's normal and the truth's there, in degrees."""
    seconds: float
    """Of one refinement, compiled before."""
    surface: RefinedSurface


def compare(mesh: ControlMesh, truth: ControlMesh, levels: int) -> tuple[list[Row], list[str]]:
    """Refine `mesh` by every scheme that takes its faces, and measure how far each is from `truth`.

    A scheme of triangles gets the quads cut, at the same level and so with as many triangles; Doo-Sabin and, on
    triangles, Catmull-Clark come closest to that at the same level. Approximating schemes are shown twice: raw, and
    with control vertices solved for so that their limit goes through the vertices of `mesh`.

    Returns:
        A row a scheme, and a sentence for each that was left out.
    """
    corners = truth.vertices[truth.triangulate().faces[3]]
    true_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    true_normals /= np.linalg.norm(true_normals, axis=1, keepdims=True)
    rows, left_out = [], []
    for name, kind in SCHEMES.items():
        scheme = kind()  # pyright: ignore[reportCallIssue]
        if 3 not in scheme.takes and len(mesh.faces[3]):
            left_out.append(f"{name} takes quads only")
            continue
        suited = mesh.triangulate() if 4 not in scheme.takes else mesh
        topology = build_topology(suited, scheme, levels)
        rows.append(_measure(name, scheme, topology, suited.control(), corners, true_normals))
        if scheme.interpolates:
            continue
        try:
            masks = build_topology(suited, scheme, 0, limit=True)
            control = interpolating_control(scheme, masks, suited.vertices)
        except ValueError as error:
            left_out.append(f"{name}, solved: {str(error).split('.')[0]}")
            continue
        rows.append(_measure(f"{name}, solved", scheme, topology, control, corners, true_normals))
    return rows, left_out


def _measure(name, scheme, topology, control, corners, true_normals: Float[np.ndarray, "t 3"]) -> Row:
    surface = jax.block_until_ready(refine(scheme, topology, control))
    start = time.perf_counter()
    jax.block_until_ready(refine(scheme, topology, control))
    seconds = time.perf_counter() - start
    drawn = sample(surface, N_SAMPLES, jax.random.key(0))
    points, normals = (np.asarray(rows, np.float64) for rows in drawn)
    distance, nearest = closest_on_mesh(points, corners)
    cosine = np.clip(np.einsum("px,px->p", normals, true_normals[nearest]), -1, 1)
    return Row(
        name,
        len(surface.faces[3]) + 2 * len(surface.faces[4]),
        float(np.sqrt(np.mean(distance**2))),
        float(distance.max()),
        float(np.degrees(np.sqrt(np.mean(np.arccos(cosine) ** 2)))),
        seconds,
        surface,
    )


def table(rows: Sequence[Row]) -> str:
    """The rows as text."""
    lines = [f"{'scheme':<22}{'triangles':>11}{'RMS':>11}{'max':>11}{'normals':>10}{'time':>11}"]
    for row in rows:
        lines.append(
            f"{row.name:<22}{row.triangles:>11,}{row.rms:>11.4g}{row.largest:>11.4g}{row.normals:>8.2f} °"
            f"{1000 * row.seconds:>8.1f} ms"
        )
    return "\n".join(lines)


def draw(path: Path, rows: Sequence[Row], truth: ControlMesh) -> None:
    """All surfaces side by side, the true one first, seen from where it is broadest."""
    from matplotlib.figure import Figure

    view = view_of(truth)
    (left, bottom, _), (right, top, _) = np.quantile(truth.vertices @ view.T, (0, 1), axis=0)
    shown = [("the true surface", truth), *((row.name, row.surface) for row in rows)]
    columns = min(4, len(shown))
    figure = Figure(figsize=(3 * columns, 3.4 * -(-len(shown) // columns)), layout="constrained")
    axes = figure.subplots(-(-len(shown) // columns), columns, squeeze=False).ravel()
    for ax, (title, surface) in zip(axes, shown, strict=False):
        draw_surface(ax, surface, view=view, frame=(left, right, bottom, top))
        ax.set_title(title)
    for ax in axes[len(shown) :]:
        ax.axis("off")
    with replace_file(path) as unfinished:
        figure.savefig(unfinished, dpi=120, format=path.suffix.lstrip(".") or "png")


def run(options: argparse.Namespace) -> int:
    """The subcommand, its arguments parsed."""
    mesh, truth = read_mesh(options.input, scale=options.scale), read_mesh(options.truth, scale=options.scale)
    if options.picture is not None:
        import matplotlib  # noqa: F401  # before the work, so that a missing one is told at once
    rows, left_out = compare(mesh, truth, options.levels)
    print(table(rows))
    for sentence in left_out:
        print(f"left out: {sentence}")
    if options.picture is not None:
        draw(Path(options.picture), rows, truth)
        print(f"wrote {options.picture}")
    return 0


def parser() -> argparse.ArgumentParser:
    """Arguments of the subcommand."""
    parser = argparse.ArgumentParser(
        prog="jaxsubdiv compare",
        description="Refine a control mesh by every scheme that takes its faces, at equal face counts, and measure how "
        "far each surface is from the true one: distances in the unit of the mesh, of points drawn by area.",
        epilog="Approximating schemes are shown raw and, as 'solved', with control vertices whose limit goes through "
        "the vertices of the mesh. Exit status: 0 done, 2 the input or the arguments cannot be used.",
    )
    add = parser.add_argument
    add("input", metavar="MESH", help="control mesh")
    add("--truth", required=True, metavar="SURFACE", help="the surface that it stands for, as a fine mesh")
    add("--levels", type=int, default=3, metavar="N", help=f"how many levels, 0 to {MAX_LEVELS} (default: 3)")
    add("--scale", type=float, default=1.0, help="multiplies the coordinates of both (default: 1)")
    add("--picture", metavar="FILE", help="all surfaces side by side, .png or .svg; needs the extra `viz`")
    return parser
