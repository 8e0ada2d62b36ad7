"""Check of a subset simulation: violations that were reached without intermediate margins.

If the margin falls continuously to a violation, a level with the probability P contains violations with the conditional
probability p / P. Cases of a level far above the last one therefore violate rarely. A gross error without intermediate
margins occurs in each level at the same rate, so that it produces more such violations than the estimate p predicts.

The check can refute an estimate, but it cannot prove that a margin is continuous (docs/rare-violations.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scipy.stats import poisson

from marsyard.campaigns.studies.counting import CountingBound
from marsyard.campaigns.studies.interval import ProbabilityInterval
from marsyard.campaigns.studies.subset import SubsetResult

#: Probability of each side of the check to refute an estimate with a continuous margin.
_RISK = 0.01
#: Number of levels before a violation from which a violation is expected.
_NEAR_LEVELS = 2


@dataclass(frozen=True)
class ContinuityCheck:
    """Violations that were reached directly: by a random case, or from a level that is at least two before the last.

    - direct: number of these violations
    - expected_lower, expected_upper: numbers that the interval of the subset simulations predicts
    - refuted: whether `direct` is incompatible with the interval
    """

    direct: int
    expected_lower: float
    expected_upper: float
    refuted: bool


def check_continuity(
    replicates: Sequence[SubsetResult], interval: ProbabilityInterval, counting: CountingBound
) -> ContinuityCheck:
    """Compare the number of direct violations with the number that the interval of the replicates predicts.

    The numbers are treated as Poisson distributed. Random cases are the independent units of the counting bound; they
    include the first level of each replicate.
    """
    far_levels = [level for replicate in replicates for level in replicate.levels[1:-_NEAR_LEVELS]]
    direct = counting.first_violations + sum(level.entered for level in far_levels)
    exposure = counting.units + sum(level.drawn / level.probability for level in far_levels)
    expected_lower, expected_upper = interval.lower * exposure, interval.upper * exposure
    is_excess = float(poisson.sf(direct - 1, expected_upper)) < _RISK
    is_deficit = float(poisson.cdf(direct, expected_lower)) < _RISK
    return ContinuityCheck(direct, expected_lower, expected_upper, is_excess or is_deficit)
