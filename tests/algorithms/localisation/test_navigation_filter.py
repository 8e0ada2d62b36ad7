"""Tests of the navigation filter for localisation on a map: an analytic descent with exact inertial increments."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from marsyard.algorithms.localisation import inertial_state as inertial
from marsyard.algorithms.localisation import state_updates as updates
from marsyard.algorithms.localisation.inertial_state import ImuErrorModel, IncrementHistory, NavigationState
from marsyard.algorithms.localisation.interface import InitialState
from marsyard.algorithms.localisation.matrices import left_jacobian
from marsyard.algorithms.localisation.navigation_filter import LocalisationFilter
from marsyard.algorithms.localisation.state_updates import UpdateOutcome
from marsyard.sim.camera import Cahvore, mount_looking_down
from marsyard.sim.dynamics.trajectory import Motion, Trajectory, attitudes_and_body_rates
from marsyard.sim.measurements import ImuIncrements
from marsyard.sim.sensor.imu import Imu, ImuParameters, true_increments

GRAVITY = 3.71
RATE_HZ = 400.0
#: 90 deg over 1024 pixels with the constant angle per pixel of 1.67 mrad: a fisheye lens (linearity 0), 0.1 m off the
#: body's origin and rotated about its axis.
CAMERA = mount_looking_down(
    Cahvore(
        c=np.zeros(3), a=np.array([0.0, 0.0, 1.0]), h=np.array([600.0, 0.0, 511.5]), v=np.array([0.0, 600.0, 511.5]),
        o=np.array([0.0, 0.0, 1.0]), r=np.zeros(3), e=np.zeros(3), linearity=0.0, size=(1024, 1024),
    )
).transform(RigidTransform.from_components(np.array([0.1, 0.05, -0.2]), Rotation.from_euler("Z", 0.3)))  # fmt: skip
SPAN_S = (0.0, 62.0)
#: Covariance of the initial state for consistency tests: inside the linear range of landmarks.
SMALL_COVARIANCE = np.diag(np.repeat([50.0, 0.5, 0.005], 3) ** 2)


class Descent(Trajectory):
    """Descent from 4 km at 90 to 50 m/s with swings of a few degrees, and a slow turn about the vertical."""

    @property
    def span_s(self) -> tuple[float, float]:
        return SPAN_S

    def motion(self, times_s: np.ndarray) -> Motion:
        t, zero, one = times_s, np.zeros_like(times_s), np.ones_like(times_s)
        sine, cosine = 15.0 * np.sin(0.5 * t), 15.0 * np.cos(0.5 * t)
        derivatives = [
            np.stack([20.0 * t + sine, -5.0 * t + 0.05 * t**2, 4400.0 - 90.0 * t + 0.33 * t**2], axis=1),
            np.stack([20.0 + 0.5 * cosine, -5.0 + 0.1 * t, -90.0 + 0.66 * t], axis=1),
            np.stack([-0.25 * sine, 0.1 * one, 0.66 * one], axis=1),
        ]
        angles = np.stack([0.02 * t, 0.06 * np.sin(0.9 * t), 0.05 * np.sin(0.7 * t + 1.0)], axis=1)
        rates = np.stack([0.02 + zero, 0.054 * np.cos(0.9 * t), 0.035 * np.cos(0.7 * t + 1.0)], axis=1)
        attitudes, body_rates = attitudes_and_body_rates(angles, rates)
        return Motion.from_accelerations(t, derivatives, attitudes, body_rates, GRAVITY)


@pytest.fixture(scope="module")
def truth() -> Descent:
    return Descent()


@pytest.fixture(scope="module")
def exact(truth: Descent) -> ImuIncrements:
    """True increments over 60 s."""
    boundaries = np.arange(int(60.0 * RATE_HZ) + 1) / RATE_HZ
    angles, velocities = true_increments(truth, boundaries)
    return ImuIncrements(boundaries, 1.0 / RATE_HZ, angles, velocities)


def slice_increments(increments: ImuIncrements, first: int, last: int) -> ImuIncrements:
    angles, velocities = increments.delta_angles_rad[first:last], increments.delta_velocities_m_s[first:last]
    return ImuIncrements(increments.times_s[first : last + 1], increments.period_s, angles, velocities)


def initial_state(truth: Descent, covariance: np.ndarray, errors: np.ndarray | None = None) -> InitialState:
    """Return the true state at time 0 minus errors of position, velocity and attitude (rotation vector), shape (9,)."""
    start, errors = truth.state(0.0), np.zeros(9) if errors is None else errors
    attitude = Rotation.from_rotvec(-errors[6:]) * start.attitude
    return InitialState(
        0.0, start.position_m - errors[:3], start.velocity_m_s - errors[3:6], attitude, covariance, GRAVITY
    )


def start_filter(
    truth: Descent, exact: ImuIncrements, covariance: np.ndarray = SMALL_COVARIANCE, errors: np.ndarray | None = None
) -> LocalisationFilter:
    """Return the filter after 2 s of exact increments, with errors of the initial state."""
    navigation = LocalisationFilter.from_initial(initial_state(truth, covariance, errors))
    navigation.propagate(slice_increments(exact, 0, 800))
    return navigation


def make_landmarks(
    points: np.ndarray, pixels: np.ndarray, pixel_sd: float, point_sd_m: float = 0.0, common_sd_m: Any = 0.0
) -> updates.LandmarkMeasurement:
    """Create the landmarks of an image; standard deviations are equal for all axes, or (east, north, up)."""
    point_sd, common_sd = np.full(3, point_sd_m), np.full(3, common_sd_m, dtype=np.float64)
    return updates.LandmarkMeasurement(CAMERA, points, pixels, pixel_sd, point_sd, common_sd)


def state_errors(truth: Descent, state: NavigationState) -> np.ndarray:
    """True minus estimated position, velocity and attitude."""
    true = truth.state(state.time_s)
    attitude = (true.attitude * state.world_from_body.inv()).as_rotvec()
    return np.concatenate([true.position_m - state.position_m, true.velocity_m_s - state.velocity_m_s, attitude])


def draw_points(truth: Descent, time_s: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw landmarks in the image (heights of 0 to 100 m); return points, shape (count, 3), and exact pixels."""
    state = truth.state(time_s)
    pose = RigidTransform.from_components(state.position_m, state.attitude)
    camera = CAMERA.transform(pose)
    origins, directions = camera.rays(rng.uniform(50.0, 973.0, (count, 2)))
    heights = rng.uniform(0.0, 100.0, count)
    points = origins + directions * ((heights - origins[:, 2]) / directions[:, 2])[:, None]
    pixels, visible = camera.project(points)
    assert visible.all()
    return points, pixels


