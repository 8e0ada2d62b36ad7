"""Domain of validity of a campaign: cases outside of the conditions in which the simulation was checked.

The rows of the validation page that concern the system, have a limit and meet it define the checked conditions: the
union of their sites and cameras, and the smallest range that contains the ranges of each other quantity. Verification
(independent calculations) and comparison (flight and test data, also those of fits) are separate domains. A row that
misses its limit defines no condition, and is listed instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.stored import StoredRun
from marsyard.reports.validation_rows import (
    QUANTITIES,
    RowKind,
    ValidationRow,
    format_range,
    merge_ranges,
    rows_of_system,
)
from marsyard.reports.wording import NOTHING, count, note_text, percent
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.systems import System, find_system


class DomainSource(NamedTuple):
    """Kinds of rows that define a domain, and the source of their numbers in words."""

    kinds: tuple[RowKind, ...]
    description: str


DOMAINS: Mapping[str, DomainSource] = {
    "verification": DomainSource((RowKind.VERIFICATION,), "with independent calculations"),
    "comparison": DomainSource((RowKind.VALIDATION, RowKind.FIT), "with flight or test data"),
}
#: Difference of a value from a limit that is a rounding error, relative to the limit.
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Coverage:
    """A quantity of the cases, and the names, or the smallest and the largest value, that were checked.

    - cases: names, or smallest and largest value of the cases
    - checked: None if no row of the domain checks the quantity; all cases are then outside
    - outside: number of cases with a value outside
    """

    quantity: str
    cases: tuple[Any, ...]
    checked: tuple[Any, ...] | None
    outside: int


@dataclass(frozen=True)
class Domain:
    """Checked conditions of one kind, by quantity, and the number of cases with any quantity outside of them."""

    kind: str
    outside: int
    coverage: tuple[Coverage, ...]


@dataclass(frozen=True)
class MissedCheck:
    """A row of the validation page that concerns the system and misses its limit."""

    text: str
    kind: RowKind
    conditions: str


@dataclass(frozen=True)
class Validity:
    """Domains of a campaign with this number of cases, and missed checks; empty for the system of another package."""

    cases: int = 0
    domains: tuple[Domain, ...] = ()
    missed: tuple[MissedCheck, ...] = ()

    @property
    def sentences(self) -> list[str]:
        """What limits the verdict, in sentences: cases outside of each domain, and each missed check."""
        texts = [self._describe(domain) for domain in self.domains if domain.outside]
        return [*texts, *(f"Missed check ({item.kind}): {item.text}." for item in self.missed)]

    def _describe(self, domain: Domain) -> str:
        """Describe the cases outside of a domain, and for how many of them each quantity is the reason."""
        description = DOMAINS[domain.kind].description
        if all(item.checked is None for item in domain.coverage):
            return f"No check compares the simulation of this system {description}."
        parts = []
        for item in domain.coverage:
            if item.outside:
                checked = "in no check" if item.checked is None else f"checked: {format_range(item.checked)}"
                parts.append(f"{QUANTITIES[item.quantity]} {percent(item.outside / self.cases)} ({checked})")
        cases = f"{domain.outside:,} of {count(self.cases, 'case')} ({percent(domain.outside / self.cases)})"
        verb = "is" if domain.outside == 1 else "are"
        place = f"outside of the conditions in which the simulation was compared {description}"
        return f"{cases} {verb} {place}: {', '.join(parts)}."


def assess_validity(run: StoredRun) -> Validity:
    """Compare the conditions of a campaign's cases with those of the checks that concern its system."""
    system = find_system(str(run.recorded("scenario") or ""))
    if system is None or not system.conditions:
        return Validity()
    frame, rows = run.frame, rows_of_system(system.name)
    values = {name: list(_read_values(run, system, items)) for name, items in system.conditions.items()}
    domains = tuple(
        _compare(kind, values, [row for row in rows if row.kind in source.kinds and row.is_met], len(frame))
        for kind, source in DOMAINS.items()
    )
    missed = (row for row in rows if row.is_met is False)
    return Validity(len(frame), domains, tuple(MissedCheck(row.text, row.kind, row.conditions.text) for row in missed))


