"""Estimators and trackers that run external programs: measurements are written to files, answers are read as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.spatial.transform import RigidTransform

from marsyard.algorithms import interface
from marsyard.algorithms.answers import check_aim, check_site, check_update, check_velocity
from marsyard.algorithms.exchange.files import (
    encode_altitude,
    encode_increments,
    encode_pose,
    encode_target,
    write_frame,
    write_mast,
    write_stop,
)
from marsyard.algorithms.exchange.process import MAX_STDERR_CHARACTERS, Command, ExecutableLimits
from marsyard.algorithms.exchange.serving import (
    AnswerReader,
    ProgramDetails,
    Session,
    check_keys,
    read_member,
    read_numbers,
    run_case,
)
from marsyard.algorithms.faults import bad_answer
from marsyard.sim.measurements import (
    AltitudeMeasurement,
    DescentFrame,
    DescentMeasurements,
    ImuIncrements,
    LandingMeasurements,
    MastCalibration,
    RoverMeasurements,
    TargetDesignation,
)


@dataclass(frozen=True)
class ExecutableVelocityEstimator:
    """Velocity estimator that runs an external program for each descent.

    `estimate` raises AlgorithmError if the program fails, exceeds a limit, or its answer has the wrong form.
    """

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: DescentMeasurements) -> interface.VelocityEstimate:
        """Write the measurements, run the program and return its estimate."""
        return run_case(self.command, self.limits, measurements, _read_velocity)


class ExecutableVelocityStream:
    """Velocity stream that runs an external program: one JSON request line per call (docs/custom-algorithms.md).

    Methods raise AlgorithmError if the program fails. One process of a `serve-stream:` program processes many descents.
    Increments and altitudes are sent only if the program requests them in its answer to 'start'.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._session = Session(command, limits)
        self._details = ProgramDetails("", 0.0)  # of all requests of the descent
        self._accepts_inertial = False

    def start(self) -> None:
        """Start a new descent."""
        self._details = ProgramDetails("", 0.0)
        self._send_without_answer("start", {}, self._read_start)

    def process_increments(self, increments: ImuIncrements) -> None:
        """Send the next inertial increments."""
        if self._accepts_inertial:
            self._send_without_answer("imu", {"increments": encode_increments(increments)}, self._read_answer)

    def process_altitude(self, measurement: AltitudeMeasurement) -> None:
        """Send the next altitude."""
        if self._accepts_inertial:
            self._send_without_answer("altitude", {"altitude": encode_altitude(measurement)}, self._read_answer)

    def process_image(self, frame: DescentFrame) -> interface.VelocityEstimate | None:
        """Send the next image and return the program's estimate, or None."""
        files = {"frame": lambda folder: write_frame(folder, frame)}
        # the exchange format defines the name of the request; a change would break existing programs
        return self._session.send_request("picture", {}, self._read_answer, files)

    def finish(self) -> interface.VelocityEstimate:
        """Return the program's final estimate; its details contain the output and the time of the whole descent."""
        answer = self._session.send_request("finish", {}, self._read_answer)
        if answer is None:
            allowed = ", ".join(interface.VelocityOutcome.__members__)
            raise bad_answer(f"the answer to 'finish' has the outcome null; allowed: {allowed}")
        return answer

    def _send_without_answer(
        self, action: str, values: Mapping[str, Any], read: AnswerReader[interface.VelocityEstimate | None]
    ) -> None:
        """Send a request whose answer must contain no estimate."""
        if self._session.send_request(action, values, read) is not None:
            raise bad_answer(f"the answer to '{action}' has an outcome; it must be null")

    def _read_start(self, answer: Mapping[str, Any], details: ProgramDetails) -> interface.VelocityEstimate | None:
        """Decode the answer to 'start', whose key `inertial` requests increments and altitudes."""
        accepts_inertial = answer.get("inertial", False)
        if not isinstance(accepts_inertial, bool):
            raise bad_answer(f"inertial is {accepts_inertial!r}; allowed: true, or false")
        self._accepts_inertial = accepts_inertial
        return self._read_answer({key: value for key, value in answer.items() if key != "inertial"}, details)

    def _read_answer(self, answer: Mapping[str, Any], details: ProgramDetails) -> interface.VelocityEstimate | None:
        """Decode an estimate, or None for the outcome null; add output and time to those of the descent."""
        self._details = ProgramDetails(
            (self._details.stderr + details.stderr)[-MAX_STDERR_CHARACTERS:], self._details.time_s + details.time_s
        )
        if answer.get("outcome", "") is None:
            check_keys(answer, {"outcome"})
            return None
        return _read_velocity(answer, self._details)


