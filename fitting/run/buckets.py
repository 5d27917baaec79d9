"""Subjects fitted in buckets: those of a size class share one compiled program, and several devices share a bucket."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

import jaxsubdiv as js

from ..model.pairing import Scene
from ..model.residual import Model
from ..model.unknowns import Variables
from ..report.cohort import CHECKPOINT_OF_COHORT
from ..solve.strengths import FromTargets
from ..solve.sweeps import State, Subject, Sweeps, subject_residual
from .checkpoint import Checkpoint, marks_of
from .stack import fill_scene, split_common, stack

_SMALLEST, _GROWTH = 1024, 1.25  # points: below the smallest, compiling again costs more than the points filled up
_FEW, _MOST_GROWN = 8, 2.0  # so few scans join a larger class of at most so many times their points: that costs less
_OF_PILOT = ("likeness", "determined")  # beside the strengths


class Kept:
    """What a cohort has finished, in a folder, for the same cohort to go on from; nothing where there is no folder.

    Of several processes the first one writes and reads, and tells the others.
    """

    def __init__(self, folder: Path | None, given: Mapping[str, Any], mesh: Mesh | None):
        """
        Args:
            folder: made when it is first written.
            given: all that the cohort depends on by name, as `Checkpoint` takes it.
            mesh: of the devices.
        """
        self._folder, self._marks = folder, {} if folder is None else marks_of(given)
        self._several = mesh is not None and mesh.is_multi_process
        self._writes = folder is not None and (not self._several or jax.process_index() == 0)

    def read(self, name: str, like: Callable[[], Any]) -> Any:
        """The pytree of a name, in the structure that `like` makes; None where it has not been written.

        Raises:
            ValueError: the file is of a cohort of other inputs, or is damaged.
        """
        if self._folder is None:
            return None
        file = self._file(name)
        found = file.read_tree(like()) if self._writes and file.path.is_file() else None
        if not self._several:
            return found
        if not multihost_utils.broadcast_one_to_all(np.asarray(found is not None)):
            return None
        return share_first(like() if found is None else found)

    def write(self, name: str, tree: Any) -> None:
        """Keep a pytree."""
        if self._writes:
            self._file(name).write_tree(tree)

    def recall_strengths(self, find: Callable[[], FromTargets]) -> FromTargets:
        """Those that a pilot finds, or found before."""
        arrays = self._file("pilot").read() if self._writes else None
        if arrays is not None:
            rest = {name: arrays.pop(name) for name in _OF_PILOT}
            found = FromTargets(arrays, **rest)
        else:
            found = jax.tree.map(np.asarray, find())
            if self._writes:
                self._file("pilot").write(found.values | {name: getattr(found, name) for name in _OF_PILOT})
        return share_first(found) if self._several else found

    def _file(self, name: str) -> Checkpoint:
        assert self._folder is not None
        return Checkpoint(self._folder / CHECKPOINT_OF_COHORT.format(name), self._marks)


def share_first(tree: Any) -> Any:
    """The arrays that the first process has, on the host of all."""
    return jax.tree.map(np.asarray, multihost_utils.broadcast_one_to_all(tree))


def find_size_class(n_points: int) -> int:
    """How many points a scan is filled up to: 1024, or the next size in steps that grow by a quarter."""
    size = _SMALLEST
    while size < n_points:
        size = int(size * _GROWTH)
    return size


def sort_into_classes(n_points: Sequence[int]) -> list[tuple[int, list[int]]]:
    """Size classes in ascending order, each with the rows of its scans.

    Args:
        n_points: of each scan.
    """
    classes: dict[int, list[int]] = {}
    for i, n in enumerate(n_points):
        classes.setdefault(find_size_class(n), []).append(i)
    found: list[tuple[int, int, list[int]]] = []  # each with the size that its smallest scans would have alone
    for size, members in sorted(classes.items()):
        least = size
        if found and len(found[-1][2]) < _FEW and size <= _MOST_GROWN * found[-1][1]:
            _, least, fewer = found.pop()
            members = fewer + members
        found.append((size, least, members))
    return [(size, members) for size, _, members in found]


def fit_in_buckets(
    solver: Sweeps,
    starts: list[tuple[Model, Variables]],
    scenes: list[Scene],
    *,
    at_once: int,
    mesh: Mesh | None,
    kept: Kept,
    on_stage: Callable[[str], None],
) -> list[tuple[Variables, State]]:
    """Fit every subject, from the smallest size class to the largest.

    Args:
        starts: the model and variables of each, filled up to common sizes but for the points of its scan.
        scenes: the scan of each.
        at_once: how many subjects share each operation of a device.
        mesh: devices that share a bucket; None for the default one alone.
        kept: buckets that are done.
        on_stage: told of each size class, and of each bucket.

    Returns:
        The variables and the state of each at its end, on the host, filled up as they were fitted.
    """
    # One device is a mesh too: its program is then that of many, to the last bit.
    mesh = mesh or Mesh(np.array([*jnp.zeros(()).devices()]), ("subjects",))
    n_bucket = at_once * mesh.size
    has_slices = any(scene.of_points is not None for scene in scenes)
    shared, own = split_common(starts)
    common = _place((solver, shared), mesh, P())
    classes = sort_into_classes([scene.scan.n_points for scene in scenes])
    buckets = [(size, members[k : k + n_bucket]) for size, members in classes for k in range(0, len(members), n_bucket)]

    def arguments(size: int, members: list[int]) -> tuple[Any, ...]:
        filled = members + members[-1:] * (n_bucket - len(members))
        rows = stack([(own[i], fill_scene(scenes[i], size, has_slices)) for i in filled])
        return *common, _place(rows, mesh, _divide(mesh)), at_once, mesh

    found: list[Any] = [None] * len(starts)
    like: dict[int, Any] = {}
    told: set[int] = set()
    for number, (size, members) in enumerate(buckets):

        def ends_like(size: int = size, members: list[int] = members) -> Any:
            if size not in like:
                shapes = eqx.filter_eval_shape(_run, *arguments(size, members))
                like[size] = jax.tree.map(lambda one: np.zeros(one.shape, one.dtype), shapes)
            return like[size]

        ends = kept.read(f"{number:05d}", ends_like)
        if ends is None:
            given = arguments(size, members)
            if size not in told:
                told.add(size)
                on_stage(_describe(size, len(dict(classes)[size]), n_bucket, given))
            ends = _fetch(_run(*given), mesh)
            kept.write(f"{number:05d}", ends)
        for k, i in enumerate(members):
            found[i] = jax.tree.map(lambda values, k=k: values[k], ends)
        on_stage(f"{sum(len(some) for _, some in buckets[: number + 1]):,} of {len(starts):,} scans are fitted")
    return found


@eqx.filter_jit
def _run(solver: Sweeps, shared: Any, own: Any, at_once: int, mesh: Mesh) -> tuple[Variables, State]:
    """A bucket: on each device as many subjects as share its operations."""
    common, static = eqx.partition((solver, shared), eqx.is_array)

    def fit_all(common: Any, own: Any) -> tuple[Variables, State]:
        solver, shared = eqx.combine(common, static)

        def fit_one(own: Any) -> tuple[Variables, State]:
            of_start, scene = own
            model, y = eqx.combine(shared, of_start)
            subject = Subject(model, scene)
            found = optx.least_squares(subject_residual, solver, y, subject, max_steps=None, throw=False)
            return found.value, found.stats["state"]

        return lax.map(fit_one, own, batch_size=None if at_once == 1 else at_once)

    rows = _divide(mesh)
    return jax.shard_map(fit_all, mesh=mesh, in_specs=(P(), rows), out_specs=rows, check_vma=False)(common, own)


def _describe(size: int, n: int, n_bucket: int, given: tuple[Any, ...]) -> str:
    """What a size class takes, before it is fitted."""
    program: Any = _run
    found = program.lower(*given).compile().compiled.memory_analysis()
    words = f"fits {n:,} scans of up to {size:,} points, {n_bucket:,} at once"
    if found is None:
        return words
    memory = js.Memory(found.argument_size_in_bytes, found.output_size_in_bytes, found.temp_size_in_bytes)
    return f"{words}, in {memory.total / 1e6:,.0f} MB of each device"


def _divide(mesh: Mesh) -> P:
    """Subjects divided between all devices."""
    return P(mesh.axis_names)


def _place(tree: Any, mesh: Mesh, how: P) -> Any:
    """The arrays of a pytree on the devices that work with them, of which every process gives those of its own."""

    def placed(leaf: Any) -> Any:
        if not eqx.is_array(leaf):
            return leaf
        array = np.asarray(leaf, jax.dtypes.canonicalize_dtype(leaf.dtype))
        return jax.make_array_from_callback(array.shape, NamedSharding(mesh, how), array.__getitem__)

    return jax.tree.map(placed, tree)


def _fetch(tree: Any, mesh: Mesh) -> Any:
    """The arrays of a pytree on the host, whole in every process."""
    if mesh.is_multi_process:
        tree = multihost_utils.process_allgather(tree, tiled=True)
    return jax.tree.map(np.asarray, tree)
