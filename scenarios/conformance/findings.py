"""What a check of the suite says."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from marsyard.algorithms.faults import AlgorithmError

_OURS = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Finding:
    """What came of one check.

    Attributes
    ----------
    check
        Its name.
    asked
        What the protocol asks for, in words.
    problem
        What is wrong; empty where nothing is.
    next_step
        What to do about it; empty where nothing is wrong.
    note
        What else was seen: the answer, or the time that it took.
    """

    check: str
    asked: str
    problem: str = ""
    next_step: str = ""
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problem


class BreachError(Exception):
    """What an algorithm does against its protocol.

    Parameters
    ----------
    problem
        What is wrong.
    next_step
        What to do about it, where that is not the check's own advice.
    """

    def __init__(self, problem: str, next_step: str = "") -> None:
        super().__init__(problem)
        self.next_step = next_step


@dataclass(frozen=True)
class Check:
    """A check of the suite.

    Attributes
    ----------
    name, asked
        As in `Finding`.
    advice
        What to do where it fails.
    run
        Does it; returns a note, and raises BreachError, or whatever the algorithm raised.
    """

    name: str
    asked: str
    advice: str
    run: Callable[[], str]

    def finding(self) -> Finding:
        """Runs it; whatever is raised is what is wrong."""
        try:
            return Finding(self.name, self.asked, note=self.run())
        except BreachError as error:
            return Finding(self.name, self.asked, str(error), error.next_step or self.advice)
        except AlgorithmError as error:
            return Finding(self.name, self.asked, f"{error.fault.name}: {error}{_said(error)}", self.advice)
        except Exception as error:
            return Finding(self.name, self.asked, f"it raised {_told(error)}", self.advice)


def _told(error: Exception) -> str:
    """An error with the last line of the user's code that it passed."""
    frames = traceback.extract_tb(error.__traceback__)
    theirs = [frame for frame in frames if not Path(frame.filename).resolve().is_relative_to(_OURS / "scenarios")]
    where = f" ({Path(theirs[-1].filename).name}, line {theirs[-1].lineno})" if theirs else ""
    return f"{type(error).__name__}: {error}{where}"


def _said(error: AlgorithmError) -> str:
    last = error.stderr.strip().splitlines()[-1:]
    return f"; its standard error ends with: {last[0]}" if last else ""
