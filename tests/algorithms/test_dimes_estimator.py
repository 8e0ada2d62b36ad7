"""Tests of DIMES on rendered descents with exact truth: noise-free, noisy and invalid inputs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from marsyard.algorithms.dimes import DimesDetails, DimesEstimator, DimesOptions, ValidityCheck, dimes_products
from marsyard.algorithms.dimes.options import IMPROVEMENTS
from marsyard.algorithms.interface import VelocityEstimate, VelocityEstimator, VelocityOutcome
from marsyard.sim.frames import direction
from marsyard.sim.measurements import DescentMeasurements
from tests.algorithms.synthetic_descent import (
    INTERVAL_S,
    Flight,
    compute_body_rays,
    draw_flight,
    draw_stripes,
    draw_terrain,
    expose_scene,
    make_calibration,
    make_measurements,
    make_waves,
    render,
    steady_flight,
    tilt_body,
    trace_scene,
    valid_velocity,
)

#: DIMES with all improvements to the published algorithm.
ESTIMATOR: VelocityEstimator = DimesEstimator(DimesOptions(**IMPROVEMENTS))


def get_details(estimate: VelocityEstimate) -> DimesDetails:
    assert isinstance(estimate.details, DimesDetails)
    return estimate.details


def track_errors(flights: list[Flight], estimates: list[VelocityEstimate], valid_only: bool = True) -> np.ndarray:
    """Compute estimated minus true horizontal velocities of the tracks of all flights, shape (tracks, 2)."""
    return np.array(
        [
            track.velocity_m_s - flight.velocities[track.pair, :2]
            for flight, estimate in zip(flights, estimates, strict=True)
            for track in get_details(estimate).tracks
            if track.valid or not valid_only
        ]
    )


def compute_rms(errors: np.ndarray) -> float:
    """Compute the root mean square length of vectors."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


@pytest.mark.parametrize(
    ("seed", "count", "is_noisy", "max_rms_m_s"),
    [(2024, 6, False, 0.05), pytest.param(2025, 6, True, 0.06, marks=pytest.mark.slow)],
)
def test_velocity_error_is_within_the_requirement(seed: int, count: int, is_noisy: bool, max_rms_m_s: float) -> None:
    # The requirement is 0.15 m/s rms over flat terrain. Aliasing in the binned pixels causes 0.02 m/s (0.015 px).
    rng = np.random.default_rng(seed)
    flights = [draw_flight(rng) for _ in range(count)]
    estimates = [ESTIMATOR.estimate(render(flight, noise=rng if is_noisy else None)) for flight in flights]
    assert [estimate.outcome for estimate in estimates] == [VelocityOutcome.VALID] * count
    errors = [valid_velocity(e) - flight.velocities[1, :2] for e, flight in zip(estimates, flights, strict=True)]
    assert compute_rms(np.array(errors)) < max_rms_m_s
    # at least 90 % of the tracks, two templates in each of two pairs, are valid
    assert len(track_errors(flights, estimates)) >= 0.9 * 4 * count


def test_template_and_match_show_the_same_ground() -> None:
    flight = steady_flight(
        (12.0, -7.0), (tilt_body(3.0, 0.0, 40.0), tilt_body(8.0, 90.0, 120.0), tilt_body(4.0, 200.0, 250.0))
    )
    inputs = render(flight)
    tracks = get_details(ESTIMATOR.estimate(inputs)).tracks
    assert len(tracks) == 4
    for track in tracks:
        ground = []
        for k, pixel in ((track.pair, track.template_pixel), (track.pair + 1, track.match_pixel)):
            _, rays = inputs.images[k].camera.bin(4, 1).rays(pixel[None, :])
            ray = flight.attitudes[k].apply(rays[0])
            ground.append(flight.positions[k] - ray * flight.positions[k, 2] / ray[2])
        # the fit of the peak is biased by up to 0.12 px of 5.6 m; the homography neglects distortion
        np.testing.assert_allclose(ground[0], ground[1], atol=1.0)


