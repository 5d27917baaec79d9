"""The page of a series: curves through time, the surface in motion, and the table, in one HTML file."""

import base64
import html
import os

import numpy as np
from jaxtyping import Float

from jaxsubdiv.console import make_printable
from jaxsubdiv.files import replace_file

from .animation import animate_series
from .series import SeriesFit
from .series_table import SeriesTable

_WIDTH, _HEIGHT = 520, 260
_LEFT, _RIGHT, _BOTTOM, _TOP = 56, 16, 40, 12
_HUES = ("#37618e", "#a8512f", "#4c7a4b", "#7a5a94")
_STYLE = """
body { margin: 0 auto; max-width: 1200px; padding: 24px; color: #222; background: #fff;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 22px; font-weight: 600; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 15px; font-weight: 600; margin: 16px 0 6px; }
.bad { color: #a11; }
.two { display: grid; grid-template-columns: repeat(auto-fit, minmax(360px, 1fr)); gap: 24px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: right; font-weight: normal; padding: 3px 12px 3px 0; border-bottom: 1px solid #eee; }
th { color: #555; }
svg { width: 100%; height: auto; }
svg text { font: 12px system-ui, sans-serif; fill: #555; }
img { max-width: 100%; }
"""
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def write_series_page(
    path: str | os.PathLike[str], series: SeriesFit, *, title: str = "", animation: bytes | None = None
) -> None:
    """Write a series as one HTML file that needs nothing else: it opens from a disk or a mail, without a network.

    It shows a curve of every measure with bands of two standard deviations, the surface in motion (where matplotlib of
    the extra `viz` is installed), and the table.

    Args:
        path: the file, complete or not there.
        series: the fit.
        title: above the page; default: "Series".
        animation: of the surface; default: what `animate_series` draws.
    """
    title, table = html.escape(make_printable(title) or "Series"), series.table
    try:
        animation = animate_series(series) if animation is None else animation
        picture = base64.b64encode(animation).decode("ascii")
        shown = f'<img src="data:image/gif;base64,{picture}" alt="the surface, and its cavities, in motion">'
    except ImportError:  # the page itself needs nothing
        shown = ""
    warnings = [f'<p class="bad">{html.escape(finding.text)}</p>' for finding in series.result.warnings]
    text = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>{title}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{title}</h1>
<p>{_sentence(series)}</p>
{"".join(warnings)}
{shown}
<div class="two">
{_charts(table)}
</div>
<h2>Table</h2>
<div class="wide">
{_table(table)}
</div>
</body>
</html>
"""
    with replace_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def _sentence(series: SeriesFit) -> str:
    parts = [f"{len(series)} frames, RMS distance {series.result.rms[-1]:.2f} mm"]
    if len(series.slices):
        farthest = float(np.linalg.norm(series.shifts, axis=1).max())
        parts.append(f"{len(series.slices)} slices shifted, alike in all frames, by {farthest:.1f} mm at most")
    parts += [
        f"ejection fraction of {html.escape(name)} {value:.3f} ± {deviation:.3f}"
        for name, (value, deviation) in series.table.ejection.items()
    ]
    return "; ".join(parts) + ". Bands are of two standard deviations."


def _charts(table: SeriesTable) -> str:
    """One chart for each kind of measure: those whose names begin alike."""
    kinds: dict[str, list[str]] = {}
    for name, unit in table.columns:
        first = next((word for word in ("volume", "area", "wall thickness") if name.startswith(f"{word} ")), name)
        kinds.setdefault(f"{first}, {unit}", []).append(name)
    return "\n".join(
        f"<div><h2>{html.escape(kind)}</h2>{_chart(table, names, kind)}</div>" for kind, names in kinds.items()
    )


def _chart(table: SeriesTable, names: list[str], label: str) -> str:
    curves = [table.column(name) for name in names]
    low = min(float((values - 2 * deviations).min()) for values, deviations in curves)
    high = max(float((values + 2 * deviations).max()) for values, deviations in curves)
    low, high = (low - 0.5, high + 0.5) if high - low < 1e-9 else (low, high)
    base, n = _HEIGHT - _BOTTOM, len(table.names)
    x = _LEFT + (_WIDTH - _LEFT - _RIGHT) * np.arange(n) / max(n - 1, 1)

    def y(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return base - (base - _TOP) * (values - low) / (high - low)

    lines = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{html.escape(label)}">']
    for level in np.linspace(low, high, 4):
        at = y(np.array([level]))[0]
        lines.append(f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{at:.1f}" y2="{at:.1f}" stroke="#e4e4e4"/>')
        lines.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{level:.3g}</text>')
    for i, (name, (values, deviations)) in enumerate(zip(names, curves, strict=True)):
        hue = _HUES[i % len(_HUES)]
        up, down = y(values + 2 * deviations), y(values - 2 * deviations)
        band = _points(np.append(x, x[::-1]), np.append(up, down[::-1]))
        lines.append(f'<polygon points="{band}" fill="{hue}" fill-opacity="0.2"/>')
        lines.append(f'<polyline points="{_points(x, y(values))}" fill="none" stroke="{hue}" stroke-width="2"/>')
        if len(names) > 1:
            at = f'x="{_LEFT + 8}" y="{_TOP + 14 + 15 * i}"'
            lines.append(f'<text {at} style="fill: {hue}">{html.escape(make_printable(name))}</text>')
    for i in range(0, n, max(-(-n // 8), 1)):
        lines.append(f'<text x="{x[i]:.1f}" y="{base + 16}" text-anchor="middle">{i}</text>')
    lines.append(f'<text x="{(_LEFT + _WIDTH) / 2:.1f}" y="{_HEIGHT - 6}" text-anchor="middle">frame</text>')
    return "\n".join([*lines, "</svg>"])


def _points(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def _table(table: SeriesTable) -> str:
    heads = "".join(f"<th>{html.escape(f'{name}, {unit}')}</th>" for name, unit in table.columns)
    rows = [f"<tr><th>frame</th>{heads}</tr>"]
    for name, values, deviations in zip(table.names, table.values, table.deviations, strict=True):
        cells = (f"<td>{value:.4g} ± {deviation:.2g}</td>" for value, deviation in zip(values, deviations, strict=True))
        rows.append(f"<tr><th>{html.escape(make_printable(name))}</th>{''.join(cells)}</tr>")
    return f"<table>{''.join(rows)}</table>"
