"""Algorithms that run outside of Marsyard: export of the cases, and tables with their answers.

Both are used like an algorithm of a campaign. ``export:FOLDER`` writes the inputs of the algorithm and returns a
refusal. ``answers:FILE.csv`` returns the answers in a table.
"""

import math
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from marsyard.algorithms.exchange import AnswerForm, write_case
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.scenarios.user_tables import check_column_groups, finite_number, format_problems, parse_table
from marsyard.sim.files import check_regular

#: Maximum number of rows of a table of answers.
MAX_ROWS = 10_000_000
#: Maximum magnitudes by suffix of the column; larger numbers are probably in another unit.
_MAX_MAGNITUDE = {"_m_s": 1e3, "_m2_s2": 1e6, "_m": 1e6, "_s": 1e6}
Answer = TypeVar("Answer")


@dataclass(frozen=True, eq=False)
class AnswerFormat(Generic[Answer]):
    """Format of a task's answers in a table.

    - form: form of the answers, as in the exchange with programs
    - numbers: columns of each key of the form. A square matrix is symmetric, and its columns are those of its upper
      triangle, row by row. A row contains all numbers of a key, or none.
    - required: keys whose columns each table contains
    - create_refusal: creates the refusal that an export returns
    - note: explanation of the columns for the user
    - write_inputs: writes the inputs of a case into an existing folder. Raises OSError.
    - join: joins the answers in the lines of a case, in the order of the table; None: a case has one line. Raises
      ValueError.
    """

    form: AnswerForm[Answer]
    numbers: Mapping[str, tuple[str, ...]]
    required: tuple[str, ...]
    create_refusal: Callable[[Any], Any]
    note: str = ""
    write_inputs: Callable[[Path, Any], None] = lambda folder, inputs: write_case(folder, inputs, image_format="png")
    join: Callable[[Sequence[Answer]], Any] | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns."""
        return ("case", "outcome", *self.number_columns)

    @property
    def number_columns(self) -> tuple[str, ...]:
        """Columns of the numbers of all keys."""
        return tuple(name for group in self.numbers.values() for name in group)

    @property
    def required_columns(self) -> tuple[str, ...]:
        """Columns that each table contains."""
        return ("case", *(name for key in self.required for name in self.numbers[key]))

    def create_answer(self, outcome: Enum, numbers: Mapping[str, float]) -> Answer:
        """Create and check an answer from its outcome and the numbers by column. Raises AlgorithmError."""
        check_column_groups(tuple(self.numbers.values()), numbers)
        arrays = {
            key: _arrange([numbers[name] for name in columns], self.form.shapes[key]) if columns[0] in numbers else None
            for key, columns in self.numbers.items()
        }
        return self.form.create(outcome=outcome, details=None, **arrays)


def _arrange(values: Sequence[float], shape: tuple[int, ...]) -> np.ndarray:
    """Arrange the numbers of a key in their shape; see `AnswerFormat.numbers`."""
    if len(shape) < 2:
        return np.array(values, dtype=np.float64).reshape(shape)
    matrix, upper = np.zeros(shape), np.triu_indices(shape[0])
    matrix[upper] = matrix.T[upper] = values
    return matrix


def read_answers(file: Path, answer_format: AnswerFormat[Answer]) -> Mapping[int, Answer]:
    """Return the answers of a table by case. Raises ValueError with all problems by line."""
    try:
        status = check_regular(file)
    except OSError as error:
        raise ValueError(f"{file}: {error.strerror or error}") from error
    return _read(file, answer_format, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _read(file: Path, answer_format: AnswerFormat[Any], _modified_ns: int, _size: int) -> Mapping[int, Any]:
    """Read a table; the cache's key includes modification time and size, so that a changed file is read again."""
    first_lines: dict[int, int] = {}

    def parse(line: int, cells: Mapping[str, str]) -> tuple[int, Any]:
        case, answer = _parse_answer(cells, answer_format)
        if case in first_lines and answer_format.join is None:
            raise ValueError(f"case {case} has two answers, the first in line {first_lines[case]}")
        first_lines.setdefault(case, line)
        return case, answer

    hint = f"allowed: {', '.join(answer_format.columns)}; the suffix of a name is its unit"
    columns, required = answer_format.columns, answer_format.required_columns
    answers, problems = parse_table(file, MAX_ROWS, required, columns, hint, parse)
    lines_by_case: dict[int, list[Any]] = {}
    for case, answer in answers:
        lines_by_case.setdefault(case, []).append(answer)
    answers_by_case = {}
    for case, lines in lines_by_case.items():
        try:
            answers_by_case[case] = lines[0] if answer_format.join is None else answer_format.join(lines)
        except ValueError as error:
            problems.append(f"case {case}: {error}")
    if problems:
        raise ValueError(format_problems(file, problems))
    return answers_by_case


