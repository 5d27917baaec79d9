"""Small sound files of every kind that the package reads, made anew each time, and who reads them."""

import gzip
import io
import json
import struct
import tempfile
import warnings
import zlib
from base64 import b64encode
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import highdicom
import jax
import jax.numpy as jnp
import nibabel
import nrrd
import numpy as np
import pydicom
from pydicom.sr.codedict import codes

import fitting
import jaxsubdiv as js
from fitting.run.checkpoint import Checkpoint


class Seed(NamedTuple):
    """A file, how it is read, and the errors that its reader documents."""

    name: str
    data: bytes
    read: Callable[[Path], Any]
    errors: tuple[type[Exception], ...]
    share: float = 1.0
    """How often it is taken, against the others."""


_BOX = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
_QUADS = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
_TRIANGLES = np.concatenate([_QUADS[:, [0, 1, 2]], _QUADS[:, [0, 2, 3]]])
_LIKE = {"a": jnp.zeros((3, 2)), "b": jnp.zeros(4)}


def seeds() -> list[Seed]:
    """All of them; those whose reading compiles programs come seldom."""
    points, landmarks = _tables(), _landmarks()
    meshes = _written() | _texts()
    found = [Seed(name, data, js.read_mesh, (js.MeshError,)) for name, data in meshes.items()]
    found += [Seed(name, data, js.read_points, (js.MeshError,), 0.5) for name, data in meshes.items()]
    found += [Seed(name, data, _scan, (js.MeshError, fitting.ScanError)) for name, data in points.items()]
    found += [Seed(name, data, fitting.read_landmarks, (fitting.ScanError,)) for name, data in landmarks.items()]
    found += [Seed(name, data, _labels, (fitting.ScanError,)) for name, data in (_images() | _dicom()).items()]
    return found + _saved()


def _scan(path: Path) -> fitting.Scan:
    try:
        return fitting.read_scan(path, labels="a")
    except fitting.ScanError as error:
        if "label" not in str(error):
            raise
        return fitting.read_scan(path)


def _labels(path: Path) -> Any:
    """The labels, and of a small volume the first one's scan."""
    volume = fitting.read_volume(path)
    try:
        found = fitting.find_labels(volume)
        if volume.layers[0].size < 10_000:
            return fitting.scan_of_label(volume, found[0].label)
    except fitting.ScanError as error:  # of what is in the volume: `fitting.read_scan` tells the file
        raise fitting.ScanError(f"{path.name}: {error}") from None
    return found


def _written() -> dict[str, bytes]:
    """What the package writes itself."""
    mesh = js.ControlMesh(_BOX, {3: _TRIANGLES}, np.float32(_BOX - 0.5))
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (".obj", ".ply", ".off", ".stl", ".vtp", ".vtk", ".gii", ".npz", ".surf", ".glb"):
            path = Path(folder, "own" + suffix)
            js.write_mesh(path, mesh)
            found[path.name] = path.read_bytes()
    return found


def _lines(rows: Any) -> str:
    return "".join(" ".join(f"{value:g}" for value in row) + "\n" for row in rows)


