"""Fractions of outcomes by type and size of a fault: stacked bars, and a table with an interval for one outcome."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.reports import rates
from marsyard.reports.plots import stacked_bars
from marsyard.reports.section import Block, Grid, svg_figure
from marsyard.reports.wording import NOTHING, percent

#: Fault type of cases without a fault.
NO_FAULT = "none"


class ExtraColumn(NamedTuple):
    """A further column of the table of outcomes.

    - heading, key: its heading, and its key in `report.json`
    - compute: function that computes its value from the rows of a fault type and size
    - format_value: function that formats the value
    """

    heading: str
    key: str
    compute: Callable[[pd.DataFrame], Any]
    format_value: Callable[[Any], str]


@dataclass(frozen=True)
class OutcomesBySize:
    """Outcomes of cases by type (column `fault`) and size of their fault.

    - outcomes: function that returns a mask of the rows for each outcome, by its key in `report.json`
    - styles: for each outcome, its label and the style of its bars (`marsyard.reports.figure_style.BARS`), in the order
      of bars and columns; the last outcome is the `interval_outcome`
    - cases: name of the counted rows, such as `Flights`: heading of their number, and label of the axis
    - wording: function that returns fault type and size in words; an unknown size is empty
    """

    outcomes: Callable[[pd.DataFrame], Mapping[str, Bool[np.ndarray, " n"]]]
    styles: Mapping[str, tuple[str, str]]
    cases: str
    wording: Callable[[str, float], tuple[str, str]]
    extra_columns: Sequence[ExtraColumn] = ()

    @property
    def interval_outcome(self) -> str:
        """Key of the outcome whose fraction has a confidence interval: the last one of `styles`."""
        return [*self.styles][-1]

    def records(self, frame: pd.DataFrame) -> list[dict[str, Any]]:
        """Count the outcomes for each fault type and size; cases without a fault come first."""
        records = []
        for fault, size, rows in rates.group_by_size(frame, "fault", "fault_size", NO_FAULT):
            masks = self.outcomes(rows)
            counts: dict[str, Any] = {name: int(mask.sum()) for name, mask in masks.items()}
            counts[f"{self.interval_outcome}_fraction"] = rates.fraction_of(masks[self.interval_outcome], rows)
            values = {column.key: column.compute(rows) for column in self.extra_columns}
            records.append({"fault": fault, "size": size, "n": len(rows), **counts, **values})
        return records

    def blocks(self, frame: pd.DataFrame, key: str, caption: str, note: str = "") -> list[Block]:
        """Create stacked bars and a table of the outcomes; empty if no row has a fault."""
        records = self.records(frame) if "fault" in frame else []
        if all(record["fault"] == NO_FAULT for record in records):
            return []
        texts = [self.wording(record["fault"], record["size"]) for record in records]
        interval_label, _ = self.styles[self.interval_outcome]
        head = ["Fault", "Size", self.cases, *(name.capitalize() for name, _ in self.styles.values())]
        head += [f"{interval_label.capitalize()}, interval", *(column.heading for column in self.extra_columns)]
        rows = [
            [
                *(name, size or NOTHING, f"{record['n']:,}"),
                *(f"{record[outcome]:,} ({percent(record[outcome] / record['n'])})" for outcome in self.styles),
                rates.interval_text(record[f"{self.interval_outcome}_fraction"]),
                *(column.format_value(record[column.key]) for column in self.extra_columns),
            ]
            for record, (name, size) in zip(records, texts, strict=True)
        ]
        percentages = {
            name: (style, [100.0 * record[outcome] / record["n"] for record in records])
            for outcome, (name, style) in self.styles.items()
        }
        figure = stacked_bars([" ".join(pair).strip() for pair in texts], percentages, f"% of {self.cases.lower()}")
        figures = [svg_figure(figure, key, caption)]
        return [Block(figures=figures, data={"rows": records}), Block(grid=Grid(head, rows), note=note)]
