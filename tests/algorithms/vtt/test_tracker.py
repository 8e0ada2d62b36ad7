"""The tracker in its loop, on pictures that are exact: planes and spheres seen through distorting cameras."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from marsyard.algorithms.interface import TargetLoss, TargetTracker, TrackingState
from marsyard.algorithms.vtt.lucas_kanade import lucas_kanade_tracker
from marsyard.algorithms.vtt.options import PURE_NCC, VttOptions
from marsyard.algorithms.vtt.tracker import VisualTargetTracker
from marsyard.sim.camera import Cahvor
from marsyard.sim.measurements import MastImage, PixelTarget, RoverTarget, SiteTarget, TargetDesignation
from tests.algorithms.vtt.synthetic_drive import (
    SMALL,
    Body,
    Drive,
    Plane,
    Scene,
    approach,
    boulder,
    details,
    navcam,
    pancam,
    pixel_of,
    pose,
    scene_of,
    slanted,
    waves,
)

# ----- drift -----


@pytest.mark.parametrize(
    ("share", "body", "seeds"), [(0.1, slanted, range(3)), (0.1, boulder, range(3)), (0.05, slanted, range(10, 11))]
)
def test_the_tracked_point_does_not_drift_from_10_m_to_2_m(share: float, body: Body, seeds: range) -> None:
    # The requirement: 1 px rms, 2.5 px worst (the paper's own: a pixel at 10 m is 5 px at 2 m), noise-free.
    drifts = []
    for seed in seeds:
        target = np.array([10.0, 0.2 - 0.1 * seed, 0.2])
        drive = Drive(scene_of(body(seed, target), target, seed), navcam(), VisualTargetTracker(SMALL))
        stops = approach(drive, target, share)
        true, last = stops[-1]
        assert last.found
        assert details(last).distance_m < 2.05
        drifts.append(pixel_of(last) - drive.true_pixel(true, target))
        assert last.position_rover is not None
        # Bar 5's 3 cm, with exact poses and cameras: a tenth of it.
        assert np.linalg.norm(last.position_rover - true.inv().apply(target)) < 0.003
        for (_, before), (_, after) in pairwise(stops):
            change = details(after).change
            assert change is not None
            # Predicted by the pose, measured by stereo: a tenth of a pixel of disparity is 0.4 % at 10 m.
            measured = details(before).distance_m / details(after).distance_m
            assert change.magnification == pytest.approx(measured, abs=0.012)
    assert np.sqrt(np.mean(np.sum(np.square(drifts), axis=1))) < 1.0
    assert np.max(np.linalg.norm(drifts, axis=1)) < 2.5


def test_whole_pixels_drift() -> None:
    # An error of up to half a pixel in each of 32 steps, magnified by all later ones: 0.4 px rms times 15.
    drifts = []
    for seed in (0, 3):
        target = np.array([10.0, 0.0, 0.2])
        drive = Drive(
            scene_of(slanted(seed, target), target, seed),
            navcam(),
            VisualTargetTracker(replace(SMALL, subpixel=False, min_match_score=0.0)),
        )
        true, last = approach(drive, target, 0.05)[-1]
        drifts.append(np.linalg.norm(pixel_of(last) - drive.true_pixel(true, target)))
    assert max(drifts) > 2.5


# ----- appearance -----


def test_scale_carries_through_large_steps_that_pure_ncc_does_not_survive() -> None:
    target = np.array([10.0, 0.1, 0.2])
    scene = scene_of(slanted(2, target), target, 2)
    scaled = approach(Drive(scene, navcam(), VisualTargetTracker(SMALL)), target, 0.23)
    assert scaled[-1][1].found
    assert details(scaled[-1][1]).distance_m < 2.05
    pure = approach(Drive(scene, navcam(), VisualTargetTracker(replace(PURE_NCC, search_px=101))), target, 0.23)
    assert pure[-1][1].state is TrackingState.LOST
    assert TargetLoss.LOW_MATCH_SCORE in pure[-1][1].losses


@pytest.mark.parametrize("roll", [True, False])
def test_a_tilted_rover_needs_the_roll(roll: bool) -> None:
    target = np.array([5.0, 0.1, 0.3])
    drive = Drive(scene_of(slanted(1, target), target, 1), navcam(), VisualTargetTracker(replace(SMALL, roll=roll)))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    # The body leans by 25 deg to its right: its picture turns counter-clockwise by about as much.
    leaning = pose(0.3, 0.0, tilt=Rotation.from_rotvec([np.deg2rad(25.0), 0.0, 0.0]))
    update = drive.stop(leaning)
    change = details(update).change
    assert change is not None
    assert np.degrees(change.roll_rad) == pytest.approx(-25.0, abs=4.0)
    assert update is not None
    assert update.found == roll
    if roll:
        np.testing.assert_allclose(pixel_of(update), drive.true_pixel(leaning, target), atol=0.3)


def test_turning_in_place_changes_the_mast_and_nothing_else() -> None:
    target = np.array([6.0, 0.5, 0.2])
    drive = Drive(scene_of(slanted(4, target), target, 4), navcam(), VisualTargetTracker(SMALL))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    update = drive.stop(pose(0.0, 0.0, np.deg2rad(45.0)))
    found = details(update)
    assert update is not None
    assert update.found
    assert found.match is not None
    assert found.match.score > 0.95
    assert found.change is not None
    # The mast stands 0.35 m ahead of the axis the rover turns about: 2.5 deg of direction, 0.1 m of 5.6 m.
    assert abs(found.change.magnification - 1.0) < 0.03
    assert abs(np.degrees(found.azimuth_change_rad)) < 4.0
    assert np.degrees(found.azimuth_rad) == pytest.approx(45.0, abs=5.0)


def test_circling_the_target_lowers_the_score_and_leaves_the_match() -> None:
    # As in Table III, where 6 to 9 deg gave 0.85 to 0.88 and 15 deg 0.79; a flat face has no relief to show.
    target = np.array([4.0, 0.0, 0.3])
    scene = scene_of(Plane(target, np.array([-0.96, 0.0, 0.28])), target, 5)
    scores = {}
    for step in (2.0, 8.0, 15.0):
        drive = Drive(scene, navcam(), VisualTargetTracker(SMALL))
        first, second = (
            pose(4.0 - 4.0 * np.cos(a), -4.0 * np.sin(a), a) for a in (np.deg2rad(-0.5 * step), np.deg2rad(0.5 * step))
        )
        drive.tracker.designate(RoverTarget(first.inv().apply(target)), first)
        drive.stop(first)
        update = drive.stop(second)
        assert update is not None
        assert update.found
        # The mast stands ahead of the rover's origin and to its left; the angle is that of the camera's line of sight.
        assert abs(np.degrees(details(update).azimuth_change_rad)) == pytest.approx(step, rel=0.02)
        np.testing.assert_allclose(pixel_of(update), drive.true_pixel(second, target), atol=0.2)
        match = details(update).match
        assert match is not None
        scores[step] = match.score
    assert 0.79 < scores[15.0] < scores[8.0] < scores[2.0]


def test_backing_off_shrinks_the_template() -> None:
    target = np.array([4.0, 0.1, 0.2])
    drive = Drive(scene_of(slanted(2, target), target, 2), navcam(), VisualTargetTracker(SMALL))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    for x in (-0.4, -0.8, -1.2):
        update = drive.stop(pose(x, 0.0))
        change = details(update).change
        assert update is not None
        assert update.found
        assert change is not None
        assert 0.88 < change.magnification < 0.93
        np.testing.assert_allclose(pixel_of(update), drive.true_pixel(pose(x, 0.0), target), atol=0.15)


# ----- designation, stereo, poses -----


def test_all_three_designations_seed_the_same_target() -> None:
    target = np.array([7.0, 0.3, 0.2])
    start = pose(0.0, 0.0)
    scene = scene_of(slanted(5, target), target, 5)
    north_east_down = np.array([target[1], target[0], -target[2]])
    camera = navcam().left.moved(start * navcam().geometry.rover_from_head(0.02, -0.12))
    picked: list[TargetDesignation] = [
        RoverTarget(target),
        SiteTarget(north_east_down),
        PixelTarget(camera.project(target)[0], 0.02, -0.12),
    ]
    for designation in picked:
        drive = Drive(scene, navcam(), VisualTargetTracker(replace(SMALL, seed_range_m=(3.0, 15.0))))
        drive.tracker.designate(designation, start)
        update = drive.stop(start)
        assert update is not None
        assert update.found
        assert update.position_rover is not None
        # A tenth of a pixel of disparity at 7 m: 2 cm.
        np.testing.assert_allclose(update.position_rover, target, atol=0.02)
        after = drive.stop(pose(0.7, 0.0))
        assert after is not None
        assert after.found
        np.testing.assert_allclose(pixel_of(after), drive.true_pixel(pose(0.7, 0.0), target), atol=0.1)


def test_a_near_target_is_ranged_by_a_pair_that_is_centred_on_it() -> None:
    target = np.array([2.2, -0.1, 0.3])
    options = replace(SMALL, aim_pair=True)
    drive = Drive(scene_of(slanted(6, target), target, 6), pancam(), VisualTargetTracker(options))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    update = drive.stop(pose(0.0, 0.0))
    assert update is not None
    assert update.position_rover is not None
    np.testing.assert_allclose(update.position_rover, target, atol=0.001)


def test_a_slanted_face_is_scored_as_the_other_camera_sees_it() -> None:
    """At 66 deg and 3 m a baseline of 0.2 m makes the right picture of a face 15 % longer or shorter."""
    target, slant = np.array([3.0, 0.0, 0.5]), np.radians(66.0)
    face = Plane(target, np.array([-np.cos(slant), np.sin(slant), 0.0]))
    scores = {}
    for warp in ("shift", "bend"):
        drive = Drive(scene_of(face, target, 3), navcam(), VisualTargetTracker(replace(SMALL, warp=warp)))
        drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
        stereo = details(drive.stop(pose(0.0, 0.0))).stereo
        scores[warp] = 0.0 if stereo is None else stereo.score
    assert scores["bend"] > 0.95
    assert scores["shift"] < scores["bend"] - 0.1


def test_slip_shows_as_a_correction_and_not_as_an_error() -> None:
    # The rover drives 4 % less than it believes: 4 cm of the first metre, 5 px of the picture's middle row and less.
    target = np.array([8.0, 0.1, 0.2])
    drive = Drive(scene_of(slanted(7, target), target, 7), navcam(), VisualTargetTracker(SMALL))
    stops = approach(drive, target, 0.1, slip=0.04)
    true, last = stops[-1]
    assert last.found
    assert last.position_rover is not None
    np.testing.assert_allclose(last.position_rover, true.inv().apply(target), atol=0.01)
    evidence = details(last).evidence
    assert evidence is not None
    # It has driven 6 m: the target moved by 4 % of that in the world that it believes in.
    assert evidence.position_correction_m == pytest.approx(0.24, abs=0.05)


def test_a_mast_that_points_wrong_moves_the_picture_and_not_the_match() -> None:
    target = np.array([6.0, 0.1, 0.2])
    drive = Drive(scene_of(slanted(5, target), target, 5), navcam(), VisualTargetTracker(SMALL))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    drive.pointing_error_rad = (np.deg2rad(0.5), np.deg2rad(-0.3))
    update = drive.stop(pose(0.5, 0.0))
    assert update is not None
    assert update.found
    found = details(update)
    assert found.predicted_pixel is not None
    # 0.82 mrad a pixel: looking too far to the right and down moves the target to the left and up.
    correction = pixel_of(update) - found.predicted_pixel
    np.testing.assert_allclose(correction, [-1222.5 * np.deg2rad(0.5), -1222.5 * np.deg2rad(0.3)], atol=0.5)
    np.testing.assert_allclose(pixel_of(update), drive.true_pixel(pose(0.5, 0.0), target), atol=0.1)


@pytest.mark.parametrize(("rows", "found"), [(1.4, True), (5.0, False)])
def test_point_stereo_tolerates_two_pixels_of_misalignment(rows: float, found: bool) -> None:
    target = np.array([6.0, 0.1, 0.2])
    true = navcam()
    assert isinstance(true.right, Cahvor)
    believed = replace(true, right=replace(true.right, v=true.right.v + rows * true.right.a))
    drive = Drive(scene_of(slanted(5, target), target, 5), true, VisualTargetTracker(SMALL), calibrated=believed)
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    update = drive.stop(pose(0.0, 0.0))
    assert update is not None
    assert update.found == found
    if found:
        # Rows hardly enter the range: a tenth of a pixel of disparity is 1.5 cm here.
        assert np.linalg.norm(update.position_rover - target) < 0.03
    else:
        assert update.losses == (TargetLoss.LOW_STEREO_SCORE,)


def test_wheels_that_spin_in_place_are_noticed() -> None:
    # Believed to have driven 1.5 m of 8 m; the target is still 8 m away, its picture not magnified.
    target = np.array([8.0, 0.1, 0.2])
    drive = Drive(scene_of(slanted(8, target), target, 8), navcam(), VisualTargetTracker(replace(SMALL, search_px=161)))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    update = drive.stop(pose(0.0, 0.0), pose(1.5, 0.0))
    assert update is not None
    assert update.state is TrackingState.LOST


def test_noise_of_a_detector_costs_little() -> None:
    target = np.array([6.0, 0.1, 0.2])
    scene = replace(scene_of(slanted(9, target), target, 9), contrast=0.08)
    drive = Drive(scene, navcam(), VisualTargetTracker(SMALL), noise=np.random.default_rng(1))
    true, last = approach(drive, target, 0.1)[-1]
    assert last.found
    assert np.linalg.norm(pixel_of(last) - drive.true_pixel(true, target)) < 1.0


# ----- another tracker behind the same protocol -----


def test_lucas_kanade_follows_in_the_same_loop() -> None:
    target = np.array([6.0, 0.1, 0.2])
    tracker: TargetTracker = lucas_kanade_tracker(SMALL)
    drive = Drive(scene_of(slanted(1, target), target, 1), navcam(), tracker)
    assert [tracker.state] == [TrackingState.NO_TARGET]
    true, last = approach(drive, target, 0.1)[-1]
    assert last.found
    assert tracker.state is TrackingState.NORMAL
    assert np.linalg.norm(pixel_of(last) - drive.true_pixel(true, target)) < 2.5


@pytest.mark.parametrize(
    "wrong",
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
def test_impossible_options_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        VttOptions(**wrong)  # type: ignore[arg-type]


# ----- lost targets -----


def hidden(scene: Scene) -> Scene:
    """The scene behind a board of another texture, half-way to the target."""
    board = Plane(np.array([3.0, 0.0, 0.5]), np.array([-1.0, 0.0, 0.0]))
    return Scene((board,), waves(99, count=100), board.point)


@pytest.mark.parametrize(
    ("behind", "expected"),
    [
        ([1], [TrackingState.LOST, TrackingState.NORMAL, TrackingState.NORMAL]),
        ([1, 2, 3], [TrackingState.LOST, TrackingState.LOST, TrackingState.FAILURE]),
    ],
)
def test_an_occluded_target_is_lost_and_found_again_or_given_up(
    behind: list[int], expected: list[TrackingState]
) -> None:
    target = np.array([6.0, 0.1, 0.2])
    clear = scene_of(slanted(3, target), target, 3)
    tracker = VisualTargetTracker(SMALL)
    drive = Drive(clear, navcam(), tracker)
    tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    states = []
    for stop in (1, 2, 3):
        drive.scene = hidden(clear) if stop in behind else clear
        true = pose(0.25 * stop, 0.0)
        update = drive.stop(true)
        assert update is not None
        states.append(update.state)
        if update.found:
            np.testing.assert_allclose(pixel_of(update), drive.true_pixel(true, target), atol=0.2)
        else:
            # Where it should be is all that is known: exact here, as the poses are.
            assert update.losses
            assert update.position_rover is not None
            np.testing.assert_allclose(update.position_rover, true.inv().apply(target), atol=0.03)
    assert states == expected
    if states[-1] is TrackingState.FAILURE:
        drive.scene = clear
        again = drive.stop(pose(1.0, 0.0))
        assert again is not None
        assert (again.state, again.losses, again.found) == (TrackingState.FAILURE, (), False)
    tracker.clear()
    assert tracker.state is TrackingState.NO_TARGET
    assert tracker.aim(pose(0.0, 0.0), navcam()) is None
    assert tracker.update(drive.measurements[-1]).state is TrackingState.NO_TARGET


def test_a_picture_that_does_not_show_the_target_is_a_loss() -> None:
    target = np.array([6.0, 0.1, 0.2])
    scene = scene_of(slanted(3, target), target, 3)
    drive = Drive(scene, navcam(), VisualTargetTracker(SMALL))
    drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    seen = drive.measurements[-1]
    blank = MastImage(np.full((40, 40), 1000, dtype=np.uint16), (0, 0))
    for wrong, loss in (
        (replace(seen, left=blank), TargetLoss.OUT_OF_VIEW),
        (replace(seen, right=blank), TargetLoss.OUT_OF_VIEW),
        (replace(seen, azimuth_rad=seen.azimuth_rad + 2.5), TargetLoss.OUT_OF_VIEW),
        (
            replace(seen, left=replace(seen.left, counts=np.full_like(seen.left.counts, 900))),
            TargetLoss.LOW_MATCH_SCORE,
        ),
        (replace(seen, right=replace(seen.right, counts=seen.left.counts * 0)), TargetLoss.LOW_STEREO_SCORE),
    ):
        drive.tracker.clear()
        drive.tracker.designate(RoverTarget(target), pose(0.0, 0.0))
        assert drive.tracker.update(seen).found
        update = drive.tracker.update(wrong)
        assert update.state is TrackingState.LOST
        assert loss in update.losses


def test_a_target_that_cannot_be_seeded_is_given_up() -> None:
    tracker = VisualTargetTracker(SMALL)
    target = np.array([6.0, 0.1, 0.2])
    drive = Drive(scene_of(slanted(3, target), target, 3), navcam(), tracker)
    tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    drive.stop(pose(0.0, 0.0))
    away = replace(drive.measurements[-1], azimuth_rad=2.0)
    tracker.designate(RoverTarget(target), pose(0.0, 0.0))
    assert [tracker.update(away).state for _ in range(3)] == [
        TrackingState.LOST,
        TrackingState.LOST,
        TrackingState.FAILURE,
    ]
