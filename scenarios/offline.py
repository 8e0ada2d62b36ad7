"""Algorithms that run outside of Marsyard: export the cases, and read the answers from a table.

Both replace an algorithm of a campaign: ``export:FOLDER`` writes its inputs and gives no answer, ``answers:FILE.csv``
returns the answer in its table.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from marsyard.algorithms.answers import AlgorithmError, Fault, check_site, check_velocity
from marsyard.algorithms.exchange import write_case
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.scenarios.user_files import check_together, finite_number, format_problems, parse_table
from marsyard.sim.files import check_regular
from marsyard.sim.measurements import LandingMeasurements

EXPORT, ANSWERS = "export:", "answers:"

#: Folder of the cases in an export.
CASES = "cases"

#: Maximum number of rows of a table of answers.
MAX_ROWS = 10_000_000
#: Maximum magnitudes; larger numbers are probably in another unit than that of the column's name.
_MAX_MAGNITUDE = {"_m_s": 1e3, "_m2_s2": 1e6, "_m": 1e6, "_s": 1e6}

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class OfflineForm(Generic[Answer]):
    """Form of a task's answers in a table.

    - required: columns of numbers next to `case` and `outcome`: all are filled, or none
    - optional: groups of further columns of numbers: all of a group are filled, or none
    - outcomes: allowed outcomes; an empty one with numbers is the first of them
    - answer: makes a valid answer from outcome and numbers. Raises AlgorithmError.
    - nothing: makes the answer of an export
    - completed: adds the inputs that a failed answer contains
    - note: explanation of the columns for the user
    """

    required: tuple[str, ...]
    optional: tuple[tuple[str, ...], ...]
    outcomes: type[Enum]
    answer: Callable[[Enum, Mapping[str, float]], Answer]
    nothing: Callable[[Any], Answer]
    completed: Callable[[Answer, Any], Answer] = lambda answer, _: answer
    note: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns."""
        return ("case", "outcome", *self.required, *(name for group in self.optional for name in group))


def _velocity(outcome: Enum, numbers: Mapping[str, float]) -> VelocityEstimate:
    groups = (VELOCITY_FORM.required, *VELOCITY_FORM.optional)
    velocity, covariance, span = ([numbers[name] for name in group if name in numbers] for group in groups)
    stated = VelocityEstimate(
        outcome=VelocityOutcome(outcome),
        velocity_m_s=np.array(velocity) if velocity else None,
        covariance_m2_s2=np.array([covariance[:2], covariance[1:]]) if covariance else None,
        span_s=(span[0], span[1]) if span else None,
    )
    return check_velocity(stated)


def _site(outcome: Enum, numbers: Mapping[str, float]) -> SiteEstimate:
    position = [numbers[name] for name in SITE_FORM.required if name in numbers]
    stated = SiteEstimate(SiteOutcome(outcome), np.array(position) if position else None)
    return check_site(stated) if position or stated.outcome.converged else stated


def _with_site(estimate: SiteEstimate, measurements: LandingMeasurements) -> SiteEstimate:
    """Return the a-priori site where the algorithm did not converge."""
    if estimate.outcome.converged or estimate.site_world is not None:
        return estimate
    return SiteEstimate(estimate.outcome, measurements.apriori_site_world)


VELOCITY_FORM: OfflineForm[VelocityEstimate] = OfflineForm(
    required=("velocity_east_m_s", "velocity_north_m_s"),
    optional=(("covariance_east_m2_s2", "covariance_east_north_m2_s2", "covariance_north_m2_s2"), ("start_s", "end_s")),
    outcomes=VelocityOutcome,
    answer=_velocity,
    nothing=lambda _: VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None),
    note="A velocity is the mean between the last two pictures, or between the time tags `start_s` and `end_s`.",
)
SITE_FORM: OfflineForm[SiteEstimate] = OfflineForm(
    required=("site_east_m", "site_north_m", "site_up_m"),
    optional=(),
    outcomes=SiteOutcome,
    answer=_site,
    nothing=lambda measurements: SiteEstimate(SiteOutcome.NO_STRUCTURE, measurements.apriori_site_world),
    completed=_with_site,
)


