"""The refinement as a layer of a network: control vertices in, a smooth surface out."""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._control import Control
from ._frozen import Frozen
from ._normals import estimate_normals
from ._refine import refine
from ._scheme.base import AbstractScheme
from ._surface import RefinedSurface
from ._topology import Topology


class SurfaceLayer(eqx.Module):
    """Refines control vertices that a network predicts.

    The layer has one parameter at most: the tangent length coefficient h, if it is trained. Everything else in the
    layer is held where neither gradients nor weight decay reach it. A trained h stays within its range by

    h = low + (high - low) sigmoid(x + x_0),

    where x is the parameter, which starts at 0, and x_0 belongs to the scheme's own h. Weight decay thus draws h
    towards the scheme's own.

    Attributes:
        parameter: x of the formula, a scalar or one a level; None where h is fixed.
        h_range: low and high, the ends of the range.

    Pass the layer, or the model that holds it, into your `jax.jit` as an argument: the tables of a layer that is closed
    over are copied into the compiled program.
    """

    parameter: Float[Array, "..."] | None
    h_range: tuple[float, float] = eqx.field(static=True)
    _fixed: Frozen

    def __init__(
        self,
        scheme: AbstractScheme,
        topology: Topology,
        *,
        train_h: bool = False,
        h_range: tuple[float, float] = (0.25, 2.0),
    ):
        """Make a layer.

        Args:
            scheme: the rules, and the h to start from or to keep.
            topology: tables from `build_topology`, whose number of levels is that of the layer. Padded ones from
                `pad_topology` serve too, and those of different meshes from `stack_topologies`.
            train_h: whether h is a parameter.
            h_range: of a trained h. The limit surface is smooth for 0 < h < 3; the default range keeps away from both
                ends.

        Raises:
            ValueError: the scheme has no h to train, the range is empty or not finite, or the scheme's h does not lie
                inside of the range.
        """
        low, high = (float(end) for end in h_range)
        self.h_range, self.parameter = (low, high), None
        if train_h:
            if scheme.h is None:
                raise ValueError(f"{type(scheme).__name__} has no h to train. Leave `train_h` out.")
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ValueError(f"`h_range` must be two finite numbers, the smaller one first; got {h_range}.")
            start = np.asarray(scheme.h)
            if not np.all((low < start) & (start < high)):
                raise ValueError(
                    f"the scheme's h must lie between {low:g} and {high:g}, the `h_range`; got {start.tolist()}. "
                    "Change one of them."
                )
            self.parameter = jnp.zeros_like(scheme.h)
        self._fixed = Frozen((scheme, topology))

    @property
    def topology(self) -> Topology:
        """The tables."""
        return self._fixed.thaw()[1]

    @property
    def scheme(self) -> AbstractScheme:
        """The scheme with the h that it has now."""
        scheme = self._fixed.thaw()[0]
        if self.parameter is None:
            return scheme
        low, high = self.h_range
        share = (scheme.h - low) / (high - low)
        x_0 = (jnp.log(share) - jnp.log1p(-share)).astype(self.parameter.dtype)
        h = low + (high - low) * jax.nn.sigmoid(self.parameter + x_0)
        return eqx.tree_at(lambda scheme: scheme.h, scheme, h)

    def __call__(
        self,
        vertices: Float[Array, "*batch v 3"],
        normals: Float[Array, "*batch_or_none v 3"] | None = None,
        *,
        key: Any = None,
    ) -> RefinedSurface:
        """The refined surface of one control mesh, or of a batch of them.

        Args:
            vertices: control vertices, with any leading axes; for stacked topologies with one, a row a mesh. Spare
                vertices of padded topologies are ignored.
            normals: control normals of any length, with the same leading axes, or `[v, 3]` for all of them. Default:
                those of the control faces, eqs. (4)-(6) with the weights of the area, differentiable in the vertices.
            key: not used; layers of equinox take one.

        Returns:
            Vertices and normals with the leading axes of `vertices`. The faces are those of the topology, without
            leading axes unless it is stacked. float16 and bfloat16 are widened: the result is float32, or float64 if an
            argument is.

        Raises:
            ValueError: at trace time, if the shapes do not fit the topology or one another.
        """
        scheme, topology = self.scheme, self.topology
        vertices = jnp.asarray(vertices)
        shape, meshes = vertices.shape, topology.control_fans.order.shape[:-1]
        if meshes and shape[:-2] != meshes:
            raise ValueError(
                f"the topology has the tables of {meshes[0]} meshes, so `vertices` must have the shape [{meshes[0]}, "
                f"{topology.n_control_vertices}, 3]; got {list(shape)}. More axes go through `jax.vmap`."
            )
        if shape[-2:] != (topology.n_control_vertices, 3):
            raise ValueError(
                f"the topology has {topology.n_control_vertices} control vertices, so `vertices` must have the shape "
                f"[..., {topology.n_control_vertices}, 3]; got {list(shape)}."
            )
        if normals is not None:
            normals = jnp.asarray(normals)
            if normals.shape not in (shape, shape[-2:]):
                raise ValueError(
                    f"`normals` must have the shape of `vertices`, {list(shape)}, or {list(shape[-2:])}; got "
                    f"{list(normals.shape)}."
                )
        wide = any(a is not None and a.dtype == jnp.float64 for a in (vertices, normals))
        dtype = jnp.dtype(jnp.float64 if wide else jnp.float32)

        vertices = vertices.astype(dtype)
        normals = None if normals is None else jnp.broadcast_to(normals.astype(dtype), shape)

        def refine_one(
            topology: Topology, vertices: Any, normals: Any
        ) -> tuple[Float[Array, "w 3"], Float[Array, "w 3"]]:
            if topology.real is not None:  # a spare vertex lies on the first one
                there = topology.real.control_vertices[:, None]
                vertices = jnp.where(there, vertices, vertices[:1])
                normals = None if normals is None else jnp.where(there, normals, normals[:1])
            if normals is None:
                normals = estimate_normals(topology.control_fans, vertices)
            surface = refine(scheme, topology, Control(vertices, normals))
            return surface.vertices, surface.normals

        if meshes:
            found = jax.vmap(refine_one)(topology, vertices, normals)
        else:
            of_control = functools.partial(refine_one, topology)
            for _ in shape[:-2]:
                of_control = jax.vmap(of_control)
            found = of_control(vertices, normals)
        return RefinedSurface(*found, topology.faces)
