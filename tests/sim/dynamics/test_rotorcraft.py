"""Tests of the small helicopter: kinematic consistency and the flight described in the landing paper (section V)."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics import Trajectory
from marsyard.sim.dynamics.rotorcraft import (
    TAIL_S,
    Air,
    AirParameters,
    AltimeterErrors,
    GroundPatch,
    LandingGuidance,
    Phase,
    RotorcraftFlight,
    RotorcraftParameters,
    TransitParameters,
    VibrationParameters,
    kernels,
    simulate_landing,
    simulate_transit,
)
from tests.sim.sensor.motions import assert_derivatives

#: Gravity, m/s2; course and heading of the transit, rad.
GRAVITY, COURSE, HEADING = 9.8, 0.3, 1.0
#: Point that the transit passes over, and the horizontal position of the landing site; world axes, m.
TRANSIT_POINT, SITE_XY = np.array([100.0, 50.0, 12.0]), np.array([103.0, 52.0])
CRAFT, TRANSIT, GUIDANCE = RotorcraftParameters(), TransitParameters(), LandingGuidance()
CALM: dict[str, Any] = {"east_m_s": 0.0, "north_m_s": 0.0, "gust_m_s": 0.0, "vertical_gust_m_s": 0.0}
#: A craft without vibration.
NO_VIBRATION = RotorcraftParameters(vibration=VibrationParameters(acceleration_m_s2=0.0, angle_deg=0.0))


def _make_air(seed: int, **changes: float) -> Air:
    span = TRANSIT.lead_s + TRANSIT.imaging_duration_s + TAIL_S + GUIDANCE.wait_s + GUIDANCE.max_duration_s
    return Air.draw(AirParameters.model_validate(changes), CRAFT.step_s, span, np.random.default_rng(seed))


def _fly_transit(air: Air, craft: RotorcraftParameters = CRAFT) -> RotorcraftFlight:
    return simulate_transit(craft, TRANSIT, TRANSIT_POINT, COURSE, HEADING, GRAVITY, air, np.random.default_rng(5))


def _fly_landing(
    seed: int = 0,
    east_error_m: float = 0.0,
    slope: float = 0.0,
    stuck_m: float | None = None,
    craft: RotorcraftParameters = CRAFT,
    axis: tuple[float, float, float] = (0.0, 0.0, -1.0),
    **wind: float,
) -> RotorcraftFlight:
    """Simulate transit and landing.

    - east_error_m: constant navigation error to the east
    - slope: slope of the ground, which rises to the east
    - stuck_m: constant reading of a failed laser altimeter
    - axis: direction of the laser in body axes
    """
    air = _make_air(seed, **wind)
    flight = _fly_transit(air, craft)
    # Navigation errors in nine columns; the first one is the east position.
    errors = np.zeros((len(flight.path.rows), 9))
    errors[:, 0] = east_error_m
    heights = 2.0 + slope * np.tile(0.5 * np.arange(101.0) - 25.0, (101, 1))
    ground = GroundPatch(float(SITE_XY[0]) - 25.0, float(SITE_XY[1]) - 25.0, 0.5, heights)
    laser = AltimeterErrors(1.0, np.zeros(len(air.gusts_m_s)), stuck_m, axis=axis)
    return simulate_landing(flight, GUIDANCE, SITE_XY, errors, air, ground, laser)


def test_air_shorter_than_the_flight_is_rejected() -> None:
    """The kernels do not check the end of the gust samples."""
    air = Air.draw(AirParameters(), CRAFT.step_s, TRANSIT.lead_s + TRANSIT.imaging_duration_s, np.random.default_rng(0))
    with pytest.raises(ValueError, match="the flight can have"):
        _fly_transit(air)


def _find_touchdown(flight: RotorcraftFlight) -> np.ndarray:
    time = flight.phase_start_s(Phase.ON_GROUND)
    assert time is not None
    return flight.path.state(time).position_m


def test_velocity_rate_and_force_are_derivatives() -> None:
    """Central differences over 1e-4 s: the relative truncation at the vibration's 22 Hz is (2 pi f h)^2 / 6 = 3e-5."""
    flight, step = _fly_landing(3).path, 1e-4
    assert isinstance(flight, Trajectory)
    first, last = flight.span_s
    times = np.random.default_rng(0).uniform(first + step, last - step, 2000)
    # Third derivatives jump at the knots, by up to 100 m/s3 at the touchdown.
    assert_derivatives(flight.motion, times, step, GRAVITY, velocity=1e-6, force=5e-3, rate=1e-5)