def _texts() -> dict[str, bytes]:
    """What others write."""
    points, faces = _lines(_BOX), _lines(np.insert(_QUADS, 0, 4, axis=1))
    cells = np.int32(np.insert(_QUADS, 0, 4, axis=1))
    head = "# vtk DataFile Version 3.0\na box\n{}\nDATASET POLYDATA\n"
    tail = f"POINT_DATA 8\nNORMALS up float\n{_lines(_BOX - 0.5)}SCALARS d float 1\nLOOKUP_TABLE default\n{'1 ' * 8}\n"
    field = "FIELD more 1\nNormals 3 8 double\n" + points
    ply = "ply\nformat {} 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face 6\n"
    ply += "property uchar part\nproperty list uchar int vertex_indices\nend_header\n"
    facets = "".join(
        f"facet normal 0 0 1\nouter loop\n{''.join(f'vertex {_lines([_BOX[i]])}' for i in face)}endloop\nendfacet\n"
        for face in _TRIANGLES
    )
    mni = f"P 0.3 0.3 0.4 10 1 8\n{points}\n{_lines(_BOX - 0.5)}\n6\n0 1 1 1 1\n\n"
    mni += f"{_lines([range(4, 25, 4)])}{_lines([_QUADS.ravel()])}"
    texts = {
        "other.obj": "".join("v " + _lines([row]) for row in _BOX)
        + "vn 0 0 1\nvn 0 1 0\nf 1//1 2//2 4//1 \\\n 3//1\nf -1 -2/1 -3\n",
        "mni.obj": mni,
        "text.ply": ply.format("ascii") + points + _lines(np.insert(cells, 0, 1, axis=1)),
        "colours.off": f"COFF 8 6 0 # a box\n{_lines(np.insert(_BOX, 3, 255, axis=1))}{faces}",
        "text.stl": f"solid box\n{facets}endsolid box\n",
        "old.vtk": head.format("ASCII") + f"POINTS 8 float\n{points}POLYGONS 6 30\n{faces}{tail}{field}",
        "surface.asc": f"#!ascii version of lh.white\n8 12\n{_lines(np.insert(_BOX, 3, 0, axis=1))}"
        + _lines(np.insert(_TRIANGLES, 3, 0, axis=1)),
    }
    big = b"".join(struct.pack(">B", 1) + struct.pack(">B4i", 4, *face) for face in _QUADS)
    return (
        {name: text.encode() for name, text in texts.items()}
        | {
            "big.ply": ply.format("binary_big_endian").encode() + _BOX.astype(">f4").tobytes() + big,
            "old_binary.vtk": (head.format("BINARY") + "POINTS 8 float\n").encode()
            + (_BOX.astype(">f4").tobytes() + b"\nPOLYGONS 6 30\n" + cells.astype(">i4").tobytes() + b"\n"),
            "packed.vtp": _vtp(packed=True),
            "appended.vtp": _vtp(packed=False),
            "plain.gii": _gifti(),
            "lh.white": _freesurfer(),
        }
        | _grids()
    )


def _freesurfer() -> bytes:
    """With lines after the faces that say which image it was made from."""
    info = "valid = 1  # volume info valid\nfilename = a.mgz\nvolume = 256 256 256\nxras = 1 0 0\ncras = 1.5 0 -2\n"
    head = b"\xff\xff\xfecreated by nobody\n\n" + struct.pack(">2i", 8, 12) + _BOX.astype(">f4").tobytes()
    return head + _TRIANGLES.astype(">i4").tobytes() + struct.pack(">3i", 2, 0, 20) + info.encode()


def _grids() -> dict[str, bytes]:
    """Unstructured grids of quads, triangles and a line, and triangle strips."""
    points, strip = _lines(_BOX), "0 2 1 3 5 7"
    cells = "2 0 1\n" + _lines(np.insert(_QUADS[:5], 0, 4, axis=1)) + "3 1 3 7\n3 1 7 5\n"
    head = "# vtk DataFile Version 3.0\na box\nASCII\nDATASET {}\nPOINTS 8 float\n" + points
    xml = (
        '<VTKFile type="{}"><{}><Piece NumberOfPoints="8" {}><Points><DataArray type="Float32" NumberOfComponents="3" '
    )
    xml += f'format="ascii">{points}</DataArray></Points><{{}}>'
    array = '<DataArray type="Int64" Name="{}" format="ascii">{}</DataArray>'
    grid = xml.format("UnstructuredGrid", "UnstructuredGrid", 'NumberOfCells="8"', "Cells")
    grid += array.format("connectivity", "0 1 " + _lines(_QUADS[:5]) + "1 3 7 1 7 5")
    grid += array.format("offsets", "2 6 10 14 18 22 25 28") + array.format("types", "3 9 9 9 9 9 5 5")
    strips = xml.format("PolyData", "PolyData", 'NumberOfStrips="1"', "Strips")
    strips += array.format("connectivity", strip) + array.format("offsets", "6")
    texts = {
        "grid.vtk": head.format("UNSTRUCTURED_GRID") + f"CELLS 8 36\n{cells}CELL_TYPES 8\n3 9 9 9 9 9 5 5\n",
        "strips.vtk": head.format("POLYDATA") + f"TRIANGLE_STRIPS 1 7\n6 {strip}\n",
        "grid.vtu": grid + "</Cells></Piece></UnstructuredGrid></VTKFile>",
        "strips.vtp": strips + "</Strips></Piece></PolyData></VTKFile>",
    }
    return {name: text.encode() for name, text in texts.items()}


