"""A slow, literal reference for the point-normal subdivision of A. Sisojevs and A. Glazs, *Smoothing Approach of 3D
Models Based on Interpolating Subdivision Surface* (2012), and for its circle-preserving variant.

Tests compare the fast implementation with this one. Nothing is shared between the two: here every formula is one small
function, written as on paper in float64, and meshes are walked in plain loops with dictionaries keyed by vertex pairs.
Numbers in brackets are the paper's equations; "circle" marks a formula that the variant changes.

Meshes are taken to be valid: manifold, consistently oriented, no repeated corners. Faces have 3 or 4 corners.
"Vanishes" means a length of exactly 0, here and below.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence

import numpy as np

Array = np.ndarray
Face = tuple[int, ...]
Edge = tuple[int, int]  # (smaller vertex, larger vertex)
Key = tuple  # ("v", i), ("e", digest) or ("f", digest)


# ---------------------------------------------------------------------------------------------------------- formulas


def unit(vector: Array) -> Array:
    """vector / |vector|; zero for the zero vector."""
    length = math.sqrt(float(np.dot(vector, vector)))
    return vector / length if length > 0.0 else np.zeros(3)


def tangent(p_i: Array, n_i: Array, p_j: Array, h: float) -> Array:
    """(1): m_ij = h (n_i x (P_j - P_i)) x n_i, n_i a unit vector; h (P_j - P_i) where n_i is missing (zero), so that
    nothing bends there: h (d - (n_i.d) n_i) with d = P_j - P_i is both."""
    if not n_i.any():
        return h * (p_j - p_i)
    return h * np.cross(np.cross(n_i, p_j - p_i), n_i)


def edge_point(p_i: Array, p_j: Array, m_ij: Array, m_ji: Array) -> Array:
    """(2): Q_ij = (P_i + P_j) / 2 + (m_ij + m_ji) / 8."""
    return (p_i + p_j) / 2.0 + (m_ij + m_ji) / 8.0


def zero_twist(n: Sequence[Array]) -> Array:
    """Bracket of (3), set to zero."""
    return np.zeros(3)


def printed_twist(n: Sequence[Array]) -> Array:
    """Bracket of (3) as printed: n_i - n_j + n_k - n_l. Open in the text: unit normals are used here too."""
    return n[0] - n[1] + n[2] - n[3]


def quad_centre(p: Sequence[Array], n: Sequence[Array], h: float, twist: str) -> Array:
    """(3): Q_c = 1/4 sum P + 1/64 bracket + 1/16 sum m, over four corners and the eight tangents along the sides."""
    bracket = {"zero": zero_twist, "printed": printed_twist}[twist](n)
    sum_p = np.zeros(3)
    sum_m = np.zeros(3)
    for a in range(4):
        b = (a + 1) % 4
        sum_p = sum_p + p[a]
        sum_m = sum_m + tangent(p[a], n[a], p[b], h) + tangent(p[b], n[b], p[a], h)
    return sum_p / 4.0 + bracket / 64.0 + sum_m / 16.0


def corner_normal(p: Array, p_next: Array, p_prev: Array) -> Array:
    """(4)-(5): v_next x v_prev with v = neighbour - P, the neighbours of P along one face."""
    return np.cross(p_next - p, p_prev - p)


def weighted_corner_normal(p: Array, p_next: Array, p_prev: Array, weights: str) -> Array:
    """One term of (6). area: raw cross product (printed); uniform: unit; angle: unit times corner angle; sphere:
    c / (|a|^2 |b|^2) (Max 1999; circle). A corner with a zero-length edge contributes zero; the sphere weight has no
    other guard here (the small e of (|a|^2 + e)(|b|^2 + e) is taken as 0)."""
    c = corner_normal(p, p_next, p_prev)
    a = p_next - p
    b = p_prev - p
    if weights == "area":
        return c
    if weights == "uniform":
        return unit(c)
    if weights == "angle":
        return unit(c) * math.atan2(math.sqrt(float(np.dot(c, c))), float(np.dot(a, b)))
    if weights == "sphere":
        product = float(np.dot(a, a)) * float(np.dot(b, b))
        return c / product if product > 0.0 else np.zeros(3)
    raise ValueError(f"unknown weights {weights!r}")


def vertex_normal(p: Array, neighbours: Sequence[tuple[Array, Array]], weights: str) -> Array:
    """(6): unit sum of the (weighted) corner normals of the faces around P, each face given by (next, previous).
    Zero where the sum vanishes; the caller decides what stands in."""
    total = np.zeros(3)
    for p_next, p_prev in neighbours:
        total = total + weighted_corner_normal(p, p_next, p_prev, weights)
    return unit(total)


def chord_normal(p_i: Array, n_i: Array, p_j: Array, n_j: Array) -> Array:
    """Circle: n_e = unit(s - (s.d) d / |d|^2), s = n_i + n_j, d = P_j - P_i. Open in the text: where d vanishes, the
    projection is taken as zero, so n_e = unit(s); where s is parallel to d, n_e is zero and stays so."""
    s = n_i + n_j
    d = p_j - p_i
    square = float(np.dot(d, d))
    if square == 0.0:
        return unit(s)
    return unit(s - (float(np.dot(s, d)) / square) * d)


def circle_factor(n_i: Array, n_j: Array) -> float:
    """Circle: g = 2 / (c (1 + c)), c^2 = (1 + max(n_i.n_j, -1/2)) / 2; 1 where either normal is missing (zero)."""
    if not n_i.any() or not n_j.any():
        return 1.0
    c = math.sqrt((1.0 + max(float(np.dot(n_i, n_j)), -0.5)) / 2.0)
    return 2.0 / (c * (1.0 + c))


def circle_edge_point(p_i: Array, n_i: Array, p_j: Array, n_j: Array, h: float) -> Array:
    """Circle: (2) with both tangents times g."""
    g = circle_factor(n_i, n_j)
    return edge_point(p_i, p_j, g * tangent(p_i, n_i, p_j, h), g * tangent(p_j, n_j, p_i, h))


def circle_quad_centre(p: Sequence[Array], n: Sequence[Array], h: float) -> Array:
    """Circle: A = edge rule on (Q_ij, Q_kl), B = edge rule on (Q_jk, Q_li), Q_c = edge rule on (A, B), each end with
    its chord normal. All three use the same h and their own g."""
    q, n_q = [], []
    for a in range(4):
        b = (a + 1) % 4
        q.append(circle_edge_point(p[a], n[a], p[b], n[b], h))
        n_q.append(chord_normal(p[a], n[a], p[b], n[b]))
    point_a = circle_edge_point(q[0], n_q[0], q[2], n_q[2], h)
    point_b = circle_edge_point(q[1], n_q[1], q[3], n_q[3], h)
    n_a = chord_normal(q[0], n_q[0], q[2], n_q[2])
    n_b = chord_normal(q[1], n_q[1], q[3], n_q[3])
    return circle_edge_point(point_a, n_a, point_b, n_b, h)


# -------------------------------------------------------------------------------------------------------------- mesh


def edge_of(i: int, j: int) -> Edge:
    """The dictionary key of the edge between two vertices."""
    return (min(i, j), max(i, j))


def faces_at_edges(faces: Sequence[Face]) -> dict[Edge, int]:
    """Number of faces at every edge, edges sorted by (smaller vertex, larger vertex)."""
    count: dict[Edge, int] = {}
    for face in faces:
        for a in range(len(face)):
            edge = edge_of(face[a], face[(a + 1) % len(face)])
            count[edge] = count.get(edge, 0) + 1
    return {edge: count[edge] for edge in sorted(count)}


def corners_at_vertices(count: int, faces: Sequence[Face]) -> list[list[Edge]]:
    """For every vertex the (next, previous) vertices in each face around it."""
    corners: list[list[Edge]] = [[] for _ in range(count)]
    for face in faces:
        for a in range(len(face)):
            corners[face[a]].append((face[(a + 1) % len(face)], face[a - 1]))
    return corners


def all_vertex_normals(points: Sequence[Array], faces: Sequence[Face], weights: str) -> list[Array]:
    """(6) at every vertex; zero where the sum vanishes (also at a vertex without faces)."""
    corners = corners_at_vertices(len(points), faces)
    return [
        vertex_normal(points[i], [(points[b], points[a]) for b, a in corners[i]], weights) for i in range(len(points))
    ]


def derived_key(kind: str, parents: Sequence[Key]) -> Key:
    """Provenance of a new vertex: kind and digest of its parents' sorted keys, "e" for edges and "f" for quads. Two
    quads on the same four corners (a pillow) have the same key."""
    return (kind, hashlib.blake2b(repr(sorted(parents)).encode(), digest_size=12).hexdigest())


def split(face: Face, edge_vertex: dict[Edge, int], centre: int | None) -> list[Face]:
    """Split: a triangle (i, j, k) into three corners and the centre (Q_ij, Q_jk, Q_ik); a quad into (P_i, Q_ij, Q_c,
    Q_il) and so on. Children keep the parent's orientation."""
    size = len(face)
    q = [edge_vertex[edge_of(face[a], face[(a + 1) % size])] for a in range(size)]  # q[a] follows corner a
    if size == 3:
        return [(face[a], q[a], q[a - 1]) for a in range(3)] + [(q[0], q[1], q[2])]
    return [(face[a], q[a], centre, q[a - 1]) for a in range(4)]


