"""GIfTI surfaces; nibabel writes them.

Not read by nibabel: some numbers in a damaged file make it loop without end.
"""

import math
import re
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float, Shaped

from ..errors import MeshError
from ..extras import import_extra
from . import _xml
from ._contents import (
    Contents,
    VertexData,
    as_double,
    as_indices,
    round_to_single,
    split_quads,
    warn,
)
from ._text import parse_rows

_NORMALS = "Normals"
_TYPES = {
    **{"UINT8": "u1", "INT8": "i1", "UINT16": "u2", "INT16": "i2", "UINT32": "u4", "INT32": "i4", "UINT64": "u8"},
    **{"INT64": "i8", "FLOAT32": "f4", "FLOAT64": "f8"},
}
_CODES = {"2": "u1", "4": "i2", "8": "i4", "16": "f4", "64": "f8", "256": "i1", "512": "u2", "768": "u4", "1024": "i8"}
_INTENTS = {"1008": "POINTSET", "1009": "TRIANGLE", "1007": "VECTOR"}
_ENCODINGS = {"1": "ASCII", "2": "Base64Binary", "3": "GZipBase64Binary", "4": "ExternalFileBinary"}


def read(path: Path) -> Contents:
    """The point set, the triangles and, where a vector array is named so, the normals.

    Coordinates stay as they are stored. A coordinate transform other than the identity is not applied, and a warning
    says so: several programs store one to a space that the surface was never meant for.
    """
    arrays = _arrays(path)
    triangles = [array for array in arrays if _intent(array) == "TRIANGLE"]
    return _points(path, arrays)._replace(faces={3: as_indices(path, _rows(path, triangles[0]))} if triangles else None)


def read_points(path: Path) -> Contents:
    """The point set and the normals, whatever the triangles are."""
    return _points(path, _arrays(path))


def _arrays(path: Path) -> list[Element]:
    arrays = _xml.parse(path, path.read_bytes(), "GIFTI").findall("DataArray")
    n = {kind: sum(_intent(array) == kind for array in arrays) for kind in ("POINTSET", "TRIANGLE")}
    if n["POINTSET"] != 1 or n["TRIANGLE"] > 1:
        raise MeshError(
            f"{path.name}: it holds {n['POINTSET']} point sets and {n['TRIANGLE']} triangle arrays; one of each makes "
            "a surface. Files of measurements on a surface (.func.gii, .label.gii) go with a .surf.gii file."
        )
    return arrays


def _points(path: Path, arrays: list[Element]) -> Contents:
    points = next(array for array in arrays if _intent(array) == "POINTSET")
    vectors = [array for array in arrays if _intent(array) == "VECTOR"]
    normals = [array for array in vectors if _meta_name(array).lower() == _NORMALS.lower()]
    for transform in points.findall("CoordinateSystemTransformMatrix/MatrixData"):
        values = parse_rows(path, transform.text or "").values
        if not np.array_equal(values, np.eye(4).ravel()):
            warn(
                path,
                "it carries a coordinate transform, which was not applied: vertices are as stored. Apply "
                "`darrays[0].coordsys.xform` of nibabel's image where the other space is wanted.",
            )
            break
    return Contents(as_double(_rows(path, points)), None, as_double(_rows(path, normals[0])) if normals else None)


def _intent(array: Element) -> str:
    intent = array.get("Intent", "").removeprefix("NIFTI_INTENT_")
    return _INTENTS.get(intent, intent)


def _meta_name(array: Element) -> str:
    pairs = array.findall("MetaData/MD")
    return next(
        (pair.findtext("Value") or "" for pair in pairs if (pair.findtext("Name") or "").strip() == "Name"), ""
    ).strip()


def _rows(path: Path, array: Element) -> Shaped[np.ndarray, "n 3"]:
    """The numbers of a data array, three a row."""
    try:
        values, shape = _values(path, array), _shape(array)
    except ValueError as error:
        text = str(error).removeprefix(f"{path.name}, ")
        raise MeshError(
            f"{path.name}: the array {_intent(array)[:40]}: {text}. The file is cut off or damaged."
        ) from None
    # Of text every line is a row, as nibabel writes and reads it whatever the order.
    by_columns = array.get("ArrayIndexingOrder") in ("ColumnMajorOrder", "2") and _encoding(array) != "ASCII"
    return values.reshape(shape, order="F" if by_columns else "C")


def _encoding(array: Element) -> str:
    name = array.get("Encoding", "")
    return _ENCODINGS.get(name, name)


def _values(path: Path, array: Element) -> Shaped[np.ndarray, "n"]:
    kind, n = array.get("DataType", "").removeprefix("NIFTI_TYPE_"), math.prod(_shape(array))
    dtype = np.dtype(_TYPES.get(kind) or _CODES.get(kind) or _unknown(f"the type '{kind[:40]}' is not read"))
    dtype = dtype.newbyteorder(">" if array.get("Endian") in ("BigEndian", "1") else "<")
    text = array.findtext("Data") or ""
    match _encoding(array):
        case "ASCII":
            values: Float[np.ndarray, "n"] = parse_rows(path, text).values
        case "Base64Binary":
            data = _xml.from_base64(text)
            values = np.frombuffer(data, dtype, len(data) // dtype.itemsize)
        case "GZipBase64Binary":
            values = np.frombuffer(_xml.unpack(_xml.from_base64(text), n * dtype.itemsize), dtype)
        case other:
            _unknown(f"the encoding '{other[:40]}' is not read; save it with GZipBase64Binary")
    if len(values) != n:
        raise ValueError(f"{n} numbers are announced, but there are {len(values)}")
    return values


def _shape(array: Element) -> tuple[int, int]:
    sizes = [array.get("Dim0", ""), array.get("Dim1", "1")]
    if not all(re.fullmatch("[0-9]{1,18}", size) for size in sizes) or sizes[1] != "3":
        raise ValueError(f"its size is {' x '.join(size[:20] for size in sizes)}, where rows of three are expected")
    return int(sizes[0]), 3


def _unknown(what: str) -> NoReturn:
    raise ValueError(what)


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Triangles, in single precision: the standard knows no other. A warning says by how much it rounds.

    No normals: Connectome Workbench opens no surface with more arrays than two.
    """
    gifti = import_extra("nibabel.gifti", "io", ".gii files")
    vertices = round_to_single(path, "GIfTI", contents.vertices)
    triangles = split_quads(path, "GIfTI", contents).astype(np.int32)
    arrays = [
        gifti.GiftiDataArray(vertices, "NIFTI_INTENT_POINTSET", "NIFTI_TYPE_FLOAT32"),
        gifti.GiftiDataArray(triangles, "NIFTI_INTENT_TRIANGLE", "NIFTI_TYPE_INT32"),
    ]
    path.write_bytes(gifti.GiftiImage(darrays=arrays).to_bytes())


def write_data(path: Path, contents: Contents, data: VertexData) -> None:
    """The vertex data alone, an array each, as the measurements that go with a `.surf.gii`."""
    gifti = import_extra("nibabel.gifti", "io", ".gii files")
    if not data:
        raise MeshError(
            f"{path.name}: such files hold vertex data alone. Give some, or write the surface to .surf.gii."
        )
    arrays = [
        gifti.GiftiDataArray(
            column.astype(np.float32),
            "NIFTI_INTENT_SHAPE",
            "NIFTI_TYPE_FLOAT32",
            meta=gifti.GiftiMetaData({"Name": name}),
        )
        for name, column in data.items()
    ]
    path.write_bytes(gifti.GiftiImage(darrays=arrays).to_bytes())
