"""Drivers: conditions ranked by the fraction of the variance of errors and of failures that they explain."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.reports import populations, rates
from marsyard.reports.column_selection import condition_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.statistics.difference_tests import correct_holm
from marsyard.reports.statistics.drivers import Driver, estimate_driver
from marsyard.reports.wording import coefficient, format_fraction, label, note_text, p_text, percent

#: Maximum number of conditions in a table, and of cases that are used for the ranking.
_MAX_DRIVERS, _MAX_DRIVER_CASES = 12, 20_000


class RankedDriver(NamedTuple):
    """A condition (a column of the rows) with its effect, and the p-value corrected for the number of conditions."""

    column: str
    driver: Driver
    p_value: float


def drivers_section(subject: Subject) -> Section | None:
    """Create the section with the ranked drivers of errors and of failures; None without drivers."""
    metric = subject.metric
    if metric is None:
        return None
    frame = subject.frame.head(_MAX_DRIVER_CASES)
    responses = {"the size of errors": np.abs(numbers(frame, metric))}
    if subject.bound is not None:
        responses["failures"] = (~populations.success_mask(frame, metric, subject.bound)).astype(np.float64)
    columns = condition_columns(frame, metric, subject.run.is_condition)
    ranked_drivers = {
        name: drivers for name, response in responses.items() if (drivers := rank_drivers(frame, columns, response))
    }
    if not ranked_drivers:
        return None
    note = note_text("common.drivers", confidence=format_fraction(CONFIDENCE))
    headings = ["Condition", "Cases", "Rank correlation", "Interval of the correlation"]
    headings += ["Fraction of variance", "Interval of the fraction", "p"]
    blocks = []
    for name, drivers in ranked_drivers.items():
        rows = []
        for column, driver, p_value in drivers[:_MAX_DRIVERS]:
            ranks = [coefficient(driver.correlation), f"{coefficient(driver.lower)} to {coefficient(driver.upper)}"]
            fractions = [percent(driver.fraction), rates.range_text(driver.fraction_lower, driver.fraction_upper)]
            rows.append([label(column), f"{driver.n:,}", *ranks, *fractions, p_text(p_value)])
        blocks.append(Block(heading=f"Drivers of {name}", grid=Grid(headings, rows, len(drivers) - len(rows))))
    data = {
        name: [{"condition": column, **asdict(driver), "corrected_p": p_value} for column, driver, p_value in drivers]
        for name, drivers in ranked_drivers.items()
    }
    title = "Influence of conditions on errors and failures"
    return Section("explained", "Influences", title, [*blocks, Block(note=note)], data)


def rank_drivers(frame: pd.DataFrame, columns: Sequence[str], response: Float[np.ndarray, " n"]) -> list[RankedDriver]:
    """Rank columns by the fraction of a response's variance that they explain, largest first; correct the p-values."""
    groups = rates.terrain_groups(frame)
    drivers: Mapping[str, Driver] = {
        column: driver
        for column in columns
        if (driver := estimate_driver(numbers(frame, column), response, groups, CONFIDENCE)) is not None
    }
    p_values = dict(zip(drivers, correct_holm([driver.p_value for driver in drivers.values()]), strict=True))
    order = sorted(drivers, key=lambda column: (-drivers[column].fraction, column))
    return [RankedDriver(column, drivers[column], p_values[column]) for column in order]