def test_subpixel_refinement_reduces_velocity_error() -> None:
    rng = np.random.default_rng(9)
    flights = [draw_flight(rng) for _ in range(4)]
    inputs = [render(flight) for flight in flights]

    def rms_error(options: DimesOptions) -> float:
        estimates = [DimesEstimator(options).estimate(measurements) for measurements in inputs]
        return compute_rms(track_errors(flights, estimates, valid_only=False))

    whole_pixel, fitted = (rms_error(DimesOptions(subpixel=subpixel)) for subpixel in (False, True))
    # Whole pixels: uniform errors of +-0.5 px of 5.6 m and 4.7 m on both axes in 3.75 s are 0.57 m/s rms.
    assert whole_pixel == pytest.approx(0.57, rel=0.4)
    # the bias of the fit, up to 0.12 px on each axis
    assert fitted < 0.18


@pytest.fixture(scope="module")
def measurements() -> DescentMeasurements:
    return render(steady_flight((10.0, 5.0)))


@pytest.fixture(scope="module")
def details(measurements: DescentMeasurements) -> DimesDetails:
    return get_details(ESTIMATOR.estimate(measurements))


def test_altitude_is_propagated_to_image_time(measurements: DescentMeasurements) -> None:
    # The altitudes are measured 0.5 s after the images; the lander descends at 75 m/s.
    later = (replace(a, altitude_m=a.altitude_m - 75.0 * 0.5, time_s=a.time_s + 0.5) for a in measurements.altitudes)
    answer = ESTIMATOR.estimate(replace(measurements, altitudes=tuple(later)))
    np.testing.assert_allclose(valid_velocity(answer), [10.0, 5.0], atol=0.1)


def test_velocity_uses_image_time_tags(measurements: DescentMeasurements) -> None:
    # The first image is at 100 s; all intervals are 1.25 times as long.
    images = tuple(replace(image, time_s=100.0 + 1.25 * (image.time_s - 100.0)) for image in measurements.images)
    altitudes = tuple(replace(a, time_s=image.time_s) for a, image in zip(measurements.altitudes, images, strict=True))
    answer = ESTIMATOR.estimate(replace(measurements, images=images, altitudes=altitudes))
    np.testing.assert_allclose(valid_velocity(answer), [10.0 / 1.25, 5.0 / 1.25], atol=0.1)


def test_velocity_is_correct_from_images_without_summed_rows() -> None:
    flight = steady_flight((12.0, -7.0))
    detector = replace(
        make_calibration(), rows_summed=1, flat_field=np.repeat(make_calibration().flat_field, 4, axis=0)
    )
    counts = [
        expose_scene(trace_scene(draw_terrain(), a, p), detector)
        for a, p in zip(flight.attitudes, flight.positions, strict=True)
    ]
    answer = ESTIMATOR.estimate(make_measurements(flight, counts, detector))
    np.testing.assert_allclose(valid_velocity(answer), [12.0, -7.0], atol=0.1)


#: Attitudes that tilt by 19 deg to opposite sides: the overlap of two images is about 240 m wide, less than a complete
#: search window of 456 m.
TILTED_APART = (tilt_body(19.0, 0.0, 0.0), tilt_body(19.0, 180.0, 0.0), tilt_body(19.0, 0.0, 0.0))


def test_velocity_is_estimated_without_complete_search_windows() -> None:
    answer = ESTIMATOR.estimate(render(steady_flight((6.0, -9.0), TILTED_APART)))
    np.testing.assert_allclose(valid_velocity(answer), [6.0, -9.0], atol=0.2)
    tracks = get_details(answer).tracks
    # positions where the second image does not show the complete template
    assert all((track.surface == -1.0).any() for track in tracks)


def test_match_outside_the_second_image_is_rejected() -> None:
    # At 30 m/s along the strip's width, features move by up to 112 m, out of the second image of one of both pairs.
    for velocity in ((29.0, 0.0), (-29.0, 0.0)):
        tracks = get_details(ESTIMATOR.estimate(render(steady_flight(velocity, TILTED_APART)))).tracks
        is_wrong = [np.hypot(*(track.velocity_m_s - velocity)) > 2.0 for track in tracks]
        assert any(is_wrong)
        assert not any(track.valid for track, wrong in zip(tracks, is_wrong, strict=True) if wrong)