def _parse_answer(cells: Mapping[str, str], answer_format: AnswerFormat[Any]) -> tuple[int, Any]:
    """Convert the cells of a row to a case number and its answer. Raises ValueError for an invalid value."""
    if not cells["case"].isdecimal():
        raise ValueError(f"case is '{cells['case']}'; allowed: a whole number from 0")
    numbers = {}
    filled = {name: text for name, text in cells.items() if name in answer_format.number_columns and text}
    for name, text in filled.items():
        numbers[name] = value = finite_number(name, text, ", or an empty cell if the outcome is a failure")
        limits = ((unit, limit) for unit, limit in _MAX_MAGNITUDE.items() if name.endswith(unit))
        unit, limit = next(limits, ("", math.inf))
        if abs(value) > limit:
            raise ValueError(f"{name} is {text}, beyond {limit:g}; the suffix of the name is the unit ({unit})")
    outcome, outcomes = cells.get("outcome", ""), answer_format.form.outcomes.__members__
    if not outcome and not numbers:
        raise ValueError("neither an outcome nor numbers are given")
    if outcome and outcome not in outcomes:
        raise ValueError(f"outcome is '{outcome}'; allowed: {', '.join(outcomes)}")
    # an empty outcome with numbers means the first outcome
    return int(cells["case"]), answer_format.create_answer(outcomes[outcome or next(iter(outcomes))], numbers)


#: Prefixes of the names of an export and of a table of answers.
EXPORT, ANSWERS = "export:", "answers:"
#: Folder of the cases in an export.
CASES = "cases"


def is_offline(spec: str) -> bool:
    """Return whether a name specifies an export or a table of answers."""
    return spec.startswith((EXPORT, ANSWERS))


def answers_file(spec: str) -> Path | None:
    """Return the path of a table of answers; None for other names."""
    return Path(spec.removeprefix(ANSWERS)) if spec.startswith(ANSWERS) else None


def create_offline(spec: str, answer_format: AnswerFormat[Any], case: int) -> Any:
    """Create the object that replaces the algorithm in a case."""
    file = answers_file(spec)
    if file is None:
        return CaseExporter(Path(spec.removeprefix(EXPORT)) / CASES / f"{case:06d}", answer_format)
    answer = read_answers(file, answer_format).get(case)
    return RecordedAnswer(answer, f"{file.name} has no answer to case {case}", answer_format)


@dataclass(frozen=True)
class CaseExporter:
    """Replaces an algorithm: writes its inputs into a folder atomically, and returns a refusal."""

    folder: Path
    answer_format: AnswerFormat[Any]

    def estimate(self, measurements: Any) -> Any:
        """Write a case. Raises OSError."""
        temporary_folder = self.folder.with_name(f"{self.folder.name}.part{os.getpid()}")
        shutil.rmtree(temporary_folder, ignore_errors=True)
        temporary_folder.mkdir(parents=True)
        self.answer_format.write_inputs(temporary_folder, measurements)
        shutil.rmtree(self.folder, ignore_errors=True)
        temporary_folder.rename(self.folder)
        return self.answer_format.create_refusal(measurements)


@dataclass(frozen=True)
class RecordedAnswer(Generic[Answer]):
    """Replaces an algorithm: returns the answer of a table; `error_message` is raised if the table has none."""

    answer: Answer | None
    error_message: str
    answer_format: AnswerFormat[Answer]

    def estimate(self, measurements: Any) -> Answer:
        """Return the answer. Raises AlgorithmError if the table has none."""
        if self.answer is None:
            raise AlgorithmError(Fault.BAD_ANSWER, self.error_message)
        return self.answer_format.form.complete(self.answer, measurements)
