"""Label maps and images: where their voxels lie, what their boundary says, and what is fitted to it."""

import gzip
import re
import struct
import subprocess
import sys
import time
import warnings
import zlib
from pathlib import Path

import highdicom
import nibabel
import nrrd
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.sr.codedict import codes
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit_command
from fitting.image.volume import mask_of
from fitting.start.mesh_topology import MeshTopology, face_topology
from jaxsubdiv.frames import convert_frame

SHAPE, SPACING = (9, 8, 7), np.array([0.5, 1.25, 3.0])
TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
MARKED = (6, 2, 3)
RADII = np.array([20.0, 15.0, 12.0])
MIDDLE = np.array([31.0, -42.0, 17.0])


def itk_image(values: np.ndarray, directions: np.ndarray = TURN) -> sitk.Image:
    """An image as ITK has it, in LPS: oblique, with three spacings, far from the origin."""
    image = sitk.GetImageFromArray(values.transpose(2, 1, 0))
    image.SetSpacing(SPACING.tolist())
    image.SetDirection(directions.ravel().tolist())
    image.SetOrigin([-31.0, 12.5, 204.0])
    return image


@pytest.mark.parametrize("suffix", [".nii.gz", ".nii", ".nrrd", ".mha", ".mhd"])
@pytest.mark.parametrize(
    "directions", [TURN, TURN * [-1, 1, 1], np.eye(3)[[2, 0, 1]]], ids=["oblique", "left", "turned"]
)
@pytest.mark.parametrize("packed", [False, True], ids=["plain", "packed"])
def test_a_voxel_lies_where_itk_says(tmp_path, suffix, directions, packed):
    values = np.zeros(SHAPE, np.int16)
    values[MARKED] = 3
    image = itk_image(values, directions)
    sitk.WriteImage(image, str(tmp_path / f"image{suffix}"), packed)

    volume = fitting.read_volume(tmp_path / f"image{suffix}")

    assert volume.frame == ("RAS" if suffix.startswith(".nii") else "LPS")
    (index,) = np.argwhere(volume.layers[0] == 3)
    place = convert_frame(volume.positions(index.astype(float)), volume.frame, "LPS")
    np.testing.assert_allclose(place, image.TransformIndexToPhysicalPoint(MARKED), atol=1e-4)  # NIfTI: single precision
    np.testing.assert_allclose(volume.indices(volume.positions(np.eye(3))), np.eye(3), atol=1e-9)
    assert fitting.choose_label(volume, None) == fitting.Label(3, "")


def test_a_segmentation_of_slicer_has_names_layers_and_a_cropped_box(tmp_path):
    layers = np.zeros((2, *SHAPE), np.uint8)
    layers[0, 2:7, 2:6, 2:6], layers[1, 3:5, 3:5, 3:5] = 1, 1
    header = {
        "space": "left-posterior-superior",
        "space directions": np.array([[np.nan] * 3, *np.diag(SPACING)]),
        "space origin": np.array([10.0, 20.0, 30.0]),
        "kinds": ["list", "domain", "domain", "domain"],
        "Segment0_Name": "left kidney",
        "Segment0_LabelValue": "1",
        "Segment0_Layer": "0",
        "Segment1_Name": "cyst",
        "Segment1_LabelValue": "1",
        "Segment1_Layer": "1",
        "Segmentation_ReferenceImageExtentOffset": "4 0 7",
    }
    nrrd.write(str(tmp_path / "a.seg.nrrd"), layers, header)

    volume = fitting.read_volume(tmp_path / "a.seg.nrrd")

    found = fitting.find_labels(volume)
    assert [(one.label.name, one.voxels) for one in found] == [("left kidney", 80), ("cyst", 8)]
    assert volume.layers[0].shape == (11, 9, 9)  # background on all sides but where the image begins
    first = np.argwhere(volume.layers[0]).min(axis=0).astype(float)
    np.testing.assert_allclose(volume.positions(first), [10, 20, 30] + np.array([2, 2, 2]) * SPACING)
    assert fitting.choose_label(volume, "CYST").layer == 1
    with pytest.raises(fitting.ScanError, match=r"no voxel has the label 'spleen'.*1 left kidney"):
        fitting.choose_label(volume, "spleen")
    with pytest.raises(fitting.ScanError, match="several labels are called '1'"):
        fitting.choose_label(volume, 1)


