"""A night in words, for a mail or a chat: `nightly.md`."""

from __future__ import annotations

from collections.abc import Sequence

from marsyard.reports.history import FINISHED, Night, NightCampaign
from marsyard.reports.regressions import FALSE_ALARMS, Change
from marsyard.reports.wording import count, number, percent, stated


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
    """A text that stays a text in a table, whatever it holds."""
    marks = {letter: f"&#{ord(letter)};" for letter in "&<>|"} | {letter: f"\\{letter}" for letter in "\\`*_[]#"}
    return "".join(marks.get(letter, letter) for letter in " ".join(text.split()))