def refine_once(
    points: list[Array], normals: list[Array], faces: list[Face], keys: list[Key], h: float, *, scheme: str,
    twist: str, weights: str, old_normals: str, boundary: str,
) -> tuple[list[Array], list[Array], list[Face], list[Key]]:  # fmt: skip
    """One level. New vertices: edge points in edge order, then quad centres in face order."""
    old_count = len(points)
    points, keys = list(points), list(keys)
    parents: list[Face] = [(i,) for i in range(old_count)]
    edges = faces_at_edges(faces)

    edge_vertex: dict[Edge, int] = {}
    for i, j in edges:
        edge_vertex[i, j] = len(points)
        if scheme == "circle":
            point = circle_edge_point(points[i], normals[i], points[j], normals[j], h)
        else:
            m_ij = tangent(points[i], normals[i], points[j], h)
            m_ji = tangent(points[j], normals[j], points[i], h)
            point = edge_point(points[i], points[j], m_ij, m_ji)
        points.append(point)
        parents.append((i, j))
        keys.append(derived_key("e", [keys[i], keys[j]]))

    new_faces: list[Face] = []
    for face in faces:
        centre = None
        if len(face) == 4:
            centre = len(points)
            p = [points[i] for i in face]
            n = [normals[i] for i in face]
            points.append(circle_quad_centre(p, n, h) if scheme == "circle" else quad_centre(p, n, h, twist))
            parents.append(face)
            keys.append(derived_key("f", [keys[i] for i in face]))
        new_faces.extend(split(face, edge_vertex, centre))

    # Normals on the refined faces. Where (6) vanishes a new vertex takes the unit sum over its parents; an old vertex
    # counts as its own only parent, so that it keeps its own.
    new_normals: list[Array] = []
    for i, from_faces in enumerate(all_vertex_normals(points, new_faces, weights)):
        if i < old_count and old_normals == "keep":
            new_normals.append(normals[i])
        elif from_faces.any():
            new_normals.append(from_faces)
        else:
            total = np.zeros(3)
            for parent in parents[i]:
                total = total + normals[parent]
            new_normals.append(unit(total))

    # Chord normals: only vertices that are new at this level. Old boundary vertices that are recomputed use (6).
    if boundary == "chord":
        for (i, j), face_count in edges.items():
            if face_count == 1:
                new_normals[edge_vertex[i, j]] = chord_normal(points[i], normals[i], points[j], normals[j])

    return points, new_normals, new_faces, keys


