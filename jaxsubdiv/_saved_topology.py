"""Topologies as files: an array a table, and one text that says how they belong together."""

import dataclasses
import json
import os
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import equinox as eqx
import jax
import numpy as np

from ._fans import Fan, Fans
from ._masks import MaskGroup, Masks
from ._scheme.bezier_triangle import PatchLevel, Places
from ._topology import Level, LimitMasks, MaskLevel, Real, Topology
from .archives import read_arrays
from .files import replace_file

_VERSION = 1
_KINDS = {
    kind.__name__: kind
    for kind in (Topology, Level, MaskLevel, PatchLevel, LimitMasks, Masks, MaskGroup, Fans, Fan, Places, Real)
}


def save_topology(path: str | os.PathLike[str], topology: Topology) -> None:
    """Write a topology to an `.npz` file, complete or not at all, for `load_topology`.

    Raises:
        ValueError: the topology holds tables of a level class of your own.
        OSError: the file cannot be written.
    """
    arrays: dict[str, Any] = {}
    text = json.dumps({"version": _VERSION, "tables": _encode(topology, arrays)})
    with replace_file(path) as unfinished, open(unfinished, "wb") as file:
        np.savez(file, about=np.array(text), **arrays)


def load_topology(path: str | os.PathLike[str]) -> Topology:
    """The topology that `save_topology` wrote, as it was.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, of a later version, or no topology; the text names it and says what is wrong.
    """
    try:
        arrays = read_arrays(Path(path), text=True)
        about = json.loads(str(arrays["about"]))
        if about["version"] != _VERSION:
            raise ValueError(
                f"a topology of version {about['version']!r}, but this release reads {_VERSION}. Update it."
            )
        topology = _decode(about["tables"], arrays)
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{os.fspath(path)}: no saved topology, or a damaged one: {error}") from None
    if not isinstance(topology, Topology):
        raise ValueError(f"{os.fspath(path)}: no saved topology.")
    return topology


def _encode(value: Any, arrays: dict[str, Any]) -> Any:
    """A value as JSON has it; its arrays go to `arrays`, and their names stay."""
    if isinstance(value, eqx.Module):
        name = type(value).__name__
        if _KINDS.get(name) is not type(value):
            raise ValueError(f"a topology with {name} has no file format; those of the package's schemes do.")
        return {"kind": name} | {field: _encode(part, arrays) for field, part in vars(value).items()}
    if isinstance(value, jax.Array):
        name = f"table_{len(arrays)}"
        arrays[name] = np.asarray(value)
        return {"array": name}
    if isinstance(value, tuple):
        return [_encode(part, arrays) for part in value]
    if isinstance(value, dict):  # faces by their number of corners
        return {"faces": {str(size): _encode(part, arrays) for size, part in value.items()}}
    return value


def _decode(value: Any, arrays: dict[str, np.ndarray | None]) -> Any:
    if isinstance(value, list):
        return tuple(_decode(part, arrays) for part in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return jax.numpy.asarray(arrays[value["array"]])  # an array of text is refused here
    if "kind" not in value:
        return {int(size): _decode(part, arrays) for size, part in value["faces"].items()}
    kind = _KINDS[value["kind"]]
    module = object.__new__(kind)  # past the converters, which take the arrays of numpy that tables are built from
    hints = get_type_hints(kind)
    for field in dataclasses.fields(kind):
        # A field with a default may be younger than the file.
        plain = value[field.name] if field.default is dataclasses.MISSING else value.get(field.name, field.default)
        part = _decode(plain, arrays)
        if not _fits(part, hints[field.name]):
            raise ValueError(f"`{field.name}` of {value['kind']} is not as it should be.")
        object.__setattr__(module, field.name, part)
    return module


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotated type, inside tuples and dicts too."""
    parts = get_args(hint)
    if isinstance(hint, UnionType) or get_origin(hint) is Union:
        return any(_fits(value, part) for part in parts)
    if get_origin(hint) is tuple:
        if not isinstance(value, tuple):
            return False
        each = [parts[0]] * len(value) if parts[-1] is Ellipsis else list(parts)
        return len(each) == len(value) and all(map(_fits, value, each))
    if get_origin(hint) is dict:
        return isinstance(value, dict) and all(_fits(part, parts[1]) for part in value.values())
    return isinstance(value, hint)
