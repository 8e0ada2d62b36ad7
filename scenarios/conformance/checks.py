"""Checks and their findings, and the checks that estimators, trackers and parts share."""

from __future__ import annotations

import ast
import random
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.algorithms.faults import AlgorithmError
from marsyard.scenarios.estimators import sources_of
from marsyard.scenarios.handover import fingerprint

#: Modules of `marsyard` that an algorithm may import (docs/architecture.md).
OPEN_MODULES = ("marsyard.sim.frames", "marsyard.sim.camera", "marsyard.sim.measurements", "marsyard.algorithms")
_SCENARIOS = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes
    ----------
    check
        Its name.
    asked
        What the protocol asks for, in words.
    problem, next_step
        What is wrong and what to do about it; empty where nothing is wrong.
    note
        The answer, or the time that it took.
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
    """What an algorithm does against its protocol."""


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
        Does it; returns a note, and raises BreachError, or what the algorithm raised.
    """

    name: str
    asked: str
    advice: str
    run: Callable[[], str]

    def finding(self) -> Finding:
        """Run it; an exception is a problem."""
        try:
            return Finding(self.name, self.asked, note=self.run())
        except BreachError as error:
            problem = str(error)
        except AlgorithmError as error:
            last = error.stderr.strip().splitlines()[-1:]
            stderr = f"; its standard error ends with: {last[0]}" if last else ""
            problem = f"{error.fault.name}: {error}{stderr}"
        except Exception as error:
            problem = f"it raised {_located(error)}"
        return Finding(self.name, self.asked, problem, self.advice)


def _located(error: Exception) -> str:
    """An error with the last line of the user's code that it passed."""
    frames = traceback.extract_tb(error.__traceback__)
    theirs = [frame for frame in frames if not Path(frame.filename).resolve().is_relative_to(_SCENARIOS)]
    where = f" ({Path(theirs[-1].filename).name}, line {theirs[-1].lineno})" if theirs else ""
    return f"{type(error).__name__}: {error}{where}"


@dataclass(frozen=True)
class Suite(ABC):
    """The suite of one algorithm or part, which is made again for each check.

    State that is left behind in the process is found by the process in which a check runs
    (`marsyard.campaigns.running.conformance`).

    Attributes
    ----------
    make
        Makes it.
    spec
        How it is named.
    program
        Whether it is a program, which gets files and so cannot change our inputs.
    limit_s
        Longest time that an answer may take.
    """

    make: Callable[[], Any]
    spec: str
    program: bool
    limit_s: float

    #: Advice of the check `deterministic`, and what an answer is called in `time`.
    deterministic_advice = (
        "draw from numpy.random.default_rng(a fixed seed), made in estimate; keep nothing between cases"
    )
    answers = "answers"
    #: Whether imports that know the truth are forbidden.
    closed_to_truth = True

    @abstractmethod
    def checks(self) -> Iterator[Check]:
        """All of them, the ordinary case first."""

    @abstractmethod
    def _change_inputs(self) -> str:
        """Raises BreachError where writable inputs are changed."""

    @abstractmethod
    def _answer_again(self) -> str:
        """Raises BreachError where the same inputs lead to different answers."""

    @abstractmethod
    def _taken_s(self) -> float:
        """Time of an answer, kernels compiled."""

    def common_checks(self) -> Iterator[Check]:
        """Inputs, repetition, time, imports."""
        if not self.program:
            copies = "work on copies: counts.astype(...), array.copy()"
            yield Check("inputs", "leaves its inputs as they are", copies, self._change_inputs)
        asked = "gives the same answers to the same case, after any other cases"
        yield Check("deterministic", asked, self.deterministic_advice, self._answer_again)
        faster = "be faster, or allow more with --time-limit"
        yield Check("time", f"{self.answers} within {self.limit_s:g} s", faster, self._answer_in_time)
        if self.closed_to_truth and not self.program:
            advice = f"use what you are handed; of sim import {', '.join(OPEN_MODULES)} only"
            yield Check("truth", "imports nothing that knows the truth", advice, self._import_no_truth)

    def _answer_in_time(self) -> str:
        taken = self._taken_s()
        if taken > self.limit_s:
            raise BreachError(f"it took {taken:.3g} s")
        return f"{taken:.3g} s"

    def _import_no_truth(self) -> str:
        found = closed_imports(self.spec)
        if found:
            raise BreachError(f"it imports what knows the truth: {'; '.join(found[:5])}")
        return ""


def timed(answer: Callable[[], object]) -> float:
    """Wall-clock time of an answer, s."""
    began = time.perf_counter()
    answer()
    return time.perf_counter() - began


def answer_print(answer: Any) -> str:
    """Fingerprint of an answer without its details, which may hold times."""
    return fingerprint(answer, ("details",))


def seed_global_generators(seed: int) -> None:
    """Set the generators that everyone in the process shares, for code that draws from them by mistake."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002


def closed_imports(spec: str) -> list[str]:
    """Imports of a Python algorithm's sources that know more than an algorithm may: file, line and name."""
    found = []
    for name, path in sources_of(spec):
        try:
            tree = ast.parse(path.read_bytes())
        except (SyntaxError, ValueError):
            continue
        found += [f"{name}, line {line}: {module}" for line, module in _imports(tree) if _is_closed(module)]
    return found


def _imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def _is_closed(module: str) -> bool:
    ours = module.partition(".")[0] == "marsyard"
    return ours and not any(f"{module}.".startswith(f"{one}.") for one in OPEN_MODULES)
