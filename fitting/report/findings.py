"""What speaks against a fit. A check is one function and its place in `CHECKS`."""

from collections.abc import Callable

import numpy as np
import optimistix as optx
from jaxtyping import Float

import jaxsubdiv as js
from jaxsubdiv.errors import name_rows

from ..finding import Finding
from .coverage import unit
from .evidence import (
    NOISE_OVER_EDGE,
    NOISE_OVER_OWN,
    Evidence,
    are_among_their_own,
    find_own_crossings,
    find_two_walls,
    rests_far_off,
)

# Each limit lies between the fits that are wrong and those that are right of tests/bench/fit_trust.py.
_UNEXPLAINED_FAR, _FAR, _UNEXPLAINED = 0.03, 0.1, 0.08  # far: in control edges
_UNSUPPORTED = 0.5
_TWO_WALLS, _ROUNDING = 0.15, 1e-4  # of a control edge
_AGAINST, _FACING = 0.05, -0.5
_JUMP, _LAST = 1.2, 7


def find_what_speaks_against(seen: Evidence) -> list[Finding]:
    """The findings about where the fit started, and those of every check."""
    own = (check(seen) for check in CHECKS)
    return [*seen.fit.origin.findings, *(finding for finding in own if finding is not None)]


def check_convergence(seen: Evidence) -> Finding | None:
    """Whether the surface came to rest."""
    if any(seen.fit.result == end for end in (optx.RESULTS.successful, optx.RESULTS.nonlinear_divergence)):
        return None  # of the latter `check_rest` tells
    return Finding(
        "not_converged",
        f"the fit did not converge in {len(seen.fit.rms) - 1} sweeps: the surface is where it stopped. Give more "
        "sweeps or a better start.",
        {"sweeps": len(seen.fit.rms) - 1},
    )


def check_rest(seen: Evidence) -> Finding | None:
    """Whether a surface at rest was moved to the scan at all."""
    fit = seen.fit
    unmoved = optx.RESULTS.successful, optx.RESULTS.nonlinear_divergence
    if not any(fit.result == end for end in unmoved):
        return None
    if not rests_far_off(fit.scene, seen.noise, seen.edge, fit.robust_rms):
        return None
    return Finding(
        "rests_where_it_started",
        f"the surface came to rest {seen.noise:.3g} mm from the scan, hardly nearer than it started: the priors hold "
        "it there, or the start is off. Give softer priors, a template that was not fitted to another scan, or a "
        "better start.",
        {"noise": seen.noise, "start": float(fit.robust_rms[0]), "end": float(fit.robust_rms[-1])},
    )


def check_noise(seen: Evidence) -> Finding | None:
    """Whether the distances are noise of the scan, or a surface that is wrong."""
    over_own, over_edge = seen.noise / max(seen.own.noise, 1e-9 * seen.edge), seen.noise / seen.edge
    if np.isnan(over_own) or over_own < NOISE_OVER_OWN or over_edge < NOISE_OVER_EDGE:
        return None
    return Finding(
        "noise_above_the_scans_own",
        f"the distances to the surface, {seen.noise:.3g} mm, are taken for noise, but neighbouring points of the scan "
        f"lie within {seen.own.noise:.2g} mm of a plane, {over_own:.1f} times less. The surface misses what the scan "
        "shows: look at the worst places; give more faces, or a better start.",
        {"noise": seen.noise, "own_noise": seen.own.noise, "edge": seen.edge},
    )


def check_unexplained_points(seen: Evidence) -> Finding | None:
    """Whether points that lie on some surface lie on this one."""
    there = seen.own.sampled
    off = there.copy()
    off[there] = are_among_their_own(np.asarray(seen.fit.look.pairs.points, np.float64)[there], ~seen.inliers[there])
    share = float(off.sum() / max(there.sum(), 1))
    if share < _UNEXPLAINED_FAR:
        return None
    far, at = float(np.median(np.abs(seen.distances[off]))), seen.feet[off].mean(axis=0)
    if share < _UNEXPLAINED and far < _FAR * seen.edge:
        return None  # detail that the control mesh is too coarse for
    return Finding(
        "points_unexplained",
        f"{share:.0%} of the points that are not scattered lie off the surface by more than 3 x the noise, half of "
        f"them by over {far:.3g} mm, around ({_place(at)}). Does the scan show another object, or "
        "a part that the control mesh lacks?",
        {"share": share, "median_distance": far},
    )


