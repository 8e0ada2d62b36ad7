"""Planned looks at a growing campaign, and the sequential test at looks after the first."""

import bisect
import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from scipy import special, stats

#: Minimum risk, since a confidence closer to 1 would be rounded to 1.
_MIN_RISK = 1e-12
#: Accuracy of a number of events, as a fraction of the number of cases.
_ACCURACY = 1e-9
#: Minimum number of cases of the first look, and maximum number of looks.
_MIN_FIRST_CASES, _MAX_LOOKS = 16, 6


@dataclass(frozen=True)
class Look:
    """A planned evaluation of the verdicts: number of cases, and fraction of the risk of a wrong verdict it may use."""

    cases: int
    risk_fraction: float


def planned_looks(cases: int) -> tuple[Look, ...]:
    """Plan the looks of a campaign of at most `cases` cases: at all cases, at half of them, a quarter, and so on."""
    if cases < 1:
        raise ValueError(f"{cases} cases; a campaign has at least one")
    sizes = [cases]
    while len(sizes) < _MAX_LOOKS and sizes[0] // 2 >= _MIN_FIRST_CASES:
        sizes.insert(0, sizes[0] // 2)
    return tuple(Look(size, (size - previous) / cases) for previous, size in pairwise([0, *sizes]))


def risk_fraction_at(looks: tuple[Look, ...], cases: int) -> float:
    """Return the fraction of the risk at the first planned look with at least this number of cases.

    It does not include the fractions of earlier looks. For more cases than at the last look, return that of the last
    look.
    """
    return next((look.risk_fraction for look in looks if cases <= look.cases), looks[-1].risk_fraction)


def confidence_at(confidence: float, risk_fraction: float) -> float:
    """Return the confidence of the bounds at a look that may use a fraction of the risk."""
    return 1.0 - (1.0 - confidence) * risk_fraction


@dataclass(frozen=True)
class SequentialTest:
    """Sequential test for one verdict (PASS or FAIL) at the looks after the first, of a campaign with appended cases.

    Events are failures for PASS and successes for FAIL: few events support the verdict. If the probability of an event
    is `rate`, the likelihood ratio (`_log_likelihood_ratio`) is a martingale; if it is higher, a supermartingale.
    Ville's inequality holds for any stopping rule: the probability that the ratio ever reaches a threshold c is at most
    its value at the first look divided by c. The first look uses the Clopper-Pearson bound. The threshold c is chosen
    so that the probabilities of a false verdict at the first look and at all later looks sum to `risk`.

    - rate: probability of an event at the limit of the requirement: 1 - probability for PASS, probability for FAIL
    - risk: probability of a false verdict at all looks together: 1 - confidence
    - first_n: number of cases at the first look, or of terrains if terrains are counted
    - first_look_risk: probability of a false verdict at the first look, if it does not use the Clopper-Pearson bound
    """

    rate: float
    risk: float
    first_n: int
    first_look_risk: float | None = None

    @cached_property
    def log_threshold(self) -> float:
        """Logarithm of the likelihood ratio that supports the verdict at a later look."""
        if self.first_look_risk is not None:
            return -math.log(max(_MIN_RISK, self.risk - self.first_look_risk))
        events = np.arange(self.first_n + 1, dtype=np.float64)
        deciding_events = events[stats.binom.cdf(events, self.first_n, self.rate) <= self.risk]
        log_probability = stats.binom.logpmf(deciding_events, self.first_n, self.rate)
        first_look_risk = float(np.exp(log_probability).sum())
        # mean of the likelihood ratio over the results that do not decide at the first look; the mean over all is 1
        log_ratio = _log_likelihood_ratio(deciding_events, self.first_n, self.rate)
        undecided_mean = 1.0 - float(np.exp(log_probability + log_ratio).sum())
        return math.log(max(_MIN_RISK, undecided_mean) / max(_MIN_RISK, self.risk - first_look_risk))

    def significance_level(self, n: float | int) -> float:
        """Compute the significance level at which the Clopper-Pearson bound gives the verdict of this test."""
        log_ratio = float(_log_likelihood_ratio(0.0, n, self.rate))
        # n cases are too few even without events: the risk (1 - rate)^n of no event, times ratio / threshold
        if log_ratio < self.log_threshold:
            log_risk = n * math.log1p(-self.rate) + log_ratio - self.log_threshold
            return max(_MIN_RISK, min(self.risk, math.exp(log_risk)))
        # bisection for the largest number of events that supports the verdict
        min_events, max_events = 0.0, float(n)
        while max_events - min_events > _ACCURACY * max(1.0, n):
            events = 0.5 * (min_events + max_events)
            is_supported = _log_likelihood_ratio(events, n, self.rate) >= self.log_threshold
            min_events, max_events = (events, max_events) if is_supported else (min_events, events)
        return max(_MIN_RISK, min(self.risk, float(stats.beta.cdf(1.0 - self.rate, n - min_events, min_events + 1.0))))

    def cases_needed(self, n: int, events: int, event_rate: float = 0.0) -> int:
        """Return the total number of cases, at least n, that supports the verdict.

        event_rate: fraction of the further cases that have an event, below `rate`; none by default
        """

        def is_sufficient(cases: int) -> bool:
            expected = events + event_rate * (cases - n)
            return bool(_log_likelihood_ratio(expected, cases, self.rate) >= self.log_threshold)

        upper = max(n, 1)
        while not is_sufficient(upper):
            upper *= 2
        return n + bisect.bisect_left(range(n, upper), True, key=is_sufficient)


def _log_likelihood_ratio(
    events: Float64[np.ndarray, "*n"] | float | int, n: float | int, rate: float
) -> Float64[np.ndarray, "*n"]:
    """Compute the logarithm of the likelihood ratio of a lower rate to `rate`, for a number of events in n cases.

    The lower rate has Jeffreys' prior, Beta(1/2, 1/2), truncated at `rate`. The ratio decreases with every event and
    increases with every case without an event.
    """
    events = np.asarray(events, dtype=np.float64)
    # marginal likelihood of the prior without truncation, and the factor of the truncation
    log_marginal = special.betaln(events + 0.5, n - events + 0.5) - special.betaln(0.5, 0.5)
    with np.errstate(divide="ignore"):
        log_weight = np.log(special.betainc(events + 0.5, n - events + 0.5, rate) / special.betainc(0.5, 0.5, rate))
    return np.asarray(log_marginal + log_weight - events * math.log(rate) - (n - events) * math.log1p(-rate))
