"""NPZ and NPY files, by numpy."""

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MeshError
from ._contents import Contents, VertexData

_MESHES = (
    ("control_points", "control_normals", ("control_faces",)),
    ("vertices", "normals", ("faces", "triangles", "quads")),
)


def read_npz(path: Path) -> Contents:
    """A mesh: `control_points`, `control_faces`, or `vertices` and `faces`, or `triangles` and `quads`; and normals."""
    arrays = _load(path)
    if not isinstance(arrays, dict):
        raise MeshError(
            f"{path.name}: it holds one array without a name, so points at most. Read it with `read_points`."
        )
    for vertices, normals, faces in _MESHES:
        if vertices in arrays:
            blocks = [arrays[name] for name in faces if name in arrays]
            return Contents(arrays[vertices], _by_columns(path, blocks) if blocks else None, arrays.get(normals))
    raise MeshError(
        f"{path.name}: a mesh needs the arrays `control_points` and `control_faces`, or `vertices` with `faces`, "
        f"`triangles` or `quads`. It has {', '.join(arrays) or 'none'}."
        + (" Read it with `read_points`." if "points" in arrays else "")
    )


def read_points(path: Path) -> Contents:
    """`points`, `normals`, `weights`; the vertices of a mesh where there are no `points`; or one bare array."""
    arrays = _load(path)
    if not isinstance(arrays, dict):
        return Contents(arrays)
    if "points" in arrays:
        return Contents(arrays["points"], None, arrays.get("normals"), arrays.get("weights"))
    if any(vertices in arrays for vertices, _, _ in _MESHES):
        return read_npz(path)
    raise MeshError(
        f"{path.name}: the array `points` is missing, and so are `control_points` and `vertices`. It has "
        f"{', '.join(arrays) or 'none'}."
    )


def write(path: Path, contents: Contents, data: VertexData) -> None:
    """`vertices`, `triangles`, `quads` and, where there are any, `normals`."""
    faces = contents.faces or {}
    arrays: dict[str, Any] = {"vertices": contents.vertices, "triangles": faces[3], "quads": faces[4]}
    if contents.normals is not None:
        arrays["normals"] = contents.normals
    with path.open("wb") as file:  # given a name, numpy would add .npz to it
        np.savez(file, **arrays)


def _load(path: Path) -> dict[str, np.ndarray] | np.ndarray:
    try:
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)  # a pickle may run any code
            return loaded if isinstance(loaded, np.ndarray) else {name: loaded[name] for name in loaded.files}
    except Exception as error:  # zipfile, zlib and numpy each raise their own
        raise MeshError(
            f"{path.name}: numpy cannot read it without unpickling ({error}). It is damaged, of another format, or "
            "holds objects: save plain arrays of numbers."
        ) from None


def _by_columns(path: Path, blocks: list[np.ndarray]) -> dict[int, np.ndarray]:
    for block in blocks:
        if block.ndim != 2 or block.shape[1] not in (3, 4) or block.dtype.kind not in "iu":
            raise MeshError(
                f"{path.name}: faces must be whole numbers of the shape [t, 3] or [q, 4]; got {block.dtype} of the "
                f"shape {list(block.shape)}."
            )
    kept = {size: [block for block in blocks if block.shape[1] == size] for size in (3, 4)}
    return {size: np.concatenate(same) for size, same in kept.items() if same}
