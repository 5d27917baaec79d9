"""Small meshes, made in code: each function returns vertices `[v, 3]` and a list of faces.

All are sound. Faces run counter-clockwise seen from outside, or from above (+z) for open sheets.
"""

from itertools import combinations, product

import numpy as np

Mesh = tuple[np.ndarray, list[tuple[int, ...]]]


def tetrahedron() -> Mesh:
    """Four triangles, valence 3 everywhere."""
    return _convex([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], combinations(range(4), 3))


def octahedron() -> Mesh:
    """Eight triangles, valence 4 everywhere."""
    vertices = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    return _convex(vertices, product((0, 1), (2, 3), (4, 5)))


def icosahedron() -> Mesh:
    """Twenty triangles, valence 5 everywhere, all vertices at distance 1."""
    golden = (1 + 5**0.5) / 2
    rows = [np.roll((0, a, b * golden), shift) for shift in range(3) for a, b in product((1, -1), repeat=2)]
    vertices = np.array(rows) / np.hypot(1, golden)
    side = 2 / np.hypot(1, golden)
    near = np.isclose(np.linalg.norm(vertices[:, None] - vertices, axis=2), side)
    return _convex(vertices, (abc for abc in combinations(range(12), 3) if near[np.ix_(abc, abc)].sum() == 6))


def cube() -> Mesh:
    """Six quads, corners at -1 and 1."""
    vertices = np.array(list(product((-1, 1), repeat=3)))
    return _convex(vertices, _sides(vertices))


def mixed_closed() -> Mesh:
    """A cuboctahedron: eight triangles and six quads, both at every one of its twelve vertices."""
    rows = [np.roll((0, a, b), shift) for shift in range(3) for a, b in product((1, -1), repeat=2)]
    vertices = np.array(rows)
    triangles = (np.flatnonzero(vertices @ corner == 2) for corner in product((-1, 1), repeat=3))
    return _convex(vertices, [*triangles, *_sides(vertices)])


def fan(k: int) -> Mesh:
    """A double pyramid over a polygon of `k` sides: closed, two poles of valence `k`, the rest of valence 4."""
    angles = 2 * np.pi * np.arange(k) / k
    rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(k)], axis=1)
    upper = [(i, (i + 1) % k, k) for i in range(k)]
    lower = [((i + 1) % k, i, k + 1) for i in range(k)]
    return np.concatenate([rim, [(0, 0, 1), (0, 0, -1)]]), upper + lower


def grid(nx: int, ny: int, kind: str = "quad", bumpy: float = 0.0, seed: int = 0) -> Mesh:
    """An open sheet of `nx` by `ny` unit cells.

    Args:
        nx: number of cells along x.
        ny: number of cells along y.
        kind: "quad", "triangle" (two for a cell) or "mixed" (the one and the other in turn, like a chessboard).
        bumpy: heights are drawn from -bumpy to bumpy.
        seed: of the heights.
    """
    at = np.arange((nx + 1) * (ny + 1)).reshape(nx + 1, ny + 1)
    x, y = np.divmod(at.ravel(), ny + 1)
    z = np.random.default_rng(seed).uniform(-bumpy, bumpy, at.size)
    return np.stack([x, y, z], axis=1), _cells(at, kind)


def torus(nu: int, nv: int, kind: str = "quad") -> Mesh:
    """A ring of genus 1, radii 2 and 1: `nu` cells along the ring and `nv` around its tube; `kind` as for `grid`."""
    at = np.arange(nu * nv).reshape(nu, nv)
    i, j = np.divmod(at.ravel(), nv)
    u, v = 2 * np.pi * i / nu, 2 * np.pi * j / nv
    across = 2 + np.cos(v)
    vertices = np.stack([across * np.cos(u), across * np.sin(u), np.sin(v)], axis=1)
    return vertices, _cells(np.pad(at, (0, 1), mode="wrap"), kind)


def pyramid(base: bool = True) -> Mesh:
    """Four triangles over a square, closed by a quad, or open: the fewest vertices with both kinds of faces."""
    faces = [(i, (i + 1) % 4, 4) for i in range(4)] if not base else [(3, 2, 1, 0), *pyramid(base=False)[1]]
    return np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1)], dtype=np.float64), faces


def two_components() -> Mesh:
    """A cube and an octahedron beside it."""
    vertices, faces = octahedron()
    return union(cube(), (vertices + (5, 0, 0), faces))


def union(*parts: Mesh) -> Mesh:
    """Meshes as the components of one, where they stand."""
    vertices, faces = [], []
    for rows, corners in parts:
        first = sum(map(len, vertices))
        faces += [tuple(corner + first for corner in face) for face in corners]
        vertices.append(rows)
    return np.concatenate(vertices), faces


def relabelled(mesh: Mesh, seed: int, turn: bool = True) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """The same mesh told otherwise: vertices and faces in another order, and with `turn` faces from any first corner.

    Returns:
        The mesh; for each of its vertices the old one; for each of its faces the old one.
    """
    (vertices, faces), rng = mesh, np.random.default_rng(seed)
    of_vertex, of_face = rng.permutation(len(vertices)), rng.permutation(len(faces))
    label = np.argsort(of_vertex)
    turned = [np.roll(label[list(faces[i])], rng.integers(4) if turn else 0) for i in of_face]
    return (vertices[of_vertex], [tuple(map(int, face)) for face in turned]), of_vertex, of_face


def _cells(at: np.ndarray, kind: str) -> list[tuple[int, ...]]:
    faces = []
    for i, j in product(range(at.shape[0] - 1), range(at.shape[1] - 1)):
        a, b, c, d = (int(at[p]) for p in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
        is_quad = {"quad": True, "triangle": False, "mixed": (i + j) % 2 == 0}[kind]
        faces += [(a, b, c, d)] if is_quad else [(a, b, c), (a, c, d)]
    return faces


def _sides(vertices: np.ndarray) -> list[np.ndarray]:
    """The vertices on each of the six sides of the box from -1 to 1."""
    return [np.flatnonzero(vertices[:, axis] == side) for axis, side in product(range(3), (-1, 1))]


def _convex(vertices, faces) -> Mesh:
    """Corners of every face turned counter-clockwise; the solid is convex and holds the origin."""
    vertices = np.array(vertices, dtype=np.float64)
    turned = []
    for face in faces:
        corners = vertices[list(face)]
        middle = corners.mean(axis=0)
        right = corners[0] - middle
        up = np.cross(middle, right)
        angles = np.arctan2(corners @ up / np.linalg.norm(up), (corners - middle) @ right / np.linalg.norm(right))
        turned.append(tuple(int(face[i]) for i in np.argsort(angles % (2 * np.pi))))
    return vertices, turned


def turns(triangles) -> set[tuple[int, ...]]:
    """Triangles as they are turned, whichever corner is named first."""
    return {tuple(np.roll(row, -int(np.argmin(row))).tolist()) for row in np.asarray(triangles)}
