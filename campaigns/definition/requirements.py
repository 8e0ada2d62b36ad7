"""Requirements as data: one file states them, campaigns name them, and stored rows can be judged by them anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from marsyard.campaigns.definition.configuration import Key, Requirement, read_table
from marsyard.campaigns.errors import ConfigurationError, Problem, not_allowed
from marsyard.campaigns.sampling.stated import StatedTable
from marsyard.scenarios.systems import systems

#: What a campaign that names a stated requirement may say of it anew.
RESTATED = ("statement", "population", "probability", "confidence", "decide_by", "accept_rate")


class StatedRequirement(Requirement):
    """A requirement in a file of requirements, with the campaigns that show it: patterns of their names."""

    campaigns: Annotated[tuple[str, ...], Field(strict=False)] = ()

    def applies_to(self, campaign: str) -> bool:
        """Whether a campaign of that name shows it."""
        return any(fnmatchcase(campaign, pattern) for pattern in self.campaigns)

    def plain(self) -> dict[str, Any]:
        """As a campaign states it."""
        return self.model_dump(mode="json", exclude={"campaigns"})


class _File(StatedTable):
    requirements: Annotated[tuple[StatedRequirement, ...], Field(strict=False)]


def read_requirements(path: Path) -> tuple[StatedRequirement, ...]:
    """The requirements that a file states.

    Raises
    ------
    ConfigurationError
        Where it cannot be read, or states something that is none; every problem with its key.
    """
    stated = read_table(path, _File)
    ids = [one.id for one in stated.requirements]
    repeated = sorted({name for name in ids if ids.count(name) > 1})
    if repeated:
        raise ConfigurationError([Problem(str(path), "requirements", f"share an id: {', '.join(repeated)}")])
    return stated.requirements


@cache
def shipped_requirements() -> Mapping[str, StatedRequirement]:
    """The requirements of all systems, by id; where two systems share an id, the one that is read first."""
    return _stated()[0]


@cache
def _stated() -> tuple[Mapping[str, StatedRequirement], tuple[str, ...]]:
    """The requirements of the systems' files, and what is wrong with files that cannot be used."""
    found: dict[str, StatedRequirement] = {}
    problems: list[str] = []
    for path in dict.fromkeys(system.requirements for system in systems() if system.requirements):
        try:
            found = {one.id: one for one in read_requirements(path)} | found
        except ConfigurationError as error:
            problems.append(str(error))
    return found, tuple(problems)


def applicable(stated: Sequence[StatedRequirement], campaign: str) -> list[dict[str, Any]]:
    """Those of the requirements that a campaign of that name shows, as campaigns state them."""
    return [one.plain() for one in stated if one.applies_to(campaign)]


def completed(tables: Mapping[str, Any]) -> tuple[dict[str, Any], list[tuple[Key, str]]]:
    """A campaign's tables with the requirements that it names filled in, and what is wrong with how it names them.

    An entry without a metric names a stated requirement by its `id`, and may restate what `RESTATED` lists.
    """
    entries = tables.get("requirements")
    if not isinstance(entries, list):
        return dict(tables), []
    problems: list[tuple[Key, str]] = []
    filled = []
    for place, entry in enumerate(entries):
        if not isinstance(entry, Mapping) or "metric" in entry or "id" not in entry:
            filled.append(entry)
            continue
        named = shipped_requirements().get(str(entry["id"]))
        wrong = [key for key in entry if key not in ("id", *RESTATED)]
        if named is None:
            message = "; ".join((not_allowed("requirement", str(entry["id"]), shipped_requirements()), *_stated()[1]))
            problems.append((("requirements", place, "id"), f"{message}; or state a metric"))
        problems += [(("requirements", place, key), "is stated in requirements.toml already") for key in wrong]
        if named is not None and not wrong:
            filled.append({**named.plain(), **entry})
    return {**tables, "requirements": filled}, problems
