"""Tables of points as other programs and hands write them: each is read, or refused by what it is."""

import time

import numpy as np
import pytest
from files import put
from odd_files import SQUARE, table

import fitting
from fitting import ScanError, read_scan
from jaxsubdiv import MeshError, read_points

ROWS = np.random.default_rng(0).normal(scale=20, size=(40, 3)).round(2)
UNIT = (ROWS / np.linalg.norm(ROWS, axis=1, keepdims=True)).round(3)
BYTES = np.random.default_rng(1).integers(0, 256, (40, 3))
LEFT_OUT = {
    "colours in bytes": (BYTES, "columns 4, 5, 6 left out"),
    "colours from 0 to 1": (BYTES / 255, "columns 4, 5, 6 left out"),
    "one colour of length 1": (np.tile((0.6, 0.8, 0.0), (40, 1)), "columns 4, 5, 6 left out"),
    "pure colours": (np.eye(3)[np.arange(40) % 3], "columns 4, 5, 6 left out"),
    "intensity": (BYTES[:, 0], "column 4 left out"),
    "time and intensity": (BYTES[:, :2] / 7, "columns 4, 5 left out"),
    "directions of any length": (ROWS, "columns 4, 5, 6 left out"),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_columns_that_are_no_normals_are_left_out_in_one_line(tmp_path, name):
    columns, words = LEFT_OUT[name]
    with pytest.warns(UserWarning, match=rf"a\.xyz: there are no headings: .* x, y, z, and {words}") as told:
        cloud = read_points(put(tmp_path, "a.xyz", table(ROWS, columns)))
    assert len(told) == 1 and cloud.normals is None
    np.testing.assert_allclose(cloud.points, ROWS)


def test_normals_are_found_by_their_length_wherever_they_stand(tmp_path):
    some = UNIT.copy()
    some[3], some[5] = 0, np.nan
    with pytest.warns(UserWarning, match=r"1 of 40 normals are not finite; these points count as without one"):
        cloud = read_points(put(tmp_path, "a.xyz", table(ROWS, some)))
    np.testing.assert_allclose(cloud.normals, np.nan_to_num(some))
    with pytest.warns(UserWarning, match="columns 7, 8, 9 as normals, and columns 4, 5, 6 left out"):
        cloud = read_points(put(tmp_path, "b.xyz", table(ROWS, BYTES, UNIT)))
    np.testing.assert_allclose(cloud.normals, UNIT)


def test_text_without_a_heading_is_left_out(tmp_path):
    with pytest.warns(UserWarning, match="column 4 left out"):
        assert len(read_points(put(tmp_path, "a.csv", "1,2,3,skin\n4,5,6,bone\n")).points) == 2


def test_delimiters_at_the_ends_of_lines_make_no_column(tmp_path):
    np.testing.assert_array_equal(
        read_points(put(tmp_path, "a.csv", "x,y,z\n1,2,3,\n4,5,6,,\n")).points, [(1, 2, 3), (4, 5, 6)]
    )


LONG = {
    "a.csv": "1" * 131000 + "x,2,3\n1,2,3\n",
    "b.csv": "(" * 131000 + ",2,3\n1,2,3\n",
    "c.csv": "1,2,3," + ",#" * 300_000 + "\n1,2,3\n",
    "d.csv": '"' * 1_000_001 + "\n1,2,3\n",
    "a.vtp": "<AppendedData" * 100_000,
    "a.obj": "\\\n" * 300_000,
}


@pytest.mark.parametrize("name", LONG)
def test_long_lines_take_no_time(tmp_path, name):
    """Each of these took minutes to split where the time grew as the square of the length."""
    begin = time.monotonic()
    with pytest.raises(MeshError) as error:
        read_points(put(tmp_path, name, LONG[name]))
    assert time.monotonic() - begin < 20 and len(str(error.value)) < 1000


def test_whole_numbers_with_a_sign_are_no_halves_of_decimal_commas(tmp_path):
    with pytest.warns(UserWarning, match="columns 4, 5, 6 left out"):
        cloud = read_points(put(tmp_path, "a.csv", "1,-25,3,205,160,140\n4,50,-6,205,160,140\n"))
    np.testing.assert_array_equal(cloud.points, [(1, -25, 3), (4, 50, -6)])


def test_spreadsheets_write_utf16_and_any_line_ends(tmp_path):
    text = "x\ty\tz\tWertÄ\r\n" + "".join(f"{x}\t{y}\t{z}\ta\r\n" for x, y, z in ROWS).replace(".", ",")
    np.testing.assert_allclose(read_points(put(tmp_path, "a.txt", text.encode("utf-16"))).points, ROWS)


@pytest.mark.parametrize("heading", ["pos_x,pos_y,pos_z", "X coordinate,Y coordinate,Z coordinate", "x_mm,y_mm,z_mm"])
def test_headings_of_two_words(tmp_path, heading):
    cloud = read_points(put(tmp_path, "a.csv", heading + "\n" + table(ROWS, separator=",")))
    np.testing.assert_allclose(cloud.points, ROWS)


def test_labels_in_quotes_hold_anything(tmp_path):
    text = 'x,y,z,label\n1,2,3,"#1"\n4,5,6,"a\nb"\n7,8,9,"c; d, e"\n# the end, "perhaps\n'
    for label, x in (("#1", 1), ("a\nb", 4), ("c; d, e", 7)):
        np.testing.assert_array_equal(read_scan(put(tmp_path, "a.csv", text), labels=label).points[:, 0], [x])


def test_contours_of_the_heart(tmp_path):
    scan = read_scan(
        put(tmp_path, "a.txt", "x\ty\tz\tcontour type\tslice\n1\t2\t3\tLV\t0\n2\t3\t4\tRV\t1\n"), labels="rv"
    )
    np.testing.assert_array_equal(scan.points, [(2, 3, 4)])
    np.testing.assert_array_equal(scan.slices, [1])


@pytest.mark.parametrize("number", ["99999999999", "1_0", "1.5", "", "٣", "9" * 5000, "nan"])
def test_slices_are_whole_numbers_of_32_bits(tmp_path, number):
    with pytest.raises(ScanError, match=r"a\.csv: the column `slice` has '.*', which is no whole number"):
        read_scan(put(tmp_path, "a.csv", f"x,y,z,slice\n1,2,3,{number}\n4,5,6,2\n"))
    with pytest.raises(ScanError, match="`slices` must be whole numbers below 2"):
        fitting.Scan(SQUARE, slices=np.array([1, 2, 3, 2**40]))


BAD_POINTS = {
    "a.ply": "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "end_header\n0 0 0\nnan nan nan\n1 1 0\n0 inf 0\n",
    "a.xyz": "0 0 0\nnan nan nan\n1 1 0\n0 inf 0\n",
    "a.csv": "x,y,z\n0,0,0\n,,\n1,1,0\n0,NA,0\n",
    "a.obj": "v 0 0 0\nv nan nan nan\nv 1 1 0\nv 0 inf 0\n",
    "a.off": "OFF\n4 0 0\n0 0 0\nnan nan nan\n1 1 0\n0 inf 0\n",
}


@pytest.mark.parametrize("name", BAD_POINTS)
def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path, name):
    with pytest.warns(UserWarning, match=rf"{name}: 2 of 4 points are not finite \(rows 1, 3, .*they were dropped"):
        cloud = read_points(put(tmp_path, name, BAD_POINTS[name]))
    np.testing.assert_array_equal(cloud.points, [(0, 0, 0), (1, 1, 0)])


def test_labels_and_slices_go_with_the_points_that_stay(tmp_path):
    with pytest.warns(UserWarning, match="1 of 3 points are not finite"):
        scan = read_scan(put(tmp_path, "a.csv", "x,y,z,label,slice\n1,2,3,a,1\nnan,2,3,a,2\n4,5,6,b,3\n"), labels="b")
    np.testing.assert_array_equal(scan.slices, [3])
