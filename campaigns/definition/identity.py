"""Identity of a campaign: hashes and versions of everything besides the case number on which its rows depend."""

from __future__ import annotations

import hashlib
import json
import platform
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from marsyard.algorithms.exchange import parse_command
from marsyard.campaigns.definition.campaign import leaves, value_at
from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.sampling.dispersions import Choice, Fixed, Grid
from marsyard.scenarios.estimators import algorithm_sources
from marsyard.scenarios.import_path import relative_to
from marsyard.scenarios.interface import HasAlgorithms, HasParts, Scenario
from marsyard.scenarios.offline import answers_file
from marsyard.scenarios.registry import UnknownScenarioError, scenario, scenario_source
from marsyard.scenarios.user_files import input_files

#: Packages on whose code rows depend; reports and commands change no row.
_CODE = ("sim", "algorithms", "scenarios", "campaigns")

#: Keys of a configuration that change no row of a finished case.
_KEYS_WITHOUT_EFFECT = frozenset({"appended", "description", "limits", "most_cases", "requirements", "retain"})

_HOME = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Identity:
    """Everything that must be equal for two runs of a case to give the same row, on one machine.

    configuration: hash of the statements about cases.
    code: hash of the sources of `sim`, `algorithms`, `scenarios`, `campaigns`, and of custom scenarios, algorithms and
    parts.
    versions: of Python, Marsyard and the packages that it requires.
    inputs: hashes of the files that the parameters name, by path as stated; missing files are left out. None where an
    earlier version stored none, so that changes are unknown.
    """

    configuration: str
    code: str
    versions: Mapping[str, str]
    inputs: Mapping[str, str] | None = None

    def plain(self) -> dict[str, Any]:
        """As stored in the record."""
        return asdict(self)

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> Self:
        """Identity stored in a record."""
        inputs = stored.get("inputs")
        return cls(
            str(stored["configuration"]),
            str(stored["code"]),
            dict(stored["versions"]),
            None if inputs is None else dict(inputs),
        )

    def differences(self, other: Identity) -> list[str]:
        """Differences from another identity, each in a few words."""
        pairs = {name: (getattr(self, name)[:12], getattr(other, name)[:12]) for name in ("configuration", "code")}
        for name in sorted({*self.versions, *other.versions}):
            pairs[name] = (str(self.versions.get(name)), str(other.versions.get(name)))
        before, now = self.inputs or {}, other.inputs or {}
        pairs.update({name: (before[name][:12], now[name][:12]) for name in sorted({*before} & {*now})})
        return [f"{name} ({old}, now {new})" for name, (old, new) in pairs.items() if old != new]


def identity_of(configuration: CampaignConfiguration) -> Identity:
    """Identity of a campaign if it were run now.

    Raises CampaignError where a file that the parameters name cannot be used any more.
    """
    named = (scenario_source(configuration.scenario), *selected_algorithms(configuration))
    named = (*named, *selected_parts(configuration))
    return Identity(
        configuration_hash(configuration), code_hash(named), package_versions(), input_hashes(configuration)
    )


def input_hashes(configuration: CampaignConfiguration) -> dict[str, str]:
    """SHA-256 of each file that the parameters or their dispersions name, by path.

    Raises CampaignError where the scenario refuses the parameters, for example because a file is missing or has
    changed.
    """
    try:
        parameters = scenario(configuration.scenario).parameters_type.model_validate(configuration.parameters)
    except UnknownScenarioError:
        return {}
    except ValidationError as error:
        reasons = "; ".join(one["msg"].removeprefix("Value error, ") for one in error.errors(include_url=False))
        raise CampaignError(f"the campaign's parameters cannot be used any more: {reasons}") from error
    dispersed = [one for one in configuration.dispersions.values() if isinstance(one, Choice | Fixed | Grid)]
    stated = [value for one in dispersed for extreme in one.extremes() for _, value in leaves(extreme)]
    names = [*input_files(parameters), *(value for value in stated if isinstance(value, str) and Path(value).is_file())]
    return {name: _file_hash(Path(name)) for name in dict.fromkeys(names) if Path(name).is_file()}


