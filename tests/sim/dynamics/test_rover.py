"""Tests of the stance of a rover on the ground with its suspension, and of drive commands with and without slip."""

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from pydantic import ValidationError

from marsyard.sim.dynamics.driven_ground import DrivenGround, RockyGround
from marsyard.sim.dynamics.driving import SlipParameters, Soil, drive
from marsyard.sim.dynamics.rover import MER, ROCKY_8, RoverParameters, compute_wheel_centres, settle
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.terrain import PlacedRock, RockField, RockParameters, Surface
from tests.sim.dynamics.grounds import NO_SLIP, Mounds, Plane, uphill_east

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


#: The default slip without its random parts.
NO_RANDOM_SLIP = SlipParameters(soil_spread=0.0, step_spread=0.0, wander_deg_m=0.0)
NO_SLIP_SOIL = Soil(NO_SLIP, 1.0)
COMMANDS = [
    DriveCommand(forward_m=1.0),
    DriveCommand(forward_m=-0.7),
    DriveCommand(left_m=0.5),
    DriveCommand(forward_m=1.2, turn_left_rad=-0.8),
    DriveCommand(turn_left_rad=2.0),
    # circle around a target 7 m ahead
    DriveCommand(left_m=-7.0 * 0.3, turn_left_rad=0.3),
]


def _rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("slope_deg", [0.0, 15.0])
def test_motion_without_slip_follows_the_command(command: DriveCommand, slope_deg: float) -> None:
    # On a plane the motion in rover axes has no vertical component, for any slope.
    ground = uphill_east(slope_deg)
    start = settle(MER, ground, 1.0, 2.0, 0.4)
    result = drive(MER, ground, NO_SLIP_SOIL, start, command, _rng())
    motion = start.world_from_rover.inv() * result.end.world_from_rover
    assert motion.translation == pytest.approx([*command.displacement_m, 0.0], abs=1e-8)
    assert motion.rotation.as_rotvec() == pytest.approx([0.0, 0.0, command.turn_left_rad], abs=1e-7)
    assert sum(part.command.length_m for part in result.parts) == pytest.approx(command.length_m)
    assert result.stances[0] is start
    assert result.stances[-1] is result.end


def test_command_equals_many_small_motions() -> None:
    command = DriveCommand(forward_m=1.3, left_m=-0.4, turn_left_rad=1.1)
    count, position, angle = 20000, np.zeros(2), 0.0
    step = np.array([command.forward_m, command.left_m]) / count
    for _ in range(count):
        angle += 0.5 * command.turn_left_rad / count
        position += np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ step
        angle += 0.5 * command.turn_left_rad / count
    assert command.displacement_m == pytest.approx(position, abs=1e-8)


def test_slip_of_one_half_halves_the_distance() -> None:
    # The default slip is one half on a slope of 15 deg: s = 0.01 + 0.99 * 0.75**2.4.
    slip = 0.01 + 0.99 * 0.75**2.4
    assert slip == pytest.approx(0.5, abs=0.01)
    ground = uphill_east(15.0)
    start = settle(MER, ground, 0.0, 0.0, EAST)
    result = drive(MER, ground, Soil(NO_RANDOM_SLIP, 1.0), start, DriveCommand(forward_m=2.0), _rng())
    distance_m = np.linalg.norm(result.end.world_from_rover.translation - start.world_from_rover.translation)
    assert distance_m == pytest.approx(2.0 * (1.0 - slip), rel=1e-9)
    assert result.slip == pytest.approx(slip, rel=1e-9)


