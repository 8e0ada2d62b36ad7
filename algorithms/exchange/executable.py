"""Algorithms that are programs: measurements as files, answers as JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import checked_aim, checked_site, checked_update, checked_velocity
from marsyard.algorithms.exchange.files import write_case, write_frame
from marsyard.algorithms.exchange.process import KEPT_STDERR, Command, ExecutableLimits
from marsyard.algorithms.exchange.replies import (
    ProgramDetails,
    bad_answer,
    check_keys,
    in_its_words,
    member,
    named,
    numbers,
)
from marsyard.algorithms.exchange.serving import Session, ask_case
from marsyard.algorithms.exchange.stops import encode_pose, encode_target, write_mast, write_stop
from marsyard.algorithms.interface import (
    MastAim,
    PixelBox,
    SiteEstimate,
    SiteOutcome,
    TargetLoss,
    TargetUpdate,
    TrackingState,
    VelocityEstimate,
    VelocityOutcome,
)
from marsyard.sim.measurements import (
    DescentFrame,
    DescentMeasurements,
    LandingMeasurements,
    MastCalibration,
    RoverMeasurements,
    TargetDesignation,
)


@dataclass(frozen=True)
class ExecutableVelocityEstimator:
    """A velocity estimator that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The program's answer."""
        answer, details = ask_case(self.command, self.limits, lambda folder: write_case(folder, measurements))
        return in_its_words(details.stderr, lambda: checked_velocity(_velocity(answer, details)))


class ExecutableVelocityStream:
    """A stream of pictures' estimator that is a program (docs/own-algorithms.md), asked line by line.

    Raises AlgorithmError where that fails to answer. With `serve-stream:` it may have followed other descents before.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._session = Session(command, limits)
        self._details = ProgramDetails("", 0.0)

    def start(self) -> None:
        """Tells that a descent begins."""
        self._details = ProgramDetails("", 0.0)
        if self._ask("start", {}) is not None:
            raise bad_answer("start is answered with an outcome; allowed: null, before the first picture")

    def picture(self, frame: DescentFrame) -> VelocityEstimate | None:
        """The program's answer to one more picture."""
        return self._ask("picture", {"frame": lambda folder: write_frame(folder, frame)})

    def finish(self) -> VelocityEstimate:
        """The program's answer to the descent; its details tell of all its words and time in it."""
        answer = self._ask("finish", {})
        if answer is None:
            raise bad_answer("finish is answered with the outcome null; allowed: one of the outcomes")
        return answer

    def _ask(self, do: str, files: Mapping[str, Callable[[Path], None]]) -> VelocityEstimate | None:
        answer, said = self._session.ask(do, {}, files)
        self._details = ProgramDetails(
            (self._details.stderr + said.stderr)[-KEPT_STDERR:], self._details.time_s + said.time_s
        )
        return in_its_words(said.stderr, lambda: _velocity_yet(answer, self._details))


@dataclass(frozen=True)
class ExecutableSiteEstimator:
    """An estimator of landing sites that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The program's answer."""
        answer, details = ask_case(self.command, self.limits, lambda folder: write_case(folder, measurements))
        return in_its_words(details.stderr, lambda: checked_site(_site(answer, details)))


class ExecutableTargetTracker:
    """A target tracker that is a program (docs/own-algorithms.md). Raises AlgorithmError where that fails to answer.

    With `exec:` the program is this tracker's own and ends with it; with `serve:` it may have followed other targets
    before, and must forget them when one is designated.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._state = TrackingState.NO_TARGET
        self._session = Session(command, limits)
        self._mast: MastCalibration | None = None
        self._masts = 0

    @property
    def state(self) -> TrackingState:
        """Where the tracker stands, as it last said."""
        return self._state

    def designate(self, target: TargetDesignation, world_from_rover: RigidTransform) -> None:
        """Tells the target and the rover's pose."""
        self._ask_state(
            "designate", {"target": encode_target(target), "world_from_rover": encode_pose(world_from_rover)}
        )

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Where the program wants the mast to look."""
        values = {"world_from_rover": encode_pose(world_from_rover), "mast": self._write_mast(mast)}
        answer, details = self._session.ask("aim", values)
        return in_its_words(details.stderr, lambda: checked_aim(_aim(answer), mast))

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """The program's answer to a stop's pictures."""
        values = {"mast": self._write_mast(measurements.mast)}
        answer, details = self._session.ask("update", values, {"stop": lambda folder: write_stop(folder, measurements)})
        update = in_its_words(details.stderr, lambda: checked_update(_update(answer, details)))
        self._state = update.state
        return update

    def clear(self) -> None:
        """Has the program forget the target."""
        self._ask_state("clear", {})

    def _ask_state(self, do: str, values: Mapping[str, Any]) -> None:
        answer, details = self._session.ask(do, values)
        self._state = in_its_words(details.stderr, lambda: _state(answer))

    def _write_mast(self, mast: MastCalibration) -> str:
        """The folder of the mast's files, written when it is another mast than before."""
        if mast is not self._mast:
            self._mast, self._masts = mast, self._masts + 1
            self._mast_folder().mkdir()
            write_mast(self._mast_folder(), mast)
        return str(self._mast_folder())

    def _mast_folder(self) -> Path:
        return self._session.folder / f"mast_{self._masts}"


