"""The page of a fit: one HTML file to look at it from all sides, in any browser, without a network."""

import base64
import html
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import DTypeLike

import jaxsubdiv as js
from jaxsubdiv.console import make_printable
from jaxsubdiv.files import replace_file

from ..image.slices import Slice
from .coverage import distances_to_scan
from .picture import draw_slices, encode_png
from .report import Report
from .result import FitResult

_MOST_POINTS = 20_000  # of the scan that the page shows: they are for the eye, and 16 bytes each
_WIDTH, _HEIGHT = 520, 240  # of the charts
_LEFT, _RIGHT, _BOTTOM, _TOP = 52, 24, 40, 8  # room for their axes


def write_page(
    path: str | os.PathLike[str],
    result: FitResult,
    *,
    title: str = "",
    start: js.ControlMesh | None = None,
    uncertainty: bool = True,
    slices: Sequence[Slice] = (),
) -> None:
    """Write a fit as one HTML file that needs nothing else: it opens from a disk or a mail, without a network.

    It shows the surface, coloured by its signed distance to the scan or by its standard deviation, with the scan's
    points; the control mesh; a histogram of the distances; convergence; and the report, whose worst places turn the
    view to them. About 70 bytes a vertex of the surface and 20 a scan point, of which it shows 20,000 at most.

    Args:
        path: the file, complete or not there.
        result: the fit.
        title: above the page; default: "Fit".
        start: the control mesh where the fit started; default: what the result remembers.
        uncertainty: with the standard deviation, which takes a second or more.
        slices: of the image that the scan was seen in, see `cut_slices`: shown with the surface's contour, where
            matplotlib of the extra `viz` is installed.
    """
    report = result.report(uncertainty=uncertainty)
    first = result.start if start is None else start
    here, title = Path(__file__).parent, html.escape(make_printable(title) or "Fit")
    parts = {
        "TITLE": title,
        "STATE_CLASS": "" if report.trusted else ' class="bad"',
        "STATE": html.escape(dict(report.as_rows())["fit"]),
        "WARNINGS": "\n".join(f'<p class="bad">{html.escape(finding.text)}</p>' for finding in report.warnings),
        "CHOICES": _choices(uncertainty),
        "SHOWN_POINTS": f" (an even part of {_MOST_POINTS:,})" if report.n_points > _MOST_POINTS else "",
        "START": "" if first is None else '<label><input type="checkbox" id="start"> where the fit started</label>',
        "HISTOGRAM": _histogram(result),
        "CONVERGENCE": _convergence(result),
        "SLICES": _slices(result, slices),
        "ROWS": _rows(report),
        "DATA": json.dumps(_data(result, report, first, uncertainty), allow_nan=False).replace("<", "\\u003c"),
        "SCRIPT": (here / "page.js").read_text(encoding="utf-8"),
    }
    pieces = (here / "page.html").read_text(encoding="utf-8").split("@@")
    pieces[1::2] = [parts[name] for name in pieces[1::2]]  # in one pass: a title may hold what looks like a name
    with replace_file(path) as unfinished:
        unfinished.write_text("".join(pieces), encoding="utf-8")


def _data(
    result: FitResult, report: Report, start: js.ControlMesh | js.Control | None, uncertainty: bool
) -> dict[str, object]:
    """Numbers of the views. Arrays are base64 of little-endian float32 and uint32."""
    surface, mesh = result.surface, result.control_mesh
    vertices = np.asarray(surface.vertices, np.float64)
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    distances = distances_to_scan(surface, result.fit.look, result.inliers)
    normals = np.asarray(surface.normals, np.float64)
    some = np.linspace(0, result.scan.n_points - 1, min(result.scan.n_points, _MOST_POINTS)).astype(int)
    deviation = result.uncertainty().surface if uncertainty else None
    return {
        "centre": centre.tolist(),
        "radius": max(radius, 1e-9),
        "view": js.view_of(surface).ravel().tolist(),
        "surface": {
            "vertices": _encode_floats(vertices),
            "triangles": _encode_indices(np.asarray(surface.triangles())),
        },
        "distance": {"values": _encode_floats(distances), "limit": _limit(np.abs(result.distances))},
        "deviation": None if deviation is None else {"values": _encode_floats(deviation), "limit": _limit(deviation)},
        "points": {
            "vertices": _encode_floats(result.points[some]),
            "values": _encode_floats(result.distances[some]),
        },
        "control": {
            "vertices": _encode_floats(mesh.vertices),
            "triangles": _encode_indices(_triangulate(mesh)),
            "edges": _encode_indices(mesh.half_edges.edges),
        },
        "start": None if start is None else _encode_floats(np.asarray(start.vertices)),
        "places": [
            {
                "position": place.position,
                "normal": normals[np.argmin(np.sum((vertices - place.position) ** 2, axis=1))].tolist(),
            }
            for place in report.worst
        ],
    }


