"""Scans: what they refuse, by its words, and where they come from."""

import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxsubdiv as js
from fitting import Scan, ScanError, read_scan

POINTS = np.random.default_rng(0).normal(size=(8, 3))


def with_value(values: np.ndarray, rows: list[int], value: float) -> np.ndarray:
    values = values.copy()
    values[rows] = value
    return values


REFUSED = {
    "no points": ((np.zeros((0, 3)),), r"points of the shape \[p, 3\], at least one; got \[0, 3\]"),
    "two columns": ((POINTS[:, :2],), r"points of the shape \[p, 3\], at least one; got \[8, 2\]"),
    "one point, not in a row": ((POINTS[0],), r"points of the shape \[p, 3\], at least one; got \[3\]"),
    "NaN": ((with_value(POINTS, [2, 5], np.nan),), r"`points` are not finite in rows 2, 5\. Drop the rows"),
    "infinite normals": ((POINTS, with_value(POINTS, [1], np.inf)), r"`normals` are not finite in rows 1\."),
    "NaN weight": ((POINTS, None, with_value(np.ones(8), [7], np.nan)), r"`weights` are not finite in rows 7\."),
    "many bad rows": ((with_value(POINTS, list(range(7)), np.nan),), r"in rows 0, 1, 2, 3, 4 \(\+2 more\)"),
    "too few normals": ((POINTS, POINTS[:5]), r"`normals` must have the shape \[8, 3\]; got \[5, 3\]"),
    "too few weights": ((POINTS, None, np.ones(5)), r"`weights` must have the shape \[8\]; got \[5\]"),
    "negative weights": ((POINTS, None, with_value(np.ones(8), [3], -1)), r"negative in rows 3\. Give 0 to ignore"),
    "no weight at all": ((POINTS, None, np.zeros(8)), "all `weights` are 0: nothing is left to fit"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refuses(case):
    arguments, words = REFUSED[case]
    with pytest.raises(ScanError, match=words):
        Scan(*arguments)


def test_weights_or_ones():
    np.testing.assert_array_equal(Scan(POINTS).weights_or_ones(), np.ones(8))
    np.testing.assert_array_equal(Scan(POINTS, None, np.arange(8)).weights_or_ones(), np.arange(8))
    np.testing.assert_allclose(Scan(POINTS, None, np.arange(8)).relative_weights(), np.arange(8) / 4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_keeps_the_precision_of_arrays(dtype):
    scan = Scan(POINTS.astype(dtype), POINTS.astype(dtype), np.ones(8, dtype))
    assert scan.points.dtype == scan.normals.dtype == scan.weights.dtype == scan.weights_or_ones().dtype == dtype
    assert scan.n_points == 8


def test_takes_lists_and_whole_numbers():
    scan = Scan([[0, 0, 1], [1, 2, 3]], weights=[1, 2])
    assert scan.points.dtype == scan.weights.dtype == jnp.float64 and not scan.points.weak_type


def rows_of_text(separator: str, *columns: np.ndarray) -> str:
    return "\n".join(separator.join(map(repr, row)) for row in np.column_stack(columns).tolist())


NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
WEIGHTS = np.arange(8.0)
FILES = {
    "a.xyz": rows_of_text(" ", POINTS, NORMALS),
    "a.csv": "x,y,z,nx,ny,nz,weight\n" + rows_of_text(",", POINTS, NORMALS, WEIGHTS),
    "a.npz": {"points": POINTS, "normals": NORMALS, "weights": WEIGHTS},
}


@pytest.mark.parametrize("scale", [1.0, 1000.0])
@pytest.mark.parametrize("name", FILES)
def test_reads_points_normals_and_weights_of_a_file(tmp_path, name, scale):
    content = FILES[name]
    np.savez(tmp_path / name, **content) if isinstance(content, dict) else (tmp_path / name).write_text(content)
    scan = read_scan(tmp_path / name, scale=scale)
    np.testing.assert_array_equal(scan.points, POINTS * scale)
    np.testing.assert_array_equal(scan.normals, NORMALS)
    if name == "a.xyz":
        assert scan.weights is None
    else:
        np.testing.assert_array_equal(scan.weights, WEIGHTS)


def test_vertices_of_a_mesh_file_are_a_scan(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    scan = read_scan(str(tmp_path / "a.obj"))
    assert scan.n_points == 3 and scan.normals is None and scan.weights is None


def test_file_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "a.xyz").write_text("1 2 3\n1 2 x\n")
    with pytest.raises(js.MeshError, match=r"a\.xyz, line 2: 'x' is not a number"):
        read_scan(tmp_path / "a.xyz")
    with pytest.raises(FileNotFoundError, match=r"none\.xyz"):
        read_scan(tmp_path / "none.xyz")


@pytest.mark.parametrize("name", ["a.xyz", "a.csv"])
def test_file_without_points_is_refused(tmp_path, name):
    (tmp_path / name).write_text("x,y,z\n" if name == "a.csv" else "# nothing\n")
    with pytest.raises(ValueError, match=r"no line of numbers|holds no points"):
        read_scan(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "n_points", "n_vertices", "faces", "closed"),
    [("head_fragment", 8000, 165, {3: 0, 4: 140}, False), ("femur_distal", 5000, 250, {3: 496, 4: 0}, True)],
)
def test_example_is_a_scan_in_mm_with_a_control_mesh_for_it(name, n_points, n_vertices, faces, closed):
    scan, mesh = fitting.example(name)
    assert scan.n_points == n_points and len(mesh.vertices) == n_vertices and mesh.is_closed == closed
    assert {size: len(rows) for size, rows in mesh.faces.items()} == faces
    sizes = [np.ptp(np.asarray(rows), axis=0) for rows in (scan.points, mesh.vertices)]
    np.testing.assert_allclose(*sizes, rtol=0.15)
    assert np.all((sizes[0] > 30) & (sizes[0] < 300))


def test_unknown_example_is_refused_with_those_that_there_are(as_users_run):
    with pytest.raises(ValueError, match=r"`name` must be one of 'head_fragment', 'femur_distal'; got 'head'\."):
        fitting.example("head")
