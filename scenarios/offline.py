"""Algorithms that are run elsewhere: cases are written down for them, and their answers come back in a table.

Both stand in for an algorithm: ``export:FOLDER`` writes what it is given and answers nothing, ``answers:FILE.csv``
answers what its table says of the case. All around them is a campaign as any other: the same cases, the same scoring.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from marsyard.algorithms.answers import checked_site, checked_velocity
from marsyard.algorithms.exchange import write_case
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from marsyard.scenarios.csv_rows import cells_by_column, check_together, finite_number, header_problems, read_lines
from marsyard.scenarios.own_files import listed
from marsyard.sim.files import check_regular
from marsyard.sim.measurements import DescentMeasurements, LandingMeasurements

EXPORT, ANSWERS = "export:", "answers:"

#: Folder of the cases in what is exported.
CASES = "cases"

#: Rows of a table of answers, at most.
MAX_ROWS = 10_000_000
#: Sizes beyond which a number is taken to be in another unit than its column's name says.
_MOST = {"_m_s": 1e3, "_m2_s2": 1e6, "_m": 1e6, "_s": 1e6}

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class OfflineForm(Generic[Answer]):
    """How a task's answers stand in a table.

    Attributes
    ----------
    required
        Columns of numbers beside `case` and `outcome`: all are filled, or none.
    optional
        Groups of columns of numbers that may be left out, each group likewise.
    outcomes
        What `outcome` may be; left empty where the required numbers are there: the first of them.
    answer
        The answer from its outcome and numbers, held against the interface. Raises AlgorithmError.
    nothing
        What one that only writes cases down answers.
    completed
        An answer with what a table leaves out of it.
    note
        What columns mean beyond their names, for whoever answers.
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
        """All that there may be."""
        return ("case", "outcome", *self.required, *(name for group in self.optional for name in group))


def _velocity(outcome: Enum, numbers: Mapping[str, float]) -> VelocityEstimate:
    east, north = (numbers.get(name) for name in VELOCITY_FORM.required)
    first, mixed, second, start, end = (numbers.get(name) for group in VELOCITY_FORM.optional for name in group)
    stated = VelocityEstimate(
        outcome=VelocityOutcome(outcome),
        velocity_m_s=None if east is None or north is None else np.array([east, north]),
        covariance_m2_s2=None
        if first is None or mixed is None or second is None
        else np.array([[first, mixed], [mixed, second]]),
        span_s=None if start is None or end is None else (start, end),
    )
    return checked_velocity(stated)


def _no_velocity(_measurements: DescentMeasurements) -> VelocityEstimate:
    return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)


def _site(outcome: Enum, numbers: Mapping[str, float]) -> SiteEstimate:
    place = [numbers[name] for name in SITE_FORM.required if name in numbers]
    stated = SiteEstimate(SiteOutcome(outcome), np.array(place) if place else None)
    return checked_site(stated) if place or stated.outcome.converged else stated


def _with_site(estimate: SiteEstimate, measurements: LandingMeasurements) -> SiteEstimate:
    """Where the algorithm did not converge, the a-priori site is what is left."""
    if estimate.outcome.converged or estimate.site_world is not None:
        return estimate
    return SiteEstimate(estimate.outcome, measurements.apriori_site_world)


def _no_site(measurements: LandingMeasurements) -> SiteEstimate:
    return SiteEstimate(SiteOutcome.NO_STRUCTURE, measurements.apriori_site_world)


VELOCITY_FORM: OfflineForm[VelocityEstimate] = OfflineForm(
    required=("velocity_east_m_s", "velocity_north_m_s"),
    optional=(
        ("covariance_east_m2_s2", "covariance_east_north_m2_s2", "covariance_north_m2_s2"),
        ("start_s", "end_s"),
    ),
    outcomes=VelocityOutcome,
    answer=_velocity,
    nothing=_no_velocity,
    note="A velocity is the mean between the last two pictures, or between the time tags `start_s` and `end_s`.",
)
SITE_FORM: OfflineForm[SiteEstimate] = OfflineForm(
    required=("site_east_m", "site_north_m", "site_up_m"),
    optional=(),
    outcomes=SiteOutcome,
    answer=_site,
    nothing=_no_site,
    completed=_with_site,
)


def is_offline(spec: str) -> bool:
    """Whether a name is one of this module's."""
    return spec.startswith((EXPORT, ANSWERS))


def answers_file(spec: str) -> Path | None:
    """The table that a name points to; None where it is not `answers:`."""
    return Path(spec.removeprefix(ANSWERS)) if spec.startswith(ANSWERS) else None


