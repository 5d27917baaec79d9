"""Files as other programs write them, and as disks and hands leave them: each is read, or refused by what it is."""

import json
import subprocess
import sys
import time
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

import fitting
import jaxsubdiv as js
from fitting import ScanError, read_scan
from jaxsubdiv import MeshError, read_mesh, read_points

ROWS = np.random.default_rng(0).normal(scale=20, size=(40, 3)).round(2)
UNIT = (ROWS / np.linalg.norm(ROWS, axis=1, keepdims=True)).round(3)
SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)


def put(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def table(*columns: np.ndarray, separator: str = " ") -> str:
    return "".join(separator.join(f"{value:g}" for value in row) + "\n" for row in np.column_stack(columns))


def case(name: str) -> Path:
    """A file of others that is not ours to copy."""
    path = Path(__file__).parents[2] / "shared" / "cases" / name
    if not path.exists():
        pytest.skip(f"{path} is not there: it belongs to others, and lies beside the checkout where it is at hand")
    return path


# --------------------------------------------------------------------------------------------- columns without headings

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


# --------------------------------------------------------------------------------------------------- headings, dialects


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


# -------------------------------------------------------------------------------------------------- points out of order

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


# --------------------------------------------------------------------------------------------- mesh files read as scans

FIVE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (-1, 0.5, 0)]
LINES = "".join(f"{x} {y} {z}\n" for x, y, z in FIVE)
XML = '<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="5" NumberOfStrips="0" NumberOfPolys="1"><Points>'
XML += f'<DataArray type="Float32" NumberOfComponents="3" format="ascii">{LINES}</DataArray></Points><Polys><DataArray '
XML += 'type="Int32" Name="connectivity" format="ascii">0 1 2 3 4</DataArray><DataArray type="Int32" Name="offsets" '
XML += 'format="ascii">5</DataArray></Polys></Piece></PolyData></VTKFile>'
PLY = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
PLY += "property list uchar int vertex_indices\nend_header\n"
PENTAGONS = {
    "a.obj": "".join(f"v {line}\n" for line in LINES.splitlines()) + "f 1 2 3 4 5\nf 1 2\n",
    "a.off": f"OFF\n5 1 0\n{LINES}5 0 1 2 3 4\n",
    "a.ply": f"{PLY}{LINES}5 0 1 2 3 4\n",
    "a.vtk": f"# vtk DataFile Version 3\n\nASCII\nDATASET POLYDATA\nPOINTS 5 float\n{LINES}POLYGONS 1 6\n5 0 1 2 3 4\n",
    "a.vtp": XML,
}


@pytest.mark.parametrize("name", PENTAGONS)
def test_faces_do_not_matter_for_points(tmp_path, name):
    path = put(tmp_path, name, PENTAGONS[name])
    np.testing.assert_array_equal(read_points(path).points, FIVE)
    with pytest.raises(MeshError, match=r"a face of 5 corners|neither triangles nor quads"):
        read_mesh(path)


def test_normals_of_corners_survive_odd_faces_and_are_left_out_with_damaged_ones(tmp_path):
    text = PENTAGONS["a.obj"].split("f ")[0] + "vn 0 0 2\n"
    cloud = read_points(put(tmp_path, "a.obj", text + "f 1//1 2//1 3//1 4//1 5//1\n"))
    np.testing.assert_array_equal(cloud.normals, [(0, 0, 2)] * 5)
    with pytest.warns(UserWarning, match="the normals were left out, since the faces do not say whose they are"):
        assert read_points(put(tmp_path, "a.obj", text + "f 1//1 2//7 3\n")).normals is None


def test_stl_with_bytes_after_its_last_triangle(tmp_path):
    facet = np.zeros(2, [("numbers", "<f4", 12), ("attributes", "<u2")])
    facet["numbers"][:, 3:] = [(0, 0, 0, 1, 0, 0, 0, 1, 0), (1, 0, 0, 1, 1, 0, 0, 1, 0)]
    data = b"solid by a scanner".ljust(80) + (2).to_bytes(4, "little") + facet.tobytes()
    with pytest.warns(UserWarning, match=r"a\.stl: 2 bytes after the last of 2 triangles were left out"):
        assert read_mesh(put(tmp_path, "a.stl", data + b"\r\n")).n_faces == 2
    with pytest.raises(MeshError, match="as binary STL it should hold 2 triangles in 184 bytes, but it has 150"):
        read_mesh(put(tmp_path, "a.stl", data[:150]))


