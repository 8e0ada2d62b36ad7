"""What a campaign's rows depend on beside the case's number: configuration, code, packages' versions, input files."""

from __future__ import annotations

import hashlib
import json
import platform
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from marsyard.algorithms.exchange import command_of
from marsyard.campaigns.definition.campaign import leaves, value_at
from marsyard.campaigns.definition.configuration import CampaignConfiguration
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.sampling.levels import Choice, Fixed, Grid
from marsyard.scenarios.dotted import relative_to
from marsyard.scenarios.estimators import sources_of
from marsyard.scenarios.interface import TakesAlgorithms, TakesParts
from marsyard.scenarios.offline import answers_file
from marsyard.scenarios.own_files import input_files
from marsyard.scenarios.registry import UnknownScenarioError, scenario, scenario_source

#: Folders of ours whose code rows depend on; what reports and commands do changes no row.
_CODE = ("sim", "algorithms", "scenarios", "campaigns")

#: Keys of a configuration that change no row of a case that comes to its end.
_OF_NO_EFFECT = frozenset({"appended", "description", "limits", "most_cases", "requirements", "retain"})

_HOME = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Identity:
    """What must be the same for two runs of a case to give the same row, on one machine.

    Attributes
    ----------
    configuration
        Hash of what the configuration states about cases.
    code
        Hash of the sources of `sim`, `algorithms`, `scenarios`, `campaigns`, and of the user's own scenario, algorithms
        and parts.
    versions
        Of Python, Marsyard and the packages that it requires.
    inputs
        Hashes of the contents of the files that the parameters name, by their paths as stated: terrain models, cameras,
        datasheets, flights, meshes, measured cases. Files that are gone are left out. None where an earlier version
        kept none: whether they have changed is then not known.
    """

    configuration: str
    code: str
    versions: Mapping[str, str]
    inputs: Mapping[str, str] | None = None

    def plain(self) -> dict[str, Any]:
        """As it stands in the record."""
        return asdict(self)

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> Self:
        """The identity in a record."""
        inputs = stored.get("inputs")
        return cls(
            str(stored["configuration"]),
            str(stored["code"]),
            dict(stored["versions"]),
            None if inputs is None else dict(inputs),
        )

    def differences(self, other: Identity) -> list[str]:
        """In what another identity differs from this one, each in a few words."""
        pairs = {what: (getattr(self, what)[:12], getattr(other, what)[:12]) for what in ("configuration", "code")}
        for name in sorted({*self.versions, *other.versions}):
            pairs[name] = (str(self.versions.get(name)), str(other.versions.get(name)))
        before, now = self.inputs or {}, other.inputs or {}
        pairs.update({name: (before[name][:12], now[name][:12]) for name in sorted({*before} & {*now})})
        return [f"{what} ({before}, now {now})" for what, (before, now) in pairs.items() if before != now]


def identity_of(configuration: CampaignConfiguration) -> Identity:
    """The identity of a campaign if it were run now.

    Raises
    ------
    CampaignError
        Where a file that the parameters name cannot be used any more.
    """
    named = (scenario_source(configuration.scenario), *chosen_algorithms(configuration), *chosen_parts(configuration))
    return Identity(
        configuration_hash(configuration), code_hash(named), package_versions(), input_hashes(configuration)
    )


def input_hashes(configuration: CampaignConfiguration) -> dict[str, str]:
    """SHA-256 of each file that the parameters name, by its path; those that are dispersed over among them.

    Raises
    ------
    CampaignError
        Where the scenario refuses the parameters, as where a file is gone or has changed since the campaign was made.
    """
    try:
        parameters = scenario(configuration.scenario).parameters_type.model_validate(configuration.parameters)
    except UnknownScenarioError:
        return {}
    except ValidationError as error:
        said = "; ".join(one["msg"].removeprefix("Value error, ") for one in error.errors(include_url=False))
        raise CampaignError(f"the campaign's parameters cannot be used any more: {said}") from error
    dispersed = [one for one in configuration.dispersions.values() if isinstance(one, Choice | Fixed | Grid)]
    stated = [value for one in dispersed for extreme in one.extremes() for _, value in leaves(extreme)]
    names = [*input_files(parameters), *(value for value in stated if isinstance(value, str) and Path(value).is_file())]
    return {name: _file_hash(Path(name)) for name in dict.fromkeys(names) if Path(name).is_file()}


