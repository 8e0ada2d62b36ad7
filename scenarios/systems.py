"""The registry of systems: those of Marsyard, and those of installed packages.

A package names a system of its own by an entry point of the group `marsyard.systems`::

    [project.entry-points."marsyard.systems"]
    altitude = "mypackage.system:SYSTEM"

A system that cannot be used is left out, with one message in `problems`; the others are not affected.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from marsyard.scenarios.dotted import found_at
from marsyard.scenarios.system import System

#: Entry points of other packages' systems.
GROUP = "marsyard.systems"

#: The systems that are part of Marsyard. Cases of recorded data come first: their products are also those of others.
BUILT_IN = (
    "marsyard.scenarios.measured.system:MEASURED",
    "marsyard.scenarios.descent.system:DIMES",
    "marsyard.scenarios.fieldtest.system:FIELD_TEST",
    "marsyard.scenarios.rover.system:VTT",
    "marsyard.scenarios.landing.system:HDA",
)


@dataclass(frozen=True)
class Registry:
    """The systems in order, and one message for each that was left out."""

    systems: tuple[System, ...]
    problems: tuple[str, ...]


@cache
def registry() -> Registry:
    """The systems of this installation, read once a process."""
    known: list[System] = [found_at(path) for path in BUILT_IN]
    problems: list[str] = []
    for point in sorted(entry_points(group=GROUP), key=lambda one: (one.name, one.value)):
        try:
            known.append(_loaded(point, known))
        except ValueError as error:
            problems.append(f"system '{point.name}' ({point.value}) is left out: {error}")
    return Registry(tuple(known), tuple(problems))


def systems() -> tuple[System, ...]:
    """All systems: those of Marsyard first, then those of other packages by their names."""
    return registry().systems


def problems() -> tuple[str, ...]:
    """One message for each system of another package that was left out."""
    return registry().problems


def scenario_paths() -> Mapping[str, str]:
    """The class of each scenario as ``module:Class``, by the scenario's name."""
    return {name: path for system in systems() for name, path in system.scenarios.items()}


def template_paths() -> Mapping[str, str]:
    """The templates of `marsyard new` as ``module:NAME``, by the names of its option ``--system``."""
    return {name: path for system in systems() for name, path in system.templates.items()}


def system_of(scenario: str) -> System | None:
    """The system that has a scenario of this name, or of this ``module:Class``; None where no system has it."""
    found = (one for one in systems() if scenario in one.scenarios or scenario in one.scenarios.values())
    return next(found, None)


def _loaded(point: EntryPoint, known: list[System]) -> System:
    """The system of an entry point. Raises ValueError where it cannot be used next to those known."""
    try:
        system = found_at(point.value)
    except ImportError as error:
        raise ValueError(f"it cannot be imported: {error}") from error
    if not isinstance(system, System):
        raise ValueError(f"it is a {type(system).__name__}; allowed: a marsyard.scenarios.system.System")
    missing = [str(path) for path in (system.requirements, system.columns) if path is not None and not path.is_file()]
    if system.catalogue is not None and not system.campaigns:
        missing.append(str(system.catalogue))
    if missing:
        raise ValueError(f"it names what is not there: {', '.join(missing)}")
    for other in known:
        shared = next(_shared_names(system, other), None)
        if shared is not None:
            raise ValueError(f"the system '{other.name}' already has the {shared}")
    return system


def _shared_names(system: System, other: System) -> Iterator[str]:
    """Names that two systems may not share but do."""
    if system.name == other.name:
        yield f"name '{system.name}'"
    for kind in ("scenarios", "campaigns", "templates"):
        for name in getattr(system, kind):
            if name in getattr(other, kind):
                yield f"{kind.removesuffix('s')} '{name}'"
