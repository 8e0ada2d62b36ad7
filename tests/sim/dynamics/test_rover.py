"""Tests of the static stance of a rover on the ground with its suspension."""

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from pydantic import ValidationError

from marsyard.sim.dynamics.driven_ground import DrivenGround, RockyGround
from marsyard.sim.dynamics.rover import MER, ROCKY_8, RoverParameters, compute_wheel_centres, settle
from marsyard.sim.terrain import Surface
from tests.sim.dynamics.grounds import Mounds, Plane, uphill_east

EAST, NORTH = 0.5 * np.pi, 0.0


@pytest.mark.parametrize("rover", [MER, ROCKY_8])
@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 200.0, -37.0])
def test_body_is_parallel_to_a_plane(rover: RoverParameters, azimuth_deg: float) -> None:
    plane = Plane(0.3, -0.2, 5.0)
    stance = settle(rover, plane, 4.0, -3.0, np.radians(azimuth_deg))
    rotation = stance.world_from_rover.rotation.as_matrix()
    normal = np.array([-0.3, 0.2, 1.0]) / np.linalg.norm([-0.3, 0.2, 1.0])
    assert rotation[:, 2] == pytest.approx(normal, abs=1e-9)
    assert stance.world_from_rover.translation == pytest.approx([4.0, -3.0, 5.0 + 1.2 + 0.6], abs=1e-9)
    heading = np.degrees(np.arctan2(rotation[0, 0], rotation[1, 0]))
    assert np.cos(np.radians(heading - azimuth_deg)) == pytest.approx(1.0)
    assert stance.azimuth_rad == pytest.approx(np.arctan2(rotation[0, 0], rotation[1, 0]))
    assert [stance.differential_rad, *stance.bogies_rad] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_slope_causes_pitch_if_heading_uphill_and_roll_if_heading_across() -> None:
    # Heading uphill, the pitch equals the slope. Heading north on ground that rises to the east, the left side is low.
    uphill = settle(MER, uphill_east(12.0), 0.0, 0.0, EAST)
    across_slope = settle(MER, uphill_east(12.0), 0.0, 0.0, NORTH)
    assert np.degrees([uphill.pitch_rad, uphill.roll_rad]) == pytest.approx([12.0, 0.0], abs=1e-6)
    assert np.degrees([across_slope.pitch_rad, across_slope.roll_rad]) == pytest.approx([0.0, -12.0], abs=1e-6)
    assert np.degrees(across_slope.tilt_rad) == pytest.approx(12.0, abs=1e-6)


def test_chassis_pitch_is_the_mean_of_the_rocker_angles() -> None:
    # The left front wheel is on a block of 10 cm. Its rocker rotates, and the rocker of the other side rotates in the
    # opposite direction. For a heading to the east, the left front wheel is at (0.705, 0.53).
    block_m = 0.10
    one_block = settle(MER, Mounds(((0.705, 0.53, block_m),)), 0.0, 0.0, EAST)
    assert np.abs(one_block.gaps_m).max() < 1e-9
    two_blocks = settle(MER, Mounds(((0.705, 0.53, block_m), (0.705, -0.53, block_m))), 0.0, 0.0, EAST)
    assert two_blocks.roll_rad == pytest.approx(0.0, abs=1e-9)
    assert two_blocks.differential_rad == pytest.approx(0.0, abs=1e-9)
    # To first order one block causes half the pitch of two.
    assert one_block.pitch_rad == pytest.approx(0.5 * two_blocks.pitch_rad, rel=0.06)
    assert -one_block.differential_rad == pytest.approx(one_block.pitch_rad, rel=0.06)
    # The front wheel rises by h; the lever arm is the distance from the bogie pivot to the front wheel.
    assert two_blocks.pitch_rad == pytest.approx(block_m / (MER.front_m - MER.bogie_pivot_x_m), rel=0.06)


