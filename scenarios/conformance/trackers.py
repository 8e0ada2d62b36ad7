"""Conformance checks of target trackers: a drive towards a textured wall, with injected faults."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.answers import check_aim, check_update
from marsyard.algorithms.interface import MastAim, PixelBox, TargetUpdate, TrackingState
from marsyard.algorithms.vtt.pointing import mast_angles
from marsyard.scenarios.conformance.checks import BreachError, Check, Suite, measure_time_s
from marsyard.scenarios.conformance.inputs import MEAN_RADIANCE, TexturedPlane, texture
from marsyard.scenarios.input_copies import copy_inputs, hash_inputs
from marsyard.sim.camera import CameraModel
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import MastCalibration, MastImage, PixelTarget, RoverMeasurements
from marsyard.sim.sensor.mast import stereo_mast

#: Largest count of the 12-bit cameras, and mean count of the wall.
FULL_SCALE_DN, _MEAN_DN = 4095, 1500.0
#: Distance of the wall from the start and distance between stops, metres, and number of stops of the drive.
_WALL_DISTANCE_M, _STEP_M, _STOPS = 8.0, 0.4, 4
#: Spacing of the texture's samples on the wall, metres.
_TEXTURE_STEP_M = 0.006
#: The designated point on the wall, world axes, metres.
TARGET_M = np.array([_WALL_DISTANCE_M, 0.3, 1.2])
#: Count of all pixels of the blank images.
BLANKS = {"featureless": 1500, "dark": 0, "saturated": FULL_SCALE_DN}


@cache
def mast() -> MastCalibration:
    """Return the mast of the suite's rover."""
    return stereo_mast("research-navcam")


def pose(distance_m: float) -> RigidTransform:
    """Return the pose of the rover at a distance along its path."""
    return rigid(Rotation.identity(), np.array([distance_m, 0.0, 0.0]))


def designation() -> PixelTarget:
    """Return the target, designated by its pixel in the left image at the start."""
    angles = mast_angles(TARGET_M, mast())
    if angles is None:
        raise ValueError("the mast cannot point at the suite's target")
    left = mast().left.transform(mast().geometry.rover_from_head(*angles))
    return PixelTarget(np.asarray(left.project(TARGET_M)[0]), *angles)


def take_images(aim: MastAim, world_from_rover: RigidTransform, blank: int | None = None) -> RoverMeasurements:
    """Create the measurements of a stop: images of the wall with this aim, or blank images of one count."""
    angles = aim.azimuth_rad, aim.elevation_rad
    head = world_from_rover * mast().geometry.rover_from_head(*angles)
    left = _take_image(mast().left.transform(head), aim.left, blank)
    right = _take_image(mast().right.transform(head), aim.right, blank)
    return RoverMeasurements(left, right, mast(), *angles, world_from_rover)


def _take_image(camera: CameraModel, box: PixelBox, blank: int | None) -> MastImage:
    if blank is not None:
        return MastImage(np.full(box.size[::-1], blank, np.uint16), box.corner)
    wall_axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    wall = TexturedPlane(np.array([_WALL_DISTANCE_M, 0.0, 0.0]), wall_axes, _TEXTURE_STEP_M)
    radiance = wall.radiance(camera.crop(*box.corner, box.size))
    return MastImage(
        np.clip(np.rint(_MEAN_DN / MEAN_RADIANCE * radiance), 0, FULL_SCALE_DN).astype(np.uint16), box.corner
    )


