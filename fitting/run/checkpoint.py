"""The state of a run in a file, from which the same run goes on where it was stopped."""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxsubdiv as js
from jaxsubdiv.archives import read_arrays
from jaxsubdiv.files import replace_file

_FORMAT = 1  # of the files of a run; a new one where they, or what they are made from, come to mean something else
_INPUT = "input "  # before the name of an input, in the file


class Checkpoint:
    """A file of arrays that belongs to a run of certain inputs, and to no other."""

    def __init__(self, path: str | os.PathLike[str], inputs: Mapping[str, Any]):
        """
        Args:
            path: the file, an .npz; its folder is made when it is first written.
            inputs: all that the run depends on by name, as pytrees of arrays, numbers and words.
        """
        self.path: Path = Path(path)
        self._marks = marks_of(inputs)

    def read(self) -> dict[str, np.ndarray] | None:
        """The arrays last written; None where there is no file.

        Raises:
            ValueError: the file cannot be read, or is of a run of other inputs; the text names them.
        """
        if not self.path.is_file():
            return None
        try:
            arrays: dict[str, Any] = dict(read_arrays(self.path, text=True))
        except (ValueError, OSError) as error:
            raise ValueError(f"{self.path} is no checkpoint: {error}. Delete it to start anew.") from None
        marks = {name.removeprefix(_INPUT): str(arrays.pop(name)) for name in list(arrays) if name.startswith(_INPUT)}
        others = find_differing(marks, self._marks)
        if others:
            raise ValueError(
                f"{self.path} is of another fit, with another {', another '.join(others)}. Start with what it was "
                "started with to go on, give another folder, or delete the file to start anew."
            )
        return arrays

    def write(self, arrays: Mapping[str, Any]) -> None:
        """Take the place of what was written before; None is left out."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        whole = {name: np.asarray(value) for name, value in arrays.items() if value is not None}
        whole |= {_INPUT + name: np.asarray(mark) for name, mark in self._marks.items()}
        with replace_file(self.path) as path, open(path, "wb") as file:
            np.savez(file, **whole)  # pyright: ignore[reportArgumentType]

    def read_tree(self, like: Any) -> Any:
        """The pytree last written, in the structure of another; None where there is no file.

        Raises:
            ValueError: as `read` does, or the arrays are not those of such a pytree; the text names the first.
        """
        arrays = self.read()
        if arrays is None:
            return None
        leaves, structure = jax.tree.flatten(like)
        for i, leaf in enumerate(leaves):
            found = arrays.get(f"leaf {i}")
            if found is None or found.shape != np.shape(leaf) or found.dtype.kind != np.asarray(leaf).dtype.kind:
                raise ValueError(
                    f"{self.path} is no checkpoint of this fit: the array 'leaf {i}' is missing, or of another shape "
                    "or kind. Delete it to start anew."
                )
        return jax.tree.unflatten(structure, [_cast_like(arrays[f"leaf {i}"], leaf) for i, leaf in enumerate(leaves)])

    def write_tree(self, tree: Any) -> None:
        """Take the place of what was written before by the leaves of a pytree."""
        self.write({f"leaf {i}": leaf for i, leaf in enumerate(jax.tree.leaves(tree))})

    def remove(self) -> None:
        """The run has ended, or is to be forgotten."""
        self.path.unlink(missing_ok=True)


def marks_of(inputs: Mapping[str, Any]) -> dict[str, str]:
    """What tells a run from those of other inputs, by the name of each input; the release counts as one.

    Args:
        inputs: all that the run depends on by name, as pytrees of arrays, numbers and words.
    """
    return {name: _mark(value) for name, value in inputs.items()} | {"release": f"{js.__version__} {_FORMAT}"}


def find_differing(some: Mapping[str, str], others: Mapping[str, str]) -> list[str]:
    """Names of the inputs that two runs do not share, by their marks."""
    return [name for name in sorted(some.keys() | others) if some.get(name) != others.get(name)]


def _cast_like(array: np.ndarray, leaf: Any) -> Any:
    array = array.astype(np.asarray(leaf).dtype, copy=False)  # a damaged file may name a precision that JAX lacks
    return jnp.asarray(array) if isinstance(leaf, jax.Array) else array


def _mark(value: Any) -> str:
    """What tells a value from others: of its arrays every bit, and of the rest the words."""
    leaves, structure = jax.tree.flatten(value)
    found = hashlib.sha256(str(structure).encode())
    for leaf in leaves:
        if isinstance(leaf, (jax.Array, np.ndarray, np.generic)):
            array = np.asarray(leaf)
            found.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        else:
            found.update(repr(leaf).encode())
    return found.hexdigest()