def test_stl_of_text_with_lines_after_its_end(tmp_path):
    corners = "".join(f"vertex {x} {y} {z}\n" for x, y, z in SQUARE[:3])
    text = f"solid a\nfacet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\nendsolid a\n"
    with pytest.warns(UserWarning, match=r"a\.stl: 1 lines after the last 'endsolid' were left out"):
        assert read_mesh(put(tmp_path, "a.stl", text + "\x1a")).n_faces == 1


# ------------------------------------------------------------------------------------------- surfaces of brain programs

MNI = "P 0.3 0.3 0.4 10 1 4\n" + "".join(f" {x:g} {y:g} {z:g}\n" for x, y, z in SQUARE)
MNI_REST = "\n" + 4 * " 0 0 1\n" + "\n 2\n {}\n\n 3 6\n\n 0 1 2 0 2 3\n"


@pytest.mark.parametrize("colours", ["0 1 1 1 1", "1" + 2 * " 1 0 0 1", "2" + 4 * "\n 1 0 0 1"])
def test_mni_surface_is_read(tmp_path, colours):
    mesh = read_mesh(put(tmp_path, "a.obj", MNI + MNI_REST.format(colours)))
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces[3], [(0, 1, 2), (0, 2, 3)])
    np.testing.assert_array_equal(mesh.normals, [(0, 0, 1)] * 4)


def test_mni_surface_that_is_cut_off_or_binary_is_named(tmp_path):
    path = put(tmp_path, "a.obj", MNI)
    np.testing.assert_array_equal(read_points(path).points, SQUARE)
    with pytest.raises(MeshError, match="a surface of the MNI tools that ends before the number of polygons"):
        read_mesh(path)
    for n, words in (("2000000000", "announces 2e.09 vertices, but has 18 numbers"), ("-1", "announces -1 vertices")):
        with pytest.raises(MeshError, match=words):
            read_points(put(tmp_path, "a.obj", MNI.replace("1 4\n", f"1 {n}\n")))
    with pytest.raises(MeshError, match=r"a binary surface of the MNI tools. Turn it into text with `ascii_binary`"):
        read_points(put(tmp_path, "a.obj", b"p" + bytes(40)))


FREESURFER = "#!ascii version of lh.white\n4 2\n" + table(SQUARE, np.zeros(4)) + "0 1 2 0\n0 2 3 0\n"


def test_freesurfer_surface_of_text(tmp_path):
    path = put(tmp_path, "lh.white.asc", FREESURFER)
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, SQUARE)
    np.testing.assert_array_equal(mesh.faces[3], [(0, 1, 2), (0, 2, 3)])
    np.testing.assert_array_equal(read_points(path).points, SQUARE)
    cut = put(tmp_path, "cut.asc", FREESURFER[:-10])
    np.testing.assert_array_equal(read_points(cut).points, SQUARE)
    with pytest.raises(MeshError, match=r"cut\.asc: 2 faces are announced, but 1 rows follow"):
        read_mesh(cut)
    with pytest.raises(MeshError, match=r"a\.asc: it holds points without faces, or no FreeSurfer surface"):
        read_mesh(put(tmp_path, "a.asc", table(SQUARE)))


def test_freesurfer_surface_of_others():
    mesh = read_mesh(case("lh.pial.asc"))
    assert (len(mesh.vertices), mesh.n_faces, mesh.is_closed) == (250, 496, True)


# ------------------------------------------------------------------------------------------------------- control points


def markups(frame: object = "LPS", **more: object) -> str:
    points = [{"label": "F-1", "position": [1, 2, 3]}, {"label": "F-2", "position": [4, 5, 6]} | more]
    return json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": frame, "controlPoints": points}]})


@pytest.mark.parametrize(("frame", "name"), [("LPS", "LPS"), ("RAS", "RAS"), (0, "RAS"), ("1", "LPS"), ("ras", "RAS")])
def test_control_points_of_slicer_stay_in_the_frame_of_their_file(tmp_path, frame, name):
    path = put(tmp_path, "a.mrk.json", markups(frame))
    with pytest.warns(UserWarning, match=rf"a\.mrk\.json: positions are in {name} \(") as told:
        marks = fitting.read_landmarks(path, scale=2.0)
    assert len(told) == 1 and list(marks) == ["F-1", "F-2"]
    np.testing.assert_array_equal(marks["F-2"], [8, 10, 12])
    with pytest.warns(UserWarning, match=name):
        np.testing.assert_array_equal(read_points(path).points, [(1, 2, 3), (4, 5, 6)])


