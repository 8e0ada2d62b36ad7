"""Tasks of the systems: creation of their algorithms by name, and the parameters that select those of a case.

An algorithm is specified by

- the name of an algorithm of Marsyard (`dimes`), or of an entry point in the group `marsyard.algorithms`;
- ``module:Class`` or ``module:function``, called without arguments; the module may be in the current folder;
- ``FILE.pkl:Name``: a stored Python object (`marsyard.scenarios.stored_objects`);
- ``exec:PROGRAM ARGUMENTS`` or ``serve:PROGRAM ARGUMENTS``: an external program (docs/custom-algorithms.md);
  ``exec-stream:`` or ``serve-stream:``: a program that receives images one by one;
- ``answers:FILE.csv``: answers computed outside of Marsyard (`marsyard.scenarios.offline_algorithms`).
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, TypeVar, cast

from pydantic import Field, field_validator, model_validator

from marsyard.algorithms import exchange
from marsyard.algorithms.worker_device import worker_device
from marsyard.scenarios.imports import import_object, source_files
from marsyard.scenarios.isolation.host import construct, reset
from marsyard.scenarios.isolation.remote import AlgorithmDescription, RemoteAlgorithm, describe_in_process
from marsyard.scenarios.offline_algorithms import AnswerFormat, answers_file, create_offline, is_offline, read_answers
from marsyard.scenarios.streamed import STREAM_METHODS, StreamedEstimator
from marsyard.scenarios.systems import systems
from marsyard.sim.parameters import Parameters

#: Entry point group of other packages' algorithms.
GROUP = "marsyard.algorithms"

Algorithm = TypeVar("Algorithm")
Options = TypeVar("Options")


def variants(
    name: str, create: Callable[[Any], Any], improvements: Mapping[str, Any]
) -> dict[str, Callable[[Any], Any]]:
    """Return the variants of an algorithm of a paper, by name.

    - `name`: the published algorithm; ValueError if one of its improvements is selected
    - `name`-plus: with all improvements; ValueError if one of them is set explicitly
    - `name`-custom: with the improvements that the options select
    """

    def create_published(options: Any) -> Any:
        defaults = type(options)()
        for key in improvements:
            if getattr(options, key) != getattr(defaults, key):
                raise ValueError(f"'{name}' and '{name}-plus' define the option {key}; '{name}-custom' accepts it")
        return create(options)

    def create_improved(options: Any) -> Any:
        create_published(options)
        return create(replace(options, **improvements))

    return {name: create_published, f"{name}-plus": create_improved, f"{name}-custom": create}


@dataclass(frozen=True)
class Task(Generic[Algorithm, Options]):
    """A task of a system and its algorithms.

    - name: name on the command line and in the exchange with programs
    - noun: noun for an algorithm of the task in messages, such as "velocity estimator"
    - methods: required methods of an algorithm that receives all measurements at once; empty if all receive them one by
      one (streams)
    - answers: data classes and enumerations of its answers
    - shipped: functions that create Marsyard's algorithms from the options of the published algorithm
    - options: class of the options of the published algorithm
    - executable: function that wraps an external program; None if programs are not accepted
    - offline: format of the answers in a table; None if an answer determines the next inputs
    - accepts_streams: whether algorithms can be streams (`marsyard.algorithms.interface.ImageStream`)
    - suite: ``module:Class`` of the conformance suite, a `marsyard.scenarios.conformance.checks.Suite`; empty without
      one
    """

    name: str
    noun: str
    methods: tuple[str, ...]
    shipped: Mapping[str, Callable[[Options], Algorithm]]
    options: type[Options]
    answers: tuple[type, ...] = ()
    executable: Callable[[exchange.Command, exchange.ExecutableLimits], Any] | None = None
    offline: AnswerFormat[Any] | None = None
    accepts_streams: bool = False
    suite: str = ""

    def check(self, spec: str) -> None:
        """Raise ValueError, with the allowed algorithms in the message, if the task has no algorithm of this name."""
        if spec in self.shipped:
            return
        command = exchange.parse_command(spec)
        if command is not None:
            if self.executable is None:
                raise ValueError(f"'{spec}': a {self.noun} cannot be a program; allowed: a name, module:Class")
            if command.stream and not self.accepts_streams:
                raise ValueError(f"'{spec}': a {self.noun} does not accept a stream of images; allowed: exec:, serve:")
            return
        if is_offline(spec):
            answer_format, file = self._answer_format(spec), answers_file(spec)
            if file is not None:
                read_answers(file, answer_format)
            return
        factory = describe_custom(spec, self.shipped)
        is_stream = self._is_stream(factory.members) or not self.methods
        methods = STREAM_METHODS if is_stream else self.methods
        missing = [method for method in methods if method not in factory.members]
        if not factory.is_callable:
            raise ValueError(f"'{spec}' is not a valid {self.noun}: {factory.kind}, not a class or function")
        if missing and factory.is_class:
            raise ValueError(f"'{spec}' is not a valid {self.noun}: missing members: {', '.join(missing)}")

    def make(self, spec: str, options: Options, limits: exchange.ExecutableLimits, case: int = 0) -> Algorithm:
        """Create an algorithm by name. Raises ValueError, and the exceptions of a user's constructor.

        The case number selects the answer of algorithms that run outside of Marsyard.
        """
        if is_offline(spec):
            return cast(Algorithm, create_offline(spec, self._answer_format(spec), case))
        algorithm = self._create(spec, options, limits)
        return cast(Algorithm, StreamedEstimator(algorithm) if self._is_stream(dir(algorithm)) else algorithm)

    def _create(self, spec: str, options: Options, limits: exchange.ExecutableLimits) -> Any:
        """Create an algorithm by name; a stream is not wrapped."""
        if spec in self.shipped:
            return self.shipped[spec](options)
        command = exchange.parse_command(spec)
        if command is not None and self.executable is not None:
            return self.executable(command, limits)
        path = custom_path(spec, self.shipped)
        if limits.isolated:
            return RemoteAlgorithm(path, limits, {item.__qualname__: item for item in self.answers})
        algorithm = construct(_import(path), worker_device(limits.devices))
        reset(algorithm)
        return algorithm

    def accepts_stream(self, spec: str) -> bool | None:
        """Return whether an algorithm accepts any number of images; None if unknown before its creation."""
        if spec in self.shipped:
            return False
        command = exchange.parse_command(spec)
        if command is not None:
            return command.stream
        if is_offline(spec):
            return True
        factory = describe_custom(spec, self.shipped)
        return self._is_stream(factory.members) if factory.is_class else None

    def _is_stream(self, members: Container[str]) -> bool:
        """Return whether an algorithm with these members receives images one by one; methods may be missing."""
        receives_all = bool(self.methods) and all(method in members for method in self.methods)
        return self.accepts_streams and "process_image" in members and not receives_all

    def _answer_format(self, spec: str) -> AnswerFormat[Any]:
        if self.offline is None:
            raise ValueError(f"'{spec}': a {self.noun} cannot run offline: each answer determines the next image")
        return self.offline


def custom_path(spec: str, shipped: Collection[str] = ()) -> str:
    """Return the import path of a custom algorithm: of an entry point, or the given one.

    Raises ValueError, with the allowed names in the message, if there is no algorithm of this name.
    """
    if ":" in spec:
        return spec
    if spec in list_installed():
        return list_installed()[spec].value
    allowed = [*shipped, *list_installed()]
    matches = difflib.get_close_matches(spec, allowed, n=1)
    hint = f" (did you mean '{matches[0]}'?)" if matches else ""
    custom = "a custom one as 'module:Class' or 'exec:./program'"
    raise ValueError(f"unknown algorithm '{spec}'{hint}; allowed: {', '.join(allowed)}, or {custom}")


def describe_custom(spec: str, shipped: Collection[str] = ()) -> AlgorithmDescription:
    """Describe a custom algorithm, imported in a process of its own. Raises ValueError if it cannot be imported."""
    path = custom_path(spec, shipped)
    try:
        return describe_in_process(path)
    except ImportError as error:
        raise ValueError(_import_problem(spec, path, error)) from error


def _import(path: str) -> Any:
    """Import a custom algorithm in this process. Raises ValueError with the reason."""
    try:
        return import_object(path)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"cannot import algorithm '{path}': {error}") from error


def _import_problem(spec: str, path: str, error: Exception) -> str:
    if spec == path:
        return f"cannot import algorithm '{spec}': {error}"
    return f"algorithm '{spec}' cannot be loaded from {path}: {error}"


@cache
def shipped_names() -> frozenset[str]:
    """Return the names of the systems' built-in algorithms."""
    names: set[str] = set()
    for path in dict.fromkeys(path for system in systems() for path in system.tasks):
        with suppress(ImportError):  # the campaigns of the system report the error
            names.update(import_object(path).shipped)
    return frozenset(names)


