"""Claims (the content of a campaign and its algorithms, without their names), and confirmations of a claim.

A claim is "this algorithm meets these requirements in these cases". Its identity is a hash of the parameters,
dispersions and sampling design, the requirements, the options and sources of the algorithms, the code of the simulation
and the input files. Names of the campaign, of a requirement, or of the module of an algorithm are no part of it.
Confirmations of one claim are evaluated together (`marsyard.reports.joint`). Their seeds are derived from the claim, so
that a user cannot choose them.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from marsyard.algorithms.exchange import parse_command
from marsyard.campaigns.definition.algorithm_descriptions import describe_algorithms
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition
from marsyard.campaigns.definition.components import list_parts
from marsyard.campaigns.definition.identity import custom_sources, hash_code, hash_inputs
from marsyard.campaigns.definition.parameter_paths import find_value, leaves, paths_overlap, replace_values
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.interface import HasAlgorithms
from marsyard.scenarios.systems import scenario_source

#: Name, in the record of confirmations, of the hash of a campaign's definition.
DEFINITION = "configuration"
#: Keys that the hash of the definition of a frozen algorithm does not contain: names and texts, the seed, the number of
#: cases, limits of the run, and the requirements, which have their own hash.
_KEYS_NOT_HASHED = frozenset(
    {"appended", "calibration", "cases", "description", "limits", "max_cases", "name", "requirements", "retain", "seed"}
)
#: Texts of a dispersion or of a group of correlated dispersions, which describe it and do not change its draws.
_TEXTS = frozenset({"description", "source", "unit"})
#: Keys of a requirement that determine its verdict.
_REQUIREMENT_KEYS = ("metric", "bound", "probability", "confidence", "population", "decide_by", "accept_rate", "scale")
#: Name of the parameters that seed the terrains of a bank; a confirmation derives them.
_BANK_SEED = "bank_seed"


@dataclass(frozen=True)
class FrozenAlgorithm:
    """All choices that a confirmation freezes.

    - algorithm: name of the algorithm under test
    - options: options of all algorithms of the campaign, under the algorithm's name, and values under `parameters`
    - hashes: SHA-256 of `sources` (of the algorithms, with their options), `DEFINITION` (parameters, dispersions
      without their texts, sampling design, input files), `requirements`, and `code` (of the simulation)
    """

    algorithm: str
    options: Mapping[str, Any]
    hashes: Mapping[str, str]

    @classmethod
    def read(cls, stored: Mapping[str, Any]) -> Self:
        """Read from the record of confirmations."""
        return cls(str(stored["algorithm"]), dict(stored["options"]), dict(stored["hashes"]))

    @property
    def claim(self) -> str:
        """Identity of the claim: SHA-256 of the hashes."""
        return hash_json(dict(self.hashes))

    def differences(self, other: FrozenAlgorithm) -> list[str]:
        """Describe the differences from another frozen algorithm, each in a few words; empty for the same claim."""
        if self.claim == other.claim:
            return []
        texts = []
        if self.algorithm != other.algorithm:
            texts.append(f"algorithm ({self.algorithm}, now {other.algorithm})")
        for name in sorted({*self.options, *other.options}):
            old, new = self.options.get(name), other.options.get(name)
            if old != new:
                texts.append(f"{name} ({json.dumps(old)}, now {json.dumps(new)})")
        names = sorted({*self.hashes, *other.hashes})
        changed_hashes = [name for name in names if self.hashes.get(name) != other.hashes.get(name)]
        if texts and DEFINITION in changed_hashes:
            changed_hashes.remove(DEFINITION)  # it includes the named parameters
        return [*texts, *changed_hashes]


@dataclass(frozen=True)
class Confirmation:
    """A confirmation in the record of confirmations.

    - campaign, folder: name of its campaign, and of the folder of the run
    - frozen, claim: its content, and the identity of this content (`FrozenAlgorithm.claim`)
    - started_utc, git_commit: time and commit of its start
    - number: number of the confirmation of its claim, from 1
    - seed, bank_seeds: seed of the draws, and seeds of the terrain banks by parameter path
    - cases: number of cases that it has announced, with appended ones
    - first_cases: number of cases of its first look
    - max_cases: maximum number of cases of a run with `--until-decided`; otherwise None
    - overlap: see `Evidence`
    - scenario: scenario of its campaign; empty if it was not recorded
    - definition: `hash_stored_definition` of its run; empty if it was not recorded
    - is_included: whether the campaign is one of the catalogue, without a change
    - requirements: name of each requirement, by `requirement_key`
    - results: status of each requirement at the latest look, by name; None before the first look
    - counted_cases, counts: number of cases and evidence of the latest look (`marsyard.reports.joint`)
    - failed: names of the requirements that were FAIL at any look
    - head: SHA-256 of the record up to the latest entry of the confirmation; the next confirmation depends on it
    - is_chained: False for an entry of an earlier version, which is not part of the chain of hashes
    """

    campaign: str
    number: int
    seed: int
    frozen: FrozenAlgorithm
    started_utc: str
    git_commit: str | None = None
    folder: str = ""
    cases: int = 0
    results: Mapping[str, str] | None = None
    claim: str = ""
    bank_seeds: Mapping[str, int] = field(default_factory=dict)
    first_cases: int = 0
    max_cases: int | None = None
    overlap: float | None = None
    scenario: str = ""
    definition: str = ""
    is_included: bool = True
    requirements: Mapping[str, str] = field(default_factory=dict)
    counted_cases: int = 0
    counts: Mapping[str, Any] = field(default_factory=dict)
    failed: tuple[str, ...] = ()
    head: str = ""
    is_chained: bool = True

    @property
    def is_unfinished(self) -> bool:
        """Whether the record announces more cases than it has results of."""
        return self.results is None or (self.is_chained and self.counted_cases < self.cases)

    @property
    def parameter_names(self) -> frozenset[str]:
        """Names of the scenario's parameters and tables of parameters, which identify a scenario without its name."""
        return frozenset(path.split(".")[1] for path in self.frozen.options if path.startswith("parameters."))


