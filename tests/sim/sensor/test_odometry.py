"""Tests of rover odometry: the estimated pose against the true pose."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from marsyard.sim.dynamics.driven_ground import DrivenGround
from marsyard.sim.dynamics.driving import Drive, SlipParameters, Soil, drive
from marsyard.sim.dynamics.rover import MER, settle
from marsyard.sim.measurements import DriveCommand
from marsyard.sim.sensor.odometry import EXACT, Odometer, OdometryParameters, PoseEstimate, VisualOdometryParameters
from tests.sim.dynamics.grounds import NO_SLIP, Plane, uphill_east

EAST = 0.5 * np.pi
STRAIGHT = DriveCommand(forward_m=0.8)
MIXED_COMMANDS = (
    DriveCommand(forward_m=0.5, turn_left_rad=0.6),
    DriveCommand(left_m=0.4),
    DriveCommand(turn_left_rad=-1.0),
    STRAIGHT,
)


def _drive(ground: DrivenGround, commands: tuple[DriveCommand, ...], slip: SlipParameters = NO_SLIP) -> list[Drive]:
    rng, soil = np.random.default_rng(1), Soil(slip, 1.0)
    stance, drives = settle(MER, ground, 0.0, 0.0, EAST), []
    for command in commands:
        drives.append(drive(MER, ground, soil, stance, command, rng))
        stance = drives[-1].end
    return drives


def _compute_error_rad(estimate: PoseEstimate, true_pose: RigidTransform) -> np.ndarray:
    """Compute the rotation vector in world axes from the true to the estimated attitude."""
    return np.asarray((estimate.world_from_rover.rotation * true_pose.rotation.inv()).as_rotvec())


def _estimate_poses(
    drives: list[Drive], parameters: OdometryParameters, seed: int, visual: bool = False
) -> tuple[Odometer, PoseEstimate]:
    """Return the odometer, and its estimate at the end of the drives; `visual` selects visual odometry."""
    rng = np.random.default_rng(seed)
    odometer = Odometer.draw(parameters, drives[0].start.world_from_rover, rng)
    estimate = odometer.initial_estimate
    for motion in drives:
        estimate = odometer.step(estimate, motion, rng, visual)
    return odometer, estimate


@pytest.mark.parametrize("visual", [False, True])
def test_estimate_is_exact_without_slip_and_errors(visual: bool) -> None:
    drives = _drive(Plane(0.2, -0.1), MIXED_COMMANDS)
    _, estimate = _estimate_poses(drives, EXACT, 0, visual)
    assert estimate.world_from_rover.as_matrix() == pytest.approx(drives[-1].end.world_from_rover.as_matrix(), abs=1e-7)


def test_visual_odometry_detects_slip_and_wheels_do_not() -> None:
    # On a slope of 15 deg, slip removes about half of the distance, but the wheels count it.
    slip = SlipParameters(step_spread=0.0, wander_deg_m=0.0)
    drives = _drive(uphill_east(15.0), (STRAIGHT,) * 3, slip)
    true_pose = drives[-1].end.world_from_rover
    _, wheels = _estimate_poses(drives, EXACT, 0)
    _, visual = _estimate_poses(drives, EXACT, 0, visual=True)
    slip_distance_m = slip.slip_fraction(np.radians(15.0)) * 3 * STRAIGHT.forward_m
    direction = np.array([np.cos(np.radians(15.0)), 0.0, np.sin(np.radians(15.0))])
    assert wheels.error_m(true_pose) == pytest.approx(slip_distance_m * direction, abs=1e-7)
    assert visual.error_m(true_pose) == pytest.approx(np.zeros(3), abs=1e-7)


def test_gyros_measure_turns_reduced_by_wheel_slip() -> None:
    slip = SlipParameters(turn=0.2, step_spread=0.0, wander_deg_m=0.0)
    drives = _drive(Plane(), (DriveCommand(turn_left_rad=1.0), STRAIGHT), slip)
    _, estimate = _estimate_poses(drives, EXACT, 0)
    assert _compute_error_rad(estimate, drives[-1].end.world_from_rover) == pytest.approx(np.zeros(3), abs=1e-8)


def test_gyro_misalignment_causes_attitude_errors_in_turns() -> None:
    parameters = EXACT.model_copy(update={"misalignment_deg": 1.0})
    ground = Plane(0.1, 0.05)
    straight = _drive(ground, (STRAIGHT, STRAIGHT))
    odometer, estimate = _estimate_poses(straight, parameters, 3)
    assert odometer.initial_estimate.world_from_rover is straight[0].start.world_from_rover
    assert _compute_error_rad(estimate, straight[-1].end.world_from_rover) == pytest.approx(np.zeros(3), abs=1e-8)
    half_turn = _drive(ground, (DriveCommand(turn_left_rad=np.pi),))
    odometer, estimate = _estimate_poses(half_turn, parameters, 3)
    error_rad = np.linalg.norm(_compute_error_rad(estimate, half_turn[-1].end.world_from_rover))
    # After half a turn the misalignment appears twice.
    assert error_rad == pytest.approx(2.0 * odometer.misalignment.magnitude(), rel=0.01)


def test_odometry_errors_are_specified_fractions_of_the_distance() -> None:
    """The default errors after 8 m are 2 % with visual odometry and 1.1 % with wheels that do not slip."""
    drives = _drive(Plane(), (DriveCommand(forward_m=2.0),) * 4)
    end = drives[-1].end.world_from_rover
    for visual, fraction in ((True, 0.02), (False, 0.011)):
        estimates = [_estimate_poses(drives, OdometryParameters(), n, visual)[1] for n in range(100)]
        errors = [np.linalg.norm(estimate.error_m(end)) for estimate in estimates]
        # The RMS of 100 vectors with one to three degrees of freedom has a standard error of up to 7 %.
        assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(fraction * 8.0, rel=0.2)


@pytest.mark.slow
def test_scale_errors_are_constant_and_random_walks_are_not() -> None:
    drives = _drive(Plane(), (STRAIGHT,) * 8)
    middle_pose, end_pose = drives[3].end.world_from_rover, drives[7].end.world_from_rover

    def compute_forward_errors(parameters: OdometryParameters) -> tuple[np.ndarray, np.ndarray]:
        middle = [_estimate_poses(drives[:4], parameters, n)[1].error_m(middle_pose)[0] for n in range(80)]
        end = [_estimate_poses(drives, parameters, n)[1].error_m(end_pose)[0] for n in range(80)]
        return np.array(middle), np.array(end)

    middle, end = compute_forward_errors(EXACT.model_copy(update={"scale_error": 0.01}))
    assert end == pytest.approx(2.0 * middle)
    assert np.std(end) == pytest.approx(0.01 * 6.4, rel=0.25)
    middle, end = compute_forward_errors(EXACT.model_copy(update={"walk_m": 0.01}))
    assert np.std(end) == pytest.approx(0.01 * np.sqrt(6.4), rel=0.25)
    # At half the distance a random walk has half of its final variance: the correlation is sqrt(0.5).
    assert np.corrcoef(middle, end)[0, 1] == pytest.approx(np.sqrt(0.5), abs=0.22)


def test_heading_errors_grow_and_shift_the_position() -> None:
    drives = _drive(Plane(), (STRAIGHT,) * 5)
    true_pose = drives[-1].end.world_from_rover
    drift = EXACT.model_copy(update={"heading_drift_deg_m": 0.5})
    odometer, estimate = _estimate_poses(drives, drift, 2)
    assert estimate.heading_error_rad == pytest.approx(4.0 * odometer.heading_drift_rad_m)
    assert _compute_error_rad(estimate, true_pose) == pytest.approx([0.0, 0.0, estimate.heading_error_rad], abs=1e-9)
    # The heading error at the start of a drive shifts its end sideways. The five errors are 0, 1, 2, 3 and 4 times that
    # of one drive of 0.8 m.
    assert estimate.error_m(true_pose)[1] == pytest.approx(odometer.heading_drift_rad_m * 0.8 * 0.8 * 10.0, rel=1e-3)
    walk = EXACT.model_copy(update={"heading_walk_deg": 0.2})
    errors = [np.degrees(_estimate_poses(drives, walk, n)[1].heading_error_rad) for n in range(100)]
    # The random walk grows with the square root of 4 m.
    assert np.std(errors) == pytest.approx(0.2 * 2.0, rel=0.22)
    turn_drives = _drive(Plane(), (DriveCommand(turn_left_rad=2.0),))
    odometer, estimate = _estimate_poses(turn_drives, EXACT.model_copy(update={"heading_scale_error": 0.01}), 4)
    assert estimate.heading_error_rad == pytest.approx(2.0 * odometer.heading_scale)


def test_wheel_odometry_replaces_failed_visual_odometry() -> None:
    slip = SlipParameters(step_spread=0.0, wander_deg_m=0.0)
    drives = _drive(uphill_east(15.0), (STRAIGHT,), slip)
    failing = EXACT.model_copy(update={"visual": VisualOdometryParameters(failure_fraction=1.0)})
    _, visual = _estimate_poses(drives, failing, 0, visual=True)
    _, wheels = _estimate_poses(drives, EXACT, 0)
    assert visual.visual_failed
    assert not wheels.visual_failed
    assert visual.world_from_rover.as_matrix() == pytest.approx(wheels.world_from_rover.as_matrix())
