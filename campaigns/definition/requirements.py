"""Requirements files: campaign files refer to their requirements by id; stored campaigns are evaluated against them."""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from marsyard.campaigns.definition.campaign_file import Requirement
from marsyard.campaigns.definition.toml_models import Key, read_model
from marsyard.campaigns.errors import DefinitionError, Problem, unknown_name_message
from marsyard.scenarios.systems import systems
from marsyard.sim.parameters import Parameters

#: Keys of a shared requirement that a campaign file may override.
_CHANGEABLE = ("statement", "population", "probability", "confidence", "decide_by", "accept_rate")


class SharedRequirement(Requirement):
    """A requirement of a requirements file, with name patterns of the campaigns that test it."""

    campaigns: Annotated[tuple[str, ...], Field(strict=False)] = ()

    def to_table(self) -> dict[str, Any]:
        """Return the requirement as an entry of a campaign file."""
        return self.model_dump(mode="json", exclude={"campaigns"})


class _RequirementsFile(Parameters):
    """Contents of a requirements file."""

    requirements: Annotated[tuple[SharedRequirement, ...], Field(strict=False)]


def read_requirements(path: Path) -> tuple[SharedRequirement, ...]:
    """Read the requirements of a file.

    Raises DefinitionError if it is unreadable or invalid; every problem has its key.
    """
    requirements = read_model(path, _RequirementsFile).requirements
    ids = [requirement.id for requirement in requirements]
    repeated_ids = sorted({name for name in ids if ids.count(name) > 1})
    if repeated_ids:
        raise DefinitionError([Problem(str(path), "requirements", f"share an id: {', '.join(repeated_ids)}")])
    return requirements


@cache
def shipped_requirements() -> Mapping[str, SharedRequirement]:
    """Return the requirements of all systems by id; if two systems use the same id, the first requirement is used."""
    return _read_shipped()[0]


@cache
def _read_shipped() -> tuple[Mapping[str, SharedRequirement], tuple[str, ...]]:
    """Read the requirements of all systems; also return the problems of invalid files."""
    by_id: dict[str, SharedRequirement] = {}
    problems: list[str] = []
    for path in dict.fromkeys(system.requirements for system in systems() if system.requirements):
        try:
            by_id = {requirement.id: requirement for requirement in read_requirements(path)} | by_id
        except DefinitionError as error:
            problems.append(str(error))
    return by_id, tuple(problems)


def select_applicable(requirements: Sequence[SharedRequirement], campaign: str) -> list[dict[str, Any]]:
    """List the requirements that a campaign of this name tests, as entries of a campaign file."""
    return [item.to_table() for item in requirements if any(fnmatchcase(campaign, name) for name in item.campaigns)]


def fill_requirements(tables: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[Key, str]]]:
    """Complete the requirements of a campaign's tables by id; also return the problems.

    An entry without a metric refers to a shared requirement by its `id`, and may override the keys in `_CHANGEABLE`.
    """
    entries = tables.get("requirements")
    if not isinstance(entries, list):
        return dict(tables), []
    problems: list[tuple[Key, str]] = []
    complete_entries = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, Mapping) or "metric" in entry or "id" not in entry:
            complete_entries.append(entry)
            continue
        shipped, file_problems = _read_shipped()
        requirement = shipped.get(str(entry["id"]))
        fixed_keys = [key for key in entry if key not in ("id", *_CHANGEABLE)]
        if requirement is None:
            message = "; ".join((unknown_name_message("requirement", str(entry["id"]), shipped), *file_problems))
            problems.append((("requirements", index, "id"), f"{message}; or define a metric"))
        problems += [(("requirements", index, key), "is already defined in requirements.toml") for key in fixed_keys]
        if requirement is not None and not fixed_keys:
            complete_entries.append({**requirement.to_table(), **entry})
    return {**tables, "requirements": complete_entries}, problems
