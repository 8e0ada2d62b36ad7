"""Identity of a campaign: hashes and versions of all inputs, except the case number, that determine its rows.

The module also describes the algorithms of a campaign for its record: class, version, options, hash of the sources.
Custom parts are code of users that replaces the motion, an instrument or a score (docs/custom-parts.md).
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from marsyard.algorithms.exchange import PREFIXES, ExecutableLimits, parse_command
from marsyard.campaigns.definition.campaign import Campaign, find_value, leaves
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.sampling.dispersions import Choice, Fixed, GridDispersion
from marsyard.scenarios.imports import relative_to, source_files
from marsyard.scenarios.interface import HasAlgorithms, HasParts, Scenario
from marsyard.scenarios.isolation.description import plain_options
from marsyard.scenarios.offline_algorithms import answers_file, is_offline
from marsyard.scenarios.systems import UnknownScenarioError, scenario, scenario_source
from marsyard.scenarios.tasks import algorithm_sources, custom_path, describe_custom
from marsyard.scenarios.user_files import input_files

#: Folders of the packages whose code determines rows; reports and commands do not affect rows.
_CODE_FOLDERS = ("sim", "algorithms", "scenarios", "campaigns")
#: Keys of a definition that do not affect the row of a finished case.
_KEYS_WITHOUT_EFFECT = frozenset(
    {"appended", "calibration", "description", "limits", "max_cases", "requirements", "retain"}
)
_PACKAGE_FOLDER = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Identity:
    """All values that determine the row of a case; with equal identity, two runs on one machine have equal rows.

    - definition: hash of the keys that determine the cases
    - code: hash of the sources of `sim`, `algorithms`, `scenarios`, `campaigns`, and of custom code
    - versions: versions of Python, Marsyard and the packages that Marsyard requires
    - inputs: hashes of the parameters' input files, by path as in the parameters; missing files are omitted
    """

    definition: str
    code: str
    versions: Mapping[str, str]
    inputs: Mapping[str, str]

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> Self:
        """Read an identity from a record."""
        versions, inputs = dict(stored["versions"]), dict(stored["inputs"])
        return cls(str(stored["definition"]), str(stored["code"]), versions, inputs)

    def differences(self, other: Identity) -> list[str]:
        """Describe the differences from another identity, each in a few words."""
        pairs = {name: (getattr(self, name)[:12], getattr(other, name)[:12]) for name in ("definition", "code")}
        for name in sorted({*self.versions, *other.versions}):
            pairs[name] = (str(self.versions.get(name)), str(other.versions.get(name)))
        common_names = sorted({*self.inputs} & {*other.inputs})
        pairs.update({name: (self.inputs[name][:12], other.inputs[name][:12]) for name in common_names})
        return [f"{name} ({old}, now {new})" for name, (old, new) in pairs.items() if old != new]


def create_identity(definition: CampaignDefinition) -> Identity:
    """Create the identity of a campaign with the current code, versions and input files.

    Raises CampaignError if an input file is no longer valid.
    """
    custom_components = (*list_algorithms(definition), *list_parts(definition))
    code = hash_code((scenario_source(definition.scenario), *custom_components))
    return Identity(definition_hash(definition), code, read_versions(), hash_inputs(definition))


def hash_inputs(definition: CampaignDefinition) -> dict[str, str]:
    """Compute the SHA-256 of each input file of the parameters or their dispersions, by path.

    Raises CampaignError if the scenario rejects the parameters, for example because a file is missing or has changed.
    """
    try:
        parameters = scenario(definition.scenario).parameters_type.model_validate(definition.parameters)
    except UnknownScenarioError:
        return {}
    except ValidationError as error:
        reasons = "; ".join(detail["msg"].removeprefix("Value error, ") for detail in error.errors(include_url=False))
        raise CampaignError(f"the campaign's parameters are no longer valid: {reasons}") from error
    dispersions = [
        item for item in definition.dispersions.values() if isinstance(item, Choice | Fixed | GridDispersion)
    ]
    values = [value for item in dispersions for extreme in item.extremes() for _, value in leaves(extreme)]
    hashes: dict[str, str] = {}
    for name in dict.fromkeys((*input_files(parameters), *(value for value in values if isinstance(value, str)))):
        if Path(name).is_file():
            try:
                with Path(name).open("rb") as file:
                    hashes[name] = hashlib.file_digest(file, "sha256").hexdigest()
            except OSError as error:
                raise CampaignError(f"{name}: cannot be read: {error.strerror or error}") from error
    return hashes


def list_algorithms(definition: CampaignDefinition) -> tuple[str, ...]:
    """List the algorithms in a definition or its dispersions: under test, then compared."""
    selected_scenario = find_scenario(definition.scenario)
    if not isinstance(selected_scenario, HasAlgorithms):
        return ()
    tested_key, compared_key = (
        ".".join((*selected_scenario.algorithm_table, name)) for name in ("algorithm", "compared")
    )
    specs = [find_value(definition.parameters, tested_key), *find_value(definition.parameters, compared_key)]
    if tested_key in definition.dispersions:
        specs += definition.dispersions[tested_key].extremes()
    return tuple(dict.fromkeys(str(spec) for spec in specs if spec))


def own_limits(definition: CampaignDefinition) -> tuple[float, float]:
    """Return the time (s) and memory (bytes) that the algorithms in processes of their own may use for one case."""
    selected_scenario = find_scenario(definition.scenario)
    if not isinstance(selected_scenario, HasAlgorithms):
        return 0.0, 0.0
    found = find_value(definition.parameters, ".".join((*selected_scenario.algorithm_table, "executable")))
    limits = ExecutableLimits.model_validate(found if isinstance(found, Mapping) else {})
    shipped = selected_scenario.task.shipped
    custom = [spec for spec in list_algorithms(definition) if spec not in shipped and not is_offline(spec)]
    count = len([spec for spec in custom if limits.isolated or spec.startswith(tuple(PREFIXES))])
    return count * (limits.loading_s + limits.total_s), count * limits.memory_gb * 1e9


def list_parts(definition: CampaignDefinition) -> tuple[str, ...]:
    """List the import paths (``module:name``) of the custom parts in a definition or its dispersions."""
    selected_scenario = find_scenario(definition.scenario)
    if not isinstance(selected_scenario, HasParts):
        return ()
    parameter_trees = [definition.parameters]
    for path, dispersion in definition.dispersions.items():
        if any(f"{key}.".startswith(f"{path}.") for key in selected_scenario.part_keys):
            for tree in dispersion.extremes():
                for name in reversed(path.split(".")):
                    tree = {name: tree}
                parameter_trees.append(tree)
    paths: dict[str, None] = {}
    for tree in parameter_trees:
        for key, kind in selected_scenario.part_keys.items():
            value = find_value(tree, key)
            specs = [value] if isinstance(value, str) else [str(item) for item in value or ()]
            paths.update(dict.fromkeys(map(kind.path, specs)))
    return tuple(paths)


def find_scenario(name: object) -> Scenario | None:
    """Return the scenario with a name; None if the name is invalid or unknown."""
    try:
        return scenario(name) if isinstance(name, str) and name else None
    except UnknownScenarioError:
        return None


def definition_hash(definition: CampaignDefinition) -> str:
    """Compute the hash of the definition keys that determine the cases."""
    return stored_definition_hash(definition.model_dump(mode="json"))


def stored_definition_hash(values: Mapping[str, Any]) -> str:
    """Compute `definition_hash` of a definition in a record, also of one that another version wrote."""
    with_effect = {name: value for name, value in values.items() if name not in _KEYS_WITHOUT_EFFECT}
    return hashlib.sha256(json.dumps(with_effect, sort_keys=True).encode()).hexdigest()


@cache
def hash_code(components: tuple[str, ...]) -> str:
    """Compute the hash of the sources that determine rows; `components`: names of scenario, algorithms and parts."""
    sources: list[tuple[str, Path]] = []
    for folder in _CODE_FOLDERS:
        for pattern in ("*.py", "*.json", "shaders/*"):
            sources += relative_to(_PACKAGE_FOLDER, sorted((_PACKAGE_FOLDER / folder).rglob(pattern)))
    return hash_sources((*sources, *(source for name in components for source in custom_sources(name))))


def hash_sources(sources: Iterable[tuple[str, Path]]) -> str:
    """Compute the SHA-256 of the names and contents of source files."""
    digest = hashlib.sha256()
    for name, path in sources:
        contents = path.read_bytes()
        digest.update(f"{name}\0{len(contents)}\0".encode())
        digest.update(contents)
    return digest.hexdigest()


def custom_sources(spec: str) -> Iterator[tuple[str, Path]]:
    """Yield the source files of a custom scenario, algorithm or part: package or module, program, or answer table."""
    table = answers_file(spec)
    try:
        command = None if table is not None else parse_command(spec)
    except ValueError:
        return
    if table is not None:
        yield table.name, table
    elif command is None:
        yield from algorithm_sources(spec)
    else:
        paths = [Path(word) for word in (shutil.which(command.words[0]), *command.words[1:]) if word is not None]
        yield from ((path.name, path) for path in paths if path.is_file())


def read_versions() -> dict[str, str]:
    """Return the versions of Python, of Marsyard and of the packages that Marsyard requires."""
    try:
        requirements = metadata.requires("marsyard") or []
    except metadata.PackageNotFoundError:
        requirements = []
    names = {re.split(r"[^A-Za-z0-9._-]", text)[0] for text in requirements if "extra ==" not in text}
    versions = {name: _distribution_version(name) or "not installed" for name in sorted({"marsyard", *names})}
    return {"python": platform.python_version(), **versions}


def _distribution_version(name: str) -> str | None:
    """Return the version of an installed distribution; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def describe_algorithms(campaign: Campaign) -> list[dict[str, Any]]:
    """Describe the algorithms of a campaign, the one under test first; empty if the scenario has none.

    Keys of each entry: `spec` (name in the campaign), `role` (`tested` or `compared`), `path` (class as
    ``module:name``, or the file of the program or table), `version` (of the installed distribution, or the class's
    `version` attribute; None if there is neither), `options` and `source_hash` (SHA-256, 16 digits; None without a
    readable source).
    """
    selected_scenario = campaign.scenario
    if not isinstance(selected_scenario, HasAlgorithms):
        return []
    compared = find_value(campaign.definition.parameters, ".".join((*selected_scenario.algorithm_table, "compared")))
    parameters: Any = campaign.base_parameters()
    for name in selected_scenario.algorithm_table:
        parameters = getattr(parameters, name)
    entries = []
    for spec in list_algorithms(campaign.definition):
        # shipped algorithms are installed with Marsyard; their sources are all of `marsyard.algorithms`
        is_shipped = spec in selected_scenario.task.shipped
        sources = list(source_files("marsyard.algorithms:") if is_shipped else custom_sources(spec))
        if is_shipped:
            configured_options = (value for _, value in parameters if isinstance(value, selected_scenario.task.options))
            algorithm = selected_scenario.task.shipped[spec](next(configured_options, selected_scenario.task.options()))
            algorithm_class, version = type(algorithm), _distribution_version("marsyard")
            path = f"{algorithm_class.__module__}:{algorithm_class.__qualname__}"
            options = plain_options(getattr(algorithm, "options", None))
        else:
            path, version, options = _describe_custom(spec)
        entries.append(
            {
                "spec": spec,
                "role": "compared" if spec in compared else "tested",
                "path": path,
                "version": version,
                "options": options,
                "source_hash": hash_sources(sources)[:16] if sources else None,
            }
        )
    return entries


def _describe_custom(spec: str) -> tuple[str, str | None, dict[str, Any]]:
    """Return class or file, version and options of a custom algorithm."""
    command = parse_command(spec)
    if command is not None or is_offline(spec):
        return (spec.partition(":")[2] if command is None else command.words[0]), None, {}
    path, description = custom_path(spec), describe_custom(spec)
    package = path.partition(":")[0].partition(".")[0]
    versions = map(_distribution_version, metadata.packages_distributions().get(package, []))
    version = next((text for text in versions if text is not None), None) or description.version
    return path, version, dict(description.options)