def test_perfect_increments_reproduce_the_motion(truth: Descent, exact: ImuIncrements) -> None:
    # the increments are passed in blocks of irregular length; 59.9987 s is between two boundaries
    navigation = LocalisationFilter.from_initial(initial_state(truth, SMALL_COVARIANCE))
    for first, last in ((0, 1), (1, 700), (700, 701), (701, 24000)):
        navigation.propagate(slice_increments(exact, first, last))
    for time_s in (60.0, 59.9987, 57.0):
        errors = state_errors(truth, navigation.state_at(time_s))
        # position: velocities are linear in an interval: step^2 / 12 * change of acceleration (8 m/s2); velocity:
        # between boundaries step^2 / 8 * jerk (2 m/s3); attitude: step^2 / 8 * angular acceleration (0.05 rad/s2)
        assert np.abs(errors[:3]).max() < 4e-6
        assert np.abs(errors[3:6]).max() < 1.6e-6
        assert np.abs(errors[6:]).max() < 4e-8


def test_state_is_extrapolated_by_a_few_milliseconds(truth: Descent, exact: ImuIncrements) -> None:
    navigation = LocalisationFilter.from_initial(initial_state(truth, SMALL_COVARIANCE))
    navigation.propagate(slice_increments(exact, 0, 4000))
    errors = state_errors(truth, navigation.state_at(10.002))
    # a constant rate is assumed over 2 ms plus the last interval of 2.5 ms; angular acceleration below 0.1 rad/s2
    assert np.abs(errors[6:]).max() < 0.5 * 0.1 * 0.0045**2
    assert np.abs(errors[:3]).max() < 1e-4
    with pytest.raises(ValueError, match="outside of the stored history"):
        navigation.state_at(10.1)
    with pytest.raises(ValueError, match="consecutive"):
        navigation.propagate(slice_increments(exact, 4100, 4200))


