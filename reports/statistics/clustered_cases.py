"""Bounds of the failure rate of a population of cases that share terrains.

Cases that do not belong to a population have neither the event nor its opposite. The rate in the population is the rate
of events per case, divided by the rate of members per case. Both have a bound, and share the risk.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Int

from marsyard.reports.statistics.clusters import TerrainCounts, max_counted, select_counted

#: Fraction of the risk of a wrong bound that the bound of the rate of members uses.
_MEMBER_RISK_FRACTION = 0.1
#: Minimum rate of members for the number of additional cases, which would otherwise be infinite.
_MIN_MEMBER_RATE = 0.01


@dataclass(frozen=True)
class TerrainEvidence:
    """Numbers of terrains with a case of the population, with a failure, and with a success.

    - failure_pairs: number of pairs of failures on one terrain
    - counted: the bounds use the first so many cases of each terrain; None if they use all
    """

    terrains: int
    failed_terrains: int
    successful_terrains: int
    failure_pairs: int
    counted: int | None = None


@dataclass(frozen=True)
class ClusteredCases:
    """Cases that share terrains.

    All cases of the design are included, because the number of cases of a population on a terrain can depend on the
    terrain. `index` numbers the terrains from 0 (`number_terrains`).

    - member: whether each case belongs to the population
    - success: whether each case is a success; ignored outside the population
    """

    success: Bool[np.ndarray, " n"]
    member: Bool[np.ndarray, " n"]
    index: Int[np.ndarray, " n"]

    @classmethod
    def of(cls, success: Bool[np.ndarray, " n"], index: Int[np.ndarray, " n"]) -> ClusteredCases:
        """Create cases that all belong to the population."""
        return cls(success, np.ones(success.size, dtype=np.bool_), index)

    @cached_property
    def failures(self) -> TerrainCounts:
        """Failures of the population."""
        return self._count(self.member & ~self.success)

    @cached_property
    def _counted(self) -> Bool[np.ndarray, " n"]:
        return select_counted(self.index)

    def _count(self, event: Bool[np.ndarray, " n"]) -> TerrainCounts:
        return TerrainCounts.of(event[self._counted], self.index[self._counted])

    @cached_property
    def is_first_on_terrain(self) -> Bool[np.ndarray, " n"]:
        """Whether each case is the first one on its terrain."""
        is_first = np.zeros(self.index.size, dtype=np.bool_)
        is_first[np.unique(self.index, return_index=True)[1]] = True
        return is_first

    def count_terrains(self) -> TerrainEvidence:
        """Count the terrains by the outcomes of their cases."""
        members = np.bincount(self.index, weights=self.member)
        failures = np.bincount(self.index, weights=self.member & ~self.success)
        counted = None if self._counted.all() else max_counted(np.bincount(self.index))
        return TerrainEvidence(
            terrains=int((members > 0).sum()),
            failed_terrains=int((failures > 0).sum()),
            successful_terrains=int((members > failures).sum()),
            failure_pairs=int((failures * (failures - 1.0) / 2.0).sum()),
            counted=counted,
        )

    def max_failure_rate(self, risk: float) -> float:
        """Compute the upper bound of the failure rate in the population."""
        min_member_rate, other_risk = self._min_member_rate(risk)
        return min(1.0, self.failures.max_rate(other_risk) / min_member_rate) if min_member_rate > 0.0 else 1.0

    def consumer_risk(self, max_failure_rate: float, risk: float) -> float:
        """Compute the probability of this result or a better one if the failure rate is `max_failure_rate`.

        risk: permitted risk; its part for the rate of members is included. The result is at most `risk` if and only if
        the upper bound of the failure rate at this risk is at most `max_failure_rate`.
        """
        min_member_rate, other_risk = self._min_member_rate(risk)
        return min(1.0, self.failures.p_value(max_failure_rate * min_member_rate) + risk - other_risk)

    def additional_cases_needed(self, max_failure_rate: float, risk: float) -> int:
        """Find the minimum number of additional cases, each on a new terrain and without a failure, for a failure rate.

        The upper bound of the failure rate is then at most `max_failure_rate`. The rate of members is not increased, so
        slightly fewer cases can be sufficient.
        """
        min_member_rate, other_risk = self._min_member_rate(risk)
        rate = max_failure_rate * max(min_member_rate, _MIN_MEMBER_RATE)

        def is_sufficient(cases: int) -> bool:
            return self.failures.with_single_cases(cases).p_value(rate) <= other_risk

        upper = 1
        while not is_sufficient(upper):
            upper *= 2
        return bisect.bisect_left(range(upper), True, key=is_sufficient)

    def min_failure_rate(self, risk: float) -> float:
        """Compute the lower bound of the failure rate in the population."""
        max_member_rate, other_risk = 1.0, risk
        if not self.member.all():
            max_member_rate = self._count(self.member).max_rate(_MEMBER_RISK_FRACTION * risk)
            other_risk = (1.0 - _MEMBER_RISK_FRACTION) * risk
        no_failure = self._count(~self.member | self.success)
        return (1.0 - no_failure.max_rate(other_risk)) / max_member_rate

    def _min_member_rate(self, risk: float) -> tuple[float, float]:
        """Return the lower bound of the rate of members, and the part of the risk that it does not use."""
        if self.member.all():
            return 1.0, risk
        max_other_rate = self._count(~self.member).max_rate(_MEMBER_RISK_FRACTION * risk)
        return 1.0 - max_other_rate, (1.0 - _MEMBER_RISK_FRACTION) * risk
