"""The outside of something hollow: what can be seen of it."""

import numpy as np
import pytest

import fitting


def shell() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a shell 2 mm thick with an opening above and a block inside, unit normals, and which are outside."""
    rng, points, normals = np.random.default_rng(0), [], []
    for radius, side, n in ((30.0, 1, 12_000), (28.0, -1, 10_000), (6.0, 1, 1000)):
        rows = rng.normal(size=(n, 3))
        rows /= np.linalg.norm(rows, axis=1)[:, None]
        rows = rows[(rows[:, 2] < 0.9) | (radius < 10)]
        points.append(radius * rows)
        normals.append(side * rows)
    outside = np.concatenate([np.full(len(rows), k == 0) for k, rows in enumerate(points)])
    return np.concatenate(points), np.concatenate(normals), outside


def test_what_is_seen_is_the_outside():
    points, normals, outside = shell()
    found = fitting.choose_outside(fitting.Scan(points, normals, weights=1.0 + outside))
    kept = np.asarray(found.weights) > 1.5
    assert kept.sum() > 0.98 * outside.sum() and np.mean(~kept) < 0.06  # some of the inside, through the opening
    inside = np.asarray(found.points)[~kept]
    assert len(inside) < 50 and (inside[:, 2] > 0).all()  # a few on top of the block, below the opening


def test_faces_tell_the_sides_too():
    from scipy.spatial import ConvexHull

    rng = np.random.default_rng(0)
    ball = rng.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    faces = ConvexHull(ball).simplices
    a, b, c = (ball[faces[:, k]] for k in range(3))
    inward = np.einsum("fx,fx->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    both = np.concatenate([10 * ball, 9 * ball])
    found = fitting.choose_outside(fitting.Scan(both, faces=np.concatenate([faces, faces[:, ::-1] + len(ball)])))
    assert found.n_points > 0.99 * len(ball) and np.linalg.norm(found.points, axis=1).min() > 9.5
    assert found.faces is not None and len(found.faces) > 0.95 * len(faces)


def test_what_has_no_sides_is_refused():
    assert fitting.choose_outside(fitting.Scan([[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])).n_points == 1
    points, normals, _ = shell()
    with pytest.raises(fitting.ScanError, match="neither: give a mesh, or normals"):
        fitting.choose_outside(fitting.Scan(points))
    with pytest.raises(fitting.ScanError, match="point inward"):
        fitting.choose_outside(fitting.Scan(points[:11_000], -normals[:11_000]))
