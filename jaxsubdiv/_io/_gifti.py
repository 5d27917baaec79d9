"""GIfTI surfaces, by nibabel."""

from pathlib import Path

import numpy as np

from ..errors import MeshError
from ._contents import Contents, VertexData, doubles, library, warn, whole

_NORMALS = "Normals"


def read(path: Path) -> Contents:
    """The point set, the triangles and, where a vector array is named so, the normals.

    Coordinates stay as they are stored. A coordinate transform other than the identity is not applied, and a warning
    says so: several programs store one to a space that the surface was never meant for.
    """
    gifti = library("nibabel.gifti", ".gii files")
    try:
        arrays = gifti.GiftiImage.from_bytes(path.read_bytes()).darrays
    except Exception as error:  # whatever the XML parser and the decoders raise
        raise MeshError(f"{path.name}: nibabel cannot read it as GIfTI ({error}). It is damaged or no GIfTI.") from None
    points = [array for array in arrays if array.intent == _intent("POINTSET")]
    triangles = [array for array in arrays if array.intent == _intent("TRIANGLE")]
    vectors = [array for array in arrays if array.intent == _intent("VECTOR")]
    normals = [array for array in vectors if array.meta.get("Name", "").lower() == _NORMALS.lower()]
    if len(points) != 1 or len(triangles) > 1:
        raise MeshError(
            f"{path.name}: it holds {len(points)} point sets and {len(triangles)} triangle arrays; one of each makes a "
            "surface. Files of measurements on a surface (.func.gii, .label.gii) go with a .surf.gii file."
        )
    transform = points[0].coordsys
    if transform is not None and not np.array_equal(transform.xform, np.eye(4)):
        warn(
            path,
            "it carries a coordinate transform, which was not applied: vertices are as stored. Apply "
            "`darrays[0].coordsys.xform` of nibabel's image where the other space is wanted.",
        )
    return Contents(
        doubles(points[0].data),
        {3: whole(path, triangles[0].data)} if triangles else None,
        doubles(normals[0].data) if normals else None,
    )


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """Triangles, in single precision: the standard knows no other. A warning says by how much it rounds."""
    faces = contents.faces or {}
    if len(faces.get(4, ())):
        raise MeshError(
            f"{path.name}: GIfTI holds triangles only, and the mesh has {len(faces[4])} quads. Write .obj, .ply, .off, "
            ".vtp, .vtk or .npz, which hold quads."
        )
    gifti = library("nibabel.gifti", ".gii files")
    vertices = contents.vertices.astype(np.float32)
    rounding = np.abs(vertices - contents.vertices).max(initial=0)
    if rounding > 0:
        warn(path, f"GIfTI holds single precision: coordinates were rounded, by up to {rounding:.1e}.")
    arrays = [
        gifti.GiftiDataArray(vertices, "NIFTI_INTENT_POINTSET", "NIFTI_TYPE_FLOAT32"),
        gifti.GiftiDataArray(faces[3].astype(np.int32), "NIFTI_INTENT_TRIANGLE", "NIFTI_TYPE_INT32"),
    ]
    if contents.normals is not None:
        normals = contents.normals.astype(np.float32)
        meta = gifti.GiftiMetaData({"Name": _NORMALS})
        arrays.append(gifti.GiftiDataArray(normals, "NIFTI_INTENT_VECTOR", "NIFTI_TYPE_FLOAT32", meta=meta))
    path.write_bytes(gifti.GiftiImage(darrays=arrays).to_bytes())


def _intent(name: str) -> int:
    return library("nibabel.nifti1", ".gii files").intent_codes.code[f"NIFTI_INTENT_{name}"]
