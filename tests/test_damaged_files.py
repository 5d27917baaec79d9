"""Counts without the room for them, archives made to fill memory, and files damaged at random."""

import json
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from files import put
from odd_files import FREESURFER, LINES, PLY, SQUARE, XML

import fitting
import jaxsubdiv as js
from jaxsubdiv import MeshError, read_mesh, read_points

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
