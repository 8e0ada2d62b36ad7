"""Detection of metrics that changed between nights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from marsyard.reports.statistics.changes import Metric, Sample, difference_p_value
from marsyard.reports.statistics.multiple_tests import correct_holm

#: Maximum probability of at least one false alarm in a night in which no metric has changed.
MAX_FALSE_ALARM_PROBABILITY = 0.01
#: Significance level of changes. The other half of the probability allows for a second false alarm: after a false
#: alarm, the only reference is one unusual night (docs/adr/0027).
_SIGNIFICANCE = 0.5 * MAX_FALSE_ALARM_PROBABILITY
#: Expected number of permutations that exceed a change at the significance level.
_MIN_EXCEEDANCES = 10


@dataclass(frozen=True)
class MetricChange:
    """A changed metric.

    - is_rate: whether the metric is a success rate (larger is better), not an error
    - before, now: rate or median error in the earlier nights and in this night
    - p_value: p-value with Holm correction for the number of metrics compared in this night
    - nights: number of earlier nights
    """

    campaign: str
    metric: str
    is_rate: bool
    before: float
    now: float
    p_value: float
    nights: int

    @property
    def is_regression(self) -> bool:
        """Whether the change is a regression."""
        return self.now < self.before if self.is_rate else self.now > self.before


@dataclass(frozen=True)
class NightComparison:
    """A metric of one night, and its samples in earlier nights (`before`)."""

    campaign: str
    metric: Metric
    before: Sequence[Sample]


def find_changes(comparisons: Sequence[NightComparison]) -> list[MetricChange]:
    """Find the changed metrics of a night; a false alarm has at most the probability `MAX_FALSE_ALARM_PROBABILITY`."""
    earlier_samples: list[Sample | None] = []
    for comparison in comparisons:
        columns = ([getattr(sample, field) for sample in comparison.before] for field in ("values", "terrains"))
        earlier_samples.append(Sample(*map(np.concatenate, columns)) if comparison.before else None)
    # Holm's method compares the smallest p-value with the significance level divided by the number of metrics
    permutations = math.ceil(_MIN_EXCEEDANCES * len(comparisons) / _SIGNIFICANCE)
    p_values = correct_holm(
        [
            math.nan if sample is None else difference_p_value(comparison.metric.sample, sample, permutations)
            for comparison, sample in zip(comparisons, earlier_samples, strict=True)
        ]
    )
    return [
        MetricChange(
            campaign=comparison.campaign,
            metric=comparison.metric.name,
            is_rate=comparison.metric.is_rate,
            before=replace(comparison.metric, sample=sample).summary,
            now=comparison.metric.summary,
            p_value=p_value,
            nights=len(comparison.before),
        )
        for comparison, sample, p_value in zip(comparisons, earlier_samples, p_values, strict=True)
        if sample is not None and p_value <= _SIGNIFICANCE
    ]
