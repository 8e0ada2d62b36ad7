"""Simulated nights: campaigns whose cases share terrains in the ways that the nightly comparison distinguishes."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from marsyard.reports.history import FINISHED, Comparison, History, NightCampaign, NightFigure, changes, compare_night
from marsyard.reports.statistics.changes import Sample

#: How a campaign's cases lie on terrains.
KINDS = ("a bank of 12 terrains", "20 terrains of each night's own", "a terrain for each case")
#: Cases of a campaign in a night.
CASES = 100
#: Nights before one with a planted regression, and how much larger its errors are.
BEFORE, WORSE = 7, 2.0
#: Bound of the errors, metres.
_BOUND_M = 2.0


class Yard:
    """Draws campaigns' cases, night after night.

    On harder terrains errors are larger and answers rarer; some errors are far off, and cases without an answer have
    none.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._bank = self._drawn_terrains(12)
        self._number = 0

    def night(self, kind: str, worse: float = 1.0) -> list[NightFigure]:
        """A campaign's figures in a night; `worse` multiplies every error."""
        self._number += 1
        terrains, (scale_m, answer) = self._terrains(kind)
        errors = worse * scale_m[terrains] * np.abs(self._rng.standard_t(4, CASES))
        answered = self._rng.random(CASES) < answer[terrains]
        # a bank's terrains have the same names every night, others never again
        names = terrains if kind == KINDS[0] else terrains + 1000 * self._number
        within = (answered & (errors < _BOUND_M)).astype(np.float64)
        errors = np.where(answered, errors, np.nan)
        return [
            NightFigure("within the bound", True, float(within.mean()), Sample(within, names)),
            NightFigure("answered", True, float(answered.mean()), Sample(answered.astype(np.float64), names)),
            NightFigure("error (m)", False, float(np.nanmedian(errors)), Sample(errors, names)),
        ]

    def _terrains(self, kind: str) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """The terrain of each case, and what the terrains are like."""
        if kind == KINDS[0]:
            return self._rng.integers(0, 12, CASES), self._bank
        if kind == KINDS[1]:
            return self._rng.integers(0, 20, CASES), self._drawn_terrains(20)
        return np.arange(CASES), self._drawn_terrains(CASES)

    def _drawn_terrains(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Scale of the errors, metres, and the chance of an answer."""
        return self._rng.uniform(0.4, 1.6, count), self._rng.beta(19.0, 1.0, count)


def quiet_nights(nights: int, seed: int) -> int:
    """In how many of so many nights in a row, in which nothing changed, a change is reported.

    They go through a history as the nightly's do: what a false alarm does to the nights after it is in the figure.
    """
    yard, alarms = Yard(seed), 0
    with TemporaryDirectory() as folder, History(Path(folder, "history.sqlite")) as history:
        for _ in range(nights):
            night = history.begin(None)
            for kind in KINDS:
                history.add(night, NightCampaign(kind, "", "", "PASS", 0, ""), yard.night(kind))
            found = changes(compare_night(history, night))
            history.finish(night, FINISHED, [(one.campaign, one.figure, one.p_value, one.worse) for one in found])
            alarms += bool(found)
    return alarms


def planted_found(worsened: str, nights: int, seed: int) -> int:
    """How many nights in which the errors of one kind of campaign are larger name that campaign and that figure."""
    yard, named = Yard(seed), 0
    for _ in range(nights):
        comparisons = []
        for kind in KINDS:
            before = [yard.night(kind) for _ in range(BEFORE)]
            for place, figure in enumerate(yard.night(kind, WORSE if kind == worsened else 1.0)):
                comparisons.append(Comparison(kind, figure, [night[place].sample for night in before]))
        named += (worsened, "error (m)") in {(one.campaign, one.figure) for one in changes(comparisons)}
    return named
