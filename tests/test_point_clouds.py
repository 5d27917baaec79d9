"""Point clouds of PCL, Leica and biv-me."""

import struct

import numpy as np
import pytest
from files import ROWS, lines, put

from fitting import read_scan
from jaxsubdiv import MeshError, read_points
from jaxsubdiv._io._pcd import unpack_lzf

PCD = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ normal_x normal_y normal_z rgb\nSIZE 4 4 4 1 4 4 4 4\n"
PCD += "TYPE F F F U F F F U\nCOUNT 1 1 1 4 1 1 1 1\nWIDTH 30\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 30\nDATA {}\n"
RECORD = np.dtype([("at", "<f4", 3), ("gap", "u1", 4), ("up", "<f4", 3), ("rgb", "<u4")])


def packed(data: bytes) -> bytes:
    """LZF with runs as they are, and of what came before where three bytes repeat."""
    found, at, plain = bytearray(), 0, bytearray()

    def put_plain() -> None:
        for i in range(0, len(plain), 32):
            part = plain[i : i + 32]
            found.extend(bytes([len(part) - 1]) + part)
        plain.clear()

    while at < len(data):
        before = data.rfind(data[at : at + 3], max(at - 8000, 0), at + 2)
        n = 0
        while 0 <= before and n < 264 and at + n < len(data) and data[before + n] == data[at + n]:
            n += 1
        if n < 3:
            plain.append(data[at])
            at += 1
            continue
        put_plain()
        back = at - before - 1
        length = bytes([(min(n - 2, 7) << 5) | back >> 8]) + (bytes([n - 9]) if n >= 9 else b"")
        found.extend(length + bytes([back & 255]))
        at += n
    put_plain()
    return bytes(found)


def pcd(form: str) -> bytes:
    table = np.zeros(30, RECORD)
    table["at"], table["up"], table["rgb"] = ROWS, -ROWS, 7
    table["at"][3] = np.nan
    head = PCD.format(form).encode()
    if form == "ascii":
        return head + b"".join(
            (" ".join(f"{v:.9g}" for v in (*row["at"], 0, 0, 0, 0, *row["up"], row["rgb"])) + "\n").encode()
            for row in table
        )
    if form == "binary":
        return head + table.tobytes()
    columns = (
        [table["at"][:, i] for i in range(3)] + [table["gap"]] + [table["up"][:, i] for i in range(3)] + [table["rgb"]]
    )
    data = b"".join(np.ascontiguousarray(column).tobytes() for column in columns)
    small = packed(data)
    return head + struct.pack("<II", len(small), len(data)) + small


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd_in_every_form(tmp_path, form):
    with pytest.warns(UserWarning, match="1 of 30 points are not finite"):
        cloud = read_points(put(tmp_path, "a.pcd", pcd(form)))
    kept = np.delete(ROWS, 3, axis=0)
    np.testing.assert_allclose(cloud.points, kept, rtol=1e-8)
    np.testing.assert_allclose(cloud.normals, -kept, rtol=1e-8)


@pytest.mark.parametrize("data", [b"", b"a", b"abcabcabcabc" * 50, bytes(3000), bytes(range(256)) * 3])
def test_lzf_gives_what_was_packed(data):
    assert unpack_lzf(packed(data), len(data)) == data


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda data: data.replace(b"DATA binary\n", b""),
            "line 11: the header has no line 'DATA'|no meaning in a PCD",
        ),
        (lambda data: data.replace(b"POINTS 30", b"POINTS 3000000000"), "3000000000 points are announced, but 30 are"),
        (lambda data: data.replace(b"POINTS 30", b"POINTS -3"), "POINTS must be a whole number"),
        (lambda data: data.replace(b"FIELDS x y", b"FIELDS x u"), "its fields must have x, y and z"),
        (lambda data: data.replace(b"SIZE 4", b"SIZE 3"), "'x' has the type F of 3 bytes"),
        (lambda data: data.replace(b"COUNT 1", b"COUNT 2"), "its fields must have x, y and z, one number each"),
        (lambda data: data.replace(b"TYPE F F", b"TYPE F"), "must have a word for each field"),
        (lambda data: data.replace(b"DATA binary", b"DATA zip"), "DATA one of ascii, binary"),
        (lambda data: data[:-1], "30 points are announced, but 29 are there"),
        (lambda data: b"hello\n" + data, "line 1: 'hello' has no meaning in a PCD header"),
        (lambda data: pcd("binary_compressed")[:-9], "bytes follow. The file is cut off"),
        (lambda data: pcd("binary_compressed")[:-9] + bytes(9), "where 960 are announced|ends? within|before the"),
        (lambda data: pcd("ascii") + b"1 2 3\n", "line 42: a point needs 11 numbers"),
        (lambda data: pcd("ascii").replace(b"POINTS 30", b"POINTS 31"), "31 points are announced, but 30 are there"),
    ],
)
def test_pcd_that_is_damaged(tmp_path, change, words):
    with pytest.raises(MeshError, match=words) as caught:
        read_points(put(tmp_path, "a.pcd", change(pcd("binary"))))
    assert str(caught.value).startswith("a.pcd")