def _file_hash(path: Path) -> str:
    """SHA-256 of a file's contents. Raises CampaignError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CampaignError(f"{path}: cannot be read: {error.strerror or error}") from error


def chosen_algorithms(configuration: CampaignConfiguration) -> tuple[str, ...]:
    """The algorithms under test that a configuration names, those that it disperses over among them."""
    try:
        found = scenario(configuration.scenario)
    except UnknownScenarioError:
        return ()
    if not isinstance(found, TakesAlgorithms):
        return ()
    table: Any = configuration.parameters
    for part in found.algorithm_table:
        table = table.get(part, {})
    path = ".".join((*found.algorithm_table, "algorithm"))
    dispersed = configuration.dispersions.get(path)
    varied = [] if dispersed is None else [str(value) for value in dispersed.extremes()]
    stated = [table.get("algorithm", ""), *table.get("compared", ()), *varied]
    return tuple(str(spec) for spec in dict.fromkeys(stated) if spec)


def chosen_parts(configuration: CampaignConfiguration) -> tuple[str, ...]:
    """Where the user's own parts are that a configuration names, as ``module:name``, dispersed ones among them."""
    try:
        found = scenario(configuration.scenario)
    except UnknownScenarioError:
        return ()
    if not isinstance(found, TakesParts):
        return ()
    trees = [configuration.parameters]
    for path, dispersion in configuration.dispersions.items():
        values = dispersion.extremes() if any(f"{key}.".startswith(f"{path}.") for key in found.part_keys) else ()
        trees += [_nested(path, value) for value in values]
    paths = [kind.path(spec) for tree in trees for key, kind in found.part_keys.items() for spec in _named(tree, key)]
    return tuple(dict.fromkeys(paths))


def _nested(path: str, value: Any) -> dict[str, Any]:
    """A tree that holds one value."""
    for part in reversed(path.split(".")):
        value = {part: value}
    return dict(value)


def _named(tree: Any, path: str) -> list[str]:
    """The name, or the names, at a path of a tree; none where it has none."""
    try:
        found = value_at(tree, path)
    except ValueError:
        return []
    return [found] if isinstance(found, str) else [str(one) for one in found or ()]


def configuration_hash(configuration: CampaignConfiguration) -> str:
    """A hash of what a configuration states about cases."""
    stated = configuration.model_dump(mode="json")
    kept = {name: value for name, value in stated.items() if name not in _OF_NO_EFFECT}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()


@cache
def code_hash(named: tuple[str, ...]) -> str:
    """A hash of the sources that rows depend on, names and contents; `named` are scenario, algorithms and parts."""
    digest = hashlib.sha256()
    foreign = [source for one in named for source in foreign_sources(one)]
    for name, path in (*_own_sources(), *foreign):
        contents = path.read_bytes()
        digest.update(f"{name}\0{len(contents)}\0".encode())
        digest.update(contents)
    return digest.hexdigest()


def _own_sources() -> Iterator[tuple[str, Path]]:
    """Our code, and the constants that lie beside it."""
    for folder in _CODE:
        yield from relative_to(_HOME, sorted((_HOME / folder).rglob("*.py")))
        yield from relative_to(_HOME, sorted((_HOME / folder).rglob("*.json")))


def foreign_sources(named: str) -> Iterator[tuple[str, Path]]:
    """The package or module of what is given as `module:Class` or by an entry point; a program's or a table's file."""
    table = answers_file(named)
    if table is not None:
        yield table.name, table
        return
    try:
        command = command_of(named)
    except ValueError:
        return
    if command is not None:
        program = shutil.which(command.words[0])
        words = [Path(word) for word in (program, *command.words[1:]) if word is not None]
        yield from ((path.name, path) for path in words if path.is_file())
        return
    # a scenario of one's own is named in the same way
    yield from sources_of(named)


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