def hash_json(content: Any) -> str:
    """Compute the SHA-256 of a content in JSON."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def freeze_algorithm(campaign: Campaign) -> FrozenAlgorithm:
    """Describe all choices that a confirmation of a campaign freezes."""
    definition = campaign.definition
    algorithms = describe_algorithms(campaign)
    algorithm = next((entry["spec"] for entry in algorithms if entry["role"] == "tested"), definition.scenario)
    options = {f"{entry['spec']}.{name}": value for entry in algorithms for name, value in entry["options"].items()}
    values = definition.model_dump(mode="json")
    options |= dict(leaves(values["parameters"], "parameters"))
    frozen_values = _remove_texts(values)
    frozen_values["parameters"] = _remove_names(campaign, values["parameters"])
    contents = {
        "sources": [[entry["role"], _algorithm_content(campaign, entry), entry["options"]] for entry in algorithms],
        DEFINITION: [frozen_values, sorted(hash_inputs(definition).values())],
        "requirements": sorted(map(requirement_key, values["requirements"])),
        "code": hash_code((scenario_source(definition.scenario), *list_parts(definition))),
    }
    return FrozenAlgorithm(algorithm, options, {name: hash_json(content) for name, content in contents.items()})


def hash_stored_definition(values: Mapping[str, Any]) -> str:
    """Compute the hash of the definition in the record of a run, except names, texts, limits and requirements."""
    return hash_json(_remove_texts(values))


def _remove_texts(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of a definition without `_KEYS_NOT_HASHED`, and without the texts of its dispersions."""

    def remove(table: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in table.items() if name not in _TEXTS}

    kept = {name: value for name, value in values.items() if name not in _KEYS_NOT_HASHED}
    dispersions, correlations = kept.get("dispersions") or {}, kept.get("correlations") or ()
    kept["dispersions"] = {path: remove(dispersion) for path, dispersion in dispersions.items()}
    kept["correlations"] = [remove(group) for group in correlations]
    return kept