@dataclass(frozen=True)
class ExecutableSiteEstimator:
    """Landing site estimator that runs an external program; `estimate` raises AlgorithmError if the program fails."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: LandingMeasurements) -> interface.SiteEstimate:
        """Write the measurements, run the program and return its estimate."""
        return run_case(self.command, self.limits, measurements, _read_site)


class ExecutableTargetTracker:
    """Target tracker that runs an external program: one JSON request line per call (docs/custom-algorithms.md).

    Methods raise AlgorithmError if the program fails. An `exec:` program ends with this tracker. A `serve:` program can
    be used by several trackers, one after another; a designation resets it.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._state = interface.TrackingState.NO_TARGET
        self._session = Session(command, limits)
        self._mast: MastCalibration | None = None
        self._mast_count = 0
        self._folder: Path | None = None  # of the mast's files

    @property
    def state(self) -> interface.TrackingState:
        """State of the tracker according to its last answer."""
        return self._state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """Send the target and the rover's pose."""
        values = {"target": encode_target(target), "world_from_rover": encode_pose(world_from_rover)}
        self._state = self._session.send_request("designate", values, _read_state)

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> interface.MastAim | None:
        """Request the mast angles and the image regions of interest."""
        values = {"world_from_rover": encode_pose(world_from_rover), "mast": self._write_mast(mast)}
        return self._session.send_request("aim", values, lambda answer, _: check_aim(_read_aim(answer), mast))

    def update(self, measurements: RoverMeasurements) -> interface.TargetUpdate:
        """Send the images of a rover stop and return the program's answer."""
        values = {"mast": self._write_mast(measurements.mast)}
        files = {"stop": lambda folder: write_stop(folder, measurements)}
        update = self._session.send_request("update", values, _read_update, files)
        self._state = update.state
        return update

    def clear(self) -> None:
        """Clear the target."""
        self._state = self._session.send_request("clear", {}, _read_state)

    def _write_mast(self, mast: MastCalibration) -> str:
        """Write the mast's files if the mast differs from that of the last call; return their folder."""
        if mast is not self._mast:
            self._mast, self._mast_count = mast, self._mast_count + 1
            self._folder = self._session.folder / f"mast_{self._mast_count}"
            self._folder.mkdir()
            write_mast(self._folder, mast)
        return str(self._folder)


# Functions that decode an answer; they raise AlgorithmError (BAD_ANSWER) if it does not conform to the exchange format.


def _read_velocity(answer: Mapping[str, Any], details: ProgramDetails) -> interface.VelocityEstimate:
    check_keys(answer, {"outcome", "velocity_m_s", "covariance_m2_s2", "span_s"})
    span = read_numbers(answer, "span_s", (2,))
    estimate = interface.VelocityEstimate(
        outcome=read_member("outcome", answer.get("outcome"), interface.VelocityOutcome),
        velocity_m_s=read_numbers(answer, "velocity_m_s", (2,)),
        details=details,
        covariance_m2_s2=read_numbers(answer, "covariance_m2_s2", (2, 2)),
        span_s=None if span is None else (float(span[0]), float(span[1])),
    )
    return check_velocity(estimate)


def _read_site(answer: Mapping[str, Any], details: ProgramDetails) -> interface.SiteEstimate:
    check_keys(answer, {"outcome", "site_world"})
    outcome = read_member("outcome", answer.get("outcome"), interface.SiteOutcome)
    return check_site(interface.SiteEstimate(outcome, read_numbers(answer, "site_world", (3,)), details))


def _read_state(answer: Mapping[str, Any], _details: ProgramDetails) -> interface.TrackingState:
    check_keys(answer, {"state"})
    return read_member("state", answer.get("state"), interface.TrackingState)


def _read_aim(answer: Mapping[str, Any]) -> interface.MastAim | None:
    check_keys(answer, {"aim"})
    aim = answer.get("aim")
    if aim is None:
        return None
    if not isinstance(aim, dict):
        raise bad_answer(f"aim is {aim!r}; allowed: null, or a table of azimuth_rad, elevation_rad, left, right")
    angles = [read_numbers(aim, name, ()) for name in ("azimuth_rad", "elevation_rad")]
    if angles[0] is None or angles[1] is None:
        raise bad_answer("an angle of aim is missing; expected azimuth_rad and elevation_rad")
    return interface.MastAim(float(angles[0]), float(angles[1]), _read_box(aim, "left"), _read_box(aim, "right"))


def _read_box(aim: Mapping[str, Any], name: str) -> interface.PixelBox:
    box = aim.get(name)
    corner, size = (box.get("corner"), box.get("size")) if isinstance(box, dict) else (None, None)
    if not isinstance(corner, list) or not isinstance(size, list) or not len(corner) == len(size) == 2:
        raise bad_answer(f'{name} is {box!r}; allowed: {{"corner": [column, row], "size": [columns, rows]}}')
    return interface.PixelBox((corner[0], corner[1]), (size[0], size[1]))


def _read_update(answer: Mapping[str, Any], details: ProgramDetails) -> interface.TargetUpdate:
    check_keys(answer, {"state", "losses", "position_rover"})
    losses = answer.get("losses", [])
    if not isinstance(losses, list):
        raise bad_answer(f"losses is {losses!r}; allowed: a list of {', '.join(interface.TargetLoss.__members__)}")
    position = read_numbers(answer, "position_rover", (3,))
    state = read_member("state", answer.get("state"), interface.TrackingState)
    decoded_losses = tuple(read_member("a loss", loss, interface.TargetLoss) for loss in losses)
    return check_update(interface.TargetUpdate(state, decoded_losses, position, details))