@pytest.mark.parametrize(
    ("data", "n"), [(b"\xff\xff\xff", 264), (b"\x20", 3), (b"\x05abc", 6), (b"\0a", 99), (b"\0a", 2)]
)
def test_lzf_that_is_damaged(data, n):
    with pytest.raises(ValueError, match=r"cannot unpack|within a run|before the first|are announced"):
        unpack_lzf(data, n)


def test_pcd_names_a_viewpoint_that_it_does_not_apply(tmp_path):
    data = pcd("binary").replace(b"VIEWPOINT 0 0", b"VIEWPOINT 0 1")
    with pytest.warns(UserWarning) as told:
        read_points(put(tmp_path, "a.pcd", data))
    assert any("VIEWPOINT of the sensor, which was not applied" in str(one.message) for one in told)


@pytest.mark.parametrize("count", ["", "30\n"])
def test_points_of_leica_with_intensity_and_colours(tmp_path, count):
    others = np.random.default_rng(1).integers(0, 255, (30, 4)) - [2000, 0, 0, 0]
    with pytest.warns(UserWarning, match=r"columns 4, 5, 6, 7 left out"):
        cloud = read_points(put(tmp_path, "a.pts", count + lines(np.hstack([ROWS.astype(float), others]))))
    np.testing.assert_allclose(cloud.points, ROWS, rtol=1e-6)
    assert cloud.normals is None


@pytest.mark.parametrize("name", ["digitised.pts", "a_local.particles", "a_world.particles"])
def test_bare_points(tmp_path, name):
    np.testing.assert_allclose(read_points(put(tmp_path, name, lines(ROWS))).points, ROWS, rtol=1e-6)


def test_points_of_leica_that_are_cut_off(tmp_path):
    with pytest.raises(MeshError, match=r"a\.pts: the first row announces 31 rows, but 30 follow"):
        read_points(put(tmp_path, "a.pts", "31\n" + lines(ROWS)))


GUIDE_POINTS = "x\ty\tz\tcontour type\tframeID\tweight\ttime frame\n1\t2\t3\tSAX_LV_ENDOCARDIAL\t2\t1.0\t0\n"
GUIDE_POINTS += "4\t5\t6\tSAX_RV_SEPTUM\t2\t0.5\t0\n7\t8\t9\tLAX_LV_ENDOCARDIAL\t11\t0.5\t{}\n"


def test_guide_points_of_biv_me_have_labels_slices_and_weights(tmp_path):
    scan = read_scan(put(tmp_path, "GPFile_000.txt", GUIDE_POINTS.format(0)), labels="LV_ENDO")
    np.testing.assert_array_equal(scan.points, [(1, 2, 3), (7, 8, 9)])
    np.testing.assert_array_equal(scan.slices, [2, 11])
    np.testing.assert_array_equal(scan.weights, [1, 0.5])
    with pytest.warns(UserWarning, match="the column 'time frame' has 2 different values: points of several moments"):
        read_scan(put(tmp_path, "GPFile_000.txt", GUIDE_POINTS.format(1)))
