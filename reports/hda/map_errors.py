"""What the errors of the elevation map depend on: baseline, texture, grid, attitude and altimeter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure

from marsyard.reports.columns import numbers
from marsyard.reports.hda.rows import is_landing, varies
from marsyard.reports.plates import plate
from marsyard.reports.populations import terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.drivers import FEWEST_CASES
from marsyard.reports.statistics.drivers import driver as explained
from marsyard.reports.svg import SERIES, in_page_style
from marsyard.reports.wording import NOTHING, coefficient, count, number, stated

#: Fewest cases with a map for the section to be shown.
FEWEST = 8
#: Confidence of the intervals of rank correlations.
CONFIDENCE = 0.9
_RANKS = (
    f"Intervals at {stated(CONFIDENCE)} confidence; a dash for fewer than {FEWEST_CASES} maps, or where nothing varies."
)
#: Bins of a driver, each with as many cases as the others; fewer where cases are few.
_BINS = 5
_FEWEST_IN_BIN = 4


@dataclass(frozen=True)
class Driver:
    """What an error may depend on: its column, name, and what its numbers are multiplied by."""

    column: str
    name: str
    scale: float = 1.0


#: Baseline, texture, spacing, attitude and altimeter, as issue and paper name them; errors as they were applied.
DRIVERS = (
    Driver("baseline_share", "baseline over height"),
    Driver("texture", "texture over the site's"),
    Driver("grid_px", "grid spacing (px)"),
    Driver("level_error_deg", "error of the vertical (deg)"),
    Driver("altimeter_share", "altimeter's error (% of the range)", 100.0),
)
#: Errors that are shown: columns as made by `with_shares`, and their names.
ERRORS = (
    Driver("rms_share", "elevation error rms (% of height)", 100.0),
    Driver("noise_share", "the same without its plane (% of height)", 100.0),
    Driver("slope_error_rms_deg", "slope error rms (deg)"),
)


@dataclass(frozen=True)
class Effect:
    """What one driver does to one error.

    Attributes
    ----------
    driver, error
        Their names.
    rank_correlation, lower, upper
        Spearman's, and its interval at 90 % confidence; NaN for fewer than 20 maps or a constant.
    centres, medians
        Of the bins: the driver's median and the error's.
    """

    driver: str
    error: str
    rank_correlation: float
    lower: float
    upper: float
    centres: Sequence[float]
    medians: Sequence[float]


def map_section(subject: Subject) -> Section | None:
    """The errors; None where texture and baseline do not vary or maps are too few."""
    frame = subject.frame
    if not is_landing(frame) or not (varies(frame, "texture") and varies(frame, "baseline_share")):
        return None
    mapped = with_shares(frame)
    if len(mapped) < FEWEST:
        return None
    effects = analyse(mapped)
    summary = [
        [error.name, *(number(float(one)) for one in np.nanquantile(_scaled(mapped, error), (0.05, 0.5, 0.95)))]
        for error in ERRORS
    ]
    head = ["", *(error.name for error in ERRORS)]
    rows = [
        [driver.name, *(_rank_text(one) for one in effects if one.driver == driver.name)]
        for driver in DRIVERS
        if any(one.driver == driver.name for one in effects)
    ]
    caption = "Every case, and medians of bins with equally many cases; scales of the errors are logarithmic."
    note = (
        "Against exact heights averaged over each cell. Rms holds what the altimeter, the vertical and the motion do "
        "to the whole map; without its plane the map's own noise is left, which roughness sees. Errors as they were "
        "applied in the case: that of the vertical from the inclinometers, that of the altimeter from its reading."
    )
    blocks = [
        Block(plates=[plate(map_figure(mapped, effects), "maperrors", caption, wide=True)]),
        Block(
            heading=f"Errors of {count(len(mapped), 'map')}",
            grid=Grid(["", "5 %", "Median", "95 %"], summary),
            note=note,
        ),
        Block(heading="Rank correlations", grid=Grid(head, rows), note=_RANKS),
    ]
    data = {"maps": len(mapped), "effects": [asdict(one) for one in effects]}
    return Section("map-errors", "Map", "Errors of the elevation map", blocks, data)


def with_shares(frame: pd.DataFrame) -> pd.DataFrame:
    """The cases with a map, with errors as shares of height and range."""
    shares = {
        "rms_share": numbers(frame, "elevation_rms_m") / numbers(frame, "height_m"),
        "noise_share": numbers(frame, "elevation_noise_m") / numbers(frame, "height_m"),
        "altimeter_share": np.abs(numbers(frame, "range_error_m")) / numbers(frame, "range_m"),
    }
    known = np.isfinite(shares["rms_share"])
    return pd.DataFrame(frame.assign(**shares)[known])


def analyse(mapped: pd.DataFrame) -> list[Effect]:
    """Effects of every driver that varies on every error."""
    found = []
    groups = terrain_groups(mapped)
    for driver in DRIVERS:
        if varies(mapped, driver.column):
            x = _scaled(mapped, driver)
            for error in ERRORS:
                y = _scaled(mapped, error)
                centres, medians = _binned(x, y)
                ranks = explained(x, y, groups, CONFIDENCE)
                of_ranks = (math.nan,) * 3 if ranks is None else (ranks.correlation, ranks.lower, ranks.upper)
                found.append(Effect(driver.name, error.name, *of_ranks, centres, medians))
    return found


def _rank_text(effect: Effect) -> str:
    """A rank correlation with its interval; a dash where there is none."""
    if math.isnan(effect.rank_correlation):
        return NOTHING
    return f"{coefficient(effect.rank_correlation)} ({coefficient(effect.lower)} to {coefficient(effect.upper)})"


def _scaled(frame: pd.DataFrame, one: Driver) -> Float[np.ndarray, " n"]:
    return np.asarray(one.scale * numbers(frame, one.column))


def _binned(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> tuple[list[float], list[float]]:
    """Medians of both in bins of equal counts, or at each value where there are few."""
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    values = np.unique(x)
    if values.size <= _BINS:
        parts = [x == value for value in values]
    else:
        bins = max(1, min(_BINS, x.size // _FEWEST_IN_BIN))
        ranks = np.argsort(np.argsort(x, kind="stable"), kind="stable")
        parts = [ranks * bins // x.size == k for k in range(bins)]
    return [float(np.median(x[part])) for part in parts], [float(np.median(y[part])) for part in parts]


@in_page_style
def map_figure(mapped: pd.DataFrame, effects: Sequence[Effect]) -> Figure:
    """Errors against every driver: a row for each error, a column for each driver."""
    drivers = [driver for driver in DRIVERS if any(one.driver == driver.name for one in effects)]
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    grid = figure.subplots(len(ERRORS), len(drivers), squeeze=False, sharex="col", sharey="row")
    for row, error in enumerate(ERRORS):
        for column, driver in enumerate(drivers):
            axes = grid[row, column]
            (effect,) = (one for one in effects if (one.driver, one.error) == (driver.name, error.name))
            axes.plot(
                _scaled(mapped, driver), _scaled(mapped, error), ".", color=SERIES[5], markersize=3, rasterized=True
            )
            axes.plot(effect.centres, effect.medians, "o-", color=SERIES[0], markersize=4.5)
            axes.set_yscale("log")
            if row == len(ERRORS) - 1:
                axes.set_xlabel(driver.name, fontsize=8)
        grid[row, 0].set_ylabel(error.name, fontsize=8)
    return figure