def test_control_points_of_older_slicers(tmp_path):
    text = "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n# columns = id,x,y,z,vis,label,desc\n"
    text += "vtkMRML_0,1,2,3,1,F-1,\nvtkMRML_1,4,5,6,1,F-2,\n"
    for frame, name in (("0", "RAS"), ("LPS", "LPS")):
        with pytest.warns(UserWarning, match=rf"positions are in {name}"):
            marks = fitting.read_landmarks(put(tmp_path, "a.fcsv", text.format(frame)))
        np.testing.assert_array_equal(marks["F-2"], [4, 5, 6])


def test_control_points_that_were_not_placed_are_left_out(tmp_path):
    with pytest.warns(UserWarning, match="LPS"):
        assert list(fitting.read_landmarks(put(tmp_path, "a.json", markups(positionStatus="undefined")))) == ["F-1"]


BAD_MARKS = {
    "a.json": (markups(position=[1, 2]), "control point 1, counted from zero, needs a `position` of three numbers"),
    "b.json": (markups("IJK"), "the frame 'IJK' is not known; it must be LPS or RAS"),
    "c.json": ('{"markups": 3}', "it has no list `markups`"),
    "d.json": ("[" * 5000, "is no JSON"),
    "e.json": ('{"tip": [1, 2, %s]}' % ("9" * 5000), "is no JSON"),
    "f.json": ('{"tip": [1, 2, %s]}' % ("9" * 400), "'tip': a landmark is three finite numbers"),
    "g.json": ('{"tip": [1, true, "3"]}', "'tip': a landmark is three finite numbers"),
    "h.csv": ("tip,1,2,3_0\n", "line 1: '3_0' is not a number|landmarks need the columns"),
    "i.csv": ('tip,1,2,3\n"a,1,2,3\n', "line 2: the row cannot be parsed"),
    "j.csv": ("tip,1,2,3\ntop,1,,3\n", "line 2: a landmark is three finite numbers"),
}


@pytest.mark.parametrize("name", BAD_MARKS)
def test_landmarks_that_cannot_be_read(tmp_path, name):
    text, words = BAD_MARKS[name]
    with pytest.raises(ScanError, match=words) as error:
        fitting.read_landmarks(put(tmp_path, name, text))
    assert name in str(error.value)


def test_landmarks_of_any_dialect(tmp_path):
    expected = {"the, tip": [1, 2.5, 3], "#2\nlow": [4, 5, 6]}
    texts = [
        'name,x,y,z\n"the, tip",1,2.5,3\n"#2\nlow",4,5,6\n',
        '"the, tip";1;2,5;3\n"#2\nlow";4;5;6\n',
        'no\tx [mm]\ty [mm]\tz [mm]\tlabel\n1\t1\t2.5\t3\t"the, tip"\n2\t4\t5\t6\t"#2\nlow"\n',
    ]
    for text in texts:
        marks = fitting.read_landmarks(put(tmp_path, "a.csv", text))
        assert {name: position.tolist() for name, position in marks.items()} == expected


# -------------------------------------------------------------------------------------------- counts that only announce