@pytest.mark.parametrize(("slope_deg", "slip"), [(0.0, 0.01), (10.0, 0.2), (20.0, 1.0), (25.0, 1.0)])
def test_uphill_slip_increases_to_one(slope_deg: float, slip: float) -> None:
    ground = uphill_east(slope_deg)
    start = settle(MER, ground, 0.0, 0.0, EAST)
    uphill = drive(MER, ground, Soil(NO_RANDOM_SLIP, 1.0), start, DriveCommand(forward_m=0.5), _rng())
    assert uphill.slip == pytest.approx(slip, abs=0.005)
    # Reverse driving uphill has the same slip. Downhill the rover gains 0.3 of the path that the slope costs uphill.
    facing_downhill = settle(MER, ground, 0.0, 0.0, -EAST)
    reverse = drive(MER, ground, Soil(NO_RANDOM_SLIP, 1.0), facing_downhill, DriveCommand(forward_m=-0.5), _rng())
    assert reverse.slip == pytest.approx(uphill.slip, abs=1e-9)
    downhill = drive(MER, ground, Soil(NO_RANDOM_SLIP, 1.0), facing_downhill, DriveCommand(forward_m=0.5), _rng())
    assert downhill.slip == pytest.approx(0.01 - 0.3 * (uphill.slip - 0.01), abs=1e-9)


@pytest.mark.parametrize("azimuth_rad", [NORTH, np.pi])
def test_rover_slides_downhill_across_a_slope(azimuth_rad: float) -> None:
    ground = uphill_east(10.0)
    start = settle(MER, ground, 0.0, 0.0, azimuth_rad)
    result = drive(MER, ground, Soil(NO_RANDOM_SLIP, 1.0), start, DriveCommand(forward_m=1.0), _rng())
    motion_m = result.end.world_from_rover.translation - start.world_from_rover.translation
    lateral_slip_m = 0.5 * (NO_RANDOM_SLIP.slip_fraction(np.radians(10.0)) - NO_RANDOM_SLIP.flat)
    # The ground falls to the west.
    assert motion_m[0] == pytest.approx(-lateral_slip_m * np.cos(np.radians(10.0)), abs=1e-9)
    assert result.slip == pytest.approx(NO_RANDOM_SLIP.flat, abs=1e-9)


def test_slip_reduces_the_turn_angle() -> None:
    """The default lost fraction of a turn is 0.03, plus half of the path fraction lost uphill by the slope."""
    start = settle(MER, Plane(), 0.0, 0.0, EAST)
    result = drive(MER, Plane(), Soil(NO_RANDOM_SLIP, 1.0), start, DriveCommand(turn_left_rad=np.radians(40.0)), _rng())
    assert np.degrees(start.azimuth_rad - result.end.azimuth_rad) == pytest.approx(40.0 * 0.97)
    assert np.isnan(result.slip)
    steep = uphill_east(15.0)
    start = settle(MER, steep, 0.0, 0.0, EAST)
    result = drive(MER, steep, Soil(NO_RANDOM_SLIP, 1.0), start, DriveCommand(turn_left_rad=np.radians(10.0)), _rng())
    assert 1.0 - result.turn_left_rad / np.radians(10.0) == pytest.approx(
        0.03 + 0.5 * (NO_RANDOM_SLIP.slip_fraction(np.radians(15.0)) - 0.01), rel=1e-6
    )


def test_soil_step_and_heading_errors_have_the_specified_deviation() -> None:
    parameters = SlipParameters(soil_spread=0.3, step_spread=0.0, wander_deg_m=0.0)
    factors = np.log([Soil.draw(parameters, np.random.default_rng(n)).factor for n in range(400)])
    # The standard error of the deviation 0.3 from 400 draws is 0.3 / sqrt(800); the tolerance is four times that.
    assert np.std(factors) == pytest.approx(0.3, abs=0.042)
    ground = uphill_east(10.0)
    start = settle(MER, ground, 0.0, 0.0, EAST)
    slippery = drive(MER, ground, Soil(NO_RANDOM_SLIP, 1.5), start, DriveCommand(forward_m=0.3), _rng())
    nominal = drive(MER, ground, Soil(NO_RANDOM_SLIP, 1.0), start, DriveCommand(forward_m=0.3), _rng())
    assert slippery.slip == pytest.approx(1.5 * nominal.slip, rel=1e-9)
    # The relative standard error of a deviation from 120 draws is 1 / sqrt(240); the tolerance is four times that.
    rng = np.random.default_rng(1)
    random_steps = Soil(SlipParameters(soil_spread=0.0, step_spread=0.2, wander_deg_m=0.0), 1.0)
    slips = [drive(MER, ground, random_steps, start, DriveCommand(forward_m=0.1), rng).slip for _ in range(120)]
    assert np.std(np.log(slips)) == pytest.approx(0.2, abs=0.052)
    random_heading = Soil(SlipParameters(step_spread=0.0, wander_deg_m=1.0), 1.0)
    headings = [
        np.degrees(drive(MER, ground, random_heading, start, DriveCommand(forward_m=0.09), rng).end.azimuth_rad) - 90.0
        for _ in range(120)
    ]
    # The heading error is a random walk: 1 deg times the square root of 0.09 m.
    assert np.std(headings) == pytest.approx(0.3, abs=0.078)


