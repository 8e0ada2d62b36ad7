"""Algorithms under test: those of Marsyard, of installed packages, and of the user.

An algorithm is named by

- a name of Marsyard (`dimes`) or, if it has none, of the entry point group `marsyard.algorithms` of other packages;
- ``module:Class`` or ``module:function``, called without arguments; the module may lie in the current folder;
- ``exec:PROGRAM ARGUMENTS`` or ``serve:PROGRAM ARGUMENTS``: an external program (docs/custom-algorithms.md);
  ``exec-stream:`` or ``serve-stream:`` one that takes pictures one by one;
- ``answers:FILE.csv``: answers computed outside of Marsyard (`marsyard.scenarios.offline`).
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from marsyard.algorithms import exchange
from marsyard.algorithms.baselines import HomographyEstimator, PhaseCorrelationEstimator
from marsyard.algorithms.dimes import DimesEstimator, DimesOptions
from marsyard.algorithms.hda import HdaEstimator, HdaOptions
from marsyard.algorithms.hda.baselines import EssentialMatrixEstimator, SemiGlobalEstimator
from marsyard.algorithms.interface import SiteEstimator, TargetTracker, VelocityEstimator
from marsyard.algorithms.streams import STREAM_METHODS, StreamedEstimator
from marsyard.algorithms.vtt import PURE_NCC, VisualTargetTracker, VttOptions, lucas_kanade_tracker
from marsyard.scenarios.offline import (
    SITE_FORM,
    VELOCITY_FORM,
    OfflineForm,
    answers_file,
    create_offline,
    is_offline,
    read_answers,
)
from marsyard.scenarios.systems import systems
from marsyard.scenarios.user_files import import_object, source_files

#: Entry points of other packages' algorithms.
GROUP = "marsyard.algorithms"

Algorithm = TypeVar("Algorithm")
Options = TypeVar("Options")


@dataclass(frozen=True)
class Task(Generic[Algorithm, Options]):
    """A task of a system and its algorithms.

    - name: name on the command line and in the exchange with programs
    - what: noun phrase for its algorithms
    - methods: required methods of an algorithm
    - shipped: constructors of Marsyard's algorithms from the options of the published one
    - options: options of the published algorithm
    - executable: wraps a program; None where programs are not accepted
    - offline: form of the answers in a table; None where an answer decides the next inputs
    - streamed: wraps an algorithm that takes pictures one by one; None where these are not accepted
    """

    name: str
    what: str
    methods: tuple[str, ...]
    shipped: Mapping[str, Callable[[Options], Algorithm]]
    options: type[Options]
    executable: Callable[[exchange.Command, exchange.ExecutableLimits], Algorithm] | None = None
    offline: OfflineForm[Any] | None = None
    streamed: Callable[[Any], Algorithm] | None = None

    def check(self, spec: str) -> None:
        """Raise ValueError where the task has no algorithm of this name; the message states the allowed ones."""
        if spec in self.shipped:
            return
        command = exchange.parse_command(spec)
        if command is not None:
            if self.executable is None:
                raise ValueError(f"'{spec}': a {self.what} cannot be a program; allowed: a name, module:Class")
            if command.stream and self.streamed is None:
                raise ValueError(f"'{spec}': a {self.what} takes no stream of pictures; allowed: exec:, serve:")
            return
        if is_offline(spec):
            form, file = self._form(spec), answers_file(spec)
            if file is not None:
                read_answers(file, form)
            return
        factory = self._import(spec)
        methods = STREAM_METHODS if self._is_stream(factory) else self.methods
        missing = [method for method in methods if not hasattr(factory, method)]
        if not callable(factory):
            raise ValueError(f"'{spec}' is no {self.what}: it is a {type(factory).__name__}, not a class or function")
        if missing and isinstance(factory, type):
            raise ValueError(f"'{spec}' is no {self.what}: it has no {', '.join(missing)}")

    def make(self, spec: str, options: Options, limits: exchange.ExecutableLimits, case: int = 0) -> Algorithm:
        """Create the algorithm of a name. Raises ValueError, and the exceptions of a user's constructor.

        The case's number selects the answer of algorithms that run outside of Marsyard.
        """
        if spec in self.shipped:
            return self.shipped[spec](options)
        if is_offline(spec):
            return cast(Algorithm, create_offline(spec, self._form(spec), case))
        command = exchange.parse_command(spec)
        if command is not None and self.executable is not None:
            return self.executable(command, limits)
        algorithm = self._import(spec)()
        if self.streamed is not None and self._is_stream(algorithm):
            return self.streamed(algorithm)
        return cast(Algorithm, algorithm)

    def takes_stream(self, spec: str) -> bool | None:
        """Return whether an algorithm takes any number of pictures; None if unknown before its creation."""
        if spec in self.shipped:
            return False
        command = exchange.parse_command(spec)
        if command is not None:
            return command.stream
        if is_offline(spec):
            return True
        factory = self._import(spec)
        return self._is_stream(factory) if isinstance(factory, type) else None

    def _is_stream(self, algorithm: object) -> bool:
        """Return whether a class or object takes pictures one by one; methods may be missing."""
        is_complete = all(hasattr(algorithm, method) for method in STREAM_METHODS)
        is_partial = hasattr(algorithm, "picture") and not any(hasattr(algorithm, method) for method in self.methods)
        return self.streamed is not None and (is_complete or is_partial)

    def _form(self, spec: str) -> OfflineForm[Any]:
        if self.offline is None:
            raise ValueError(
                f"'{spec}': a {self.what} cannot be run elsewhere, as each of its answers decides what it sees next"
            )
        return self.offline

    def _import(self, spec: str) -> Any:
        """Import the class or function of another package's name, or of a path."""
        if ":" in spec:
            try:
                return import_object(spec)
            except ImportError as error:
                raise ValueError(f"no algorithm at '{spec}': {error}") from error
        if spec not in list_installed():
            allowed = [*self.shipped, *list_installed()]
            near = difflib.get_close_matches(spec, allowed, n=1)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            own = "your own as 'module:Class' or 'exec:./program'"
            raise ValueError(f"unknown algorithm '{spec}'{hint}; allowed: {', '.join(allowed)}, or {own}")
        try:
            return list_installed()[spec].load()
        except (ImportError, AttributeError) as error:
            raise ValueError(
                f"algorithm '{spec}' cannot be loaded from {list_installed()[spec].value}: {error}"
            ) from error


