import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim.frames import SITE_FROM_WORLD, direction, rigid


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "expected"),
    [(0, 0, [0, 1, 0]), (90, 0, [1, 0, 0]), (180, 0, [0, -1, 0]), (123, 90, [0, 0, 1]), (0, -90, [0, 0, -1])],
)
def test_directions_are_clockwise_from_north(azimuth_deg, elevation_deg, expected) -> None:
    np.testing.assert_allclose(direction(np.radians(azimuth_deg), np.radians(elevation_deg)), expected, atol=1e-15)


def test_site_axes_are_north_east_down() -> None:
    north, east, up = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    in_site = SITE_FROM_WORLD.apply(np.stack([north, east, up]))
    np.testing.assert_allclose(in_site, np.diag([1.0, 1.0, -1.0]), atol=1e-15)
    assert np.linalg.det(SITE_FROM_WORLD.as_matrix()) == pytest.approx(1.0)


def test_rigid_rotates_then_translates() -> None:
    quarter_turn = Rotation.from_euler("z", 90, degrees=True)
    moved = rigid(quarter_turn, np.array([10.0, 0.0, 0.0])).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(moved, [10.0, 1.0, 0.0], atol=1e-15)
