"""Tests of the navigator's terrain map: cells, new data, and goodness of the ground (0: hazard, 1: level)."""

from __future__ import annotations

import numpy as np
import pytest

from marsyard.algorithms.navigation.terrain_map import CELL_M, GroundLimits, TerrainMap

#: Limits of the rover: radius of its footprint, height of steps, tilt and roughness.
LIMITS = GroundLimits(radius_m=0.7, climb_m=0.2, tilt_rad=float(np.radians(30.0)), roughness_m=0.06)
EMPTY = TerrainMap.empty(np.zeros(2))
ORIGIN = np.zeros((1, 2))


def _sample_plane(east_slope: float, height: float = 0.0) -> np.ndarray:
    """Sample a plane within 3 m of the origin every 5 cm; points (east, north, up), metres."""
    axis = np.arange(-3.0, 3.0, 0.05)
    east, north = (values.ravel() for values in np.meshgrid(axis, axis))
    return np.column_stack([east, north, height + east_slope * east])


def test_plane_has_the_goodness_of_its_tilt() -> None:
    terrain = EMPTY.add_points(_sample_plane(np.tan(np.radians(15.0))))
    # goodness at a tilt of 15 deg and a limit of 30 deg: 1 - 15 / 30; the tolerance covers the slope over half a cell
    assert terrain.goodness(LIMITS).at(ORIGIN)[0] == pytest.approx(0.5, abs=0.01)
    assert np.isnan(EMPTY.goodness(LIMITS).at(ORIGIN)[0])


@pytest.mark.parametrize("height", [0.3, -0.3])
def test_rocks_and_holes_are_hazards(height: float) -> None:
    points = _sample_plane(0.0)
    points[np.hypot(points[:, 0] - 1.0, points[:, 1]) < 0.25, 2] = height
    goodness = EMPTY.add_points(points).goodness(LIMITS)
    assert goodness.at(np.array([[1.0, 0.0]]))[0] == 0.0
    assert goodness.hazard_distances_m(ORIGIN)[0] == pytest.approx(1.0, abs=0.25 + CELL_M)


def test_single_false_match_is_not_a_hazard() -> None:
    outlier = np.array([[0.01, 0.01, 1.5]])
    goodness = EMPTY.add_points(np.concatenate([_sample_plane(0.0), outlier])).goodness(LIMITS)
    assert goodness.at(ORIGIN)[0] == pytest.approx(1.0)


def test_new_points_replace_old_ones_and_two_points_do_not_map_a_cell() -> None:
    terrain = EMPTY.add_points(_sample_plane(0.0)).add_points(_sample_plane(0.0, height=0.4))
    assert np.nanmin(terrain.median_m) == pytest.approx(0.4)
    few = EMPTY.add_points(np.array([[0.0, 0.0, 1.0], [0.02, 0.0, 1.0]]))
    assert not few.mapped_cells.any()


def test_points_outside_of_the_map_are_ignored() -> None:
    assert not EMPTY.add_points(_sample_plane(0.0) + np.array([100.0, 0.0, 0.0])).mapped_cells.any()
    assert np.isnan(EMPTY.goodness(LIMITS).at(np.array([[100.0, 0.0]]))[0])


def test_plane_under_the_rover_does_not_replace_measurements() -> None:
    # The rover stands on the plane up = 0.1 east; the southern edge of the map is measured at a height of 1 m.
    normal = np.array([-0.1, 0.0, 1.0])
    terrain = EMPTY.add_points(_sample_plane(0.0, height=1.0)[:600]).add_plane(np.zeros(3), normal, 1.0)
    row, column = np.argwhere(np.isfinite(terrain.median_m) & (np.abs(terrain.median_m - 1.0) > 0.5))[0]
    east, _ = terrain.corner_m + CELL_M * np.array([column, row])
    assert terrain.median_m[row, column] == pytest.approx(0.1 * east)
    assert np.count_nonzero(np.abs(terrain.median_m - 1.0) < 1e-9) > 0


def test_ground_around_the_target_has_no_hazards() -> None:
    points = _sample_plane(0.0)
    points[np.hypot(points[:, 0] - 1.0, points[:, 1]) < 0.5, 2] = 0.6
    terrain = EMPTY.add_points(points).without_hazards(np.array([1.0, 0.0]), 0.8)
    assert terrain.goodness(LIMITS).at(np.array([[1.0, 0.0]]))[0] > 0.9
