"""Registry of the systems under test and their scenarios: those of Marsyard, and those of installed packages.

A system is, for example, the velocity estimator DIMES with its scenarios, campaigns, requirements and reports. A
package adds a system by an entry point of the group `marsyard.systems`::

    [project.entry-points."marsyard.systems"]
    altitude = "mypackage.system:SYSTEM"

A system that cannot be loaded is omitted, with one message in `problems`.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, cast

from marsyard.scenarios.imports import import_object

if TYPE_CHECKING:  # its imports take longer than `marsyard list`
    from marsyard.scenarios.interface import Scenario

#: Folder of the files that the systems of Marsyard share.
SCENARIOS_FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Ingested:
    """Result of `marsyard ingest`: text of the campaign file, numbers of cases and images, and a note for the user."""

    campaign: str
    cases: int
    images: int
    note: str = ""


@dataclass(frozen=True)
class System:
    """A system under test; plain data, whose ``module:NAME`` objects are imported when they are needed.

    A system of another package is a module-level object of this class, in an entry point of the group
    `marsyard.systems` (`marsyard.scenarios.systems`).

    - name: short unique name; the dashboard groups campaigns by it
    - title: title in reports
    - summary: one sentence on the tests
    - scenarios: classes that implement `marsyard.scenarios.interface.Scenario`, by the names in campaign files
    - tasks: each a `marsyard.scenarios.estimators.Task`: the published algorithm, the baselines, and the accepted forms
      of a user's algorithm. Entry points of the group `marsyard.algorithms` add algorithms.
    - catalogue: campaign files, as a folder and a pattern (``folder/altitude-*.toml``)
    - requirements: file of the requirements that campaigns reference by id, as `scenarios/requirements.toml`
    - columns: file of the columns of each scenario's rows, as `scenarios/columns.toml`. Without it, requirements are
      checked against the first finished case.
    - error_sources: file of the sources of error of each scenario's cases, as `scenarios/error_sources.toml`
    - compilation_campaigns: campaigns of the catalogue, each with settings (``KEY=VALUE``) that make it small. One case
      of each calls, and so compiles, all numeric kernels of its scenario (`marsyard compile`).
    - templates: each a `marsyard.scenarios.template.CampaignTemplate`, by the values of ``marsyard new --system``
    - ingest: function that converts recorded data into cases (`marsyard ingest`). Arguments: folder of the data, folder
      for the new cases, and folder to which the new cases are moved. Returns `Ingested`.
    - report: a `marsyard.reports.presentation.Presentation`: report sections, and the figures of a case
    """

    name: str
    title: str
    summary: str
    scenarios: Mapping[str, str]
    tasks: tuple[str, ...] = ()
    catalogue: Path | None = None
    requirements: Path | None = None
    columns: Path | None = None
    error_sources: Path | None = None
    compilation_campaigns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    templates: Mapping[str, str] = field(default_factory=dict)
    ingest: str = ""
    report: str = ""

    @property
    def campaigns(self) -> Mapping[str, Path]:
        """Files of the catalogue by campaign."""
        if self.catalogue is None:
            return {}
        return {path.stem: path for path in sorted(self.catalogue.parent.glob(self.catalogue.name))}


#: Entry point group of other packages' systems.
GROUP = "marsyard.systems"

#: Files that the systems of Marsyard share.
_CATALOGUE = SCENARIOS_FOLDER / "catalogue"
_REQUIREMENTS, _COLUMNS = SCENARIOS_FOLDER / "requirements.toml", SCENARIOS_FOLDER / "columns.toml"
_ERROR_SOURCES = SCENARIOS_FOLDER / "error_sources.toml"

#: The systems of Marsyard. Recorded images come first, because their cases also contain products of other systems.
BUILT_IN = (
    System(
        name="measured",
        title="Recorded images",
        summary="Algorithms on real images, compared with the measured poses.",
        scenarios={
            "measured-velocity": "marsyard.scenarios.measured.scenarios:MeasuredVelocityScenario",
            "measured-landing": "marsyard.scenarios.measured.scenarios:MeasuredLandingScenario",
            "measured-matching": "marsyard.scenarios.measured.scenarios:MatchingScenario",
        },
        tasks=("marsyard.scenarios.estimators:VELOCITY", "marsyard.scenarios.estimators:LANDING"),
        columns=_COLUMNS,
        ingest="marsyard.scenarios.measured.ingest:ingest_campaign",
        report="marsyard.reports.measured.presentation:MEASURED",
    ),
    System(
        name="dimes",
        title="Descent Image Motion Estimation System (DIMES)",
        summary="Horizontal velocity of a lander under its parachute, from three images.",
        scenarios={"descent": "marsyard.scenarios.descent.scenario:DescentScenario"},
        tasks=("marsyard.scenarios.estimators:VELOCITY",),
        catalogue=_CATALOGUE / "dimes-*.toml",
        requirements=_REQUIREMENTS,
        columns=_COLUMNS,
        error_sources=_ERROR_SOURCES,
        compilation_campaigns={"dimes-smoke": ("terrain.samples=512",)},
        templates={"velocity": "marsyard.scenarios.template:VELOCITY"},
        report="marsyard.reports.dimes.presentation:DIMES",
    ),
    System(
        name="fieldtest",
        title="Field test of DIMES on a helicopter",
        summary="Horizontal velocity of a helicopter from triples of images over desert ground.",
        scenarios={"fieldtest": "marsyard.scenarios.fieldtest.scenario:FieldTestScenario"},
        tasks=("marsyard.scenarios.estimators:VELOCITY",),
        catalogue=_CATALOGUE / "dimes-fieldtest.toml",
        columns=_COLUMNS,
        error_sources=_ERROR_SOURCES,
        report="marsyard.reports.fieldtest.presentation:FIELD_TEST",
    ),
    System(
        name="vtt",
        title="Visual target tracking (VTT)",
        summary="Position of a target that a rover approaches, tracked in the images of its mast cameras.",
        scenarios={
            "rover": "marsyard.scenarios.rover.scenario:RoverScenario",
            "rover-drive": "marsyard.scenarios.rover.scenario:SharedDriveScenario",
        },
        tasks=("marsyard.scenarios.estimators:TRACKING",),
        catalogue=_CATALOGUE / "vtt-*.toml",
        requirements=_REQUIREMENTS,
        columns=_COLUMNS,
        error_sources=_ERROR_SOURCES,
        compilation_campaigns={
            "vtt-checkout-2": ("world.samples=512", "start.distance_m=2.4", "target.diameter_m=0.5")
        },
        templates={"tracking": "marsyard.scenarios.template:TRACKING"},
        report="marsyard.reports.vtt.presentation:VTT",
    ),
    System(
        name="hda",
        title="Hazard detection and avoidance (HDA)",
        summary="A safe landing site from two images of a moving camera.",
        scenarios={"landing": "marsyard.scenarios.landing.scenario:LandingScenario"},
        tasks=("marsyard.scenarios.estimators:LANDING",),
        catalogue=_CATALOGUE / "hda-*.toml",
        requirements=_REQUIREMENTS,
        columns=_COLUMNS,
        error_sources=_ERROR_SOURCES,
        compilation_campaigns={"hda-benign": ("terrain.samples=512",)},
        templates={"landing": "marsyard.scenarios.template:LANDING"},
        report="marsyard.reports.hda.presentation:HDA",
    ),
)


@dataclass(frozen=True)
class Registry:
    """The systems in order, and one message for each omitted system."""

    systems: tuple[System, ...]
    problems: tuple[str, ...]


@cache
def registry() -> Registry:
    """Read the systems of this installation, once per process."""
    loaded_systems = list(BUILT_IN)
    problems: list[str] = []
    for point in sorted(entry_points(group=GROUP), key=lambda item: (item.name, item.value)):
        try:
            loaded_systems.append(_load(point, loaded_systems))
        except ValueError as error:
            problems.append(f"system '{point.name}' ({point.value}) is omitted: {error}")
    return Registry(tuple(loaded_systems), tuple(problems))


def systems() -> tuple[System, ...]:
    """Return all systems: those of Marsyard first, then those of other packages by name."""
    return registry().systems


def catalogue() -> dict[str, Path]:
    """Return the campaign files of all systems by campaign name, sorted."""
    return dict(sorted((name, path) for system in systems() for name, path in system.campaigns.items()))


def problems() -> tuple[str, ...]:
    """Return one message for each system of another package that is omitted."""
    return registry().problems


def scenario_paths() -> Mapping[str, str]:
    """Return the classes of the scenarios as ``module:Class`` by scenario."""
    return {name: path for system in systems() for name, path in system.scenarios.items()}


def template_paths() -> Mapping[str, str]:
    """Return the templates of `marsyard new` as ``module:NAME`` by value of its option ``--system``."""
    return {name: path for system in systems() for name, path in system.templates.items()}


def find_system(scenario: str) -> System | None:
    """Return the system with a scenario of this name or ``module:Class``; None without one."""
    return next((item for item in systems() if scenario in {*item.scenarios, *item.scenarios.values()}), None)


def _load(point: EntryPoint, earlier_systems: list[System]) -> System:
    """Load the system of an entry point. Raises ValueError if it is invalid or conflicts with an earlier system."""
    try:
        system = import_object(point.value)
    except ImportError as error:
        raise ValueError(f"it cannot be imported: {error}") from error
    if not isinstance(system, System):
        raise ValueError(f"it is a {type(system).__name__}; allowed: a marsyard.scenarios.systems.System")
    missing = [
        str(path)
        for path in (system.requirements, system.columns, system.error_sources)
        if path is not None and not path.is_file()
    ]
    if system.catalogue is not None and not system.campaigns:
        missing.append(str(system.catalogue))
    if missing:
        raise ValueError(f"these files do not exist: {', '.join(missing)}")
    for earlier in earlier_systems:
        conflicts = [f"name '{system.name}'"] if system.name == earlier.name else []
        for kind in ("scenarios", "campaigns", "templates"):
            names = getattr(earlier, kind)
            conflicts += [f"{kind.removesuffix('s')} '{name}'" for name in getattr(system, kind) if name in names]
        if conflicts:
            raise ValueError(f"the system '{earlier.name}' already has the {conflicts[0]}")
    return system


@dataclass(frozen=True)
class RowColumns:
    """Columns of a scenario's rows; `flags` and `numbers` contain names or patterns, in which `*` matches any text.

    - flags: boolean columns
    - numbers: numeric columns
    - named_flags: path of a list among the parameters; the `name` of each entry is a further boolean column; empty for
      none
    - from_truth: boolean columns that the flight system cannot know, because they are computed from the truth, and the
      definition of each; a list in the file has empty definitions
    - configured: boolean columns that the configuration of a case determines, such as its camera or its driving mode
    - conditions: names or patterns of the numbers that describe the conditions of a case, not results of the algorithm;
      empty if unknown
    """

    flags: tuple[str, ...]
    numbers: tuple[str, ...]
    named_flags: str = ""
    from_truth: Mapping[str, str] = field(default_factory=dict)
    configured: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()

    def has_flag(self, name: str) -> bool:
        """Return whether a boolean column may have this name."""
        return any(fnmatchcase(name, pattern) for pattern in self.flags)

    def has_number(self, name: str) -> bool:
        """Return whether a numeric column may have this name."""
        return any(fnmatchcase(name, pattern) for pattern in self.numbers)


@cache
def row_columns(scenario: str) -> RowColumns | None:
    """Return the columns of a scenario; None if its system has no such file. Raises ValueError for an invalid file."""
    system = find_system(scenario)
    if system is None or system.columns is None:
        return None
    try:
        columns = tomllib.loads(system.columns.read_text(encoding="utf-8")).get(scenario)
        if columns is None:
            return None
        from_truth = columns.get("from_truth", {})
        return RowColumns(
            tuple(columns["flags"]),
            tuple(columns["numbers"]),
            columns.get("named_flags", ""),
            dict(from_truth) if isinstance(from_truth, Mapping) else dict.fromkeys(from_truth, ""),
            tuple(columns.get("configured", ())),
            tuple(columns.get("conditions", ())),
        )
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{system.columns}: invalid columns: {type(error).__name__}: {error}") from error


class UnknownScenarioError(LookupError):
    """No scenario has the name, or the path cannot be imported."""


def scenario_names() -> list[str]:
    """Return the names of the scenarios of all systems."""
    return sorted(scenario_paths())


def scenario(name: str) -> Scenario:
    """Create the scenario of a name, or of a class ``module:Class`` that implements `Scenario`.

    Raises UnknownScenarioError with the allowed names.
    """
    path = name if ":" in name else scenario_paths().get(name)
    if path is None:
        matches = difflib.get_close_matches(name, scenario_names(), n=1)
        hint = f" (did you mean '{matches[0]}'?)" if matches else ""
        allowed = ", ".join(scenario_names())
        message = f"unknown scenario '{name}'{hint}; allowed: {allowed}, or a custom one as 'module:Class'"
        raise UnknownScenarioError("; ".join((message, *problems())))
    try:
        scenario_type = import_object(path)
    except ImportError as error:
        raise UnknownScenarioError(f"cannot import scenario '{path}': {error}") from error
    members = ("parameters_type", "shared_inputs", "prepare", "run")
    missing = [member for member in members if not hasattr(scenario_type, member)]
    if missing:
        raise UnknownScenarioError(f"'{path}' is not a valid scenario: missing members: {', '.join(missing)}")
    return cast("Scenario", scenario_type())


def scenario_source(name: str) -> str:
    """Return ``module:Class`` for a scenario of another package; the name for any other scenario."""
    path = scenario_paths().get(name, name)
    return name if path.startswith("marsyard.") else path
