"""Tests of the target tracker in the loop of drive, images and update, on exact images of planes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.interface import TargetLoss, TargetTracker, TrackingState
from marsyard.algorithms.vtt.options import PURE_NCC, VttOptions
from marsyard.algorithms.vtt.tracker import VisualTargetTracker, lucas_kanade_tracker
from marsyard.sim.camera import Cahvor
from marsyard.sim.measurements import MastImage, PixelTarget, RoverTarget, SiteTarget, TargetDesignation
from tests.algorithms.vtt.synthetic_drive import (
    SMALL_WINDOW,
    Drive,
    Plane,
    Scene,
    draw_waves,
    drive_to_target,
    get_details,
    get_pixel,
    make_face,
    make_scene,
    navcam,
    pancam,
    pose,
    start_drive,
)

# ----- drift -----


@pytest.mark.parametrize(
    ("fraction", "seeds"), [(0.1, range(3)), pytest.param(0.05, range(10, 11), marks=pytest.mark.slow)]
)
def test_tracked_point_does_not_drift_from_10_m_to_2_m(fraction: float, seeds: range) -> None:
    # Requirement without noise: 1 px rms, 2.5 px maximum. An error of one pixel at 10 m grows to 5 px at 2 m.
    drifts = []
    for seed in seeds:
        target = np.array([10.0, 0.2 - 0.1 * seed, 0.2])
        drive = Drive(make_scene(make_face(seed, target), target, seed), navcam(), VisualTargetTracker(SMALL_WINDOW))
        stops = drive_to_target(drive, target, fraction)
        true_pose, last = stops[-1]
        assert last.tracked
        assert get_details(last).distance_m < 2.05
        drifts.append(get_pixel(last) - drive.true_pixel(true_pose, target))
        # One tenth of the required 3 cm, with exact poses and cameras.
        assert np.linalg.norm(last.position_rover - true_pose.inv().apply(target)) < 0.003
        for (_, previous), (_, current) in pairwise(stops):
            change = get_details(current).change
            # The pose predicts the magnification, stereo measures it. 0.1 px of disparity changes the range by 0.4 %
            # at 10 m.
            range_ratio = get_details(previous).distance_m / get_details(current).distance_m
            assert change.magnification == pytest.approx(range_ratio, abs=0.012)
    assert np.sqrt(np.mean(np.sum(np.square(drifts), axis=1))) < 1.0
    assert np.max(np.linalg.norm(drifts, axis=1)) < 2.5


@pytest.mark.slow
def test_published_tracker_drifts_by_a_few_pixels() -> None:
    """Each of 32 steps adds an error of up to half a pixel (0.4 px rms): about 6 px in total."""
    options, drifts = replace(SMALL_WINDOW, subpixel=False, min_match_score=0.0), []
    for seed in range(3):
        target = np.array([10.0, 0.2 - 0.1 * seed, 0.2])
        drive = Drive(make_scene(make_face(seed, target), target, seed), navcam(), VisualTargetTracker(options))
        true_pose, last = drive_to_target(drive, target, 0.05)[-1]
        assert last.tracked
        drifts.append(np.linalg.norm(get_pixel(last) - drive.true_pixel(true_pose, target)))
    assert 1.5 < np.sqrt(np.mean(np.square(drifts))) < 10.0


# ----- appearance -----


def test_scaling_allows_larger_steps_than_pure_ncc() -> None:
    target = np.array([10.0, 0.1, 0.2])
    scene = make_scene(make_face(2, target), target, 2)
    scaled_stops = drive_to_target(Drive(scene, navcam(), VisualTargetTracker(SMALL_WINDOW)), target, 0.23)
    assert scaled_stops[-1][1].tracked
    assert get_details(scaled_stops[-1][1]).distance_m < 2.05
    ncc_tracker = VisualTargetTracker(replace(PURE_NCC, search_px=101))
    ncc_stops = drive_to_target(Drive(scene, navcam(), ncc_tracker), target, 0.23)
    assert ncc_stops[-1][1].state is TrackingState.LOST
    assert TargetLoss.LOW_MATCH_SCORE in ncc_stops[-1][1].losses


@pytest.mark.parametrize("roll", [True, False])
def test_tilted_rover_requires_roll_correction(roll: bool) -> None:
    target = np.array([5.0, 0.1, 0.3])
    drive = start_drive(target, 1, replace(SMALL_WINDOW, roll=roll))
    # The body tilts by 25 deg to its right: its image rolls counter-clockwise by about the same angle.
    tilted_pose = pose(0.3, 0.0, tilt=Rotation.from_rotvec([np.deg2rad(25.0), 0.0, 0.0]))
    update = drive.stop(tilted_pose)
    change = get_details(update).change
    assert np.degrees(change.roll_rad) == pytest.approx(-25.0, abs=4.0)
    assert update.tracked == roll
    if roll:
        np.testing.assert_allclose(get_pixel(update), drive.true_pixel(tilted_pose, target), atol=0.3)


def test_turn_in_place_changes_only_mast_angles() -> None:
    target = np.array([6.0, 0.5, 0.2])
    drive = start_drive(target, 4)
    update = drive.stop(pose(0.0, 0.0, np.deg2rad(45.0)))
    result = get_details(update)
    assert update.tracked
    assert result.match.score > 0.95
    # The mast is 0.35 m ahead of the turn axis: the direction changes by 2.5 deg, the distance of 5.6 m by 0.1 m.
    assert abs(result.change.magnification - 1.0) < 0.03
    assert abs(np.degrees(result.azimuth_change_rad)) < 4.0
    assert np.degrees(result.azimuth_rad) == pytest.approx(45.0, abs=5.0)


def test_circling_reduces_the_score_but_not_the_accuracy() -> None:
    # Table III of the tracking paper lists scores of 0.85 to 0.88 for azimuth changes of 6 to 9 deg, and 0.79 for 15
    # deg. The scores of a flat face without relief are higher.
    target = np.array([4.0, 0.0, 0.3])
    scene = make_scene(Plane(target, np.array([-0.96, 0.0, 0.28])), target, 5)
    scores = {}
    for step in (2.0, 8.0, 15.0):
        drive = Drive(scene, navcam(), VisualTargetTracker(SMALL_WINDOW))
        first, second = (
            pose(4.0 - 4.0 * np.cos(angle), -4.0 * np.sin(angle), angle)
            for angle in (np.deg2rad(-0.5 * step), np.deg2rad(0.5 * step))
        )
        drive.tracker.designate(RoverTarget(first.inv().apply(target)), first)
        drive.stop(first)
        update = drive.stop(second)
        assert update.tracked
        # The mast is ahead and to the left of the rover origin; the angle is that of the line of sight.
        assert abs(np.degrees(get_details(update).azimuth_change_rad)) == pytest.approx(step, rel=0.02)
        np.testing.assert_allclose(get_pixel(update), drive.true_pixel(second, target), atol=0.2)
        match = get_details(update).match
        scores[step] = match.score
    assert 0.79 < scores[15.0] < scores[8.0] < scores[2.0]


# ----- designation, stereo, poses -----


def test_all_three_designations_define_the_same_target() -> None:
    target = np.array([7.0, 0.3, 0.2])
    start = pose(0.0, 0.0)
    scene = make_scene(make_face(5, target), target, 5)
    north_east_down = np.array([target[1], target[0], -target[2]])
    camera = navcam().left.transform(start * navcam().geometry.rover_from_head(0.02, -0.12))
    designations: list[TargetDesignation] = [
        RoverTarget(target),
        SiteTarget(north_east_down),
        PixelTarget(camera.project(target)[0], 0.02, -0.12),
    ]
    for designation in designations:
        drive = Drive(scene, navcam(), VisualTargetTracker(replace(SMALL_WINDOW, seed_range_m=(3.0, 15.0))))
        drive.tracker.designate(designation, start)
        update = drive.stop(start)
        assert update.tracked
        assert update.position_rover is not None
        # A tenth of a pixel of disparity is 2 cm of range at 7 m.
        np.testing.assert_allclose(update.position_rover, target, atol=0.02)
        second_update = drive.stop(pose(0.7, 0.0))
        assert second_update.tracked
        np.testing.assert_allclose(get_pixel(second_update), drive.true_pixel(pose(0.7, 0.0), target), atol=0.1)


def test_range_of_a_near_target_is_accurate_if_the_mast_centres_both_images() -> None:
    """With `aim_pair` the target is between the centres of both images, so that both contain a target at 2.2 m."""
    target = np.array([2.2, -0.1, 0.3])
    (update,) = start_drive(target, 6, replace(SMALL_WINDOW, aim_pair=True), pancam()).updates
    assert update.position_rover is not None
    np.testing.assert_allclose(update.position_rover, target, atol=0.001)


def test_warp_increases_the_stereo_score_of_a_slanted_face() -> None:
    """At 66 deg and 3 m, a baseline of 0.2 m changes the width of the face in the right image by 15 %."""
    target, slant = np.array([3.0, 0.0, 0.5]), np.radians(66.0)
    face = Plane(target, np.array([-np.cos(slant), np.sin(slant), 0.0]))
    scores = {}
    for warp in ("shift", "bend"):
        stereo = get_details(start_drive(target, 3, replace(SMALL_WINDOW, warp=warp), face=face).updates[0]).stereo
        scores[warp] = 0.0 if stereo is None else stereo.score
    assert scores["bend"] > 0.95
    assert scores["shift"] < scores["bend"] - 0.1


def test_stereo_criterion_loses_slanted_faces_at_any_step_size() -> None:
    """The stereo score depends on the last pair only: steps of 5 % and 23 % lose the same, correctly matched target.

    The right camera sees a face at 66 deg compressed; the minimum score of 0.7 is not reached near the goal.
    """
    target, slant = np.array([4.0, 0.0, 0.5]), np.radians(66.0)
    face = Plane(target, np.array([-np.cos(slant), np.sin(slant), 0.0]))
    for fraction in (0.05, 0.23):
        last_updates = []
        for min_score in (0.7, 0.0):
            tracker = VisualTargetTracker(VttOptions(search_px=101, min_stereo_score=min_score))
            drive = Drive(make_scene(face, target, 3), navcam(), tracker)
            stops = drive_to_target(drive, target, fraction)
            last_pose, last_update = stops[-1]
            # several pixels (5 px), as in the paper
            assert np.linalg.norm(get_pixel(last_update) - drive.true_pixel(last_pose, target)) < 5.0
            last_updates.append(last_update)
        assert last_updates[0].losses == (TargetLoss.LOW_STEREO_SCORE,)
        assert last_updates[1].tracked


def test_slip_appears_as_a_position_correction() -> None:
    # The rover drives 4 % less than estimated: 4 cm in the first metre, a displacement of at most 5 px in the image.
    target = np.array([8.0, 0.1, 0.2])
    drive = Drive(make_scene(make_face(7, target), target, 7), navcam(), VisualTargetTracker(SMALL_WINDOW))
    stops = drive_to_target(drive, target, 0.1, slip=0.04)
    true_pose, last = stops[-1]
    assert last.tracked
    assert last.position_rover is not None
    np.testing.assert_allclose(last.position_rover, true_pose.inv().apply(target), atol=0.01)
    evidence = get_details(last).evidence
    # After 6 m the target has moved by 4 % of that in the estimated world frame.
    assert evidence.position_correction_m == pytest.approx(0.24, abs=0.05)


def test_pointing_error_does_not_change_the_match() -> None:
    target = np.array([6.0, 0.1, 0.2])
    drive = start_drive(target, 5)
    drive.pointing_error_rad = (np.deg2rad(0.5), np.deg2rad(-0.3))
    update = drive.stop(pose(0.5, 0.0))
    assert update.tracked
    result = get_details(update)
    # 0.82 mrad per pixel: pointing too far right and down moves the target left and up.
    correction = get_pixel(update) - result.predicted_pixel
    np.testing.assert_allclose(correction, [-1222.5 * np.deg2rad(0.5), -1222.5 * np.deg2rad(0.3)], atol=0.5)
    np.testing.assert_allclose(get_pixel(update), drive.true_pixel(pose(0.5, 0.0), target), atol=0.1)


@pytest.mark.parametrize(("row_offset_px", "is_tracked"), [(1.4, True), (5.0, False)])
def test_stereo_tolerates_row_offsets_within_the_epipolar_tolerance(row_offset_px: float, is_tracked: bool) -> None:
    """The epipolar tolerance of the options is 2 px."""
    target = np.array([6.0, 0.1, 0.2])
    mast = navcam()
    assert isinstance(mast.right, Cahvor)
    misaligned = replace(mast, right=replace(mast.right, v=mast.right.v + row_offset_px * mast.right.a))
    (update,) = start_drive(target, 5, mast=mast, mast_model=misaligned).updates
    assert update.tracked == is_tracked
    if is_tracked:
        # Row errors hardly affect the range: a tenth of a pixel of disparity is 1.5 cm here.
        assert np.linalg.norm(update.position_rover - target) < 0.03
    else:
        assert update.losses == (TargetLoss.LOW_STEREO_SCORE,)


def test_spinning_wheels_are_detected() -> None:
    # The estimated drive is 1.5 m of 8 m. The target is still 8 m away, and its image is not magnified.
    target = np.array([8.0, 0.1, 0.2])
    drive = start_drive(target, 8, replace(SMALL_WINDOW, search_px=161))
    update = drive.stop(pose(0.0, 0.0), pose(1.5, 0.0))
    assert update.state is TrackingState.LOST


def test_detector_noise_has_little_effect() -> None:
    target = np.array([6.0, 0.1, 0.2])
    scene = replace(make_scene(make_face(9, target), target, 9), contrast=0.08)
    drive = Drive(scene, navcam(), VisualTargetTracker(SMALL_WINDOW), noise=np.random.default_rng(1))
    true_pose, last = drive_to_target(drive, target, 0.1)[-1]
    assert last.tracked
    assert np.linalg.norm(get_pixel(last) - drive.true_pixel(true_pose, target)) < 1.0


# ----- another tracker with the same interface -----


def test_lucas_kanade_tracker_follows_the_target_in_the_same_loop() -> None:
    target = np.array([6.0, 0.1, 0.2])
    tracker: TargetTracker = lucas_kanade_tracker(SMALL_WINDOW)
    drive = Drive(make_scene(make_face(1, target), target, 1), navcam(), tracker)
    # compared as lists, because mypy would otherwise assume that the state does not change
    assert [tracker.state] == [TrackingState.NO_TARGET]
    true_pose, last = drive_to_target(drive, target, 0.1)[-1]
    assert last.tracked
    assert tracker.state is TrackingState.NORMAL
    assert np.linalg.norm(get_pixel(last) - drive.true_pixel(true_pose, target)) < 2.5


def test_lucas_kanade_tracker_loses_a_target_next_to_the_image() -> None:
    """The predicted pixel is 24 px outside of the left subframe, but the search window overlaps the subframe."""
    target = np.array([6.0, 0.1, 0.2])
    drive = Drive(make_scene(make_face(3, target), target, 3), navcam(), lucas_kanade_tracker(SMALL_WINDOW))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    assert drive.stop(pose(0.0, 0.0)).tracked
    first = drive.measurements[-1]
    turned = replace(first, azimuth_rad=first.azimuth_rad + 86.0 / navcam().left.focal_lengths[0])
    update = drive.tracker.update(turned)
    assert (update.state, update.losses) == (TrackingState.LOST, (TargetLoss.OUT_OF_VIEW,))


@pytest.mark.parametrize(
    "invalid",
    [
        {"template_px": 20},
        {"search_px": 22},
        {"coarse_levels": 4},
        {"coarse_candidates": 0},
        {"max_lost_updates": -1},
        {"seed_range_m": (5.0, 1.0)},
        {"epipolar_tolerance_px": 0.0},
    ],
)
def test_invalid_options_are_rejected(invalid: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(invalid))):
        VttOptions(**invalid)  # type: ignore[arg-type]


# ----- lost targets -----


def hide_behind_board(scene: Scene) -> Scene:
    """Return a scene that contains only a board with another texture, half-way to the target."""
    board = Plane(np.array([3.0, 0.0, 0.5]), np.array([-1.0, 0.0, 0.0]))
    return Scene((board,), draw_waves(99, count=100), board.point)


@pytest.mark.parametrize(
    ("occluded_stops", "expected"),
    [
        ([1], [TrackingState.LOST, TrackingState.NORMAL, TrackingState.NORMAL]),
        ([1, 2, 3], [TrackingState.LOST, TrackingState.LOST, TrackingState.FAILURE]),
    ],
)
def test_occluded_target_is_recovered_or_abandoned(occluded_stops: list[int], expected: list[TrackingState]) -> None:
    target = np.array([6.0, 0.1, 0.2])
    drive = start_drive(target, 3)
    tracker, clear_scene = drive.tracker, drive.scene
    states = []
    for stop in (1, 2, 3):
        drive.scene = hide_behind_board(clear_scene) if stop in occluded_stops else clear_scene
        true_pose = pose(0.25 * stop, 0.0)
        update = drive.stop(true_pose)
        states.append(update.state)
        if update.tracked:
            np.testing.assert_allclose(get_pixel(update), drive.true_pixel(true_pose, target), atol=0.2)
        else:
            # The predicted position is exact because the poses are exact.
            assert update.losses
            assert update.position_rover is not None
            np.testing.assert_allclose(update.position_rover, true_pose.inv().apply(target), atol=0.03)
    assert states == expected
    if states[-1] is TrackingState.FAILURE:
        drive.scene = clear_scene
        later_update = drive.stop(pose(1.0, 0.0))
        assert (later_update.state, later_update.losses, later_update.tracked) == (TrackingState.FAILURE, (), False)
    tracker.clear()
    assert tracker.state is TrackingState.NO_TARGET
    assert tracker.aim(pose(0.0, 0.0), navcam()) is None
    assert tracker.update(drive.measurements[-1]).state is TrackingState.NO_TARGET


def test_image_without_the_target_is_reported_as_lost() -> None:
    target = np.array([6.0, 0.1, 0.2])
    drive = start_drive(target, 3)
    measurements = drive.measurements[-1]
    blank = MastImage(np.full((40, 40), 1000, dtype=np.uint16), (0, 0))
    for invalid, loss in (
        (replace(measurements, left=blank), TargetLoss.OUT_OF_VIEW),
        (replace(measurements, right=blank), TargetLoss.OUT_OF_VIEW),
        (replace(measurements, azimuth_rad=measurements.azimuth_rad + 2.5), TargetLoss.OUT_OF_VIEW),
        (
            replace(measurements, left=replace(measurements.left, counts=np.full_like(measurements.left.counts, 900))),
            TargetLoss.LOW_MATCH_SCORE,
        ),
        (
            replace(measurements, right=replace(measurements.right, counts=measurements.left.counts * 0)),
            TargetLoss.LOW_STEREO_SCORE,
        ),
    ):
        drive.tracker.clear()
        drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
        assert drive.tracker.update(measurements).tracked
        update = drive.tracker.update(invalid)
        assert update.state is TrackingState.LOST
        assert loss in update.losses


def test_target_outside_all_images_is_abandoned() -> None:
    target = np.array([6.0, 0.1, 0.2])
    drive = start_drive(target, 3)
    other_direction = replace(drive.measurements[-1], azimuth_rad=2.0)
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    states = [drive.tracker.update(other_direction).state for _ in range(3)]
    assert states == [TrackingState.LOST, TrackingState.LOST, TrackingState.FAILURE]


def test_driving_backwards_shrinks_the_template() -> None:
    target = np.array([4.0, 0.1, 0.2])
    drive = start_drive(target, 2)
    for x in (-0.4, -0.8, -1.2):
        update = drive.stop(pose(x, 0.0))
        change = get_details(update).change
        assert update.tracked
        assert 0.88 < change.magnification < 0.93
        np.testing.assert_allclose(get_pixel(update), drive.true_pixel(pose(x, 0.0), target), atol=0.15)


@pytest.mark.slow
def test_track_drifts_without_subpixel_matching() -> None:
    # Each of 32 steps adds an error of up to half a pixel (0.4 px rms), which later steps magnify: about 6 px in total.
    drifts = []
    for seed in (0, 3):
        target = np.array([10.0, 0.0, 0.2])
        drive = Drive(
            make_scene(make_face(seed, target), target, seed),
            navcam(),
            VisualTargetTracker(replace(SMALL_WINDOW, subpixel=False, min_match_score=0.0)),
        )
        true_pose, last = drive_to_target(drive, target, 0.05)[-1]
        drifts.append(np.linalg.norm(get_pixel(last) - drive.true_pixel(true_pose, target)))
    assert max(drifts) > 2.5
