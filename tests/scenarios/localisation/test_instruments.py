"""Tests of the instruments of localisation: camera, detector, radar, and the initial state."""

import numpy as np
import pytest
from scipy.stats import chi2

from marsyard.scenarios.cameras import CalibrationParameters
from marsyard.scenarios.localisation.camera import (
    HALF_WELL_SNR,
    LANDER_DETECTOR,
    LanderCameraParameters,
    draw_calibrated_camera,
    true_camera,
)
from marsyard.scenarios.localisation.flight import LanderFlight
from marsyard.scenarios.localisation.initial_state import InitialErrors
from marsyard.scenarios.localisation.instruments import RADAR, measure_altitudes
from marsyard.sim.sensor import Detector, RadarAltimeter
from marsyard.sim.sensor.presets import preset
from marsyard.sim.terrain import Surface

#: Height of the level ground, and gravity of Mars.
GROUND_M, GRAVITY_M_S2 = -100.0, 3.72
EXACT_LENS = CalibrationParameters(focal_error=0.0, centre_error_px=0.0, distortion_error_px=0.0)


def test_camera_has_the_field_and_pixel_of_the_lander() -> None:
    """90 deg from edge to edge, 1.67 mrad per pixel on the axis; columns along body x, looking along -z."""
    camera = true_camera(LanderCameraParameters())
    assert camera.size == (1024, 1024)
    edges = np.array([[-0.5, 511.5], [1023.5, 511.5], [511.5, -0.5], [511.5, 1023.5]])
    _, rays = camera.rays(edges)
    root = np.sqrt(0.5)
    expected = np.array([[-root, 0.0, -root], [root, 0.0, -root], [0.0, root, -root], [0.0, -root, -root]])
    np.testing.assert_allclose(rays, expected, rtol=0.0, atol=1e-9)
    _, centre = camera.rays(np.array([[511.0, 511.5], [512.0, 511.5]]))
    assert np.arccos(centre[0] @ centre[1]) == pytest.approx(1.67e-3, rel=1e-5)
    pixels = camera.pixel_grid()[::93, ::93]
    projected, visible = camera.project(1500.0 * camera.rays(pixels)[1])
    assert visible.all()
    np.testing.assert_allclose(projected, pixels, rtol=0.0, atol=1e-6)
    # pixels of 9.6 um: 2 x 2 of 4.8 um
    assert LanderCameraParameters().pixel_pitch_um == pytest.approx(9.6, abs=0.1)


def test_field_of_view_with_a_folded_image_is_rejected() -> None:
    """The distortion is a cubic term; for this field of view it would map two directions to one pixel."""
    with pytest.raises(ValueError, match="allowed: a field close to"):
        LanderCameraParameters(field_deg=120.0, pixel_mrad=1.0)


def test_calibration_without_errors_is_the_true_camera() -> None:
    """All errors of the calibrated camera are parameters."""
    p = LanderCameraParameters(alignment_error_deg=0.0, calibration=EXACT_LENS)
    camera, calibrated = true_camera(p), draw_calibrated_camera(p, np.random.default_rng(0))
    grid = camera.pixel_grid()[::170, ::170]
    np.testing.assert_allclose(calibrated.rays(grid)[1], camera.rays(grid)[1], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "expected_px"),
    [
        # a distortion error of 0.3 px RMS displaces the corner by 0.3 px
        ({"distortion_error_px": 0.3}, 0.3),
        # the centre: both axes
        ({"centre_error_px": 0.5}, 0.5 * np.sqrt(2.0)),
        # the corner is 724 px from the centre
        ({"focal_error": 0.0002}, 0.0002 * 724.1),
    ],
)
def test_calibration_errors_have_their_standard_deviation(changes: dict[str, float], expected_px: float) -> None:
    """RMS displacement of a corner by each error of the lens; 100 cameras determine it to 7 % (one sigma)."""
    p = LanderCameraParameters(alignment_error_deg=0.0, calibration=EXACT_LENS.model_copy(update=changes))
    camera = true_camera(p)
    corner = np.array([-0.5, -0.5])
    point = camera.rays(corner)[1]
    rng = np.random.default_rng(3)
    displacements = [draw_calibrated_camera(p, rng).project(point)[0] - corner for _ in range(100)]
    assert np.sqrt(np.mean(np.sum(np.square(displacements), axis=1))) == pytest.approx(expected_px, rel=0.25)


def test_detector_has_the_specified_signal_to_noise_ratio() -> None:
    """Two images of a uniform scene at half of the full well: their difference has sqrt(2) times the noise."""
    detector = LANDER_DETECTOR.model_copy(update={"response_spread": 0.0, "residual_spread": 0.0})
    radiance = 0.5 * detector.full_well_e / (detector.responsivity_e_s * detector.exposure_s)
    rng = np.random.default_rng(5)
    unit = Detector.draw(np.ones((256, 256), dtype=np.float32), detector, rng)
    scene = np.full((256, 256), radiance, dtype=np.float32)
    # a ramp over a few counts, as in any real scene, so that rounding errors are uniformly distributed
    scene *= np.linspace(0.97, 1.03, 256, dtype=np.float32)
    first, second = (unit.expose(scene, rng).astype(np.float64) for _ in range(2))
    noise = np.std(first - second) / np.sqrt(2.0)
    # 65536 pixels: 0.3 % (one sigma)
    assert (first.mean() - detector.offset_dn) / noise == pytest.approx(HALF_WELL_SNR, rel=0.02)
    assert unit.calibration.full_scale_dn == 255
    assert detector.exposure_s == 150e-6


