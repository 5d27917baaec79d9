"""Subjects of different sizes filled up to one size, so that one compiled program fits them all."""

from collections.abc import Sequence
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
    """Landmarks, boundary points and slices filled up to the most of any subject, so that one program serves all; the
    inputs themselves where there is nothing to fill up."""
    if all(own[name] is None for own in inputs for name in ("landmarks", "boundary", "slices")):
        return inputs
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


def split_common(subjects: Sequence[Any]) -> tuple[Any, list[Any]]:
    """What all subjects share, once, as a pytree; and what differs, as one of each. Each lacks what the other has."""
    flat = [jax.tree.flatten(subject) for subject in subjects]
    structure = flat[0][1]
    if any(other != structure for _, other in flat):
        raise ValueError(
            "the subjects of a cohort must have the same priors: give landmarks and so on for all or none."
        )
    leaves = [leaves for leaves, _ in flat]
    same = [all(_is_same(one, of_all[0]) for one in of_all) for of_all in zip(*leaves, strict=True)]
    shared = [leaf if alike else None for leaf, alike in zip(leaves[0], same, strict=True)]
    own = [[None if alike else leaf for leaf, alike in zip(some, same, strict=True)] for some in leaves]
    return structure.unflatten(shared), [structure.unflatten(some) for some in own]


def share_equal(tree: Any, other: Any) -> Any:
    """A pytree with the arrays of another where they are equal, so that many subjects hold them once."""
    leaves, structure = jax.tree.flatten(tree)
    others, alike = jax.tree.flatten(other)
    if structure != alike:
        return tree
    return structure.unflatten([b if _is_same(a, b) else a for a, b in zip(leaves, others, strict=True)])


def stack(trees: Sequence[Any]) -> Any:
    """The arrays of several pytrees, one a row, on the host."""
    return jax.tree.map(lambda *rows: np.stack([np.asarray(row) for row in rows]), *trees)


def _is_same(one: Any, other: Any) -> bool:
    if one is other:
        return True
    if not all(isinstance(leaf, (np.ndarray, jax.Array)) for leaf in (one, other)):
        return bool(one == other)
    return one.dtype == other.dtype and np.array_equal(one, other)
