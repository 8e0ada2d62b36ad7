"""Requirement files: campaigns refer to requirements by id, and stored rows can be evaluated against them again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from marsyard.campaigns.definition.configuration import Key, Requirement, read_table
from marsyard.campaigns.errors import ConfigurationError, Problem, unknown_name_message
from marsyard.scenarios.systems import systems
from marsyard.sim.parameters import Parameters

#: Keys of a requirement that a campaign may override.
_CHANGEABLE = ("statement", "population", "probability", "confidence", "decide_by", "accept_rate")


class SharedRequirement(Requirement):
    """A requirement of a requirements file, with name patterns of the campaigns that verify it."""

    campaigns: Annotated[tuple[str, ...], Field(strict=False)] = ()

    def to_table(self) -> dict[str, Any]:
        """Return the requirement as an entry of a campaign file."""
        return self.model_dump(mode="json", exclude={"campaigns"})


class _File(Parameters):
    requirements: Annotated[tuple[SharedRequirement, ...], Field(strict=False)]


def read_requirements(path: Path) -> tuple[SharedRequirement, ...]:
    """Read the requirements of a file.

    Raises ConfigurationError if it is unreadable or invalid; every problem has its key.
    """
    requirements = read_table(path, _File).requirements
    ids = [requirement.id for requirement in requirements]
    repeated = sorted({name for name in ids if ids.count(name) > 1})
    if repeated:
        raise ConfigurationError([Problem(str(path), "requirements", f"share an id: {', '.join(repeated)}")])
    return requirements


@cache
def shipped_requirements() -> Mapping[str, SharedRequirement]:
    """Requirements of all systems by id; the first wins where an id repeats."""
    return _read_shipped()[0]


@cache
def _read_shipped() -> tuple[Mapping[str, SharedRequirement], tuple[str, ...]]:
    """Requirements of the systems' files, and the problems of unreadable files."""
    by_id: dict[str, SharedRequirement] = {}
    problems: list[str] = []
    for path in dict.fromkeys(system.requirements for system in systems() if system.requirements):
        try:
            by_id = {requirement.id: requirement for requirement in read_requirements(path)} | by_id
        except ConfigurationError as error:
            problems.append(str(error))
    return by_id, tuple(problems)


def select_applicable(requirements: Sequence[SharedRequirement], campaign: str) -> list[dict[str, Any]]:
    """Requirements verified by a campaign of this name, as entries of a campaign file."""
    return [item.to_table() for item in requirements if any(fnmatchcase(campaign, name) for name in item.campaigns)]


def fill_requirements(tables: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[Key, str]]]:
    """Tables of a campaign with its requirements filled in by id, and the problems of the ids.

    An entry without a metric refers to a requirement by its `id`, and may override the keys in `_CHANGEABLE`.
    """
    entries = tables.get("requirements")
    if not isinstance(entries, list):
        return dict(tables), []
    problems: list[tuple[Key, str]] = []
    entries_filled = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, Mapping) or "metric" in entry or "id" not in entry:
            entries_filled.append(entry)
            continue
        shipped, unusable = _read_shipped()
        requirement = shipped.get(str(entry["id"]))
        fixed_keys = [key for key in entry if key not in ("id", *_CHANGEABLE)]
        if requirement is None:
            message = "; ".join((unknown_name_message("requirement", str(entry["id"]), shipped), *unusable))
            problems.append((("requirements", index, "id"), f"{message}; or give a metric"))
        problems += [(("requirements", index, key), "is already defined in requirements.toml") for key in fixed_keys]
        if requirement is not None and not fixed_keys:
            entries_filled.append({**requirement.to_table(), **entry})
    return {**tables, "requirements": entries_filled}, problems
