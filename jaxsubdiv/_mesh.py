"""The control mesh on the host: numpy arrays, checked once at the door."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from ._control import Control
from ._fans import mesh_fans
from ._normals import Weights, estimate_normals
from ._regions import Regions, as_regions
from .errors import MeshError, name_rows
from .half_edges import Faces, HalfEdges, half_edges
from .linalg import scale_to_moderate_length

# A face whose area is under this part of its longest edge squared has no direction that rounding would not change.
_FLAT = 1e-12


@final
class ControlMesh:
    """A mesh of triangles and quads with or without vertex normals: what a refinement starts from.

    Args:
        vertices: `[v, 3]`, in any one unit of length (mm for scans). Kept in float64.
        faces: corners of every face, counter-clockwise seen from outside, zero-based: a list of 3- and 4-tuples, an
            array `[t, 3]` or `[q, 4]`, a pair of such arrays, or a dict `{3: [t, 3], 4: [q, 4]}`.
        normals: `[v, 3]`, one a vertex, of any length, or None. A zero normal gives no bend from its end.
        check: False puts off every check but those of the shapes, so that `repair()` can be called.
        regions: of the faces, triangles first and then quads: `Regions`, or a name each, empty where a face lies in
            none; or None.

    Raises:
        MeshError: the mesh is empty; a coordinate or a normal is not finite; a face has an index out of range, a
            repeated corner, five or more corners or no area; an edge has more than two faces; neighbours are oriented
            oppositely; the normals are not one a vertex, or the regions not one a face. The text names the rows. Unused
            vertices and several components are legal.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Faces
    """`{3: [t, 3], 4: [q, 4]}`, both always present; the order of the input is kept within each."""
    normals: Float[np.ndarray, "v 3"] | None
    regions: Regions | None
    """Of the faces, triangles first and then quads, such as the groups of an OBJ file."""
    repairs: tuple[str, ...]
    """What `repair()` did to get here, a sentence each; empty otherwise."""

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike | Mapping[int, ArrayLike] | Sequence[ArrayLike],
        normals: ArrayLike | None = None,
        *,
        check: bool = True,
        repairs: Sequence[str] = (),
        regions: Regions | Sequence[str] | None = None,
    ):
        self.vertices = _rows_of_three(vertices, "vertices")
        self.faces, self._names = _sort_faces(faces)
        self.normals = None if normals is None else scale_to_moderate_length(_rows_of_three(normals, "normals"))
        self.regions = _regions_of_faces(regions, self.n_faces)
        self.repairs = tuple(repairs)
        self._checked = False
        for array in (self.vertices, self.normals, *self.faces.values()):
            if array is not None:
                array.flags.writeable = False
        if check:
            self.check()

    def __repr__(self) -> str:
        kinds = f"{len(self.faces[3])} triangles, {len(self.faces[4])} quads"
        return f"ControlMesh({len(self.vertices)} vertices, {kinds}, {'no ' * (self.normals is None)}normals)"

    @property
    def n_faces(self) -> int:
        """Number of triangles and quads."""
        return len(self.faces[3]) + len(self.faces[4])

    @cached_property
    def half_edges(self) -> HalfEdges:
        """Sides of the faces and the edges that they lie on."""
        return half_edges(self.faces)

    @cached_property
    def boundary_edges(self) -> Int[np.ndarray, "b 2"]:
        """Ends of the edges that have one face only."""
        sides = self.half_edges
        return sides.edges[np.bincount(sides.edge, minlength=len(sides.edges)) == 1]

    @property
    def is_closed(self) -> bool:
        """True where no edge is a boundary edge."""
        return len(self.boundary_edges) == 0

    @property
    def euler_number(self) -> int:
        """Vertices in use less edges plus faces: 2 for a sphere, 1 for a disc, 0 for a torus."""
        sides = self.half_edges
        return len(np.unique(sides.start)) - len(sides.edges) + self.n_faces

    def control(self, *, weights: Weights = "area") -> Control:
        """Vertices and normals as JAX arrays, in JAX's default floating dtype.

        Args:
            weights: of the corner normals in (6), where the mesh has no normals of its own: "area" as printed, or
                "uniform", "angle" or "sphere". A vertex without faces gets a zero normal.
        """
        vertices = jnp.asarray(self.vertices, jnp.result_type(float))
        if self.normals is not None:
            return Control(vertices, jnp.asarray(self.normals, vertices.dtype))
        self.check()
        # Centred in float64 first: far from the origin float32 has too few digits left for the cross products.
        centred = jnp.asarray(self.vertices - self.vertices.mean(axis=0), vertices.dtype)
        fans = mesh_fans(len(self.vertices), self.half_edges)
        return Control(vertices, estimate_normals(fans, centred, weights))

    def check(self) -> None:
        """Raise what the class says it raises, unless an earlier call found nothing."""
        if not self._checked:
            _check_values(self)
            _check_edges(self)
            _check_areas(self)
            self._checked = True

    def repair(self, merge_within: float | None = None) -> "ControlMesh":
        """A mended copy; its `repairs` say what was done, in order.

        Merges doubled vertices, drops what is not finite and degenerate and repeated faces, splits edges with more
        than two faces, and orients neighbours alike and closed components outwards. Vertices and faces keep their
        order, and unused vertices stay. Normals go with their vertices (merged ones by their unit mean) and turn with
        the faces that they pointed along; those that are not finite are computed from the faces.

        Args:
            merge_within: vertices in use that are closer than this become one, in the unit of the mesh. Default: 1e-8
                of their bounding box's diagonal.

        Raises:
            MeshError: nothing is left, or what is wrong is not one of these (an index out of range, normals that are
                not one a vertex, a surface of one side).
        """
        from ._repair import repair  # here and not above: it loads trimesh, which plain use never needs

        return repair(self, merge_within)

    def triangulate(self) -> "ControlMesh":
        """A copy with every quad cut from its first to its third corner, after the triangles that there are."""
        quads = self.faces[4]
        halves = np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
        regions = self.regions
        if regions is not None:
            rows = np.arange(self.n_faces)
            regions = regions.take(np.repeat(rows, np.where(rows < len(self.faces[3]), 1, 2)))
        faces = {3: np.concatenate([self.faces[3], halves])}
        return ControlMesh(self.vertices, faces, self.normals, regions=regions)

    def name_faces(self, rows: ArrayLike) -> str:
        """Faces, triangles numbered first and then quads, by the words of whoever passed them."""
        return self._names.join(np.asarray(rows))