def _vtp(packed: bool) -> bytes:
    """Base64 inside, packed by zlib; or bytes at the end."""
    arrays = [_BOX.astype("<f4"), _QUADS.ravel().astype("<i8"), np.arange(4, 25, 4).astype("<i8")]
    parts, appended = [], b""
    for array in arrays:
        raw = array.tobytes()
        zipped = zlib.compress(raw)
        text = b64encode(struct.pack("<4I", 1, len(raw), 0, len(zipped))) + b64encode(zipped)
        parts.append(f'format="binary">{text.decode()}' if packed else f'format="appended" offset="{len(appended)}">')
        appended += struct.pack("<I", len(raw)) + raw
    zlib_ = ' compressor="vtkZLibDataCompressor"' if packed else ""
    xml = f'<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian"{zlib_}><PolyData>'
    xml += '<Piece NumberOfPoints="8" NumberOfStrips="0" NumberOfPolys="6"><PointData></PointData>'
    xml += f'<Points><DataArray type="Float32" NumberOfComponents="3" {parts[0]}</DataArray></Points>'
    xml += f'<Polys><DataArray type="Int64" Name="connectivity" {parts[1]}</DataArray>'
    xml += f'<DataArray type="Int64" Name="offsets" {parts[2]}</DataArray></Polys></Piece></PolyData>'
    end = b"</VTKFile>" if packed else b'<AppendedData encoding="raw">_' + appended + b"</AppendedData></VTKFile>"
    return xml.encode() + end