def is_offline(spec: str) -> bool:
    """Return whether a name is an export or a table of answers."""
    return spec.startswith((EXPORT, ANSWERS))


def answers_file(spec: str) -> Path | None:
    """Return the path of a table of answers; None for other names."""
    return Path(spec.removeprefix(ANSWERS)) if spec.startswith(ANSWERS) else None


def create_offline(spec: str, form: OfflineForm[Any], case: int) -> Any:
    """Create the replacement of an algorithm in a case."""
    file = answers_file(spec)
    if file is None:
        return Recorder(Path(spec.removeprefix(EXPORT)) / CASES / f"{case:06d}", form)
    return RecordedAnswer(read_answers(file, form).get(case), f"{file.name} has no answer to case {case}", form)


@dataclass(frozen=True)
class Recorder:
    """Writes its inputs into a folder, completely or not at all, and gives no answer."""

    folder: Path
    form: OfflineForm[Any]

    def estimate(self, measurements: Any) -> Any:
        """Write a case. Raises OSError."""
        unfinished = self.folder.with_name(f"{self.folder.name}.part{os.getpid()}")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        write_case(unfinished, measurements, pictures="png")
        shutil.rmtree(self.folder, ignore_errors=True)
        unfinished.rename(self.folder)
        return self.form.nothing(measurements)


@dataclass(frozen=True)
class RecordedAnswer(Generic[Answer]):
    """Returns the answer of a table."""

    answer: Answer | None
    missing: str
    form: OfflineForm[Answer]

    def estimate(self, measurements: Any) -> Answer:
        """Return the answer. Raises AlgorithmError where the table has none."""
        if self.answer is None:
            raise AlgorithmError(Fault.BAD_ANSWER, self.missing)
        return self.form.completed(self.answer, measurements)


def read_answers(file: Path, form: OfflineForm[Answer]) -> Mapping[int, Answer]:
    """Return the answers of a table by case. Raises ValueError, which lists all problems by line."""
    try:
        status = check_regular(file)
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror or error}") from error
    return _read(file, form, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _read(file: Path, form: OfflineForm[Any], _time: int, _size: int) -> Mapping[int, Any]:
    first_lines: dict[int, int] = {}

    def parse(line: int, cells: Mapping[str, str]) -> tuple[int, Any]:
        case, answer = _parse_answer(cells, form)
        if case in first_lines:
            raise ValueError(f"case {case} is answered twice, before in line {first_lines[case]}")
        first_lines[case] = line
        return case, answer

    hint = f"allowed: {', '.join(form.columns)}; units are those of the names"
    answers, problems = parse_table(file, MAX_ROWS, ("case", *form.required), form.columns, hint, parse)
    if problems:
        raise ValueError(format_problems(file, problems))
    return dict(answers)


def _parse_answer(stated: Mapping[str, str], form: OfflineForm[Any]) -> tuple[int, Any]:
    if not stated["case"].isdecimal():
        raise ValueError(f"case is '{stated['case']}'; allowed: a whole number from 0")
    numbers = {}
    for name, text in ((name, text) for name, text in stated.items() if name in form.columns[2:] and text):
        numbers[name] = value = finite_number(name, text, ", or nothing where the outcome is a failure")
        unit, limit = next((unit, limit) for unit, limit in _MAX_MAGNITUDE.items() if name.endswith(unit))
        if abs(value) > limit:
            raise ValueError(f"{name} is {text}, beyond {limit:g}; is it in the unit that the name ends with ({unit})?")
    check_together((form.required, *form.optional), numbers)
    outcome, outcomes = stated.get("outcome", ""), form.outcomes.__members__
    if not outcome and not numbers:
        raise ValueError("neither an outcome nor numbers are given")
    if outcome and outcome not in outcomes:
        raise ValueError(f"outcome is '{outcome}'; allowed: {', '.join(outcomes)}")
    # an empty outcome with numbers is the first one
    return int(stated["case"]), form.answer(outcomes[outcome or next(iter(outcomes))], numbers)
