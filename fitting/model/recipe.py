"""The settings of a fit, and their JSON text."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, TypeVar, get_args

import equinox as eqx
import numpy as np

import jaxsubdiv as js

from ..start.align import Kind
from ..start.control_mesh import FaceKind
from ..start.parts import PartKind
from .limits import check_numbers
from .priors import Priors
from .priors.shape_modes import ShapeModes
from .robust import AbstractLoss, Barron, Huber, LeastSquares, Tukey, geman_mcclure
from .unknowns import Free

_VERSION = 2  # 1 had no settings of `fit_scan`, which then are the defaults
_SCHEMES = {kind.__name__: kind for kind in js.SCHEMES.values()}
_LOSSES = {kind.__name__: kind for kind in (Barron, Huber, LeastSquares, Tukey)}
_NUMBERS = ("levels", "max_sweeps", "tolerance", "landmark_deviation", "faces")
_NUMBERS += ("tolerance_mm", "most_faces", "most_points")
_M = TypeVar("_M", bound=eqx.Module)
_S = TypeVar("_S", bound="Settings")


@dataclasses.dataclass(frozen=True)
class Settings:
    """All that `fit` and `fit_scan` are told besides the data: scan, control mesh and landmarks.

    Attributes:
        scheme: the scheme, with the h where the fit starts.
        levels: of refinement. On both shipped examples, with and without their control meshes, the RMS distance with
            three lies within 3 % of that from the same surface at five levels; with two, up to 18 % below it.
        free: what may move. A mask of control vertices fits only control meshes with as many.
        priors: what is known of the surface beforehand.
        loss: how a point loses weight with its distance.
        max_sweeps, tolerance, landmark_deviation: see `fit`.
        faces, kind, closed, part, pose, mirror, tolerance_mm, most_faces, most_points: see `fit_scan`; `fit` has no use
            for them.
        mesh_normals, limit: see `js.build_topology`.

    Raises:
        ValueError: a number is out of its range; the text names it.
    """

    scheme: js.AbstractScheme
    levels: int = 3
    free: Free = dataclasses.field(default_factory=Free)
    priors: Priors = dataclasses.field(default_factory=Priors)
    loss: AbstractLoss = dataclasses.field(default_factory=geman_mcclure)
    max_sweeps: int = 60
    tolerance: float = 0.1
    landmark_deviation: float = 1.0
    faces: int = 500
    kind: FaceKind = "triangle"
    closed: bool | None = None
    part: PartKind | None = None
    pose: Kind | None = "similarity"
    mirror: bool = False
    tolerance_mm: float | None = None
    most_faces: int = 10_000
    most_points: int | None = None
    mesh_normals: bool = False
    limit: bool = False

    def __post_init__(self) -> None:
        check_numbers({name: getattr(self, name) for name in _NUMBERS})

    def topology(self, mesh: js.ControlMesh) -> js.Topology:
        """Tables of a control mesh, as `fit` needs them."""
        return js.build_topology(mesh, self.scheme, self.levels, mesh_normals=self.mesh_normals, limit=self.limit)

    @classmethod
    def of(cls: type[_S], scheme: js.AbstractScheme, topology: js.Topology, **settings: Any) -> _S:
        """The recipe of a fit on these tables; `settings` are the other attributes."""
        of_tables = {"mesh_normals": topology.mesh_normals, "limit": topology.limit is not None}
        return cls(scheme, len(topology.levels), **of_tables, **settings)

    def to_json(self) -> str:
        """The recipe as JSON text, exact to the last bit. Infinite numbers, which JSON does not have, are words.

        Raises:
            ValueError: the scheme or the loss is of a class that neither `jaxsubdiv` nor `fitting` brings.
        """
        values: dict[str, Any] = {"recipe": "jaxsubdiv fit", "version": _VERSION}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name in ("scheme", "loss"):
                known = _SCHEMES if field.name == "scheme" else _LOSSES
                value = {"name": _known_name(field.name, value, known)} | _encode_module(value)
            elif isinstance(value, eqx.Module):
                value = _encode_module(value)
            values[field.name] = value
        return json.dumps(values, indent=2, allow_nan=False)

    @classmethod
    def from_json(cls: type[_S], text: str) -> _S:
        """The recipe of JSON text; what the text leaves out keeps its default, but for the scheme and its levels.

        Raises:
            ValueError: the text is no recipe, or of a later version; it has a name or value that there is not.
        """
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as error:  # also of numbers of thousands of digits, and of depth
            raise ValueError(f"no JSON text: {error}.") from None
        if not isinstance(values, dict) or "scheme" not in values or "levels" not in values:
            raise ValueError("no recipe: it has no `scheme` and `levels`.")
        values = dict(values)
        values.pop("recipe", None)
        version = values.pop("version", _VERSION)
        if version not in range(1, _VERSION + 1):
            raise ValueError(f"a recipe of version {version!r}, but this release reads up to {_VERSION}. Update it.")
        fields = {field.name for field in dataclasses.fields(cls)}
        _refuse_others("a recipe", values, fields)
        makers = {
            "scheme": lambda value: _decode_named("scheme", value, _SCHEMES),
            "loss": lambda value: _decode_named("loss", value, _LOSSES),
            "free": lambda value: _decode("free", Free, value),
            "priors": _priors,
            "levels": lambda value: _check_type("levels", value, int),
            "max_sweeps": lambda value: _check_type("max_sweeps", value, int),
            "tolerance": lambda value: _number("tolerance", value),
            "landmark_deviation": lambda value: _number("landmark_deviation", value),
            "faces": lambda value: _check_type("faces", value, int),
            "kind": lambda value: _check_choice("kind", value, get_args(FaceKind)),
            "closed": lambda value: None if value is None else _check_type("closed", value, bool),
            "part": lambda value: _check_choice("part", value, (*get_args(PartKind), None)),
            "mirror": lambda value: _check_type("mirror", value, bool),
            "pose": lambda value: _check_choice("pose", value, (*get_args(Kind), None)),
            "tolerance_mm": lambda value: None if value is None else _number("tolerance_mm", value),
            "most_faces": lambda value: _check_type("most_faces", value, int),
            "most_points": lambda value: None if value is None else _check_type("most_points", value, int),
            "mesh_normals": lambda value: _check_type("mesh_normals", value, bool),
            "limit": lambda value: _check_type("limit", value, bool),
        }
        return cls(**{name: makers[name](value) for name, value in values.items()})


def _known_name(what: str, module: eqx.Module, known: Mapping[str, type]) -> str:
    name = type(module).__name__
    if known.get(name) is not type(module):
        raise ValueError(
            f"a {what} of your own, {name}, has no place in a recipe; those of the package do: {_join_names(known)}."
        )
    return name


def _priors(value: Any) -> Priors:
    if isinstance(value, dict) and value.get("shape") is not None:
        value = value | {"shape": _decode("shape", ShapeModes, value["shape"])}
    return _decode("priors", Priors, value)


def _encode_module(module: eqx.Module) -> dict[str, Any]:
    """The arguments that make a module, as JSON has them."""
    return {field.name: _encode(getattr(module, field.name)) for field in dataclasses.fields(module) if field.init}


def _encode(value: Any) -> Any:
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, eqx.Module):
        return _encode_module(value)
    value = np.asarray(value)
    if value.ndim:
        return [_encode(row) for row in value]
    return value.item() if np.isfinite(value) else str(value)  # "inf", "-inf"


def _decode_named(what: str, value: Any, known: Mapping[str, type[_M]]) -> _M:
    name = value.get("name") if isinstance(value, dict) else value
    if not isinstance(value, dict) or not isinstance(name, str) or name not in known:
        raise ValueError(f"`{what}` must have a `name`, one of {_join_names(known)}; got {name!r}.")
    return _decode(what, known[name], {key: part for key, part in value.items() if key != "name"})


def _decode(what: str, kind: type[_M], value: Any) -> _M:
    if not isinstance(value, dict):
        raise ValueError(f"`{what}` must be an object of names and values; got {value!r}.")
    _refuse_others(f"`{what}`", value, {field.name for field in dataclasses.fields(kind) if field.init})
    try:
        return kind(**{name: _decode_value(part) for name, part in value.items()})
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"`{what}` is not as it should be: {error}") from None


def _decode_value(value: Any) -> Any:
    if isinstance(value, list):
        return np.array([_decode_value(row) for row in value])
    return float(value) if value in ("inf", "-inf") and isinstance(value, str) else value


def _check_type(what: str, value: Any, kinds: type | tuple[type, ...]) -> Any:
    if not isinstance(value, kinds) or (isinstance(value, bool) and kinds is not bool):
        wanted = {int: "a whole number", bool: "true or false"}.get(kinds, "a number")  # pyright: ignore
        raise ValueError(f"`{what}` must be {wanted}; got {value!r}.")
    return value


def _number(what: str, value: Any) -> float:
    try:
        return float(_check_type(what, value, (int, float)))
    except OverflowError:
        raise ValueError(f"`{what}` is too large a number.") from None


def _check_choice(what: str, value: Any, choices: tuple[str | None, ...]) -> Any:
    if value not in choices:
        raise ValueError(f"`{what}` must be one of {_join_names(map(json.dumps, choices))}; got {json.dumps(value)}.")
    return value


def _refuse_others(what: str, values: Mapping[str, Any], known: set[str]) -> None:
    others = sorted(set(values) - known)
    if others:
        raise ValueError(f"{what} has no {', '.join(map(repr, others))}; it has {_join_names(sorted(known))}.")


def _join_names(names: Any) -> str:
    return ", ".join(names)
