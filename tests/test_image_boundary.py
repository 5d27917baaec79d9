"""What the boundary of a label says, what is fitted to it, and slices of the image."""

import re
from pathlib import Path

import nibabel
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from voxels import TURN

import fitting
import jaxsubdiv as js
from fitting.__main__ import main as fit_command
from fitting.start.mesh_topology import MeshTopology, face_topology
from jaxsubdiv.frames import convert_frame

RADII = np.array([20.0, 15.0, 12.0])
MIDDLE = np.array([31.0, -42.0, 17.0])


def ellipsoid(spacing: float | np.ndarray = 2.0, cut: float = 0.0) -> tuple[fitting.Volume, np.ndarray]:
    """A label map of an ellipsoid, oblique to the voxels, and how far inside each voxel lies, 1 in the middle, 0 at the
    surface; `cut` is the part of the image that is missing at the end of the first index."""
    spacing = np.resize(spacing, 3).astype(float)
    n = np.ceil(60 / spacing).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = TURN * spacing
    affine[:3, 3] = MIDDLE - TURN @ (spacing * (n - 1) / 2) + 0.2
    n[0] = int(n[0] * (1 - cut))
    index = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), axis=-1).reshape(-1, 3)
    inside = 1 - np.linalg.norm((index @ affine[:3, :3].T + affine[:3, 3] - MIDDLE) / RADII, axis=1)
    inside = inside.reshape(tuple(n))
    return fitting.Volume(((inside > 0).astype(np.uint8),), affine, "RAS"), inside