@dataclass(frozen=True)
class TrackerSuite(Suite):
    """Suite of one tracker; its only case is a drive to the designated target."""

    deterministic_advice = "use numpy.random.default_rng(a fixed seed); reset the whole state in clear and designate"
    time_verb = "updates"
    dependence_problem = "after clear and a second designation of the target, its answer differs"

    def checks(self) -> Iterator[Check]:
        """See `Suite`."""
        advice = "see algorithms/interface.py for aim, update and state"
        requirement = "returns a well-formed aim and answer at every stop of a drive"
        yield Check("answer", requirement, advice, self._list_states)
        yield Check("states", "has no target before the designation and after clear", advice, self._check_states)
        advice = "return a TargetUpdate with the state LOST and the reasons in losses"
        for name, blank in BLANKS.items():
            yield Check(name, f"loses its target if images are {name}", advice, partial(self._check_loss, name, blank))
        requirement = "answers if the pose jumps and the images show a different scene"
        yield Check("pose", requirement, advice, self._check_pose_jump)
        yield from self.common_checks()

    def cases(self) -> Sequence[PixelTarget]:
        """See `Suite`."""
        texture()
        return [designation()]

    def _call(self, algorithm: Any, case: PixelTarget, seed: int) -> Sequence[TargetUpdate]:
        updates = drive_to_target(algorithm)
        algorithm.clear()
        return updates

    def _check_answer(self, answer: Any, case: PixelTarget) -> Any:
        return answer  # checked by `drive_to_target`

    def _list_states(self) -> str:
        return ", ".join(update.state.name for update in drive_to_target(self.make()))

    def _check_states(self) -> str:
        tracker = self.make()
        _expect_state(tracker, "before the designation", TrackingState.NO_TARGET)
        tracker.designate(copy_inputs(designation()), pose(0.0))
        _expect_state(tracker, "after the designation", TrackingState.NORMAL)
        tracker.clear()
        _expect_state(tracker, "after clear", TrackingState.NO_TARGET)
        update = check_update(tracker.update(copy_inputs(take_images(aim_ahead(), pose(0.0)))))
        if update.state is not TrackingState.NO_TARGET:
            raise BreachError(f"without a target, it answers {update.state.name}; allowed: NO_TARGET")
        return ""

    def _check_loss(self, name: str, blank: int) -> str:
        tracker = self.make()
        drive_to_target(tracker)
        update = update_tracker(tracker, pose(_STOPS * _STEP_M), blank)
        if update is None:
            return "no aim"
        if update.tracked:
            raise BreachError(f"it finds its target in images that are {name}")
        if update.state is TrackingState.LOST and not update.losses:
            raise BreachError("it reports no reason for the lost target: losses is empty")
        return ", ".join([update.state.name, *(loss.name for loss in update.losses)])

    def _check_pose_jump(self) -> str:
        tracker = self.make()
        drive_to_target(tracker)
        measurements = replace(take_images(aim_ahead(), pose(0.0)), world_from_rover=pose(3.0))
        return check_update(tracker.update(copy_inputs(measurements))).state.name

    def _check_inputs(self) -> str:
        tracker, target = self.make(), copy_inputs(designation(), writable=True)
        target_hash = hash_inputs(target)
        tracker.designate(target, pose(0.0))
        measurements = copy_inputs(take_images(_aim_at_target(tracker, pose(0.0)), pose(0.0)), writable=True)
        measurements_hash = hash_inputs(measurements)
        tracker.update(measurements)
        if hash_inputs(target) != target_hash or hash_inputs(measurements) != measurements_hash:
            raise BreachError("it changed its input, the designation or the measurements")
        return ""

    def _answer_time_s(self) -> float:
        """Measure the maximum time of an update in a second drive; the first drive compiles kernels."""
        drive_to_target(self.make())
        tracker = self.make()
        tracker.designate(copy_inputs(designation()), pose(0.0))
        times = []
        for number in range(_STOPS):
            rover_pose = pose(number * _STEP_M)
            measurements = copy_inputs(take_images(_aim_at_target(tracker, rover_pose), rover_pose))
            times.append(measure_time_s(partial(tracker.update, measurements)))
        return max(times)


def drive_to_target(tracker: Any) -> Sequence[TargetUpdate]:
    """Designate the target and drive towards it; return the updates at the stops, up to a failure."""
    tracker.designate(copy_inputs(designation()), pose(0.0))
    updates: list[TargetUpdate] = []
    for number in range(_STOPS):
        update = update_tracker(tracker, pose(number * _STEP_M))
        if update is None:
            break
        updates.append(update)
        if update.state is TrackingState.FAILURE:
            break
    return updates


def update_tracker(tracker: Any, rover_pose: RigidTransform, blank: int | None = None) -> TargetUpdate | None:
    """Aim, take images and update the tracker; check its answers against the interface. None without an aim."""
    aim = check_aim(tracker.aim(rover_pose, copy_inputs(mast())), mast())
    if aim is None:
        return None
    update = check_update(tracker.update(copy_inputs(take_images(aim, rover_pose, blank))))
    if tracker.state is not update.state:
        raise BreachError(f"its state is {tracker.state}, but its update reports {update.state}")
    return update


def _aim_at_target(tracker: Any, rover_pose: RigidTransform) -> MastAim:
    aim = check_aim(tracker.aim(rover_pose, copy_inputs(mast())), mast())
    if aim is None:
        raise BreachError("it returns no aim at a fully visible target 8 m ahead")
    return aim


def aim_ahead() -> MastAim:
    """Return an aim straight ahead, 0.2 rad below the horizon, with subframes at the centres of both images."""
    columns, rows = mast().left.size
    box = PixelBox((columns // 4, rows // 4), (columns // 2, rows // 2))
    return MastAim(0.0, -0.2, box, box)


def _expect_state(tracker: Any, moment: str, state: TrackingState) -> None:
    if tracker.state is not state:
        raise BreachError(f"its state {moment} is {tracker.state}; allowed: {state}")
