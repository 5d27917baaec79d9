"""The tables of a refinement, what they refuse, and what importing the library brings in."""

import subprocess
import sys
from itertools import pairwise

import jax
import jax.numpy as jnp
import meshes
import numpy as np
import pytest
from schemes import MIXED, QUADS, TRIANGLES, control_mesh

import jaxsubdiv as js
from jaxsubdiv._normals import corner_sum, ring_sum
from jaxsubdiv._scheme.base import ring_corners

MESHES = {"triangles": TRIANGLES, "quads": QUADS, "mixed": MIXED}
TRIANGLE = js.ControlMesh(np.eye(3), [(0, 1, 2)])
CONTROL = js.Control(np.eye(3), np.eye(3))
RECOMPUTE = js.Interpolating(old_normals="recompute")


def over_meshes():
    return pytest.mark.parametrize("mesh", MESHES.values(), ids=MESHES.keys())


# ------------------------------------------------------------------------------------------------------------- tables


@over_meshes()
def test_tables_are_32_bit_integers_and_nothing_else(mesh):
    topology = js.build_topology(control_mesh(mesh), RECOMPUTE, 2)
    leaves = jax.tree.leaves(topology)
    assert all(isinstance(leaf, jax.Array) and leaf.dtype == jnp.int32 for leaf in leaves)
    assert topology.n_control_vertices == len(mesh[0])


def levels_of(mesh: meshes.Mesh) -> list[tuple[int, js.ControlMesh, js.ControlMesh, object]]:
    """For every level: the number of its vertices, its mesh, the refined mesh and the tables between them."""
    checked, found = control_mesh(mesh), []
    stages = [js.build_topology(checked, RECOMPUTE, levels) for levels in range(4)]
    for coarse, fine in pairwise(stages):
        level = fine.levels[-1]
        n_old = len(mesh[0]) + sum(len(before.edges) + len(before.quads) for before in coarse.levels)
        n_new = n_old + len(level.edges) + len(level.quads)
        finer = js.ControlMesh(np.zeros((n_new, 3)), {k: np.asarray(v) for k, v in fine.faces.items()}, check=False)
        coarser = js.ControlMesh(np.zeros((n_old, 3)), {k: np.asarray(v) for k, v in coarse.faces.items()}, check=False)
        found.append((n_old, coarser, finer, level))
    return found


def corners_at(mesh: js.ControlMesh) -> list[set[tuple[int, int]]]:
    """For every vertex (next, previous) in each of its faces."""
    corners = [set() for _ in mesh.vertices]
    for rows in mesh.faces.values():
        for face in rows.tolist():
            for i, corner in enumerate(face):
                corners[corner].add((face[(i + 1) % len(face)], face[i - 1]))
    return corners


@over_meshes()
def test_edges_and_quads_are_those_of_the_level(mesh):
    for _, coarser, _, level in levels_of(mesh):
        edges = np.sort(np.asarray(level.edges), axis=1)
        assert np.array_equal(np.unique(edges, axis=0), coarser.half_edges.edges)
        assert len(edges) == len(coarser.half_edges.edges)
        assert np.array_equal(level.quads, coarser.faces[4])
        following = np.stack([level.quads, np.roll(level.quads, -1, axis=1)], axis=-1)
        assert np.array_equal(edges[np.asarray(level.quad_edges)], np.sort(following, axis=-1))


@over_meshes()
def test_rings_of_edge_vertices_are_the_corners_of_the_refined_faces(mesh):
    for n_old, _, finer, level in levels_of(mesh):
        corners, half = corners_at(finer), level.wings.shape[1] // 2
        assert half == (1 if mesh is QUADS else 2)
        for i, ((start, end), wings) in enumerate(zip(level.edges.tolist(), level.wings.tolist(), strict=True)):
            ring = [end, *wings[:half], start, *wings[half:]]
            pairs = zip(ring, ring[1:] + ring[:1], strict=True)
            there = {(after, before) for after, before in pairs if after != before and n_old + i not in (after, before)}
            assert there == corners[n_old + i]
        assert ring_corners(level, n_old).sum() == sum(map(len, corners[n_old : n_old + len(level.edges)]))


@pytest.mark.parametrize("weights", ["uniform", "angle", "sphere"])
def test_corners_that_are_not_there_add_nothing_whatever_rounding_makes_of_them(weights):
    centre = jnp.array([[0.3, 0.1, 0.2]])
    ring = [jnp.array([row]) for row in [(1.0, 0.0, 0.0), (0.0, 1.0, 0.1), (0.3, 0.1, 0.2 + 1e-16)]]
    assert np.any(ring[2] != centre)
    there = jnp.array([True, False, False])[:, None, None]
    total, _ = ring_sum(centre, ring, weights, there)
    alone, _ = corner_sum((ring[0] - centre)[None], (ring[1] - centre)[None], weights)
    np.testing.assert_allclose(total, alone, rtol=1e-14)


@over_meshes()
def test_fans_are_the_corners_of_the_faces(mesh):
    topology = js.build_topology(control_mesh(mesh), js.Interpolating(), 0)
    found = [(topology.control_fans, control_mesh(mesh))]
    found += [(level.old_fans, finer) for _, _, finer, level in levels_of(mesh)]
    for fans, of_mesh in found:
        corners, centres = corners_at(of_mesh), []
        for fan in jax.tree.map(np.asarray, fans.groups):
            for centre, *around in zip(fan.centre.tolist(), fan.next.T.tolist(), fan.previous.T.tolist(), strict=True):
                pairs = list(zip(*around, strict=True))
                assert set(pairs) == corners[centre] and len(pairs) == len(corners[centre])
                centres.append(centre)
        assert np.array_equal(np.array(centres)[np.asarray(fans.order)], np.arange(len(centres)))