# --------------------------------------------------------------------------------------------------------------- API


def refine(
    vertices: Array, normals: Array, faces: Sequence[Sequence[int]], levels: int, h: float | Sequence[float] = 1.0, *,
    scheme: str = "interpolating", twist: str = "zero", weights: str = "area", old_normals: str = "keep",
    boundary: str = "fan",
) -> tuple[Array, Array, list[Face], list[Key]]:  # fmt: skip
    """Refine a mesh: (vertices, unit normals, faces, provenance keys) after `levels` levels.

    h is one number, or one number a level. Normals may have any length; a zero normal stays zero under `keep` and bends
    nothing. scheme="circle" fixes its own twist, weights and boundary. Normals put out are the scheme's own state.
    """
    for name, value, allowed in (
        ("scheme", scheme, ("interpolating", "circle")),
        ("twist", twist, ("zero", "printed")),
        ("weights", weights, ("area", "uniform", "angle", "sphere")),
        ("old_normals", old_normals, ("keep", "recompute")),
        ("boundary", boundary, ("fan", "chord")),
    ):
        if value not in allowed:
            raise ValueError(f"{name} must be one of {allowed}, not {value!r}")
    if scheme == "circle":
        weights, boundary = "sphere", "chord"
    level_h = [float(h)] * levels if np.ndim(h) == 0 else [float(x) for x in h]
    if len(level_h) != levels:
        raise ValueError(f"{levels} levels need {levels} values of h, not {len(level_h)}")

    points = list(np.array(vertices, dtype=np.float64).reshape(-1, 3))
    unit_normals = [unit(n) for n in np.array(normals, dtype=np.float64).reshape(-1, 3)]
    polygons = [tuple(int(i) for i in face) for face in faces]
    if any(len(face) not in (3, 4) for face in polygons):
        raise ValueError("faces must have 3 or 4 corners")
    keys: list[Key] = [("v", i) for i in range(len(points))]
    for value in level_h:
        points, unit_normals, polygons, keys = refine_once(
            points, unit_normals, polygons, keys, value,
            scheme=scheme, twist=twist, weights=weights, old_normals=old_normals, boundary=boundary,
        )  # fmt: skip
    return np.array(points).reshape(-1, 3), np.array(unit_normals).reshape(-1, 3), polygons, keys


