"""Estimators that hand their measurements to a program, and read its answer."""

from __future__ import annotations

import atexit
import json
import shlex
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from algorithms.answers import checked_site, checked_velocity
from algorithms.exchange.files import EXCHANGE, write_case
from algorithms.exchange.process import Child, Command, ExecutableLimits, Said
from algorithms.faults import AlgorithmError, Fault
from algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from sim.measurements import DescentMeasurements, LandingMeasurements

#: How a program is named: one process a case, or one process for many.
PREFIXES: Mapping[str, bool] = {"exec:": False, "serve:": True}

Member = TypeVar("Member", bound=Enum)
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class ProgramDetails:
    """What is known of a program's answer beside it: its standard error, and the wall-clock time that it took."""

    stderr: str
    time_s: float


def command_of(text: str) -> Command | None:
    """The program that a text names (`exec:./mine --flag`); None where it names none.

    Raises
    ------
    ValueError
        Where it names one that is not there, or its quotes do not close.
    """
    prefix = next((one for one in PREFIXES if text.startswith(one)), None)
    if prefix is None:
        return None
    try:
        words = shlex.split(text.removeprefix(prefix))
    except ValueError as error:
        raise ValueError(f"'{text}' cannot be read: {error}") from error
    if not words:
        raise ValueError(f"'{text}' names no program; expected {prefix}PROGRAM, with arguments behind it")
    if shutil.which(words[0]) is None:
        where = "is not there, or may not be run" if "/" in words[0] else "is not on the PATH; write ./ before your own"
        raise ValueError(f"no program for '{text}': {words[0]} {where}")
    return Command(tuple(words), PREFIXES[prefix])


@dataclass(frozen=True)
class ExecutableVelocityEstimator:
    """A velocity estimator that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The program's answer."""
        answer, details = _asked(self.command, self.limits, measurements)
        allowed = {"exchange", "outcome", "velocity_m_s", "covariance_m2_s2"}
        return _in_its_words(
            details,
            lambda: checked_velocity(
                VelocityEstimate(
                    outcome=_outcome(answer, VelocityOutcome, allowed),
                    velocity_m_s=_numbers(answer, "velocity_m_s", (2,)),
                    details=details,
                    covariance_m2_s2=_numbers(answer, "covariance_m2_s2", (2, 2)),
                )
            ),
        )


@dataclass(frozen=True)
class ExecutableSiteEstimator:
    """An estimator of landing sites that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The program's answer."""
        answer, details = _asked(self.command, self.limits, measurements)
        return _in_its_words(
            details,
            lambda: checked_site(
                SiteEstimate(
                    outcome=_outcome(answer, SiteOutcome, {"exchange", "outcome", "site_world"}),
                    site_world=_numbers(answer, "site_world", (3,)),
                    details=details,
                )
            ),
        )


def _asked(
    command: Command, limits: ExecutableLimits, measurements: DescentMeasurements | LandingMeasurements
) -> tuple[Mapping[str, Any], ProgramDetails]:
    """Hands a case to a program; its answer, read but not checked."""
    with tempfile.TemporaryDirectory(prefix="marsyard-case-") as folder:
        write_case(Path(folder), measurements)
        said = _persistent(command, limits, folder) if command.persistent else _once(command, limits, folder)
    return _json(said.output, said.stderr), ProgramDetails(said.stderr, said.time_s)


def _once(command: Command, limits: ExecutableLimits, folder: str) -> Said:
    return Child((*command.words, folder), limits).answer()


#: Persistent programs of this process, by their command and limits.
_serving: dict[tuple[Command, ExecutableLimits], Child] = {}


def _persistent(command: Command, limits: ExecutableLimits, folder: str) -> Said:
    """An answer of a program that runs on; one that fails is ended, and started anew for the next case."""
    key = (command, limits)
    child = _serving.pop(key, None) or _greeted(command, limits)
    said = child.line(json.dumps({"exchange": EXCHANGE, "case": folder}))
    _serving[key] = child
    return said


def _greeted(command: Command, limits: ExecutableLimits) -> Child:
    """A program that was started and has said that it is ready, in the exchange's version."""
    child = Child(command.words, limits)
    said = child.line()
    greeting: Mapping[str, Any] | None = None
    try:
        greeting = _json(said.output, said.stderr)
    finally:
        if greeting is None:
            child.leave()
    if dict(greeting) != {"exchange": EXCHANGE, "ready": True}:
        child.leave()
        message = f'its first line is {_short(said.output)}; expected {{"exchange": {EXCHANGE}, "ready": true}}'
        raise AlgorithmError(Fault.BAD_ANSWER, message, said.stderr)
    return child


@atexit.register
def end_persistent() -> None:
    """Ends the persistent programs of this process."""
    while _serving:
        _serving.popitem()[1].leave()


def _json(output: bytes, stderr: str) -> Mapping[str, Any]:
    """An answer's table."""
    try:
        answer = json.loads(output.decode("utf-8"), parse_constant=float)
    except (ValueError, RecursionError) as error:
        message = f"its output is not one JSON object: {_short(output)} ({error})"
        raise AlgorithmError(Fault.BAD_ANSWER, message, stderr) from error
    if not isinstance(answer, dict):
        raise AlgorithmError(Fault.BAD_ANSWER, f"its output is not one JSON object: {_short(output)}", stderr)
    return answer


def _outcome(answer: Mapping[str, Any], outcomes: type[Member], allowed: set[str]) -> Member:
    """The outcome that an answer names, once its version and its keys are right."""
    if type(answer.get("exchange")) is not int or answer["exchange"] != EXCHANGE:
        raise _bad(f"the answer's exchange is {answer.get('exchange')!r}; allowed: {EXCHANGE}")
    unknown = sorted(set(answer) - allowed)
    if unknown:
        raise _bad(f"the answer has an unknown key '{unknown[0]}'; allowed: {', '.join(sorted(allowed))}")
    named = answer.get("outcome")
    if not isinstance(named, str) or named not in outcomes.__members__:
        raise _bad(f"outcome is {named!r}; allowed: {', '.join(outcomes.__members__)}")
    return outcomes[named]


def _numbers(answer: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """A list of numbers in an answer; None where it is null or left out."""
    value = answer.get(name)
    if value is None:
        return None
    if not _is_nested(value, shape):
        raise _bad(f"{name} is {_short(json.dumps(value).encode())}; allowed: numbers in the shape {list(shape)}")
    return np.array(value, dtype=np.float64)


def _is_nested(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value is numbers in lists of these lengths."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    return isinstance(value, list) and len(value) == shape[0] and all(_is_nested(one, shape[1:]) for one in value)


def _in_its_words(details: ProgramDetails, make: Callable[[], Answer]) -> Answer:
    """Makes an answer; a fault in it carries what the program wrote."""
    try:
        return make()
    except AlgorithmError as error:
        raise AlgorithmError(error.fault, str(error), details.stderr) from error


def _bad(message: str) -> AlgorithmError:
    return AlgorithmError(Fault.BAD_ANSWER, message)


def _short(raw: bytes) -> str:
    text = raw[:200].decode("utf-8", errors="replace")
    return repr(text + ("..." if len(raw) > 200 else ""))
