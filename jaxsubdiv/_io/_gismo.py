"""XML files of G+Smo, the library for isogeometric analysis: geometries of many patches."""

import errno
import os
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..files import replace_file
from ..half_edges import half_edges

_KNOTS = '<KnotVector degree="3">0 0 0 0 1 1 1 1</KnotVector>'
_BASIS = (
    '  <Basis type="TensorBSplineBasis2">\n'
    f'   <Basis type="BSplineBasis" index="0">{_KNOTS}</Basis>\n'
    f'   <Basis type="BSplineBasis" index="1">{_KNOTS}</Basis>\n  </Basis>\n'
)
# Of the sides of a quad, from its first to its second corner and so on: G+Smo's number, the direction that runs along
# it, whether the side runs with this, and at which end of the other direction the side lies.
_NUMBER, _ALONG, _FORWARD, _AT = np.array([3, 2, 4, 1]), np.array([0, 1, 0, 1]), np.array([1, 1, 0, 0]), [0, 1, 1, 0]


def check_can_write_xml(path: str | os.PathLike[str]) -> Path:
    """The path of a file in a folder that is there.

    Raises:
        FileNotFoundError: the folder is not.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "the folder does not exist, create it first", str(path.parent))
    return path


def write_multipatch(path: Path, points: Float[np.ndarray, "q 16 3"], corners: Int[np.ndarray, "q 4"]) -> None:
    """Write bicubic patches, and which sides of them are one.

    Args:
        path: the file, which takes the place of another only once it is complete.
        points: control points of every patch, row by row, in the unit of the surface.
        corners: of every patch, by number: patches with two corners in common share a side.
    """
    path = check_can_write_xml(path)
    parts = ['<?xml version="1.0" encoding="UTF-8"?>\n<xml>\n']
    for number, rows in enumerate(points.tolist()):
        coefficients = "\n".join("   {!r} {!r} {!r}".format(*row) for row in rows)
        parts.append(
            f' <Geometry type="TensorBSpline2" id="{number}">\n{_BASIS}'
            f'  <coefs geoDim="3">\n{coefficients}\n  </coefs>\n </Geometry>\n'
        )
    found = zip(("interfaces", "boundary"), _pair_sides(corners), strict=True)
    sides = "".join(f"  <{name}>{_format_rows(rows)}</{name}>\n" for name, rows in found if len(rows))
    parts.append(
        f' <MultiPatch parDim="2" id="{len(points)}">\n  <patches type="id_range">0 {len(points) - 1}</patches>\n'
        f"{sides} </MultiPatch>\n</xml>\n"
    )
    with replace_file(path) as unfinished:
        unfinished.write_text("".join(parts), encoding="utf-8")


def _pair_sides(corners: Int[np.ndarray, "q 4"]) -> tuple[Int[np.ndarray, "i 8"], Int[np.ndarray, "b 2"]]:
    """Of every pair of sides: patch and side of both, which directions of the second those of the first are, and
    whether they run the same way; and patch and side of every side that has no other."""
    sides = half_edges({4: corners})
    order = np.argsort(sides.edge, kind="stable")
    counts = np.bincount(sides.edge, minlength=len(sides.edges))
    paired = counts[sides.edge[order]] == 2
    one, other = order[paired].reshape(-1, 2).T
    a, b = one % 4, other % 4
    along, across = _ALONG[a], 1 - _ALONG[a]
    rows = np.arange(len(one))
    directions, same_way = np.empty((2, len(one), 2), int)
    directions[rows, along], directions[rows, across] = _ALONG[b], 1 - _ALONG[b]
    same_way[rows, along] = (_FORWARD[a] != _FORWARD[b]) == (sides.start[one] == sides.end[other])
    same_way[rows, across] = np.array(_AT)[a] == np.array(_AT)[b]
    pairs = np.stack([one // 4, _NUMBER[a], other // 4, _NUMBER[b]], axis=1)
    alone = order[~paired]
    return np.concatenate([pairs, directions, same_way], axis=1), np.stack([alone // 4, _NUMBER[alone % 4]], axis=1)


def _format_rows(rows: Int[np.ndarray, "n k"]) -> str:
    return "\n   ".join(" ".join(map(str, row)) for row in rows.tolist())