def test_featureless_terrain_has_no_contrast() -> None:
    answer = ESTIMATOR.estimate(render(steady_flight((10.0, 0.0)), draw_terrain(3, 0.0), np.random.default_rng(4)))
    assert answer.outcome is VelocityOutcome.NO_VALID_TRACK
    assert answer.velocity_m_s is None
    tracks = get_details(answer).tracks
    assert len(tracks) == 4
    assert all(ValidityCheck.CONTRAST in track.failed for track in tracks)


@pytest.mark.parametrize("wavelength_m", [45.0, 80.0])
def test_repetitive_terrain_is_rejected_by_second_peak(wavelength_m: float) -> None:
    answer = ESTIMATOR.estimate(render(steady_flight((10.0, 5.0)), make_waves(wavelength_m), np.random.default_rng(4)))
    assert answer.outcome is VelocityOutcome.NO_VALID_TRACK
    assert all(ValidityCheck.SECOND_PEAK in track.failed for track in get_details(answer).tracks)


def test_disagreement_with_imu_rejects_the_velocity(measurements: DescentMeasurements) -> None:
    velocities = measurements.interval_velocities_m_s + np.array([[0.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    answer = ESTIMATOR.estimate(replace(measurements, interval_velocities_m_s=velocities))
    assert answer.outcome is VelocityOutcome.IMU_MISMATCH
    assert get_details(answer).selected is None
    assert get_details(answer).combinations[0].discrepancy_m_s == pytest.approx(10.0, abs=0.4)


#: Function of the number and the counts of an image that returns new counts.
ChangeCounts = Callable[[int, np.ndarray], np.ndarray]


def _change_counts(inputs: DescentMeasurements, change: ChangeCounts) -> DescentMeasurements:
    """Replace the counts of each image by `change(number of the image, counts)`."""
    images = (replace(image, counts=change(number, image.counts.copy())) for number, image in enumerate(inputs.images))
    return replace(inputs, images=tuple(images))


def _draw_random_counts(number: int, counts: np.ndarray) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 4096, counts.shape, dtype=np.uint16)


@pytest.mark.parametrize(
    "change",
    [
        lambda number, counts: np.zeros_like(counts),
        lambda number, counts: np.full_like(counts, 4095),
        lambda number, counts: np.full_like(counts, 65535),
        _draw_random_counts,
        lambda number, counts: counts if number else np.zeros_like(counts),
        lambda number, counts: draw_stripes(counts),
        lambda number, counts: np.full_like(counts, number),
    ],
)
def test_unusable_images_give_no_velocity(measurements: DescentMeasurements, change: ChangeCounts) -> None:
    answer = ESTIMATOR.estimate(_change_counts(measurements, change))
    assert answer.outcome is not VelocityOutcome.VALID
    assert answer.velocity_m_s is None
    dimes_products(get_details(answer))


@pytest.mark.parametrize("altitude_m", [1e-300, 3.0, 120.0, 2e4, 1e300, -10.0, np.nan])
def test_wrong_altitude_gives_no_velocity(measurements: DescentMeasurements, altitude_m: float) -> None:
    altitudes = tuple(replace(a, altitude_m=altitude_m) for a in measurements.altitudes)
    answer = ESTIMATOR.estimate(replace(measurements, altitudes=altitudes))
    assert answer.outcome is not VelocityOutcome.VALID


def test_wrong_attitude_gives_no_velocity(measurements: DescentMeasurements) -> None:
    random = Rotation.random(3 * 6, rng=np.random.default_rng(5))
    for k in range(6):
        attitudes = tuple(replace(a, world_from_body=random[3 * k + i]) for i, a in enumerate(measurements.attitudes))
        assert ESTIMATOR.estimate(replace(measurements, attitudes=attitudes)).outcome is not VelocityOutcome.VALID
    looking_up = tuple(replace(a, world_from_body=tilt_body(180.0, 0.0, 0.0)) for a in measurements.attitudes)
    assert ESTIMATOR.estimate(replace(measurements, attitudes=looking_up)).outcome is VelocityOutcome.NO_TEMPLATE_AREA


@pytest.mark.parametrize(
    "times", [(0.0, 0.0, 0.0), (2.0, 1.0, 0.0), (0.0, 1e9, 2e9), (0.0, np.nan, 1.0), (0.0, 60.0, 120.0)]
)
def test_wrong_times_give_no_template_area(
    measurements: DescentMeasurements, times: tuple[float, float, float]
) -> None:
    images = tuple(replace(image, time_s=t) for image, t in zip(measurements.images, times, strict=True))
    altitudes = tuple(replace(a, time_s=t) for a, t in zip(measurements.altitudes, times, strict=True))
    answer = ESTIMATOR.estimate(replace(measurements, images=images, altitudes=altitudes))
    assert answer.outcome is VelocityOutcome.NO_TEMPLATE_AREA


@pytest.mark.parametrize(
    "sun", [np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.full(3, np.nan)]
)
def test_any_sun_gives_a_velocity_or_no_template_area(measurements: DescentMeasurements, sun: np.ndarray) -> None:
    answer = ESTIMATOR.estimate(replace(measurements, sun_direction=sun))
    assert answer.outcome in (VelocityOutcome.VALID, VelocityOutcome.NO_TEMPLATE_AREA)


def test_zero_phase_spot_of_an_image_follows_from_its_sun(measurements: DescentMeasurements) -> None:
    suns = np.stack([direction(np.radians(azimuth), np.radians(80.0)) for azimuth in (90.0, 120.0, 150.0)])
    moving = get_details(ESTIMATOR.estimate(replace(measurements, sun_directions=suns)))
    fixed = [get_details(ESTIMATOR.estimate(replace(measurements, sun_direction=sun))) for sun in suns]
    for pair in (0, 1):
        for image in (0, 1):
            expected = fixed[pair + image].pairs[pair].zero_phase_pixels[image]
            np.testing.assert_array_equal(moving.pairs[pair].zero_phase_pixels[image], expected)


def test_velocity_is_correct_with_one_corrupted_template_per_pair() -> None:
    rng = np.random.default_rng(12)
    flight = draw_flight(rng, max_tilt_deg=10.0)
    inputs = render(flight)
    reference = get_details(ESTIMATOR.estimate(inputs))
    dust_pixels = {t.pair: t.template_pixel for t in reference.tracks if t.index == 0}

    def add_dust(number: int, counts: np.ndarray) -> np.ndarray:
        # Dust that is not in the flat field covers the best template of the earlier image of each pair.
        if number in dust_pixels:
            u, v = (round(float(x)) for x in dust_pixels[number])
            counts[max(v - 9, 0) : v + 10, max(4 * (u - 9), 0) : 4 * (u + 10)] = 3000 if (u + v) % 2 else 4000
        return counts

    answer = ESTIMATOR.estimate(_change_counts(inputs, add_dust))
    assert not all(track.valid for track in get_details(answer).tracks)
    assert answer.outcome is VelocityOutcome.VALID
    np.testing.assert_allclose(valid_velocity(answer), flight.velocities[1, :2], atol=0.3)


def test_opposition_surge_does_not_bias_velocity() -> None:
    """An opposition surge, a bright spot around the anti-solar point, moves over the ground with the lander.

    It is a Gaussian with an amplitude of 30 % and a standard deviation of 3 deg.
    """
    sun = direction(np.radians(250.0), np.radians(75.0))
    attitudes = (tilt_body(5.0, 0.0, 40.0), tilt_body(8.0, 90.0, 120.0), tilt_body(4.0, 200.0, 250.0))
    flight = replace(steady_flight((25.0, -10.0), attitudes), sun=sun)
    low_contrast = draw_terrain(7, 0.02)
    counts = []
    for attitude, position in zip(flight.attitudes, flight.positions, strict=True):
        phase = np.arccos(np.clip(np.tensordot(attitude.inv().apply(-sun), compute_body_rays(), 1), -1.0, 1.0))
        surge = 1.0 + 0.3 * np.exp(-0.5 * (phase / np.radians(3.0)) ** 2)
        counts.append(expose_scene(trace_scene(low_contrast, attitude, position) * surge, make_calibration()))
    inputs = make_measurements(flight, counts, make_calibration())
    answer = ESTIMATOR.estimate(inputs)
    assert answer.outcome is VelocityOutcome.VALID
    np.testing.assert_allclose(valid_velocity(answer), flight.velocities[1, :2], atol=0.6)
    # Without a mask the templates are at the surge, which has the highest contrast. Its distance from the nadir
    # decreases with altitude. The apparent velocity is the descent rate times the cotangent of the sun's elevation.
    apparent_velocity = -75.0 * sun[:2] / sun[2]
    unmasked = get_details(DimesEstimator(DimesOptions(**IMPROVEMENTS, zero_phase_radius_rad=0.0)).estimate(inputs))
    assert np.hypot(*(apparent_velocity - flight.velocities[1, :2])) > 10.0
    assert min(np.hypot(*(t.velocity_m_s - apparent_velocity)) for t in unmasked.tracks) < 5.0


def test_products_contain_the_keys_used_by_reports(details: DimesDetails) -> None:
    products = dimes_products(details)
    assert products["tracks_columns"] == [
        "pair", "template", "template_u", "template_v", "match_u", "match_v", "contrast", "peak", "peak_width",
        "second_peak_ratio", "valid", "velocity_east_m_s", "velocity_north_m_s", "ground_east_m", "ground_north_m",
        "failed_contrast", "failed_peak_height", "failed_peak_width", "failed_second_peak", "failed_search_border",
    ]  # fmt: skip
    assert products["tracks"].shape == (4, 20)
    np.testing.assert_array_equal(products["tracks"][:, 0], [0, 0, 1, 1])
    for track in details.tracks:
        name = f"{track.pair}_{track.index}"
        template, window, match = (products[f"{kind}_{name}"] for kind in ("template", "window", "match"))
        row, column = np.rint(match).astype(int)
        half = len(template) // 2
        result = window[row - half : row + half + 1, column - half : column + half + 1]
        assert np.corrcoef(result.ravel(), template.ravel())[0, 1] > 0.8
    assert products["combinations"].shape == (4, 3)
    assert products["overlap_0"].shape[1] == 2
    assert all(isinstance(value, np.ndarray | list) for value in products.values())


def test_products_report_failures_and_selection(measurements: DescentMeasurements, details: DimesDetails) -> None:
    products = dimes_products(details)
    np.testing.assert_array_equal(products["selected"], [details.selected.first, details.selected.second])
    uniform = _change_counts(measurements, lambda number, counts: np.full_like(counts, 1000))
    products = dimes_products(get_details(ESTIMATOR.estimate(uniform)))
    assert products["selected"].size == 0
    column = products["tracks_columns"].index("failed_contrast")
    np.testing.assert_array_equal(products["tracks"][:, column], 1.0)


def test_rectified_lattice_matches_track_pixels(details: DimesDetails) -> None:
    products = dimes_products(details)
    for track in details.tracks:
        west, north, step = products[f"rectified_frame_{track.pair}"]
        motion_m = track.velocity_m_s * INTERVAL_S
        for side, ground, pixel in (
            (0, track.ground_m, track.template_pixel),
            (1, track.ground_m - motion_m, track.match_pixel),
        ):
            column, row = (ground[0] - west) / step, (north - ground[1]) / step
            pixels = products[f"rectified_{track.pair}_{side}"]
            result = [ndimage.map_coordinates(pixels[..., k], [[row], [column]], order=3)[0] for k in (0, 1)]
            np.testing.assert_allclose(result, pixel, atol=0.1)


def test_altitude_error_causes_predicted_velocity_error() -> None:
    """An altitude error e of the third image displaces a feature at distance r from its nadir by e r / H."""
    attitudes = (tilt_body(3.0, 0.0, 0.0), tilt_body(5.0, 90.0, 0.0), tilt_body(4.0, 200.0, 0.0))
    flight = steady_flight((8.0, 3.0), attitudes)
    inputs = render(flight)
    error = 10.0
    wrong = replace(inputs.altitudes[2], altitude_m=inputs.altitudes[2].altitude_m + error)
    answer = ESTIMATOR.estimate(replace(inputs, altitudes=(*inputs.altitudes[:2], wrong)))
    tracks = [track for track in get_details(answer).tracks if track.pair == 1]
    assert len(tracks) == 2
    later = flight.positions[2, 2]
    for track in tracks:
        _, rays = inputs.images[2].camera.bin(4, 1).rays(track.match_pixel[None, :])
        ray = flight.attitudes[2].apply(rays[0])
        position = ray[:2] / -ray[2] * later
        expected = -error / later * position / INTERVAL_S
        np.testing.assert_allclose(track.velocity_m_s - flight.velocities[1, :2], expected, atol=0.18)
