"""The algorithms under test: those that ship with Marsyard, those installed by other packages, and a user's own.

An algorithm is named by

- a name that ships with Marsyard (`dimes`), or that an installed package gives it in the entry point group
  `marsyard.algorithms`; where both have it Marsyard's own is meant;
- ``module:Class``, or ``module:function``: what is found there is called without arguments and gives the algorithm. The
  module may lie in the current folder;
- ``exec:PROGRAM ARGUMENTS`` or ``serve:PROGRAM ARGUMENTS``: a program of its own (docs/own-algorithms.md);
  ``exec-stream:`` or ``serve-stream:`` one that takes pictures one by one;
- ``answers:FILE.csv``: one that was run elsewhere (`marsyard.scenarios.offline`).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from marsyard.algorithms.baselines import HomographyEstimator, PhaseCorrelationEstimator
from marsyard.algorithms.dimes import DimesEstimator, DimesOptions
from marsyard.algorithms.exchange import (
    PREFIXES,
    Command,
    ExecutableLimits,
    ExecutableSiteEstimator,
    ExecutableTargetTracker,
    ExecutableVelocityEstimator,
    ExecutableVelocityStream,
    command_of,
)
from marsyard.algorithms.hda import HdaEstimator, HdaOptions
from marsyard.algorithms.hda.baselines import EssentialMatrixEstimator, SemiGlobalEstimator
from marsyard.algorithms.interface import SiteEstimator, TargetTracker, VelocityEstimator
from marsyard.algorithms.streams import STREAM_METHODS, StreamedEstimator
from marsyard.algorithms.vtt import PURE_NCC, VisualTargetTracker, VttOptions, lucas_kanade_tracker
from marsyard.scenarios.dotted import found_at, sources_at
from marsyard.scenarios.offline import SITE_FORM, VELOCITY_FORM, OfflineForm, check_offline, is_offline, made_offline
from marsyard.scenarios.systems import systems

#: Entry points of other packages' algorithms.
GROUP = "marsyard.algorithms"

Algorithm = TypeVar("Algorithm")
Options = TypeVar("Options")


@dataclass(frozen=True)
class Task(Generic[Algorithm, Options]):
    """What a system's algorithms do, and the algorithms that there are for it.

    Attributes
    ----------
    name
        As the command line and the exchange with programs have it.
    what
        An algorithm for it, in words.
    methods
        What an algorithm for it must have.
    shipped
        How each algorithm that ships is made from the options of the paper's own.
    options
        The options of the published algorithm.
    executable
        How a program becomes one; None where programs are not accepted.
    offline
        How its answers stand in a table; None where each answer decides what is seen next.
    streamed
        Makes an algorithm of one that takes pictures one by one; None where there is no such thing.
    """

    name: str
    what: str
    methods: tuple[str, ...]
    shipped: Mapping[str, Callable[[Options], Algorithm]]
    options: type[Options]
    executable: Callable[[Command, ExecutableLimits], Algorithm] | None = None
    offline: OfflineForm[Any] | None = None
    streamed: Callable[[Any], Algorithm] | None = None

    def check(self, spec: str) -> None:
        """Raises ValueError where there is no algorithm of this name for the task; the message says what is allowed."""
        if spec in self.shipped:
            return
        command = command_of(spec)
        if command is not None:
            if self.executable is None:
                raise ValueError(f"'{spec}': a {self.what} cannot be a program; allowed: a name, module:Class")
            if command.stream and self.streamed is None:
                raise ValueError(f"'{spec}': a {self.what} takes no stream of pictures; allowed: exec:, serve:")
            return
        if is_offline(spec):
            check_offline(spec, self._form(spec))
            return
        found = self._class(spec)
        methods = STREAM_METHODS if self._is_stream(found) else self.methods
        missing = [method for method in methods if not hasattr(found, method)]
        if not callable(found):
            raise ValueError(f"'{spec}' is no {self.what}: it is a {type(found).__name__}, not a class or function")
        if missing and isinstance(found, type):
            raise ValueError(f"'{spec}' is no {self.what}: it has no {', '.join(missing)}")

    def make(self, spec: str, options: Options, limits: ExecutableLimits, case: int = 0) -> Algorithm:
        """The algorithm of a name. Raises ValueError where there is none, and whatever making a user's own raises.

        `case` is the case's number, of which only the tables of algorithms that are run elsewhere know.
        """
        if spec in self.shipped:
            return self.shipped[spec](options)
        if is_offline(spec):
            return cast(Algorithm, made_offline(spec, self._form(spec), case))
        command = command_of(spec)
        if command is not None and self.executable is not None:
            return self.executable(command, limits)
        made = self._class(spec)()
        if self.streamed is not None and self._is_stream(made):
            return self.streamed(made)
        return cast(Algorithm, made)

    def takes_stream(self, spec: str) -> bool | None:
        """Whether an algorithm takes any number of pictures; None where only making it tells. Raises as `check`."""
        if spec in self.shipped:
            return False
        command = command_of(spec)
        if command is not None:
            return command.stream
        if is_offline(spec):
            return True
        found = self._class(spec)
        return self._is_stream(found) if isinstance(found, type) else None

    def _is_stream(self, thing: object) -> bool:
        """Whether a class or an object is one that takes pictures one by one, be it with a method lacking."""
        whole = all(hasattr(thing, method) for method in STREAM_METHODS)
        begun = hasattr(thing, "picture") and not any(hasattr(thing, method) for method in self.methods)
        return self.streamed is not None and (whole or begun)

    def _form(self, spec: str) -> OfflineForm[Any]:
        if self.offline is None:
            raise ValueError(
                f"'{spec}': a {self.what} cannot be run elsewhere, as each of its answers decides what it sees next"
            )
        return self.offline

    def _class(self, spec: str) -> Any:
        """What stands under a name of another package, or at a path."""
        if ":" in spec:
            try:
                return found_at(spec)
            except ImportError as error:
                raise ValueError(f"no algorithm at '{spec}': {error}") from error
        if spec not in installed():
            raise ValueError(self._unknown(spec))
        try:
            return installed()[spec].load()
        except (ImportError, AttributeError) as error:
            raise ValueError(f"algorithm '{spec}' cannot be loaded from {installed()[spec].value}: {error}") from error

    def _unknown(self, name: str) -> str:
        known = [*self.shipped, *installed()]
        near = difflib.get_close_matches(name, known, n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        own = "your own as 'module:Class' or 'exec:./program'"
        return f"unknown algorithm '{name}'{hint}; allowed: {', '.join(known)}, or {own}"


def _pure_ncc(options: VttOptions) -> TargetTracker:
    """The paper's baseline: without scale, roll and warp, whatever the options say of them."""
    return VisualTargetTracker(replace(options, scale=PURE_NCC.scale, roll=PURE_NCC.roll, warp=PURE_NCC.warp))