def _gifti() -> bytes:
    """Numbers as text and as base64, with a name and a transform."""
    corners = b64encode(_TRIANGLES.astype("<i4").tobytes()).decode()
    one = 'ArrayIndexingOrder="RowMajorOrder" Dimensionality="2" Endian="LittleEndian" Dim1="3"'
    identity = " ".join(f"{value:g}" for value in np.eye(4).ravel())
    return (
        f'<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="2"><DataArray Intent="NIFTI_INTENT_POINTSET" '
        f'DataType="NIFTI_TYPE_FLOAT32" {one} Dim0="8" Encoding="ASCII"><MetaData><MD><Name>Name</Name><Value>a</Value>'
        f"</MD></MetaData><CoordinateSystemTransformMatrix><MatrixData>{identity}</MatrixData>"
        f"</CoordinateSystemTransformMatrix><Data>{_lines(_BOX)}</Data></DataArray>"
        f'<DataArray Intent="NIFTI_INTENT_TRIANGLE" DataType="NIFTI_TYPE_INT32" {one} Dim0="12" '
        f'Encoding="Base64Binary"><Data>{corners}</Data></DataArray></GIFTI>'
    ).encode()


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _npz(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()


def _tables() -> dict[str, bytes]:
    rows = np.random.default_rng(0).normal(size=(12, 3)).round(3)
    unit = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).round(3)
    labelled = "".join(f'{x},{y},{z},"a #{i}\nb",{i % 3}\n' for i, (x, y, z) in enumerate(rows))
    commas = "".join(";".join(str(value).replace(".", ",") for value in row) + "\n" for row in rows)
    texts = {
        "bare.xyz": _lines(rows),
        "normals.xyz": "12\n" + _lines(np.hstack([rows, unit])),
        "colours.xyz": _lines(np.hstack([rows, np.abs(rows) * 50 // 1])),
        "labelled.csv": "x,y,z,label,slice\n" + labelled,
        "semicolons.csv": "x [mm];y [mm];z [mm]\n" + commas,
        "tabs.txt": "# a scan\nx\ty\tz\tcontour type\n" + _lines(np.insert(rows, 3, 1, axis=1)).replace(" ", "\t"),
        "plain.asc": "// a comment\n" + _lines(rows),
        "weights.csv": "Points:0,Points:1,Points:2,weight\n" + _lines(np.insert(rows, 3, 1, axis=1)).replace(" ", ","),
    }
    texts |= _digitised(rows)
    made = {name: text.encode() for name, text in texts.items()} | _pcd(rows, unit)
    made["bare.npy"] = _npy(rows)
    return made | {"scan.npz": _npz(points=rows, normals=unit, weights=np.ones(12)), "points.mrk.json": _markups()}


def _digitised(rows: np.ndarray) -> dict[str, str]:
    """Points as scanners, digitisers, and programs of shapes and hearts write them."""
    head = "//Position of fiducials X+, Y+, Y- on the subject\n%F\t0.1\t0\t0\n%F\t0\t0.08\t0\n%F\t0\t-0.08\t0\n"
    guide = "".join(f"{x}\t{y}\t{z}\ta{i}\t{i % 3}\t1.0\t0\n" for i, (x, y, z) in enumerate(rows))
    return {
        "leica.pts": "12\n" + _lines(np.hstack([rows, np.abs(rows) * 50 // 1])),
        "local.particles": _lines(rows),
        "head.hsp": f"3\t200\n//Shape file\n{head}//No of rows, no of columns; position\n12\t3\n{_lines(rows)}",
        "probe.elp": f"3\t2\n//Probe file\n1\n{head}%S\t4000\n%N\tRED\n0.1 0.2 0.3\n%N\tBLUE\n0.1 0.2 -0.3\n",
        "head.pos": "12\n" + "".join(f"{i} {_lines([row])}" for i, row in enumerate(rows)) + "nasion 1 2 3\n",
        "GPFile_000.txt": "x\ty\tz\tcontour type\tframeID\tweight\ttime frame\n" + guide,
    }


def _pcd(rows: np.ndarray, unit: np.ndarray) -> dict[str, bytes]:
    """In the three forms, the packed one as runs of bytes and one run that came before."""
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z normal_x normal_y normal_z rgb\nSIZE 4 4 4 4 4 4 4\n"
    head += "TYPE F F F F F F U\nCOUNT 1 1 1 1 1 1 1\nWIDTH 12\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 12\nDATA "
    table = np.hstack([rows, unit, np.zeros((len(rows), 1))]).astype("<f4")
    plain = np.ascontiguousarray(table.T[:6]).tobytes()
    parts = [plain[i : i + 32] for i in range(0, len(plain), 32)]
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    packed += b"\x03\0\0\0\0" + b"\xe0\x23\x03"  # zeros, and 44 more as those four bytes before
    return {
        "text.pcd": (head + "ascii\n" + _lines(table)).encode(),
        "binary.pcd": (head + "binary\n").encode() + table.tobytes(),
        "packed.pcd": (head + "binary_compressed\n").encode() + struct.pack("<II", len(packed), table.nbytes) + packed,
    }


def _markups() -> bytes:
    points = [
        {"id": str(i), "label": f"F-{i}", "position": [i, 2.5, -1], "positionStatus": "defined"} for i in range(3)
    ]
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    return json.dumps({"@schema": "x", "markups": [markup]}).encode()


def _landmarks() -> dict[str, bytes]:
    old = "# Markups fiducial file version = 4.11\n# CoordinateSystem = 0\n# columns = id,x,y,z,vis,label,desc\n"
    return {
        "marks.json": json.dumps({"lpa": [1, 2, 3], "tip": [0.5, -1e3, 2], "coils": [[1, 2, 3], [4, 5, 6]]}).encode(),
        "marks.csv": b'name,x,y,z\nlpa,1,2,3\n"the, tip",4,5.5,-6\n',
        "bare.csv": b"lpa;1;2;3\ntip;4;5,5;-6\n",
        "marks.mrk.json": _markups(),
        "marks.fcsv": (old + "1,1,2,3,1,F-1,\n2,4,5,6,1,F-2,\n").encode(),
    }


def _images() -> dict[str, bytes]:
    """A block of one label in another, as each format has it, plain and packed."""
    values = np.zeros((6, 5, 4), np.int16)
    values[1:5, 1:4, 1:3], values[2, 2, 2] = 1, 2
    affine = np.array([[0.0, -2, 0, 5], [1.5, 0, 0, -7], [0, 0, 3, 1], [0, 0, 0, 1]])
    image = nibabel.Nifti1Image(values, affine)
    table = b'<LabelTable><Label Key="1" Red="1"><![CDATA[liver]]></Label><Label Key="2">cyst</Label></LabelTable>'
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, table))
    scaled = nibabel.Nifti1Image(values.astype(">i2"), affine, nibabel.Nifti1Header(endianness=">"))
    scaled.header.set_slope_inter(2.0, 0)
    header = {"space": "left-posterior-superior", "space directions": affine[:3, :3], "space origin": affine[:3, 3]}
    layered = header | {
        "space directions": np.insert(affine[:3, :3], 0, np.nan, axis=0),
        "kinds": ["list"] + ["domain"] * 3,
    }
    layered |= {
        f"Segment{n}_{key}": value
        for n in (0, 1)
        for key, value in zip(("Name", "LabelValue", "Layer"), ("ab"[n], "1", str(n)), strict=True)
    }
    layered |= {"Segmentation_ReferenceImageExtentOffset": "4 0 7"}
    voxels = np.asfortranarray(values).tobytes(order="F")
    meta = "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = {}\n"
    meta += "TransformMatrix = 0 1 0 -1 0 0 0 0 1\nOffset = 5 -7 1\nElementSpacing = 1.5 2 3\nDimSize = 6 5 4\n"
    meta += "ElementType = MET_SHORT\nElementDataFile = LOCAL\n"
    return {
        "labels.nii": image.to_bytes(),
        "labels.nii.gz": gzip.compress(image.to_bytes(), mtime=0),
        "second.nii": nibabel.Nifti2Image(values.astype(np.float32), affine).to_bytes(),
        "scaled.nii.gz": gzip.compress(scaled.to_bytes(), mtime=0),
        "raw.nrrd": _nrrd(values.astype(">i2"), header, "raw"),
        "packed.nrrd": _nrrd(values.astype(np.uint8), header, "gzip"),
        "text.nrrd": _nrrd(values, header, "ascii"),
        "bzip2.nrrd": _nrrd(values, header, "bzip2"),
        "layers.seg.nrrd": _nrrd(np.stack([values == 1, values == 2]).astype(np.uint8), layered, "gzip"),
        "plain.mha": meta.format("False").encode() + voxels,
        "packed.mha": meta.format("True").encode() + zlib.compress(voxels),
    }


def _nrrd(values: np.ndarray, header: dict[str, Any], encoding: str) -> bytes:
    file = io.BytesIO()
    nrrd.write(file, values, header | {"encoding": encoding})
    return file.getvalue()


def _dicom() -> dict[str, bytes]:
    """A segmentation of two segments in four slices."""
    slices = []
    for k in range(4):
        one = pydicom.Dataset()
        one.file_meta = pydicom.dataset.FileMetaDataset()
        one.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
        one.SOPClassUID = one.file_meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
        one.SOPInstanceUID, one.StudyInstanceUID, one.SeriesInstanceUID, one.FrameOfReferenceUID = (
            f"1.2.{k}",
            "1.3",
            "1.4",
            "1.5",
        )
        for empty in ("PatientBirthDate", "PatientSex", "AccessionNumber", "StudyDate", "StudyTime"):
            setattr(one, empty, "")
        one.ReferringPhysicianName = one.PositionReferenceIndicator = ""
        one.Modality, one.PatientID, one.PatientName, one.StudyID = "CT", "1", "A^B", "1"
        one.SeriesNumber, one.InstanceNumber = 1, k + 1
        one.Rows, one.Columns, one.PixelSpacing, one.SliceThickness = 5, 6, [2.0, 1.5], 3.0
        one.ImageOrientationPatient, one.ImagePositionPatient = [1, 0, 0, 0, 1, 0], [10.0, -20.0, 3.0 * k]
        one.SamplesPerPixel, one.PhotometricInterpretation, one.PixelRepresentation = 1, "MONOCHROME2", 0
        one.BitsAllocated = one.BitsStored = 16
        one.HighBit, one.PixelData = 15, bytes(60)
        slices.append(one)
    mask = np.zeros((4, 5, 6, 2), np.uint8)
    mask[1:3, 1:4, 1:5, 0], mask[1, 2, 2, 1] = 1, 1
    manual = highdicom.seg.SegmentAlgorithmTypeValues.MANUAL
    segments = [
        highdicom.seg.SegmentDescription(n, "ab"[n - 1], codes.SCT.Organ, codes.SCT.Liver, manual) for n in (1, 2)
    ]
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        highdicom.seg.Segmentation(
            slices, mask, "BINARY", segments, "1.6", 1, "1.7", 1, "maker", "model", "1", "0"
        ).save_as(file)
    return {"segments.dcm": file.getvalue()}


def _saved() -> list[Seed]:
    """Topologies, checkpoints, recipes and fits, which hold one another's forms."""
    mesh, scheme = js.ControlMesh(_BOX, {4: _QUADS}), js.Interpolating()
    topology = js.build_topology(mesh, scheme, 1)
    surface = js.refine(scheme, topology, mesh.control())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        js.save_topology(folder / "topology.npz", topology)
        Checkpoint(folder / "checkpoint.npz", {"like": 1}).write_tree(_LIKE)
        scan = fitting.Scan(np.asarray(surface.vertices))
        fitting.fit(scheme, topology, mesh.control(), scan, max_sweeps=1, throw=False).save(folder)
        data = {path.name: path.read_bytes() for path in folder.iterdir()}
    return [
        Seed("topology.npz", data["topology.npz"], js.load_topology, (ValueError,), 2.0),
        Seed("checkpoint.npz", data["checkpoint.npz"], _checkpoint, (ValueError,)),
        Seed("recipe.json", data["recipe.json"], fitting.load_recipe, (ValueError,), 2.0),
        Seed("fit.npz", data["fit.npz"], lambda path: fitting.load(path.parent), (ValueError,), 0.3),
    ]


def _checkpoint(path: Path) -> Any:
    return jax.tree.leaves(Checkpoint(path, {"like": 1}).read_tree(_LIKE))
