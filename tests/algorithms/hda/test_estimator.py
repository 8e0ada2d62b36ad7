"""Tests of the complete hazard detection on exact scenes: site, map coordinates and failures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import (
    Ground,
    HdaDetails,
    HdaEstimator,
    HdaOptions,
    Motion,
    Safety,
    SurfaceFrame,
    TrackSeed,
    hda_products,
)
from marsyard.algorithms.hda.baselines import EssentialMatrixEstimator, SemiGlobalEstimator
from marsyard.algorithms.interface import SiteEstimate, SiteEstimator, SiteOutcome
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import LandingMeasurements, PoseMeasurement
from tests.algorithms.hda.relief_scene import Pass, make_bumps, measure_pass, plane, pose, render_image

#: Options for images of 320 x 240 pixels; a lander of 1 m diameter among boulders of 0.3 m.
OPTIONS = HdaOptions(
    block_px=32, grid_px=4, lander_diameter_m=1.0, max_roughness_m=0.12, max_slope_rad=float(np.deg2rad(12.0))
)
#: Boulders in the left half of the image; the ground on the right is clear.
BOULDERS = ((-1.2, 1.5, 0.35, 0.12), (1.6, 1.6, 0.35, 0.12), (0.3, 0.6, 0.35, 0.12), (-2.0, 0.3, 0.35, 0.12))
ESTIMATORS: dict[str, Callable[[HdaOptions], SiteEstimator]] = {
    "hda": HdaEstimator,
    "essential": EssentialMatrixEstimator,
    "semi-global": SemiGlobalEstimator,
}
each = pytest.mark.parametrize("name", ESTIMATORS)


def make_pass(base: tuple[float, float] = (0.03, 0.02), rocks: tuple[tuple[float, ...], ...] = BOULDERS) -> Pass:
    relief = make_bumps(*rocks, base=plane(*base))  # type: ignore[arg-type]
    return Pass(relief, (pose(0.0, 0.0, 10.0, 5.0, 1.0, -2.0), pose(0.1, -0.75, 10.1, 7.0, 2.0, -1.0)))


@pytest.fixture(scope="module")
def scene() -> Pass:
    return make_pass()


@pytest.fixture(scope="module")
def measurements(scene: Pass) -> LandingMeasurements:
    return measure_pass(scene)


@pytest.fixture(scope="module")
def answer(measurements: LandingMeasurements) -> SiteEstimate:
    return HdaEstimator(OPTIONS).estimate(measurements)


def details_of(answer: SiteEstimate) -> HdaDetails:
    assert isinstance(answer.details, HdaDetails)
    return answer.details


def ground_of(answer: SiteEstimate) -> Ground:
    ground = details_of(answer).ground
    assert ground is not None
    return ground


def motion_of(answer: SiteEstimate) -> Motion:
    motion = details_of(answer).motion
    assert motion is not None
    return motion


def site_of(answer: SiteEstimate) -> np.ndarray:
    assert answer.site_world is not None
    return answer.site_world


def map_errors(scene: Pass, answer: SiteEstimate) -> np.ndarray:
    """Elevation errors at known cells, metres, from the exact pose of the first camera."""
    result = ground_of(answer)
    cells = np.argwhere(~np.isnan(result.elevation.elevation_m))
    z = result.elevation.elevation_m[tuple(cells.T)]
    points = np.column_stack([result.elevation.positions(cells.astype(np.float64)), z])
    world = scene.camera(0).c + result.world_from_surface.apply(points)
    return np.asarray(world[:, 2] - scene.height(world[:, 0], world[:, 1]))


def true_safe(scene: Pass, x: float, y: float) -> bool:
    """Whether a position is at least one lander radius and two boulder radii away from each boulder."""
    return all(np.hypot(x - cx, y - cy) > 0.5 + 2.0 * radius for cx, cy, _, radius in BOULDERS)


@each
def test_site_is_on_the_ground_and_clear_of_boulders(name: str, scene: Pass, measurements: LandingMeasurements) -> None:
    result = ESTIMATORS[name](OPTIONS).estimate(measurements)
    assert result.outcome is SiteOutcome.SAFE_SITE
    assert result.site_world is not None
    x, y, z = result.site_world
    assert true_safe(scene, x, y)
    # The smoothed elevation is accurate to half a percent of the height.
    assert z == pytest.approx(float(scene.height(np.array(x), np.array(y))), abs=0.05)
    assert ground_of(result).hazards.safety[ground_of(result).site_cell] == Safety.SAFE


def test_motion_and_map_match_exact_pair(scene: Pass, answer: SiteEstimate) -> None:
    # Required accuracy: 0.05 deg, 1 % of the baseline, half a percent of the height.
    motion = motion_of(answer)
    true = scene.second_from_first
    assert np.rad2deg((motion.second_from_first.rotation * true.rotation.inv()).magnitude()) < 0.05
    miss = np.linalg.norm(motion.second_from_first.translation - true.translation)
    assert miss < 0.01 * np.linalg.norm(true.translation)
    errors = map_errors(scene, answer)
    assert np.sqrt(np.mean(errors**2)) < 0.005 * 10.0
    assert abs(np.median(errors)) < 0.02


def test_each_boulder_is_a_hazard(scene: Pass, answer: SiteEstimate) -> None:
    result = ground_of(answer)
    for x, y, _, _ in BOULDERS:
        offset = np.array([x, y, float(scene.height(np.array(x), np.array(y)))]) - scene.camera(0).c
        row, column = np.rint(result.elevation.cells(result.world_from_surface.inv().apply(offset)[:2])).astype(int)
        assert result.hazards.safety[row, column] == Safety.HAZARD
        near = result.hazards.roughness_m[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        # A boulder of 0.35 m height and 0.12 m (1 sigma) width exceeds the threshold over three cells.
        assert np.nanmax(near) > OPTIONS.max_roughness_m


def test_too_steep_ground_has_no_safe_site() -> None:
    steep = measure_pass(make_pass((0.3, 0.0), ()))
    result = HdaEstimator(OPTIONS).estimate(steep)
    assert result.outcome is SiteOutcome.NO_SAFE_SITE
    assert result.outcome.converged
    assert result.site_world is None
    assert np.rad2deg(np.nanmedian(ground_of(result).hazards.slope_rad)) == pytest.approx(16.7, abs=0.5)


def test_gravity_from_fitted_plane_removes_mean_slope() -> None:
    steep = measure_pass(make_pass((0.3, 0.0), ()))
    frame = replace(OPTIONS, surface_frame=SurfaceFrame.PLANE)
    result = HdaEstimator(frame).estimate(steep)
    assert result.outcome is SiteOutcome.SAFE_SITE
    ground = ground_of(result)
    first = details_of(result).views[0]
    normal = (first.world_from_camera.rotation * ground.surface_from_camera.inv()).apply(np.array([0.0, 0.0, 1.0]))
    # Independent matches would give 0.01 deg (3,000 points, 2 cm of noise, 7 m). Neighbouring matches are correlated.
    assert np.rad2deg(np.arccos(normal @ np.array([-0.3, 0.0, 1.0]) / np.hypot(0.3, 1.0))) < 0.2


def test_gravity_from_inclinometers_or_state(measurements: LandingMeasurements) -> None:
    leaning = replace(measurements, up_body=Rotation.from_rotvec([0.0, 0.1, 0.0]).apply(measurements.up_body))
    slopes = {}
    for frame in (SurfaceFrame.INCLINOMETER, SurfaceFrame.STATE):
        result = HdaEstimator(replace(OPTIONS, surface_frame=frame)).estimate(leaning)
        slopes[frame] = float(np.nanmedian(ground_of(result).hazards.slope_rad))
    assert slopes[SurfaceFrame.STATE] == pytest.approx(np.arctan(np.hypot(0.03, 0.02)), abs=0.005)
    assert abs(slopes[SurfaceFrame.INCLINOMETER] - slopes[SurfaceFrame.STATE]) > 0.05


def test_sites_are_reported_in_map_coordinates(measurements: LandingMeasurements, answer: SiteEstimate) -> None:
    # The same images in a rotated and translated world: the site is transformed in the same way.
    moved = rigid(Rotation.from_euler("z", 130.0, degrees=True), np.array([500.0, -200.0, 30.0]))
    poses = tuple(PoseMeasurement(moved * one.world_from_body, one.time_s) for one in measurements.poses)
    result = HdaEstimator(OPTIONS).estimate(
        replace(
            measurements, poses=(poses[0], poses[1]), apriori_site_world=moved.apply(measurements.apriori_site_world)
        )
    )
    np.testing.assert_allclose(site_of(result), moved.apply(site_of(answer)), atol=1e-6)


def test_position_error_shifts_the_site_equally(measurements: LandingMeasurements, answer: SiteEstimate) -> None:
    shift = np.array([1.5, -0.7, 0.2])
    poses = tuple(
        PoseMeasurement(rigid(Rotation.identity(), shift) * one.world_from_body, one.time_s)
        for one in measurements.poses
    )
    # The a-priori site comes from map data and only breaks ties.
    result = HdaEstimator(OPTIONS).estimate(replace(measurements, poses=(poses[0], poses[1])))
    np.testing.assert_allclose(site_of(result), site_of(answer) + shift, atol=1e-6)


@each
def test_estimate_is_deterministic(name: str, measurements: LandingMeasurements) -> None:
    first, second = (ESTIMATORS[name](OPTIONS).estimate(measurements) for _ in range(2))
    np.testing.assert_array_equal(first.site_world, second.site_world)
    for key, value in hda_products(details_of(first)).items():
        np.testing.assert_array_equal(hda_products(details_of(second))[key], value)


def is_apriori_site(result: SiteEstimate, inputs: LandingMeasurements) -> bool:
    """Whether only the a-priori site is reported."""
    assert not result.outcome.converged
    return result.site_world is not None and np.array_equal(result.site_world, inputs.apriori_site_world)


@each
@pytest.mark.parametrize("range_m", [np.nan, np.inf, 0.0, -3.0])
def test_invalid_range_prevents_convergence(name: str, range_m: float, measurements: LandingMeasurements) -> None:
    result = ESTIMATORS[name](OPTIONS).estimate(replace(measurements, slant_range_m=range_m))
    assert result.outcome is SiteOutcome.NO_RANGE
    assert is_apriori_site(result, measurements)


def replace_image(inputs: LandingMeasurements, which: int, counts: np.ndarray) -> LandingMeasurements:
    images = list(inputs.images)
    images[which] = replace(images[which], counts=counts)
    return replace(inputs, images=(images[0], images[1]))


@each
@pytest.mark.parametrize("level", [0, 1500, 4095])
def test_uniform_first_image_has_no_features(name: str, level: int, measurements: LandingMeasurements) -> None:
    flat = np.full((240, 320), level, dtype=np.uint16)
    result = ESTIMATORS[name](OPTIONS).estimate(replace_image(measurements, 0, flat))
    assert result.outcome is SiteOutcome.NO_FEATURES
    assert is_apriori_site(result, measurements)


@each
@pytest.mark.parametrize("seed", [None, 3])
def test_unrelated_second_image_has_no_tracks(name: str, seed: int | None, measurements: LandingMeasurements) -> None:
    other = np.full((240, 320), 1500, dtype=np.uint16)
    if seed is not None:
        other = np.random.default_rng(seed).integers(0, 4096, (240, 320)).astype(np.uint16)
    result = ESTIMATORS[name](OPTIONS).estimate(replace_image(measurements, 1, other))
    assert result.outcome is SiteOutcome.NO_TRACKS
    assert is_apriori_site(result, measurements)


def test_zero_baseline_is_reported(measurements: LandingMeasurements) -> None:
    static = replace(
        replace_image(measurements, 1, measurements.images[0].counts),
        poses=(measurements.poses[0], measurements.poses[0]),
    )
    result = HdaEstimator(OPTIONS).estimate(static)
    assert result.outcome is SiteOutcome.NO_BASELINE
    assert is_apriori_site(result, static)


def test_pure_rotation_is_reported() -> None:
    # The rotation is about the camera centre, which is at (0.3, 0, -0.1) in the body.
    first = pose(0.0, 0.0, 10.0, 5.0)
    turn = Rotation.from_euler("zyx", [3.0, 2.0, -2.0], degrees=True)
    centre = np.array([0.3, 0.0, -0.1])
    second = first * rigid(turn, centre - turn.apply(centre))
    rotated = measure_pass(Pass(make_pass().height, (first, second)), np.random.default_rng(2))
    result = HdaEstimator(OPTIONS).estimate(rotated)
    assert result.outcome is SiteOutcome.NO_BASELINE
    assert is_apriori_site(result, rotated)


def test_independently_moving_blocks_give_no_motion(measurements: LandingMeasurements) -> None:
    # Each block of the first image is shifted differently: tracks are sharp, but no rigid motion fits all of them.
    rng = np.random.default_rng(4)
    source = measurements.images[0].counts
    second = source.copy()
    for row in range(0, 240, 60):
        for column in range(0, 320, 64):
            part = np.roll(source, rng.integers(-15, 16, 2), axis=(0, 1))
            second[row : row + 60, column : column + 64] = part[row : row + 60, column : column + 64]
    result = HdaEstimator(OPTIONS).estimate(replace_image(measurements, 1, second))
    assert result.outcome is SiteOutcome.NO_MOTION
    assert is_apriori_site(result, measurements)


def test_too_few_points_give_no_map(measurements: LandingMeasurements) -> None:
    result = HdaEstimator(replace(OPTIONS, min_points=100_000)).estimate(measurements)
    assert result.outcome is SiteOutcome.NO_STRUCTURE
    assert is_apriori_site(result, measurements)


@each
def test_any_image_gives_an_estimate(name: str, measurements: LandingMeasurements) -> None:
    rng = np.random.default_rng(5)
    chequers = (np.indices((240, 320)).sum(axis=0) // 8 % 2 * 4095).astype(np.uint16)
    bars = np.tile((np.arange(320) // 10 % 2 * 4095).astype(np.uint16), (240, 1))
    noise = rng.integers(0, 4096, (240, 320)).astype(np.uint16)
    for paint in (chequers, bars, noise):
        result = ESTIMATORS[name](OPTIONS).estimate(replace_image(replace_image(measurements, 0, paint), 1, paint))
        assert isinstance(result.outcome, SiteOutcome)


def test_poses_can_predict_feature_positions(scene: Pass) -> None:
    # A baseline of 1.5 m moves the ground by at least 60 px, beyond the search window without a prediction.
    wide = Pass(scene.height, (scene.poses[0], pose(0.1, -1.5, 10.1, 7.0, 2.0, -1.0)))
    inputs = measure_pass(wide)
    seeded = HdaEstimator(replace(OPTIONS, track_seed=TrackSeed.POSE)).estimate(inputs)
    assert seeded.outcome.converged
    assert motion_of(seeded).parallax_px > 50.0
    errors = map_errors(wide, seeded)
    assert np.sqrt(np.mean(errors**2)) < 0.005 * 10.0
    assert not HdaEstimator(OPTIONS).estimate(inputs).outcome.converged


def test_image_size_must_match_camera(measurements: LandingMeasurements) -> None:
    with pytest.raises(ValueError, match=r"rows, columns.*\(120, 160\), its camera \(240, 320\)"):
        HdaEstimator(OPTIONS).estimate(replace_image(measurements, 0, measurements.images[0].counts[:120, :160]))


def test_products_contain_figure_data(scene: Pass, measurements: LandingMeasurements, answer: SiteEstimate) -> None:
    products = hda_products(details_of(answer))
    accepted = products["tracks_accepted"]
    assert products["sparse_points"].shape == (accepted.sum(), 3)
    # The points of Fig. 2 are on the ground at the pixels of the tracks.
    truth = scene.ground(0, products["features"][accepted])
    one = scene.camera(0)
    misses = products["sparse_points"][:, 2] - (truth - one.c) @ one.a
    assert products["inliers"].mean() > 0.9
    # Aligned tracks with a parallax of 33 px at 10 m: 0.1 m is a third of a pixel.
    assert np.max(np.abs(misses[products["inliers"]])) < 0.1
    assert products["grid"].shape == products["segment_ends"].shape == products["matched"].shape
    # Fig. 7: cells project to the pixels that show them.
    row, column = products["site"].astype(int)
    observed = scene.ground(0, products["map_pixels"][row, column][None])[0]
    np.testing.assert_allclose(observed[:2], site_of(answer)[:2], atol=0.05)
    # Products of stages that did not run are absent.
    blind = HdaEstimator(OPTIONS).estimate(replace(measurements, slant_range_m=np.nan))
    assert hda_products(details_of(blind)) == {}


def test_map_does_not_depend_on_image_brightness(scene: Pass, measurements: LandingMeasurements) -> None:
    darker = measurements
    for which in (0, 1):
        darker = replace_image(darker, which, (measurements.images[which].counts // 4).astype(np.uint16))
    errors = map_errors(scene, HdaEstimator(OPTIONS).estimate(darker))
    assert np.sqrt(np.mean(errors**2)) < 0.005 * 10.0


def test_dropped_frame_repeats_the_first_image(measurements: LandingMeasurements) -> None:
    # The second image equals the first, but the poses differ.
    repeated = replace_image(measurements, 1, measurements.images[0].counts)
    result = HdaEstimator(OPTIONS).estimate(repeated)
    assert result.outcome is SiteOutcome.NO_BASELINE


def test_map_tolerates_detector_noise(scene: Pass) -> None:
    rng = np.random.default_rng(6)
    noisy = [render_image(scene, which, rng) for which in (0, 1)]
    inputs = measure_pass(scene)
    result = HdaEstimator(OPTIONS).estimate(replace(inputs, images=(noisy[0], noisy[1])))
    clean = HdaEstimator(OPTIONS).estimate(inputs)
    spread = [float(np.std(map_errors(scene, one))) for one in (clean, result)]
    assert spread[1] < 1.3 * spread[0]
