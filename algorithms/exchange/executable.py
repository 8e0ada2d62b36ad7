"""Estimators that hand their measurements to a program, and read its answer."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.algorithms.answers import checked_site, checked_velocity
from marsyard.algorithms.exchange import serving
from marsyard.algorithms.exchange.files import write_case, write_frame
from marsyard.algorithms.exchange.process import KEPT_STDERR, Child, Command, ExecutableLimits, Said
from marsyard.algorithms.exchange.replies import (
    ProgramDetails,
    bad_answer,
    check_keys,
    in_its_words,
    member,
    numbers,
    table_of,
)
from marsyard.algorithms.exchange.session import Session
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.sim.measurements import DescentFrame, DescentMeasurements, LandingMeasurements


@dataclass(frozen=True)
class ExecutableVelocityEstimator:
    """A velocity estimator that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The program's answer."""
        answer, details = _asked(self.command, self.limits, measurements)
        return in_its_words(details.stderr, lambda: checked_velocity(_velocity(answer, details)))


class ExecutableVelocityStream:
    """A stream of pictures' estimator that is a program (docs/own-algorithms.md), asked line by line.

    Raises AlgorithmError where that fails to answer. With `serve-stream:` it may have followed other descents before.
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._session = Session(command, limits)
        self._told = ProgramDetails("", 0.0)

    def start(self) -> None:
        """Tells that a descent begins."""
        self._told = ProgramDetails("", 0.0)
        if self._asked("start", {}) is not None:
            raise bad_answer("start is answered with an outcome; allowed: null, before the first picture")

    def picture(self, frame: DescentFrame) -> VelocityEstimate | None:
        """The program's answer to one more picture."""
        return self._asked("picture", {"frame": lambda folder: write_frame(folder, frame)})

    def finish(self) -> VelocityEstimate:
        """The program's answer to the descent; its details tell of all its words and time in it."""
        answer = self._asked("finish", {})
        if answer is None:
            raise bad_answer("finish is answered with the outcome null; allowed: one of the outcomes")
        return answer

    def _asked(self, do: str, files: Mapping[str, Callable[[Path], None]]) -> VelocityEstimate | None:
        answer, said = self._session.ask(do, {}, files)
        self._told = ProgramDetails((self._told.stderr + said.stderr)[-KEPT_STDERR:], self._told.time_s + said.time_s)
        return in_its_words(said.stderr, lambda: _velocity_yet(answer, self._told))


@dataclass(frozen=True)
class ExecutableSiteEstimator:
    """An estimator of landing sites that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The program's answer."""
        answer, details = _asked(self.command, self.limits, measurements)
        return in_its_words(details.stderr, lambda: checked_site(_site(answer, details)))


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


def _asked(
    command: Command, limits: ExecutableLimits, measurements: DescentMeasurements | LandingMeasurements
) -> tuple[Mapping[str, Any], ProgramDetails]:
    """Hands a case to a program; its answer, read but not checked."""
    with tempfile.TemporaryDirectory(prefix="marsyard-case-") as folder:
        write_case(Path(folder), measurements)
        answer, said = (_ask_server if command.persistent else _run_once)(command, limits, folder)
    return answer, ProgramDetails(said.stderr, said.time_s)


def _run_once(command: Command, limits: ExecutableLimits, folder: str) -> tuple[Mapping[str, Any], Said]:
    said = Child((*command.words, folder), limits).answer()
    return table_of(said), said


def _ask_server(command: Command, limits: ExecutableLimits, folder: str) -> tuple[Mapping[str, Any], Said]:
    """The answer of a program that runs on; one that fails is ended, and started again for the next case."""
    server = serving.taken(command, limits)
    answer, said = server.ask({"case": folder})
    serving.given_back(command, limits, server)
    return answer, said
