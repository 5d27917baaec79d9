"""Label maps and images of every format: where their voxels lie, and what their labels are."""

import highdicom
import nibabel
import nrrd
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.sr.codedict import codes
from voxels import SHAPE, SPACING, TURN

import fitting
from fitting.image.volume import mask_of
from jaxsubdiv.frames import convert_frame

MARKED = (6, 2, 3)


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