def test_names_of_a_nifti_file_are_those_of_its_table(tmp_path):
    values = np.zeros(SHAPE, np.uint8)
    values[2:5, 2:5, 2:5], values[6, 6, 5] = 7, 9
    image = nibabel.Nifti1Image(values, np.diag([*SPACING, 1]))
    table = b'<CaretExtension><LabelTable><Label Key="7" Red="0"><![CDATA[left &amp; right]]></Label></LabelTable>'
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, table))
    nibabel.save(image, tmp_path / "a.nii.gz")

    found = fitting.find_labels(fitting.read_volume(tmp_path / "a.nii.gz"))

    assert [str(one.label) for one in found] == ["7 left & right", "9"]


def test_a_nifti_file_in_metres_is_read_in_mm(tmp_path):
    image = nibabel.Nifti1Image(np.ones(SHAPE, np.uint8), np.diag([*SPACING / 1000, 1]))
    image.header.set_xyzt_units("meter")
    nibabel.save(image, tmp_path / "a.nii")
    np.testing.assert_allclose(fitting.read_volume(tmp_path / "a.nii").spacing, SPACING, rtol=1e-6)


@pytest.mark.filterwarnings("ignore:The string")  # what highdicom thinks of the patient's name
@pytest.mark.parametrize(("overlap", "kind"), [(False, "BINARY"), (True, "BINARY"), (False, "FRACTIONAL")])
def test_a_dicom_segmentation(tmp_path, overlap, kind):
    mask = np.zeros((6, 20, 16, 2), np.uint8 if kind == "BINARY" else np.float32)
    mask[2:4, 5:15, 4:12, 0], mask[3, 7, 5 if overlap else 3, 1] = 1, 1
    if kind == "FRACTIONAL":
        mask[2, 0, 0, 0], mask[2, 0, 1, 0] = 0.2, 0.6
    segments = [
        highdicom.seg.SegmentDescription(
            n, name, codes.SCT.Organ, codes.SCT.Liver, highdicom.seg.SegmentAlgorithmTypeValues.MANUAL
        )
        for n, name in ((1, "liver"), (2, "vessel"))
    ]
    uid = pydicom.uid.generate_uid
    made = highdicom.seg.Segmentation(
        dicom_slices(6, 20, 16), mask, kind, segments, uid(), 1, uid(), 1, "maker", "model", "1", "0"
    )
    made.save_as(tmp_path / "a.dcm")

    volume = fitting.read_volume(tmp_path / "a.dcm")

    assert volume.frame == "LPS"
    assert len(volume.layers) == (1 if kind == "BINARY" and not overlap else 2)
    assert all(layer.itemsize == 1 for layer in volume.layers)
    liver = 160 + (kind == "FRACTIONAL")
    assert [(one.label.name, one.voxels) for one in fitting.find_labels(volume)] == [("liver", liver), ("vessel", 1)]
    index = np.argwhere(mask_of(volume, fitting.choose_label(volume, "vessel"))).astype(float)
    column = 5 if overlap else 3
    np.testing.assert_allclose(volume.positions(index), [[10 + column * 1.5, -20 + 7 * 2.0, 30 + 3 * 3.0]])
    assert volume.layers[0].shape == (4, 20, 16)  # empty slices are not stored


