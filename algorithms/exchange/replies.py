"""Reads what a program answers: one JSON object with the exchange's version, known keys, and numbers in their shape."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeVar

import numpy as np

from marsyard.algorithms.exchange.files import ANSWER_VERSIONS
from marsyard.algorithms.exchange.process import Said, shortened
from marsyard.algorithms.faults import AlgorithmError, Fault

Member = TypeVar("Member", bound=Enum)
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class ProgramDetails:
    """What is known of a program's answer beside it: its standard error, and the wall-clock time that it took."""

    stderr: str
    time_s: float


def table_of(said: Said) -> Mapping[str, Any]:
    """The table that a program wrote, its keys not looked at. Raises AlgorithmError (BAD_ANSWER) where it is none."""
    try:
        answer = json.loads(said.output.decode("utf-8"), parse_constant=float)
    except (ValueError, RecursionError) as error:
        message = f"its output is not one JSON object: {shortened(said.output)} ({error})"
        raise AlgorithmError(Fault.BAD_ANSWER, message, said.stderr) from error
    if not isinstance(answer, dict):
        raise AlgorithmError(
            Fault.BAD_ANSWER, f"its output is not one JSON object: {shortened(said.output)}", said.stderr
        )
    return answer


def check_keys(answer: Mapping[str, Any], allowed: set[str]) -> None:
    """Raises AlgorithmError (BAD_ANSWER) where a table's version is another, or it has a key that is not allowed."""
    if type(answer.get("exchange")) is not int or answer["exchange"] not in ANSWER_VERSIONS:
        raise bad_answer(
            f"the answer's exchange is {answer.get('exchange')!r}; allowed: {', '.join(map(str, ANSWER_VERSIONS))}"
        )
    unknown = sorted(set(answer) - allowed - {"exchange"})
    if unknown:
        raise bad_answer(
            f"the answer has an unknown key '{unknown[0]}'; allowed: {', '.join(sorted(allowed | {'exchange'}))}"
        )


def member(answer: Mapping[str, Any], name: str, kinds: type[Member]) -> Member:
    """The member of an enumeration that an answer names under a key."""
    return named(name, answer.get(name), kinds)


def named(what: str, name: object, kinds: type[Member]) -> Member:
    """The member of an enumeration of a name."""
    if not isinstance(name, str) or name not in kinds.__members__:
        raise bad_answer(f"{what} is {name!r}; allowed: {', '.join(kinds.__members__)}")
    return kinds[name]


def numbers(answer: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """A list of numbers in an answer; None where it is null or left out."""
    value = answer.get(name)
    if value is None:
        return None
    if not _is_nested(value, shape):
        shown = shortened(json.dumps(value).encode())
        raise bad_answer(f"{name} is {shown}; allowed: numbers in the shape {list(shape)}")
    return np.array(value, dtype=np.float64)


def _is_nested(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value is numbers in lists of these lengths."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    return isinstance(value, list) and len(value) == shape[0] and all(_is_nested(one, shape[1:]) for one in value)


def in_its_words(stderr: str, make: Callable[[], Answer]) -> Answer:
    """Makes an answer; a fault in it carries what the program wrote to its standard error."""
    try:
        return make()
    except AlgorithmError as error:
        raise AlgorithmError(error.fault, str(error), stderr) from error


def bad_answer(message: str) -> AlgorithmError:
    """The fault of an answer that is not of the form that the exchange states."""
    return AlgorithmError(Fault.BAD_ANSWER, message)
