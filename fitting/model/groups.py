"""Whether two groups of shapes differ, and where: permutation tests."""

from collections.abc import Iterator, Sequence
from itertools import combinations, islice
from math import comb
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.stats import false_discovery_control

from .limits import check_numbers
from .modes import shape_modes

_AT_ONCE = 1 << 24  # numbers in memory


class GroupDifference(NamedTuple):
    """The second group less the first, after both were moved onto their common mean."""

    groups: tuple[str, str]
    """The first and the second, in the order of their names."""
    counts: tuple[int, int]
    distance: float
    """Procrustes distance between the two means: root mean square over the vertices, in mm."""
    p: float
    """Of a distance as large where the groups mean nothing."""
    means: Float[np.ndarray, "2 v 3"]
    """In mm."""
    explained: Float[np.ndarray, "v"]
    """Part of each vertex' variance that the groups explain, 0 to 1."""
    p_vertex: Float[np.ndarray, "v"]
    """Of each vertex alone: over many vertices some are small by chance."""
    p_any: Float[np.ndarray, "v"]
    """Of such a difference at any vertex, where the groups mean nothing: by the maximum over all vertices."""
    q: Float[np.ndarray, "v"]
    """Least false discovery rate at which the vertex counts as a difference."""
    n_permutations: int
    """How many ways to divide the shapes were looked at: all of them where that is no more than was asked for."""


def compare_groups(
    vertices: ArrayLike, groups: Sequence[object], *, size: bool = False, n_permutations: int = 9999, seed: int = 0
) -> GroupDifference:
    """Test whether the mean shapes of two groups differ, as a whole and vertex by vertex.

    The shapes are moved onto their common mean once, then divided at random into groups of the same numbers again and
    again. The p-values are the share of the divisions that differ as much or more, the given one included.

    Args:
        vertices: corresponding vertices `[s, v, 3]` in mm.
        groups: the group of each shape, of any kind with two values.
        size: also scale the shapes to one size, that of the mean.
        n_permutations: how many random divisions.
        seed: of these.

    Raises:
        ValueError: there are not two groups of two shapes or more, or not one for each shape; another shape of array.

    Source: C. Goodall, Procrustes methods in the statistical analysis of shape, 1991; B. Phipson and G. Smyth,
    Permutation p-values should never be zero, 2010; P. Westfall and S. Young, Resampling-based multiple testing, 1993
    (the maximum); Y. Benjamini and Y. Hochberg, Controlling the false discovery rate, 1995.
    """
    check_numbers({"n_permutations": n_permutations})
    x = shape_modes(vertices, size=size).aligned
    n, v = x.shape[:2]
    names, second = _two_groups(groups, n)
    n_second = int(second.sum())
    flat = (x - x.mean(axis=0)).reshape(n, -1)
    total = np.sum(flat.reshape(n, v, 3) ** 2, axis=(0, 2))
    part = n_second * (n - n_second) / n  # of the squared difference of means: what lies between the groups

    def variance_between(rows: Float[np.ndarray, "b s"]) -> Float[np.ndarray, "b v"]:
        # The shapes sum to zero: the mean of the others follows from that of the second group.
        apart = rows @ flat * (1 / n_second + 1 / (n - n_second))
        return part * np.sum(apart.reshape(-1, v, 3) ** 2, axis=2)

    own = variance_between(second[None].astype(float))[0]
    scaled = np.maximum(total, np.finfo(float).tiny)
    own_max, own_all = own / scaled, own.sum()
    # Of random divisions, the given one is one more.
    n_seen = n_all = 0 if comb(n, n_second) <= n_permutations else 1
    at_least = np.full((2, v), float(n_all))
    for rows in _divisions(n, n_second, n_permutations, seed, max(1, _AT_ONCE // (3 * v))):
        found = variance_between(rows)
        # Rounding differs from one product to the next: the same division must count as the same.
        at_least[0] += np.sum(found >= own * (1 - 1e-9), axis=0)
        at_least[1] += np.sum((found / scaled).max(axis=1)[:, None] >= own_max * (1 - 1e-9), axis=0)
        n_all += int(np.sum(found.sum(axis=1) >= own_all * (1 - 1e-9)))
        n_seen += len(rows)
    p_vertex, p_any = at_least / n_seen
    means = np.stack([x[~second].mean(axis=0), x[second].mean(axis=0)])
    return GroupDifference(
        groups=names,
        counts=(n - n_second, n_second),
        distance=float(np.sqrt(np.mean(np.sum((means[1] - means[0]) ** 2, axis=1)))),
        p=n_all / n_seen,
        means=means,
        explained=own_max,
        p_vertex=p_vertex,
        p_any=p_any,
        q=false_discovery_control(p_vertex),
        n_permutations=n_seen,
    )


def _two_groups(groups: Sequence[object], n: int) -> tuple[tuple[str, str], np.ndarray]:
    words = np.array([str(group) for group in groups])
    names, rows = np.unique(words, return_inverse=True)
    counts = np.bincount(rows, minlength=2)
    if len(words) != n or len(names) != 2 or counts.min() < 2:
        told = ", ".join(f"{name} ({count})" for name, count in zip(names, counts, strict=False)) or "none"
        raise ValueError(
            f"two groups of two shapes or more are compared, one for each of the {n} shapes; got {len(words)}: {told}."
        )
    return (str(names[0]), str(names[1])), rows == 1


def _divisions(n: int, n_second: int, most: int, seed: int, at_once: int) -> Iterator[Float[np.ndarray, "b s"]]:
    """Divisions into groups, 1 for the second: all there are, or random ones."""
    if comb(n, n_second) <= most:
        chosen = (np.array(one) for one in combinations(range(n), n_second))
    else:
        rng = np.random.default_rng(seed)
        chosen = (rng.permutation(n)[:n_second] for _ in range(most))
    while some := list(islice(chosen, at_once)):
        rows = np.zeros((len(some), n))
        np.put_along_axis(rows, np.stack(some), 1.0, axis=1)
        yield rows
