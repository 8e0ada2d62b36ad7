"""Identity of a campaign: hashes and versions of all inputs, except the case number, that determine its rows."""

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

from marsyard.algorithms.exchange import parse_command
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.components import list_algorithms, list_parts
from marsyard.campaigns.definition.parameter_paths import leaves
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.sampling.dispersions import Choice, Fixed, GridDispersion
from marsyard.scenarios.custom_algorithms import algorithm_sources
from marsyard.scenarios.imports import relative_to
from marsyard.scenarios.offline_algorithms import answers_file
from marsyard.scenarios.systems import UnknownScenarioError, scenario, scenario_source
from marsyard.scenarios.user_files import input_files

#: Folders of the packages whose code determines rows; reports and commands do not affect rows.
_CODE_FOLDERS = ("sim", "algorithms", "scenarios", "campaigns")
#: Keys of a definition that do not affect the row of a finished case.
_KEYS_WITHOUT_EFFECT = frozenset(
    {"appended", "calibration", "description", "limits", "max_cases", "requirements", "retain"}
)
#: Number of digits of a hash in the description of a difference.
_DIGITS = 12
#: Folder of the program, with `_CODE_FOLDERS`.
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
        pairs = {
            name: (getattr(self, name)[:_DIGITS], getattr(other, name)[:_DIGITS]) for name in ("definition", "code")
        }
        for name in sorted({*self.versions, *other.versions}):
            pairs[name] = (str(self.versions.get(name)), str(other.versions.get(name)))
        common_names = sorted({*self.inputs} & {*other.inputs})
        pairs.update({name: (self.inputs[name][:_DIGITS], other.inputs[name][:_DIGITS]) for name in common_names})
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
    versions = {name: distribution_version(name) or "not installed" for name in sorted({"marsyard", *names})}
    return {"python": platform.python_version(), **versions}


def distribution_version(name: str) -> str | None:
    """Return the version of an installed distribution; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