def _file_hash(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CampaignError(f"{path}: cannot be read: {error.strerror or error}") from error


def selected_algorithms(configuration: CampaignConfiguration) -> tuple[str, ...]:
    """Algorithms under test that a configuration or its dispersions name."""
    used = _scenario(configuration)
    if not isinstance(used, HasAlgorithms):
        return ()
    table: Any = configuration.parameters
    for part in used.algorithm_table:
        table = table.get(part, {})
    path = ".".join((*used.algorithm_table, "algorithm"))
    dispersed = configuration.dispersions.get(path)
    varied = [] if dispersed is None else [str(value) for value in dispersed.extremes()]
    stated = [table.get("algorithm", ""), *table.get("compared", ()), *varied]
    return tuple(str(spec) for spec in dict.fromkeys(stated) if spec)


def selected_parts(configuration: CampaignConfiguration) -> tuple[str, ...]:
    """Import paths (``module:name``) of the custom parts that a configuration or its dispersions name."""
    used = _scenario(configuration)
    if not isinstance(used, HasParts):
        return ()
    trees = [configuration.parameters]
    for path, dispersion in configuration.dispersions.items():
        values = dispersion.extremes() if any(f"{key}.".startswith(f"{path}.") for key in used.part_keys) else ()
        trees += [_nested(path, value) for value in values]
    paths = [kind.path(spec) for tree in trees for key, kind in used.part_keys.items() for spec in _names_at(tree, key)]
    return tuple(dict.fromkeys(paths))


def _scenario(configuration: CampaignConfiguration) -> Scenario | None:
    try:
        return scenario(configuration.scenario)
    except UnknownScenarioError:
        return None


def _nested(path: str, value: Any) -> dict[str, Any]:
    for part in reversed(path.split(".")):
        value = {part: value}
    return dict(value)


def _names_at(tree: Any, path: str) -> list[str]:
    """Name, or names, at a path of a tree; empty where there is none."""
    try:
        value = value_at(tree, path)
    except ValueError:
        return []
    return [value] if isinstance(value, str) else [str(one) for one in value or ()]


def configuration_hash(configuration: CampaignConfiguration) -> str:
    """Hash of a configuration's statements about cases."""
    stated = configuration.model_dump(mode="json", exclude=set(_KEYS_WITHOUT_EFFECT))
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()


@cache
def code_hash(named: tuple[str, ...]) -> str:
    """Hash of the sources on which rows depend; `named` are the scenario, algorithms and parts."""
    custom = [source for one in named for source in custom_sources(one)]
    return hash_sources((*_package_sources(), *custom))


def hash_sources(sources: Iterable[tuple[str, Path]]) -> str:
    """SHA-256 of the names and contents of source files."""
    digest = hashlib.sha256()
    for name, path in sources:
        contents = path.read_bytes()
        digest.update(f"{name}\0{len(contents)}\0".encode())
        digest.update(contents)
    return digest.hexdigest()


def _package_sources() -> Iterator[tuple[str, Path]]:
    for folder in _CODE:
        for pattern in ("*.py", "*.json"):
            yield from relative_to(_HOME, sorted((_HOME / folder).rglob(pattern)))


def custom_sources(named: str) -> Iterator[tuple[str, Path]]:
    """Source files of a custom scenario, algorithm or part: package or module, program, or table of answers."""
    table = answers_file(named)
    if table is not None:
        yield table.name, table
        return
    try:
        command = parse_command(named)
    except ValueError:
        return
    if command is not None:
        program = shutil.which(command.words[0])
        words = [Path(word) for word in (program, *command.words[1:]) if word is not None]
        yield from ((path.name, path) for path in words if path.is_file())
        return

    yield from algorithm_sources(named)


def package_versions() -> dict[str, str]:
    """Versions of Python, of Marsyard and of the packages that it requires."""
    try:
        requirements = metadata.requires("marsyard") or []
    except metadata.PackageNotFoundError:
        requirements = []
    names = {re.split(r"[^A-Za-z0-9._-]", text)[0] for text in requirements if "extra ==" not in text}
    versions = {"python": platform.python_version()}
    for name in sorted({"marsyard", *names}):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
