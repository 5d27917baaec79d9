"""Which faces each point of a scan may lie on: labels of the scan, and the template's groups that they are of."""

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Int

import jaxsubdiv as js

from .scan import Scan, ScanError

Groups: TypeAlias = Mapping[str, str | Sequence[str] | None]
"""Label of a scan -> the template's group, or groups, that its points lie on; None where it may be any."""


class RegionMatch(eqx.Module):
    """Regions of control faces, and the labels whose points lie on them; made by `match_regions`.

    Attributes:
        faces: regions of the control faces, triangles first and then quads.
        groups: label -> names of the regions that its points may be paired with, in the order of the names. Points of
            other labels may be paired with any face.
    """

    faces: js.Regions
    groups: tuple[tuple[str, tuple[str, ...]], ...] = eqx.field(static=True)

    def __check_init__(self) -> None:
        known = {name for name, n in zip(self.faces.names, self.faces.counts(), strict=True) if n}
        for label, groups in self.groups:
            lost = [name for name in groups if name not in known]
            if lost or not groups:
                raise ValueError(
                    f"the label '{label}' is to lie on {', '.join(map(repr, lost)) or 'no region'}, but the control "
                    f"faces lie in {_list_names(known)}."
                )

    @property
    def kinds(self) -> tuple[tuple[str, ...], ...]:
        """The sets of regions that points are paired within, each once."""
        return tuple(dict.fromkeys(groups for _, groups in self.groups))

    def kinds_of(self, scan: Scan) -> Int[np.ndarray, "p"]:
        """The row in `kinds` of each point of a scan; -1 where it may be paired with any face."""
        if scan.regions is None:
            return np.full(scan.n_points, -1)
        known, kinds = dict(self.groups), self.kinds
        rows = [kinds.index(known[label]) if label in known else -1 for label in scan.regions.names]
        return np.array([*rows, -1])[scan.regions.rows]  # the last for points without a label, whose row is -1

    def choice(self, scan: Scan, owner: Int[np.ndarray, "f"]) -> js.FaceChoice | None:
        """What the points of a scan may be paired with; None where all may be with any face.

        Args:
            owner: the control face of every face of the surface.
        """
        of_points = self.kinds_of(scan)
        if not (of_points >= 0).any():
            return None
        region = self.faces.rows[owner]
        faces = [np.isin(region, [self.faces.names.index(name) for name in kind]) for kind in self.kinds]
        return js.FaceChoice(of_points.astype(np.int32), np.stack(faces))


def match_regions(scan: Scan, mesh: js.ControlMesh, groups: Groups | None = None) -> RegionMatch | None:
    """Find the template's group that each label of a scan is of.

    A label is of the groups that are given for it; else of the group of the same name, in capitals or not; else of the
    group whose words are among its own in their order, the most of them, as `LV_ENDOCARDIAL` in
    `SAX_LV_ENDOCARDIAL`; else of all groups among whose words its own are, as `MITRAL_VALVE` in `MITRAL_VALVE_CUT`.

    Args:
        scan: its `regions` are the labels.
        mesh: the template, whose `regions` are the groups.
        groups: label -> group, or several, or None for any face; before what the names say. Labels that the scan does
            not have are passed over.

    Returns:
        None where the mesh has no groups.

    Raises:
        ValueError: a given group is none of the mesh, or groups are given and the mesh has none.
        ScanError: groups are given and the scan has no labels.
    """
    if mesh.regions is None:
        if groups:
            raise ValueError("`regions` name groups of the control mesh, and it has none. An OBJ file has them as `g`.")
        return None
    given = _normalise_groups(groups or {}, mesh.regions)
    labels = () if scan.regions is None else scan.regions.names
    if groups and not labels:
        raise ScanError(
            f"`regions` are given for {_list_names(groups)}, but the scan has no labels. A table has them in a column "
            "`label` or `contour`."
        )
    counts = dict(zip(mesh.regions.names, mesh.regions.counts(), strict=True))
    there = [name for name in mesh.regions.names if counts[name]]
    found = {label: given.get(label.casefold(), _groups_of(label, there)) for label in labels}
    return RegionMatch(mesh.regions, tuple((label, names) for label, names in found.items() if names))


def read_groups(path: str | os.PathLike[str]) -> Groups:
    """The groups of labels from a JSON file: `{"label": "group", "other": ["one", "two"], "third": null}`.

    Raises:
        OSError: there is no such file.
        ValueError: it holds anything else; the text names the file.
    """
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None
    values = found.values() if isinstance(found, dict) else [0]
    if not all(one is None or isinstance(one, str) or _are_words(one) for one in values):
        raise ValueError(
            f'{path}: regions are written {{"label": "group", "other": ["one", "two"], "third": null}}, in JSON; '
            "null is any face."
        )
    return found


def _are_words(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) for word in value)


def _normalise_groups(groups: Groups, regions: js.Regions) -> dict[str, tuple[str, ...]]:
    """The groups of labels in small letters, by the names that the mesh has for them."""
    known, found = {name.casefold(): name for name in regions.names}, {}
    for label, names in groups.items():
        names = [names] if isinstance(names, str) else list(names or ())
        lost = [name for name in names if str(name).casefold() not in known]
        if lost:
            raise ValueError(
                f"`regions` put '{label}' on '{lost[0]}', which is no group of the control mesh. It has "
                f"{_list_names(regions.names)}."
            )
        wanted = {known[name.casefold()] for name in names}
        found[label.casefold()] = tuple(name for name in regions.names if name in wanted)
    return found


def _groups_of(label: str, groups: Sequence[str]) -> tuple[str, ...]:
    """The groups of a label by the words of the names."""
    same = tuple(group for group in groups if group.casefold() == label.casefold())
    if same:
        return same
    words = {group: _words(group) for group in groups}
    own = _words(label)
    within = {group: len(some) for group, some in words.items() if _contains(own, some)}
    if within:
        most = max(within.values())
        return tuple(group for group, n in within.items() if n == most)
    return tuple(group for group, some in words.items() if _contains(some, own))


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[\W_]+", name.casefold()) if word]


def _contains(words: list[str], some: list[str]) -> bool:
    """Whether some words, one or more, stand among others in their order, without gaps."""
    n = len(some)
    return n > 0 and any(words[i : i + n] == some for i in range(len(words) - n + 1))


def _list_names(names: object) -> str:
    return ", ".join(sorted(map(str, names))) or "none"  # pyright: ignore[reportArgumentType]
