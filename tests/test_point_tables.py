"""Points as text: columns, headings, digits, and tables that cannot be read."""

import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
from files import put
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from round_trips import finite

from jaxsubdiv import _io, tables
from jaxsubdiv._io import read_points
from jaxsubdiv.errors import MeshError


@pytest.mark.parametrize(
    ("text", "has_normals", "has_weights"),
    [
        ("0 1.5 2\n3 4 5\n", False, False),
        ("# a\n  0\t1.5   2 # b\r\n\r\n3 4 5", False, False),
        ("0,1.5, 2\n3,4,5\n", False, False),
        ("0; 1.5;2\n3;4;5\n", False, False),
        ("0 1.5 2\r3 4 5\r", False, False),
        ("0;1,5;2\n3;4;5\n", False, False),
        ("0,0 1,5 2,0\n3,0 4,0 5,0\n", False, False),
        ("2\n0 1.5 2\n3 4 5\n", False, False),
        ("// a comment\n; another\n0 1.5 2\n3 4 5\n", False, False),
        ("//X Y Z Nx Ny Nz\n0 1.5 2 1 0 0\n3 4 5 0 2 0\n", True, False),
        ("x [mm] y [mm] z [mm] nx ny nz\n0 1.5 2 1 0 0\n3 4 5 0 2 0\n", True, False),
        ("x (mm);y (mm);z (mm)\n0;1,5;2\n3;4;5\n", False, False),
        (
            '"Point ID","Points:0","Points:1","Points:2","Normals:0","Normals:1","Normals:2"\n0,0,1.5,2,1,0,0\n'
            "1,3,4,5,0,2,0\n",
            True,
            False,
        ),
        ("x\ty\tz\tcontour type\tslice\n0\t1.5\t2\tLV ENDO\t0\n3\t4\t5\tLV ENDO\t0\n", False, False),
        ('x,y,z,label\n0,1.5,2,"#1"\n3,4,5,"a\nb, c"\n', False, False),
        ("x,y,z,label\n0,1.5,2,#1\n3,4,5,#2\n", False, False),
        (";x;y;z\n0;0;1,5;2\n1;3;4;5\n", False, False),
        ("x,y,z,nx,ny,nz\n0,1.5,2,1,0,0\n3,4,5,0,2,0\n", True, False),
        ("X Y Z\n0 1.5 2\n3 4 5\n", False, False),
        ("z,label,y,weight,x\n2,LV ENDO,1.5,0.5,0\n5,,4,2,3\n", False, True),
        ('"x";"y";"z";"name"\n0;1.5;2;"a;b"\n3;4;5;c\n', False, False),
        ("\ufeffnx,ny,nz,x,y,z,weight\n1,0,0,0,1.5,2,0.5\n0,2,0,3,4,5,2\n", True, True),
    ],
)
@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".txt", ".ASC"])
def test_point_tables(tmp_path, suffix, text, has_normals, has_weights):
    cloud = read_points(put(tmp_path, "a" + suffix, text))
    np.testing.assert_array_equal(cloud.points, [[0, 1.5, 2], [3, 4, 5]])
    assert (cloud.normals is not None, cloud.weights is not None) == (has_normals, has_weights)
    if has_normals:
        np.testing.assert_array_equal(cloud.normals, [[1, 0, 0], [0, 2, 0]])
    if has_weights:
        np.testing.assert_array_equal(cloud.weights, [0.5, 2])


@settings(max_examples=25, deadline=None)
@given(arrays(np.float64, st.tuples(st.integers(1, 5), st.sampled_from([3, 6])), elements=finite))
def test_point_tables_keep_every_digit(rows):
    with tempfile.TemporaryDirectory() as folder:
        for separator in (" ", ",", ";", "\t"):
            names = separator.join(("x", "y", "z", "nx", "ny", "nz")[: rows.shape[1]])
            text = "\n".join([names, *(separator.join(map(repr, row)) for row in rows.tolist())])
            cloud = read_points(put(Path(folder), "a.xyz", text))
            np.testing.assert_array_equal(cloud.points, rows[:, :3])
            assert (cloud.normals is None) == (not rows[:, 3:].any())
            if cloud.normals is not None:
                np.testing.assert_array_equal(cloud.normals, rows[:, 3:])


CELLS = [
    *("1", "+2.", "-.5", "1e3", "nan", "-inf", "1 ", "0x10", "1_0", "1d5", "1,5", "", " ", "\t", "\x0c3", "3\x0b", "."),
    *("1e400", "1e-400", "4\x00", "\x1c5", "abc", "1+2j", "1e", "--1", "1.#QNAN", "-", "NA", "7\r", '"8"', "9#", "//"),
]


