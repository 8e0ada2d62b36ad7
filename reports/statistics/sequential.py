"""When a campaign may stop itself, with the error rates of its verdicts held.

A campaign that is judged whenever a few cases are in, and stopped at the first verdict that pleases, passes falsely far
more often than its confidence says. Here the looks are fixed before the first case, and the risk that the confidence
leaves (10 % at 90 %) is shared out among them, in proportion to the cases that each adds (Lan & DeMets, "Discrete
sequential boundaries for clinical trials", Biometrika 70, 1983, with the linear spending function): the bounds at look
k hold with confidence 1 - risk_k, and a false verdict at any look has at most the sum of the risks (Boole). Nothing is
asked of how the looks depend on one another, so that this holds for any bounds, those for shared terrains included. It
costs cases: at the last look 99 % at 90 % takes 299 without a failure, where a campaign that is judged once takes 230.

Looks that were not planned are those of a campaign that was judged, and to which cases were then appended. How many
are appended depends on what was seen, so that no spending function holds. There the first look keeps its ordinary
bounds, and every later one asks for a likelihood ratio that any number of looks, at any times, keeps within the risk
that the first look has left (`LaterLook`; Robbins, "Statistical methods related to the law of the iterated logarithm",
Annals of Mathematical Statistics 41, 1970). Cases on shared terrains are judged so as well. Where whole terrains are
counted it holds: a terrain has a failure at least as often as its first case fails. With the effective sample size of
Korn & Graubard it is as near as that method itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy import special, stats

#: Smallest risk that is told from none: a confidence nearer to 1 would be 1 in floating-point numbers.
_SMALLEST = 1e-12
#: Fewest cases of the first look, and most looks.
FEWEST_CASES, MOST_LOOKS = 16, 6


@dataclass(frozen=True)
class Look:
    """A time at which verdicts are looked at: after how many cases, and which share of the risk is spent then."""

    cases: int
    share: float


def looks_of(cases: int) -> tuple[Look, ...]:
    """The looks of a campaign of at most so many cases: at the last case, at half of them, a quarter, and so on."""
    if cases < 1:
        raise ValueError(f"{cases} cases; a campaign has at least one")
    places = [cases]
    while len(places) < MOST_LOOKS and places[-1] // 2 >= FEWEST_CASES:
        places.append(places[-1] // 2)
    places.reverse()
    before = [0, *places[:-1]]
    return tuple(Look(place, (place - last) / cases) for place, last in zip(places, before, strict=True))


def spent_share(looks: tuple[Look, ...], cases: int) -> float:
    """The share of the risk for a judgement of so many cases: that of the first look that has as many.

    Of more cases than the last look it is that look's: cases added to a campaign that has stopped buy nothing.
    """
    return next((look.share for look in looks if cases <= look.cases), looks[-1].share)


def confidence_at(confidence: float, share: float) -> float:
    """The confidence that one look's bounds must have."""
    return 1.0 - (1.0 - confidence) * share


@dataclass(frozen=True)
class LaterLook:
    """What a look takes at a campaign that has been judged before: one side, PASS or FAIL, of a requirement.

    Events are failures for PASS, successes for FAIL: few of them show it. Under the rate at the edge of the
    requirement, `rate`, the likelihood ratio of `_log_ratio` is a martingale, and under any higher rate a
    supermartingale. By Ville's inequality it ever reaches c with a chance of at most its value at the first look, by
    c,
    whatever decides when to look: also the number of events seen. The threshold c is chosen so that the chance of a
    verdict at the first look, by the ordinary bound, and that of one at any later look add up to `risk`.

    rate: chance of an event in a case at the edge of the requirement: 1 - probability for PASS, probability for FAIL.
    risk: chance of a false verdict that all looks together may have: 1 - confidence.
    first: cases of the first look, whole terrains where these are counted.
    """

    rate: float
    risk: float
    first: int

    @cached_property
    def log_threshold(self) -> float:
        """The logarithm of the likelihood ratio that shows the verdict at a later look."""
        events = np.arange(self.first + 1, dtype=np.float64)
        decided = events[stats.binom.cdf(events, self.first, self.rate) <= self.risk]
        chance = stats.binom.logpmf(decided, self.first, self.rate)
        spent = float(np.exp(chance).sum())
        # what remains of the martingale's mean, which is 1, where the first look does not decide
        remaining = 1.0 - float(np.exp(chance + _log_ratio(decided, self.first, self.rate)).sum())
        return math.log(max(_SMALLEST, remaining) / max(_SMALLEST, self.risk - spent))

    def risk_of_bound(self, n: float | int) -> float:
        """The risk at which the one-sided Clopper-Pearson bound of n cases shows the verdict for what this look may."""
        log_ratio = float(_log_ratio(0.0, n, self.rate))
        if log_ratio < self.log_threshold:
            level = n * math.log1p(-self.rate) + log_ratio - self.log_threshold
            return max(_SMALLEST, min(self.risk, math.exp(level)))
        few, many = 0.0, float(n)
        while many - few > 1e-9 * max(1.0, n):
            middle = 0.5 * (few + many)
            few, many = (middle, many) if _log_ratio(middle, n, self.rate) >= self.log_threshold else (few, middle)
        return max(_SMALLEST, min(self.risk, float(stats.beta.cdf(1.0 - self.rate, n - few, few + 1.0))))

    def cases_needed(self, n: int, events: int) -> int:
        """Cases in all, n or more, that show the verdict if no further event happens."""
        enough = max(n, 1)
        while _log_ratio(events, enough, self.rate) < self.log_threshold:
            enough *= 2
        too_few = n - 1
        while enough - too_few > 1:
            middle = (enough + too_few) // 2
            shown = _log_ratio(events, middle, self.rate) >= self.log_threshold
            too_few, enough = (too_few, middle) if shown else (middle, enough)
        return enough


def _log_ratio(
    events: Float64[np.ndarray, "*n"] | float | int, n: float | int, rate: float
) -> Float64[np.ndarray, "*n"]:
    """Logarithm of the likelihood of a lower rate over that of `rate`, for so many events in n cases.

    The lower rate has Jeffreys' prior, Beta(1/2, 1/2), cut at `rate`. The ratio falls with the events, and rises with
    every case without one.
    """
    events = np.asarray(events, dtype=np.float64)
    likelihood = special.betaln(events + 0.5, n - events + 0.5) - special.betaln(0.5, 0.5)
    below = special.betainc(events + 0.5, n - events + 0.5, rate) / special.betainc(0.5, 0.5, rate)
    with np.errstate(divide="ignore"):
        weight = np.log(below)
    return np.asarray(likelihood + weight - events * math.log(rate) - (n - events) * math.log1p(-rate))
