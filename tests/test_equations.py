"""The equations of a sweep: derivatives by elements, sums over faces, and vectors of unknowns."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scans import analysed, hold_everything, problem
from schemes import MIXED, control_mesh, random_control

import jaxsubdiv as js
from fitting import Free, Priors, Residual
from fitting.model.residual import Pairs
from fitting.solve import elements as _elements
from fitting.solve.derivatives import differentiate
from fitting.solve.elements import find_elements, find_patches, forgets_some, jacobian, normal_matrix, times_transposed
from fitting.solve.sparse_normal import SparseEquations
from fitting.solve.structure import find_structure, row_faces


@functools.cache
def mixed_rows(kind: str, levels: int):
    """The rows of a mesh of triangles and quads about one place, and their derivatives in full."""
    scheme = {
        "default": js.Interpolating(1.1),
        "h a level": js.Interpolating([1.1] * levels),
        "circle": js.CirclePreserving(),
    }[kind]
    mesh, control = control_mesh(MIXED), random_control(MIXED, 0)
    topology = js.build_topology(mesh, scheme, levels)
    model, y = analysed(scheme, topology, control, priors=Priors(bend=1.0))
    surface = model.refine(y)
    face = np.random.default_rng(1).integers(surface.n_faces, size=60)
    at = js.SurfacePoint(face, np.full((60, 2), 0.3))
    corners, weights = js.corner_weights(surface, at)
    on, directions = js.evaluate(surface, at)
    held = hold_everything(model, y, Pairs(on + 0.1 * directions, corners, weights, directions), face)
    precisions = {"distance": np.random.default_rng(2).uniform(0.5, 2, 60)}
    for name, row in Residual(model).rows(y, held).items():
        precisions[name] = (
            np.random.default_rng(len(row)).uniform(0.5, 2, len(row)) if name != "distance" else precisions[name]
        )
    held = held._replace(distance_precisions=precisions.pop("distance"), precisions=precisions)
    of_offsets, split = Residual(model).recentre(y), model.layout.split

    @jax.jit
    def in_full(vector):
        return of_offsets.residual.rows(model.retract(y, split(vector)), held)

    zero = jnp.zeros(model.layout.n)
    by = {name: np.asarray(rows) for name, rows in jax.jacfwd(in_full)(zero).items()}
    return model, y, held, by


def dense(equations: SparseEquations, matrix) -> np.ndarray:
    """An arrowhead, without damping, as a whole."""
    return equations.multiply(matrix, np.eye(equations.model.layout.n))


@pytest.mark.parametrize(("kind", "levels"), [("default", 2), ("h a level", 2), ("circle", 1)])
def test_derivatives_by_elements_are_those_in_full(kind, levels):
    model, y, held, in_full = mixed_rows(kind, levels)
    structure = find_structure(model, y, held.priors)
    equations = SparseEquations(structure, model, y, held)
    np.testing.assert_allclose(equations.values["distance"], -0.1, atol=1e-12)
    for name in in_full.keys() - {"distance"}:
        np.testing.assert_allclose(equations.jacobian(name).toarray(), in_full[name], atol=1e-12, err_msg=name)
    # Far fewer derivatives than unknowns: that is what the colours are for.
    assert structure.elements.seeds.shape[0] < 0.75 * model.layout.n
    weights = {"distance": held.distance_precisions} | held.precisions
    products = {name: by.T @ (weights[name][:, None] * by) for name, by in in_full.items()}
    np.testing.assert_allclose(dense(equations, equations.data), products.pop("distance"), atol=1e-10)
    np.testing.assert_allclose(dense(equations, equations.prior), sum(products.values()), atol=1e-10)
    gradient = sum(by.T @ (weights[name] * equations.values[name]) for name, by in in_full.items())
    np.testing.assert_allclose(equations.gradient, gradient, atol=1e-10)


def test_sums_over_parts_of_the_faces_are_those_over_all(monkeypatch):
    """A few faces at a time, as it is done where there are many."""
    model, y, held, in_full = mixed_rows("default", 2)
    elements = find_structure(model, y, held.priors).elements
    monkeypatch.setattr(_elements, "_ENTRIES_AT_ONCE", 5 * elements.columns.shape[1] ** 2)
    structure = find_structure(model, y, held.priors)
    assert len(elements.runs) == 1 and len(structure.elements.runs) == -(-len(elements.columns) // 5)
    equations = SparseEquations(structure, model, y, held)
    by, weights = in_full["distance"], held.distance_precisions
    np.testing.assert_allclose(dense(equations, equations.data), by.T @ (weights[:, None] * by), atol=1e-10)
    products = [by.T @ (held.precisions[name][:, None] * by) for name, by in in_full.items() if name != "distance"]
    np.testing.assert_allclose(dense(equations, equations.prior), sum(products), atol=1e-10)


def test_rows_of_a_face_make_matrices_and_gradients():
    """More rows a face than are multiplied at once."""
    model, y, held, _ = mixed_rows("default", 2)
    elements = find_structure(model, y, held.priors).elements
    rng, m = np.random.default_rng(3), 40 * len(elements.columns)
    face, weights = rng.integers(len(elements.columns), size=m), rng.uniform(0.5, 2, m)
    by = np.where(elements.columns[face] < elements.n, rng.normal(size=(m, elements.columns.shape[1])), 0.0)
    whole, pattern = jacobian(elements, by, face).toarray(), elements.pattern
    values = normal_matrix(elements, by, weights, face)
    found = sp.csc_array((values, pattern.indices, pattern.indptr), shape=pattern.shape).toarray()
    np.testing.assert_allclose(found, whole.T @ (weights[:, None] * whole), atol=1e-10)
    np.testing.assert_allclose(times_transposed(elements, by, weights, face), whole.T @ weights, atol=1e-10)


def test_elements_that_are_too_small_are_noticed():
    model, y, held, _ = mixed_rows("default", 2)
    surface = model.refine(y)
    owner = js.control_faces_of(model.scheme, model.topology, surface, y.control)
    patches, rows = find_patches(surface.faces, owner, model.topology.n_control_faces), row_faces(model, held.priors)
    for rings in (0, 1):
        elements = find_elements(model, rings)
        found = differentiate(model, y, held.priors, elements.seeds)
        assert forgets_some(elements, patches, found, rows) == (rings == 0)


@pytest.mark.parametrize(
    "free", [Free(), Free(normals=False), Free(vertices=False), Free(True, True, False), Free(False, False, True)]
)
def test_vectors_of_unknowns_go_to_offsets_and_back(free):
    model, _ = analysed(js.Interpolating(), problem().topology, problem().truth, free=free)
    vector = np.arange(model.layout.n, dtype=float)
    offset = model.layout.split(jnp.asarray(vector))
    np.testing.assert_array_equal(model.layout.join(offset), vector)
    assert (offset.vertices is None, offset.normals is None) == (free.vertices is False, free.normals is False)
    if offset.vertices is not None:
        np.testing.assert_array_equal(offset.vertices[1], model.layout.width + np.arange(3))
