"""Conformance checks and their findings, and the checks common to estimators, trackers and parts."""

from __future__ import annotations

import ast
import random
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.algorithms.answers import AlgorithmError
from marsyard.scenarios.algorithm_run import copy_inputs, hash_inputs
from marsyard.scenarios.estimators import algorithm_sources

#: Modules of `marsyard` that an algorithm may import (docs/architecture.md).
OPEN_MODULES = ("marsyard.sim.frames", "marsyard.sim.camera", "marsyard.sim.measurements", "marsyard.algorithms")
_SCENARIOS = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    - asked: the requirement of the protocol
    - problem, next_step: the violation and its remedy; empty if passed
    - note: the answer, or its computation time
    """

    check: str
    asked: str
    problem: str = ""
    next_step: str = ""
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the check found no problem."""
        return not self.problem


class BreachError(Exception):
    """A violation of the protocol."""


@dataclass(frozen=True)
class Check:
    """A check: `run` returns a note, or raises BreachError or an error of the algorithm; `advice` is the remedy."""

    name: str
    asked: str
    advice: str
    run: Callable[[], str]

    def finding(self) -> Finding:
        """Run the check; an exception is a problem."""
        try:
            return Finding(self.name, self.asked, note=self.run())
        except BreachError as error:
            problem = str(error)
        except AlgorithmError as error:
            last = error.stderr.strip().splitlines()[-1:]
            stderr = f"; its standard error ends with: {last[0]}" if last else ""
            problem = f"{error.fault.name}: {error}{stderr}"
        except Exception as error:
            # the last line of the user's code in the traceback
            frames = traceback.extract_tb(error.__traceback__)
            own = [frame for frame in frames if not Path(frame.filename).resolve().is_relative_to(_SCENARIOS)]
            where = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
            problem = f"it raised {type(error).__name__}: {error}{where}"
        return Finding(self.name, self.asked, problem, self.advice)


@dataclass(frozen=True)
class Suite(ABC):
    """Conformance suite of one algorithm or part, which is constructed again for each check.

    The process of a check detects state left behind in it (`marsyard.campaigns.running.replay`).

    - make: constructs the algorithm or part
    - program: it is a program with files as input, which cannot change the suite's objects
    """

    make: Callable[[], Any]
    spec: str
    program: bool
    limit_s: float

    #: Advice of the check `deterministic`, and verb of the check `time`.
    deterministic_advice = (
        "draw from numpy.random.default_rng(a fixed seed), made in estimate; keep no state between cases"
    )
    answers = "answers"
    #: Problem of an answer that differs after other cases.
    dependence = "its answer depends on earlier cases"
    #: Whether imports of the truth are forbidden.
    closed_to_truth = True
    #: Whether the arrays of inputs are writable in all checks.
    writable = False

    @abstractmethod
    def checks(self) -> Iterator[Check]:
        """All checks, the ordinary case first."""

    @abstractmethod
    def cases(self) -> Sequence[Any]:
        """Inputs of ordinary cases."""

    def _other_cases(self) -> Sequence[Any]:
        """Inputs of other cases, on which the answers of `cases` must not depend."""
        return self.cases()

    @abstractmethod
    def _call(self, algorithm: Any, case: Any, seed: int) -> Any:
        """Call an algorithm or part with the input of a case."""

    @abstractmethod
    def _check_answer(self, answer: Any, case: Any) -> Any:
        """The answer, valid by the protocol; raises BreachError or AlgorithmError otherwise."""

    def _answer(self, case: Any, seed: int = 1) -> Any:
        """Checked answer of a new algorithm or part to a copy of a case's input."""
        return self._check_answer(self._call(self.make(), copy_inputs(case, writable=self.writable), seed), case)

    def common_checks(self) -> Iterator[Check]:
        """Checks of unchanged inputs, repeatability, time, and imports."""
        if not self.program:
            copies = "work on copies: counts.astype(...), array.copy()"
            yield Check("inputs", "leaves its inputs as they are", copies, self._leaves_inputs)
        rule = "gives the same answers to the same case, after any other cases"
        yield Check("deterministic", rule, self.deterministic_advice, self._repeats_answers)
        faster = "be faster, or allow more with --time-limit"
        yield Check("time", f"{self.answers} within {self.limit_s:g} s", faster, self._answers_in_time)
        if self.closed_to_truth and not self.program:
            advice = f"use the inputs alone; of marsyard import only {', '.join(OPEN_MODULES)}"
            yield Check("truth", "imports no module with access to the truth", advice, self._imports_no_truth)

    def _leaves_inputs(self) -> str:
        for case in self.cases():
            copy = copy_inputs(case, writable=True)
            before = hash_inputs(copy)
            self._call(self.make(), copy, 1)
            if hash_inputs(copy) != before:
                raise BreachError(f"it changed its input, a {type(case).__name__}")
        return ""

    def _repeats_answers(self) -> str:
        used = self.make()
        for case in self.cases():
            prints = []
            for seed in (1, 2):  # the process's global generators, for code that uses them by mistake
                random.seed(seed)
                np.random.seed(seed)  # noqa: NPY002
                prints.append(fingerprint(self._answer(case)))
            if prints[0] != prints[1]:
                raise BreachError("asked twice, it answers differently to the same case")
            for other in self._other_cases():
                self._call(used, copy_inputs(other, writable=self.writable), 2)
            again = self._call(used, copy_inputs(case, writable=self.writable), 1)
            if fingerprint(self._check_answer(again, case)) != prints[0]:
                raise BreachError(self.dependence)
        return ""

    def _answers_in_time(self) -> str:
        taken = self._answer_time_s()
        if taken > self.limit_s:
            raise BreachError(f"it took {taken:.3g} s")
        return f"{taken:.3g} s"

    def _answer_time_s(self) -> float:
        """Time of an answer after a first one, which compiles kernels."""
        case = self.cases()[0]
        self._answer(case)
        return measure_time_s(lambda: self._answer(case))

    def _imports_no_truth(self) -> str:
        closed, allowed = [], tuple(f"{one}." for one in OPEN_MODULES)
        for name, path in algorithm_sources(self.spec):
            try:
                nodes = list(ast.walk(ast.parse(path.read_bytes())))
            except (SyntaxError, ValueError):
                continue
            imports = [(node.lineno, one.name) for node in nodes if isinstance(node, ast.Import) for one in node.names]
            for node in nodes:
                if isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
                    imports += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
            for line, module in imports:
                if module.partition(".")[0] == "marsyard" and not f"{module}.".startswith(allowed):
                    closed.append(f"{name}, line {line}: {module}")
        if closed:
            raise BreachError(f"it imports modules with access to the truth: {'; '.join(closed[:5])}")
        return ""


def measure_time_s(call: Callable[[], object]) -> float:
    """Wall-clock time of a call."""
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


def fingerprint(answer: Any) -> str:
    """Fingerprint of an answer without its details, which may contain times."""
    return hash_inputs(answer, ("details",))
