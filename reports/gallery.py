"""The page's figures of all rows, with their captions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from reports.columns import driver_columns, label, numbers, rank_correlation
from reports.figures import (
    error_against,
    error_distribution,
    error_histogram,
    error_scatter,
    off_scale,
    outcome_bars,
    worth_a_closer_look,
)
from reports.plates import Plate, plate
from reports.wording import coefficient, count


def error_plates(frame: pd.DataFrame, whole: pd.DataFrame, metric: str, bound: float | None) -> list[Plate]:
    """Scatter of a metric over some rows, and its distribution over all."""
    beyond = off_scale(frame, metric, bound)
    scatter = "Errors of single cases; the dashed circle is the requirement."
    if beyond:
        scatter += f" {count(beyond, 'error')} too large for these axes: drawn at their edge."
    plates: list[tuple[str, Figure | None, str]] = [
        ("scatter", error_scatter(frame, metric, bound), scatter),
        ("histogram", error_histogram(whole, metric, bound), "How often each magnitude of error occurred."),
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
        [(f"driver{k}", error_against(frame, metric, d, bound), _ranks(frame, metric, d)) for k, d in drivers]
    )


def _ranks(frame: pd.DataFrame, metric: str, driver: str) -> str:
    correlation = rank_correlation(numbers(frame, driver), np.abs(numbers(frame, metric)))
    if np.isnan(correlation):
        return f"{label(driver)}."
    return f"{label(driver)}: rank correlation {coefficient(correlation)}."


def outcome_plates(frame: pd.DataFrame) -> list[Plate]:
    """How the cases ended."""
    caption = "Plain bars: an answer was given. Hatched: none was, as the algorithm said. Crossed: the case crashed."
    return _plates([("outcomes", outcome_bars(frame), caption)])


def _plates(wanted: Sequence[tuple[str, Figure | None, str]]) -> list[Plate]:
    return [plate(figure, key, caption) for key, figure, caption in wanted if figure is not None]
