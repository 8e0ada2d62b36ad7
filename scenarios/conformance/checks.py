"""Conformance checks and their findings, and the checks common to estimators, trackers and custom parts.

A custom part is a user-defined motion, instrument or score (`marsyard.scenarios.parts`). The protocol is the interface
of an algorithm or part: its methods, their inputs, and the rules for their answers.
"""

import ast
import random
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.algorithms.faults import AlgorithmError
from marsyard.scenarios.custom_algorithms import algorithm_sources
from marsyard.scenarios.input_copies import copy_inputs, hash_inputs
from marsyard.scenarios.isolation.host import reset

#: Modules of `marsyard` that an algorithm may import, with their submodules (docs/architecture.md).
ALLOWED_MODULES = ("marsyard.sim.frames", "marsyard.sim.camera", "marsyard.sim.measurements", "marsyard.algorithms")
#: Maximum number of forbidden imports in a message.
_MAX_VIOLATIONS = 5
_SCENARIOS = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    - requirement: text of a requirement of the protocol, without its subject (the algorithm or part)
    - problem, next_step: the violation and its remedy; empty if the check passed
    - note: description of the answer, or its computation time
    """

    check: str
    requirement: str
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
    requirement: str
    advice: str
    run: Callable[[], str]

    def evaluate(self) -> Finding:
        """Run the check; an exception is a problem."""
        try:
            return Finding(self.name, self.requirement, note=self.run())
        except BreachError as error:
            problem = str(error)
        except AlgorithmError as error:
            last_line = error.stderr.strip().splitlines()[-1:]
            stderr = f"; its standard error ends with: {last_line[0]}" if last_line else ""
            problem = f"{error.fault.name}: {error}{stderr}"
        except Exception as error:
            # report the last line of the user's code in the traceback
            frames = traceback.extract_tb(error.__traceback__)
            user_frames = [frame for frame in frames if not Path(frame.filename).resolve().is_relative_to(_SCENARIOS)]
            location = f" ({Path(user_frames[-1].filename).name}, line {user_frames[-1].lineno})" if user_frames else ""
            problem = f"it raised {type(error).__name__}: {error}{location}"
        return Finding(self.name, self.requirement, problem, self.advice)


@dataclass(frozen=True)
class Suite(ABC):
    """Conformance suite of one algorithm or part; a new object is constructed for each check.

    `marsyard.campaigns.running.conformance` runs each check in a worker process, and also reports whether the algorithm
    changed the state of that process.

    - make: constructs the algorithm or part
    - spec: name of the algorithm or part
    - is_program: whether it is an external program; a program reads files, so it cannot change the Python inputs
    - limit_s: maximum computation time of an answer
    - make_remote: constructs a custom algorithm in a process of its own; None for all others
    """

    make: Callable[[], Any]
    spec: str
    is_program: bool
    limit_s: float
    make_remote: Callable[[], Any] | None = field(default=None, kw_only=True)

    #: Remedy if the check `deterministic` fails.
    deterministic_advice = (
        "use numpy.random.default_rng(a fixed seed), created in estimate; keep no state between cases"
    )
    #: Verb in the requirement of the check `time`.
    time_verb = "answers"
    #: Problem if the answer to a case differs after other cases.
    dependence_problem = "its answer depends on earlier cases"
    #: Whether imports of modules with ground truth are forbidden.
    forbids_truth = True
    #: Whether the arrays of inputs are writable in all checks.
    writable_inputs = False

    @abstractmethod
    def checks(self) -> Iterator[Check]:
        """Yield all checks; the first is the check of ordinary cases."""

    @abstractmethod
    def cases(self) -> Sequence[Any]:
        """Return the inputs of ordinary cases."""

    def _other_cases(self) -> Sequence[Any]:
        """Return the inputs of other cases, which must not affect the answers to `cases`."""
        return self.cases()

    @abstractmethod
    def _call(self, algorithm: Any, case: Any, seed: int) -> Any:
        """Call an algorithm or part with the input of a case."""

    @abstractmethod
    def _check_answer(self, answer: Any, case: Any) -> Any:
        """Return the answer if it is valid. Raises BreachError or AlgorithmError if it violates the protocol."""

    def _answer(self, case: Any, seed: int = 1) -> Any:
        """Return the checked answer of a new algorithm or part to a copy of a case's input."""
        return self._check_answer(self._call(self.make(), copy_inputs(case, writable=self.writable_inputs), seed), case)

    def common_checks(self) -> Iterator[Check]:
        """Yield the checks of unchanged inputs, repeatability, time, and imports."""
        if not self.is_program:
            copies = "work on copies: counts.astype(...), array.copy()"
            yield Check("inputs", "does not change its inputs", copies, self._check_inputs)
        requirement = "returns the same answers to the same case, after any other cases"
        yield Check("deterministic", requirement, self.deterministic_advice, self._check_repeatability)
        if self.make_remote is not None:
            requirement = "returns the same answers in a process of its own, as in a campaign"
            advice = "find files by the path of the module, and return only the types of the protocol"
            yield Check("process", requirement, advice, self._check_process)
        advice = "reduce the computation time, or raise the limit with --time-limit"
        yield Check("time", f"{self.time_verb} within {self.limit_s:g} s", advice, self._check_time)
        if self.forbids_truth and not self.is_program:
            advice = f"use only the inputs; from marsyard import only {', '.join(ALLOWED_MODULES)}"
            yield Check("truth", "imports no module with access to the truth", advice, self._check_imports)

    def _check_inputs(self) -> str:
        for case in self.cases():
            input_copy = copy_inputs(case, writable=True)
            original_hash = hash_inputs(input_copy)
            self._call(self.make(), input_copy, 1)
            if hash_inputs(input_copy) != original_hash:
                raise BreachError(f"it changed its input, a {type(case).__name__}")
        return ""

    def _check_repeatability(self) -> str:
        reused_instance = self.make()
        for case in self.cases():
            fingerprints = []
            for seed in (1, 2):  # of the global generators, for code that uses them by mistake
                random.seed(seed)
                np.random.seed(seed)  # noqa: NPY002
                fingerprints.append(fingerprint(self._answer(case)))
            if fingerprints[0] != fingerprints[1]:
                raise BreachError("its answers to the same case differ between two calls")
            for other_case in self._other_cases():
                reset(getattr(reused_instance, "stream", reused_instance))
                self._call(reused_instance, copy_inputs(other_case, writable=self.writable_inputs), 2)
            reset(getattr(reused_instance, "stream", reused_instance))
            answer = self._call(reused_instance, copy_inputs(case, writable=self.writable_inputs), 1)
            if fingerprint(self._check_answer(answer, case)) != fingerprints[0]:
                raise BreachError(self.dependence_problem)
        return ""

    def _check_process(self) -> str:
        if self.make_remote is not None:
            remote = replace(self, make=self.make_remote)
            for case in self.cases():
                if fingerprint(remote._answer(case)) != fingerprint(self._answer(case)):
                    raise BreachError("its answers in a process of its own differ from those in this process")
        return ""

    def _check_time(self) -> str:
        elapsed_s = self._answer_time_s()
        if elapsed_s > self.limit_s:
            raise BreachError(f"it took {elapsed_s:.3g} s")
        return f"{elapsed_s:.3g} s"

    def _answer_time_s(self) -> float:
        """Measure the time of a second answer; the first answer compiles kernels."""
        case = self.cases()[0]
        self._answer(case)
        return measure_time_s(lambda: self._answer(case))

    def _check_imports(self) -> str:
        violations, allowed_prefixes = [], tuple(f"{module}." for module in ALLOWED_MODULES)
        for name, path in algorithm_sources(self.spec):
            try:
                nodes = list(ast.walk(ast.parse(path.read_bytes())))
            except (SyntaxError, ValueError):
                continue
            statements = [node for node in nodes if isinstance(node, ast.Import)]
            imports = [(node.lineno, alias.name) for node in statements for alias in node.names]
            for node in nodes:
                if isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
                    imports += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
            for line, module in imports:
                if module.partition(".")[0] == "marsyard" and not f"{module}.".startswith(allowed_prefixes):
                    violations.append(f"{name}, line {line}: {module}")
        if violations:
            raise BreachError(f"it imports modules with access to the truth: {'; '.join(violations[:_MAX_VIOLATIONS])}")
        return ""


def measure_time_s(call: Callable[[], object]) -> float:
    """Measure the wall-clock time of a call."""
    start_s = time.perf_counter()
    call()
    return time.perf_counter() - start_s


def fingerprint(answer: Any) -> str:
    """Compute the hash of an answer without its details, which may contain times, and without computation times."""
    return hash_inputs(answer, ("details", "image_times_s"))