def _executable_velocity(command: Command, limits: ExecutableLimits) -> VelocityEstimator:
    """A program that gets three pictures at once, or as many as there are one by one."""
    if command.stream:
        return StreamedEstimator(ExecutableVelocityStream(command, limits))
    return ExecutableVelocityEstimator(command, limits)


VELOCITY: Task[VelocityEstimator, DimesOptions] = Task(
    name="velocity",
    what="velocity estimator",
    methods=("estimate",),
    shipped={
        "dimes": DimesEstimator,
        "phase-correlation": lambda _: PhaseCorrelationEstimator(),
        "homography": lambda _: HomographyEstimator(),
    },
    executable=_executable_velocity,
    options=DimesOptions,
    offline=VELOCITY_FORM,
    streamed=StreamedEstimator,
)

TRACKING: Task[TargetTracker, VttOptions] = Task(
    name="tracking",
    what="target tracker",
    methods=("designate", "aim", "update", "clear", "state"),
    shipped={"vtt": VisualTargetTracker, "pure-ncc": _pure_ncc, "lucas-kanade": lucas_kanade_tracker},
    executable=ExecutableTargetTracker,
    options=VttOptions,
)

LANDING: Task[SiteEstimator, HdaOptions] = Task(
    name="landing",
    what="estimator of landing sites",
    methods=("estimate",),
    shipped={"hda": HdaEstimator, "essential-matrix": EssentialMatrixEstimator, "semi-global": SemiGlobalEstimator},
    executable=ExecutableSiteEstimator,
    options=HdaOptions,
    offline=SITE_FORM,
)

#: The tasks that have a conformance suite, by their names.
TASKS: Mapping[str, Task[Any, Any]] = {task.name: task for task in (VELOCITY, TRACKING, LANDING)}


@cache
def shipped_names() -> frozenset[str]:
    """Names of the algorithms that the systems bring with them."""
    names: set[str] = set()
    for path in dict.fromkeys(path for system in systems() for path in system.tasks):
        with suppress(ImportError):  # the system's own campaigns report it
            names.update(found_at(path).shipped)
    return frozenset(names)


@cache
def installed() -> Mapping[str, EntryPoint]:
    """Algorithms that installed packages name, in the order of their names."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def sources_of(spec: str) -> list[tuple[str, Path]]:
    """The sources of an algorithm of one's own in Python, by their names; none of one that ships, or of a program."""
    path = installed()[spec].value if spec in installed() else spec
    elsewhere = is_offline(spec) or spec.startswith(tuple(PREFIXES))
    return list(sources_at(path)) if ":" in path and not elsewhere and spec not in shipped_names() else []


def check_chosen(task: Task[Any, Any], specs: Sequence[str]) -> None:
    """Raises ValueError where one of several algorithms is not there, or one is named twice."""
    for place, spec in enumerate(specs):
        task.check(spec)
        if spec in specs[:place]:
            raise ValueError(f"the algorithm '{spec}' is named twice")


def labels(specs: Sequence[str]) -> tuple[str, ...]:
    """Short names of algorithms, told apart: what stands before the point in the columns of a row.

    >>> labels(["dimes", "phase-correlation", "mypkg.velocity:Estimator", "exec:./mine --fast", "exec:./mine"])
    ('dimes', 'phase_correlation', 'Estimator', 'mine', 'mine_2')
    """
    given: list[str] = []
    for spec in specs:
        short = _short(spec)
        number, label = 1, short
        while label in given:
            number += 1
            label = f"{short}_{number}"
        given.append(label)
    return tuple(given)


def _short(spec: str) -> str:
    """The last part of a name, as an identifier."""
    program = re.match(r"(?:(?:exec|serve)(?:-stream)?|answers|export):\s*(\S+)", spec)
    last = Path(program[1]).stem if program else spec.rpartition(":")[2]
    label = re.sub(r"\W", "_", last, flags=re.ASCII)
    return label if label[:1].isalpha() else f"a_{label}"
