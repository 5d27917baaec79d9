"""The sparse Cholesky factors agree with dense linear algebra and SuperLU on patterns of many kinds."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from fitting.solve.cholesky import analyse


def torus_faces(a: int, b: int) -> np.ndarray:
    i, j = np.meshgrid(np.arange(a), np.arange(b), indexing="ij")
    corner = [((i + s) % a * b + (j + t) % b).ravel() for s, t in ((0, 0), (1, 0), (1, 1), (0, 1))]
    return np.concatenate([np.stack([corner[0], corner[k], corner[k + 1]], 1) for k in (1, 2)])


def surface(a: int = 10, b: int = 13, width: int = 5, mirror: bool = False) -> tuple[sp.csc_array, np.ndarray]:
    """Normal equations like those of a surface fit, and the unknowns near each face."""
    faces = torus_faces(a, b)
    rng = np.random.default_rng(3)
    numbers = rng.permutation(a * b)
    ones = np.ones(faces.size)
    incidence = sp.csr_array((ones, (np.repeat(np.arange(len(faces)), 3), numbers[faces].ravel())))
    near = sp.csr_array((incidence @ incidence.T) @ incidence)
    jacobian = sp.csr_array(sp.kron(near, np.ones((4, width))))
    jacobian.data = rng.standard_normal(jacobian.nnz)
    matrix = sp.csc_array(jacobian.T @ jacobian + sp.eye_array(a * b * width))
    if mirror:
        flip = numbers[(-np.arange(a) % a)[:, None] * b + np.arange(b)].ravel()[np.argsort(numbers)]
        pairs = sp.csr_array((np.ones(a * b), (np.arange(a * b), flip))) - sp.eye_array(a * b)
        pairs = sp.kron(pairs, sp.eye_array(width))
        matrix = sp.csc_array(matrix + 10 * pairs.T @ pairs)
    cliques = np.stack([near[[f]].indices for f in range(len(faces)) if near[[f]].nnz == 12])
    return matrix, (cliques[:, :, None] * width + np.arange(width)).reshape(len(cliques), -1)


def scattered(n: int, share: float, seed: int) -> sp.csc_array:
    rows = sp.random_array((n, n), density=share, rng=np.random.default_rng(seed), format="csc")
    return sp.csc_array(rows.T @ rows + 0.5 * sp.eye_array(n))


def masked() -> sp.csc_array:
    matrix = surface()[0]
    kept = np.flatnonzero(np.random.default_rng(1).random(matrix.shape[0]) < 0.7)
    return sp.csc_array(matrix[kept][:, kept])


def star(n: int) -> sp.csc_array:
    matrix = sp.lil_array((n, n))
    matrix[n // 2, :], matrix[:, n // 2] = 1.0, 1.0
    matrix.setdiag(2.0)
    matrix[n // 2, n // 2] = n
    return sp.csc_array(matrix)


PATTERNS = {
    "mesh": lambda: surface()[0],
    "mesh of width 3": lambda: surface(17, 8, 3)[0],
    "mirror": lambda: surface(mirror=True)[0],
    "masked": masked,
    "scattered": lambda: scattered(400, 0.008, 0),
    "scattered densely": lambda: scattered(300, 0.03, 1),
    "diagonal": lambda: sp.csc_array(sp.diags_array(np.arange(1.0, 400.0))),
    "dense": lambda: scattered(150, 1.0, 2),
    "one": lambda: sp.csc_array(np.array([[4.0]])),
    "disconnected": lambda: sp.csc_array(sp.block_diag([surface(7, 7)[0], np.eye(3), scattered(50, 0.2, 3)])),
    "chain": lambda: sp.csc_array(sp.diags_array([-1.0, 2.5, -1.0], offsets=[-1, 0, 1], shape=(900, 900))),
    "star": lambda: star(500),
}


def near(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.abs(one - other).max() <= 1e-10 * np.abs(other).max())


@pytest.mark.parametrize("name", PATTERNS)
def test_agrees_with_dense_algebra(name):
    matrix = PATTERNS[name]()
    n = matrix.shape[0]
    factor = analyse(matrix).factorise(matrix)
    rng = np.random.default_rng(0)
    sides = rng.standard_normal((n, 7))
    lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    assert near(factor.solve(sides), lu.solve(sides))
    assert near(factor.solve(np.asfortranarray(sides)), lu.solve(sides))
    assert factor.solve(sides[:, 0]).shape == (n,)
    assert near(factor.solve(sides[:, 0]), lu.solve(sides[:, 0]))
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(matrix.toarray())[1], rel=1e-10, abs=1e-10)
    # all entries of the pattern, as pairs of unknowns
    inverse = np.linalg.inv(matrix.toarray())
    pairs = np.stack(matrix.nonzero(), 1)
    assert near(factor.inverse_blocks(pairs), inverse[pairs[:, :, None], pairs[:, None, :]])
    # the rows of R^-1 make up the inverse
    root = factor.sample(np.eye(n))
    assert near(root @ root.T, inverse)


@pytest.mark.parametrize("mirror", [False, True])
def test_inverse_blocks_of_faces_with_padding(mirror):
    matrix, columns = surface(mirror=mirror)
    n = matrix.shape[0]
    columns = np.where(np.random.default_rng(0).random(columns.shape) < 0.2, n, columns)
    columns[3], columns[5, 1:] = n, n
    inverse = np.pad(np.linalg.inv(matrix.toarray()), (0, 1))
    factor = analyse(matrix).factorise(matrix)
    blocks = factor.inverse_blocks(columns)
    assert near(blocks, inverse[columns[:, :, None], columns[:, None, :]])
    assert not blocks[3].any()
    assert factor.inverse_blocks(columns[:0]).shape == (0, 60, 60)


def test_inverse_blocks_refuses_uncoupled_unknowns():
    matrix = PATTERNS["chain"]()
    with pytest.raises(ValueError, match="not coupled"):
        analyse(matrix).factorise(matrix).inverse_blocks(np.array([[0, 899]]))


def test_covariance_of_samples():
    matrix = scattered(12, 0.3, 5)
    drawn = analyse(matrix).factorise(matrix).sample(np.random.default_rng(0).standard_normal((12, 200_000)))
    inverse = np.linalg.inv(matrix.toarray())
    spread = np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(np.cov(drawn) / np.outer(spread, spread), inverse / np.outer(spread, spread), atol=0.015)


def test_matrix_of_part_of_the_pattern():
    matrix, _ = surface()
    symbolic = analyse(matrix)
    few = matrix.copy()
    few.data[np.abs(few.data) < 10] = 0
    few.eliminate_zeros()
    few = sp.csc_array(few + 1000 * sp.eye_array(matrix.shape[0]))
    assert few.nnz < matrix.nnz
    side = np.arange(matrix.shape[0], dtype=float)
    assert near(few @ symbolic.factorise(few).solve(side), side)
    with pytest.raises(ValueError, match="outside"):
        analyse(few).factorise(matrix)
    with pytest.raises(ValueError, match="shape"):
        symbolic.factorise(few[:-1, :-1])


def test_unsorted_columns_and_other_values():
    matrix, _ = surface()
    twice = sp.csc_array(2 * matrix.tocsr().T)  # the columns of a product come unsorted
    order = np.concatenate([np.arange(b - 1, a - 1, -1) for a, b in zip(twice.indptr, twice.indptr[1:], strict=False)])
    unsorted = sp.csc_array((twice.tocsc().data[order], twice.tocsc().indices[order], twice.indptr), twice.shape)
    before = unsorted.data.copy()
    side = np.ones(matrix.shape[0])
    once = analyse(unsorted).factorise(matrix).solve(side)
    assert near(analyse(matrix).factorise(unsorted).solve(side), once / 2)
    np.testing.assert_array_equal(unsorted.data, before)


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan])
def test_not_positive_definite(bad):
    matrix, _ = surface()
    symbolic = analyse(matrix)
    matrix[[77], [77]] = bad
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        symbolic.factorise(matrix)


def test_indefinite_with_positive_diagonal():
    matrix = sp.csc_array(np.array([[1.0, 2.0], [2.0, 1.0]]))
    with pytest.raises(np.linalg.LinAlgError, match="at unknown 1"):
        analyse(matrix).factorise(matrix)


def test_same_results_every_time():
    matrix, columns = surface()
    side = np.random.default_rng(0).standard_normal(matrix.shape[0])
    first, second = (analyse(matrix.copy()).factorise(matrix.copy()) for _ in range(2))
    np.testing.assert_array_equal(first.values, second.values)
    np.testing.assert_array_equal(first.solve(side), second.solve(side))
    np.testing.assert_array_equal(first.inverse_blocks(columns), second.inverse_blocks(columns))
