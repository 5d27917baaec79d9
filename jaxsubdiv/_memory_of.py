"""How much memory a refinement and its gradient take, told before they run."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from ._control import Control
from ._refine import refine
from ._scheme.base import AbstractScheme
from ._topology import Topology


class Memory(NamedTuple):
    """Bytes on the device that one call needs."""

    arguments: int
    """The tables, the control vertices and normals, and for a gradient the derivatives by the surface."""
    results: int
    """The surface, and the gradient where it was asked for."""
    temporaries: int
    """What XLA reserves besides, at most at once."""

    @property
    def total(self) -> int:
        """The sum."""
        return self.arguments + self.results + self.temporaries

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {size / 1e6:,.1f} MB" for name, size in self._asdict().items())
        return f"{self.total / 1e6:,.1f} MB: {parts}"


def memory_of(
    scheme: AbstractScheme,
    topology: Topology,
    *,
    batch: int = 1,
    dtype: Any = jnp.float32,
    gradient: bool = True,
) -> Memory:
    """How much memory a refined batch takes: the analysis of the compiled program by XLA. Nothing is computed.

    The program is compiled for it, which takes seconds and, with a persistent compilation cache, is done once. The loss
    and the network around the refinement come on top, and so does what the allocator holds back.

    Args:
        scheme: the rules.
        topology: tables from `build_topology`, with the levels that are asked about.
        batch: how many control meshes are refined at once.
        dtype: of the control vertices inside: float32 or float64.
        gradient: with the gradient by vertices, normals and h; else the surface alone.

    Raises:
        ValueError: the batch is empty, or the backend does not analyse its programs.
    """
    if batch < 1:
        raise ValueError(f"`batch` is a whole number from 1 on; got {batch}.")
    rows = jax.ShapeDtypeStruct((batch, topology.n_control_vertices, 3), jnp.dtype(dtype))
    scheme, topology = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype), (scheme, topology))

    def surface(scheme: AbstractScheme, topology: Topology, control: Any) -> Any:
        def refine_one(x: Any, n: Any) -> Any:
            found = refine(scheme, topology, Control(x, n))
            return found.vertices, found.normals

        return jax.vmap(refine_one)(*control)

    def surface_and_gradient(scheme: AbstractScheme, topology: Topology, control: Any, slopes: Any) -> Any:
        def by_h(h: Any, control: Any) -> Any:
            return surface(eqx.tree_at(lambda scheme: scheme.h, scheme, h, is_leaf=_is_none), topology, control)

        found, pull_back = jax.vjp(by_h, scheme.h, control)
        return found, pull_back(slopes)

    arguments: tuple[Any, ...] = (scheme, topology, (rows, rows))
    if gradient:
        arguments = (*arguments, jax.eval_shape(surface, *arguments))
    program = jax.jit(surface_and_gradient if gradient else surface).lower(*arguments).compile()
    found = program.memory_analysis()
    if found is None:
        raise ValueError(f"the backend {jax.default_backend()} does not say what memory its programs take.")
    return Memory(found.argument_size_in_bytes, found.output_size_in_bytes, found.temp_size_in_bytes)


def _is_none(leaf: Any) -> bool:
    return leaf is None