def _remove_names(campaign: Campaign, parameters: Mapping[str, Any]) -> Any:
    """Remove the names of the algorithms and the seeds of the terrain banks from the parameters."""
    removed = {path: None for path, _ in leaves(parameters) if path.rpartition(".")[2] == _BANK_SEED}
    if isinstance(campaign.scenario, HasAlgorithms):
        paths = (".".join((*campaign.scenario.algorithm_table, name)) for name in ("algorithm", "compared"))
        removed |= {path: None for path in paths if find_value(parameters, path) != ()}
    return replace_values(parameters, removed)


def _algorithm_content(campaign: Campaign, entry: Mapping[str, Any]) -> Any:
    """Describe an algorithm by the contents of its files.

    An included algorithm keeps its name, since it selects one of several in the same sources. For the same reason, the
    content of a Python algorithm includes the name of its class and the hash of the file that defines it.
    """
    spec = str(entry["spec"])
    sources = _hash_contents(path for _, path in custom_sources(spec))
    if isinstance(campaign.scenario, HasAlgorithms) and spec in campaign.scenario.task.shipped:
        return [spec, entry["source_hash"]]
    command = parse_command(spec)
    if command is not None:
        words = [shutil.which(command.words[0]) or command.words[0], *command.words[1:]]
        contents = [_hash_contents([Path(word)]) if Path(word).is_file() else word for word in words]
        return [spec.partition(":")[0], contents]
    path = str(entry["path"])
    if ":" not in path:  # a table of answers
        return sources
    return [path.rpartition(":")[2], _hash_contents(_defining_file(path)), sources]


def _defining_file(path: str) -> list[Path]:
    """Return the source file of the object at ``module:name``; empty if it has none."""
    target = import_object(path)
    try:
        file = inspect.getsourcefile(target if inspect.isclass(target) or callable(target) else type(target))
    except TypeError:
        return []
    return [] if file is None or not Path(file).is_file() else [Path(file)]


def _hash_contents(paths: Iterable[Path]) -> list[str]:
    """Compute the SHA-256 of the contents of files, sorted, without their names."""
    return sorted(hashlib.sha256(path.read_bytes()).hexdigest() for path in paths)


def requirement_key(requirement: Mapping[str, Any]) -> str:
    """Compute the identity of a requirement from all values that determine its verdict: 16 digits of a SHA-256."""
    return hash_json([requirement.get(name) for name in _REQUIREMENT_KEYS])[:16]


def hash_requirements(requirements: Iterable[Mapping[str, Any]]) -> str:
    """Compute the hash of requirements, in any order."""
    return hash_json(sorted(map(requirement_key, requirements)))


def confirmation_seed(claim: str, head: str) -> int:
    """Compute the seed of a confirmation: 48 bits of a SHA-256.

    head: hash of the record up to the latest entry of the claim; empty for the first confirmation of a claim

    >>> confirmation_seed("0f", "") == confirmation_seed("0f", "1b")
    False
    """
    return _derive("seed", claim, head)


def bank_seeds(definition: CampaignDefinition) -> dict[str, int]:
    """Return the seeds of the terrain banks of a campaign by parameter path, except dispersed ones."""
    seeds = {path: value for path, value in leaves(definition.parameters) if path.rpartition(".")[2] == _BANK_SEED}
    dispersions = definition.dispersions
    return {path: seed for path, seed in seeds.items() if not any(paths_overlap(path, name) for name in dispersions)}


def confirmation_bank_seeds(definition: CampaignDefinition, claim: str, head: str) -> dict[str, int]:
    """Compute the seeds of the terrain banks of a confirmation, by parameter path; see `confirmation_seed`."""
    return {path: _derive(path, claim, head) for path in bank_seeds(definition)}


def _derive(purpose: str, claim: str, head: str) -> int:
    """Derive 48 bits from a claim and the head of the record."""
    return int.from_bytes(hashlib.sha256(f"{purpose}\0{claim}\0{head}".encode()).digest()[:6])