def test_plain_tables_are_read_as_any_others(tmp_path, monkeypatch):
    read_plain, n_plain = tables._plain_numbers, 0

    def outcome() -> tuple:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            try:
                contents = _io._table.read(tmp_path / "a.csv")
                words = None
            except MeshError as error:
                contents, words = _io._table.Contents(np.zeros((0, 3))), str(error)
        arrays = [None if values is None else values.tolist() for values in (*contents[:1], *contents[2:4])]
        return repr(arrays), contents.texts, words, [str(warning.message) for warning in told]

    for seed in range(400):
        rng = np.random.default_rng(seed)
        n, delimiter = rng.integers(3, 8), rng.choice([" ", ",", ";", "\t", "  ", ", "])
        rows = [[f"{value:.3g}" for value in row] for row in rng.normal(size=(rng.integers(1, 5), n))]
        if seed % 3:
            rows[rng.integers(len(rows))][rng.integers(n)] = str(rng.choice(CELLS))
        if seed % 5 < 2:
            rows.insert(0, ["x", "y", "z", "nx", "ny", "nz", "weight"][:n])
        if seed % 7 == 0:
            rows.insert(0, [str(rng.integers(1, 5))])
        put(tmp_path, "a.csv", "\n".join(delimiter.join(row) for row in rows) + "\n" * int(rng.integers(3)))
        monkeypatch.setattr(tables, "_plain_numbers", lambda *_: None)
        expected = outcome()
        monkeypatch.setattr(tables, "_plain_numbers", read_plain)
        assert outcome() == expected, seed
        n_plain += tables.read_table(tmp_path / "a.csv")._plain is not None if expected[2] is None else 0
    assert n_plain > 100


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("# nothing\n\n", r"a\.csv: it has no line of numbers"),
        ("x y z\n", r"a\.csv: it holds no points"),
        ("# a\n1 2\n", r"a\.csv, line 2: 2 columns. A point needs at least x, y and z"),
        ("a,b,c\n1,2,3\n", "line 1: a header row must name x, y and z, .* this one has a, b, c"),
        ("x,y,z,nx\n1,2,3,4\n", "must name x, y and z, all of nx, ny, nz or none, and none twice"),
        ("x,y,z,x\n1,2,3,4\n", "must name x, y and z, all of nx, ny, nz or none, and none twice"),
        ("1 2 3\n\n1 2 3 4\n", "line 3: 4 columns, where the first row has 3"),
        ("x,y,z,l\n1,2,3,a\n1,2,3\n", "line 3: 3 columns, where the first row has 4"),
        ("1,2,3\n1,b,3\n", "line 2: 'b' is not a number. Write decimals with a point"),
        ("1;2,5;3\n1;2.5;3\n", "line 1: the column has both commas and points. Write decimals with a point"),
        ("x,y,z\n1,,3\n", "it holds no points. All 1 rows have coordinates that are not finite"),
        ("250\n1 2 3\n4 5 6\n", "the first row announces 250 rows, but 2 follow. The file is cut off"),
        ('x,y,z,l\n1,2,3,"a\n', "line 2: the row cannot be parsed .*Close its quotes"),
        ("x,y,z\n1,5,2,5,3,5\n", "line 2: 6 columns, where the first row has 3. Write decimals with a point"),
        ("1,257,-29,868,12,079\n2,257,-29,868,12,079\n", "6 columns of whole numbers, .*: decimal commas, it seems"),
        ("1 2 3\n1 2 3_0\n", "line 2: '3_0' is not a number"),
        ("1,2,3\n1,2,3" + 200000 * "3" + ",4\n", "line 2: the row cannot be parsed .field larger"),
        ("1 2 3\n1 2 \uff13\n", "line 2: '\uff13' is not a number"),
    ],
)
def test_point_tables_that_cannot_be_read(tmp_path, content, words):
    with pytest.raises(MeshError, match=words):
        read_points(put(tmp_path, "a.csv", content))


def test_whole_numbers_in_named_columns_are_what_the_names_say(tmp_path):
    cloud = read_points(put(tmp_path, "a.csv", "x,y,z,nx,ny,nz\n1,257,-29,868,12,79\n"))
    np.testing.assert_array_equal(cloud.normals, [(868, 12, 79)])


def test_not_finite_points_are_named_by_row(tmp_path):
    points = np.zeros((9, 3))
    points[[2, 5], 1] = np.nan
    np.savez(tmp_path / "a.npz", points=points, weights=np.arange(9.0))
    with pytest.warns(UserWarning, match=r"a\.npz: 2 of 9 points are not finite \(rows 2, 5, .*they were dropped"):
        np.testing.assert_array_equal(read_points(tmp_path / "a.npz").weights, [0, 1, 3, 4, 6, 7, 8])
    np.savez(tmp_path / "a.npz", points=np.zeros((2, 3)), normals=[(0, 0, 1), (0, 0, np.nan)])
    with pytest.warns(UserWarning, match="1 of 2 normals are not finite; these points count as without one"):
        np.testing.assert_array_equal(read_points(tmp_path / "a.npz").normals, [(0, 0, 1), (0, 0, 0)])
    np.savez(tmp_path / "a.npz", points=np.zeros((2, 3)), weights=[np.inf, 1])
    with pytest.raises(MeshError, match="weights 0, counted from zero, are not finite"):
        read_points(tmp_path / "a.npz")