@cache
def list_installed() -> Mapping[str, EntryPoint]:
    """Return the algorithms of installed packages, sorted by name."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def algorithm_sources(spec: str) -> list[tuple[str, Path]]:
    """Return names and paths of the source files of a user's Python algorithm; empty for all other algorithms."""
    path = list_installed()[spec].value if spec in list_installed() else spec
    is_external = is_offline(spec) or spec.startswith(tuple(exchange.PREFIXES))
    is_shipped = ":" not in spec and spec in shipped_names()
    return list(source_files(path)) if ":" in path and not is_external and not is_shipped else []


def check_algorithms(task: Task[Any, Any], specs: Sequence[str]) -> None:
    """Raise ValueError if an algorithm does not exist or is listed twice."""
    for index, spec in enumerate(specs):
        task.check(spec)
        if spec in specs[:index]:
            raise ValueError(f"the algorithm '{spec}' is listed twice")


def labels(specs: Sequence[str]) -> tuple[str, ...]:
    """Return unique short names of algorithms, the prefixes of their columns.

    >>> labels(["dimes", "phase-correlation", "mypkg.velocity:Estimator", "exec:./mine --fast", "exec:./mine"])
    ('dimes', 'phase_correlation', 'Estimator', 'mine', 'mine_2')
    """
    unique_labels: list[str] = []
    for spec in specs:
        program = re.match(r"(?:(?:exec|serve)(?:-stream)?|answers|export):\s*(\S+)", spec)
        basename = Path(program[1]).stem if program else spec.rpartition(":")[2]
        label = re.sub(r"\W", "_", basename, flags=re.ASCII)
        # names of columns must begin with a letter
        label = label if label[:1].isalpha() else f"a_{label}"
        candidates = itertools.chain([label], (f"{label}_{number}" for number in itertools.count(2)))
        unique_labels.append(next(name for name in candidates if name not in unique_labels))
    return tuple(unique_labels)


