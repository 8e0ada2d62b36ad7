"""Numbers of papers, from one TOML file each, next to ours."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.reports.kinds import Part, Rows
from marsyard.reports.rates import all_flags, flag_fraction, fraction_text, known, spread_text
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.wording import NOTHING


@cache
def read_paper(path: Path) -> Mapping[str, Any]:
    """Read the numbers of a paper from its TOML file."""
    with path.open("rb") as file:
        return tomllib.load(file)


@dataclass(frozen=True)
class PaperFacts:
    """A paper's numbers of single runs next to ours: `[[facts]]` of its TOML file.

    Keys: `campaign` (that repeats the run), `title`, `source`, `note`, and `rows`. Keys of a row: `name` (with its
    unit), `paper` (text, a dash by default), `column`, and optionally `statistic` (``spread``, the median with minimum
    and maximum, or ``rate``), `among` (flags that choose rows), `scale`, `digits`, and `magnitude` (drop signs).

    further: additional parts by campaign
    """

    path: Path
    further: Mapping[str, Part] = field(default_factory=dict)

    def __call__(self, subject: Subject) -> Section | None:
        """The section; None if the paper has no run of the campaign's name."""
        facts = {one["campaign"]: one for one in read_paper(self.path)["facts"]}.get(subject.run.name)
        if facts is None or not any(row["column"] in subject.frame for row in facts["rows"]):
            return None
        data: dict[str, Any] = {
            row["name"]: {"paper": row.get("paper", NOTHING), "ours": format_own_value(subject.frame, row)}
            for row in facts["rows"]
        }
        grid = Grid(["", "Paper", "Ours"], [[name, *one.values()] for name, one in data.items()])
        blocks = [Block(grid=grid, note=f"{_MEDIANS} {facts.get('note', '')}".strip())]
        if subject.run.name in self.further:
            shown, numbers_too = self.further[subject.run.name].draw(subject.frame, subject, "paper")
            blocks += shown
            data |= numbers_too
        return Section("paper", "Paper comparison", facts["title"], blocks, data)


_MEDIANS = "Ours: median over all cases, minimum to maximum in brackets. A dash: not stated by the paper."


def format_own_value(frame: Rows, row: Mapping[str, Any]) -> str:
    """Our value of a paper's quantity."""
    chosen, column = frame[all_flags(frame, *row.get("among", ()))], row["column"]
    if row.get("statistic") == "rate":
        return fraction_text(flag_fraction(chosen, column)) if column in chosen else NOTHING
    values = known(chosen, column, row.get("scale", 1.0))
    return spread_text(np.abs(values) if row.get("magnitude") else values, row.get("digits"))