def dicom_slices(n: int, rows: int, columns: int) -> list[pydicom.Dataset]:
    """Slices of a CT, 3 mm apart, of pixels of 2 x 1.5 mm."""
    study, series, frame = (pydicom.uid.generate_uid() for _ in range(3))
    slices = []
    for k in range(n):
        one = pydicom.Dataset()
        one.file_meta = pydicom.dataset.FileMetaDataset()
        one.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
        one.SOPClassUID = one.file_meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
        one.SOPInstanceUID = pydicom.uid.generate_uid()
        one.StudyInstanceUID, one.SeriesInstanceUID, one.FrameOfReferenceUID = study, series, frame
        for empty in ("PatientBirthDate", "PatientSex", "AccessionNumber", "StudyDate", "StudyTime"):
            setattr(one, empty, "")
        one.ReferringPhysicianName = one.PositionReferenceIndicator = ""
        one.Modality, one.PatientID, one.PatientName, one.StudyID = "CT", "1", "A^B", "1"
        one.SeriesNumber, one.InstanceNumber = 1, k + 1
        one.Rows, one.Columns, one.PixelSpacing, one.SliceThickness = rows, columns, [2.0, 1.5], 3.0
        one.ImageOrientationPatient, one.ImagePositionPatient = [1, 0, 0, 0, 1, 0], [10.0, -20.0, 30.0 + 3 * k]
        one.SamplesPerPixel, one.PhotometricInterpretation, one.PixelRepresentation = 1, "MONOCHROME2", 0
        one.BitsAllocated = one.BitsStored = 16
        one.HighBit, one.PixelData = 15, bytes(2 * rows * columns)
        slices.append(one)
    return slices


# ------------------------------------------------------------------------------------------------------ the boundary


def ellipsoid(spacing: float | np.ndarray = 2.0, cut: float = 0.0) -> tuple[fitting.Volume, np.ndarray]:
    """A label map of an ellipsoid, oblique to the voxels, and how far inside each voxel lies, 1 in the middle, 0 at the
    surface; `cut` is the part of the image that is missing at the end of the first index."""
    spacing = np.resize(spacing, 3).astype(float)
    n = np.ceil(60 / spacing).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = TURN * spacing
    affine[:3, 3] = MIDDLE - TURN @ (spacing * (n - 1) / 2) + 0.2
    n[0] = int(n[0] * (1 - cut))
    index = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), axis=-1).reshape(-1, 3)
    inside = 1 - np.linalg.norm((index @ affine[:3, :3].T + affine[:3, 3] - MIDDLE) / RADII, axis=1)
    inside = inside.reshape(tuple(n))
    return fitting.Volume(((inside > 0).astype(np.uint8),), affine, "RAS"), inside