def test_block_under_the_middle_wheel_rotates_the_bogie() -> None:
    # The bogie pivot rises by the height of the block times its distance from the rear wheel / bogie wheelbase. The
    # angle of a bogie is relative to its rocker, which rotates with the nose.
    block_m = 0.06
    stance = settle(MER, Mounds(((0.0, 0.61, block_m), (0.0, -0.61, block_m))), 0.0, 0.0, EAST)
    pivot_rise_m = block_m * (MER.rear_m + MER.bogie_pivot_x_m) / MER.rear_m
    nose_down_rad = pivot_rise_m / (MER.front_m - MER.bogie_pivot_x_m)
    assert stance.pitch_rad == pytest.approx(-nose_down_rad, rel=0.05)
    assert stance.bogies_rad[0] == pytest.approx(stance.bogies_rad[1])
    assert stance.bogies_rad[0] == pytest.approx(-block_m / MER.rear_m - nose_down_rad, rel=0.05)
    # A block on the left rotates mainly the left bogie, which is the first.
    left, right = settle(MER, Mounds(((0.0, 0.61, block_m),)), 0.0, 0.0, EAST).bogies_rad
    assert abs(left) > 3.0 * abs(right)


def test_all_wheels_touch_rough_ground() -> None:
    samples = np.zeros((256, 256, 2), dtype=np.float32)
    samples[..., 0] = 0.03 * np.random.default_rng(3).standard_normal((256, 256))
    surface = Surface.from_samples(samples, 0.1)
    assert isinstance(surface, DrivenGround)
    rng = np.random.default_rng(4)
    for _ in range(10):
        east, north = rng.uniform(0.0, 25.0, 2).tolist()
        stance = settle(MER, surface, east, north, float(rng.uniform(-3.0, 3.0)))
        assert np.abs(stance.gaps_m).max() < 1e-6
        # The ground below each wheel centre is not above the rim.
        centres = stance.world_from_rover.apply(compute_wheel_centres(MER, stance.differential_rad, stance.bogies_rad))
        clearance = centres[:, 2] - surface.height(centres[:, 0], centres[:, 1])
        assert np.all(clearance > 0.9 * MER.wheel_radius_m)


def _make_block(east: float, north: float, top: float) -> Float64[np.ndarray, "triangles 3 3"]:
    """Return a block 0.4 m square, half buried."""
    block = trimesh.creation.box(extents=(0.4, 0.4, 2.0 * top))
    return np.asarray(np.asarray(block.triangles) + np.array([east, north, 0.0]))


def test_rocks_raise_the_ground() -> None:
    slope = uphill_east(5.0)
    ground = RockyGround.from_triangles(slope, _make_block(1.0, 2.0, 0.3), (1.0, 2.0), 1.0)
    x, y = np.array([1.0, 1.19, 1.25, 1.0, 9.0]), np.array([2.0, 2.19, 2.0, 1.75, 9.0])
    assert ground.height(x, y) == pytest.approx([0.3, 0.3, *slope.height(x[2:], y[2:])], abs=1e-9)
    # A rock below the sloping ground has no effect on the height.
    assert RockyGround.from_triangles(slope, _make_block(1.0, 2.0, 0.05), (1.0, 2.0), 1.0).height(
        x, y
    ) == pytest.approx(slope.height(x, y), abs=1e-9)
    without_bodies = RockyGround.from_triangles(slope, np.empty((0, 3, 3)), (1.0, 2.0), 1.0)
    assert without_bodies.height(x, y) == pytest.approx(slope.height(x, y))


def test_stance_does_not_depend_on_initial_guess() -> None:
    ground = Mounds(((0.705, 0.53, 0.1), (-0.705, -0.53, 0.05)))
    default_stance = settle(MER, ground, 0.0, 0.0, EAST)
    stance = settle(MER, ground, 0.0, 0.0, EAST, initial=settle(MER, uphill_east(5.0), 0.1, 0.0, EAST))
    assert stance.world_from_rover.as_matrix() == pytest.approx(default_stance.world_from_rover.as_matrix(), abs=1e-8)


def test_pivots_must_lie_between_their_wheels() -> None:
    with pytest.raises(ValidationError, match="bogie_pivot_x_m"):
        RoverParameters(bogie_pivot_x_m=0.1)
    with pytest.raises(ValidationError, match="rocker_pivot_x_m"):
        RoverParameters(rocker_pivot_x_m=0.9)
