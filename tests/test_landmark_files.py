"""Landmarks in files of 3D Slicer and others, in the frame of their scan."""

import json

import meshes
import numpy as np
import pytest
from files import put
from landmark_files import FLIP, PLACES, same

import fitting
import jaxsubdiv as js
from fitting import ScanError, read_landmarks, write_landmarks
from jaxsubdiv.markups import SCHEMA

ENDINGS = ("a.mrk.json", "a.fcsv", "a.csv", "a.tsv")


@pytest.mark.parametrize("frame", ["LPS", "RAS"])
@pytest.mark.parametrize("name", ENDINGS)
def test_what_is_written_reads_back_bit_for_bit_in_either_frame(tmp_path, name, frame):
    write_landmarks(tmp_path / name, PLACES, frame=frame, deviations={"low": 0.25, "the, tip": 1.0})
    same(read_landmarks(tmp_path / name, frame=frame), PLACES)
    other = "RAS" if frame == "LPS" else "LPS"
    same(read_landmarks(tmp_path / name, frame=other), {label: at * FLIP for label, at in PLACES.items()})
    with pytest.warns(UserWarning, match=rf"{name}: positions are in {frame} \("):
        same(read_landmarks(tmp_path / name), PLACES)


@pytest.mark.parametrize(("name", "own"), [("a.json", "LPS"), ("a.fcsv", "LPS"), ("a.csv", None), ("a.tsv", None)])
def test_without_a_frame_a_table_says_none_and_files_of_slicer_say_its_own(tmp_path, name, own):
    write_landmarks(tmp_path / name, PLACES)
    same(read_landmarks(tmp_path / name, frame="LPS"), PLACES)
    turned = {label: at * FLIP for label, at in PLACES.items()} if own else PLACES
    same(read_landmarks(tmp_path / name, frame="RAS"), turned)


TABLES = {
    "LPS": "label,l,p,s,defined,selected,visible,locked,description\nF-1,1,2,3,1,1,1,0,\nF-2,4,5,6,1,1,1,0,a note\n",
    "RAS": '"label"\t"r"\t"a"\t"s"\t"defined"\t"selected"\n"F-1"\t1\t2\t3\t1\t1\n"F-2"\t4\t5\t6\t1\t0\n',
}


@pytest.mark.parametrize("frame", TABLES)
def test_tables_that_slicer_exports(tmp_path, frame):
    path = put(tmp_path, "a.csv", TABLES[frame])
    same(read_landmarks(path, frame=frame), {"F-1": [1, 2, 3], "F-2": [4, 5, 6]})
    other = "RAS" if frame == "LPS" else "LPS"
    same(read_landmarks(path, scale=2.0, frame=other), {"F-1": [-2, -4, 6], "F-2": [-8, -10, 12]})


def test_points_that_were_not_placed_and_columns_in_any_order(tmp_path):
    text = "defined,s,description,p,l,label\n1,3,a,2,1,F-1\n0,0,b,0,0,F-2\n1,6,c,5,4,\n"
    same(read_landmarks(put(tmp_path, "a.csv", text), frame="LPS"), {"F-1": [1, 2, 3], "2": [4, 5, 6]})


def test_file_of_slicer_has_what_it_needs(tmp_path):
    write_landmarks(tmp_path / "a.mrk.json", PLACES, frame="RAS", deviations={"low": 0.25, "the, tip": 1.0})
    content = json.loads((tmp_path / "a.mrk.json").read_text())
    (markup,) = content["markups"]
    assert content["@schema"] == SCHEMA and markup["type"] == "Fiducial"
    assert (markup["coordinateSystem"], markup["coordinateUnits"]) == ("RAS", "mm")
    assert [point["description"] for point in markup["controlPoints"]] == [
        "standard deviation 1 mm",
        "standard deviation 0.25 mm",
    ]
    assert all(point["positionStatus"] == "defined" for point in markup["controlPoints"])


