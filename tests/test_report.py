"""The report of a fit in numbers, and as a page."""

import base64
import dataclasses
import functools
import html.parser
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scans import N_POINTS, noise, problem

import fitting
import jaxsubdiv as js
from fitting.report.coverage import distances_to_scan
from fitting.report.page import write_page


@functools.cache
def noisy() -> fitting.FitResult:
    p = problem()
    return p.fit(p.points + noise())


def test_report_has_both_directions_the_unknowns_and_the_margin():
    result = noisy()
    report = result.report()
    areas, away = (
        np.asarray(result.surface.vertex_areas()),
        distances_to_scan(result.surface, result.fit.look, result.inliers),
    )
    here = ~np.isnan(away)
    there, share = np.abs(away[here]), areas[here] / areas[here].sum()
    np.testing.assert_allclose(report.coverage, areas[here].sum() / areas.sum(), rtol=1e-12)
    np.testing.assert_allclose(report.rms_to_scan, np.sqrt(np.average(there**2, weights=share)), rtol=1e-12)
    np.testing.assert_allclose(report.mean_to_scan, np.average(there, weights=share), rtol=1e-12)
    assert report.maximum_to_scan == there.max() and report.mean_to_scan < report.percentile_95_to_scan < there.max()
    assert report.coverage > 0.95 and report.rms_to_scan < 2 * report.noise
    assert report.n_unknowns == 12 * 5 + 1 and 20 < report.determined < 61
    np.testing.assert_allclose(report.least_margin, js.admissible_margin(problem().mesh, result.control).min())
    assert report.uncertainty_median is None and report.uncertainty_95 is None


def test_report_gives_the_uncertainty_when_asked():
    result = noisy()
    report, spread = result.report(uncertainty=True), result.uncertainty().surface
    assert report.uncertainty_median in spread and report.uncertainty_95 in spread
    assert np.quantile(spread, 0.3) < report.uncertainty_median < np.quantile(spread, 0.7)
    assert np.quantile(spread, 0.85) < report.uncertainty_95 <= spread.max()
    assert f"median {report.uncertainty_median:.3f}, 95th {report.uncertainty_95:.3f} mm" in str(report)


def test_report_is_the_same_in_words_values_and_json():
    report = noisy().report(uncertainty=True)
    values = json.loads(report.as_json())
    assert values == report.as_dict() and set(values) == {field.name for field in dataclasses.fields(report)}
    rows = dict(report.as_rows())
    assert len(rows) == len(report.as_rows()) == len(str(report).splitlines())
    assert rows["surface covered by the scan"] == f"{report.coverage:.1%}"
    assert f"RMS {report.rms_to_scan:.3f}, mean {report.mean_to_scan:.3f}" in rows["there, surface to scan"]
    assert rows["unknowns"] == f"61, about {report.determined:.0f} determined by the scan"
    assert rows["least margin of a normal"] == f"{report.least_margin:+.2f}"
    place = report.worst[0]
    at = ", ".join(f"{x:.1f}" for x in place.position)
    assert rows["worst place 1"] == f"{place.distance:+.3f} mm at ({at}), {place.n_points} points"
    assert values["worst"][0] == {
        "position": place.position,
        "distance": place.distance,
        "n_points": place.n_points,
    }


def test_report_leaves_out_what_there_is_not():
    report = dataclasses.replace(
        noisy().report(),
        least_margin=None,
        rms_to_scan=None,
        mean_to_scan=None,
        percentile_95_to_scan=None,
        maximum_to_scan=None,
        coverage=0.0,
    )
    names = [name for name, _ in report.as_rows()]
    assert not any("to scan" in name or "margin" in name or "deviation" in name for name in names)
    assert json.loads(report.as_json())["rms_to_scan"] is None


def test_control_mesh_of_a_fit_is_the_one_that_it_started_from_moved():
    result = noisy()
    mesh = result.control_mesh
    np.testing.assert_array_equal(mesh.vertices, result.control.vertices)
    np.testing.assert_array_equal(mesh.normals, result.control.normals)
    for size in (3, 4):
        np.testing.assert_array_equal(mesh.faces[size], problem().mesh.faces[size])
    assert N_POINTS == result.report().n_points