def test_images_contain_the_pattern_of_the_flown_descent_camera() -> None:
    """The response contains a pattern with the RMS of that of Spirit's camera, which the calibration lacks."""
    flown = preset("mer-descent-flown").detector
    assert LANDER_DETECTOR.residual_spread == flown.residual_spread > 0.0
    assert LANDER_DETECTOR.residual_px == flown.residual_px
    exact = LANDER_DETECTOR.model_copy(update={"response_spread": 0.0, "calibration_error": 0.0})
    radiance = np.full((256, 256), 0.5 * exact.full_well_e / (exact.responsivity_e_s * exact.exposure_s), np.float32)
    unit = Detector.draw(np.ones((256, 256), dtype=np.float32), exact, np.random.default_rng(5))
    rng = np.random.default_rng(6)
    mean = np.mean([unit.expose(radiance, rng) for _ in range(100)], axis=0) - exact.offset_dn
    # the noise of a mean of 100 images is 0.1 / 80 = 0.13 %; the calibrated response is normalised to its maximum
    pattern = mean / unit.calibration.flat_field
    assert pattern.std() / pattern.mean() == pytest.approx(flown.residual_spread, rel=0.1)


def test_radar_measures_the_altitude_over_flat_ground(flight: LanderFlight) -> None:
    """Altitudes are within a few per mille; their tags are not the true sample times."""
    samples = np.zeros((16, 16, 2), dtype=np.float32)
    samples[..., 0] = GROUND_M
    rng = np.random.default_rng(2)
    radar = RadarAltimeter.draw(RADAR, Surface.from_samples(samples, 2000.0), rng)
    altitudes = measure_altitudes(radar, flight, (0.05, flight.end_s), rng)
    assert len(altitudes) == pytest.approx(flight.end_s * RADAR.rate_hz, abs=1)
    tags = np.array([altitude.time_s for altitude in altitudes])
    true_altitudes = flight.motion(tags).positions_m[:, 2] - GROUND_M
    ratios = np.array([altitude.altitude_m for altitude in altitudes]) / true_altitudes
    # 4 sigma of the constant error (0.3 %) and the noise (0.15 %), and 0.2 % for the grid of the radar's search
    np.testing.assert_allclose(ratios, 1.0, rtol=0.0, atol=4.0 * np.hypot(0.003, 0.0015) + 0.002)
    true_times = radar.sampling.within(0.05, flight.end_s)
    assert np.all(tags != true_times)


def _draw_errors(errors: InitialErrors, flight: LanderFlight, count: int) -> np.ndarray:
    """Draw initial states; return true minus estimated position and velocity, and the attitude error."""
    truth, rng = flight.state(0.0), np.random.default_rng(11)
    rows = []
    for _ in range(count):
        state = errors.draw(truth, 0.0, GRAVITY_M_S2, rng)
        attitude = (truth.attitude * state.world_from_body.inv()).as_rotvec()
        rows.append(
            np.concatenate([truth.position_m - state.position_m, truth.velocity_m_s - state.velocity_m_s, attitude])
        )
    return np.array(rows)


@pytest.mark.parametrize("horizontal_sd_m", [1000.0, 3000.0])
def test_initial_errors_have_the_stated_covariance(flight: LanderFlight, horizontal_sd_m: float) -> None:
    """Chi-square of each component and correlations of 1500 drawn states, also for a strong truncation."""
    count = 1500
    errors = InitialErrors(horizontal_sd_m=horizontal_sd_m, attitude_sd_deg=0.3)
    drawn, covariance = _draw_errors(errors, flight, count), errors.covariance()
    assert np.hypot(drawn[:, 0], drawn[:, 1]).max() < errors.horizontal_max_m
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), drawn.T)
    low, high = (float(chi2.ppf(quantile, count)) for quantile in (1e-5, 1.0 - 1e-5))
    squares = np.sum(whitened**2, axis=1)
    assert np.all((squares > low) & (squares < high))
    correlations = whitened @ whitened.T / count - np.diag(squares) / count
    assert np.abs(correlations).max() < 4.5 / np.sqrt(count)
    # the mean of the normalised squared errors of nine components
    assert np.mean(np.sum(whitened**2, axis=0)) == pytest.approx(9.0, abs=4.5 * np.sqrt(18.0 / count))


def test_truncated_variance_has_its_limits() -> None:
    """Without truncation the variance is sd^2; for a very large sd the position is uniform in a disc: R^2 / 4."""
    assert InitialErrors(horizontal_sd_m=100.0).covariance()[0, 0] == pytest.approx(1e4, rel=1e-12)
    uniform = InitialErrors(horizontal_sd_m=1e6).covariance()
    assert uniform[1, 1] == pytest.approx(3200.0**2 / 4.0, rel=1e-3)
    assert InitialErrors(horizontal_sd_m=0.0).covariance()[0, 0] == 0.0


def test_initial_state_without_errors_is_exact(flight: LanderFlight) -> None:
    """Zero standard deviations give the true state."""
    exact = InitialErrors(horizontal_sd_m=0.0, vertical_sd_m=0.0, velocity_sd_m_s=0.0, attitude_sd_deg=0.0)
    truth = flight.state(0.0)
    state = exact.draw(truth, 0.001, GRAVITY_M_S2, np.random.default_rng(0))
    np.testing.assert_array_equal(state.position_m, truth.position_m)
    np.testing.assert_array_equal(state.velocity_m_s, truth.velocity_m_s)
    assert (state.world_from_body.inv() * truth.attitude).magnitude() < 1e-12
    assert state.time_s == 0.001