def check_unsupported_surface(seen: Evidence) -> Finding | None:
    """Whether most of the surface has points."""
    total = seen.areas.sum()
    share = float(seen.areas[~seen.covered].sum() / total) if total > 0 else 1.0
    if share < _UNSUPPORTED:
        return None
    bare = np.asarray(seen.surface.vertices, np.float64)[~seen.covered].mean(axis=0)
    return Finding(
        "surface_unsupported",
        f"{share:.0%} of the surface has no point of the scan near, around ({_place(bare)}): "
        "there it follows from the template and the priors alone.",
        {"share": share},
    )


def check_two_walls(seen: Evidence) -> Finding | None:
    """Whether the surface lies between two layers of points."""
    kept = seen.inliers & seen.own.sampled
    share, apart = find_two_walls(seen.feet[kept], seen.sides[kept], seen.distances[kept], _ROUNDING * seen.edge)
    if share < _TWO_WALLS:
        return None
    return Finding(
        "two_walls",
        f"on {share:.0%} of the surface the points lie in two layers, {apart:.3g} mm apart, and the surface "
        "between them. Keep one of the walls, by labels or normals.",
        {"share": share, "apart": apart},
    )


def check_facing(seen: Evidence) -> Finding | None:
    """Whether the scan's normals point as the surface's do."""
    normals = seen.fit.scan.normals
    if normals is None:
        return None
    own = np.asarray(normals, np.float64)
    there = seen.inliers & seen.own.sampled & (own != 0).any(axis=1)
    if not there.any():
        return None
    cosine = np.einsum("px,px->p", unit(own[there]), seen.sides[there])
    share = float(np.mean(cosine * np.sign(cosine.sum()) < _FACING))  # outside is the side that most points are on
    if share < _AGAINST:
        return None
    return Finding(
        "points_face_against",
        f"the normals of {share:.0%} of the points face against the surface where they lie on it: they may show the "
        "other side of something thin.",
        {"share": share},
    )


def check_jumps(seen: Evidence) -> Finding | None:
    """Whether the distances fell to the end, or rose again and again."""
    last = seen.fit.robust_rms[1:][-_LAST:]
    rises = last[1:] / np.maximum(last[:-1], np.finfo(float).tiny)
    rises = rises[rises > _JUMP]
    if len(rises) < 2:
        return None
    return Finding(
        "distances_jump",
        f"the RMS distance of the points that count rose in {len(rises)} of the last {len(last) - 1} sweeps, by up to "
        f"{rises.max() - 1:.0%}: the surface goes to and fro. Give a better start, or fewer faces.",
        {"rises": len(rises), "largest": float(rises.max())},
    )


def check_crossings(seen: Evidence) -> Finding | None:
    """Whether the surface goes through itself; layers may go through each other."""
    found = seen.crossings
    if found is None or not len(found.triangles):
        return None
    fit = seen.fit
    start = find_own_crossings(js.refine(fit.model.scheme, fit.topology, fit.start), seen.layers).triangles
    since = "The surface did not where the fit started."
    if len(start):
        since = f"Where the fit started {len(start)} did already, rows {name_rows(start)}: mend the control mesh there."
    return Finding(
        "surface_crosses_itself",
        f"{len(found.triangles):,} of the surface's {found.n_triangles:,} triangles go through others, rows "
        f"{name_rows(found.triangles)}, around ({_place(np.median(found.places, axis=0))}). {since}",
        {"triangles": len(found.triangles), "at_start": len(start), "share": len(found.triangles) / found.n_triangles},
    )


def _place(at: Float[np.ndarray, "3"]) -> str:
    return ", ".join(f"{x:.0f}" for x in at)


CHECKS: tuple[Callable[[Evidence], Finding | None], ...] = (
    check_convergence,
    check_rest,
    check_noise,
    check_unexplained_points,
    check_unsupported_surface,
    check_two_walls,
    check_facing,
    check_jumps,
    check_crossings,
)
