"""Tasks of the systems: each with its algorithms, which are created by name.

An algorithm is specified by

- the name of an algorithm of Marsyard (`dimes`), or of an entry point in the group `marsyard.algorithms`;
- ``module:Class`` or ``module:function``, called without arguments; the module may be in the current folder;
- ``FILE.pkl:Name``: a stored Python object (`marsyard.scenarios.stored_objects`);
- ``exec:PROGRAM ARGUMENTS`` or ``serve:PROGRAM ARGUMENTS``: an external program (docs/custom-algorithms.md);
  ``exec-stream:`` or ``serve-stream:``: a program that receives images one by one;
- ``answers:FILE.csv``: answers computed outside of Marsyard (`marsyard.scenarios.offline_algorithms`).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar, cast

from marsyard.algorithms import exchange
from marsyard.algorithms.worker_device import worker_device
from marsyard.scenarios.custom_algorithms import custom_path, describe_custom, import_algorithm
from marsyard.scenarios.isolation.host import construct, reset
from marsyard.scenarios.isolation.remote import RemoteAlgorithm
from marsyard.scenarios.offline_algorithms import AnswerFormat, answers_file, create_offline, is_offline, read_answers
from marsyard.scenarios.streamed import STREAM_METHODS, StreamedEstimator

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

    def check_improvements(options: Any) -> None:
        defaults = type(options)()
        for key in improvements:
            if getattr(options, key) != getattr(defaults, key):
                raise ValueError(f"'{name}' and '{name}-plus' define the option {key}; '{name}-custom' accepts it")

    def create_published(options: Any) -> Any:
        check_improvements(options)
        return create(options)

    def create_improved(options: Any) -> Any:
        check_improvements(options)
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
        algorithm = construct(import_algorithm(path), worker_device(limits.devices))
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
