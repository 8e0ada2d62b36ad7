"""When a campaign may stop itself, with the error rates of its verdicts held.

A campaign that is judged whenever a few cases are in, and stopped at the first verdict that pleases, passes falsely far
more often than its confidence says. Here the looks are fixed before the first case, and the risk that the confidence
leaves (10 % at 90 %) is shared out among them, in proportion to the cases that each adds (Lan & DeMets, "Discrete
sequential boundaries for clinical trials", Biometrika 70, 1983, with the linear spending function): the bounds at look
k hold with confidence 1 - risk_k, and a false verdict at any look has at most the sum of the risks (Boole). Nothing is
asked of how the looks depend on one another, so that this holds for any bounds, those for shared terrains included. It
costs cases: at the last look 99 % at 90 % takes 299 without a failure, where a campaign that is judged once takes 230.
"""

from __future__ import annotations

from dataclasses import dataclass

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