class Page(html.parser.HTMLParser):
    """Elements of a page with their attributes, and the text in some of them."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.elements, self.texts = [], [], {}
        self.feed(text)
        self.close()
        self.data = json.loads(self.texts["data"])

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.elements.append((tag, attrs))
        if tag not in ("meta", "input"):
            self.open.append((tag, attrs.get("id", tag)))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        if self.open:
            key = self.open[-1][1]
            self.texts[key] = self.texts.get(key, "") + data

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


def page_of(path: Path) -> Page:
    page = Page(path.read_text(encoding="utf-8"))
    assert page.open == []
    return page


def array(text: str, dtype: str, width: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, width)


@functools.cache
def written(folder: Path, uncertainty: bool) -> Path:
    path = folder / f"{uncertainty}.html"
    write_page(path, noisy(), title="</title><script>alert(1)</script> & @@DATA@@", uncertainty=uncertainty)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pages")


def test_page_holds_the_surface_the_control_mesh_and_the_scan(folder):
    result, data = noisy(), page_of(written(folder, True)).data
    surface, mesh = result.surface, result.control_mesh
    for text, values in (
        (data["surface"]["vertices"], surface.vertices),
        (data["points"]["vertices"], result.scan.points),
        (data["control"]["vertices"], result.control.vertices),
        (data["start"], problem().start.vertices),
        (data["points"]["values"], result.distances[:, None]),
        (data["deviation"]["values"], result.uncertainty().surface[:, None]),
        (data["distance"]["values"], distances_to_scan(surface, result.fit.look, result.inliers)[:, None]),
    ):
        np.testing.assert_array_equal(array(text, "<f4", values.shape[1]), np.asarray(values, np.float32))
    np.testing.assert_array_equal(array(data["surface"]["triangles"], "<u4", 3), surface.triangles())
    np.testing.assert_array_equal(array(data["control"]["edges"], "<u4", 2), mesh.half_edges.edges)
    assert len(array(data["control"]["triangles"], "<u4", 3)) == len(mesh.faces[3]) + 2 * len(mesh.faces[4])
    view = np.reshape(data["view"], (3, 3))
    np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view) > 0
    assert np.linalg.norm(np.asarray(surface.vertices) - data["centre"], axis=1).max() <= data["radius"] * (1 + 1e-9)


def test_page_has_the_table_of_the_report_with_places_to_turn_to(folder):
    page, report = page_of(written(folder, True)), noisy().report(uncertainty=True)
    rows = len(page.all("tr"))
    assert rows == len(report.as_rows()) == len(page.all("td"))
    assert [attrs["data-place"] for attrs in page.all("button")] == [str(i) for i in range(len(report.worst))]
    assert [place["position"] for place in page.data["places"]] == [place.position for place in report.worst]
    for name, value in report.as_rows():
        assert name in page.texts["th"] and value in page.texts["td"] + page.texts["button"]


def test_page_needs_no_network_and_a_title_cannot_break_it(folder):
    page, text = page_of(written(folder, True)), written(folder, True).read_text(encoding="utf-8")
    assert "://" not in text and "url(" not in text and "import" not in page.texts["script"]
    assert not any({"src", "href", "srcset", "action"} & set(attrs) for _, attrs in page.elements)
    policy = next(attrs["content"] for attrs in page.all("meta") if "http-equiv" in attrs)
    assert policy.startswith("default-src 'none'")
    assert page.texts["title"] == page.texts["h1"] == "</title><script>alert(1)</script> & @@DATA@@"
    assert len(page.all("script")) == 2


def test_page_without_uncertainty_has_no_switch_to_it(folder):
    page, other = page_of(written(folder, False)), page_of(written(folder, True))
    assert page.data["deviation"] is None
    radios = [[attrs["value"] for attrs in p.all("input") if attrs["type"] == "radio"] for p in (page, other)]
    assert radios == [["distance"], ["distance", "deviation"]]


def test_charts_of_the_page_show_every_point_and_every_sweep(folder):
    page, result = page_of(written(folder, False)), noisy()
    heights = np.array([float(attrs["height"]) for attrs in page.all("rect")])
    limit = np.percentile(np.abs(result.distances), 99)
    counts = np.histogram(np.clip(result.distances, -limit, limit), 60, (-limit, limit))[0]
    np.testing.assert_allclose(heights / heights.max(), counts / counts.max(), atol=1e-3)
    y = np.array([float(attrs["cy"]) for attrs in page.all("circle")])
    drop = np.log(result.rms[0] / result.rms)
    assert len(y) == len(result.rms)
    np.testing.assert_allclose((y - y[0]) / (y[-1] - y[0]), drop / drop[-1], atol=1e-3)


def test_page_of_a_fit_that_did_not_converge_says_so_and_takes_a_start(tmp_path):
    result = problem().fit(max_sweeps=0)
    write_page(tmp_path / "fit.html", result, start=problem().mesh, uncertainty=False)
    page = page_of(tmp_path / "fit.html")
    assert page.texts["title"] == "Fit" and page.all("p")[0] == {"class": "bad"}
    np.testing.assert_array_equal(array(page.data["start"], "<f4", 3), np.float32(problem().mesh.vertices))
    assert [path.name for path in tmp_path.iterdir()] == ["fit.html"]


def test_page_of_a_large_surface_stays_under_three_megabytes(tmp_path, monkeypatch):
    """10,000 vertices and 30,000 points, of which 20,000 are shown."""
    p, result = problem(), problem().fit(max_sweeps=0)
    report = dataclasses.replace(result.report(), n_points=30_000)
    monkeypatch.setattr(fitting.FitResult, "report", lambda self, **_: report)
    topology = js.build_topology(p.mesh, js.Interpolating(), 5)
    result.surface = js.refine(js.Interpolating(), topology, p.start)
    points = np.tile(np.asarray(result.scan.points), (50, 1))
    result.scan, result.distances = fitting.Scan(points), np.tile(result.distances, 50)
    monkeypatch.setattr(fitting.FitResult, "points", points)
    monkeypatch.setattr(
        "fitting.report.page.distances_to_scan", lambda surface, *_: np.full(len(surface.vertices), np.nan)
    )
    write_page(tmp_path / "fit.html", result, uncertainty=False)
    assert len(result.surface.vertices) > 10_000 and (tmp_path / "fit.html").stat().st_size < 3_000_000
    page = page_of(tmp_path / "fit.html")
    assert np.isnan(array(page.data["distance"]["values"], "<f4", 1)).all()
    assert len(array(page.data["points"]["values"], "<f4", 1)) == 20_000
    assert "(an even part of 20,000)" in page.texts["label"]


@pytest.mark.skipif(shutil.which("node") is None, reason="node reads the script as a browser would")
def test_script_of_the_page_is_sound_javascript():
    script = Path(fitting.__file__).parent / "report" / "page.js"
    subprocess.run(["node", "--check", script], check=True, timeout=60)
    assert "</" not in script.read_text(encoding="utf-8")