def test_units_that_are_millimetres_in_more_words(tmp_path):
    markup = {"coordinateUnits": ["mm", "UCUM", "millimeter"], "controlPoints": [{"label": "a", "position": [1, 2, 3]}]}
    same(read_landmarks(put(tmp_path, "a.json", json.dumps({"markups": [markup]})), frame="LPS"), {"a": [1, 2, 3]})
    markup["coordinateUnits"] = "um"
    with pytest.warns(UserWarning, match=r"a\.json: positions are in 'um', as the file says; `scale` turns them"):
        read_landmarks(put(tmp_path, "a.json", json.dumps({"markups": [markup]})), frame="LPS")


BAD = {
    "a.csv": ("name,x,y,q\na,1,2,3\n", r"a\.csv, line 1: landmarks need the columns name, x, y and z; or l, p and s"),
    "b.csv": ("name,x,y,z,frame\na,1,2,3,LPS\nb,1,2,3,RAS\n", r"b\.csv: it holds control points in LPS and RAS"),
    "c.csv": ("name,x,y,z,frame\na,1,2,3,IJK\n", r"c\.csv: the frame 'IJK' is not known; it must be LPS or RAS"),
    "d.tsv": ("label\tl\tp\ts\na\t1\t2\n", r"d\.tsv, line 2: 3 columns, where the first row has 4"),
    "e.csv": ("label,r,a,s,defined\na,1,2,3,0\n", r"e\.csv holds no landmarks"),
}


@pytest.mark.parametrize("name", BAD)
def test_refuses_tables(tmp_path, name):
    text, words = BAD[name]
    with pytest.raises(ScanError, match=words):
        read_landmarks(put(tmp_path, name, text))


def test_refuses_to_write(tmp_path):
    with pytest.raises(
        ScanError, match=r"landmarks are written to \.json, \.csv, \.tsv and \.fcsv files, not to \.txt"
    ):
        write_landmarks(tmp_path / "a.txt", PLACES)
    with pytest.raises(ScanError, match=r"a\.csv: the landmarks low are not three finite numbers"):
        write_landmarks(tmp_path / "a.csv", {"tip": [1, 2, 3], "low": [1, 2, np.nan]})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("frame", ["LPS", "RAS", None])
@pytest.mark.parametrize("name", ["a.ply", "a.obj", "a.stl", "a.vtk", "a.off"])
@pytest.mark.parametrize("size", [1.0, 1 / 3], ids=["single", "double"])  # of two kinds of STL
def test_meshes_say_their_frame_to_slicer(tmp_path, name, frame, size):
    vertices, faces = meshes.tetrahedron()
    js.write_mesh(tmp_path / name, js.ControlMesh(vertices * size, faces), frame=frame)
    known = None if name == "a.off" else frame
    assert js.read_frame(tmp_path / name) == fitting.read_scan(tmp_path / name).frame == known
    assert js.read_mesh(tmp_path / name).n_faces == len(faces)


OF_SLICER = {
    "a.ply": "ply\nformat ascii 1.0\ncomment VTK generated PLY File\ncomment SPACE=RAS\nobj_info vtkPolyData\n",
    "a.obj": "# 3D Slicer output. SPACE=RAS\nv 0 0 0\n",
    "a.vtk": "# vtk DataFile Version 5.1\n3D Slicer output. SPACE=RAS\nASCII\nDATASET POLYDATA\n",
    "a.stl": "3D Slicer output. SPACE=RAS".ljust(80, "\0") + "\0\0\0\0",
}


@pytest.mark.parametrize("name", OF_SLICER)
def test_headers_of_slicer(tmp_path, name):
    assert js.read_frame(put(tmp_path, name, OF_SLICER[name])) == "RAS"


def test_only_comments_say_a_frame(tmp_path):
    assert js.read_frame(put(tmp_path, "a.obj", "g SPACE=RAS\nv 0 0 0\n")) is None
    assert js.read_frame(put(tmp_path, "a.obj", "# SPACE=IJK\nv 0 0 0\n")) is None
    assert js.read_frame(put(tmp_path, "a.obj", "# WORKSPACE=RAS\nv 0 0 0\n")) is None


def test_control_points_say_their_frame(tmp_path):
    write_landmarks(tmp_path / "a.mrk.json", PLACES, frame="RAS")
    assert js.read_frame(tmp_path / "a.mrk.json") == "RAS"