VTK = "# vtk DataFile Version {}\nx\n{}\nDATASET POLYDATA\nPOINTS {} float\n0 0 0 1 0 0 1 1 0 0 1 0\nPOLYGONS {}\n{}\n"
GII = '<GIFTI Version="1.0"><DataArray Intent="NIFTI_INTENT_POINTSET" DataType="NIFTI_TYPE_FLOAT32" Dim0="{}" Dim1="3" '
GII += 'ArrayIndexingOrder="RowMajorOrder" Encoding="{}" Dimensionality="9223372036854775808"><Data>{}</Data>'
GII += "</DataArray></GIFTI>"
HUGE = 2_000_000_000
ANNOUNCED = {
    "a.vtk": (VTK.format("3.0", "ASCII", 4, "200000 8", "3 0 1 2\n3 0 2 3"), "200000 cells are announced"),
    "b.vtk": (VTK.format("3.0", "ASCII", HUGE, "2 8", "3 0 1 2\n3 0 2 3"), "6000000000 numbers are announced"),
    "c.vtk": (VTK.format("!", "ASCII", 4, f"{HUGE} 24", "OFFSETS vtktypeint64"), "2000000000 numbers are announced"),
    "d.vtk": (VTK.format("5.1", "ASCII", 4, "3 6", "OFFSETS int\n0 3 9\nCONNECTIVITY int\n0 1 2 0 2 3"), "nor q"),
    "e.vtk": (VTK.format("3.0", "ASCII", 4, "1 4", "-3 0 1 2"), "1 cells are announced, but the 4 numbers hold 0"),
    "a.vtp": (XML.replace('Points="5"', f'Points="{HUGE}"'), "6000000000 numbers are announced, but there are 15"),
    "b.vtp": (XML.replace('Polys="1"', f'Polys="{HUGE}"'), "'offsets': 2000000000 numbers are announced"),
    "c.vtp": (XML.replace('Points="5"', 'Points="-5"'), "'NumberOfPoints' is '-5', which is no count"),
    "d.vtp": (XML.replace('">5<', '">-5<'), "there are|neither triangles nor quads"),
    "a.gii": (GII.format("-4", "ASCII", "0 0 0"), "its size is -4 x 3, where rows of three are expected"),
    "b.gii": (GII.format(HUGE, "GZipBase64Binary", "eJxjYGiwZ0ABMH7DfjRx"), "cannot unpack to the 24000000000"),
    "c.gii": (GII.format(1, "ExternalFileBinary", ""), "the encoding 'ExternalFileBinary' is not read"),
    "d.gii": ("<!DOCTYPE a [<!ENTITY b 'c'>]>" + GII.format(1, "ASCII", "0 0 0"), "it defines entities"),
    "a.ply": (PLY.replace("vertex 5", "vertex " + "9" * 5000) + LINES, "line 3: 'element vertex 99+' has no meaning"),
    "b.ply": (PLY.replace("list uchar", "list float") + LINES + "3.5 0 1 2\n", "line 8: 'property list float int"),
    "c.ply": (PLY.replace("vertex 5", f"vertex {HUGE}") + LINES, "announces 2000000000 rows of 'vertex', but only"),
    "a.off": (f"OFF\n{HUGE} 1 0\n{LINES}", "line 2: 2000000000 vertices and 1 faces are announced, but 5 rows follow"),
    "a.asc": (FREESURFER.replace("4 2\n", f"{HUGE} 2\n"), "2000000000 vertices|2000000000 faces|faces are announced"),
    "a.xyz": (f"{HUGE}\n1 2 3\n", "the first row announces 2000000000 rows, but 1 follow"),
}  # fmt: skip


@pytest.mark.parametrize("name", ANNOUNCED)
def test_counts_that_the_file_has_no_room_for(tmp_path, name):
    text, words = ANNOUNCED[name]
    with pytest.raises(MeshError, match=words) as error:
        (read_points if name == "a.xyz" else read_mesh)(put(tmp_path, name, text))
    assert str(error.value).startswith(name)


def test_garbled_version_of_vtk_and_dimensionality_of_gifti_do_no_harm(tmp_path):
    text = VTK.format("!5.1", "ASCII", 4, "3 6", "OFFSETS vtktypeint64\n0 3 6\nCONNECTIVITY vtktypeint64\n0 1 2 0 2 3")
    assert read_mesh(put(tmp_path, "a.vtk", text)).n_faces == 2
    assert len(read_points(put(tmp_path, "a.gii", GII.format(2, "ASCII", "0 0 0 1 1 1"))).points) == 2


def member(name: str, header: str, data: bytes = bytes(96)) -> tuple[str, bytes]:
    text = header.ljust(117).encode() + b"\n"
    return name, b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


HEADER = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"
MEMBERS = {
    "announces too much": (
        HEADER.format("'<f8'", "(99999999999, 3)"),
        "announces float64 of the shape .99999999999, 3",
    ),
    "overflows": (HEADER.format("'<f8'", "(4611686018427387904, 4)"), "announces float64"),
    "negative": (HEADER.format("'<f8'", "(-4, -3)"), "announces float64 of the shape|header cannot be read"),
    "objects": (HEADER.format("'|O'", "(4, 3)"), "it holds objects"),
    "dates": (HEADER.format("'<M8[ns]'", "(4, 3)"), "it holds dates"),
    "spans of time": (HEADER.format("'<m8[s]'", "(4, 3)"), "it holds spans of time"),
    "text": (HEADER.format("'<U2'", "(4, 3)"), "it holds text"),
    "records": (HEADER.format("[('a', '<f8')]", "(4, 3)"), "it holds '"),
    "no header": ("__import__('os')", "its header cannot be read"),
}


