"""Target trackers that are programs: one process a run, or one for many, asked line by line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.answers import checked_aim, checked_update
from marsyard.algorithms.exchange.process import Command, ExecutableLimits
from marsyard.algorithms.exchange.replies import (
    ProgramDetails,
    bad_answer,
    check_keys,
    in_its_words,
    member,
    named,
    numbers,
)
from marsyard.algorithms.exchange.session import Session
from marsyard.algorithms.exchange.stops import told_pose, told_target, write_mast, write_stop
from marsyard.algorithms.interface import MastAim, PixelBox, TargetLoss, TargetUpdate, TrackingState
from marsyard.sim.measurements import MastCalibration, RoverMeasurements, TargetDesignation


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
        self._tell("designate", {"target": told_target(target), "world_from_rover": told_pose(world_from_rover)})

    def aim(self, world_from_rover: RigidTransform, mast: MastCalibration) -> MastAim | None:
        """Where the program wants the mast to look."""
        told = {"world_from_rover": told_pose(world_from_rover), "mast": self._told_mast(mast)}
        answer, details = self._session.ask("aim", told)
        return in_its_words(details.stderr, lambda: checked_aim(_aim(answer), mast))

    def update(self, measurements: RoverMeasurements) -> TargetUpdate:
        """The program's answer to a stop's pictures."""
        told = {"mast": self._told_mast(measurements.mast)}
        answer, details = self._session.ask("update", told, {"stop": lambda folder: write_stop(folder, measurements)})
        update = in_its_words(details.stderr, lambda: checked_update(_update(answer, details)))
        self._state = update.state
        return update

    def clear(self) -> None:
        """Has the program forget the target."""
        self._tell("clear", {})

    def _tell(self, do: str, told: Mapping[str, Any]) -> None:
        answer, details = self._session.ask(do, told)
        self._state = in_its_words(details.stderr, lambda: _state(answer))

    def _told_mast(self, mast: MastCalibration) -> str:
        """The folder in which the mast stands, written when it is another than before."""
        if mast is not self._mast:
            self._mast, self._masts = mast, self._masts + 1
            self._mast_folder().mkdir()
            write_mast(self._mast_folder(), mast)
        return str(self._mast_folder())

    def _mast_folder(self) -> Path:
        return self._session.folder / f"mast_{self._masts}"


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
