"""Tests of radar and laser altimeter."""

import numpy as np
import pytest
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from marsyard.sim.sensor import (
    ClockParameters,
    LaserParameters,
    RadarAltimeter,
    RadarParameters,
    Sampling,
    height_above_ground,
)
from marsyard.sim.sensor.altimeters import RangingUnit, first_return, range_along
from marsyard.sim.terrain import Surface
from tests.sim.scenes import flat_ground, make_ground
from tests.sim.sensor.motions import Swaying

DESCENT = Swaying(position_m=(2500.0, 2500.0, 2000.0), velocity_m_s=(10.0, 0.0, -75.0))
#: Samples per side of a surface, their spacing and the coordinate of its centre, m.
SIDE, SPACING = 1024, 5.0
MIDDLE = 0.5 * SIDE * SPACING


def _make_plane(slope: float) -> Surface:
    """Make a plane that rises to the east, with height 0 at the centre; it falls at the distant periodic border."""
    return make_ground(np.tile(slope * (np.arange(SIDE) * SPACING - MIDDLE), (SIDE, 1)), SPACING)


def _make_rough_surface(seed: int) -> Surface:
    """Make Gaussian relief with a power-law spectrum and an RMS of 30 m over 2 km."""
    rng = np.random.default_rng(seed)
    wavenumbers = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None, :])
    wavenumbers[0, 0] = np.inf
    heights = np.fft.irfft2(wavenumbers**-1.7 * np.fft.rfft2(rng.standard_normal((SIDE, SIDE))), s=(SIDE, SIDE))
    return make_ground(30.0 * heights / heights.std(), 2.0)


