"""Tests of compass and inclinometers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.sim.sensor.instrument import ClockParameters
from marsyard.sim.sensor.tilt_compass import TiltCompass, TiltCompassParameters, TiltCompassReadings
from tests.sim.sensor.motions import GRAVITY, Swaying

_ERRORS = ("tilt_bias", "tilt_noise", "heading_bias", "hard_iron", "soft_iron", "heading_noise", "count")
NO_ERRORS: dict[str, object] = {f"{name}_deg": 0.0 for name in _ERRORS} | {"clock": ClockParameters()}


def _read(motion: Swaying, times: np.ndarray, seed: int = 0, **changes: object) -> TiltCompassReadings:
    rng = np.random.default_rng(seed)
    unit = TiltCompass.draw(TiltCompassParameters.model_validate(NO_ERRORS | changes), rng)
    return unit.measure(motion, times, rng)


def test_static_readings_equal_the_attitude() -> None:
    tilt = Rotation.from_euler("ZYX", [70.0, 5.0, -8.0], degrees=True)
    readings = _read(Swaying(tilt=tilt), np.array([0.0, 1.0]))
    np.testing.assert_allclose(readings.up_body, np.tile(tilt.as_matrix()[2], (2, 1)), atol=1e-9)
    np.testing.assert_allclose(np.degrees(readings.headings_rad), 20.0, atol=1e-9)


def test_acceleration_tilts_vertical_and_rotates_heading() -> None:
    """An eastward acceleration a tilts the measured vertical by atan(a / g).

    The magnetic field is (0, cos d, -sin d) with the dip d. The measured horizontal axes are north and
    east' = (g, 0, -a) / sqrt(g^2 + a^2). The body x axis is east: its heading is 90 deg - atan(B_east' / B_north).
    """
    motion, dip = Swaying(acceleration_m_s2=(0.5, 0.0, 0.0)), np.radians(59.0)
    readings = _read(motion, np.array([0.0]))
    specific_force = np.hypot(0.5, GRAVITY)
    np.testing.assert_allclose(readings.up_body[0], [0.5 / specific_force, 0.0, GRAVITY / specific_force], atol=1e-9)
    heading_error = np.arctan2(0.5 / specific_force * np.sin(dip), np.cos(dip))
    assert np.degrees(heading_error) > 10.0
    assert readings.headings_rad[0] == pytest.approx(0.5 * np.pi - heading_error, abs=1e-9)
    horizontal_field = _read(motion, np.array([0.0]), dip_deg=0.0)
    assert horizontal_field.headings_rad[0] == pytest.approx(0.5 * np.pi, abs=1e-9)


def test_inclinometers_lag_as_a_first_order_system() -> None:
    """For a sway of w = 1 rad/s and a lag t = 0.2 s the gain is 1 / sqrt(1 + w^2 t^2), the phase lag atan(w t)."""
    motion, times = Swaying(sway_m=0.1, sway_rad_s=1.0), np.arange(10.0, 20.0, 0.05)
    up_x = _read(motion, times).up_body[:, 0]
    expected = -0.1 / GRAVITY / np.hypot(1.0, 0.2) * np.sin(times - np.arctan(0.2))
    np.testing.assert_allclose(up_x, expected, atol=2e-5)


def test_lag_does_not_depend_on_requested_times() -> None:
    motion, times = Swaying(sway_m=0.1, sway_rad_s=3.0), np.arange(0.0, 6.0, 0.25)
    all_readings = _read(motion, times).up_body
    np.testing.assert_allclose(_read(motion, times[12:]).up_body, all_readings[12:], atol=1e-5)


def test_iron_causes_one_and_two_cycle_heading_errors() -> None:
    parameters = TiltCompassParameters.model_validate(
        NO_ERRORS | {"heading_bias_deg": 0.8, "hard_iron_deg": 0.5, "soft_iron_deg": 0.25}
    )
    azimuths = np.radians(np.arange(0.0, 360.0, 45.0))
    deviations_deg = []
    for seed in range(300):
        unit = TiltCompass.draw(parameters, np.random.default_rng(seed))
        errors_rad = unit.deviation_rad(azimuths)
        motions = [Swaying(tilt=Rotation.from_euler("z", 0.5 * np.pi - azimuth)) for azimuth in azimuths]
        reading_rng = np.random.default_rng(0)
        if seed < 3:
            headings = [unit.measure(motion, np.array([0.0]), reading_rng).headings_rad[0] for motion in motions]
            np.testing.assert_allclose(np.angle(np.exp(1j * (headings - azimuths - errors_rad))), 0.0, atol=1e-9)
        deviations_deg.append(np.degrees(errors_rad))
    modes = np.fft.rfft(np.array(deviations_deg), axis=1) / azimuths.size
    # Deviations of the constant error (300 values) and of the errors with one and two cycles (600 values each).
    assert modes[:, 0].real.std() == pytest.approx(0.8, rel=0.12)
    assert np.sqrt(2.0 * np.mean(np.abs(modes[:, 1]) ** 2)) == pytest.approx(0.5, rel=0.09)
    assert np.sqrt(2.0 * np.mean(np.abs(modes[:, 2]) ** 2)) == pytest.approx(0.25, rel=0.09)
    np.testing.assert_allclose(np.abs(modes[:, 3]), 0.0, atol=1e-9)


def test_noise_and_bias_have_the_specified_deviation() -> None:
    static, times = Swaying(), np.arange(0.0, 40.0, 0.1)
    readings = _read(static, times, tilt_noise_deg=0.15, heading_noise_deg=0.3)
    # The relative standard errors are 2.5 % (800 values) and 3.5 % (400 values).
    assert np.degrees(readings.up_body[:, :2]).std() == pytest.approx(0.15, rel=0.08)
    assert np.degrees(readings.headings_rad).std() == pytest.approx(0.3, rel=0.11)
    biases = [np.degrees(_read(static, times[:1], seed, tilt_bias_deg=0.2).up_body[0, :2]) for seed in range(300)]
    assert np.std(biases) == pytest.approx(0.2, rel=0.09)


def test_stuck_instruments_repeat_their_last_reading() -> None:
    spinning, times = Swaying(spin_rad_s=0.1, nod_rad=0.05), np.arange(0.0, 4.0, 0.25)
    free, stuck = (_read(spinning, times, heading_stuck_s=stuck_s, tilt_stuck_s=stuck_s) for stuck_s in (None, 2.1))
    np.testing.assert_array_equal(stuck.headings_rad[:9], free.headings_rad[:9])
    np.testing.assert_array_equal(stuck.headings_rad[9:], free.headings_rad[8])
    np.testing.assert_array_equal(stuck.up_body[9:], np.tile(free.up_body[8], (7, 1)))
