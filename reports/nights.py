"""A night held against the nights before: which figures have changed, and the page `nightly.md`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from marsyard.reports.history import FINISHED, History, Night, NightCampaign, NightFigure
from marsyard.reports.statistics.changes import Sample, difference_p, holm
from marsyard.reports.wording import count, number, percent, stated

#: The chance that a night in which nothing changed reports any change at all, at most.
FALSE_ALARMS = 0.01
#: Level at which changes are reported. The other half is for nights after a false alarm, which is their history.
_LEVEL = 0.5 * FALSE_ALARMS
#: Permutations that are expected to go beyond a change just large enough to be reported.
_RESOLVED = 10


@dataclass(frozen=True)
class Change:
    """A figure that has changed.

    Attributes
    ----------
    campaign, figure, rate
        What changed; whether it is a rate of successes, of which more is better, or a size of errors.
    before, now
        Its level in the nights before and tonight: the rate, or the median.
    p_value
        Probability of so much by chance, corrected for the number of figures compared tonight.
    nights
        Nights before that it was held against.
    """

    campaign: str
    figure: str
    rate: bool
    before: float
    now: float
    p_value: float
    nights: int

    @property
    def worse(self) -> bool:
        """Whether it changed for the worse."""
        return self.now < self.before if self.rate else self.now > self.before


@dataclass(frozen=True)
class Comparison:
    """A figure of tonight, and the same figure in the nights before."""

    campaign: str
    figure: NightFigure
    before: Sequence[Sample]


def changes(comparisons: Sequence[Comparison]) -> list[Change]:
    """The figures of a night that have changed; the family-wise rate of false alarms is at most `FALSE_ALARMS`."""
    pooled = [_pooled(one.before) for one in comparisons]
    permutations = math.ceil(_RESOLVED * len(comparisons) / _LEVEL)
    p_values = holm(
        [
            math.nan if before is None else difference_p(one.figure.sample, before, permutations)
            for one, before in zip(comparisons, pooled, strict=True)
        ]
    )
    return [
        Change(
            campaign=one.campaign,
            figure=one.figure.figure,
            rate=one.figure.rate,
            before=level_of(before, one.figure.rate),
            now=level_of(one.figure.sample, one.figure.rate),
            p_value=p,
            nights=len(one.before),
        )
        for one, before, p in zip(comparisons, pooled, p_values, strict=True)
        if before is not None and p <= _LEVEL
    ]


def comparisons_of(history: History, night: int) -> list[Comparison]:
    """Every figure of a night with the same figure in the nights before."""
    return [
        Comparison(campaign.name, figure, history.before(night, campaign, figure.figure))
        for campaign in history.campaigns(night)
        for figure in history.figures(night, campaign.name)
    ]


def level_of(sample: Sample, rate: bool) -> float:
    """The rate, or the median; NaN for no cases."""
    known = sample.known().values
    if known.size == 0:
        return math.nan
    return float(known.mean() if rate else np.median(known))


def _pooled(samples: Sequence[Sample]) -> Sample | None:
    """The cases of several nights together; None where there are none."""
    if not samples:
        return None
    values = np.concatenate([one.values for one in samples])
    return Sample(values, np.concatenate([one.terrains for one in samples]))


def night_text(
    night: Night, earlier: Sequence[Night], campaigns: Sequence[NightCampaign], found: Sequence[Change], compared: int
) -> str:
    """The night's page in Markdown.

    Parameters
    ----------
    night, earlier
        The night, and those before it, the latest first.
    campaigns
        What its campaigns came to.
    found, compared
        The figures that changed, and how many were compared with their history.
    """
    worse = [one for one in found if one.worse]
    better = [one for one in found if not one.worse]
    lines = [f"# Night {night.night}: {_headline(night, campaigns, worse)}", ""]
    lines.append(f"Begun {night.started_utc}, {_end(night)}; commit {night.git_commit or 'not known'}.")
    lines += _interruptions(earlier)
    lines += ["", "| Campaign | Verdict | |", "|---|---|---|"]
    lines += [f"| {_cell(one.name)} | {_cell(one.verdict)} | {_cell(one.sentence)} |" for one in campaigns]
    for title, some in (("Regressions", worse), ("Improvements", better)):
        if some:
            lines += ["", f"## {title}", ""]
            lines += [_change(one) for one in some]
    lines += ["", _compared(compared, found)]
    return "\n".join(lines) + "\n"


def _headline(night: Night, campaigns: Sequence[NightCampaign], worse: Sequence[Change]) -> str:
    if night.state != FINISHED:
        return night.state.upper()
    words = [one.verdict for one in campaigns]
    counts = [f"{words.count(word)} {word}" for word in dict.fromkeys(words)]
    regressed = f", {count(len(worse), 'regression')}" if worse else ""
    return ", ".join(counts) + regressed


def _end(night: Night) -> str:
    return f"ended {night.finished_utc}" if night.state == FINISHED else f"{night.state}: its figures are kept aside"


def _interruptions(earlier: Sequence[Night]) -> list[str]:
    """The nights since the last whole one that did not come to their end."""
    broken = []
    for night in earlier:
        if night.state == FINISHED:
            break
        broken.append(night)
    return ["", *(f"Night {one.night}, begun {one.started_utc}, was {one.state}." for one in broken)] if broken else []


def _change(one: Change) -> str:
    show = percent if one.rate else number
    figures = f"{show(one.before)} in {count(one.nights, 'night')} before, {show(one.now)} now"
    return f"- **{_cell(one.campaign)}: {_cell(one.figure)}**: {figures} (p = {one.p_value:.1g})"


def _compared(compared: int, found: Sequence[Change]) -> str:
    if not compared:
        return "No figure has a history to be compared with yet."
    said = "" if found else " None has changed."
    return (
        f"{count(compared, 'figure')} compared with the nights before; the chance of any false alarm is at most "
        f"{stated(FALSE_ALARMS)}.{said}"
    )


def _cell(text: str) -> str:
    """A text that stays a text in a table, with any characters."""
    marks = {letter: f"&#{ord(letter)};" for letter in "&<>|"} | {letter: f"\\{letter}" for letter in "\\`*_[]#"}
    return "".join(marks.get(letter, letter) for letter in " ".join(text.split()))