def state_difference(plus: NavigationState, minus: NavigationState) -> np.ndarray:
    return np.concatenate(
        [
            plus.position_m - minus.position_m,
            plus.velocity_m_s - minus.velocity_m_s,
            (plus.world_from_body * minus.world_from_body.inv()).as_rotvec(),
            plus.gyro_bias_rad_s - minus.gyro_bias_rad_s,
            plus.accelerometer_bias_m_s2 - minus.accelerometer_bias_m_s2,
        ]
    )


def test_propagated_covariance_equals_that_of_the_transition(truth: Descent, exact: ImuIncrements) -> None:
    """The propagated covariance of a single error is the square of its propagated difference: 1 step, and 40 steps."""
    noise_free = ImuErrorModel(
        **dict.fromkeys(ImuErrorModel.__dataclass_fields__, 0.0) | {"gyro_wander_s": 1.0, "accelerometer_wander_s": 1.0}
    )
    start = LocalisationFilter.from_initial(initial_state(truth, SMALL_COVARIANCE)).state_at(0.0)
    history = IncrementHistory(exact.times_s, exact.period_s, exact.delta_angles_rad, exact.delta_velocities_m_s)
    times = 0.1 * np.arange(1, 41)
    for column, size in enumerate(np.repeat([1.0, 1.0, 1e-4, 1e-4, 1e-2], 3)):
        error = size * np.eye(15)[column]
        single = replace(start, covariance=np.outer(error, error))
        results, plus, minus = (
            inertial.propagate_states(state, history, times, GRAVITY, noise_free)
            for state in (single, *(start.correct(sign * error, np.eye(15)) for sign in (1.0, -1.0)))
        )
        # Increments' sums neglect a gyro bias within an interval: 1.5 / 40 of the first step, and 1.5 / 1600 of all.
        for step, tolerance in ((0, 0.1), (-1, 4e-3)):
            numeric = 0.5 * state_difference(plus[step], minus[step])
            # relative to the vector of each state
            scale = np.repeat(np.abs(numeric.reshape(5, 3)).max(axis=1), 3)
            difference = np.abs(results[step].covariance - np.outer(numeric, numeric))
            assert np.all(difference <= tolerance * np.outer(scale, scale) + 1e-20), (column, step)


def test_landmark_jacobian_matches_numerical_differences(truth: Descent) -> None:
    state, rng = truth.state(10.0), np.random.default_rng(1)
    points, pixels = draw_points(truth, 10.0, 40, rng)
    measurement = make_landmarks(points, pixels, 1.0)
    result = updates.linearise_landmarks(measurement, state.position_m, state.attitude)
    assert result.visible.all()
    assert np.abs(result.residuals).max() < 1e-7
    for column, step in enumerate(np.repeat([1.0, 1e-4, 1.0], 3)):
        error = step * np.eye(9)[column]

        def expected(error: np.ndarray) -> np.ndarray:
            moved = replace(measurement, points_world=points + error[6:])
            attitude = Rotation.from_rotvec(error[3:6]) * state.attitude
            return pixels - updates.linearise_landmarks(moved, state.position_m + error[:3], attitude).residuals

        numeric = (expected(error) - expected(-error)) / (2.0 * step)
        # third derivatives: (1 m / 3 km)^2, (1e-4 rad)^2
        assert np.abs(numeric - result.jacobian[..., column]).max() < 1e-6 * np.abs(numeric).max()


def test_altitude_jacobian_is_the_gradient_of_the_height_above_sloping_ground() -> None:
    # altitude = z - (30 m + 0.1 x - 0.2 y)
    jacobian = updates.altitude_jacobian(np.array([0.1, -0.2]))
    np.testing.assert_allclose(jacobian, [[-0.1, 0.2, 1.0, *[0.0] * 12]])