def _compare(kind: str, values: Mapping[str, list[pd.Series]], rows: Sequence[ValidationRow], cases: int) -> Domain:
    """Compare the values of all quantities with the conditions of rows."""
    is_outside, coverage = np.zeros(cases, dtype=np.bool_), []
    for name, columns in values.items():
        known = pd.concat(columns).dropna() if columns else pd.Series(dtype=object)
        if known.empty:
            continue
        checked = merge_ranges([row.conditions.quantities[name] for row in rows if name in row.conditions.quantities])
        outside = np.logical_or.reduce([_mask_outside(column, checked) for column in columns])
        is_outside |= outside
        coverage.append(Coverage(name, _summarize(known), checked, int(outside.sum())))
    return Domain(kind, int(is_outside.sum()), tuple(coverage))


def _mask_outside(values: pd.Series, checked: tuple[Any, ...] | None) -> Bool[np.ndarray, " n"]:
    """Create the mask of the values that are known and outside of names or a range."""
    if checked is None:
        outside = pd.Series(data=True, index=values.index)
    elif isinstance(checked[0], str):
        outside = ~values.astype(str).isin(checked)
    else:
        numbers = pd.to_numeric(values, errors="coerce")
        low, high = (limit + sign * _TOLERANCE * abs(limit) for limit, sign in zip(checked, (-1.0, 1.0), strict=True))
        outside = (numbers < low) | (numbers > high)
    return np.asarray(outside & values.notna(), dtype=np.bool_)


def _summarize(values: pd.Series) -> tuple[Any, ...]:
    """Return the names, or the smallest and the largest number."""
    numbers = pd.to_numeric(values, errors="coerce")
    return (
        tuple(sorted(set(values.astype(str)))) if numbers.isna().any() else (float(numbers.min()), float(numbers.max()))
    )


def _read_values(run: StoredRun, system: System, items: Sequence[str]) -> Iterator[pd.Series]:
    """Yield the values of a quantity, one series with a value per case for each column or parameter.

    items: `System.conditions`: the first known one of the sources of an item, which are separated by `|`, is used; a
    source is a pattern of columns, or as in `_read_constant`
    """
    for item in items:
        for source in item.split("|"):
            columns = [name for name in run.frame.columns if fnmatchcase(str(name), source)]
            found = [run.frame[name] for name in columns] or _read_constant(run, system, source)
            if found:
                yield from found
                break


def _read_constant(run: StoredRun, system: System, source: str) -> list[pd.Series]:
    """Read a value that is not a column; empty if there is none.

    source: a literal (`=VALUE`), a property of the site's preset (`site.NAME`), or the path of a parameter
    """
    if source.startswith("="):
        return [pd.Series(source[1:], index=run.frame.index)]
    if source.startswith("site."):
        presets = {name: _read_preset(system, name, source.split(".")[1:]) for name in _site_names(run)}
        sites = (
            run.frame["site"] if "site" in run.frame else pd.Series(next(iter(presets), None), index=run.frame.index)
        )
        values = sites.map(presets)
        return [] if values.isna().all() else [values]
    value = run.parameter(*source.split("."))
    return [pd.Series(value, index=run.frame.index)] if isinstance(value, str | int | float) else []


def _site_names(run: StoredRun) -> list[str]:
    """List the names of the sites of the cases."""
    if "site" in run.frame:
        return [str(name) for name in run.frame["site"].dropna().unique()]
    return [name for name in (run.parameter("site"),) if isinstance(name, str)]


def _read_preset(system: System, site: str, path: Sequence[str]) -> Any:
    """Read a property of the preset of a site; None if there is none."""
    try:
        value = import_object(system.find_site)(site)
    except ValueError:
        return None
    for name in path:
        value = getattr(value, name, None)
    return value


def validity_section(subject: Subject) -> Section | None:
    """Create the section with the domain of validity; None for the system of another package."""
    validity = assess_validity(subject.run)
    if not validity.domains:
        return None
    rows = [
        [
            f"{QUANTITIES[item.quantity]}, compared {DOMAINS[domain.kind].description}",
            format_range(item.cases),
            NOTHING if item.checked is None else format_range(item.checked),
            f"{item.outside:,} ({percent(item.outside / validity.cases)})",
        ]
        for domain in validity.domains
        for item in domain.coverage
    ]
    grid = Grid(["Quantity", "Cases", "Checked", "Cases outside"], rows)
    missed = Grid(
        ["Missed check", "Kind", "Conditions"], [[item.text, item.kind, item.conditions] for item in validity.missed]
    )
    blocks = [Block(grid=grid, note=note_text("common.validity"))]
    blocks += [Block(heading="Checks that miss their limit", grid=missed)] if validity.missed else []
    return Section("validity", "Validity", "Conditions in which the simulation was checked", blocks)
