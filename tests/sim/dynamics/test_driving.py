"""Tests of rover motion for drive commands: kinematics without slip, slip on slopes, and random soil."""

import numpy as np
import pytest

from marsyard.sim.dynamics.driving import SlipParameters, Soil, drive
from marsyard.sim.dynamics.rover import MER, settle
from marsyard.sim.measurements import DriveCommand
from tests.sim.dynamics.grounds import NO_SLIP, Plane, uphill_east

EAST, NORTH = 0.5 * np.pi, 0.0
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