def _choices(uncertainty: bool) -> str:
    names = {"distance": "signed distance, outside is red"} | (
        {"deviation": "standard deviation"} if uncertainty else {}
    )
    return "\n".join(
        f'<label><input type="radio" name="colour" value="{value}"{" checked" * (value == "distance")}> {name}</label>'
        for value, name in names.items()
    )


def _slices(result: FitResult, slices: Sequence[Slice]) -> str:
    if not slices:
        return ""
    try:
        picture = base64.b64encode(encode_png(draw_slices(result, slices))).decode("ascii")
    except ImportError:  # the page itself needs nothing
        return ""
    name = "the fitted surface's contour over three slices of the image"
    return f'<h2>Slices</h2>\n<img src="data:image/png;base64,{picture}" alt="{name}" style="width: 100%">'


def _rows(report: Report) -> str:
    places = {f"worst place {i + 1}": i for i in range(len(report.worst))}
    lines = []
    for name, value in report.as_rows():
        name, place, value = html.escape(name), places.get(name), html.escape(value)
        if place is not None:
            value = f'<button type="button" data-place="{place}" title="turn the view to it">{value}</button>'
        lines.append(f'<tr><th scope="row">{name}</th><td>{value}</td></tr>')
    return "\n".join(lines)


def _limit(values: Float[np.ndarray, "n"]) -> float:
    """End of a colour bar: what all but a few in a hundred stay below."""
    return max(float(np.percentile(values, 98)), 1e-6)


def _triangulate(mesh: js.ControlMesh) -> np.ndarray:
    quads = mesh.faces[4]
    return np.concatenate([mesh.faces[3], quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _encode_floats(values: np.ndarray) -> str:
    return _encode_base64(values, "<f4")


def _encode_indices(values: np.ndarray) -> str:
    return _encode_base64(values, "<u4")


def _encode_base64(values: np.ndarray, dtype: DTypeLike) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode("ascii")


# Charts


def _histogram(result: FitResult) -> str:
    limit = max(float(np.percentile(np.abs(result.distances), 99)), 1e-6)
    counts, _ = np.histogram(np.clip(result.distances, -limit, limit), bins=60, range=(-limit, limit))
    width, most = (_WIDTH - _LEFT - _RIGHT) / len(counts), int(counts.max())
    height = _HEIGHT - _BOTTOM - _TOP
    bars = [
        f'<rect x="{_LEFT + i * width:.1f}" y="{_HEIGHT - _BOTTOM - count / most * height:.1f}" '
        f'width="{width - 1:.1f}" height="{count / most * height:.1f}" fill="#6b93bd"/>'
        for i, count in enumerate(counts)
    ]
    ticks = [
        (_LEFT + (_WIDTH - _LEFT - _RIGHT) * (i / 4), f"{limit * (i / 2 - 1):+.2g}" if i != 2 else "0")
        for i in range(5)
    ]
    return _chart(
        bars, ticks, [(0.0, "0"), (1.0, f"{most:,}")], "mm, outside is positive; the ends hold what is beyond"
    )


def _convergence(result: FitResult) -> str:
    """On a logarithmic scale, as far as the values differ."""
    values = np.log10(np.maximum(result.rms, 1e-12))
    low, high = float(values.min()), float(values.max())
    low, high = (low - 0.05, high + 0.05) if high - low < 0.1 else (low, high)
    x = _LEFT + 8 + (_WIDTH - _LEFT - _RIGHT - 8) * np.arange(len(values)) / max(len(values) - 1, 1)
    y = _HEIGHT - _BOTTOM - (_HEIGHT - _BOTTOM - _TOP) * (values - low) / (high - low)
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    marks = [f'<polyline points="{line}" fill="none" stroke="#6b93bd" stroke-width="2"/>']
    marks += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="#37618e"/>' for a, b in zip(x, y, strict=True)]
    step = max(-(-len(values) // 8), 1)
    ticks = [(float(x[i]), str(i)) for i in range(0, len(values), step)]
    levels = [(t, f"{10 ** (low + t * (high - low)):.3g}") for t in (0.0, 0.5, 1.0)]
    return _chart(marks, ticks, levels, "sweep; RMS distance in mm upwards")


def _chart(marks: list[str], ticks: list[tuple[float, str]], levels: list[tuple[float, str]], name: str) -> str:
    """Marks with an axis below, ticks by their x, and one on the left, ticks by their part of the height."""
    base = _HEIGHT - _BOTTOM
    lines = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{html.escape(name)}">']
    for part, word in levels:
        y = base - part * (base - _TOP)
        lines.append(f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#e4e4e4"/>')
        lines.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{word}</text>')
    lines += marks
    lines += [f'<text x="{x:.1f}" y="{base + 16}" text-anchor="middle">{word}</text>' for x, word in ticks]
    lines.append(
        f'<text x="{(_LEFT + _WIDTH) / 2:.1f}" y="{_HEIGHT - 6}" text-anchor="middle">{html.escape(name)}</text>'
    )
    return "\n".join([*lines, "</svg>"])