class _FaceNames:
    """How the caller counts faces: by place in one list, or apart for triangles and quads."""

    def __init__(self, n_triangles: int, n_quads: int, places: Int[np.ndarray, "f"] | None):
        self._n_triangles = n_triangles
        self._places = places if places is not None or n_triangles * n_quads else np.arange(n_triangles + n_quads)

    def join(self, rows: Int[np.ndarray, "n"]) -> str:
        if self._places is not None:
            return f"face{'s' * (len(rows) != 1)} {name_rows(np.sort(self._places[rows]))}"
        named = (f"triangle {r}" if r < self._n_triangles else f"quad {r - self._n_triangles}" for r in np.sort(rows))
        return name_rows(named)


def _regions_of_faces(regions: Regions | Sequence[str] | None, n_faces: int) -> Regions | None:
    try:
        found = as_regions(regions)
    except ValueError as error:
        raise MeshError(f"`regions`: {error}") from None
    if found is not None and len(found) != n_faces:
        raise MeshError(f"there are {len(found)} `regions` for {n_faces} faces. Give one a face, triangles first.")
    return found


def _rows_of_three(values: ArrayLike, name: str) -> Float[np.ndarray, "n 3"]:
    rows = np.array(values, dtype=np.float64)  # a copy, so that the checked values cannot change under us
    if rows.size == 0:
        rows = rows.reshape(0, 3)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise MeshError(f"`{name}` must be rows of three coordinates, shape [v, 3]; got shape {list(rows.shape)}.")
    return rows


