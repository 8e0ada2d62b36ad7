"""Which cases keep their products, and how much of the disk these may take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marsyard.campaigns.definition.configuration import CampaignConfiguration, Requirement
from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.campaigns.store.products import PackedProducts, save_packed

#: Products of one case each lie in a folder of its number in here.
CASES_FOLDER = "cases"


def case_directory(directory: Path, case: int) -> Path:
    """Where a campaign keeps the products of a case."""
    return directory / CASES_FOLDER / str(case)


@dataclass(frozen=True)
class Keep:
    """Which rows' products a worker sends back.

    Attributes
    ----------
    every
        The step between numbers of cases that are kept; 0 for none by their number.
    failed
        Requirements of which a case that fails any is kept.
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
    """What a campaign keeps as its cases end; the worst are known, and run again, when all have."""
    retain = configuration.retain
    if retain.products == "all":
        return KEEP_ALL
    if retain.products == "every":
        return Keep(every=retain.every)
    return Keep(failed=configuration.requirements) if retain.products == "failed" else KEEP_NONE


def fails(row: Mapping[str, Any], requirement: Requirement) -> bool:
    """Whether a row counts against a requirement; an unfinished case does so in every population that it may be in."""
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
    """Whether a row is a member of a population, as in `Requirement.population`; None where the row does not say."""
    known = {"all": True, "completed": row["outcome"] not in UNFINISHED, "valid": row["answered"]}
    parts = [known[part] if part in known else row.get(part) for part in population.split(" and ")]
    if any(part is False for part in parts):
        return False
    return None if None in parts else True


class ProductStore:
    """The products that a campaign keeps, within its budget of the disk."""

    def __init__(self, directory: Path, budget_gb: float) -> None:
        self._directory = directory
        self._left = budget_gb * 1e9 - _size(directory / CASES_FOLDER)
        self.full = False

    def save(self, case: int, packed: PackedProducts, row: Mapping[str, Any]) -> bool:
        """Keeps a case's products, unless they go beyond the budget; from then on none are kept.

        Raises
        ------
        StoreError
            Where they cannot be written.
        """
        self.full = self.full or packed.size > self._left
        if self.full:
            return False
        self._left -= packed.size
        save_packed(case_directory(self._directory, case), packed, row)
        return True


def _size(folder: Path) -> int:
    """Bytes of the files in a folder; 0 where there is none."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else 0