def test_updates_of_position_and_altitude_are_those_of_a_kalman_filter(truth: Descent) -> None:
    """Compare with the covariance form, K = P H' S^-1, on a full covariance."""
    rng = np.random.default_rng(2)
    mixing = np.eye(9) + 0.2 * rng.standard_normal((9, 9))
    scale = np.sqrt(np.diag(SMALL_COVARIANCE))
    start = initial_state(truth, scale[:, None] * (mixing @ mixing.T) * scale)
    slope, noise = np.array([0.1, -0.2]), np.array([[900.0, 200.0], [200.0, 400.0]])
    for kind in ("position", "altitude"):
        navigation = LocalisationFilter.from_initial(start)
        prior = navigation.state_at(0.0)
        if kind == "position":
            jacobian, covariance, residual = np.eye(2, 15), noise, np.array([20.0, -30.0])
            outcome = navigation.update_position(0.0, prior.position_m[:2] + residual, covariance)
        else:
            jacobian, covariance, residual = updates.altitude_jacobian(slope), np.array([[25.0]]), np.array([7.0])
            measured = float(prior.position_m[2]) - 30.0 + 7.0
            outcome = navigation.update_altitude(0.0, measured, lambda _: (30.0, slope), 5.0)
        assert outcome is UpdateOutcome.APPLIED
        posterior = navigation.state_at(0.0)
        gain = prior.covariance @ jacobian.T @ np.linalg.inv(jacobian @ prior.covariance @ jacobian.T + covariance)
        reduced = np.eye(15) - gain @ jacobian
        joseph = reduced @ prior.covariance @ reduced.T + gain @ covariance @ gain.T
        errors = gain @ residual
        reset = np.eye(15)
        reset[6:9, 6:9] = left_jacobian(errors[6:9])
        deviations = np.sqrt(np.diag(joseph))
        difference = (posterior.covariance - reset @ joseph @ reset.T) / np.outer(deviations, deviations)
        assert np.abs(difference).max() < 1e-9
        np.testing.assert_allclose(posterior.position_m - prior.position_m, errors[:3], atol=1e-8)
        np.testing.assert_allclose(posterior.gyro_bias_rad_s, errors[9:12], atol=1e-14)
        turned = (posterior.world_from_body * prior.world_from_body.inv()).as_rotvec()
        np.testing.assert_allclose(turned, errors[6:9], atol=1e-12)


def test_left_jacobian_is_the_derivative_of_a_composed_rotation() -> None:
    rotation, rest = np.array([0.02, -0.03, 0.01]), np.array([1e-6, 2e-6, -3e-6])
    total = Rotation.from_rotvec(rotation + rest) * Rotation.from_rotvec(rotation).inv()
    # third order of the series: |d|^3 / 24, relative
    np.testing.assert_allclose(total.as_rotvec(), left_jacobian(rotation) @ rest, atol=3e-6 * 2.2e-6)


@pytest.mark.parametrize("pending", [False, True])
def test_delayed_updates_equal_updates_in_order_of_time(truth: Descent, exact: ImuIncrements, pending: bool) -> None:
    """An image of 1.2343 s arrives at 2 s, after an altitude of 1.7 s; `pending`: its tag is after the last increment.

    A pending update uses an extrapolated state; it is repeated when the increments arrive.
    """
    rng = np.random.default_rng(3)
    image_s, altitude_s = 1.2343, 1.7
    points, pixels = draw_points(truth, image_s, 60, rng)
    pixels += 0.5 * rng.standard_normal(pixels.shape)
    pixels[::4] += 100.0
    start = initial_state(truth, SMALL_COVARIANCE, np.array([40.0, -30, 20, 0.3, 0.2, -0.4, 0.003, 0.004, -0.002]))
    states = []
    for delayed in (False, True):
        navigation = LocalisationFilter.from_initial(start)
        # 493 increments end at 1.2325 s, 494 at 1.235 s
        first = 800 if delayed else (493 if pending else 494)
        navigation.propagate(slice_increments(exact, 0, first))
        if delayed:
            navigation.update_altitude(altitude_s, 4240.0, (7.0, np.array([0.1, 0.0])), 10.0)
        result = navigation.update_landmarks(image_s, make_landmarks(points, pixels, 0.5, 1.0, 3.0))
        assert result.outcome is UpdateOutcome.APPLIED
        assert np.array_equal(np.flatnonzero(~result.inliers), np.arange(0, 60, 4))
        if not delayed:
            navigation.propagate(slice_increments(exact, first, 700))
            navigation.update_altitude(altitude_s, 4240.0, (7.0, np.array([0.1, 0.0])), 10.0)
            navigation.propagate(slice_increments(exact, 700, 800))
        states.append(navigation.state_at(2.0))
    one, two = states
    deviations = np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose(one.position_m, two.position_m, atol=1e-9)
    np.testing.assert_allclose(one.velocity_m_s, two.velocity_m_s, atol=1e-10)
    assert (one.world_from_body.inv() * two.world_from_body).magnitude() < 1e-12
    assert np.abs((one.covariance - two.covariance) / np.outer(deviations, deviations)).max() < 1e-9


