"""The page's figures of all rows, with their captions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports.columns import driver_columns, label, numbers
from marsyard.reports.drivers import CONFIDENCE
from marsyard.reports.figures import (
    beyond_the_axis,
    error_against,
    error_distribution,
    error_histogram,
    error_scatter,
    outcome_bars,
    worth_a_closer_look,
)
from marsyard.reports.plates import Plate, plate
from marsyard.reports.populations import terrain_groups
from marsyard.reports.statistics.drivers import Driver, driver
from marsyard.reports.wording import coefficient, count, stated


def error_plates(frame: pd.DataFrame, whole: pd.DataFrame, metric: str, bound: float | None) -> list[Plate]:
    """Scatter of a metric over some rows, and its distribution over all."""
    scatter = "Errors of single cases; the dashed circle is the requirement. Hollow: beyond the axes, at their edge."
    plates: list[tuple[str, Figure | None, str]] = [
        ("scatter", error_scatter(frame, metric, bound), scatter),
        (
            "histogram",
            error_histogram(whole, metric, bound),
            "How often each magnitude of error occurred; hatched: beyond the axis.",
        ),
        ("distribution", error_distribution(whole, metric, bound), "Fraction of cases up to each magnitude."),
    ]
    if worth_a_closer_look(frame, metric, bound):
        closer = ("close", error_scatter(frame, metric, bound, close=True), "The same errors seen closely.")
        plates.insert(1, closer)
    return _plates(plates)


def driver_plates(frame: pd.DataFrame, metric: str, bound: float | None) -> list[Plate]:
    """A metric against what may drive it."""
    drivers = enumerate(driver_columns(frame, metric))
    return _plates(
        [
            (f"driver{k}", error_against(frame, metric, d, bound), _driver_caption(frame, metric, d, bound))
            for k, d in drivers
        ]
    )


def _driver_caption(frame: pd.DataFrame, metric: str, column: str, bound: float | None) -> str:
    """The condition's name, its rank correlation with the errors, and how many of them lie beyond the axis."""
    found = driver(numbers(frame, column), np.abs(numbers(frame, metric)), terrain_groups(frame), CONFIDENCE)
    text = f"{label(column)}."
    if found is not None:
        text = f"{label(column)}: rank correlation {rank_text(found)}."
    beyond = beyond_the_axis(frame, metric, column, bound)
    return f"{text} {count(beyond, 'error')} beyond the axis: hollow, at its upper edge." if beyond else text


def rank_text(found: Driver) -> str:
    """A rank correlation with its interval: ``0.310 (0.120 to 0.480 at 90 % confidence)``."""
    lower, upper = coefficient(found.lower), coefficient(found.upper)
    return f"{coefficient(found.correlation)} ({lower} to {upper} at {stated(CONFIDENCE)} confidence)"


def outcome_plates(frame: pd.DataFrame) -> list[Plate]:
    """How the cases ended."""
    caption = "Plain bars: an answer was given. Hatched: none was, as the algorithm said. Crossed: the case crashed."
    return _plates([("outcomes", outcome_bars(frame), caption)])


def _plates(wanted: Sequence[tuple[str, Figure | None, str]]) -> list[Plate]:
    return [plate(figure, key, caption) for key, figure, caption in wanted if figure is not None]
