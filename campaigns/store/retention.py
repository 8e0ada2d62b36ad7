"""Retention of products: cases that keep them, and their disk space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.configuration import CampaignConfiguration, Requirement
from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.campaigns.store.products import PackedProducts, save_packed

#: Folder of the kept products, with a folder for each case.
CASES_FOLDER = "cases"


def case_directory(directory: Path, case: int) -> Path:
    """Folder of a case's products."""
    return directory / CASES_FOLDER / str(case)


@dataclass(frozen=True)
class Keep:
    """Selection of rows whose products a worker returns.

    every: step between numbers of kept cases; 0 for none by their number.
    failed: requirements; a case that fails any of them is kept.
    """

    every: int = 0
    failed: tuple[Requirement, ...] = ()

    def wants(self, row: Mapping[str, Any]) -> bool:
        """Whether the products of the case with this row are kept."""
        if self.every and row["case"] % self.every == 0:
            return True
        return any(fails(row, requirement) for requirement in self.failed)


KEEP_NONE = Keep()
KEEP_ALL = Keep(every=1)


def keep_while_running(configuration: CampaignConfiguration) -> Keep:
    """Selection while a campaign runs; the worst cases are run again at its end."""
    retain = configuration.retain
    if retain.products == "all":
        return KEEP_ALL
    if retain.products == "every":
        return Keep(every=retain.every)
    return Keep(failed=configuration.requirements) if retain.products == "failed" else KEEP_NONE


def fails(row: Mapping[str, Any], requirement: Requirement) -> bool:
    """Whether a row fails a requirement; an unfinished case does in every population that may contain it."""
    belongs = _belongs(row, requirement.population)
    if belongs is not True or row["outcome"] in UNFINISHED:
        return belongs is not False
    values: list[Any] = [row.get(name) for name in requirement.metric_columns]
    if requirement.bound is None:
        return values != [True]
    if not all(isinstance(value, int | float) for value in values):
        return True
    return not abs(requirement.scale * sum(values)) <= requirement.bound


def _belongs(row: Mapping[str, Any], population: str) -> bool | None:
    """Whether a row is in a population, as in `Requirement.population`; None where the row does not state it."""
    known = {"all": True, "completed": row["outcome"] not in UNFINISHED, "valid": row["answered"]}
    parts = [known[part] if part in known else row.get(part) for part in population.split(" and ")]
    if any(part is False for part in parts):
        return False
    return None if None in parts else True


class ProductStore:
    """Kept products of a campaign, within its disk budget."""

    def __init__(self, directory: Path, budget_gb: float) -> None:
        self._directory = directory
        self._left = budget_gb * 1e9 - _size(directory / CASES_FOLDER)
        self.full = False

    def save(self, case: int, packed: PackedProducts, row: Mapping[str, Any]) -> bool:
        """Save a case's products, unless they exceed the budget; from then on none are saved.

        Raises StoreError where they cannot be written.
        """
        self.full = self.full or packed.size > self._left
        if self.full:
            return False
        self._left -= packed.size
        save_packed(case_directory(self._directory, case), packed, row)
        return True


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else 0
