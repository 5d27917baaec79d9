"""What a fit makes small: the distances to the scan, and the rows of its priors."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

import jaxsubdiv as js
from jaxsubdiv.linalg import dot

from .priors import (
    REGISTER,
    AbstractFacePrior,
    AbstractPrior,
    AbstractSurfacePrior,
    AbstractVertexPrior,
    Place,
    Priors,
    Start,
)
from .priors.shifts import ShiftPrior
from .unknowns import Free, Layout, Unknowns, Variables


class Pairs(NamedTuple):
    """Scan points and the surface points paired with them, as one sweep holds them fixed."""

    points: Float[Array, "p 3"]
    corners: Int[Array, "p 4"]
    """Vertices of the refined surface around each surface point."""
    corner_weights: Float[Array, "p 4"]
    directions: Float[Array, "p 3"]
    """Unit vectors along which the distance is measured, from the surface to the point: the surface slides freely
    across them."""


class Model(eqx.Module):
    """What is fitted, all tables built: surface, priors, and how the unknowns stand in a vector.

    Attributes:
        scheme: with the h where the fit starts.
        topology: tables of the control mesh.
        priors: those that are in force.
        layout: of the unknowns.
        is_free: 1 for the unknowns that may move, 0 for those that a mask of `Free` fixes.
        template: control vertices where the fit started, in mm.
        edge: length of a control edge there, in mm.
    """

    scheme: js.AbstractScheme
    topology: js.Topology
    priors: tuple[AbstractPrior, ...]
    layout: Layout
    is_free: Float[Array | np.ndarray, "n"]
    template: Float[Array, "v 3"]
    edge: Float[Array, ""]

    def prior(self, name: str) -> AbstractPrior | None:
        """The prior of a name, where it is in force."""
        return next((prior for prior in self.priors if prior.name == name), None)

    def strip_strengths(self) -> "Model":
        """The model without what its rows do not depend on."""
        return dataclasses.replace(self, priors=tuple(prior.strip_strengths() for prior in self.priors))

    @property
    def face_priors(self) -> list[AbstractFacePrior]:
        """Priors whose rows lie in control faces."""
        return [prior for prior in self.priors if isinstance(prior, AbstractFacePrior)]

    @property
    def vertex_priors(self) -> list[AbstractVertexPrior]:
        """Priors whose rows tie control vertices anywhere."""
        return [prior for prior in self.priors if isinstance(prior, AbstractVertexPrior)]

    @property
    def surface_priors(self) -> list[AbstractSurfacePrior]:
        """Priors whose rows tie vertices of the surface anywhere."""
        return [prior for prior in self.priors if isinstance(prior, AbstractSurfacePrior)]

    def scheme_at(self, y: Variables) -> js.AbstractScheme:
        """The scheme with its h."""
        return self.scheme if "h" not in y.shared else eqx.tree_at(lambda s: s.h, self.scheme, y.shared["h"])

    def refine(self, y: Variables) -> js.RefinedSurface:
        """The surface of the variables."""
        return js.refine(self.scheme_at(y), self.topology, y.control)

    def place(self, y: Variables, surface: js.RefinedSurface | None = None) -> Place:
        """Where rows are evaluated; unknowns that do not last are 0 unless `y` has them."""
        dtype = self.edge.dtype
        missing = {name: jnp.zeros(of.shape, dtype) for name, of in self.layout.shared if name not in y.shared}
        values = self.scheme_at(y), self.topology, y.control, missing | y.shared
        return Place(*values, surface, self.template, self.edge)

    def place_of(self, y: Variables) -> Place:
        """The same with the surface; see `Place.before`."""
        scheme, topology = self.scheme_at(y), self.topology
        keeps_normals = scheme.uses_normals and not scheme.recomputes_normals and not topology.mesh_normals
        if not keeps_normals or not topology.tells_levels:
            return self.place(y, self.refine(y))
        *_, before, surface = js.refine_levels(scheme, topology, y.control)
        return self.place(y, surface)._replace(before=before)

    def retract(self, y: Variables, offset: Unknowns) -> Variables:
        """The variables with an offset put on."""
        return self.layout.retract(y, offset, js.edge_length(self.topology, y.control.vertices))

    def keep_lasting(self, y: Variables) -> Variables:
        """The variables without the unknowns that only let a step move along with them."""
        kept = {name: y.shared[name] for name, of in self.layout.shared if of.lasting}
        return Variables(y.control, kept)

    def hold(self, place: Place, strengths: dict[str, Any]) -> dict[str, object]:
        """What every prior holds fixed during a sweep that starts from here."""
        return {prior.name: prior.hold(place, strengths) for prior in self.priors}


class Held(NamedTuple):
    """What one sweep holds fixed: the `args` of its residual."""

    pairs: Pairs
    faces: Int[Array | np.ndarray, "p"]
    """The face of the surface that each point is paired with."""
    of_points: Int[Array | np.ndarray, "p"] | None
    """The row of the slice of each scan point, -1 where that stays; None where no slice may be shifted."""
    shifts: Float[Array, "s 2"] | None
    """The shifts that `pairs.points` have put on."""
    distance_precisions: Float[Array, "p"]
    """1 / variance of every distance."""
    priors: dict[str, object]
    """What each prior holds, by its name."""
    precisions: dict[str, object]
    """1 / variance of the rows of each prior, by its name."""


class Residual(eqx.Module):
    """The rows of a fit over their standard deviations, for any least-squares solver of optimistix.

    `residual(y, held)` takes `Variables` and what a sweep holds fixed. `residual.recentre(y)` is the same as a function
    of offsets (`Unknowns`) from `y`, each scaled to about 1 mm, in which normals have two coordinates: that is what
    `optx.LevenbergMarquardt` and `optx.GaussNewton` solve best.
    """

    model: Model

    def __call__(self, y: Variables, held: Held) -> dict[str, Float[Array, "_"]]:
        rows = self.rows(y, held)
        precisions = {"distance": held.distance_precisions} | held.precisions
        return {name: jnp.sqrt(jnp.asarray(precisions[name], row.dtype)) * row for name, row in rows.items()}

    def rows(self, y: Variables, held: Held) -> dict[str, Float[Array, "_"]]:
        """The rows before they are weighed, by the name of their prior; those of the scan are "distance"."""
        place = self.model.place_of(y)
        assert place.surface is not None
        found = {"distance": self.distances(place, held)}
        return found | {prior.name: prior.rows(place, held.priors[prior.name]) for prior in self.model.priors}

    def distances(self, place: Place, held: Held) -> Float[Array, "p"]:
        """How far the surface points lie from their scan points, in mm, along the directions held fixed; no lengths, so
        that a perfect fit has a derivative too."""
        assert place.surface is not None
        distances = signed_distances(place.surface.vertices, held.pairs)
        if held.of_points is None or held.shifts is None:
            return distances
        change = (place.shared["shifts"] - held.shifts).astype(distances.dtype)
        return distances - self.project_shifts(held, change)

    def project_shifts(self, held: Held, shifts: Float[Array, "s 2"]) -> Float[Array, "p"]:
        """How far shifts of slices move each point along its direction."""
        prior = self.model.prior("shift")
        assert isinstance(prior, ShiftPrior) and held.of_points is not None
        planes = jnp.asarray(prior.planes, shifts.dtype)
        moved = jnp.sum(shifts[:, :, None] * planes, axis=1)[jnp.maximum(held.of_points, 0)]
        return jnp.where(held.of_points >= 0, dot(held.pairs.directions, moved)[:, 0], 0.0)

    def recentre(self, y: Variables) -> "OffsetResidual":
        """The same as a function of offsets from `y`."""
        return OffsetResidual(self, y)


class OffsetResidual(eqx.Module):
    """A residual as a function of offsets; see `Residual.about`."""

    residual: Residual
    y: Variables

    def __call__(self, offset: Unknowns, held: Held) -> dict[str, Float[Array, "_"]]:
        model = self.residual.model
        free = model.layout.join(offset, jnp) * jnp.asarray(model.is_free, self.y.control.vertices.dtype)
        return self.residual(model.retract(self.y, model.layout.split(free)), held)

    @property
    def zero(self) -> Unknowns:
        """The offset of nothing: where a solver starts."""
        layout = self.residual.model.layout
        return layout.split(jnp.zeros(layout.n, self.y.control.vertices.dtype))


def signed_distances(vertices: Float[Array, "v 3"], pairs: Pairs) -> Float[Array, "p"]:
    """How far the surface points lie from their scan points, along the directions held fixed."""
    pairs = Pairs(*map(jnp.asarray, pairs))  # those of a finished fit are on the host
    away = js.sum_corners(vertices, pairs.corners, pairs.corner_weights) - pairs.points
    return dot(pairs.directions, away)[:, 0]


def analyse(
    scheme: js.AbstractScheme,
    topology: js.Topology,
    control: js.Control,
    free: Free,
    priors: Priors,
    inputs: dict[str, object],
) -> tuple[Model, Variables]:
    """Build all tables of a fit, in numpy, and the variables where it starts.

    Args:
        control: where the fit starts, checked, with unit normals.
        inputs: what belongs to this scan alone, by name; see `Start`.

    Raises:
        ValueError: nothing is free, or a prior cannot be made.
    """
    n_vertices = topology.n_control_vertices
    masks = free.masks(scheme, n_vertices)
    has_vertices, has_normals, has_h = (bool(np.any(masks[name])) for name in ("vertices", "normals", "h"))
    surface = js.refine(scheme, topology, control)
    owner = js.control_faces_of(scheme, topology, surface, control)
    start = Start(scheme, topology, control, surface, owner, has_normals, has_h, inputs)
    made = [prior for kind in REGISTER if (prior := kind.make(priors, start)) is not None]
    shared = {name: of for prior in made for name, of in prior.shared_unknowns().items()}
    layout = Layout(n_vertices, has_vertices, has_normals, tuple(shared.items()))
    rows = [
        np.repeat(np.asarray(masks[name])[:, None], width, axis=1)
        for name, width in (("vertices", 3), ("normals", 2))
        if np.any(masks[name])
    ]
    own = np.concatenate(rows, axis=1).ravel() if rows else np.zeros(0)
    is_free = np.concatenate([own, np.ones(layout.n - layout.n_own)]).astype(float)
    values = {name: value for prior in made for name, value in prior.initial_values().items()}
    edge = jnp.asarray(js.edge_length(topology, control.vertices))
    model = Model(scheme, topology, tuple(made), layout, is_free, control.vertices, edge)
    return model, Variables(control, values)