def test_updates_outside_the_history_and_invalid_ones_are_ignored(truth: Descent, exact: ImuIncrements) -> None:
    navigation = LocalisationFilter.from_initial(initial_state(truth, SMALL_COVARIANCE))
    navigation.propagate(slice_increments(exact, 0, 4000))
    before = navigation.state_at(10.0)
    flat = (0.0, np.zeros(2))
    assert navigation.update_altitude(1.0, 3900.0, flat, 10.0) is UpdateOutcome.OUTSIDE_HISTORY
    assert navigation.update_altitude(10.5, 3900.0, flat, 10.0) is UpdateOutcome.OUTSIDE_HISTORY
    assert navigation.update_altitude(10.0, np.nan, flat, 10.0) is UpdateOutcome.INVALID
    assert navigation.update_altitude(10.0, 100.0, flat, 10.0) is UpdateOutcome.REJECTED
    none = np.zeros((0, 2))
    assert (
        navigation.update_landmarks(10.0, make_landmarks(np.zeros((0, 3)), none, 0.5)).outcome is UpdateOutcome.TOO_FEW
    )
    points, pixels = draw_points(truth, 10.0, 20, np.random.default_rng(4))
    invalid = navigation.update_landmarks(10.0, make_landmarks(points, np.full_like(pixels, np.nan), 0.5))
    assert invalid.outcome is UpdateOutcome.TOO_FEW
    after = navigation.state_at(10.0)
    assert np.array_equal(before.position_m, after.position_m)
    assert np.array_equal(before.covariance, after.covariance)


