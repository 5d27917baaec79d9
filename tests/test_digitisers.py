"""Head shapes and places of digitisers."""

import numpy as np
import pytest
from files import ROWS, lines, put

from fitting import read_scan
from jaxsubdiv import MeshError, read_mesh, read_points

HEAD = (
    "//Position of fiducials X+, Y+, Y- on the subject\n%F\t0.11\t0\t0\n%F\t-0.003\t0.0786\t0\n%F\t0.003\t-0.0801\t0\n"
)
SHAPE = "3\t200\n//Shape file\n//Minor revision number\n2\n//Subject Name\n%N\tName    \n////Shape code, number of "
SHAPE += (
    f"digitized points\n0\t30\n{HEAD}//No of rows, no of columns; position of digitized points\n30\t3\n{lines(ROWS)}"
)
FIDUCIALS = [(0.11, 0, 0), (-0.003, 0.0786, 0), (0.003, -0.0801, 0)]
PROBE = "3\t2\n//Probe file\n//Minor revision number\n1\n//ProbeName\n%N\tName\n//Probe type, number of sensors\n0\t2\n"
PROBE += (
    "//Position of fiducials X+, Y+, Y- on the subject\n%F\t0.11\t0\t0\n%F\t-0.003\t0.0786\t0\n%F\t0.003\t-0.0801\t0\n"
)
PROBE += (
    "//Sensor type\n%S\t4000\n//Sensor name and data for sensor # 1\n%N\tRED  \n0.09\t-0.01\t0.02\n%S\t4000\n%N\tBLUE\n"
)
PROBE += "-0.09\t1e-2\t0.03\n"
POS = "3\n1 4.5 6.1 7.8\n2 1 2 3\n3 4 5 6\nnasion 10.5 0 0\n"


def test_head_shapes_of_a_digitiser(tmp_path):
    with pytest.warns(
        UserWarning, match=r"a\.hsp: \.hsp files are in metres as a rule; a scale of 1000 takes these to mm"
    ):
        cloud = read_points(put(tmp_path, "a.hsp", SHAPE))
    np.testing.assert_allclose(cloud.points, [*FIDUCIALS, *ROWS], rtol=1e-6)
    np.testing.assert_allclose(
        read_scan(tmp_path / "a.hsp", scale=1000.0, labels="head").points, 1000 * ROWS, rtol=1e-6
    )
    np.testing.assert_allclose(read_scan(tmp_path / "a.hsp", scale=1000.0, labels="nasion").points, [(110, 0, 0)])


def test_probes_of_a_digitiser(tmp_path):
    path = put(tmp_path, "a.elp", PROBE)
    np.testing.assert_allclose(read_points(path, scale=1000).points[3:], [(90, -10, 20), (-90, 10, 30)])
    np.testing.assert_allclose(read_scan(path, scale=1000.0, labels="blue").points, [(-90, 10, 30)], rtol=1e-6)
    with pytest.warns(UserWarning, match=r"\.elp files are in metres"):
        np.testing.assert_allclose(read_points(path).points[:3], FIDUCIALS)


@pytest.mark.parametrize(
    "text", [POS, POS.replace("3\n1", "4\n1"), POS.removeprefix("3\n"), "1 E1 1 2 3\n2 E2 4 5 6\n"]
)
def test_places_of_a_digitiser(tmp_path, text):
    path = put(tmp_path, "a.pos", text)
    with pytest.warns(UserWarning, match=r"\.pos files are in centimetres as a rule; a scale of 10 takes"):
        points = read_points(path).points
    np.testing.assert_allclose(points[:2], [(4.5, 6.1, 7.8), (1, 2, 3)] if len(points) == 4 else [(1, 2, 3), (4, 5, 6)])
    label = "nasion" if len(points) == 4 else "E2"
    np.testing.assert_allclose(read_scan(path, scale=10.0, labels=label).points, 10 * points[-1:])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.hsp", SHAPE[:-20], "line 44: .* should be three numbers|30 points are announced, but 29 follow"),
        ("a.hsp", SHAPE.replace("30\t3\n", "200000000\t3\n"), "200000000 points are announced, but 30 follow"),
        ("a.hsp", SHAPE.replace("30\t3\n", "30\t4\n"), "line 14: the number of points must stand here"),
        ("a.hsp", SHAPE.replace("%F\t0.11", "%F\tnose"), "line 10: 'nose 0 0' should be three numbers"),
        ("a.hsp", SHAPE.partition("30\t3")[0], "line 14: the number of points"),
        ("a.hsp", SHAPE.partition("\n30\t3")[0], "line 14: the number of points"),
        ("a.hsp", lines(ROWS), "line 1: a head shape of a Polhemus digitiser begins with '3 200'"),
        ("a.elp", "EEG Fp1 -92 -72\n", "line 1: .* angles of BESA give no positions"),
        ("a.elp", PROBE + "1 2 3 4\n", "line 21: '1 2 3 4' should be three numbers"),
        ("a.elp", "3\t2\n", "it holds no points"),
        ("a.pos", POS + "1 2 3\n", "line 6: 3 words, where a number or a name"),
        ("a.pos", POS + "5 1 2 x\n", "line 6: '1 2 x' should be three numbers"),
        ("a.pos", "9" + POS, "93 points are announced, but 4 follow"),
    ],
)
def test_files_of_a_digitiser_that_are_damaged(tmp_path, name, content, words):
    with pytest.raises(MeshError, match=words) as caught:
        read_points(put(tmp_path, name, content), scale=1000)
    assert str(caught.value).startswith(name)


@pytest.mark.parametrize("name", ["a.pcd", "a.pts", "a.hsp", "a.elp", "a.pos", "a.particles"])
def test_points_are_no_mesh(tmp_path, name):
    with pytest.raises(MeshError, match=r"files hold points without faces. Read it with `read_points`"):
        read_mesh(put(tmp_path, name, "hello"))
