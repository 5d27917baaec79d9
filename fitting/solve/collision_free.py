"""Steps that do not take a surface through itself, and the places where it comes near itself. numpy and ipctk."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js
from jaxsubdiv.extras import import_extra

from ..model.pairing import Look
from ..model.priors.contact import ContactPrior, Contacts, no_contacts
from ..model.residual import Model
from ..model.unknowns import Layout, Variables
from ..start.folds import Folds
from .elements import face_corners

_HELD_FASTER, _MOST_TRIES = 2, 16  # of a step, before none is taken
_LEAST_SHARE, _GRADE = 0.2, 0.25  # of a step that is left: less is nothing; from vertex to vertex it grows by this
_RINGS = 2  # of control faces around those that crossed in the last try
_COMMON = 90  # percentile of the heights of triangles: larger ones have the reach of these
_LEAST_REACH = 0.1  # of a contact, where the scan's layers touch: so much of the usual one
_LEAST_GAP = 0.02  # of the reach: standard deviation of nearer contacts
_PARALLEL = 1e-3  # squared sine between edges: their places are not unique, and their ends are contacts too


def _ipctk() -> Any:
    return import_extra("ipctk", "contact", "fits whose surface must not cross itself")


class CrossingGuard:
    """Keeps the refined surface of a control mesh from passing through itself.

    Attributes:
        reach: of contacts, as a part of the heights of the triangles there.
    """

    def __init__(self, model: Model, surface: js.RefinedSurface, owner: Int[np.ndarray, "g"], reach: float):
        """
        Args:
            surface: any of the fit's.
            owner: the control face of every face of the surface.
        """
        self.reach: float = reach
        self._folds = Folds(model.topology)
        self._no_quads = jnp.zeros((0, 4), jnp.int32)
        self._triangles = np.asarray(surface.triangles())
        n_triangles = len(surface.faces[3])
        self._owner = np.concatenate([owner[:n_triangles], np.repeat(owner[n_triangles:], 2)])
        self._face_of = np.zeros(len(surface.vertices), int)
        self._face_of[face_corners(surface.faces)] = owner[:, None]
        different = (self._triangles != np.roll(self._triangles, 1, axis=1)).all(axis=1)
        self._faces = np.asfortranarray(self._triangles[different].astype(np.int32))
        ipctk = _ipctk()
        self._edges = np.asfortranarray(ipctk.edges(self._faces))
        self._mesh = ipctk.CollisionMesh(_positions(surface), self._edges, self._faces)

    def crossing_faces(
        self, surface: js.RefinedSurface, among: Bool[np.ndarray, "f"] | None = None
    ) -> Bool[np.ndarray, "f"]:
        """The control faces whose part of the surface goes through another part of it.

        Args:
            among: control faces of which to look at; default: all.
        """
        found, x = np.zeros(len(self._folds.corners), bool), _positions(surface)
        if not np.isfinite(x).all():
            return found  # the fit ends of it
        if among is not None:
            rows = np.flatnonzero(among[self._owner])
            some = np.zeros((1 << len(rows).bit_length(), 3), np.int32)  # few sizes, which jax compiles once each
            some[: len(rows)] = self._triangles[rows]
            part = js.RefinedSurface(surface.vertices, surface.normals, {3: jnp.asarray(some), 4: self._no_quads})
            found[self._owner[rows[js.find_crossings(part).triangles]]] = True
        elif _ipctk().has_intersections(self._mesh, x):
            found[self._owner[js.find_crossings(surface).triangles]] = True
        return found

    def shorten(
        self,
        step: Float[np.ndarray, "n"],
        before: Bool[np.ndarray, "f"],
        layout: Layout,
        refine: Callable[[Float[np.ndarray, "n"]], js.RefinedSurface],
        solve_again: Callable[[Bool[np.ndarray, "v"]], Float[np.ndarray, "n"]],
    ) -> tuple[Float[np.ndarray, "n"], float]:
        """Shorten a step until nothing crosses that did not before: first where something would, then as a whole.

        First h stays, then the step is solved again with the vertices of the faces that would cross held faster. Only
        after that is the step cut. When tries run out there is no step, which crosses nothing.

        Args:
            before: control faces that cross already; they and those beside them are left alone.
            refine: makes the surface after a step.
            solve_again: the step without h and with some control vertices held faster, from call to call.

        Returns:
            The step, and what share of it is left where nothing would cross: 1, but where all of it had to be cut.
        """
        left_alone, near = self._around(before), None
        share, whole = np.ones(layout.n_vertices), 1.0
        for k in range(_MOST_TRIES):
            own = layout.repeat_per_unknown(share)
            taken = whole * step * np.concatenate([own, np.ones(layout.n - layout.n_own)])
            surface = refine(taken)
            # Most of what crossed still does: looking there first is soon done.
            crossing = np.zeros(len(before), bool) if near is None else self.crossing_faces(surface, near) & ~left_alone
            if not crossing.any():
                crossing = self.crossing_faces(surface) & ~left_alone
            if not crossing.any():
                return taken, whole
            near = crossing
            for _ in range(_RINGS):
                near = self._around(near)
            corners = self._folds.corners_of(crossing)
            if k == 0 and "h" in dict(layout.shared):  # which moves all of the surface, and may be at fault alone
                step = step.copy()
                step[layout.columns("h")] = 0.0
                continue
            if k <= _HELD_FASTER:
                step = solve_again(corners)
                continue
            if (share[corners] == 0).all():  # the faces move with the vertices around
                corners = self._folds.corners_of(self._around(crossing))
                if (share[corners] == 0).all():
                    whole *= 0.5
                share[corners] = 0.0
            share[corners] = np.where(share[corners] > _LEAST_SHARE, 0.5 * share[corners], 0.0)
            self._grade(share)
        return np.zeros_like(step), 0.0

    def _around(self, faces: Bool[np.ndarray, "f"]) -> Bool[np.ndarray, "f"]:
        """These control faces and those that have a vertex in common with them."""
        return self._folds.corners_of(faces)[self._folds.corners].any(axis=1)

    def _grade(self, share: Float[np.ndarray, "v"]) -> None:
        """Let shares grow from vertex to vertex by little, so that a step does not shear the faces between."""
        a, b = self._folds.sides.edges.T
        for _ in range(round(1 / _GRADE)):
            np.minimum.at(share, a, share[b] + _GRADE)
            np.minimum.at(share, b, share[a] + _GRADE)

    def find_contacts(self, surface: js.RefinedSurface, look: Look, before: Bool[np.ndarray, "f"]) -> Contacts:
        """Places of the surface that are nearer to each other than the reach.

        Where the scan's layers are nearer than that, the reach gives way to half of the distance between them.

        Args:
            look: the scan as seen from the surface.
            before: control faces that cross others: which way their places should go from each other is not known.
        """
        x = _positions(surface)
        reach = self.reach * self._heights(x)
        near = _ipctk().NormalCollisions()
        near.build(self._mesh, x, float(np.percentile(reach, _COMMON)))
        if not len(near):
            return no_contacts()
        corners, weights = self._places(x, near)
        apart = np.einsum("ci,cix->cx", weights, x[corners])
        gap = np.linalg.norm(apart, axis=1)
        reach = reach[corners].min(axis=1)
        kept = (gap > 0) & (gap < reach) & ~before[self._face_of[corners]].any(axis=1)
        corners, weights, gap, reach = corners[kept], weights[kept], gap[kept], reach[kept]
        directions = apart[kept] / gap[:, None]
        away = _offsets(look, len(x))[:, None] * np.asarray(surface.normals, np.float64)
        of_scan = gap + np.einsum("ci,cx,cix->c", weights, directions, away[corners])
        reach = np.clip(0.5 * of_scan, _LEAST_REACH * reach, reach)
        found = Contacts(corners.astype(np.int32), weights, directions, reach, np.maximum(gap, _LEAST_GAP * reach))
        return Contacts(*(part[gap < reach] for part in found))

    def _heights(self, x: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v"]:
        """The least height of the triangles at each vertex."""
        sides = x[self._faces[:, [1, 2, 0]]] - x[self._faces]
        areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        longest = np.linalg.norm(sides, axis=2).max(axis=1)
        found = np.full(len(x), np.inf)
        np.minimum.at(found, self._faces, (areas / np.maximum(longest, np.finfo(float).tiny))[:, None])
        return np.where(np.isfinite(found), found, 0.0)

    def _places(
        self, x: Float[np.ndarray, "v 3"], near: Any
    ) -> tuple[Int[np.ndarray, "c 4"], Float[np.ndarray, "c 4"]]:
        """The vertices of pairs of places, and their weights: of vertices, edges and triangles that lie near."""
        ends, corners, weights = self._edges, [np.zeros((0, 4), int)], [np.zeros((0, 4))]

        def add(places: Int[np.ndarray, "c 4"], first: Float[np.ndarray, "c"], second: Float[np.ndarray, "c"]) -> None:
            corners.append(places)
            weights.append(np.stack([first - 1, -first, 1 - second, second], axis=1))

        pairs = np.array([(one.vertex0_id, one.vertex1_id) for one in near.vv_collisions], int).reshape(-1, 2)
        none = np.zeros(len(pairs))
        add(pairs[:, [0, 0, 1, 1]], none, none)

        rows = np.array([(one.vertex_id, one.edge_id) for one in near.ev_collisions], int).reshape(-1, 2)
        a, b = ends[rows[:, 1]].T
        along = x[b] - x[a]
        second = np.einsum("cx,cx->c", x[rows[:, 0]] - x[a], along) / np.einsum("cx,cx->c", along, along)
        add(np.stack([rows[:, 0], rows[:, 0], a, b], axis=1), np.zeros(len(rows)), np.clip(second, 0, 1))

        rows = np.array([(one.edge0_id, one.edge1_id) for one in near.ee_collisions], int).reshape(-1, 2)
        places = np.concatenate([ends[rows[:, 0]], ends[rows[:, 1]]], axis=1)
        u, v = x[places[:, 1]] - x[places[:, 0]], x[places[:, 3]] - x[places[:, 2]]
        first, second, sine = _closest_on_plane(u, -v, x[places[:, 2]] - x[places[:, 0]])
        kept = sine > _PARALLEL
        add(places[kept], np.clip(first[kept], 0, 1), np.clip(second[kept], 0, 1))

        rows = np.array([(one.vertex_id, one.face_id) for one in near.fv_collisions], int).reshape(-1, 2)
        of_faces = self._faces[rows[:, 1]]
        a, b, c = (x[of_faces[:, i]] for i in range(3))
        second, third, sine = _closest_on_plane(b - a, c - a, x[rows[:, 0]] - a)
        kept = sine > _PARALLEL
        corners.append(np.concatenate([rows[:, :1], of_faces], axis=1)[kept])
        weights.append(np.stack([-np.ones(len(rows)), 1 - second - third, second, third], axis=1)[kept])
        return np.concatenate(corners), np.concatenate(weights)


def _closest_on_plane(
    u: Float[np.ndarray, "c 3"], v: Float[np.ndarray, "c 3"], to: Float[np.ndarray, "c 3"]
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "c"], Float[np.ndarray, "c"]]:
    """The s, t for which s u + t v is nearest to a vector, and the squared sine between u and v."""
    uu, uv, vv, ut, vt = (np.einsum("cx,cx->c", a, b) for a, b in ((u, u), (u, v), (v, v), (u, to), (v, to)))
    area, least = uu * vv - uv**2, np.finfo(float).tiny
    by = 1 / np.maximum(area, least)
    return (vv * ut - uv * vt) * by, (uu * vt - uv * ut) * by, area / np.maximum(uu * vv, least)


def _offsets(look: Look, n: int) -> Float[np.ndarray, "v"]:
    """How far the scan lies outside of each vertex of the surface, by the points paired beside it; 0 where none are."""
    corners = np.asarray(look.pairs.corners).ravel()
    shares = (np.asarray(look.pairs.corner_weights, np.float64) * np.asarray(look.weights)[:, None]).ravel()
    distances = np.repeat(np.asarray(look.distances, np.float64), 4)
    total = np.bincount(corners, shares, n)
    return np.bincount(corners, shares * distances, n) / np.where(total > 0, total, 1.0)


def _positions(surface: js.RefinedSurface) -> Float[np.ndarray, "v 3"]:
    return np.asfortranarray(np.asarray(surface.vertices, np.float64))


def make_guard(model: Model, y: Variables) -> CrossingGuard | None:
    """What keeps a fit's surface from passing through itself; None where nothing is to.

    Raises:
        ImportError: ipctk, of the extra `contact`, is not installed.
    """
    prior = model.prior("contact")
    if not isinstance(prior, ContactPrior):
        return None
    _ipctk()
    surface = model.refine(y)
    owner = js.control_faces_of(model.scheme, model.topology, surface, y.control)
    return CrossingGuard(model, surface, owner, float(prior.reach))