def check_offline(spec: str, form: OfflineForm[Any]) -> None:
    """Raises ValueError where a table cannot be read; the message names lines and columns."""
    file = answers_file(spec)
    if file is not None:
        answers_of(file, form)


def made_offline(spec: str, form: OfflineForm[Any], case: int) -> Any:
    """What stands in for an algorithm in a case."""
    file = answers_file(spec)
    if file is None:
        return Recorder(case_folder(Path(spec.removeprefix(EXPORT)), case), form)
    return Answered(answers_of(file, form).get(case), f"{file.name} has no answer to case {case}", form)


def case_folder(folder: Path, case: int) -> Path:
    """Where a case is written."""
    return folder / CASES / f"{case:06d}"


@dataclass(frozen=True)
class Recorder:
    """Writes what it is given into a folder, whole or not at all, and answers nothing."""

    folder: Path
    form: OfflineForm[Any]

    def estimate(self, measurements: Any) -> Any:
        """Writes a case. Raises OSError where that fails."""
        unfinished = self.folder.with_name(f"{self.folder.name}.part{os.getpid()}")
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        write_case(unfinished, measurements, pictures="png")
        shutil.rmtree(self.folder, ignore_errors=True)
        unfinished.rename(self.folder)
        return self.form.nothing(measurements)


@dataclass(frozen=True)
class Answered(Generic[Answer]):
    """Answers what was answered elsewhere; raises AlgorithmError where nothing was."""

    answer: Answer | None
    lacking: str
    form: OfflineForm[Answer]

    def estimate(self, measurements: Any) -> Answer:
        """The answer."""
        if self.answer is None:
            raise AlgorithmError(Fault.BAD_ANSWER, self.lacking)
        return self.form.completed(self.answer, measurements)


def answers_of(file: Path, form: OfflineForm[Answer]) -> Mapping[int, Answer]:
    """The answers of a table by their cases.

    Raises
    ------
    ValueError
        Where the file cannot be read, or holds anything that is no answer; all that is wrong is told, by line.
    """
    try:
        status = check_regular(file)
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror or error}") from error
    return _read(file, form, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _read(file: Path, form: OfflineForm[Any], _time: int, _size: int) -> Mapping[int, Any]:
    """Read the answers of a file as it is now."""
    header, lines = read_lines(file, MAX_ROWS)
    problems = list(_header_problems(header, form))
    if problems:
        raise ValueError(listed(file, problems))
    answers: dict[int, Any] = {}
    first_lines: dict[int, int] = {}
    for line, cells in lines:
        try:
            case, answer = _line(header, cells, form)
            if case in answers:
                raise ValueError(f"case {case} is answered twice, before in line {first_lines[case]}")
        except (ValueError, AlgorithmError) as error:
            problems.append(f"line {line}: {error}")
            continue
        answers[case], first_lines[case] = answer, line
    if problems:
        raise ValueError(listed(file, problems))
    return answers


def _header_problems(header: Sequence[str], form: OfflineForm[Any]) -> Iterator[str]:
    """What is wrong with the names of the columns."""
    said = f"allowed: {', '.join(form.columns)}; units are those of the names"
    return header_problems(header, ("case", *form.required), form.columns, said)


def _line(header: Sequence[str], cells: Sequence[str], form: OfflineForm[Any]) -> tuple[int, Any]:
    """A line's case and answer."""
    stated = {name: cell.strip() for name, cell in cells_by_column(header, cells).items()}
    if not stated["case"].isdecimal():
        raise ValueError(f"case is '{stated['case']}'; allowed: a whole number from 0")
    numbers = {name: _number(name, text) for name, text in stated.items() if name in form.columns[2:] and text}
    check_together((form.required, *form.optional), numbers)
    return int(stated["case"]), form.answer(_outcome(stated.get("outcome", ""), numbers, form), numbers)


def _number(name: str, text: str) -> float:
    """A finite number in the column's unit."""
    value = finite_number(name, text, ", or nothing where the outcome is a failure")
    unit, most = next((unit, most) for unit, most in _MOST.items() if name.endswith(unit))
    if abs(value) > most:
        raise ValueError(f"{name} is {text}, beyond {most:g}; is it in the unit that the name ends with ({unit})?")
    return value


def _outcome(text: str, numbers: Mapping[str, float], form: OfflineForm[Any]) -> Enum:
    """The outcome that is stated, or that numbers alone mean."""
    if not text and not numbers:
        raise ValueError("neither an outcome nor numbers are given")
    known = form.outcomes.__members__
    if text and text not in known:
        raise ValueError(f"outcome is '{text}'; allowed: {', '.join(known)}")
    return known[text] if text else next(iter(known.values()))
