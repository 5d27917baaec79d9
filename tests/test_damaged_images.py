"""Images that are damaged, or none: each is refused by what is wrong with it."""

import gzip
import re
import struct
import subprocess
import sys
import time
import warnings
import zlib
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
from voxels import SHAPE

import fitting


def damaged(path: Path, head: bytes) -> None:
    path.write_bytes(gzip.compress(head) if path.suffix == ".gz" else head)


NIFTI = struct.pack("<i36x8h14xhh36xf", 348, 3, 2000, 2000, 2000, 1, 1, 1, 1, 2, 8, 352.0).ljust(344, b"\0") + b"n+1\0"


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.nii", b"not an image at all", "does not begin as a NIfTI"),
        ("a.nii", NIFTI, "8,000,000,000 bytes of voxels, and the file has 348"),
        ("a.nii.gz", NIFTI, "8,000,000,000 bytes of voxels, and"),
        ("a.nii.gz", b"\x1f\x8b\x08garbage", "does not begin|damaged"),
        ("a.nrrd", b"NRRD0004\ntype: short\ndimension: 3\n", "does not begin as a NRRD"),
        (
            "a.nrrd",
            b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 4000 4000 4000\nencoding: raw\nspace: LPS\n"
            b"space directions: (1,0,0) (0,1,0) (0,0,1)\n\nxx",
            "64,000,000,000 bytes",
        ),
        (
            "a.nrrd",
            b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n12345678",
            "direction in space",
        ),
        (
            "a.nrrd",
            b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: /etc/passwd\n\n",
            "another file",
        ),
        ("a.mha", b"ObjectType = Image\nNDims = 3\n", "no line 'ElementDataFile"),
        ("a.mha", b"NDims = 3\nDimSize = 9 9 9\nElementType = MET_UCHAR\nElementDataFile = LOCAL\nx", "729 bytes"),
        (
            "a.mha",
            b"NDims = 3\nDimSize = 9 9\nElementType = MET_UCHAR\nElementDataFile = LOCAL\nx",
            "3 numbers .*DimSize",
        ),
        ("a.mha", b"NDims = 3\nDimSize = 1 1 1\nElementType = MET_RGB\nElementDataFile = LOCAL\nx", "one number each"),
        (
            "a.mhd",
            b"NDims = 3\nDimSize = 1 1 1\nElementType = MET_CHAR\nElementDataFile = ../a.raw\n",
            "one file beside",
        ),
        ("a.mhd", b"NDims = 3\nDimSize = 1 1 1\nElementType = MET_CHAR\nElementDataFile = a.raw\n", "not beside it"),
        ("a.dcm", b"\0" * 128 + b"DICM", "no DICOM segmentation"),
    ],
)
def test_damaged_images_are_refused_by_name(tmp_path, name, content, text):
    damaged(tmp_path / name, content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pynrrd and pydicom, on their way to the error
        with pytest.raises(fitting.ScanError, match=f"^{name}: .*({text})"):
            fitting.read_volume(tmp_path / name)


def nifti(path: Path, values: np.ndarray, axes: np.ndarray | None = None, extension: tuple[int, bytes] | None = None):
    """A NIfTI file as it should be, to be damaged."""
    image = nibabel.Nifti2Image(values, np.eye(4) if axes is None else axes)
    if extension is not None:
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension(*extension))
    nibabel.save(image, path)
    return image


def nrrd_file(path: Path, values: np.ndarray, changes: dict[str, str], encoding: str = "raw") -> None:
    """An NRRD file, and then other lines in its header."""
    header = {"space": "LPS", "space directions": np.eye(3), "space origin": np.zeros(3), "encoding": encoding}
    nrrd.write(str(path), values, header)
    head, voxels = path.read_bytes().split(b"\n\n", 1)
    lines = [line for line in head.decode().split("\n") if line.split(":")[0] not in changes]
    lines += [f"{name}: {value}" for name, value in changes.items() if value]
    path.write_bytes("\n".join(lines).encode() + b"\n\n" + voxels)


def test_a_suffix_must_say_whether_a_nifti_file_is_packed(tmp_path):
    nifti(tmp_path / "a.nii", np.ones(SHAPE, np.uint8))
    nifti(tmp_path / "b.nii.gz", np.ones(SHAPE, np.uint8))
    for old, new, text in (("a.nii", "a.nii.gz", "not packed .*to .nii"), ("b.nii.gz", "b.nii", "packed .*to .nii.gz")):
        (tmp_path / old).rename(tmp_path / new)
        with pytest.raises(fitting.ScanError, match=f"^{new}: it is {text}"):
            fitting.read_volume(tmp_path / new)


def test_a_header_of_a_pair_is_refused(tmp_path):
    (tmp_path / "a.nii").write_bytes(NIFTI.replace(b"n+1", b"ni1") + bytes(8))
    with pytest.raises(fitting.ScanError, match=r"^a.nii: .*another file with the voxels, .img"):
        fitting.read_volume(tmp_path / "a.nii")


