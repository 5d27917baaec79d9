"""How smooth the surface is, and how like its template, found from the scan: the bend prior that makes the scan most
probable, place by place.

The strength of a Gaussian prior under which data are most probable obeys a fixed point: the bends that are left, over
their variance, equal the number of bends that the data do not determine. Source: D. MacKay, Bayesian interpolation,
1992, eq. (4.7); as an update for any number of strengths at once, S. Wood and M. Fasiolo, A generalized Fellner-Schall
method for smoothing parameter optimization, 2017, eq. (4). Here every control face has strengths of its own, shared
with its neighbourhood as the mean of logarithms and, a little, with the whole surface: a skull is smoother than an ear.

The prior's means are the template's bends times one number, the likeness. Under given strengths that is most probable
which is found together with the surface, as one more unknown. Source: C. Henderson, Best linear unbiased estimation and
prediction under a selection model, 1975, eq. (8).
"""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

import jaxsubdiv as js

Solve = Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, "n k"]]

_PROBES = 24  # random vectors of a trace; a face and its neighbourhood average over a hundred rows besides
_SHARE_OF_ALL = 0.05  # how much the whole surface counts beside a face
_TINY = np.finfo(float).tiny
_LARGEST_CHANGE = 5.0  # of a strength in one sweep: what it depends on is known for the present one only
_PART_OF_WAY = 0.5  # of the likeness: it and the strengths are found in turns, whole steps overshoot


def neighbourhoods(topology: js.Topology) -> sp.csr_array:
    """Averages of a value a face over the faces around each of its corners, the corners counting alike."""
    parts = [np.asarray(topology.control_faces[size]) for size in (3, 4)]
    corners = np.concatenate([part.ravel() for part in parts])
    counts = np.concatenate([np.full(len(part), part.shape[1]) for part in parts])
    face = np.repeat(np.arange(len(counts)), counts)
    at = sp.csr_array((np.ones(len(face)), (face, corners)), shape=(len(counts), topology.n_control_vertices))
    around = np.maximum(np.asarray(at.sum(axis=0)).ravel(), 1)
    return (sp.diags_array(1 / counts) @ at @ sp.diags_array(1 / around) @ at.T).tocsr()


def next_precision(
    precision: Float[np.ndarray, "s"],
    bends: Float[np.ndarray, "b"],
    by: sp.csr_array,
    strength: Int[np.ndarray, "b"],
    solve_prior: Solve,
    solve_posterior: Solve,
    around: sp.csr_array,
) -> Float[np.ndarray, "s"]:
    """One step of the fixed point.

    Args:
        precision: 1 / variance of a row, a strength each, in 1/mm^2; families of strengths one after the other, each
            with one for every control face.
        bends: in mm.
        by: their derivatives by the unknowns.
        strength: which is that of each row.
        solve_prior: with the normal matrix of all priors.
        solve_posterior: with that of the priors and the scan.
        around: see `neighbourhoods`.
    """
    root = np.sqrt(precision)[strength]
    probes = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(bends), _PROBES))
    sides = by.T @ (probes * root[:, None])
    free = root * np.mean(probes * (by @ (solve_prior(sides) - solve_posterior(sides))), axis=1)
    n = len(precision)
    determined = np.maximum(np.bincount(strength, free, n), 0)
    left, rows = np.bincount(strength, bends**2, n), np.bincount(strength, minlength=n)
    families = np.arange(n).reshape(-1, len(around.indptr) - 1)
    return np.concatenate([_of_family(precision[f], determined[f], left[f], rows[f] > 0, around) for f in families])


def _of_family(
    precision: Float[np.ndarray, "f"],
    determined: Float[np.ndarray, "f"],
    left: Float[np.ndarray, "f"],
    has_rows: Bool[np.ndarray, "f"],
    around: sp.csr_array,
) -> Float[np.ndarray, "f"]:
    """Next strengths, from how many rows the data determine on each face, and the squares that are left of all."""
    if determined.sum() < 1:  # rows in holes alone: nothing is known of them
        return precision
    # Where the scan says nothing, in a hole, the surface is as smooth as elsewhere.
    shared = _SHARE_OF_ALL * determined.sum() / max(has_rows.sum(), 1)
    usual = np.exp(np.average(np.log(precision), weights=determined + (shared + _TINY) * has_rows + _TINY))
    found = (shared + determined) / np.maximum(shared / usual + left, _TINY)
    changed = precision * np.clip(found / precision, 1 / _LARGEST_CHANGE, _LARGEST_CHANGE)
    # Means of the logarithms: means of the bends would be those of the one ear or rim in a neighbourhood, and leave
    # noise in all of it. Edges that are not halved belong to one face of two, and the other has no rows.
    votes = around @ has_rows
    means = around @ (np.log(changed) * has_rows) / np.where(votes > 0, votes, 1)
    return np.where(votes > 0, np.exp(means), precision)


def next_likeness(
    likeness: float,
    expected: Float[np.ndarray, "b"],
    precision: Float[np.ndarray, "b"],
    bends: Float[np.ndarray, "b"],
    by: sp.csr_array,
    solve_posterior: Solve,
) -> float:
    """A step towards the likeness, from 0 to 1, that makes the scan most probable; none where that is as near as the
    scan can tell.

    Args:
        expected: the template's bends in mm.
        precision: 1 / variance of each bend.
        bends: departures from what is expected now, in mm.
        by: their derivatives by the unknowns.
        solve_posterior: with the normal matrix of the priors and the scan.
    """
    side = by.T @ (precision * expected)
    # Beforehand it is 0, give or take 1: a template without bends, or without a scan over them, is expected nowhere.
    slope = float(expected @ (precision * bends)) - likeness
    curvature = float(expected @ (precision * expected) - side @ solve_posterior(side[:, None])[:, 0]) + 1
    if slope**2 < curvature:  # less than its own standard deviation
        return likeness
    return float(np.clip(likeness + _PART_OF_WAY * slope / curvature, 0.0, 1.0))