@over_meshes()
def test_children_stand_in_a_block_and_cover_their_parent(mesh):
    for n_old, coarser, finer, _ in levels_of(mesh):
        for size, parents in coarser.faces.items():
            blocks = finer.faces[size].reshape(-1, 4, size)
            for parent, children in zip(parents, blocks, strict=True):
                assert [corner for corner in children.ravel() if corner < n_old] == parent.tolist()
                assert np.array_equal(children[:size, 0], parent)
                assert len(np.unique(children)) == (6 if size == 3 else 9)


@pytest.mark.parametrize(
    ("scheme", "mesh_normals", "expected"),
    [
        (js.Interpolating(), False, [False, False]),
        (js.Interpolating(), True, [False, True]),
        (js.CirclePreserving(), False, [False, False]),
        (RECOMPUTE, False, [True, True]),
    ],
)
def test_fans_of_old_vertices_are_built_where_they_are_needed(scheme, mesh_normals, expected):
    topology = js.build_topology(TRIANGLE, scheme, 2, mesh_normals=mesh_normals)
    assert [level.old_fans is not None for level in topology.levels] == expected


# ------------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("levels", "words"),
    [
        (-1, "between 0 and 8; got -1"),
        (9, "between 0 and 8; got 9"),
        (2.0, "whole number from 0 to 8; got 2.0"),
        ("2", "whole number from 0 to 8; got '2'"),
    ],
)
def test_levels_must_be_a_whole_number_from_0_to_8(as_users_run, levels, words):
    with pytest.raises(ValueError, match=words):
        js.build_topology(TRIANGLE, js.Interpolating(), levels)


def test_refined_mesh_must_fit_32_bit_indices():
    with pytest.raises(ValueError, match=r"8281 faces refined 8 times need indices up to .* more than 32 bits hold"):
        js.build_topology(js.ControlMesh(*meshes.grid(91, 91)), js.Interpolating(), 8)


def test_mesh_made_without_checks_is_checked_here():
    unchecked = js.ControlMesh(np.eye(3), [(0, 1, 7)], check=False)
    with pytest.raises(js.MeshError, match="face 0 use vertex indices >= 3"):
        js.build_topology(unchecked, js.Interpolating(), 1)


@pytest.mark.parametrize(
    ("vertices", "normals"),
    [((4, 3), (4, 3)), ((3, 3), (2, 3)), ((3, 2), (3, 3)), ((5, 3, 3), (5, 3, 3))],
)
def test_control_must_fit_the_topology(as_users_run, vertices, normals):
    topology = js.build_topology(TRIANGLE, js.Interpolating(), 1)
    control = js.Control(np.ones(vertices), np.ones(normals))
    words = rf"3 control vertices, .* shape \[3, 3\]; got {list(vertices)} and {list(normals)}"
    with pytest.raises(ValueError, match=words.replace("got [", r"got \[").replace("and [", r"and \[")):
        js.refine(js.Interpolating(), topology, control)


def test_vertices_and_normals_must_have_one_dtype():
    topology = js.build_topology(TRIANGLE, js.Interpolating(), 1)
    with pytest.raises(ValueError, match="one dtype; got float64 and float32"):
        js.refine(js.Interpolating(), topology, js.Control(np.eye(3), np.eye(3, dtype=np.float32)))


@pytest.mark.parametrize("scheme", [js.Interpolating([1.0, 1.0, 1.0]), js.CirclePreserving([1.0])])
def test_h_must_have_one_value_a_level(scheme):
    topology = js.build_topology(TRIANGLE, scheme, 2)
    with pytest.raises(ValueError, match=r"2 levels, so `h` must be a scalar or have the shape \[2\]"):
        js.refine(scheme, topology, CONTROL)


@pytest.mark.parametrize("kind", [js.Interpolating, js.CirclePreserving])
def test_h_must_not_have_two_axes(kind):
    with pytest.raises(ValueError, match=r"scalar or one value a level, shape \[\] or \[levels\]; got \[1, 2\]"):
        kind([[1.0, 1.0]])


@pytest.mark.parametrize("option", ["twist", "weights", "old_normals", "boundary"])
def test_options_must_be_known(as_users_run, option):
    with pytest.raises(ValueError, match=f"`{option}` must be one of '.*', .*; got 'other'"):
        js.Interpolating(**{option: "other"})


def test_recomputing_scheme_needs_tables_of_its_own():
    topology = js.build_topology(TRIANGLE, js.Interpolating(), 1)
    with pytest.raises(ValueError, match="built for a scheme that keeps old normals"):
        js.refine(RECOMPUTE, topology, CONTROL)


def test_schemes_cannot_be_built_from_the_abstract_one():
    with pytest.raises(TypeError, match="abstract"):
        js.AbstractScheme()


# ------------------------------------------------------------------------------------------------------------ imports


def test_importing_and_refining_loads_no_optional_or_heavy_library():
    program = """
import sys, numpy, jaxsubdiv as js
mesh = js.ControlMesh(numpy.eye(3), [(0, 1, 2)])
js.refine(js.Interpolating(), js.build_topology(mesh, js.Interpolating(), 1), mesh.control())
heavy = {"trimesh", "scipy", "pyvista", "vtk", "meshio", "nibabel", "optimistix", "fitting", "matplotlib"}
print(*sorted(heavy & set(sys.modules)))
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""
