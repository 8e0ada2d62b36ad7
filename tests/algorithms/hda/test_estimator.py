"""The whole of hazard detection on exact scenes: the right site, in map coordinates, and every way to fail."""

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
from tests.algorithms.hda.relief_scene import Pass, bumps, measured, picture, plane, pose

#: For pictures of 320 x 240; a lander of 1 m beside boulders of 0.3 m.
OPTIONS = HdaOptions(
    block_px=32, grid_px=4, lander_diameter_m=1.0, max_roughness_m=0.12, max_slope_rad=float(np.deg2rad(12.0))
)
#: Boulders on the left half of the view; the ground on the right is clear.
BOULDERS = ((-1.2, 1.5, 0.35, 0.12), (1.6, 1.6, 0.35, 0.12), (0.3, 0.6, 0.35, 0.12), (-2.0, 0.3, 0.35, 0.12))
ESTIMATORS: dict[str, Callable[[HdaOptions], SiteEstimator]] = {
    "hda": HdaEstimator,
    "essential": EssentialMatrixEstimator,
    "semi-global": SemiGlobalEstimator,
}
each = pytest.mark.parametrize("name", ESTIMATORS)


def flown(base: tuple[float, float] = (0.03, 0.02), rocks: tuple[tuple[float, ...], ...] = BOULDERS) -> Pass:
    relief = bumps(*rocks, base=plane(*base))  # type: ignore[arg-type]
    return Pass(relief, (pose(0.0, 0.0, 10.0, 5.0, 1.0, -2.0), pose(0.1, -0.75, 10.1, 7.0, 2.0, -1.0)))


@pytest.fixture(scope="module")
def scene() -> Pass:
    return flown()


@pytest.fixture(scope="module")
def exact(scene: Pass) -> LandingMeasurements:
    return measured(scene)


@pytest.fixture(scope="module")
def answer(exact: LandingMeasurements) -> SiteEstimate:
    return HdaEstimator(OPTIONS).estimate(exact)


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
    """Elevation less truth at every known cell, metres, by the exact pose of the first camera."""
    found = ground_of(answer)
    cells = np.argwhere(~np.isnan(found.elevation.elevation_m))
    z = found.elevation.elevation_m[tuple(cells.T)]
    points = np.column_stack([found.elevation.places(cells.astype(np.float64)), z])
    world = scene.camera(0).c + found.world_from_surface.apply(points)
    return np.asarray(world[:, 2] - scene.height(world[:, 0], world[:, 1]))


def true_safe(scene: Pass, x: float, y: float) -> bool:
    """No boulder within a lander's radius (and two of a boulder's) of a place."""
    return all(np.hypot(x - cx, y - cy) > 0.5 + 2.0 * radius for cx, cy, _, radius in BOULDERS)


@each
def test_the_site_is_on_the_ground_and_clear_of_boulders(name: str, scene: Pass, exact: LandingMeasurements) -> None:
    found = ESTIMATORS[name](OPTIONS).estimate(exact)
    assert found.outcome is SiteOutcome.SAFE_SITE
    assert found.site_world is not None
    x, y, z = found.site_world
    assert true_safe(scene, x, y)
    # Smooth elevation: half a percent of the height.
    assert z == pytest.approx(float(scene.height(np.array(x), np.array(y))), abs=0.05)
    assert ground_of(found).hazards.safety[ground_of(found).site_cell] == Safety.SAFE


def test_motion_and_map_of_an_exact_pair(scene: Pass, answer: SiteEstimate) -> None:
    # Issue 6, bar 1: 0.05 deg, 1 % of the baseline, half a percent of the height.
    motion = motion_of(answer)
    true = scene.second_from_first
    assert np.rad2deg((motion.second_from_first.rotation * true.rotation.inv()).magnitude()) < 0.05
    miss = np.linalg.norm(motion.second_from_first.translation - true.translation)
    assert miss < 0.01 * np.linalg.norm(true.translation)
    errors = map_errors(scene, answer)
    assert np.sqrt(np.mean(errors**2)) < 0.005 * 10.0
    assert abs(np.median(errors)) < 0.02