def test_specific_force_is_rotor_thrust_plus_drag() -> None:
    """In calm air the force perpendicular to the rotor axis is drag."""
    flight = _fly_transit(_make_air(0, **CALM), NO_VIBRATION).path
    motion = flight.motion(flight.knots_s[1:])
    drag = motion.attitudes.inv().apply(-motion.velocities_m_s / NO_VIBRATION.drag_s)
    # Thrust angles are predicted one step h ahead. A command jump of 1 m/s2 causes a prediction error of
    # (omega h)^2 / (6 g) = 2e-4 rad.
    np.testing.assert_allclose(motion.specific_forces_m_s2[:, :2], drag[:, :2], atol=3e-3)


def test_pitch_balances_drag_and_wind() -> None:
    """In steady flight tan(pitch) is drag divided by weight; the drag per mass is the airspeed divided by 5 s."""
    for wind in (0.0, -3.0):
        air = CALM | {"east_m_s": wind * np.cos(COURSE), "north_m_s": wind * np.sin(COURSE)}
        flight = simulate_transit(
            NO_VIBRATION, TRANSIT, TRANSIT_POINT, COURSE, COURSE, GRAVITY, _make_air(0, **air), np.random.default_rng(0)
        ).path
        attitude = flight.state(TRANSIT.imaging_duration_s).attitude.as_euler("ZYX")
        speed = float(flight.state(TRANSIT.imaging_duration_s).velocity_m_s[:2] @ [np.cos(COURSE), np.sin(COURSE)])
        assert speed == pytest.approx(1.0, abs=0.05)
        assert np.tan(attitude[1]) == pytest.approx((speed - wind) / 5.0 / GRAVITY, abs=2e-3)
        assert attitude[2] == pytest.approx(0.0, abs=1e-6)


def test_transit_has_constant_height_and_course() -> None:
    """Forty images in five seconds at 1 m/s cover 5 m along the course. Only gusts change the height."""
    displacements, height_ranges, attitude_deviations_deg = [], [], []
    for seed in range(20):
        motion = _fly_transit(_make_air(seed)).path.motion(np.linspace(0.0, TRANSIT.imaging_duration_s, TRANSIT.images))
        displacements.append(motion.positions_m[-1] - motion.positions_m[0])
        height_ranges.append(np.ptp(motion.positions_m[:, 2]))
        attitude_deviations_deg.append(motion.attitudes.as_euler("ZYX", degrees=True).std(axis=0))
    mean_displacement = np.mean(displacements, axis=0)
    assert np.hypot(*mean_displacement[:2]) == pytest.approx(5.0, abs=0.3)
    assert np.arctan2(mean_displacement[1], mean_displacement[0]) == pytest.approx(COURSE, abs=0.1)
    assert max(height_ranges) < 0.3
    # Gusts change the attitude by about a degree; the paper's limit for tracking is 10 deg.
    assert 0.2 < np.mean(attitude_deviations_deg) < 2.0


def test_vibration_has_the_specified_frequency() -> None:
    vibrating, without_vibration = (_fly_transit(_make_air(1), craft).path for craft in (CRAFT, NO_VIBRATION))
    times = np.arange(0.0, 5.0, 1e-3)
    motions = [flight.motion(times) for flight in (vibrating, without_vibration)]
    specific_force = [motion.attitudes.apply(motion.specific_forces_m_s2) for motion in motions]
    spectrum = np.abs(np.fft.rfft(specific_force[0] - specific_force[1], axis=0)) * 2.0 / times.size
    assert np.all(np.argmax(spectrum, axis=0) == 110)  # 22 Hz: 5 s resolve 0.2 Hz
    np.testing.assert_allclose(spectrum[110], 1.5, rtol=1e-3)
    angles_deg = motions[0].attitudes.as_euler("ZYX", degrees=True) - motions[1].attitudes.as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(angles_deg.std(axis=0), 0.03 / np.sqrt(2.0), rtol=1e-3)


def test_calm_air_landing_error_equals_navigation_error() -> None:
    without_error = _find_touchdown(_fly_landing(**CALM))
    np.testing.assert_allclose(without_error[:2], SITE_XY, atol=0.02)
    with_error = _find_touchdown(_fly_landing(east_error_m=0.7, **CALM))
    np.testing.assert_allclose(with_error[:2], SITE_XY - [0.7, 0.0], atol=0.02)


def test_touchdown_error_is_proportional_to_gusts() -> None:
    def rms_error(gust_m_s: float) -> float:
        errors = [_find_touchdown(_fly_landing(seed, gust_m_s=gust_m_s))[:2] - SITE_XY for seed in range(25)]
        return float(np.sqrt(np.mean(np.square(errors))))

    # Without saturation, doubled gusts double the errors. The standard error of an RMS of 50 values is 10 %.
    assert rms_error(0.8) / rms_error(0.4) == pytest.approx(2.0, rel=0.2)