def _velocity_yet(answer: Mapping[str, Any], details: ProgramDetails) -> VelocityEstimate | None:
    """A stream's answer; None where it has none yet."""
    if answer.get("outcome", "") is None:
        check_keys(answer, {"outcome"})
        return None
    return checked_velocity(_velocity(answer, details))


def _velocity(answer: Mapping[str, Any], details: ProgramDetails) -> VelocityEstimate:
    check_keys(answer, {"outcome", "velocity_m_s", "covariance_m2_s2", "span_s"})
    span = numbers(answer, "span_s", (2,))
    return VelocityEstimate(
        outcome=member(answer, "outcome", VelocityOutcome),
        velocity_m_s=numbers(answer, "velocity_m_s", (2,)),
        details=details,
        covariance_m2_s2=numbers(answer, "covariance_m2_s2", (2, 2)),
        span_s=None if span is None else (float(span[0]), float(span[1])),
    )


def _site(answer: Mapping[str, Any], details: ProgramDetails) -> SiteEstimate:
    check_keys(answer, {"outcome", "site_world"})
    return SiteEstimate(
        outcome=member(answer, "outcome", SiteOutcome),
        site_world=numbers(answer, "site_world", (3,)),
        details=details,
    )


def _state(answer: Mapping[str, Any]) -> TrackingState:
    check_keys(answer, {"state"})
    return member(answer, "state", TrackingState)


def _aim(answer: Mapping[str, Any]) -> MastAim | None:
    check_keys(answer, {"aim"})
    aim = answer.get("aim")
    if aim is None:
        return None
    if not isinstance(aim, dict):
        raise bad_answer(f"aim is {aim!r}; allowed: null, or a table of azimuth_rad, elevation_rad, left, right")
    angles = [numbers(aim, name, ()) for name in ("azimuth_rad", "elevation_rad")]
    if angles[0] is None or angles[1] is None:
        raise bad_answer("aim lacks an angle; expected azimuth_rad and elevation_rad")
    return MastAim(float(angles[0]), float(angles[1]), _box(aim, "left"), _box(aim, "right"))


def _box(aim: Mapping[str, Any], name: str) -> PixelBox:
    box = aim.get(name)
    corner, size = (box.get("corner"), box.get("size")) if isinstance(box, dict) else (None, None)
    if not isinstance(corner, list) or not isinstance(size, list) or not len(corner) == len(size) == 2:
        raise bad_answer(f'{name} is {box!r}; allowed: {{"corner": [column, row], "size": [columns, rows]}}')
    return PixelBox((corner[0], corner[1]), (size[0], size[1]))


def _update(answer: Mapping[str, Any], details: ProgramDetails) -> TargetUpdate:
    check_keys(answer, {"state", "losses", "position_rover"})
    losses = answer.get("losses", [])
    if not isinstance(losses, list):
        raise bad_answer(f"losses is {losses!r}; allowed: a list of {', '.join(TargetLoss.__members__)}")
    position = numbers(answer, "position_rover", (3,))
    return TargetUpdate(
        state=member(answer, "state", TrackingState),
        losses=tuple(named("a loss", one, TargetLoss) for one in losses),
        position_rover=None if position is None else np.asarray(position),
        details=details,
    )