def off_ellipsoid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances from it, to first order, and its normals."""
    own = (points - MIDDLE) / RADII
    slope = own / RADII
    return (np.linalg.norm(own, axis=1) - 1) * np.linalg.norm(own, axis=1) / np.linalg.norm(slope, axis=1), (
        slope / np.linalg.norm(slope, axis=1, keepdims=True)
    )


@pytest.mark.parametrize("spacing", [2.0, 1.0, np.array([1.0, 1.0, 4.0])], ids=["2 mm", "1 mm", "thick slices"])
def test_points_are_as_far_off_as_they_say(spacing):
    volume, _ = ellipsoid(spacing)

    scan = fitting.scan_of_label(volume, fitting.Label(1, ""))

    points, deviations = np.asarray(scan.points), np.asarray(scan.deviations)
    off, normals = off_ellipsoid(points)
    turned = np.degrees(np.arccos(np.clip(np.einsum("px,px->p", normals, np.asarray(scan.normals)), -1, 1)))
    assert turned.mean() < (3.5 if np.ptp(spacing) == 0 else 7.5)
    assert abs(off.mean()) < 0.03 * volume.spacing.max()
    by_deviation = np.array_split(np.argsort(deviations), 4)
    for rows in by_deviation:  # the sure points are near, the others are not
        ratio = np.sqrt(np.mean(off[rows] ** 2) / np.mean(deviations[rows] ** 2))
        assert 0.7 < ratio < 1.4
    assert deviations[by_deviation[-1]].mean() > 2 * deviations[by_deviation[0]].mean()
    assert scan.frame == "RAS"


def test_grey_values_place_the_surface_between_voxels():
    volume, inside = ellipsoid(2.0)
    grey = np.random.default_rng(0).normal(1000 * inside, 5.0)
    image = volume._replace(layers=(grey,))

    scan = fitting.scan_above(image, 0.0)

    off, normals = off_ellipsoid(np.asarray(scan.points))
    assert np.sqrt(np.mean(off**2)) < 0.05 * 2.0  # a label's points are 0.2 voxels off
    assert np.einsum("px,px->p", normals, np.asarray(scan.normals)).mean() > 0.999
    assert 0.5 < np.sqrt(np.mean(off**2)) / np.sqrt(np.mean(np.asarray(scan.deviations) ** 2)) < 2
    with pytest.raises(fitting.ScanError, match="no surface at 5000: its voxels go from"):
        fitting.scan_above(image, 5000.0)


def test_a_fit_leaves_no_stairs_and_keeps_the_volume():
    volume, _ = ellipsoid(2.0)
    scan = fitting.scan_of_label(volume, fitting.Label(1, ""))

    found = fitting.fit_scan(scan, faces=100, levels=3)

    surface = found.result.surface
    off, normals = off_ellipsoid(np.asarray(surface.vertices))
    turned = np.degrees(np.arccos(np.clip(np.einsum("px,px->p", normals, np.asarray(surface.normals)), -1, 1)))
    assert np.sqrt(np.mean(off**2)) < 0.06 * 2.0  # of a voxel; marching cubes: 0.17
    assert np.sqrt(np.mean(turned**2)) < 3.0
    corners = np.asarray(surface.vertices)[np.asarray(surface.triangles())] - MIDDLE
    enclosed = np.linalg.det(corners).sum() / 6
    assert abs(enclosed / (4 / 3 * np.pi * RADII.prod()) - 1) < 0.004
    assert found.result.trusted
    assert "RAS (right, anterior, superior)" in str(found.result.report())


def test_the_surface_is_open_where_the_image_ends():
    volume, _ = ellipsoid(2.0, cut=0.25)  # a cap of it was not seen: a tenth of its area
    scan = fitting.scan_of_label(volume, fitting.Label(1, ""))

    mesh = fitting.control_mesh(scan, faces=100)

    assert fitting.topology_of(mesh).boundary_loops == 1
    last = volume.layers[0].shape[0] - 1
    at_rim = volume.indices(mesh.vertices[np.unique(mesh.half_edges.edges[rim_edges(mesh)])])[:, 0]
    np.testing.assert_allclose(at_rim, last, atol=2)
    whole = fitting.scan_of_label(ellipsoid(2.0)[0], fitting.Label(1, ""))
    assert fitting.topology_of(fitting.control_mesh(whole, faces=100)).is_closed


def rim_edges(mesh: js.ControlMesh) -> np.ndarray:
    return np.bincount(mesh.half_edges.edge) == 1


def test_a_thin_sheet_starts_from_its_outline():
    volume, inside = ellipsoid(1.0)
    index = np.stack(np.meshgrid(*map(np.arange, inside.shape), indexing="ij"), axis=-1).reshape(-1, 3).astype(float)
    along = ((volume.positions(index) - MIDDLE) @ TURN[:, 0]).reshape(inside.shape)
    cup = ((inside > 0) & (inside < 0.15) & (along > 0)).astype(np.uint8)  # half of a shell, 2 to 3 voxels thick
    with pytest.warns(UserWarning, match="thinner than two voxels"):
        scan = fitting.scan_of_label(volume._replace(layers=(cup,)), fitting.Label(1, ""))
    assert scan.outlined and scan.faces is not None
    assert MeshTopology(1, 0, 0, 2) == face_topology({3: scan.faces, 4: np.zeros((0, 4), np.int32)})
    a, b, c = np.moveaxis(np.asarray(scan.points)[scan.faces] - MIDDLE, 1, 0)
    assert np.einsum("tx,tx->", a, np.cross(b, c)) / 6 == pytest.approx(cup.sum(), rel=0.02)  # mm^3, wound outwards

    mesh = fitting.control_mesh(scan, faces=300)

    assert fitting.topology_of(mesh) == MeshTopology(1, 0, 0, 2)
    edge = np.linalg.norm(np.diff(mesh.vertices[mesh.half_edges.edges], axis=1), axis=2).mean()
    far = KDTree(mesh.vertices).query(np.asarray(scan.points))[0]
    assert np.quantile(far, 0.95) < 2 * edge  # near enough for the fit, which draws the rim out


def test_thin_parts_are_named():
    volume, inside = ellipsoid(2.0)
    shell = ((inside > 0) & (inside < 0.12)).astype(np.uint8)  # a wall of about 2 mm
    with pytest.warns(UserWarning, match="label 1: .*thinner than two voxels"):
        fitting.scan_of_label(volume._replace(layers=(shell,)), fitting.Label(1, ""))


def test_a_label_without_a_boundary_is_refused():
    full = fitting.Volume((np.ones((4, 4, 4), np.uint8),), np.eye(4), None)
    with pytest.raises(fitting.ScanError, match="fills the image"):
        fitting.scan_of_label(full, fitting.Label(1, ""))
    with pytest.raises(fitting.ScanError, match="all of its voxels are 0"):
        fitting.find_labels(full._replace(layers=(np.zeros((4, 4, 4), np.uint8),)))
    with pytest.raises(fitting.ScanError, match=r"no whole numbers.*--above"):
        fitting.find_labels(full._replace(layers=(gaussian_filter(np.eye(4)[None] + np.zeros((4, 4, 4)), 1),)))
    with pytest.raises(fitting.ScanError, match=r"go from -1000 to .*--above"):
        fitting.find_labels(full._replace(layers=(np.arange(-1000, 64000).reshape(40, 25, 65),)))


@pytest.mark.parametrize("frame", ["RAS", "LPS"])
def test_slices_show_the_label_where_it_is_and_name_their_sides(frame):
    volume, _ = ellipsoid(2.0)
    volume = volume._replace(frame=frame)
    label = fitting.Label(1, "")
    index = np.argwhere(volume.layers[0]).astype(float)
    for one in fitting.cut_slices(volume, volume.positions(index), label=label):
        pixels = volume.positions(index) @ one.to_pixels[:3, :3].T + one.to_pixels[:3, 3]
        column, row, _ = np.round(pixels[np.abs(pixels[:, 2]) < 0.5]).astype(int).T
        assert len(row) == (one.grey == one.grey.max()).sum()
        assert (one.grey[row, column] == one.grey.max()).all()
        # A step towards the side that a letter names goes that way on the page.
        left, right, top, _ = one.sides
        for letter, axis, way in ((right, 0, 1), (left, 0, -1), (top, 1, -1)):
            towards = {
                "R": [1, 0, 0],
                "A": [0, 1, 0],
                "S": [0, 0, 1],
                "L": [-1, 0, 0],
                "P": [0, -1, 0],
                "I": [0, 0, -1],
            }
            step = convert_frame(np.array(towards[letter], float), "RAS", frame)
            assert way * (one.to_pixels[:3, :3] @ step)[axis] > 0
        assert top in "SA" and left in "RAI"


def test_every_axis_has_sides_of_its_own():
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    affine[:2, :2] += [[0.01, 0], [0, -0.01]]  # both axes are nearer to x
    volume = fitting.Volume((np.ones((9, 9, 9), np.uint8),), affine, "RAS")
    corners = volume.positions(np.array([[2.0, 2, 2], [6, 6, 6]]))
    for one in fitting.cut_slices(volume, corners, label=fitting.Label(1, "")):
        assert len(set(one.sides)) == 4


def test_an_even_part_of_many_points_is_drawn():
    volume, _ = ellipsoid(2.0)
    whole = np.asarray(fitting.scan_of_label(volume, fitting.Label(1, "")).points)
    part = np.asarray(fitting.scan_of_label(volume, fitting.Label(1, ""), most_points=500).points)
    assert len(part) == 500 and len(np.unique(part, axis=0)) == 500
    assert (np.abs(whole[None] - part[:, None]).max(axis=-1).min(axis=1) < 1e-6).all()
    np.testing.assert_allclose(part.mean(axis=0), whole.mean(axis=0), atol=2)


def test_contours_lie_on_the_surface():
    volume, _ = ellipsoid(2.0)
    mesh = fitting.control_mesh(fitting.scan_of_label(volume, fitting.Label(1, "")), faces=100)
    for one in fitting.cut_slices(volume, mesh.vertices, label=fitting.Label(1, "")):
        ends = one.cut(mesh.vertices, mesh.faces[3])
        # Every segment begins where another ends: the contour is closed.
        rounded = np.round(ends.reshape(-1, 2), 6)
        _, counts = np.unique(rounded, axis=0, return_counts=True)
        assert len(ends) > 8 and (counts == 2).all()


@pytest.fixture(scope="module")
def two_labels(tmp_path_factory) -> Path:
    """Two ellipsoids of another label each, one named."""
    volume, _ = ellipsoid(3.0)
    one = volume.layers[0]
    values = np.concatenate([one, 5 * one], axis=0)
    image = nibabel.Nifti1Image(values, volume.affine)
    table = b'<LabelTable><Label Key="5"><![CDATA[right/kidney]]></Label></LabelTable>'
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, table))
    path = tmp_path_factory.mktemp("labels") / "seg.nii.gz"
    nibabel.save(image, path)
    return path


def test_the_command_fits_every_label_into_a_folder_of_its_own(two_labels, tmp_path, capsys):
    options = ["--faces", "60", "--levels", "2", "--max-sweeps", "12", "-o", str(tmp_path / "out")]
    assert fit_command([str(two_labels), "--label", "all", *options]) == 0, capsys.readouterr().err
    assert (tmp_path / "out" / "seg_1" / "fit.npz").is_file()
    assert (tmp_path / "out" / "seg_right_kidney" / "fit.html").is_file()
    assert "data:image/png" in (tmp_path / "out" / "seg_1" / "fit.html").read_text(encoding="utf-8")
    loaded = fitting.load(tmp_path / "out" / "seg_1")
    assert loaded.scan.frame == "RAS"
    assert "seg.nii.gz, 5 right/kidney" in (tmp_path / "out" / "summary.csv").read_text()
    capsys.readouterr()


def test_labels_and_grey_values_at_once_are_refused_before_any_fit(two_labels, tmp_path, capsys):
    options = ["--label", "all", "--above", "3", "-o", str(tmp_path / "out")]
    assert fit_command([str(two_labels), *options]) == 2
    assert "not both" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ([], r"seg.nii.gz: it has 2 labels; choose one by --label .* 1 \(.* ml\), 5 right/kidney \(.* ml\)"),
        (["--label", "liver"], "no voxel has the label 'liver'"),
        (["--label", "1", "--above", "3"], "not both"),
        (["--labels", "liver"], "is for tables"),
    ],
)
def test_the_command_says_what_a_label_map_holds(two_labels, tmp_path, capsys, options, text):
    assert fit_command([str(two_labels), "-o", str(tmp_path / "out"), *options]) == 2
    assert re.search(text, capsys.readouterr().err)


def test_labels_are_refused_of_points(tmp_path, capsys):
    (tmp_path / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    assert fit_command([str(tmp_path / "a.xyz"), "--label", "1", "-o", str(tmp_path / "out")]) == 2
    assert "--label (`label=`) is for images and label maps" in capsys.readouterr().err