def simulate(
    truth: Descent, exact: ImuIncrements, landmarks: list[tuple[np.ndarray, np.ndarray]], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Run the filter with drawn errors and landmarks at 0.5 s, 1.5 s, ...; return errors and covariance at the end."""
    rng, duration_s = np.random.default_rng([seed, 5]), len(landmarks)
    parameters = ImuParameters()
    parameters = parameters.model_copy(update={"clock": parameters.clock.model_copy(update={"offset_sd_s": 0.0})})
    imu = Imu.draw(parameters, SPAN_S, rng)
    boundaries, angles, velocities = exact.times_s, exact.delta_angles_rad, exact.delta_velocities_m_s
    errors = np.linalg.cholesky(SMALL_COVARIANCE) @ rng.standard_normal(9)
    navigation = LocalisationFilter.from_initial(initial_state(truth, SMALL_COVARIANCE, errors))
    count = round(duration_s * RATE_HZ)
    measured = ImuIncrements(
        times_s=imu.clock.tags(boundaries[: count + 1], rng),
        period_s=1.0 / RATE_HZ,
        delta_angles_rad=imu.gyro.measure(angles[:count], boundaries[: count + 1], rng),
        delta_velocities_m_s=imu.accelerometer.measure(velocities[:count], boundaries[: count + 1], rng),
    )
    for second, (points, exact_pixels) in enumerate(landmarks):
        first = round(second * RATE_HZ)
        navigation.propagate(slice_increments(measured, first, first + round(RATE_HZ)))
        image_s = second + 0.5
        pixels = exact_pixels + 0.3 * rng.standard_normal(exact_pixels.shape)
        mapped = points + 3.0 * rng.standard_normal(points.shape) + 4.0 * rng.standard_normal(3)
        result = navigation.update_landmarks(image_s, make_landmarks(mapped, pixels, 0.3, 3.0, 4.0))
        assert result.outcome is UpdateOutcome.APPLIED
        assert result.inliers.sum() >= 37
    state = navigation.state_at(float(duration_s))
    covariance = state.covariance
    assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))).min() > 0.0
    return state_errors(truth, state), covariance[:9, :9]


@pytest.mark.slow
def test_estimates_are_consistent(truth: Descent, exact: ImuIncrements) -> None:
    """NEES of 60 runs: the sum is chi-square with 3 x 60 (9 x 60) degrees of freedom."""
    runs = 60
    landmarks = [draw_points(truth, second + 0.5, 40, np.random.default_rng([second, 4])) for second in range(3)]
    results = [simulate(truth, exact, landmarks, seed) for seed in range(runs)]
    for block in (slice(0, 3), slice(3, 6), slice(6, 9), slice(0, 9)):
        size = block.stop - block.start
        nees = sum([float(error[block] @ np.linalg.solve(cov[block, block], error[block])) for error, cov in results])
        low, high = np.asarray(chi2.ppf([0.005, 0.995], size * runs)) / (size * runs)
        assert low < nees / (size * runs) < high


@pytest.mark.parametrize("seed", range(3))
def test_outliers_are_rejected(truth: Descent, exact: ImuIncrements, seed: int) -> None:
    """30 % of 150 landmarks are wrong by up to 40 pixels, within the uncertainty before the update."""
    rng = np.random.default_rng([seed, 6])
    covariance = np.diag(np.repeat([100.0, 1.0, 0.005], 3) ** 2)
    errors = np.sqrt(np.diag(covariance)) * rng.standard_normal(9)
    navigation = start_filter(truth, exact, covariance, errors)
    points, pixels = draw_points(truth, 2.0, 150, rng)
    pixels += 0.3 * rng.standard_normal(pixels.shape)
    wrong = rng.permutation(150) < 45
    pixels[wrong] += rng.uniform(-40.0, 40.0, (45, 2))
    result = navigation.update_landmarks(2.0, make_landmarks(points, pixels, 0.3))
    assert result.outcome is UpdateOutcome.APPLIED
    far = np.linalg.norm(result.residuals_px, axis=1) > 2.0
    assert not result.inliers[wrong & far].any()
    # a correct landmark is rejected with a probability of 0.001 + 0.0001
    assert (~result.inliers[~wrong]).sum() <= 2
    state = navigation.state_at(2.0)
    error, deviations = state_errors(truth, state), np.sqrt(np.diag(state.covariance)[:9])
    assert np.abs(error[:3] / deviations[:3]).max() < 4.0


def test_systematically_wrong_landmarks_are_inconsistent(truth: Descent, exact: ImuIncrements) -> None:
    """A repetitive pattern: all landmarks agree on a position that is wrong by 400 m, 8 standard deviations."""
    navigation = start_filter(truth, exact)
    points, pixels = draw_points(truth, 2.0, 80, np.random.default_rng(7))
    result = navigation.update_landmarks(2.0, make_landmarks(points + np.array([400.0, 0.0, 0.0]), pixels, 0.3))
    assert result.outcome in (UpdateOutcome.TOO_FEW, UpdateOutcome.INCONSISTENT)
    assert np.abs(state_errors(truth, navigation.state_at(2.0))[:3]).max() < 0.1


@pytest.mark.parametrize("tilt_deg", [0.0, 6.0])
def test_landmarks_of_a_wrong_attitude_are_inconsistent(truth: Descent, exact: ImuIncrements, tilt_deg: float) -> None:
    """Exact pixels; the state's attitude is wrong by the tilt, and its position such that the nadir fits.

    Without the test of all landmarks the robust estimation keeps those near the nadir, and rejects the others.
    """
    covariance = np.diag(np.repeat([30.0, 1.0, 0.002], 3) ** 2)
    tilt = np.radians([tilt_deg, 0.0, 0.0])
    height = truth.state(2.0).position_m[2]
    errors = np.concatenate([np.cross(tilt, [0.0, 0.0, height]), np.zeros(3), tilt])
    navigation = start_filter(truth, exact, covariance, errors)
    points, pixels = draw_points(truth, 2.0, 100, np.random.default_rng(7))
    before = navigation.state_at(2.0)
    result = navigation.update_landmarks(2.0, replace(make_landmarks(points, pixels, 0.3, 6.0, 10.0), is_rigid=True))
    if tilt_deg == 0.0:
        assert result.outcome is UpdateOutcome.APPLIED
        assert result.inliers.all()
        return
    assert result.outcome is UpdateOutcome.INCONSISTENT
    assert not result.inliers.any()
    np.testing.assert_array_equal(navigation.state_at(2.0).position_m, before.position_m)


def test_common_error_limits_the_accuracy_of_one_image(truth: Descent, exact: ImuIncrements) -> None:
    """150 landmarks with a common error: the position's standard deviation is not below that of the common error."""
    deviations = []
    for common in (0.0, np.array([6.0, 6.0, 10.0])):
        navigation = start_filter(truth, exact)
        points, pixels = draw_points(truth, 2.0, 150, np.random.default_rng(8))
        result = navigation.update_landmarks(2.0, make_landmarks(points, pixels, 0.3, 1.0, common))
        assert result.outcome is UpdateOutcome.APPLIED
        deviations.append(np.sqrt(np.diag(navigation.state_at(2.0).covariance)[:3]))
    assert np.all(deviations[0] < 2.0)
    # posterior of prior and common error alone: 1 / (1 / 50^2 + 1 / 6^2), and 10 m in the height
    minimum = 1.0 / np.sqrt(1.0 / 50.0**2 + 1.0 / np.array([6.0, 6.0, 10.0]) ** 2)
    assert np.all(deviations[1] > 0.999 * minimum)


def test_transition_matches_numerical_differences(truth: Descent, exact: ImuIncrements) -> None:
    """One step of 0.1 s and 40 steps, element by element."""
    start = LocalisationFilter.from_initial(initial_state(truth, SMALL_COVARIANCE)).state_at(0.0)
    history = IncrementHistory(exact.times_s, exact.period_s, exact.delta_angles_rad, exact.delta_velocities_m_s)
    times, gravity, step = 0.1 * np.arange(1, 41), np.array([0.0, 0.0, -GRAVITY]), 0.1

    def propagate(errors: np.ndarray) -> list[NavigationState]:
        changed = start.correct(errors, np.eye(15))
        return inertial.propagate_states(changed, history, times, GRAVITY, ImuErrorModel())

    transitions = []
    states = [start, *propagate(np.zeros(15))]
    for before, after in pairwise(states):
        rotations = truth.motion(np.linspace(before.time_s, after.time_s, 41)).attitudes.as_matrix()
        moved = after.position_m - before.position_m - before.velocity_m_s * step
        transitions.append(
            inertial.compute_transition(
                after.velocity_m_s - before.velocity_m_s - gravity * step,
                moved - 0.5 * gravity * step**2,
                np.asarray(np.trapezoid(rotations, dx=step / 40, axis=0)),
                step,
            )
        )
    total = np.linalg.multi_dot(transitions[::-1])
    sizes = np.repeat([1.0, 1.0, 1e-4, 1e-4, 1e-2], 3)
    for column in range(15):
        error = sizes[column] * np.eye(15)[column]
        plus, minus = propagate(error), propagate(-error)
        for number, analytic, tolerance in ((0, transitions[0], 0.05), (39, total, 2e-3)):
            numeric = state_difference(plus[number], minus[number]) / (2.0 * sizes[column])
            for first in range(0, 15, 3):
                rows = slice(first, first + 3)
                expected = analytic[rows, column]
                block = analytic[rows, 3 * (column // 3) : 3 * (column // 3) + 3]
                # Effects of biases on position and velocity: the increments' sums neglect a gyro bias within an
                # interval (1.5 / 40 of the first step, 1.5 / 1600 of all), and rotation in a step. Others: rounding.
                # Relative to the largest element of the block of three columns.
                is_bias = column >= 9 and first < 6
                allowed = (tolerance if is_bias else 1e-6) * np.abs(block).max() + 1e-9
                assert np.abs(numeric[rows] - expected).max() < allowed, (number, column, first)
