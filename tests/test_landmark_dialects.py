"""Control points of 3D Slicer in every frame and version."""

import json

import numpy as np
import pytest
from files import put

import fitting
from fitting import ScanError
from jaxsubdiv import read_points


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
