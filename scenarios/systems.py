"""Registry of the systems under test and their scenarios: those of Marsyard, and those of installed packages.

A system is, for example, the velocity estimator DIMES with its scenarios, campaigns, requirements and reports. Each
folder of `scenarios` with a module `system` defines one. Another package adds one by an entry point of the group
`marsyard.systems`::

    [project.entry-points."marsyard.systems"]
    altitude = "mypackage.system:SYSTEM"

A system that cannot be loaded is omitted, with one message in `problems`.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, cast

from marsyard.scenarios.imports import import_object
from marsyard.scenarios.template import CampaignTemplate

if TYPE_CHECKING:  # its imports take longer than `marsyard list`
    from marsyard.scenarios.interface import Scenario

#: Folder of Marsyard's systems, each in a folder of its own, and of the files that they share.
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

    - name: short unique name; the dashboard groups campaigns by it
    - title: title in reports
    - summary: one sentence on the tests
    - scenarios: classes that implement `marsyard.scenarios.interface.Scenario`, by the names in campaign files
    - tasks: each a `marsyard.scenarios.tasks.Task`: the published algorithm, the baselines, and the accepted forms
      of a user's algorithm. Entry points of the group `marsyard.algorithms` add algorithms.
    - folder: its files: campaigns in the folder `catalogue`, and the requirements that campaigns reference by id in
      `requirements.toml` (docs/reports.md), and alternative models in `variants.toml` (docs/robustness.md)
    - columns: columns of the rows, each a `marsyard.scenarios.columns.Columns`, by scenario. Without them, requirements
      are checked against the first finished case.
    - compilation_campaigns: campaigns of the catalogue, each with overrides (``KEY=VALUE``) for a small one. One case
      of each calls, and so compiles, all numeric kernels of its scenario (`marsyard compile`).
    - templates: of campaign files, by the values of ``marsyard new --system``
    - ingest: function that converts recorded data into cases (`marsyard ingest`). Arguments: folder of the data, folder
      for the new cases, and folder to which the new cases are moved. Returns `Ingested`.
    - report: a `marsyard.reports.presentation.Presentation`: report sections, and the figures of a case
    - conditions: sources of the quantities of `marsyard.reports.validation_rows.Conditions`, by quantity. Each item is
      a source of values, or several separated by ``|``, of which the first that exists is used: a column of the rows (a
      pattern), a parameter path of the campaign, ``site.PATH`` of the site's preset, or ``=VALUE``
    - find_site: function that returns the preset of a site, given by name; raises ValueError for an unknown name
    """

    name: str
    title: str
    summary: str
    scenarios: Mapping[str, str]
    tasks: tuple[str, ...] = ()
    folder: Path | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    compilation_campaigns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    templates: Mapping[str, CampaignTemplate] = field(default_factory=dict)
    ingest: str = ""
    report: str = ""
    conditions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    find_site: str = "marsyard.sim.terrain.sites:site"

    @property
    def campaigns(self) -> Mapping[str, Path]:
        """Files of the catalogue by campaign."""
        files = () if self.folder is None else sorted((self.folder / "catalogue").glob("*.toml"))
        return {path.stem: path for path in files}

    @property
    def requirements(self) -> Path | None:
        """File of the requirements; None without one."""
        path = None if self.folder is None else self.folder / "requirements.toml"
        return path if path is not None and path.is_file() else None


#: Entry point group of other packages' systems.
GROUP = "marsyard.systems"


def own_paths() -> dict[str, str]:
    """Return the systems of Marsyard as ``module:SYSTEM``, by the name of their folder."""
    folders = sorted(file.parent.name for file in SCENARIOS_FOLDER.glob("*/system.py"))
    return {folder: f"marsyard.scenarios.{folder}.system:SYSTEM" for folder in folders}


@dataclass(frozen=True)
class Registry:
    """Systems of this installation: those of Marsyard by folder, those of other packages by name, and problems.

    problems: one message for each system that is omitted
    """

    own: tuple[System, ...]
    plugins: tuple[System, ...]
    problems: tuple[str, ...]


@cache
def registry() -> Registry:
    """Read the systems of this installation, once per process."""
    own: list[System] = []
    plugins: list[System] = []
    problems: list[str] = []
    points = sorted((point.name, point.value) for point in entry_points(group=GROUP))
    others = [(name, path) for name, path in points if path not in own_paths().values()]
    for group, paths in ((own, own_paths().items()), (plugins, others)):
        for name, path in paths:
            try:
                group.append(_load(path, [*own, *plugins]))
            except ValueError as error:
                problems.append(f"system '{name}' ({path}) is omitted: {error}")
    return Registry(tuple(own), tuple(plugins), tuple(problems))


def systems() -> tuple[System, ...]:
    """Return all systems: those of Marsyard by folder, then those of other packages by name."""
    return (*registry().own, *registry().plugins)


def catalogue() -> dict[str, Path]:
    """Return the campaign files of all systems by campaign name, sorted."""
    return dict(sorted((name, path) for system in systems() for name, path in system.campaigns.items()))


def problems() -> tuple[str, ...]:
    """Return one message for each system that is omitted."""
    return registry().problems


def scenario_paths() -> Mapping[str, str]:
    """Return the classes of the scenarios as ``module:Class`` by scenario."""
    return {name: path for system in systems() for name, path in system.scenarios.items()}


def templates() -> Mapping[str, CampaignTemplate]:
    """Return the templates of `marsyard new` by value of its option ``--system``."""
    return {name: template for system in systems() for name, template in system.templates.items()}


def find_system(scenario: str) -> System | None:
    """Return the system with a scenario of this name or ``module:Class``; None without one."""
    return next((item for item in systems() if scenario in {*item.scenarios, *item.scenarios.values()}), None)


def _load(path: str, earlier_systems: list[System]) -> System:
    """Load the system ``module:NAME``. Raises ValueError if it is invalid or conflicts with an earlier system."""
    try:
        system = import_object(path)
    except ImportError as error:
        raise ValueError(f"it cannot be imported: {error}") from error
    if not isinstance(system, System):
        raise ValueError(f"it is a {type(system).__name__}; allowed: a marsyard.scenarios.systems.System")
    if system.folder is not None and not system.folder.is_dir():
        raise ValueError(f"the folder {system.folder} does not exist")
    for earlier in earlier_systems:
        conflicts = [f"name '{system.name}'"] if system.name == earlier.name else []
        for kind in ("scenarios", "campaigns", "templates"):
            names = getattr(earlier, kind)
            conflicts += [f"{kind.removesuffix('s')} '{name}'" for name in getattr(system, kind) if name in names]
        if conflicts:
            raise ValueError(f"the system '{earlier.name}' already has the {conflicts[0]}")
    return system


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
