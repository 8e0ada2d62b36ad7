"""Which conditions explain errors and failures: rank correlation and share of variance, with confidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports.columns import driver_columns, label, numbers
from marsyard.reports.populations import succeeded, terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.changes import holm
from marsyard.reports.statistics.drivers import Driver, driver
from marsyard.reports.wording import coefficient, percent, stated

CONFIDENCE = 0.9
#: Conditions that are ranked, and cases that are looked at: the first ones, which tell as much as they need to.
MOST_CONDITIONS, MOST_CASES = 12, 20_000


def drivers_section(subject: Subject) -> Section | None:
    """Conditions ranked by what they explain of errors and of failures; None where none can be ranked."""
    metric = subject.metric
    if metric is None:
        return None
    frame = subject.frame.head(MOST_CASES)
    responses = {"the size of errors": np.abs(numbers(frame, metric))}
    if subject.bound is not None:
        responses["failures"] = (~succeeded(frame, metric, subject.bound)).astype(np.float64)
    ranked = {name: ranked_drivers(frame, metric, response) for name, response in responses.items()}
    known = {name: found for name, found in ranked.items() if found}
    if not known:
        return None
    note = (
        f"Share: part of the variance of the ranks that the condition alone explains, whatever the curve (first-order "
        f"index). Intervals at {stated(CONFIDENCE)} confidence, fewer cases taken where terrains share condition and "
        "response. p: that it explains nothing, corrected for the number of conditions (Holm). A failure is a case "
        "without an answer within the bound. Nothing is claimed about causes."
    )
    blocks = [Block(heading=f"What explains {name}", grid=_grid(found)) for name, found in known.items()]
    data = {
        name: [{"condition": column, **asdict(one), "corrected_p": p} for column, one, p in found]
        for name, found in known.items()
    }
    return Section("explained", "Explained", "What explains errors and failures", [*blocks, Block(note=note)], data)


Ranked = Sequence[tuple[str, Driver, float]]


def ranked_drivers(frame: pd.DataFrame, metric: str, response: Float[np.ndarray, " n"]) -> Ranked:
    """Conditions with what each explains of a response and its corrected p, those that explain most first."""
    groups = terrain_groups(frame)
    found: Mapping[str, Driver] = {
        column: one
        for column in driver_columns(frame, metric, MOST_CONDITIONS)
        if (one := driver(numbers(frame, column), response, groups, CONFIDENCE)) is not None
    }
    p_values = dict(zip(found, holm([one.p_value for one in found.values()]), strict=True))
    order = sorted(found, key=lambda column: (-found[column].share, column))
    return [(column, found[column], p_values[column]) for column in order]


def _grid(ranked: Ranked) -> Grid:
    head = ["Condition", "Cases", "Rank correlation", "Interval", "Share", "Interval", "p"]
    rows = [
        [
            label(column),
            f"{one.n:,}",
            coefficient(one.correlation),
            f"{coefficient(one.lower)} to {coefficient(one.upper)}",
            percent(one.share),
            f"{percent(one.share_lower)} to {percent(one.share_upper)}",
            "< 0.001" if p < 0.001 else "–" if math.isnan(p) else f"{p:.3f}",
        ]
        for column, one, p in ranked
    ]
    return Grid(head, rows)