def test_phases_start_at_the_heights_of_the_paper() -> None:
    # The ground height is 2 m + 0.1 times the distance east of the site.
    flight = _fly_landing(slope=0.1, craft=NO_VIBRATION, **CALM)
    state = {phase: flight.path.state(time) for phase in Phase if (time := flight.phase_start_s(phase)) is not None}
    assert list(state) == list(Phase)
    assert state[Phase.APPROACH].time_s - TRANSIT.imaging_duration_s == pytest.approx(GUIDANCE.wait_s, abs=0.05)
    # Commands use the state 0.1 s earlier. This is 0.2 m at 2 m/s, and 0.07 m at the descent rate of 0.7 m/s.
    assert np.hypot(*(state[Phase.DESCENT].position_m[:2] - SITE_XY)) == pytest.approx(2.0, abs=0.25)
    flare_start = state[Phase.FLARE].position_m
    assert flare_start[2] - 2.0 - 0.1 * (flare_start[0] - SITE_XY[0]) == pytest.approx(1.5, abs=0.1)
    landed = state[Phase.ON_GROUND]
    assert landed.position_m[2] - 2.0 - 0.1 * (landed.position_m[0] - SITE_XY[0]) == pytest.approx(
        CRAFT.gear_m, abs=0.01
    )
    assert landed.velocity_m_s[2] == pytest.approx(-GUIDANCE.flare_m_s, abs=0.05)
    at_rest = flight.path.state(flight.path.span_s[1])
    np.testing.assert_allclose(at_rest.velocity_m_s, 0.0, atol=1e-9)
    np.testing.assert_allclose(at_rest.attitude.as_matrix()[:, 2], [0.0, 0.0, 1.0], atol=1e-9)
    assert at_rest.time_s - landed.time_s == pytest.approx(GUIDANCE.rest_s, abs=0.05)


def test_altimeter_measures_along_its_axis() -> None:
    """A laser tilted by 30 deg in calm air reads the height above level ground divided by cos(30 deg)."""
    heights_m = []
    for tilt_rad in (0.0, np.radians(30.0)):
        flight = _fly_landing(craft=NO_VIBRATION, axis=(np.sin(tilt_rad), 0.0, -np.cos(tilt_rad)), **CALM)
        time = flight.phase_start_s(Phase.FLARE)
        assert time is not None
        heights_m.append(flight.path.state(time).position_m[2] - 2.0)
    # the delay of 0.1 s of both commands, 0.07 m at the speed of the descent
    assert heights_m[0] == pytest.approx(1.5 - 0.07, abs=0.03)
    assert heights_m[1] == pytest.approx(1.5 * np.cos(np.radians(30.0)) - 0.07, abs=0.03)


def test_range_along_a_tilted_axis_is_that_of_the_rotated_direction() -> None:
    """Against SciPy's rotation (intrinsic yaw, pitch, roll) on level ground: the height / the downward component."""
    rng = np.random.default_rng(2)
    ground = GroundPatch(-50.0, -50.0, 1.0, np.zeros((101, 101)))
    for _ in range(20):
        row, angles, axis = np.zeros(18), rng.uniform(-0.4, 0.4, 3), np.append(rng.uniform(-0.3, 0.3, 2), -1.0)
        axis /= np.linalg.norm(axis)
        row[2], row[9:12] = 10.0, angles
        down = -Rotation.from_euler("ZYX", angles).apply(axis)[2]
        assert kernels.compute_laser_range(ground, row, *axis) == pytest.approx(10.0 / down, rel=1e-12)


def test_stuck_altimeter_prevents_deceleration() -> None:
    flight = _fly_landing(stuck_m=9.0, **CALM)
    assert flight.phase_start_s(Phase.FLARE) is None
    time = flight.phase_start_s(Phase.ON_GROUND)
    assert time is not None
    assert flight.path.state(time).velocity_m_s[2] == pytest.approx(-GUIDANCE.descent_m_s, abs=0.05)


def test_flight_is_defined_only_within_its_span() -> None:
    with pytest.raises(ValueError, match="outside of the motion"):
        _fly_transit(_make_air(0)).path.state(99.0)


@pytest.mark.parametrize("name", ["drag_s", "contact_s"])
def test_time_constants_shorter_than_a_step_are_rejected(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is 0.02; allowed: above step_s, 0.02"):
        RotorcraftParameters.model_validate({name: 0.02})
