"""Tests of elevation maps built from points with known heights, and of the rotation to the surface frame."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import ElevationMap, HdaOptions, SurfaceFrame
from marsyard.algorithms.hda.elevation import elevation_map
from marsyard.algorithms.hda.scene import (
    CameraView,
    plane_normal,
    surface_from_camera,
    up_direction,
    world_from_surface,
)
from marsyard.sim.camera import camera_pose
from tests.algorithms.hda.relief_scene import make_camera, make_pose


def draw_points(count: int, rng: np.random.Generator, slopes: tuple[float, float] = (0.2, -0.1)) -> np.ndarray:
    """Draw points on a sloping plane 10 m below the camera, in an area of 8 m x 6 m."""
    x, y = rng.uniform([-4.0, -3.0], [4.0, 3.0], (count, 2)).T
    return np.column_stack([x, y, -10.0 + slopes[0] * x + slopes[1] * y])


def test_cell_positions_and_indices_are_inverse() -> None:
    ground = ElevationMap(np.zeros((4, 6)), np.array([-1.0, 2.0]), 0.5)
    # Rows run along -y, columns along x.
    np.testing.assert_allclose(
        ground.positions(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 5.0]])), [[-1.0, 2.0], [-1.0, 0.5], [1.5, 2.0]]
    )
    cells = np.random.default_rng(2).uniform(-3.0, 9.0, (50, 2))
    np.testing.assert_allclose(ground.cells(ground.positions(cells)), cells)


def test_points_are_distributed_by_bilinear_weights() -> None:
    # Four corner points and one inner point in a box of 3 m x 3 m: cells of sqrt(9 / 5) m, hence 3 x 3 cells.
    points = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 4.0], [3.0, 3.0, 0.0], [0.9, 2.1, 8.0]])
    ground = elevation_map(points)
    cell = ground.cell_m
    assert cell == pytest.approx(np.sqrt(9.0 / 5.0))
    assert ground.elevation_m.shape == (3, 3)
    # the map is centred on its points
    np.testing.assert_allclose(ground.positions(np.array([1.0, 1.0])), [1.5, 1.5])
    weights = np.zeros(ground.elevation_m.shape)
    sums = np.zeros(ground.elevation_m.shape)
    for point in points:
        for row, column in np.ndindex(weights.shape):
            x, y = ground.positions(np.array([row, column], dtype=np.float64))
            weight = max(0.0, 1.0 - abs(point[0] - x) / cell) * max(0.0, 1.0 - abs(point[1] - y) / cell)
            weights[row, column] += weight
            sums[row, column] += weight * point[2]
    # Cells with a total weight below 0.1 have no elevation.
    expected = np.where(weights >= 0.1, sums / np.where(weights > 0.0, weights, 1.0), np.nan)
    np.testing.assert_allclose(ground.elevation_m, expected)


def test_cells_without_points_are_unknown() -> None:
    points = draw_points(4000, np.random.default_rng(3))
    points = points[np.hypot(points[:, 0] - 1.0, points[:, 1]) > 1.0]
    ground = elevation_map(points)
    positions = ground.positions(np.moveaxis(np.indices(ground.elevation_m.shape).astype(np.float64), 0, -1))
    distance = np.hypot(positions[..., 0] - 1.0, positions[..., 1])
    assert np.all(np.isnan(ground.elevation_m[distance < 1.0 - ground.cell_m]))
    assert np.isnan(ground.elevation_m[distance > 1.3]).mean() < 0.05


def test_collinear_points_are_rejected() -> None:
    assert elevation_map(np.column_stack([np.arange(50.0), np.zeros(50), np.zeros(50)])) is None
    assert elevation_map(np.zeros((50, 3))) is None


def make_view(yaw: float, pitch: float, roll: float) -> CameraView:
    """Create a black image from a body with this attitude, degrees."""
    body_from_camera = camera_pose(make_camera())
    counts = np.zeros((240, 320), dtype=np.uint16)
    return CameraView(
        counts,
        make_camera().transform(body_from_camera.inv()),
        make_pose(3.0, 4.0, 10.0, yaw, pitch, roll) * body_from_camera,
    )


@pytest.mark.parametrize("attitude", [(0.0, 0.0, 0.0), (40.0, 10.0, -15.0), (190.0, -20.0, 5.0)])
def test_surface_frame_is_level_and_differs_from_world_by_yaw(attitude: tuple[float, float, float]) -> None:
    first = make_view(*attitude)
    up = first.world_from_camera.rotation.inv().apply(np.array([0.0, 0.0, 1.0]))
    to_surface = surface_from_camera(up)
    np.testing.assert_allclose(to_surface.apply(up), [0.0, 0.0, 1.0], atol=1e-12)
    # The columns of the image run along x without a component along y.
    assert abs(to_surface.apply(np.array([1.0, 0.0, 0.0]))[1]) < 1e-12
    to_world = world_from_surface(first.world_from_camera.rotation, to_surface)
    np.testing.assert_allclose(
        (to_world * to_surface).as_matrix(), first.world_from_camera.rotation.as_matrix(), atol=1e-12
    )


def test_gravity_source_follows_the_options() -> None:
    first = make_view(30.0, 5.0, -5.0)
    state_up = first.world_from_camera.rotation.inv().apply(np.array([0.0, 0.0, 1.0]))
    tilted_up = Rotation.from_rotvec([0.02, 0.0, 0.0]).apply(state_up)
    rng = np.random.default_rng(4)
    flat = draw_points(500, rng, (0.0, 0.0)) + np.array([0.0, 0.0, 1.0]) * rng.normal(0.0, 0.01, (500, 1))
    flat[:150, 2] += rng.uniform(0.5, 2.0, 150)  # outliers
    points = surface_from_camera(state_up).inv().apply(flat)
    result = {frame: up_direction(first, tilted_up, points, HdaOptions(surface_frame=frame)) for frame in SurfaceFrame}
    np.testing.assert_allclose(result[SurfaceFrame.INCLINOMETER], tilted_up)
    np.testing.assert_allclose(result[SurfaceFrame.STATE], state_up)
    # The fit error of the 350 other points, with 1 cm of noise and an RMS distance of 2.3 m from the middle, is
    # 0.01 / (sqrt(350) 2.3) = 2e-4 rad.
    assert np.arccos(min(float(result[SurfaceFrame.PLANE] @ state_up), 1.0)) < 2e-3


def test_map_has_one_point_per_cell_on_average() -> None:
    points = draw_points(600, np.random.default_rng(1))
    ground = elevation_map(points)
    extent = np.ptp(points[:, :2], axis=0)
    # The paper's cell size s = sqrt(A / N), and the number of whole cells that cover the box.
    assert ground.cell_m == pytest.approx(np.sqrt(extent[0] * extent[1] / 600))
    assert ground.elevation_m.shape == tuple(int(np.ceil(side / ground.cell_m)) for side in extent[::-1])


def test_plane_is_reconstructed_from_even_points() -> None:
    x, y = np.meshgrid(np.arange(40) * 0.25, np.arange(30) * 0.25)
    points = np.column_stack([x.ravel(), y.ravel(), 0.2 * x.ravel() - 0.1 * y.ravel() - 9.0])
    ground = elevation_map(points)
    positions = ground.positions(np.moveaxis(np.indices(ground.elevation_m.shape).astype(np.float64), 0, -1))
    plane = 0.2 * positions[..., 0] - 0.1 * positions[..., 1] - 9.0
    # Points are up to half a cell from the cell centre: the error is at most the rise within half a cell.
    assert np.nanmax(np.abs(ground.elevation_m - plane)) < 0.5 * 0.3 * ground.cell_m
    assert not np.any(np.isnan(ground.elevation_m))


def test_robust_normal_points_to_the_camera() -> None:
    points = draw_points(200, np.random.default_rng(5))
    expected = np.array([-0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
    np.testing.assert_allclose(plane_normal(points, 0), expected, atol=1e-9)
    np.testing.assert_allclose(plane_normal(-points, 0), -expected, atol=1e-9)