def test_drives_are_reproducible_and_continuous() -> None:
    ground = uphill_east(8.0)
    start = settle(MER, ground, 0.0, 0.0, 0.3)
    first, second = (
        drive(MER, ground, Soil(SlipParameters(), 1.1), start, COMMANDS[3], np.random.default_rng(9)) for _ in range(2)
    )
    assert np.array_equal(first.end.world_from_rover.as_matrix(), second.end.world_from_rover.as_matrix())
    for part, next_part in zip(first.parts, first.parts[1:], strict=False):
        assert part.after is next_part.before
    assert all(part.command.length_m <= 0.2 + 1e-12 for part in first.parts)


def test_target_stays_ahead_when_the_rover_circles_it() -> None:
    distance_m, turn_rad = 7.0, np.radians(10.0)
    command = DriveCommand(left_m=-distance_m * turn_rad, turn_left_rad=turn_rad)
    start = settle(MER, Plane(), 0.0, 0.0, EAST)
    end = drive(MER, Plane(), NO_SLIP_SOIL, start, command, _rng()).end
    target = end.world_from_rover.inv().apply(np.array([distance_m, 0.0, 0.0]))
    assert target == pytest.approx([distance_m, 0.0, 0.0], abs=1e-7)
    # A left turn around the target moves the rover right of its initial heading.
    assert end.world_from_rover.translation[1] < 0.0


def test_block_gives_the_same_stance_as_a_mound_of_equal_height() -> None:
    # The tops of block and mound are wider than the wheel's contact.
    height_m = 0.10
    ground = RockyGround.from_triangles(Plane(), _make_block(0.705, 0.53, height_m), (0.0, 0.0), 1.5)
    stance = settle(MER, ground, 0.0, 0.0, EAST)
    mound = settle(MER, Mounds(((0.705, 0.53, height_m),)), 0.0, 0.0, EAST)
    assert np.abs(stance.gaps_m).max() < 1e-6
    assert stance.world_from_rover.as_matrix() == pytest.approx(mound.world_from_rover.as_matrix(), abs=1e-4)


def test_rock_of_a_field_lifts_the_wheel() -> None:
    surface = Surface.from_samples(np.zeros((128, 128, 2), dtype=np.float32), 0.1)
    rock = PlacedRock(name="step", east_m=6.4 + 0.705, north_m=6.4 + 0.53, diameter_m=0.3, height_m=0.1)
    field = RockField.draw(surface, RockParameters(abundance=0.0, placed=(rock,)), np.random.default_rng(1))
    mesh = field.rock(0, detail=0)
    ground = RockyGround.from_triangles(surface, mesh.vertices[mesh.faces], (6.4, 6.4), 1.5)
    heights = ground.height(*np.meshgrid(np.linspace(6.9, 7.3, 201), np.linspace(6.7, 7.1, 201)))
    assert heights.max() == pytest.approx(mesh.vertices[:, 2].max(), abs=0.003)
    stance = settle(MER, ground, 6.4, 6.4, EAST)
    assert np.abs(stance.gaps_m).max() < 1e-4
    assert stance.pitch_rad > 0.0
    assert stance.differential_rad < 0.0