def _sort_faces(faces: Any) -> tuple[Faces, _FaceNames]:
    """Faces by size, and the caller's way to count them."""
    if isinstance(faces, Mapping):
        if set(faces) - {3, 4}:
            raise MeshError(f"`faces` has the keys {sorted(faces)}; only 3 (triangles) and 4 (quads) have a meaning.")
        return _pair([_index_rows(faces.get(size, ()), size) for size in (3, 4)])
    is_array = hasattr(faces, "__array__")
    if is_array or any(np.ndim(item) == 2 for item in faces if hasattr(item, "__array__")):
        arrays = [a for a in map(np.asarray, [faces] if is_array else faces) if a.size]
        if any(a.ndim != 2 or a.shape[1] not in (3, 4) for a in arrays):
            shapes = [list(a.shape) for a in arrays]
            raise MeshError(f"`faces` must be arrays [t, 3] or [q, 4]; got shapes {shapes}. Split larger polygons.")
        by_size = {size: [a for a in arrays if a.shape[1] == size] for size in (3, 4)}
        return _pair([_index_rows(np.concatenate(by_size[s]) if by_size[s] else (), s) for s in (3, 4)])
    lengths = np.array([len(face) if hasattr(face, "__len__") else 1 for face in faces], dtype=int)
    wrong = np.flatnonzero((lengths < 3) | (lengths > 4))
    if len(wrong):
        row = wrong[0]
        raise MeshError(
            f"faces {name_rows(wrong)} are neither triangles nor quads (face {row} has {lengths[row]} corners). "
            "Split faces of five or more corners into triangles and quads, and drop faces of fewer than three."
        )
    places = [np.flatnonzero(lengths == size) for size in (3, 4)]
    triangles, quads = (_index_rows([faces[i] for i in at], size) for at, size in zip(places, (3, 4), strict=True))
    return {3: triangles, 4: quads}, _FaceNames(len(triangles), len(quads), np.concatenate(places))


def _pair(faces: list[Int[np.ndarray, "_ _"]]) -> tuple[Faces, _FaceNames]:
    triangles, quads = faces
    return {3: triangles, 4: quads}, _FaceNames(len(triangles), len(quads), None)


def _index_rows(faces: Any, size: int) -> Int[np.ndarray, "_ _"]:
    rows = np.asarray(faces)
    if rows.size == 0:
        return np.zeros((0, size), np.int32)
    if rows.ndim != 2 or rows.shape[1] != size:
        raise MeshError(f"faces of {size} corners must have the shape [n, {size}]; got {list(rows.shape)}.")
    if not np.issubdtype(rows.dtype, np.integer):
        raise MeshError(f"faces must hold whole numbers, vertex indices from zero; got dtype {rows.dtype}.")
    if rows.max() > np.iinfo(np.int32).max or rows.min() < np.iinfo(np.int32).min:
        raise MeshError("faces use vertex indices beyond 32 bits; such a mesh cannot be refined here. Cut it in parts.")
    return rows.astype(np.int32)


def _check_values(mesh: ControlMesh) -> None:
    check_counts(mesh)
    bad = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
    if len(bad):
        raise MeshError(
            f"vertices {name_rows(bad)} have coordinates that are not finite. Drop them and the faces that use them, "
            "or let `repair()` do it."
        )
    first = 0
    for faces in mesh.faces.values():
        repeated = np.flatnonzero((np.diff(np.sort(faces, axis=1), axis=1) == 0).any(axis=1))
        if len(repeated):
            raise MeshError(
                f"{mesh.name_faces(repeated + first)} name a corner twice. A triangle stored as a quad must be given "
                "as a triangle; `repair()` does this, and drops what is left of fewer than three corners."
            )
        first += len(faces)
    if mesh.normals is not None:
        bad = np.flatnonzero(~np.isfinite(mesh.normals).all(axis=1))
        if len(bad):
            raise MeshError(
                f"the normals of vertices {name_rows(bad)} are not finite. Give normals=None to compute them from the "
                "faces, or zeros where a vertex has none."
            )


