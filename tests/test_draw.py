"""Pictures: what is drawn where, in which colour, and what hides what."""

import sys

import meshes
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxsubdiv as js

FROM_ABOVE = np.eye(3)


def picture(surface, **how) -> np.ndarray:
    """The image `[rows, columns, 4]`, from the bottom up."""
    ax = Figure().subplots()
    js.draw_surface(ax, surface, **{"view": FROM_ABOVE, "pixels": 60} | how)
    [image] = ax.images
    return np.asarray(image.get_array())


def square(height: float = 0.0, size: float = 1.0) -> js.ControlMesh:
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * size
    return js.ControlMesh(np.column_stack([corners, np.full(4, height)]), [(0, 1, 2, 3)])


def refined(mesh: meshes.Mesh, levels: int = 1) -> js.RefinedSurface:
    checked, scheme = js.ControlMesh(*mesh), js.Loop()
    return js.refine(scheme, js.build_topology(checked, scheme, levels), checked.control())


def test_views_are_rotations_towards_an_open_surface_and_the_broad_side_of_a_closed_one():
    sheet, ring = js.ControlMesh(*meshes.grid(3, 2)), js.ControlMesh(*meshes.torus(8, 4))
    for view in (js.view_of(sheet), js.view_of(ring), js.view_of(ring, (1, 2, 3)), js.view_of(refined(meshes.fan(5)))):
        np.testing.assert_allclose(view @ view.T, np.eye(3), rtol=0, atol=1e-12)
        assert np.linalg.det(view) > 0
    np.testing.assert_allclose(js.view_of(sheet)[2], (0, 0, 1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs(js.view_of(ring)[2]), (0, 0, 1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(js.view_of(ring, (1, 2, 3))[2] * np.sqrt(14), (1, 2, 3), rtol=0, atol=1e-12)


def test_a_surface_covers_its_outline_and_the_axes_have_its_unit():
    ax = Figure().subplots()
    js.draw_surface(ax, square(size=5.0), view=FROM_ABOVE, frame=(-5, 5, 0, 5), pixels=480)
    [image] = ax.images
    shown = np.asarray(image.get_array())
    assert shown.shape == (240, 480, 4) and image.get_extent() == [-5, 5, 0, 5]
    assert np.all(shown[2:-2, 243:-2, 3] == 1) and np.all(shown[:, :239] == 0)


def test_the_nearer_face_hides_the_farther_one_and_triangles_cross_where_they_cross():
    near = js.ControlMesh(*meshes.union(*((m.vertices, [(0, 1, 2, 3)]) for m in (square(1, 0.5), square(0)))))
    values = np.repeat([0.0, 1.0], 4)
    for order in (slice(None), slice(None, None, -1)):
        mesh = js.ControlMesh(near.vertices, near.faces[4][order])
        shown = picture(mesh, values=values, limits=(0, 1), cmap="gray", frame=(0, 1, 0, 1))
        assert np.all(shown[:28, :28, 0] < 0.3) and np.all(shown[32:, 32:, 0] > 0.6)
    tilted = np.array([(0, 0, -1), (1, 0, 1), (1, 1, 1), (0, 1, -1)])
    both = js.ControlMesh(np.concatenate([square().vertices, tilted]), [(0, 1, 2, 3), (4, 5, 6, 7)])
    shown = picture(both, values=values, limits=(0, 1), cmap="gray", frame=(0, 1, 0, 1))
    assert np.all(shown[:, :28, 0] < 0.3) and np.all(shown[:, 32:, 0] > 0.6)


def test_values_without_a_number_keep_the_colour():
    plain, unknown = (picture(square(), colour="tab:red", values=v) for v in (np.arange(4.0), [np.nan, 0, 1, np.nan]))
    assert np.ptp(plain[5:-5, 5:-5, 0]) > 0.1
    left = unknown[5:-5, 5:20]
    assert np.all(left[..., 0] > 2 * left[..., 2])


def test_colours_are_explained_where_there_are_values():
    ax = Figure().subplots()
    assert js.draw_surface(ax, square(), view=FROM_ABOVE) is None
    shown = js.draw_surface(ax, square(), view=FROM_ABOVE, values=np.array([2.0, 3.0, np.nan, 5.0]))
    assert (shown.norm.vmin, shown.norm.vmax) == (2, 5)


def test_edges_are_those_of_the_faces_and_no_diagonals():
    plain, lined = (picture(square(), edges=edges, frame=(-0.2, 1.2, -0.2, 1.2)) for edges in (False, True))
    darker = plain[..., 0] - lined[..., 0] > 0.1
    inside = slice(14, 46)
    assert not darker[inside, inside].any()
    assert darker.any(axis=0)[14:46].all() and darker.any(axis=1)[14:46].all()


def test_stripes_and_the_shade_follow_the_normals():
    ball = refined(meshes.octahedron(), 3)
    plain, striped = (picture(ball, stripes=stripes) for stripes in (False, True))
    light = plain[30, 5:55, 0]
    assert light.argmax() < 25 and np.abs(np.diff(light)).max() < 0.1  # from the left, without facets
    changes = np.diff((striped[5:55, 30, 0] > 0.5).astype(int)) != 0
    assert changes.sum() > 8
    assert not np.array_equal(striped, plain)


def test_the_back_of_a_face_is_bluish():
    front, back = (picture(square(), view=(0, 0, side))[30, 30] for side in (1, -1))
    assert back[2] / back[0] > 1.1 * front[2] / front[0]


def test_without_matplotlib_it_says_what_to_install(monkeypatch):
    ax = Figure().subplots()
    monkeypatch.setitem(sys.modules, "matplotlib.cm", None)
    with pytest.raises(ImportError, match=r"jaxsubdiv\[viz\]"):
        js.draw_surface(ax, square())
