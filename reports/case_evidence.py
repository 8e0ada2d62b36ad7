"""Results of the cases of a requirement: joined over confirmations, and counted for their record.

A confirmation is evaluated together with the earlier ones of its claim. The record of confirmations contains the number
of cases and failures of each terrain, so that the folders of the earlier runs are not needed.

A look is an evaluation that the campaign planned: after its first cases, and after each further block up to its maximum
number. A claim is an algorithm with its options on a campaign's definition (`marsyard.campaigns.definition.claims`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from marsyard.reports.statistics.clustered_cases import ClusteredCases

Mask = Bool[np.ndarray, " n"]  #: Property of each case.
Groups = Int[np.ndarray, " n"]  #: Index of each case's terrain, from 0.

#: Kinds of cases that the record counts on each terrain: successes (0) and failures (1) of the population and other
#: cases (2) of the first look, then the same kinds of later looks (3 to 5).
_KINDS_PER_LOOK, _KINDS = 3, 6
#: Order of the kinds on a terrain whose cases are restored from their counts. Other cases precede those of the
#: population: the order of the cases is not recorded, so the first case of a terrain belongs to the population only if
#: all of them do.
_ORDER_OF_KINDS = np.array([2, 5, 0, 1, 3, 4])


class _TerrainRow(NamedTuple):
    """A row of the record of confirmations: cases on one terrain, or on each of several terrains with equal counts.

    - counts: number of cases of each kind
    - label: name of the terrain, if other confirmations can use it; otherwise None
    - repeats: number of terrains with these counts; 1 for a terrain with a name
    """

    counts: Sequence[int]
    label: str | None = None
    repeats: int = 1

    def to_list(self) -> list[Any]:
        """Return the counts, then the name of the terrain (a text), or the number of terrains (an integer)."""
        return [*self.counts, self.repeats if self.label is None else self.label]

    @classmethod
    def from_list(cls, values: Sequence[Any]) -> _TerrainRow:
        """Create the row from the values of `to_list`."""
        *counts, last = values
        return cls(counts, label=last) if isinstance(last, str) else cls(counts, repeats=int(last))


@dataclass(frozen=True)
class CaseEvidence:
    """Results of the cases of a campaign with regard to a requirement.

    - success: whether each case meets the requirement; false outside the population
    - member: whether it belongs to the population
    - groups: terrain of each case, numbered from 0; None if unknown
    - in_first_look: mask of the cases of the first look
    - labels: name of each terrain, if other confirmations can use the same terrains; None if each has its own
    - contains_first: whether the first look of the claim was a look at some of these cases
    """

    success: Mask
    member: Mask
    groups: Groups | None
    in_first_look: Mask
    labels: tuple[str, ...] | None = None
    contains_first: bool = False

    @property
    def n(self) -> int:
        """Number of cases of the population."""
        return int(self.member.sum())

    @property
    def failures(self) -> int:
        """Number of failures of the population."""
        return int((self.member & ~self.success).sum())

    @property
    def terrains(self) -> int | None:
        """Number of terrains with a case of the population; None if unknown."""
        return None if self.groups is None else int(np.unique(self.groups[self.member]).size)

    @property
    def clustered(self) -> ClusteredCases | None:
        """The cases with their terrains; None if no two cases are on one terrain."""
        if self.groups is None or int(self.groups.max(initial=-1)) + 1 == self.groups.size:
            return None
        return ClusteredCases(self.success, self.member, self.groups)

    @property
    def terrain_groups(self) -> Groups:
        """Terrain of each case; a case with an unknown terrain has its own."""
        return np.arange(self.success.size) if self.groups is None else self.groups

    def join_own(self, own: CaseEvidence) -> CaseEvidence:
        """Join the cases of earlier confirmations with those of the evaluated one, which are a later look.

        The cases of the evaluated one are restored from their counts, so that each confirmation has the same verdict.
        """
        return self.join(CaseEvidence.from_rows(own.to_rows(), is_first=not self.contains_first))

    def join(self, other: CaseEvidence) -> CaseEvidence:
        """Join with the cases of another confirmation."""
        if not self.success.size or not other.success.size:
            part = self if self.success.size else other
            return replace(part, contains_first=self.contains_first or other.contains_first)
        groups = [self.terrain_groups, other.terrain_groups]
        labels = None
        if self.labels is not None and other.labels is not None:
            labels = tuple(dict.fromkeys((*self.labels, *other.labels)))
            index = {label: number for number, label in enumerate(labels)}
            groups = [
                np.array([index[label] for label in part_labels], dtype=np.int64)[part_groups]
                for part_labels, part_groups in zip((self.labels, other.labels), groups, strict=True)
            ]
        else:
            groups[1] = groups[1] + int(groups[0].max(initial=-1)) + 1
        is_unknown = self.groups is None and other.groups is None
        return CaseEvidence(
            np.concatenate([self.success, other.success]),
            np.concatenate([self.member, other.member]),
            None if is_unknown else np.concatenate(groups),
            np.concatenate([self.in_first_look, other.in_first_look]),
            labels,
            self.contains_first or other.contains_first,
        )

    def to_rows(self) -> list[list[Any]]:
        """Count the cases of each terrain for the record of confirmations.

        A row contains successes, failures and other cases of the first look, those of later looks, and the number of
        terrains with these values, or the name of a terrain that other confirmations can use.
        """
        groups, terrains = self.terrain_groups, int(self.terrain_groups.max(initial=-1)) + 1
        kinds = np.select([self.success, self.member], [0, 1], 2) + np.where(self.in_first_look, 0, _KINDS_PER_LOOK)
        counts = np.bincount(groups * _KINDS + kinds, minlength=terrains * _KINDS).reshape(terrains, _KINDS).tolist()
        if self.labels is not None:
            return [_TerrainRow(row, label).to_list() for row, label in zip(counts, self.labels, strict=True)]
        return [_TerrainRow(row, repeats=n).to_list() for row, n in sorted(Counter(map(tuple, counts)).items())]

    @classmethod
    def from_rows(cls, rows: Sequence[Sequence[Any]], *, is_first: bool) -> CaseEvidence:
        """Create the results from the rows of `to_rows`; `is_first`: whether they are of the first confirmation.

        The cases of a terrain are in the order of `_ORDER_OF_KINDS`.
        """
        terrain_rows = [_TerrainRow.from_list(row) for row in rows]
        names = tuple(row.label for row in terrain_rows if row.label is not None)
        # either all terrains have a name or none
        labels = names or None
        counts_by_terrain = [row.counts for row in terrain_rows for _ in range(row.repeats)]
        counts = np.array(counts_by_terrain, dtype=np.int64).reshape(-1, _KINDS)
        cases = counts[:, _ORDER_OF_KINDS].ravel()
        kinds = np.repeat(np.tile(_ORDER_OF_KINDS, len(counts)), cases)
        groups = np.repeat(np.repeat(np.arange(len(counts)), _KINDS), cases)
        kind_of_look, in_first_look = kinds % _KINDS_PER_LOOK, (kinds < _KINDS_PER_LOOK) & is_first
        return cls(kind_of_look == 0, kind_of_look < 2, groups, in_first_look, labels, is_first)


@dataclass(frozen=True)
class RequirementEvidence:
    """Results of the cases of a requirement: of its population, and with the unfinished cases that it excludes."""

    population: CaseEvidence
    with_unfinished: CaseEvidence

    def join(self, other: RequirementEvidence) -> RequirementEvidence:
        """Join with the cases of another confirmation."""
        return RequirementEvidence(
            self.population.join(other.population), self.with_unfinished.join(other.with_unfinished)
        )

    def to_table(self) -> dict[str, Any]:
        """Return the counts for the record of confirmations."""
        population, with_unfinished = self.population.to_rows(), self.with_unfinished.to_rows()
        unfinished = {} if population == with_unfinished else {"with_unfinished": with_unfinished}
        return {"n": self.population.n, "failures": self.population.failures} | {"terrains": population, **unfinished}

    @classmethod
    def from_table(cls, stored: Mapping[str, Any], *, is_first: bool) -> RequirementEvidence:
        """Create the results from the record of confirmations; see `CaseEvidence.from_rows`."""
        rows = (stored["terrains"], stored.get("with_unfinished", stored["terrains"]))
        return cls(*(CaseEvidence.from_rows(part, is_first=is_first) for part in rows))