def test_every_boulder_is_a_hazard(scene: Pass, answer: SiteEstimate) -> None:
    found = ground_of(answer)
    for x, y, _, _ in BOULDERS:
        offset = np.array([x, y, float(scene.height(np.array(x), np.array(y)))]) - scene.camera(0).c
        row, column = np.rint(found.elevation.cells(found.world_from_surface.inv().apply(offset)[:2])).astype(int)
        assert found.hazards.safety[row, column] == Safety.HAZARD
        near = found.hazards.roughness_m[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        # 0.35 m high, 0.12 m wide (1 sigma): three cells across see more than the threshold of it.
        assert np.nanmax(near) > OPTIONS.max_roughness_m


def test_ground_that_is_too_steep_has_no_safe_site() -> None:
    steep = measured(flown((0.3, 0.0), ()))
    found = HdaEstimator(OPTIONS).estimate(steep)
    assert found.outcome is SiteOutcome.NO_SAFE_SITE
    assert found.outcome.converged
    assert found.site_world is None
    assert np.rad2deg(np.nanmedian(ground_of(found).hazards.slope_rad)) == pytest.approx(16.7, abs=0.5)


def test_gravity_from_a_plane_through_the_points_sees_no_mean_slope() -> None:
    steep = measured(flown((0.3, 0.0), ()))
    frame = replace(OPTIONS, surface_frame=SurfaceFrame.PLANE)
    found = HdaEstimator(frame).estimate(steep)
    assert found.outcome is SiteOutcome.SAFE_SITE
    ground = ground_of(found)
    first = details_of(found).views[0]
    normal = (first.world_from_camera.rotation * ground.surface_from_camera.inv()).apply(np.array([0.0, 0.0, 1.0]))
    # 3,000 points of 2 cm noise over 7 m would leave 0.01 deg; matches are not independent of their neighbours.
    assert np.rad2deg(np.arccos(normal @ np.array([-0.3, 0.0, 1.0]) / np.hypot(0.3, 1.0))) < 0.2


def test_gravity_is_the_inclinometers_unless_it_is_the_states(exact: LandingMeasurements) -> None:
    leaning = replace(exact, up_body=Rotation.from_rotvec([0.0, 0.1, 0.0]).apply(exact.up_body))
    slopes = {}
    for frame in (SurfaceFrame.INCLINOMETER, SurfaceFrame.STATE):
        found = HdaEstimator(replace(OPTIONS, surface_frame=frame)).estimate(leaning)
        slopes[frame] = float(np.nanmedian(ground_of(found).hazards.slope_rad))
    assert slopes[SurfaceFrame.STATE] == pytest.approx(np.arctan(np.hypot(0.03, 0.02)), abs=0.005)
    assert abs(slopes[SurfaceFrame.INCLINOMETER] - slopes[SurfaceFrame.STATE]) > 0.05


def test_sites_are_handed_over_in_map_coordinates(exact: LandingMeasurements, answer: SiteEstimate) -> None:
    # The same pictures in a world that is turned and shifted: the site turns and shifts with it.
    moved = rigid(Rotation.from_euler("z", 130.0, degrees=True), np.array([500.0, -200.0, 30.0]))
    poses = tuple(PoseMeasurement(moved * one.world_from_body, one.time_s) for one in exact.poses)
    found = HdaEstimator(OPTIONS).estimate(
        replace(exact, poses=(poses[0], poses[1]), apriori_site_world=moved.apply(exact.apriori_site_world))
    )
    np.testing.assert_allclose(site_of(found), moved.apply(site_of(answer)), atol=1e-6)


def test_a_position_error_moves_the_site_by_as_much(exact: LandingMeasurements, answer: SiteEstimate) -> None:
    shift = np.array([1.5, -0.7, 0.2])
    poses = tuple(
        PoseMeasurement(rigid(Rotation.identity(), shift) * one.world_from_body, one.time_s) for one in exact.poses
    )
    # The a-priori site stays: it is map data, and matters for ties only.
    found = HdaEstimator(OPTIONS).estimate(replace(exact, poses=(poses[0], poses[1])))
    np.testing.assert_allclose(site_of(found), site_of(answer) + shift, atol=1e-6)


@each
def test_the_answer_is_a_function_of_the_measurements(name: str, exact: LandingMeasurements) -> None:
    first, second = (ESTIMATORS[name](OPTIONS).estimate(exact) for _ in range(2))
    np.testing.assert_array_equal(first.site_world, second.site_world)
    for key, value in hda_products(details_of(first)).items():
        np.testing.assert_array_equal(hda_products(details_of(second))[key], value)


def apriori(found: SiteEstimate, given: LandingMeasurements) -> bool:
    """Whether an estimate reports that nothing but the a-priori site is left."""
    assert not found.outcome.converged
    return found.site_world is not None and np.array_equal(found.site_world, given.apriori_site_world)


@each
@pytest.mark.parametrize("range_m", [np.nan, np.inf, 0.0, -3.0])
def test_without_a_range_nothing_converges(name: str, range_m: float, exact: LandingMeasurements) -> None:
    found = ESTIMATORS[name](OPTIONS).estimate(replace(exact, slant_range_m=range_m))
    assert found.outcome is SiteOutcome.NO_RANGE
    assert apriori(found, exact)


def repainted(given: LandingMeasurements, which: int, counts: np.ndarray) -> LandingMeasurements:
    images = list(given.images)
    images[which] = replace(images[which], counts=counts)
    return replace(given, images=(images[0], images[1]))


@each
@pytest.mark.parametrize("level", [0, 1500, 4095])
def test_a_flat_first_picture_has_no_features(name: str, level: int, exact: LandingMeasurements) -> None:
    flat = np.full((240, 320), level, dtype=np.uint16)
    found = ESTIMATORS[name](OPTIONS).estimate(repainted(exact, 0, flat))
    assert found.outcome is SiteOutcome.NO_FEATURES
    assert apriori(found, exact)


@each
@pytest.mark.parametrize("seed", [None, 3])
def test_a_second_picture_of_something_else_has_no_tracks(
    name: str, seed: int | None, exact: LandingMeasurements
) -> None:
    other = np.full((240, 320), 1500, dtype=np.uint16)
    if seed is not None:
        other = np.random.default_rng(seed).integers(0, 4096, (240, 320)).astype(np.uint16)
    found = ESTIMATORS[name](OPTIONS).estimate(repainted(exact, 1, other))
    assert found.outcome is SiteOutcome.NO_TRACKS
    assert apriori(found, exact)


def test_zero_baseline_is_reported(exact: LandingMeasurements) -> None:
    still = replace(repainted(exact, 1, exact.images[0].counts), poses=(exact.poses[0], exact.poses[0]))
    found = HdaEstimator(OPTIONS).estimate(still)
    assert found.outcome is SiteOutcome.NO_BASELINE
    assert apriori(found, still)


def test_a_pure_rotation_is_reported() -> None:
    # About the camera's centre, or the camera would move: its place in the body is (0.3, 0, -0.1).
    first = pose(0.0, 0.0, 10.0, 5.0)
    turn = Rotation.from_euler("zyx", [3.0, 2.0, -2.0], degrees=True)
    centre = np.array([0.3, 0.0, -0.1])
    second = first * rigid(turn, centre - turn.apply(centre))
    turned = measured(Pass(flown().height, (first, second)), np.random.default_rng(2))
    found = HdaEstimator(OPTIONS).estimate(turned)
    assert found.outcome is SiteOutcome.NO_BASELINE
    assert apriori(found, turned)


def test_parts_that_move_on_their_own_are_no_motion(exact: LandingMeasurements) -> None:
    # Blocks of the first picture shifted each its own way: tracks are sharp, but no rigid motion has them all.
    rng = np.random.default_rng(4)
    source = exact.images[0].counts
    second = source.copy()
    for row in range(0, 240, 60):
        for column in range(0, 320, 64):
            part = np.roll(source, rng.integers(-15, 16, 2), axis=(0, 1))
            second[row : row + 60, column : column + 64] = part[row : row + 60, column : column + 64]
    found = HdaEstimator(OPTIONS).estimate(repainted(exact, 1, second))
    assert found.outcome is SiteOutcome.NO_MOTION
    assert apriori(found, exact)


def test_too_few_points_make_no_map(exact: LandingMeasurements) -> None:
    found = HdaEstimator(replace(OPTIONS, min_points=100_000)).estimate(exact)
    assert found.outcome is SiteOutcome.NO_STRUCTURE
    assert apriori(found, exact)


@each
def test_any_picture_gives_an_answer(name: str, exact: LandingMeasurements) -> None:
    rng = np.random.default_rng(5)
    chequers = (np.indices((240, 320)).sum(axis=0) // 8 % 2 * 4095).astype(np.uint16)
    bars = np.tile((np.arange(320) // 10 % 2 * 4095).astype(np.uint16), (240, 1))
    noise = rng.integers(0, 4096, (240, 320)).astype(np.uint16)
    for paint in (chequers, bars, noise):
        found = ESTIMATORS[name](OPTIONS).estimate(repainted(repainted(exact, 0, paint), 1, paint))
        assert isinstance(found.outcome, SiteOutcome)


def test_features_can_be_sought_by_the_poses(scene: Pass) -> None:
    # A baseline of 1.5 m moves the ground by 60 px and more: out of the window without the poses.
    wide = Pass(scene.height, (scene.poses[0], pose(0.1, -1.5, 10.1, 7.0, 2.0, -1.0)))
    given = measured(wide)
    seeded = HdaEstimator(replace(OPTIONS, track_seed=TrackSeed.POSE)).estimate(given)
    assert seeded.outcome.converged
    assert motion_of(seeded).parallax_px > 50.0
    errors = map_errors(wide, seeded)
    assert np.sqrt(np.mean(errors**2)) < 0.005 * 10.0
    assert not HdaEstimator(OPTIONS).estimate(given).outcome.converged


def test_a_picture_that_is_not_its_cameras_size_is_refused(exact: LandingMeasurements) -> None:
    with pytest.raises(ValueError, match=r"rows, columns.*\(120, 160\), its camera \(240, 320\)"):
        HdaEstimator(OPTIONS).estimate(repainted(exact, 0, exact.images[0].counts[:120, :160]))


def test_products_hold_what_the_figures_show(scene: Pass, exact: LandingMeasurements, answer: SiteEstimate) -> None:
    products = hda_products(details_of(answer))
    accepted = products["tracks_accepted"]
    assert products["sparse_points"].shape == (accepted.sum(), 3)
    # Fig. 2's points are where the tracks' pixels see the ground.
    truth = scene.ground(0, products["features"][accepted])
    one = scene.camera(0)
    misses = products["sparse_points"][:, 2] - (truth - one.c) @ one.a
    assert products["inliers"].mean() > 0.9
    # Aligned tracks with a parallax of 33 px at 10 m: 0.1 m is a third of a pixel.
    assert np.max(np.abs(misses[products["inliers"]])) < 0.1
    assert products["grid"].shape == products["segment_ends"].shape == products["matched"].shape
    # Fig. 7: cells fall on the pixels that see them.
    row, column = products["site"].astype(int)
    seen = scene.ground(0, products["map_pixels"][row, column][None])[0]
    np.testing.assert_allclose(seen[:2], site_of(answer)[:2], atol=0.05)
    # What was not reached is left out.
    blind = HdaEstimator(OPTIONS).estimate(replace(exact, slant_range_m=np.nan))
    assert hda_products(details_of(blind)) == {}


def test_bright_and_dark_pairs_give_the_same_map(scene: Pass, exact: LandingMeasurements) -> None:
    """The level of both pictures does not matter: differences and correlations are of counts less their means."""
    darker = exact
    for which in (0, 1):
        darker = repainted(darker, which, (exact.images[which].counts // 4).astype(np.uint16))
    errors = map_errors(scene, HdaEstimator(OPTIONS).estimate(darker))
    assert np.sqrt(np.mean(errors**2)) < 0.005 * 10.0


def test_a_dropped_frame_is_a_repeated_one(exact: LandingMeasurements) -> None:
    # The second frame is the first again, but the poses have moved on.
    repeated = repainted(exact, 1, exact.images[0].counts)
    found = HdaEstimator(OPTIONS).estimate(repeated)
    assert found.outcome is SiteOutcome.NO_BASELINE


def test_noise_of_the_detector_leaves_the_map_usable(scene: Pass) -> None:
    rng = np.random.default_rng(6)
    noisy = [picture(scene, which, rng) for which in (0, 1)]
    given = measured(scene)
    found = HdaEstimator(OPTIONS).estimate(replace(given, images=(noisy[0], noisy[1])))
    clean = HdaEstimator(OPTIONS).estimate(given)
    spread = [float(np.std(map_errors(scene, one))) for one in (clean, found)]
    assert spread[1] < 1.3 * spread[0]
