"""The tracker when its target is hidden, out of view or never seen: lost, found again, or given up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from marsyard.algorithms.interface import TargetLoss, TrackingState
from marsyard.algorithms.vtt.tracker import VisualTargetTracker
from marsyard.sim.measurements import MastImage, RoverTarget
from tests.algorithms.vtt.approach import SMALL, pixel_of, scene_of, slanted
from tests.algorithms.vtt.synthetic_drive import Drive, Plane, Scene, navcam, pose, waves


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