class AlgorithmSelection(Parameters):
    """Parameters of scenarios with selectable algorithms; subclasses define the field `algorithm`."""

    task: ClassVar[Task[Any, Any]]

    algorithm: str
    compared: Annotated[
        tuple[str, ...], Field(description="further algorithms, run on the same cases and compared with the first")
    ] = ()
    executable: Annotated[exchange.ExecutableLimits, Field(description="limits and isolation of custom algorithms")] = (
        exchange.ExecutableLimits()
    )

    @property
    def algorithms(self) -> tuple[str, ...]:
        """All algorithms; the first is the one under test."""
        return (self.algorithm, *self.compared)

    @property
    def options(self) -> Any:
        """Options of the published algorithm, for all algorithms of Marsyard."""
        return next((value for _, value in self if isinstance(value, self.task.options)), self.task.options())

    def make(self, algorithm: str, case: int) -> Any:
        """Create an algorithm for a case. Raises ValueError, and the exceptions of a user's constructor."""
        return self.task.make(algorithm, self.options, self.executable, case)

    @field_validator("algorithm")
    @classmethod
    def _check_algorithm(cls, name: str) -> str:
        cls.task.check(name)
        return name

    @field_validator("compared")
    @classmethod
    def _check_compared(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        check_algorithms(cls.task, names)
        return names

    @model_validator(mode="after")
    def _check_distinct(self) -> AlgorithmSelection:
        if self.algorithm in self.compared:
            raise ValueError(f"the algorithm '{self.algorithm}' is listed twice")
        return self

    @model_validator(mode="after")
    def _check_options(self) -> AlgorithmSelection:
        """Create the algorithms of Marsyard once, which checks their options."""
        for name in self.algorithms:
            if name in self.task.shipped:
                self.task.shipped[name](self.options)
        return self
