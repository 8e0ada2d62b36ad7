"""Responses against conditions as a part of a declared section: points, medians of bins, and rank correlations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from marsyard.reports.charts import Panel, scatter_panels
from marsyard.reports.kinds import Drawn, Quantity, Rows, condition_bins
from marsyard.reports.populations import terrain_groups
from marsyard.reports.rates import CONFIDENCE, varies
from marsyard.reports.section import Block, Grid, Subject, plate
from marsyard.reports.statistics.drivers import FEWEST_CASES, driver
from marsyard.reports.wording import NOTHING, coefficient, stated


@dataclass(frozen=True)
class Effect:
    """What a condition does to a response: Spearman's correlation with its interval, and medians in bins of it."""

    driver: str
    error: str
    rank_correlation: float
    lower: float
    upper: float
    centres: Sequence[float]
    medians: Sequence[float]


@dataclass(frozen=True)
class Scatter:
    """Responses against conditions: points, medians of bins, and rank correlations.

    Attributes
    ----------
    x, y
        Conditions and responses. A condition that does not vary is left out.
    logarithmic
        Whether the responses' axes are.
    """

    x: Sequence[Quantity]
    y: Sequence[Quantity]
    caption: str
    heading: str = ""
    logarithmic: bool = False

    def effects(self, frame: Rows) -> list[Effect]:
        """The effect of every condition that varies on every response."""
        effects, groups = [], terrain_groups(frame)
        for one in (one for one in self.x if varies(frame, one.column)):
            for response in self.y:
                x, y = one.values(frame), response.values(frame)
                bins = condition_bins(np.where(np.isfinite(y), x, np.nan))
                medians = [[float(np.median(values[chosen])) for chosen in bins] for values in (x, y)]
                ranks = driver(x, y, groups, CONFIDENCE)
                of_ranks = (math.nan,) * 3 if ranks is None else (ranks.correlation, ranks.lower, ranks.upper)
                effects.append(Effect(one.title, response.title, *of_ranks, *medians))
        return effects

    def draw(self, frame: Rows, subject: Subject, key: str) -> Drawn:
        """The panels and the rank correlations; nothing where no condition varies."""
        del subject
        effects = self.effects(frame)
        if not effects:
            return [], {}
        columns = {one.title: one.values(frame) for one in (*self.x, *self.y)}
        panels = {
            (one.driver, one.error): Panel((columns[one.driver], columns[one.error]), (one.centres, one.medians))
            for one in effects
        }
        texts: dict[str, list[str]] = {}
        for one in effects:
            texts.setdefault(one.driver, []).append(correlation_text(one))
        grid = Grid(
            ["Rank correlation", *(one.title for one in self.y)], [[name, *cells] for name, cells in texts.items()]
        )
        figure = scatter_panels(panels, logarithmic=self.logarithmic)
        note = (
            f"Intervals at {stated(CONFIDENCE)} confidence; a dash for fewer than {FEWEST_CASES} cases, or where "
            "nothing varies."
        )
        plates = [plate(figure, key, self.caption, wide=len(effects) > 1)]
        return [Block(heading=self.heading, plates=plates, grid=grid, note=note)], {
            "effects": [asdict(e) for e in effects]
        }


def correlation_text(effect: Effect) -> str:
    """A rank correlation with its interval; a dash where there is none."""
    if math.isnan(effect.rank_correlation):
        return NOTHING
    return f"{coefficient(effect.rank_correlation)} ({coefficient(effect.lower)} to {coefficient(effect.upper)})"