def _make_axis(tilt_deg: float, azimuth_deg: float = 90.0) -> Float64[np.ndarray, "3"]:
    """Return the unit vector of a beam at a tilt from nadir towards an azimuth, world axes."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(tilt) * np.sin(azimuth), np.sin(tilt) * np.cos(azimuth), -np.cos(tilt)])


FLAT = flat_ground(64, SPACING)
NO_ERRORS: dict[str, object] = {"scale_error": 0.0, "noise": 0.0, "count_m": 0.0, "clock": ClockParameters()}


def _make_radar(rng: np.random.Generator, **errors: object) -> RadarAltimeter:
    return RadarAltimeter.draw(RadarParameters.model_validate(errors), FLAT, rng)


def test_readings_are_measured_at_the_true_time() -> None:
    clock = ClockParameters(offset_s=0.02, jitter_sd_s=0.001)
    radar = _make_radar(np.random.default_rng(0), **NO_ERRORS | {"clock": clock})
    times = np.arange(400) * 0.02
    readings = radar.measure(DESCENT, times, np.random.default_rng(1))
    np.testing.assert_allclose(readings.values, 2000.0 - 75.0 * times, atol=1e-6)
    error = readings.times_s - times
    # The standard errors from 400 values are 5e-5 s of the mean and 3.5 % of the standard deviation.
    assert error.mean() == pytest.approx(0.02, abs=2e-4)
    assert error.std() == pytest.approx(0.001, rel=0.15)


def test_readings_have_constant_rate_and_random_phase() -> None:
    sampling = Sampling(10.0, 0.03)
    np.testing.assert_allclose(sampling.within(0.0, 0.35), [0.03, 0.13, 0.23, 0.33])
    np.testing.assert_allclose(sampling.latest(np.array([0.0, 0.1, 0.329, 3.75])), [-0.07, 0.03, 0.23, 3.73])
    phases = [Sampling.draw(10.0, np.random.default_rng(seed)).phase_s for seed in range(200)]
    assert 0.0 <= min(phases) < 0.01
    assert 0.09 < max(phases) < 0.1


def test_radar_scale_is_common_and_noise_is_independent() -> None:
    static = Swaying(position_m=(0.0, 0.0, 1000.0))
    parameters = RadarParameters(scale_error=0.01, noise=0.001, count_m=0.0)
    common_errors, noise_errors = [], []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        radar = RadarAltimeter.draw(parameters, FLAT, rng)
        first, second = radar.measure(static, np.array([0.0, 1.0]), rng).values
        common_errors.append(0.5 * (first + second) - 1000.0)
        noise_errors.append((first - second) / np.sqrt(2.0))
    # The standard error of the deviation from 300 values is 4 %; the tolerance is three times that.
    assert np.std(common_errors) == pytest.approx(10.0, rel=0.12)
    assert np.std(noise_errors) == pytest.approx(1.0, rel=0.12)


def test_radar_is_quantised_and_limited_in_range() -> None:
    parameters = RadarParameters(
        scale_error=0.0, noise=0.0, count_m=0.5, max_range_m=1990.0, min_range_m=1700.0, clock=ClockParameters()
    )
    radar = RadarAltimeter.draw(parameters, FLAT, np.random.default_rng(0))
    values = radar.measure(DESCENT, np.array([0.0, 1.0, 1.001, 5.0]), np.random.default_rng(0)).values
    np.testing.assert_array_equal(values, [np.nan, 1925.0, 1925.0, np.nan])
    with pytest.raises(ValueError, match="less than max_range_m"):
        RadarParameters(min_range_m=100.0, max_range_m=50.0)


@pytest.mark.parametrize("slope_deg", [0.0, 5.0, 12.0])
def test_radar_over_a_slope_measures_the_perpendicular_distance(slope_deg: float) -> None:
    surface = _make_plane(np.tan(np.radians(slope_deg)))
    position = np.array([MIDDLE, MIDDLE, 1000.0])
    result = first_return(surface, position, _make_axis(0.0), np.radians(30.0), 5000.0)
    assert result == pytest.approx(1000.0 * np.cos(np.radians(slope_deg)), abs=0.1)


def test_radar_near_a_cliff_measures_the_range_to_its_edge() -> None:
    heights = np.zeros((SIDE, SIDE))
    edge = SIDE // 2 + 60
    heights[:, edge:] = 200.0
    position = np.array([MIDDLE, MIDDLE, 1500.0])
    result = first_return(make_ground(heights, SPACING), position, _make_axis(0.0), np.radians(30.0), 5000.0)
    # The spline turns the step into a ramp, whose top is one cell beyond the edge.
    assert result == pytest.approx(np.hypot(61 * SPACING, 1300.0), abs=0.1)
    # The edge is 13 deg from nadir, outside a beam with a half angle of 10 deg.
    result = first_return(make_ground(heights, SPACING), position, _make_axis(0.0), np.radians(10.0), 5000.0)
    assert result == pytest.approx(1500.0)


@pytest.mark.parametrize(("height", "tilt_deg"), [(2000.0, 0.0), (1400.0, 25.0), (2000.0, 38.0)])
def test_first_return_matches_a_dense_scan(height: float, tilt_deg: float) -> None:
    surface = _make_rough_surface(int(height + tilt_deg))
    position, axis = np.array([300.0, 700.0, height]), _make_axis(tilt_deg, 200.0)
    line = np.arange(-1500.0, 1500.0, 2.0)
    x, y = np.meshgrid(line, line)
    depth = height - surface.height(300.0 + x, 700.0 + y)
    ranges = np.sqrt(x**2 + y**2 + depth**2)
    is_in_beam = x * axis[0] + y * axis[1] - depth * axis[2] >= ranges * np.cos(np.radians(30.0))
    result = first_return(surface, position, axis, np.radians(30.0), 5000.0)
    # The requirement is 0.05 % of the altitude.
    assert result == pytest.approx(ranges[is_in_beam].min(), abs=5e-4 * height)


def test_radar_above_the_horizon_has_no_return() -> None:
    for height in (1000.0, 1.0):
        assert first_return(FLAT, np.array([0.0, 0.0, height]), _make_axis(150.0), np.radians(30.0), 5000.0) == np.inf


def test_radar_measures_the_ledge_below_it_or_the_ground_beyond() -> None:
    heights = np.zeros((SIDE, SIDE))
    edge = SIDE // 2
    heights[:, :edge] = 400.0
    # The radar is 1 m above the ledge, 20 m from its edge. The narrow beam points east, 60 deg from nadir, and hits the
    # ledge.
    position = np.array([edge * SPACING - 20.0, MIDDLE, 401.0])
    result = first_return(make_ground(heights, SPACING), position, _make_axis(60.0), np.radians(2.0), 5000.0)
    assert result < 10.0
    # 15 m beyond the edge, the beam hits the ground 401 m below.
    position = np.array([edge * SPACING + 15.0, MIDDLE, 401.0])
    result = first_return(make_ground(heights, SPACING), position, _make_axis(60.0), np.radians(2.0), 5000.0)
    assert result == pytest.approx(401.0 / np.cos(np.radians(58.0)), rel=5e-3)


def test_laser_measures_slant_range_along_its_axis() -> None:
    # The axis points west, 20 deg from nadir. The ground falls to the west, so that r cos 20 = 100 + 0.1 r sin 20.
    axis = np.array([-np.sin(np.radians(20.0)), 0.0, -np.cos(np.radians(20.0))])
    expected = 100.0 / (np.cos(np.radians(20.0)) - 0.1 * np.sin(np.radians(20.0)))
    position = np.array([MIDDLE, MIDDLE, 100.0])
    assert range_along(_make_plane(0.1), position, axis, 300.0) == pytest.approx(expected, abs=1e-4)
    assert range_along(_make_plane(0.1), position, axis, 90.0) == np.inf
    assert range_along(FLAT, position, np.array([0.0, 0.0, 1.0]), 300.0) == np.inf


def test_laser_has_no_reading_outside_its_range() -> None:
    no_errors = LaserParameters(noise_m=0.0, count_m=0.0)
    unit = RangingUnit.draw(no_errors, np.random.default_rng(0))
    readings = unit.read(np.array([10.0, np.inf, 301.0]), np.random.default_rng(0))
    np.testing.assert_array_equal(readings, [10.0, np.nan, np.nan])


def test_boresight_error_has_the_specified_deviation() -> None:
    parameters = LaserParameters(boresight_deg=0.5)
    axes = np.array([RangingUnit.draw(parameters, np.random.default_rng(seed)).axis for seed in range(400)])
    # The standard error of the deviation from 400 values is 3.5 %; the tolerance is three times that.
    np.testing.assert_allclose(np.degrees(axes[:, :2].std(axis=0)), 0.5, rtol=0.11)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)


def test_side_lobes_receive_the_ground_at_nadir() -> None:
    """A beam of 60 deg width, tilted by 50 deg, ends 20 deg from nadir. The side lobes include the nadir."""
    tilted_motion = Swaying(position_m=(160.0, 160.0, 1000.0), tilt=Rotation.from_rotvec([0.0, np.radians(50.0), 0.0]))
    times, exact = np.arange(100) * 0.1, {"scale_error": 0.0, "noise": 0.0, "count_m": 0.0}
    main_lobe, with_side_lobes = (
        _make_radar(np.random.default_rng(0), **exact, sidelobe_fraction=fraction)
        .measure(tilted_motion, times, np.random.default_rng(1))
        .values
        for fraction in (0.0, 0.3)
    )
    np.testing.assert_allclose(main_lobe, 1000.0 / np.cos(np.radians(20.0)), rtol=1e-3)
    is_nadir_range = np.isclose(with_side_lobes, 1000.0, rtol=1e-3)
    assert np.all(is_nadir_range | np.isclose(with_side_lobes, main_lobe, rtol=1e-6))
    assert 0.15 < is_nadir_range.mean() < 0.45


def test_true_altitude_is_vertical_height_above_ground() -> None:
    positions = np.array([[MIDDLE + 100.0, MIDDLE, 500.0], [MIDDLE - 50.0, MIDDLE, 500.0]])
    np.testing.assert_allclose(height_above_ground(_make_plane(0.2), positions), [480.0, 510.0], atol=1e-3)


def test_error_free_readings_equal_the_truth() -> None:
    radar = _make_radar(np.random.default_rng(0), **NO_ERRORS)
    times = radar.sampling.within(0.0, 10.0)
    readings = radar.measure(DESCENT, times, np.random.default_rng(1))
    # Flat ground at height 0.
    np.testing.assert_allclose(readings.values, DESCENT.motion(times).positions_m[:, 2], atol=1e-6)
    np.testing.assert_array_equal(readings.times_s, times)


def test_narrow_beam_measures_the_range_at_its_uphill_edge() -> None:
    surface = _make_plane(np.tan(np.radians(20.0)))
    position = np.array([MIDDLE, MIDDLE, 1000.0])
    result = first_return(surface, position, _make_axis(0.0), np.radians(5.0), 5000.0)
    # The nearest ray is 5 deg uphill of nadir. Its range r solves r cos 5 = 1000 - r sin 5 tan 20.
    expected = 1000.0 / (np.cos(np.radians(5.0)) + np.sin(np.radians(5.0)) * np.tan(np.radians(20.0)))
    assert result == pytest.approx(expected, rel=5e-4)


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 30.0, 40.0, 60.0])
def test_tilt_beyond_half_beam_width_increases_the_range(tilt_deg: float) -> None:
    position = np.array([0.0, 0.0, 1500.0])
    result = first_return(FLAT, position, _make_axis(tilt_deg, 33.0), np.radians(30.0), 5000.0)
    off_nadir = max(np.radians(tilt_deg - 30.0), 0.0)
    assert result == pytest.approx(1500.0 / np.cos(off_nadir), rel=5e-4)
