"""Group sequential tests: when a campaign may stop itself, with the error rates of its verdicts controlled.

A campaign that is judged after every few cases and stopped at the first favourable verdict passes falsely far more
often than its confidence states. Here the looks are fixed before the first case. The risk left by the confidence (10 %
at 90 %) is divided among them in proportion to the cases that each adds (Lan & DeMets, "Discrete sequential boundaries
for clinical trials", Biometrika 70, 1983, with the linear spending function): the bounds at look k hold with confidence
1 - risk_k, and a false verdict at any look has at most the sum of the risks (Boole). No assumption is made on the
dependence between looks, so this holds for any bounds, also those for shared terrains. It costs cases: at the last look
99 % at 90 % takes 299 without a failure, where a campaign that is judged once takes 230.

Unplanned looks occur where a campaign was judged and cases were then appended. The number of appended cases depends on
the results, so no spending function holds. The first look keeps its ordinary bounds. Every later one requires a
likelihood ratio that keeps any number of looks, at any times, within the risk that the first look has left
(`LaterLook`; Robbins, "Statistical methods related to the law of the iterated logarithm", Annals of Mathematical
Statistics 41, 1970). The same applies to shared terrains: where whole terrains are counted it holds, since a terrain
has a failure at least as often as its first case fails. With Korn & Graubard's effective sample size it holds as
approximately as that method.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from scipy import special, stats

#: Minimum risk: a confidence nearer to 1 would round to 1.
_MIN_RISK = 1e-12
#: Minimum number of cases of the first look, and maximum number of looks.
_MIN_FIRST_CASES, _MAX_LOOKS = 16, 6


@dataclass(frozen=True)
class Look:
    """A look at the verdicts: number of cases, and fraction of the risk that is spent."""

    cases: int
    share: float


def planned_looks(cases: int) -> tuple[Look, ...]:
    """Looks of a campaign of at most `cases` cases: at the last case, at half of them, a quarter, and so on."""
    if cases < 1:
        raise ValueError(f"{cases} cases; a campaign has at least one")
    sizes = [cases]
    while len(sizes) < _MAX_LOOKS and sizes[0] // 2 >= _MIN_FIRST_CASES:
        sizes.insert(0, sizes[0] // 2)
    return tuple(Look(size, (size - before) / cases) for before, size in pairwise([0, *sizes]))


def spent_fraction(looks: tuple[Look, ...], cases: int) -> float:
    """Fraction of the risk for a verdict from a number of cases: that of the first look with at least as many.

    For more cases than at the last look it is that look's: cases added to a stopped campaign gain nothing.
    """
    return next((look.share for look in looks if cases <= look.cases), looks[-1].share)


def confidence_at(confidence: float, share: float) -> float:
    """Confidence of the bounds at one look."""
    return 1.0 - (1.0 - confidence) * share


@dataclass(frozen=True)
class LaterLook:
    """Test at a look at a campaign that was judged before: one verdict, PASS or FAIL, of a requirement.

    Events are failures for PASS, successes for FAIL: few of them show it. Under `rate`, the rate at the requirement's
    limit, the likelihood ratio (`_log_likelihood_ratio`) is a martingale, and under any higher rate a supermartingale.
    By Ville's inequality it ever reaches c with probability at most its value at the first look over c, for any
    stopping rule. The threshold c is chosen so that the probabilities of a verdict at the first look, by the ordinary
    bound, and at any later look add up to `risk`.

    rate: probability of an event in a case at the limit: 1 - probability for PASS, probability for FAIL.
    risk: probability of a false verdict of all looks together: 1 - confidence.
    first: cases of the first look, or whole terrains where these are counted.
    """

    rate: float
    risk: float
    first: int

    @cached_property
    def log_threshold(self) -> float:
        """Logarithm of the likelihood ratio that shows the verdict at a later look."""
        events = np.arange(self.first + 1, dtype=np.float64)
        decided = events[stats.binom.cdf(events, self.first, self.rate) <= self.risk]
        chance = stats.binom.logpmf(decided, self.first, self.rate)
        spent = float(np.exp(chance).sum())
        # rest of the martingale's mean of 1 where the first look does not decide
        remaining = 1.0 - float(np.exp(chance + _log_likelihood_ratio(decided, self.first, self.rate)).sum())
        return math.log(max(_MIN_RISK, remaining) / max(_MIN_RISK, self.risk - spent))

    def risk_of_bound(self, n: float | int) -> float:
        """Risk at which the one-sided Clopper-Pearson bound of n cases shows the verdict at this look."""
        log_ratio = float(_log_likelihood_ratio(0.0, n, self.rate))
        if log_ratio < self.log_threshold:
            level = n * math.log1p(-self.rate) + log_ratio - self.log_threshold
            return max(_MIN_RISK, min(self.risk, math.exp(level)))
        few, many = 0.0, float(n)
        while many - few > 1e-9 * max(1.0, n):
            middle = 0.5 * (few + many)
            few, many = (
                (middle, many) if _log_likelihood_ratio(middle, n, self.rate) >= self.log_threshold else (few, middle)
            )
        return max(_MIN_RISK, min(self.risk, float(stats.beta.cdf(1.0 - self.rate, n - few, few + 1.0))))

    def cases_needed(self, n: int, events: int) -> int:
        """Total number of cases, at least n, that shows the verdict if no further event happens."""

        def is_shown(cases: int) -> bool:
            return bool(_log_likelihood_ratio(events, cases, self.rate) >= self.log_threshold)

        upper = max(n, 1)
        while not is_shown(upper):
            upper *= 2
        return n + bisect.bisect_left(range(n, upper), True, key=is_shown)


def _log_likelihood_ratio(
    events: Float64[np.ndarray, "*n"] | float | int, n: float | int, rate: float
) -> Float64[np.ndarray, "*n"]:
    """Logarithm of the likelihood ratio of a lower rate to `rate`, for a number of events in n cases.

    The lower rate has Jeffreys' prior, Beta(1/2, 1/2), truncated at `rate`. The ratio falls with the events, and rises
    with every case without one.
    """
    events = np.asarray(events, dtype=np.float64)
    likelihood = special.betaln(events + 0.5, n - events + 0.5) - special.betaln(0.5, 0.5)
    with np.errstate(divide="ignore"):
        weight = np.log(special.betainc(events + 0.5, n - events + 0.5, rate) / special.betainc(0.5, 0.5, rate))
    return np.asarray(likelihood + weight - events * math.log(rate) - (n - events) * math.log1p(-rate))