def off_ellipsoid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances from it, to first order, and its normals."""
    own = (points - MIDDLE) / RADII
    slope = own / RADII
    return (np.linalg.norm(own, axis=1) - 1) * np.linalg.norm(own, axis=1) / np.linalg.norm(slope, axis=1), (
        slope / np.linalg.norm(slope, axis=1, keepdims=True)
    )


@pytest.mark.parametrize("spacing", [2.0, 1.0, np.array([1.0, 1.0, 4.0])], ids=["2 mm", "1 mm", "thick slices"])
def test_points_are_as_far_off_as_they_say(spacing):
    volume, _ = ellipsoid(spacing)

    scan = fitting.scan_of_label(volume, fitting.Label(1, ""))

    points, deviations = np.asarray(scan.points), np.asarray(scan.deviations)
    off, normals = off_ellipsoid(points)
    turned = np.degrees(np.arccos(np.clip(np.einsum("px,px->p", normals, np.asarray(scan.normals)), -1, 1)))
    assert turned.mean() < (3.5 if np.ptp(spacing) == 0 else 7.5)
    assert abs(off.mean()) < 0.03 * volume.spacing.max()
    by_deviation = np.array_split(np.argsort(deviations), 4)
    for rows in by_deviation:  # the sure points are near, the others are not
        ratio = np.sqrt(np.mean(off[rows] ** 2) / np.mean(deviations[rows] ** 2))
        assert 0.7 < ratio < 1.4
    assert deviations[by_deviation[-1]].mean() > 2 * deviations[by_deviation[0]].mean()
    assert scan.frame == "RAS"


def test_grey_values_place_the_surface_between_voxels():
    volume, inside = ellipsoid(2.0)
    grey = np.random.default_rng(0).normal(1000 * inside, 5.0)
    image = volume._replace(layers=(grey,))

    scan = fitting.scan_above(image, 0.0)

    off, normals = off_ellipsoid(np.asarray(scan.points))
    assert np.sqrt(np.mean(off**2)) < 0.05 * 2.0  # a label's points are 0.2 voxels off
    assert np.einsum("px,px->p", normals, np.asarray(scan.normals)).mean() > 0.999
    assert 0.5 < np.sqrt(np.mean(off**2)) / np.sqrt(np.mean(np.asarray(scan.deviations) ** 2)) < 2
    with pytest.raises(fitting.ScanError, match="no surface at 5000: its voxels go from"):
        fitting.scan_above(image, 5000.0)


def test_a_fit_leaves_no_stairs_and_keeps_the_volume():
    volume, _ = ellipsoid(2.0)
    scan = fitting.scan_of_label(volume, fitting.Label(1, ""))

    found = fitting.fit_scan(scan, faces=100, levels=3)

    surface = found.result.surface
    off, normals = off_ellipsoid(np.asarray(surface.vertices))
    turned = np.degrees(np.arccos(np.clip(np.einsum("px,px->p", normals, np.asarray(surface.normals)), -1, 1)))
    assert np.sqrt(np.mean(off**2)) < 0.06 * 2.0  # of a voxel; marching cubes: 0.17
    assert np.sqrt(np.mean(turned**2)) < 3.0
    corners = np.asarray(surface.vertices)[np.asarray(surface.triangles())] - MIDDLE
    enclosed = np.linalg.det(corners).sum() / 6
    assert abs(enclosed / (4 / 3 * np.pi * RADII.prod()) - 1) < 0.004
    assert found.result.trusted
    assert "RAS (right, anterior, superior)" in str(found.result.report())


def test_the_surface_is_open_where_the_image_ends():
    volume, _ = ellipsoid(2.0, cut=0.25)  # a cap of it was not seen: a tenth of its area
    scan = fitting.scan_of_label(volume, fitting.Label(1, ""))

    mesh = fitting.control_mesh(scan, faces=100)

    assert fitting.topology_of(mesh).boundary_loops == 1
    last = volume.layers[0].shape[0] - 1
    at_rim = volume.indices(mesh.vertices[np.unique(mesh.half_edges.edges[rim_edges(mesh)])])[:, 0]
    np.testing.assert_allclose(at_rim, last, atol=2)
    whole = fitting.scan_of_label(ellipsoid(2.0)[0], fitting.Label(1, ""))
    assert fitting.topology_of(fitting.control_mesh(whole, faces=100)).is_closed


def rim_edges(mesh: js.ControlMesh) -> np.ndarray:
    return np.bincount(mesh.half_edges.edge) == 1


def test_a_thin_sheet_starts_from_its_outline():
    volume, inside = ellipsoid(1.0)
    index = np.stack(np.meshgrid(*map(np.arange, inside.shape), indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    along = ((volume.positions(index) - MIDDLE) @ TURN[:, 0]).reshape(inside.shape)
    cup = ((inside > 0) & (inside < 0.15) & (along > 0)).astype(np.uint8)  # half of a shell, 2 to 3 voxels thick
    with pytest.warns(UserWarning, match="thinner than two voxels"):
        scan = fitting.scan_of_label(volume._replace(layers=(cup,)), fitting.Label(1, ""))
    assert scan.outlined and scan.faces is not None
    assert MeshTopology(1, 0, 0, 2) == face_topology({3: scan.faces, 4: np.zeros((0, 4), np.int32)})
    a, b, c = np.moveaxis(np.asarray(scan.points)[scan.faces] - MIDDLE, 1, 0)
    assert np.einsum("tx,tx->", a, np.cross(b, c)) / 6 == pytest.approx(cup.sum(), rel=0.02)  # mm^3, wound outwards

    mesh = fitting.control_mesh(scan, faces=300)

    assert fitting.topology_of(mesh) == MeshTopology(1, 0, 0, 2)
    edge = np.linalg.norm(np.diff(mesh.vertices[mesh.half_edges.edges], axis=1), axis=2).mean()
    far = KDTree(mesh.vertices).query(np.asarray(scan.points))[0]
    assert np.quantile(far, 0.95) < 2 * edge  # near enough for the fit, which draws the rim out


def test_thin_parts_are_named():
    volume, inside = ellipsoid(2.0)
    shell = ((inside > 0) & (inside < 0.12)).astype(np.uint8)  # a wall of about 2 mm
    with pytest.warns(UserWarning, match="label 1: .*thinner than two voxels"):
        fitting.scan_of_label(volume._replace(layers=(shell,)), fitting.Label(1, ""))


def test_a_label_without_a_boundary_is_refused():
    full = fitting.Volume((np.ones((4, 4, 4), np.uint8),), np.eye(4), None)
    with pytest.raises(fitting.ScanError, match="fills the image"):
        fitting.scan_of_label(full, fitting.Label(1, ""))
    with pytest.raises(fitting.ScanError, match="all of its voxels are 0"):
        fitting.find_labels(full._replace(layers=(np.zeros((4, 4, 4), np.uint8),)))
    with pytest.raises(fitting.ScanError, match=r"no whole numbers.*--above"):
        fitting.find_labels(full._replace(layers=(gaussian_filter(np.eye(4)[None] + np.zeros((4, 4, 4)), 1),)))
    with pytest.raises(fitting.ScanError, match=r"go from -1000 to .*--above"):
        fitting.find_labels(full._replace(layers=(np.arange(-1000, 64000).reshape(40, 25, 65),)))


# -------------------------------------------------------------------------------------------------------- the slices


@pytest.mark.parametrize("frame", ["RAS", "LPS"])
def test_slices_show_the_label_where_it_is_and_name_their_sides(frame):
    volume, _ = ellipsoid(2.0)
    volume = volume._replace(frame=frame)
    label = fitting.Label(1, "")
    index = np.argwhere(volume.layers[0]).astype(float)
    for one in fitting.cut_slices(volume, volume.positions(index), label=label):
        pixels = volume.positions(index) @ one.to_pixels[:3, :3].T + one.to_pixels[:3, 3]
        column, row, _ = np.round(pixels[np.abs(pixels[:, 2]) < 0.5]).astype(int).T
        assert len(row) == (one.grey == one.grey.max()).sum()
        assert (one.grey[row, column] == one.grey.max()).all()
        # A step towards the side that a letter names goes that way on the page.
        left, right, top, _ = one.sides
        for letter, axis, way in ((right, 0, 1), (left, 0, -1), (top, 1, -1)):
            towards = {
                "R": [1, 0, 0],
                "A": [0, 1, 0],
                "S": [0, 0, 1],
                "L": [-1, 0, 0],
                "P": [0, -1, 0],
                "I": [0, 0, -1],
            }
            step = convert_frame(np.array(towards[letter], float), "RAS", frame)
            assert way * (one.to_pixels[:3, :3] @ step)[axis] > 0
        assert top in "SA" and left in "RAI"


def test_every_axis_has_sides_of_its_own():
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    affine[:2, :2] += [[0.01, 0], [0, -0.01]]  # both axes are nearer to x
    volume = fitting.Volume((np.ones((9, 9, 9), np.uint8),), affine, "RAS")
    corners = volume.positions(np.array([[2.0, 2, 2], [6, 6, 6]]))
    for one in fitting.cut_slices(volume, corners, label=fitting.Label(1, "")):
        assert len(set(one.sides)) == 4


def test_an_even_part_of_many_points_is_drawn():
    volume, _ = ellipsoid(2.0)
    whole = np.asarray(fitting.scan_of_label(volume, fitting.Label(1, "")).points)
    part = np.asarray(fitting.scan_of_label(volume, fitting.Label(1, ""), most_points=500).points)
    assert len(part) == 500 and len(np.unique(part, axis=0)) == 500
    assert (np.abs(whole[None] - part[:, None]).max(axis=-1).min(axis=1) < 1e-6).all()
    np.testing.assert_allclose(part.mean(axis=0), whole.mean(axis=0), atol=2)


def test_contours_lie_on_the_surface():
    volume, _ = ellipsoid(2.0)
    mesh = fitting.control_mesh(fitting.scan_of_label(volume, fitting.Label(1, "")), faces=100)
    for one in fitting.cut_slices(volume, mesh.vertices, label=fitting.Label(1, "")):
        ends = one.cut(mesh.vertices, mesh.faces[3])
        # Every segment begins where another ends: the contour is closed.
        rounded = np.round(ends.reshape(-1, 2), 6)
        _, counts = np.unique(rounded, axis=0, return_counts=True)
        assert len(ends) > 8 and (counts == 2).all()


# ------------------------------------------------------------------------------------------------------- the command


@pytest.fixture(scope="module")
def two_labels(tmp_path_factory) -> Path:
    """Two ellipsoids of another label each, one named."""
    volume, _ = ellipsoid(3.0)
    one = volume.layers[0]
    values = np.concatenate([one, 5 * one], axis=0)
    image = nibabel.Nifti1Image(values, volume.affine)
    table = b'<LabelTable><Label Key="5"><![CDATA[right/kidney]]></Label></LabelTable>'
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, table))
    path = tmp_path_factory.mktemp("labels") / "seg.nii.gz"
    nibabel.save(image, path)
    return path


def test_the_command_fits_every_label_into_a_folder_of_its_own(two_labels, tmp_path, capsys):
    options = ["--faces", "60", "--levels", "2", "--max-sweeps", "12", "-o", str(tmp_path / "out")]
    assert fit_command([str(two_labels), "--label", "all", *options]) == 0, capsys.readouterr().err
    assert (tmp_path / "out" / "seg_1" / "fit.npz").is_file()
    assert (tmp_path / "out" / "seg_right_kidney" / "fit.html").is_file()
    assert "data:image/png" in (tmp_path / "out" / "seg_1" / "fit.html").read_text(encoding="utf-8")
    loaded = fitting.load(tmp_path / "out" / "seg_1")
    assert loaded.scan.frame == "RAS"
    assert "seg.nii.gz, 5 right/kidney" in (tmp_path / "out" / "summary.csv").read_text()
    capsys.readouterr()


def test_labels_and_grey_values_at_once_are_refused_before_any_fit(two_labels, tmp_path, capsys):
    options = ["--label", "all", "--above", "3", "-o", str(tmp_path / "out")]
    assert fit_command([str(two_labels), *options]) == 2
    assert "not both" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ([], r"seg.nii.gz: it has 2 labels; choose one by --label .* 1 \(.* ml\), 5 right/kidney \(.* ml\)"),
        (["--label", "liver"], "no voxel has the label 'liver'"),
        (["--label", "1", "--above", "3"], "not both"),
        (["--labels", "liver"], "is for tables"),
    ],
)
def test_the_command_says_what_a_label_map_holds(two_labels, tmp_path, capsys, options, text):
    assert fit_command([str(two_labels), "-o", str(tmp_path / "out"), *options]) == 2
    assert re.search(text, capsys.readouterr().err)


def test_labels_are_refused_of_points(tmp_path, capsys):
    (tmp_path / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    assert fit_command([str(tmp_path / "a.xyz"), "--label", "1", "-o", str(tmp_path / "out")]) == 2
    assert "--label (`label=`) is for images and label maps" in capsys.readouterr().err


# ---------------------------------------------------------------------------------------------------------- bad files


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
