"""Comparison of a campaign with the numbers of a paper, which are read from a TOML file."""

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.populations import all_flags
from marsyard.reports.rates import finite_values, flag_fraction, fraction_text, median_text
from marsyard.reports.section import Block, Grid, Section, Subject, create_section
from marsyard.reports.wording import NOTHING

_VALUES_NOTE = (
    '"Ours" is the median over all cases, with minimum to maximum in brackets. A dash means that no value is printed.'
)


@cache
def read_paper(path: Path) -> Mapping[str, Any]:
    """Read the numbers of a paper from its TOML file."""
    with path.open("rb") as file:
        return tomllib.load(file)


def paper_section(subject: Subject, path: Path, *extra_blocks: Block) -> Section | None:
    """Create the section with a paper's numbers of a single run next to those of the campaign that repeats it.

    The paper's TOML file contains a table `[[facts]]` for each run. Its keys are `campaign` (name of the campaign that
    repeats the run), `title`, `source`, `note`, and `rows`. Keys of a row:

    - `name` with its unit, `paper` (text, a dash by default), `column`
    - optional: `statistic` (``spread``: median, minimum and maximum; or ``rate``), `among` (flags that select rows),
      `scale`, `digits`, `magnitude` (remove signs)

    None if the paper's file has no run with the campaign's name.
    """
    facts = {fact["campaign"]: fact for fact in read_paper(path)["facts"]}.get(subject.run.name)
    if facts is None or not any(row["column"] in subject.frame for row in facts["rows"]):
        return None
    data = {
        row["name"]: {"paper": row.get("paper", NOTHING), "ours": format_simulated_value(subject.frame, row)}
        for row in facts["rows"]
    }
    grid = Grid(["", "Paper", "Ours"], [[name, *fact.values()] for name, fact in data.items()])
    block = Block(grid=grid, note=f"{_VALUES_NOTE} {facts.get('note', '')}".strip(), data=data)
    return create_section("paper", "Paper comparison", facts["title"], block, *extra_blocks)


def format_simulated_value(frame: pd.DataFrame, row: Mapping[str, Any]) -> str:
    """Format Marsyard's value of a quantity of a paper; `row` is a row of `paper_section`."""
    rows, column = frame[all_flags(frame, *row.get("among", ()))], row["column"]
    if row.get("statistic") == "rate":
        return fraction_text(flag_fraction(rows, column)) if column in rows else NOTHING
    values = finite_values(rows, column, row.get("scale", 1.0))
    return median_text(np.abs(values) if row.get("magnitude") else values, row.get("digits"))
