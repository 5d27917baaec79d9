"""NPZ and NPY files."""

from pathlib import Path
from typing import Any

import numpy as np

from ..archives import read_arrays
from ..errors import MeshError, name_rows
from ._contents import Contents, VertexData

_MESHES = (
    ("control_points", "control_normals", ("control_faces",)),
    ("vertices", "normals", ("faces", "triangles", "quads")),
)


def read_npz(path: Path) -> Contents:
    """A mesh: `control_points`, `control_faces`, or `vertices` and `faces`, or `triangles` and `quads`; and normals."""
    arrays = _load(path, {name for vertices, normals, faces in _MESHES for name in (vertices, normals, *faces)})
    if "" in arrays:
        raise MeshError(
            f"{path.name}: it holds one array without a name, so points at most. Read it with `read_points`."
        )
    for vertices, normals, faces in _MESHES:
        if (found := arrays.get(vertices)) is not None:
            blocks = [block for name in faces if (block := arrays.get(name)) is not None]
            return Contents(found, _sort_by_columns(path, blocks) if blocks else None, arrays.get(normals))
    raise MeshError(
        f"{path.name}: a mesh needs the arrays `control_points` and `control_faces`, or `vertices` with `faces`, "
        f"`triangles` or `quads`. It has {name_rows(arrays) or 'none'}."
        + (" Read it with `read_points`." if "points" in arrays else "")
    )


def read_points(path: Path) -> Contents:
    """`points`, `normals`, `weights`; the vertices of a mesh where there are no `points`; or one bare array."""
    of_meshes = {name for vertices, normals, _ in _MESHES for name in (vertices, normals)}
    arrays = _load(path, {"", "points", "weights"} | of_meshes)
    if (points := arrays.get("points", arrays.get(""))) is not None:
        return Contents(points, None, arrays.get("normals"), arrays.get("weights"))
    for vertices, normals, _ in _MESHES:
        if (found := arrays.get(vertices)) is not None:
            return Contents(found, None, arrays.get(normals))
    raise MeshError(
        f"{path.name}: the array `points` is missing, and so are `control_points` and `vertices`. It has "
        f"{name_rows(arrays) or 'none'}."
    )


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """`vertices`, `triangles`, `quads` and, where there are any, `normals`."""
    faces = contents.faces or {}
    arrays: dict[str, Any] = {"vertices": contents.vertices, "triangles": faces[3], "quads": faces[4]}
    if contents.normals is not None:
        arrays["normals"] = contents.normals
    with path.open("wb") as file:  # given a name, numpy would add .npz to it
        np.savez(file, **arrays)


def _load(path: Path, wanted: set[str]) -> dict[str, np.ndarray | None]:
    try:
        return read_arrays(path, wanted.__contains__)
    except ValueError as error:
        raise MeshError(f"{path.name}: {error}.") from None


def _sort_by_columns(path: Path, blocks: list[np.ndarray]) -> dict[int, np.ndarray]:
    for block in blocks:
        if block.ndim != 2 or block.shape[1] not in (3, 4) or block.dtype.kind not in "iu":
            raise MeshError(
                f"{path.name}: faces must be whole numbers of the shape [t, 3] or [q, 4]; got {block.dtype} of the "
                f"shape {list(block.shape)}."
            )
    kept = {size: [block for block in blocks if block.shape[1] == size] for size in (3, 4)}
    return {size: np.concatenate(same) for size, same in kept.items() if same}
