"""Algorithms that run outside of Marsyard: export the cases, and read the answers from a table.

Both are used like an algorithm of a campaign. ``export:FOLDER`` writes the inputs of the algorithm and returns a
refusal. ``answers:FILE.csv`` returns the answers in a table.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.scenarios.answer_tables import Answer, AnswerFormat, read_answers

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
        return self.answer_format.create_empty(measurements)


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