def check_counts(mesh: ControlMesh) -> None:
    """Raise what no repair could mend: an empty mesh, indices out of range, normals that are not one a vertex."""
    n = len(mesh.vertices)
    if n == 0 or mesh.n_faces == 0:
        raise MeshError(
            f"the mesh is empty: {n} vertices, {mesh.n_faces} faces. "
            "A refinement needs at least one face; a file of points alone is a scan, read with `read_points`."
        )
    first = 0
    for faces in mesh.faces.values():
        negative = np.flatnonzero((faces < 0).any(axis=1))
        if len(negative):
            raise MeshError(
                f"{mesh.name_faces(negative + first)} use negative vertex indices. Vertices are counted from zero; "
                "OBJ files may count them back from the last one, which must be resolved first."
            )
        beyond = np.flatnonzero((faces >= n).any(axis=1))
        if len(beyond):
            raise MeshError(
                f"{mesh.name_faces(beyond + first)} use vertex indices >= {n}, but there are {n} vertices, counted "
                "from zero. OBJ files count from one: subtract 1 if the faces come from such a file."
            )
        first += len(faces)
    if mesh.normals is not None and len(mesh.normals) != n:
        raise MeshError(
            f"there are {len(mesh.normals)} normals for {n} vertices. Give one a vertex, or normals=None to compute "
            "them from the faces."
        )


def _check_edges(mesh: ControlMesh) -> None:
    sides = mesh.half_edges
    counts = np.bincount(sides.edge, minlength=len(sides.edges))
    crowded = np.flatnonzero(counts > 2)
    if len(crowded):
        raise MeshError(
            f"edges {_name_edges(sides, crowded)} have more than two faces "
            f"({mesh.name_faces(np.unique(sides.face[np.isin(sides.edge, crowded)]))}). A surface cannot branch: drop "
            "the faces that are one too many, or let `repair()` split the surface there."
        )
    # Two faces that agree on their outside run along their edge in opposite directions.
    forward = np.bincount(sides.edge[sides.start < sides.end], minlength=len(sides.edges))
    torn = np.flatnonzero((counts == 2) & (forward != 1))
    if len(torn):
        raise MeshError(
            f"the faces at edges {_name_edges(sides, torn)} are oriented oppositely "
            f"({mesh.name_faces(np.unique(sides.face[np.isin(sides.edge, torn)]))}). Reverse the corners of one side, "
            "or let `repair()` orient all alike."
        )


def _name_edges(sides: HalfEdges, rows: Int[np.ndarray, "n"]) -> str:
    return name_rows(f"({a}, {b})" for a, b in sides.edges[rows])


def _check_areas(mesh: ControlMesh) -> None:
    flat = np.flatnonzero(zero_area(mesh.vertices, mesh.faces))
    if len(flat):
        raise MeshError(
            f"{mesh.name_faces(flat)} have no area: their corners lie on a line or on one another, or the sides of a "
            "quad cross. Move the corners apart, or let `repair()` drop or merge what is degenerate."
        )


def zero_area(vertices: Float[np.ndarray, "v 3"], faces: Faces) -> Bool[np.ndarray, "f"]:
    """For every face, triangles first, whether its vector area vanishes beside its longest edge squared."""
    flags = []
    for size in (3, 4):
        corners = vertices[faces[size]]
        edges = np.roll(corners, -1, axis=1) - corners
        longest = np.einsum("fkx,fkx->fk", edges, edges).max(axis=1, initial=0)
        flags.append(np.linalg.norm(vector_areas(corners), axis=1) <= _FLAT * longest)
    return np.concatenate(flags)


def vector_areas(corners: Float[np.ndarray, "f k 3"]) -> Float[np.ndarray, "f 3"]:
    """Normal times area of triangles or quads; for a quad that is not flat, of its shadow along the normal."""
    return np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1]) / 2
