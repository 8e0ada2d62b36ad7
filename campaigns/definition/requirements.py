"""Files of requirements: campaigns name requirements by id, and stored rows can be evaluated by them again."""

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

#: Keys that a campaign may change in a requirement that it names.
_CHANGEABLE = ("statement", "population", "probability", "confidence", "decide_by", "accept_rate")


class StatedRequirement(Requirement):
    """A requirement in a file of requirements, with name patterns of the campaigns that verify it."""

    campaigns: Annotated[tuple[str, ...], Field(strict=False)] = ()

    def plain(self) -> dict[str, Any]:
        """As stated in a campaign."""
        return self.model_dump(mode="json", exclude={"campaigns"})


class _File(Parameters):
    requirements: Annotated[tuple[StatedRequirement, ...], Field(strict=False)]


def read_requirements(path: Path) -> tuple[StatedRequirement, ...]:
    """Read the requirements of a file.

    Raises ConfigurationError where it cannot be read, or is not valid; every problem with its key.
    """
    stated = read_table(path, _File).requirements
    ids = [one.id for one in stated]
    repeated = sorted({name for name in ids if ids.count(name) > 1})
    if repeated:
        raise ConfigurationError([Problem(str(path), "requirements", f"share an id: {', '.join(repeated)}")])
    return stated


@cache
def shipped_requirements() -> Mapping[str, StatedRequirement]:
    """Requirements of all systems, by id; of equal ids the first that is read."""
    return _read_shipped()[0]


@cache
def _read_shipped() -> tuple[Mapping[str, StatedRequirement], tuple[str, ...]]:
    """Requirements of the systems' files, and the problems of unusable files."""
    by_id: dict[str, StatedRequirement] = {}
    problems: list[str] = []
    for path in dict.fromkeys(system.requirements for system in systems() if system.requirements):
        try:
            by_id = {one.id: one for one in read_requirements(path)} | by_id
        except ConfigurationError as error:
            problems.append(str(error))
    return by_id, tuple(problems)


def select_applicable(stated: Sequence[StatedRequirement], campaign: str) -> list[dict[str, Any]]:
    """Requirements that a campaign of that name verifies, as campaigns state them."""
    return [one.plain() for one in stated if any(fnmatchcase(campaign, pattern) for pattern in one.campaigns)]


def fill_requirements(tables: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[Key, str]]]:
    """Tables of a campaign with its named requirements filled in, and the problems of the names.

    An entry without a metric names a requirement by its `id`, and may change the keys in `_CHANGEABLE`.
    """
    entries = tables.get("requirements")
    if not isinstance(entries, list):
        return dict(tables), []
    problems: list[tuple[Key, str]] = []
    filled = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, Mapping) or "metric" in entry or "id" not in entry:
            filled.append(entry)
            continue
        shipped, unusable = _read_shipped()
        named = shipped.get(str(entry["id"]))
        wrong = [key for key in entry if key not in ("id", *_CHANGEABLE)]
        if named is None:
            message = "; ".join((unknown_name_message("requirement", str(entry["id"]), shipped), *unusable))
            problems.append((("requirements", index, "id"), f"{message}; or state a metric"))
        problems += [(("requirements", index, key), "is stated in requirements.toml already") for key in wrong]
        if named is not None and not wrong:
            filled.append({**named.plain(), **entry})
    return {**tables, "requirements": filled}, problems