VELOCITY: Task[VelocityEstimator, DimesOptions] = Task(
    name="velocity",
    what="velocity estimator",
    methods=("estimate",),
    shipped={
        "dimes": DimesEstimator,
        "phase-correlation": lambda _: PhaseCorrelationEstimator(),
        "homography": lambda _: HomographyEstimator(),
    },
    # a program gets three pictures at once, or all pictures one by one
    executable=lambda command, limits: (
        StreamedEstimator(exchange.ExecutableVelocityStream(command, limits))
        if command.stream
        else exchange.ExecutableVelocityEstimator(command, limits)
    ),
    options=DimesOptions,
    offline=VELOCITY_FORM,
    streamed=StreamedEstimator,
)

TRACKING: Task[TargetTracker, VttOptions] = Task(
    name="tracking",
    what="target tracker",
    methods=("designate", "aim", "update", "clear", "state"),
    shipped={
        "vtt": VisualTargetTracker,
        # the paper's baseline: without scale, roll and warp
        "pure-ncc": lambda options: VisualTargetTracker(
            replace(options, scale=PURE_NCC.scale, roll=PURE_NCC.roll, warp=PURE_NCC.warp)
        ),
        "lucas-kanade": lucas_kanade_tracker,
    },
    executable=exchange.ExecutableTargetTracker,
    options=VttOptions,
)

LANDING: Task[SiteEstimator, HdaOptions] = Task(
    name="landing",
    what="estimator of landing sites",
    methods=("estimate",),
    shipped={"hda": HdaEstimator, "essential-matrix": EssentialMatrixEstimator, "semi-global": SemiGlobalEstimator},
    executable=exchange.ExecutableSiteEstimator,
    options=HdaOptions,
    offline=SITE_FORM,
)

#: Tasks with a conformance suite, by name.
TASKS: Mapping[str, Task[Any, Any]] = {task.name: task for task in (VELOCITY, TRACKING, LANDING)}


@cache
def shipped_names() -> frozenset[str]:
    """Return the names of the systems' own algorithms."""
    names: set[str] = set()
    for path in dict.fromkeys(path for system in systems() for path in system.tasks):
        with suppress(ImportError):  # the system's own campaigns report it
            names.update(import_object(path).shipped)
    return frozenset(names)


@cache
def list_installed() -> Mapping[str, EntryPoint]:
    """Return the algorithms of installed packages, sorted by name."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def algorithm_sources(spec: str) -> list[tuple[str, Path]]:
    """Return the source files of a user's algorithm in Python by name; empty for all others."""
    path = list_installed()[spec].value if spec in list_installed() else spec
    is_external = is_offline(spec) or spec.startswith(tuple(exchange.PREFIXES))
    return list(source_files(path)) if ":" in path and not is_external and spec not in shipped_names() else []


def check_algorithms(task: Task[Any, Any], specs: Sequence[str]) -> None:
    """Raise ValueError where an algorithm does not exist or is named twice."""
    for index, spec in enumerate(specs):
        task.check(spec)
        if spec in specs[:index]:
            raise ValueError(f"the algorithm '{spec}' is named twice")


def labels(specs: Sequence[str]) -> tuple[str, ...]:
    """Return unique short names of algorithms, the prefixes of their columns.

    >>> labels(["dimes", "phase-correlation", "mypkg.velocity:Estimator", "exec:./mine --fast", "exec:./mine"])
    ('dimes', 'phase_correlation', 'Estimator', 'mine', 'mine_2')
    """
    labels: list[str] = []
    for spec in specs:
        program = re.match(r"(?:(?:exec|serve)(?:-stream)?|answers|export):\s*(\S+)", spec)
        last = Path(program[1]).stem if program else spec.rpartition(":")[2]
        short = re.sub(r"\W", "_", last, flags=re.ASCII)
        short = short if short[:1].isalpha() else f"a_{short}"
        candidates = itertools.chain([short], (f"{short}_{number}" for number in itertools.count(2)))
        labels.append(next(label for label in candidates if label not in labels))
    return tuple(labels)