@pytest.mark.parametrize("name", MEMBERS)
def test_arrays_whose_headers_do_not_fit(tmp_path, name):
    header, words = MEMBERS[name]
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr(*member("points.npy", header))
    with pytest.raises(MeshError, match=rf"a\.npz: the array 'points': .*{words}"):
        read_points(tmp_path / "a.npz")


def test_archives_made_to_fill_memory_and_members_that_are_not_wanted(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, points=SQUARE, patient=np.array(["A"]), day=np.array(["2020-01-01"], "M8[D]"))
    assert len(read_points(path).points) == 4
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("points.npy", "w") as file:
        for _ in range(300):
            file.write(bytes(1 << 20))
    with pytest.raises(MeshError, match=r"a\.npz: .* announced to unpack to 314572800"):
        read_points(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr(*member("points.npy", HEADER.format("'<f8'", "(4, 3)")))
    with pytest.raises(MeshError, match="is packed in a way that numpy does not write"):
        read_points(path)


# ----------------------------------------------------------------------------------------------- topologies and recipes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda about: about["tables"].pop("levels"), "levels"),
        (lambda about: about["tables"].update(levels=3), "`levels` of Topology is not as it should be"),
        (lambda about: about["tables"].update(mesh_normals="yes"), "`mesh_normals` of Topology is not"),
        (lambda about: about["tables"].update(control_faces={"faces": 3}), "damaged"),
        (lambda about: about["tables"].update(kind=["Topology"]), "damaged"),
        (lambda about: about["tables"]["control_fans"].update(order={"array": "about"}), "damaged"),
    ],
)
def test_topologies_with_parts_of_other_kinds(tmp_path, change, words):
    path = tmp_path / "tables.npz"
    mesh = js.ControlMesh(SQUARE, [(0, 1, 2, 3)])
    js.save_topology(path, js.build_topology(mesh, js.CatmullClark(), 1))
    with np.load(path) as file:
        arrays = dict(file)
    about = json.loads(str(arrays["about"]))
    change(about)
    np.savez(path, **(arrays | {"about": np.array(json.dumps(about))}))
    with pytest.raises(ValueError, match=rf"tables\.npz: no saved topology.*{words}"):
        js.load_topology(path)
    np.savez(path, **(arrays | {"about": np.array("[" * 5000)}))
    with pytest.raises(ValueError, match=r"tables\.npz: no saved topology"):
        js.load_topology(path)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 5000,
        '{"scheme": {"name": "Loop"}, "levels": %s}' % ("9" * 5000),
        '{"scheme": {"name": ["Loop"]}, "levels": 2}',
        '{"scheme": {"name": "Loop"}, "levels": 2, "priors": {"bend": "%s"}}' % ("9" * 5000),
        '{"scheme": {"name": "Loop"}, "levels": 2, "tolerance": %s}' % ("9" * 400),
        '{"scheme": {"name": "Loop"}, "levels": 2, "priors": {"bend": %s}}' % ("9" * 400),
        '{"scheme": {"name": "Loop"}, "levels": 2, "free": {"vertices": {"a": [1, [2]]}}}',
        "\x00",
    ],
)
def test_recipes_that_are_none(tmp_path, text, as_users_run):
    with pytest.raises(ValueError, match=r"a\.json: "):
        fitting.load_recipe(put(tmp_path, "a.json", text))


# ----------------------------------------------------------------------------------------------------------- any damage


def test_damaged_files_end_nothing():
    """A few seconds of what `tests/fuzz/readers.py` does for as long as one likes."""
    script = Path(__file__).parent / "fuzz" / "readers.py"
    done = subprocess.run(
        [sys.executable, script, "--cases", "300", "--minutes", "3", "--seed", "7"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_sound_files_of_the_fuzzer_are_read(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "fuzz"))
    from seeds import seeds  # pyright: ignore[reportMissingImports]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for seed in seeds():
            seed.read(put(tmp_path, seed.name, seed.data))