@pytest.mark.parametrize("values", [np.zeros(SHAPE, np.complex64), np.zeros(SHAPE, [(n, "u1") for n in "RGB"])])
def test_colours_and_complex_numbers_are_refused(tmp_path, values):
    nifti(tmp_path / "a.nii", values)
    with pytest.raises(fitting.ScanError, match=r"^a.nii: its voxels are of the type \d+; .*one number each"):
        fitting.read_volume(tmp_path / "a.nii")


def test_the_room_for_voxels_is_that_of_their_type(tmp_path):
    head = bytearray(NIFTI + bytes(4))
    struct.pack_into("<3h", head, 42, 10, 10, 4)
    struct.pack_into("<2h", head, 70, 64, 1)  # numbers of 64 bits, which the next field says are of one
    (tmp_path / "a.nii").write_bytes(head)
    with pytest.raises(fitting.ScanError, match="3,200 bytes of voxels, and the file has 352"):
        fitting.read_volume(tmp_path / "a.nii")


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e300, 0.5])
def test_numbers_that_are_no_labels_are_refused_as_such(tmp_path, value):
    values = np.zeros(SHAPE)
    values[2:5, 2:5, 2:5] = value
    nifti(tmp_path / "a.nii", values)
    volume = fitting.read_volume(tmp_path / "a.nii")
    with pytest.raises(fitting.ScanError, match="it is an image and no label map: give --above"):
        fitting.find_labels(volume)
    if value != 0.5:
        with pytest.raises(fitting.ScanError, match="27 voxels of the image are not finite, or far too large"):
            fitting.scan_above(volume, 0.1)


def test_few_large_values_are_labels_and_are_counted(tmp_path):
    values = np.zeros((80, 70, 60), np.int32)  # counted in more than one part
    values[2:5, 2:5, 2:5], values[7:70, 6, 5] = 7, 2_000_000_000
    volume = fitting.Volume((values,), np.eye(4), None)
    assert [(one.label.value, one.voxels) for one in fitting.find_labels(volume)] == [(7, 27), (2_000_000_000, 63)]


@pytest.mark.parametrize("axes", [np.diag([1e200, 1, 1, 1]), np.diag([1e-9, 1, 1, 1]), np.eye(4)[[0, 1, 1, 3]]])
def test_voxels_must_have_a_size(tmp_path, axes):
    image = nifti(tmp_path / "a.nii", np.ones(SHAPE, np.uint8))
    data = bytearray((tmp_path / "a.nii").read_bytes())
    at = data.index(np.asarray(image.affine[:3], "<f8").tobytes())
    data[at : at + 96] = np.asarray(axes[:3], "<f8").tobytes()
    (tmp_path / "a.nii").write_bytes(data)
    with pytest.raises(fitting.ScanError, match=r"^a.nii: its voxels have no size: the axes are "):
        fitting.read_volume(tmp_path / "a.nii")


@pytest.mark.parametrize(
    "extension",
    [(0, b"<Label " * 200_000), (0, b"<Label " + b'Key="1" ' * 200_000), (2, b"no DICOM" * 20), (32, b"<CIFTI")],
    ids=["no end", "many keys", "DICOM", "CIFTI"],
)
def test_texts_in_a_header_take_no_time(tmp_path, extension):
    nifti(tmp_path / "a.nii", np.ones(SHAPE, np.uint8), None, (0, extension[1]))
    data = bytearray((tmp_path / "a.nii").read_bytes())
    struct.pack_into("<i", data, 548, extension[0])
    (tmp_path / "a.nii").write_bytes(data)
    began = time.perf_counter()
    try:
        assert fitting.read_volume(tmp_path / "a.nii").labels == ()
    except fitting.ScanError as error:
        assert str(error).startswith("a.nii: it is no NIfTI file, or damaged: ")
    assert time.perf_counter() - began < 5


def test_names_are_printable(tmp_path):
    header = {
        "space": "LPS",
        "space directions": np.eye(3),
        "Segment0_Name": "K-pfchen",
        "Segment1_Name": "a\x1b[31m",
    }
    path = tmp_path / "a.seg.nrrd"
    nrrd.write(str(path), np.ones(SHAPE, np.uint8), header)
    head, voxels = path.read_bytes().split(b"\n\n", 1)
    path.write_bytes(re.sub(rb"K.*pfchen", "Köpfchen".encode(), head) + b"\n\n" + voxels)
    names = [label.name for label in fitting.read_volume(path).labels]
    assert names[0] == "Köpfchen" and names[1] == "a [31m"


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2", "ascii"])
@pytest.mark.parametrize("dtype", ["<i2", ">i2", "u1", "f4"])
def test_every_encoding_is_read(tmp_path, encoding, dtype):
    values = np.zeros((60, 70, 80), dtype)  # packs so well that its size looks too small for it
    values[2:5, 3:9, 4] = 300 if dtype.endswith("i2") else 7
    nrrd_file(tmp_path / "a.nrrd", values, {}, encoding)
    np.testing.assert_array_equal(fitting.read_volume(tmp_path / "a.nrrd").layers[0], values)


