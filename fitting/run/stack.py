"""Subjects of different sizes filled up to one size, so that one compiled program fits them all."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxsubdiv as js

from ..model.pairing import Scene
from ..model.priors.landmarks import Anchors
from ..model.priors.shifts import SlicePlanes
from ..scan.scan import Scan


def fill_up(inputs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Landmarks, boundary points and slices filled up to the most of any subject, so that one program serves all."""
    filled = [dict(own) for own in inputs]
    for name, fill in (("landmarks", _fill_landmarks), ("boundary", _fill_curve), ("slices", _fill_planes)):
        sizes = [0 if own[name] is None else len(own[name][0]) for own in inputs]
        if max(sizes):
            for own in filled:
                fill(own, max(sizes))
    return filled


def _fill_landmarks(own: dict[str, Any], size: int) -> None:
    anchors = own["landmarks"]
    more = size - len(anchors.points)
    filled = Anchors(*(jnp.concatenate([part, jnp.repeat(part[-1:], more, axis=0)]) for part in anchors))
    own["landmarks"] = filled._replace(deviations=filled.deviations.at[size - more :].set(jnp.inf))


def _fill_curve(own: dict[str, Any], size: int) -> None:
    curve = own["boundary"]
    more = size - len(curve.points)
    own["boundary"] = curve._replace(points=np.concatenate([curve.points, np.repeat(curve.points[-1:], more, axis=0)]))
    own["boundary_counts"] = np.append(np.ones(size - more), np.zeros(more))


def _fill_planes(own: dict[str, Any], size: int) -> None:
    planes = own["slices"] or SlicePlanes(np.zeros(0, int), np.zeros((0, 2, 3)))
    more = size - len(planes.numbers)
    own["slices"] = SlicePlanes(
        np.append(planes.numbers, np.full(more, -1)), np.concatenate([planes.planes, np.zeros((more, 2, 3))])
    )


def fill_scene(scene: Scene, size: int, has_slices: bool) -> Scene:
    """A scene with its points filled up, by points of weight 0."""
    scan, n = scene.scan, scene.scan.n_points

    def fill(rows: Any, **how: Any) -> Array:
        rows = jnp.asarray(rows)
        return jnp.pad(rows, [(0, size - n)] + [(0, 0)] * (rows.ndim - 1), **(how or {"mode": "edge"}))

    whole = Scan(
        fill(scan.points),
        None if scan.normals is None else fill(scan.normals),
        fill(scan.weights_or_ones(), constant_values=0),
        fill(scan.relative_deviations(), constant_values=1),
    )
    around = type(scene.around)(*(fill(rows) for rows in scene.around))
    of_points = scene.of_points
    if has_slices:
        of_points = fill(np.full(n, -1, np.int32) if of_points is None else of_points, constant_values=-1)
    strokes = scene.strokes
    if strokes is not None:
        strokes = strokes._replace(nearest=fill(strokes.nearest), most=jnp.asarray(strokes.most, scan.points.dtype))
    choice = scene.choice
    if choice is not None:
        choice = js.FaceChoice(fill(choice.of_points), jnp.asarray(choice.faces))
    return Scene(whole, around, strokes, of_points, jnp.asarray(scene.open_vertices), choice)


def fill_choices(choices: list[js.FaceChoice | None], n_points: list[int]) -> list[js.FaceChoice | None]:
    """The faces that points may be paired with, in as many sets as the subject with the most has; None where all have
    none."""
    given = [choice for choice in choices if choice is not None]
    if not given:
        return choices
    most, n_faces = max(len(choice.faces) for choice in given), given[0].faces.shape[1]
    filled: list[js.FaceChoice | None] = []
    for choice, n in zip(choices, n_points, strict=True):
        of_points = np.full(n, -1, np.int32) if choice is None else np.asarray(choice.of_points)
        faces = np.ones((most, n_faces), bool)
        if choice is not None:
            faces[: len(choice.faces)] = choice.faces
        filled.append(js.FaceChoice(of_points, faces))
    return filled


def split_common(subjects: list[Any]) -> tuple[Any, Any]:
    """What all subjects share, once; and what differs, one a row."""
    flat = [jax.tree.flatten(subject) for subject in subjects]
    structure = flat[0][1]
    for _, other in flat:
        if other != structure:
            raise ValueError(
                "the subjects of a cohort must have the same priors: give landmarks and so on for all or none."
            )
    shared, own = [], []
    for leaves in zip(*(leaves for leaves, _ in flat), strict=True):
        first = leaves[0]
        same = all(leaf is first or np.array_equal(leaf, first) for leaf in leaves)
        shared.append(first if same else None)
        own.append(None if same else jnp.stack([jnp.asarray(leaf) for leaf in leaves]))
    if all(leaf is None for leaf in own):  # one subject, or copies of one
        y = structure.unflatten(range(len(shared)))[2].control.vertices
        own[y] = jnp.stack([leaves[0][y] for leaves in flat])
        shared[y] = None
    return structure.unflatten(shared), structure.unflatten(own)
