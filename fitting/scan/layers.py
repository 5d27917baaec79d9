"""Layers: several surfaces as one control mesh with a region each, and the points of all of them as one scan."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

import jaxsubdiv as js

from .closest_points import boundary_vertices, closest_points
from .frames import join_frames, join_rows
from .regions import read_groups
from .scan import Scan, ScanError

_RIM = 1e-3  # of a face: how near a layer's rim a place counts as where the layer ends
LayerLabels: TypeAlias = Mapping[str, str | Sequence[str]]
"""Layer, from the inside out -> the label, or labels, of its points."""


def stack_meshes(meshes: Mapping[str, js.ControlMesh]) -> js.ControlMesh:
    """One control mesh of several that do not hang together, with a region each.

    Args:
        meshes: by the names of the layers, which become those of the regions.

    Returns:
        The vertices of one mesh after those of the other; the triangles of all, then the quads of all. Normals where
        every mesh has its own.
    """
    parts = list(meshes.values())
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = {
        size: np.concatenate([part.faces[size] + n for part, n in zip(parts, first, strict=False)]) for size in (3, 4)
    }
    rows = np.concatenate([np.full(len(part.faces[size]), k) for size in (3, 4) for k, part in enumerate(parts)])
    normals = None
    if all(part.normals is not None for part in parts):
        normals = np.concatenate([np.asarray(part.normals) for part in parts])
    vertices = np.concatenate([part.vertices for part in parts])
    return js.ControlMesh(vertices, faces, normals, regions=js.Regions(rows, tuple(meshes)))


def take_layer(mesh: js.ControlMesh, name: str) -> js.ControlMesh:
    """The faces of one region of a control mesh, with the vertices that they use.

    Raises:
        ValueError: the mesh has no such region.
    """
    vertices, faces = take_layer_faces(mesh, name)
    normals = None if mesh.normals is None else mesh.normals[vertices]
    return js.ControlMesh(mesh.vertices[vertices], faces, normals, check=False)


def take_layer_faces(mesh: js.ControlMesh, name: str) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """The vertices that the faces of a region use, and those faces between them."""
    if mesh.regions is None or name not in mesh.regions.names:
        there = () if mesh.regions is None else mesh.regions.names
        raise ValueError(f"'{name}' is no region of the control mesh; it has {', '.join(there) or 'none'}.")
    return take_faces(mesh.faces, mesh.regions.rows == mesh.regions.names.index(name))


def take_faces(faces: Mapping[int, Any], chosen: np.ndarray) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """The vertices that chosen faces use, triangles being marked first, and the faces in the numbers of these."""
    kept = choose_faces(faces, chosen)
    vertices = np.unique(np.concatenate([rows.ravel() for rows in kept.values()]))
    return vertices, {size: np.searchsorted(vertices, rows).astype(np.int32) for size, rows in kept.items()}


def choose_faces(faces: Mapping[int, Any], chosen: np.ndarray) -> dict[int, np.ndarray]:
    """The triangles and quads that are marked, triangles first."""
    n = len(faces[3])
    return {3: np.asarray(faces[3])[chosen[:n]], 4: np.asarray(faces[4])[chosen[n:]]}


def take_part(surface: js.RefinedSurface, chosen: np.ndarray) -> js.RefinedSurface:
    """A surface with some of its faces, and all of its vertices."""
    faces = {size: jnp.asarray(rows) for size, rows in choose_faces(surface.faces, chosen).items()}
    return js.RefinedSurface(surface.vertices, surface.normals, faces)


class Opposite(NamedTuple):
    """The places of one layer that are closest to the vertices of another, as one surface has them."""

    vertices: np.ndarray
    """Of the one layer; none on the other, nor where that ends."""
    at: js.SurfacePoint
    corners: np.ndarray
    weights: np.ndarray
    """The place on the other layer, and the vertices that it lies between."""


def find_opposite(surface: js.RefinedSurface, layer: np.ndarray, other: np.ndarray) -> Opposite:
    """The closest places of one layer to the vertices of another.

    Args:
        surface: of all layers.
        layer, other: the faces of each, triangles first.
    """
    own = np.setdiff1d(take_faces(surface.faces, layer)[0], take_faces(surface.faces, other)[0])
    choice = js.FaceChoice(np.zeros(len(own), np.int32), other[None])
    at = closest_points(surface, np.asarray(surface.vertices)[own], choice)
    corners, weights = (np.asarray(part) for part in js.corner_weights(surface, at))
    there = np.sum(np.where(find_rim(surface, other)[corners], weights, 0), axis=1) <= 1 - _RIM
    return Opposite(own[there], js.SurfacePoint(at.face[there], at.uv[there]), corners[there], weights[there])


def find_rim(surface: js.RefinedSurface, chosen: np.ndarray) -> np.ndarray:
    """Which vertices of a surface lie where its chosen faces end."""
    return boundary_vertices(take_part(surface, chosen))


def join_scans(scans: Mapping[str, Scan]) -> Scan:
    """One scan of the points of all layers, labelled by the names of these.

    Raises:
        ScanError: some have normals, deviations or slices and others have none; the text names the layer.
    """
    parts, names = list(scans.values()), [f"the layer '{name}'" for name in scans]
    of_points: dict[str, Any] = {
        name: join_rows(name, [getattr(part, name) for part in parts], names)
        for name in ("normals", "deviations", "slices")
    }
    if any(part.weights is not None for part in parts):
        of_points["weights"] = np.concatenate([np.asarray(part.weights_or_ones()) for part in parts])
    rows = np.repeat(np.arange(len(parts)), [part.n_points for part in parts])
    points = np.concatenate([np.asarray(part.points) for part in parts])
    frame = join_frames([part.frame for part in parts], names)
    return Scan(points, regions=js.Regions(rows, tuple(scans)), frame=frame, **of_points)


def part_scan(scan: Scan, layers: LayerLabels | None) -> dict[str, Scan]:
    """The points of each layer, by their labels; points of other labels belong to none.

    Args:
        scan: with labels.
        layers: default: every label is a layer.

    Raises:
        ScanError: the scan has no labels, none of a layer's, or a label that two layers have.
    """
    if scan.regions is None:
        raise ScanError(
            "layers are told apart by labels, and the scan has none. A table has them in a column `label` or "
            "`contour`; or give a scan for each layer."
        )
    words = np.array(scan.regions.words())
    there = sorted(set(words.tolist()) - {""})
    given = {name: name for name in there} if layers is None else layers
    found, taken = {}, dict[str, str]()
    for name, labels in given.items():
        own = [labels] if isinstance(labels, str) else list(labels)
        for label in own:
            if label in taken:
                raise ScanError(f"the label '{label}' is of the layers '{taken[label]}' and '{name}': give it one.")
            taken[label] = name
        chosen = np.isin(words, own)
        if not chosen.any():
            raise ScanError(
                f"the layer '{name}' has no points: the scan has no label {' or '.join(map(repr, own))}. It has "
                f"{', '.join(there)}."
            )
        found[name] = scan.rows(np.flatnonzero(chosen))
    return found


def read_layers(path: str | os.PathLike[str]) -> dict[str, list[str]]:
    """The layers of a JSON file, from the inside out: `{"endo": "LV_ENDOCARDIAL", "epi": ["LV_EPI", "RV_EPI"]}`.

    Raises:
        OSError: there is no such file.
        ValueError: it holds anything else, or fewer than two layers; the text names the file.
    """
    found = read_groups(path)
    if len(found) < 2 or any(labels is None or not labels for labels in found.values()):
        raise ValueError(
            f'{path}: layers are written {{"inner": "label", "outer": ["label", "other"]}}, two or more, in JSON.'
        )
    return {name: [labels] if isinstance(labels, str) else list(labels or ()) for name, labels in found.items()}