@pytest.mark.parametrize(
    ("encoding", "changes", "text"),
    [
        ("gzip", {"sizes": "9 8 9000000"}, "announces 1,296,000,000 bytes"),
        ("gzip", {"sizes": "9 8 9"}, "ends after 1,008 of 1,296 bytes"),
        ("bzip2", {"sizes": "9 8 9"}, "ends after 1,008 of 1,296 bytes"),
        ("raw", {"sizes": "9 8 0"}, r"the sizes \[9, 8, 0\]"),
        ("raw", {"sizes": "-9 -8 7"}, r"the sizes \[-9, -8, 7\]"),
        ("raw", {"sizes": "9 56"}, "dimension 3"),
        ("raw", {"encoding": "hex"}, "the encoding 'hex'"),
        ("gzip", {"encoding": "bzip2"}, "cannot be unpacked"),
        ("raw", {"encoding": "ascii"}, "no numbers|ends after"),
        ("raw", {"type": "block"}, "the type 'block'"),
        ("raw", {"endian": ""}, "'endian: None'"),
        ("raw", {"line skip": "2000000000"}, "ends after 0"),
        ("raw", {"byte skip": "-7"}, "skips 0 lines and -7 bytes"),
        ("raw", {"byte skip": "2000000000"}, "ends after 0"),
        ("gzip", {"byte skip": "-1"}, "skips 0 lines and -1 bytes"),
    ],
)
def test_damaged_nrrd_files_are_refused(tmp_path, encoding, changes, text):
    nrrd_file(tmp_path / "a.nrrd", np.arange(504, dtype=np.int16).reshape(SHAPE), changes, encoding)
    with pytest.raises(fitting.ScanError, match=f"^a.nrrd: .*({text})"):
        fitting.read_volume(tmp_path / "a.nrrd")


def test_damaged_meta_images_are_refused(tmp_path):
    head = "NDims = 3\nDimSize = 9 9 9\nElementType = MET_UCHAR\n{}ElementDataFile = {}\n"
    packed = zlib.compress(bytes(729))
    path = tmp_path / "a.mha"
    path.write_bytes(head.format("CompressedData = True\nHeaderSize = -1\n", "LOCAL").encode() + packed)
    assert fitting.read_volume(path).layers[0].shape == (9, 9, 9)
    path.write_bytes(head.format("", "9" * 5000).encode())
    with pytest.raises(fitting.ScanError, match=r"^a.mha: its voxels are in '9{60}', which is not beside it"):
        fitting.read_volume(path)


def test_images_have_one_layer():
    grey = np.random.default_rng(0).normal(size=SHAPE)
    with pytest.raises(fitting.ScanError, match="it has 2 layers, and an image has one"):
        fitting.scan_above(fitting.Volume((grey, grey), np.eye(4), None), 0.0)


def test_a_nifti_file_must_say_where_it_lies(tmp_path):
    image = nibabel.Nifti1Image(np.ones(SHAPE, np.uint8), None)
    image.header["sform_code"] = image.header["qform_code"] = 0
    nibabel.save(image, tmp_path / "a.nii")
    with pytest.raises(fitting.ScanError, match=r"a.nii: it does not say where its voxels lie"):
        fitting.read_volume(tmp_path / "a.nii")


def test_series_are_refused(tmp_path):
    nibabel.save(nibabel.Nifti1Image(np.ones((3, 3, 3, 2), np.uint8), np.eye(4)), tmp_path / "a.nii")
    with pytest.raises(fitting.ScanError, match=r"\[3, 3, 3, 2\]; one volume"):
        fitting.read_volume(tmp_path / "a.nii")


def test_a_row_of_voxels_is_refused_before_it_is_read(tmp_path):
    head = bytearray(NIFTI + bytes(4))
    struct.pack_into("<3h", head, 42, 1, 1, 30_000)
    (tmp_path / "a.nii").write_bytes(head)  # the voxels are missing
    with pytest.raises(fitting.ScanError, match=r"^a.nii: it has \[1, 1, 30000\] voxels, which is no volume"):
        fitting.read_volume(tmp_path / "a.nii")


def test_importing_loads_no_library_of_images():
    code = (
        "import sys, fitting, jaxsubdiv\n"
        "assert not {'nibabel', 'nrrd', 'highdicom', 'pydicom', 'SimpleITK', 'pyvista', 'matplotlib'} "
        "& set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["kidney_left_ct", "liver_ct", "pulmonary_artery_ct", "spine_ct"])
def test_real_label_maps(shared_data, name):
    volume = fitting.read_volume(shared_data / "labels" / f"{name}.nii.gz")
    for one in fitting.find_labels(volume):
        scan = fitting.scan_of_label(volume, one.label)
        assert scan.n_points > 100 and scan.frame == "RAS"
        size = np.ptp(np.asarray(scan.points), axis=0)
        assert (size > 5).all() and (size < 300).all()


def test_a_real_knee(shared_data):
    volume = fitting.read_volume(shared_data / "labels" / "knee_mri.nrrd")
    found = fitting.find_labels(volume)
    assert volume.frame == "LPS" and len(found) == 10
    femur = max(found, key=lambda one: one.voxels)
    assert 130 < femur.voxels * volume.voxel_volume / 1000 < 150  # ml
