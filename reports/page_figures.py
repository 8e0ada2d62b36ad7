"""Figures of errors, drivers and outcomes with their captions.

A driver is a condition that may affect the metric.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports import figures
from marsyard.reports.column_values import numbers
from marsyard.reports.populations import engine_failed
from marsyard.reports.rates import CONFIDENCE, terrain_groups
from marsyard.reports.section import SvgFigure, svg_figure
from marsyard.reports.statistics.drivers import Driver, estimate_driver
from marsyard.reports.wording import coefficient, count, format_fraction


def error_figures(frame: pd.DataFrame, all_cases: pd.DataFrame, metric: str, bound: float | None) -> list[SvgFigure]:
    """Draw a scatter plot of a metric for the cases in `frame`; histogram and distribution for those in `all_cases`."""
    scatter = "Error of each case." if bound is None else "Error of each case. The dashed circle is the requirement."
    histogram = "Histogram of the error magnitude."
    entries: list[tuple[str, Figure | None, str]] = [("scatter", figures.error_scatter(frame, metric, bound), scatter)]
    if figures.needs_enlarged_figure(frame, metric, bound):
        figure = figures.error_scatter(frame, metric, bound, enlarged=True)
        entries.append(("close", figure, "Enlarged view of the same errors."))
    entries.append(("histogram", figures.error_histogram(all_cases, metric, bound), histogram))
    caption = "Cumulative distribution of the error magnitude."
    entries.append(("distribution", figures.error_distribution(all_cases, metric, bound), caption))
    return _svg_figures(entries)


def driver_figures(frame: pd.DataFrame, metric: str, bound: float | None, columns: Sequence[str]) -> list[SvgFigure]:
    """Draw a metric against the conditions `columns`, with rank correlations."""
    entries, magnitude, groups = [], np.abs(numbers(frame, metric)), terrain_groups(frame)
    for index, column in enumerate(columns):
        driver = estimate_driver(numbers(frame, column), magnitude, groups, CONFIDENCE)
        sentences = [] if driver is None else [f"Rank correlation {rank_text(driver)}."]
        n_beyond = figures.count_beyond_axis(frame, metric, column, bound)
        if n_beyond:
            sentences.append(f"Hollow marks at the upper edge: {count(n_beyond, 'error')} beyond the axis.")
        entries.append(
            (f"driver{index}", figures.error_scatter_against(frame, metric, column, bound), " ".join(sentences))
        )
    return _svg_figures(entries)


def rank_text(driver: Driver) -> str:
    """Format a rank correlation with its interval: ``0.310 (0.120 to 0.480 at 90 % confidence)``."""
    lower, upper = coefficient(driver.lower), coefficient(driver.upper)
    return f"{coefficient(driver.correlation)} ({lower} to {upper} at {format_fraction(CONFIDENCE)} confidence)"


def outcome_figures(frame: pd.DataFrame) -> list[SvgFigure]:
    """Draw the number of cases by outcome."""
    caption = "Solid bars: cases with an answer. Hatched bars: cases without an answer."
    if engine_failed(frame).any():
        caption += " Cross-hatched bars: cases in which the program failed (crashed cases)."
    return _svg_figures([("outcomes", figures.outcome_bars(frame), caption)])


def _svg_figures(entries: Sequence[tuple[str, Figure | None, str]]) -> list[SvgFigure]:
    return [svg_figure(figure, key, caption) for key, figure, caption in entries if figure is not None]