def vertex_normals(vertices: Array, faces: Sequence[Sequence[int]], weights: str = "area") -> Array:
    """(4)-(6) on the mesh itself, for control meshes without normals; zero where the sum vanishes."""
    points = list(np.array(vertices, dtype=np.float64).reshape(-1, 3))
    polygons = [tuple(int(i) for i in face) for face in faces]
    return np.array(all_vertex_normals(points, polygons, weights)).reshape(-1, 3)


def pn_triangle_edge_middles(vertices: Array, normals: Array) -> Array:
    """Middles of the edges 12, 23, 31 of the cubic PN triangle (Vlachos et al. 2001) on three points and three normals,
    from its ten control points: b(u, v) with w = 1 - u - v at P_1, u at P_2, v at P_3."""
    p1, p2, p3 = np.array(vertices, dtype=np.float64)
    n1, n2, n3 = (unit(n) for n in np.array(normals, dtype=np.float64))

    def near(p_i: Array, n_i: Array, p_j: Array) -> Array:
        """(2 P_i + P_j - w_ij N_i) / 3 with w_ij = (P_j - P_i).N_i."""
        return (2.0 * p_i + p_j - np.dot(p_j - p_i, n_i) * n_i) / 3.0

    b300, b030, b003 = p1, p2, p3
    b210, b120 = near(p1, n1, p2), near(p2, n2, p1)
    b021, b012 = near(p2, n2, p3), near(p3, n3, p2)
    b102, b201 = near(p3, n3, p1), near(p1, n1, p3)
    mean_edge = (b210 + b120 + b021 + b012 + b102 + b201) / 6.0
    b111 = mean_edge + (mean_edge - (p1 + p2 + p3) / 3.0) / 2.0

    def evaluate(u: float, v: float, w: float) -> Array:
        return (
            b300 * w**3 + b030 * u**3 + b003 * v**3
            + b210 * 3 * w**2 * u + b120 * 3 * w * u**2 + b201 * 3 * w**2 * v
            + b021 * 3 * u**2 * v + b102 * 3 * w * v**2 + b012 * 3 * u * v**2
            + b111 * 6 * w * u * v
        )  # fmt: skip

    return np.array([evaluate(0.5, 0.0, 0.5), evaluate(0.5, 0.5, 0.0), evaluate(0.0, 0.5, 0.5)])
