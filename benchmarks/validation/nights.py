"""Simulated nightly runs of campaigns whose cases share terrains in different ways."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from marsyard.reports.history import (
    FINISHED,
    Comparison,
    History,
    NightCampaign,
    NightMetric,
    find_changes,
    list_comparisons,
)
from marsyard.reports.statistics.changes import Sample

#: Assignments of cases to terrains.
KINDS = ("a bank of 12 terrains", "20 terrains of each night's own", "a terrain for each case")
#: Cases of a campaign in a night.
CASES = 100
#: Nights before a planted regression, and factor of its errors.
BEFORE, WORSE = 7, 2.0
#: Bound of the errors, metres.
_BOUND_M = 2.0


class Yard:
    """Draw the cases of campaigns for successive nights.

    Difficult terrains have larger errors and fewer answers. Errors have a heavy-tailed distribution; cases without an
    answer have no error.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._bank = self._list_drawn_terrains(12)
        self._number = 0

    def night(self, kind: str, worse: float = 1.0) -> list[NightMetric]:
        """Draw the figures of a campaign in one night; `worse` multiplies every error."""
        self._number += 1
        terrains, (scale_m, answer) = self._terrains(kind)
        errors = worse * scale_m[terrains] * np.abs(self._rng.standard_t(4, CASES))
        answered = self._rng.random(CASES) < answer[terrains]
        # terrains of a bank have the same numbers every night; other terrains are new
        names = terrains if kind == KINDS[0] else terrains + 1000 * self._number
        within = (answered & (errors < _BOUND_M)).astype(np.float64)
        errors = np.where(answered, errors, np.nan)
        return [
            NightMetric("within the bound", True, float(within.mean()), Sample(within, names)),
            NightMetric("answered", True, float(answered.mean()), Sample(answered.astype(np.float64), names)),
            NightMetric("error (m)", False, float(np.nanmedian(errors)), Sample(errors, names)),
        ]

    def _terrains(self, kind: str) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Terrain of each case, and error scales and answer probabilities of the terrains."""
        if kind == KINDS[0]:
            return self._rng.integers(0, 12, CASES), self._bank
        if kind == KINDS[1]:
            return self._rng.integers(0, 20, CASES), self._list_drawn_terrains(20)
        return np.arange(CASES), self._list_drawn_terrains(CASES)

    def _list_drawn_terrains(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw error scales in metres and answer probabilities."""
        return self._rng.uniform(0.4, 1.6, count), self._rng.beta(19.0, 1.0, count)


def quiet_nights(nights: int, seed: int) -> int:
    """Count nights with a false alarm among successive nights without a change.

    The nights are stored in a history, so that effects of a false alarm on later nights are included.
    """
    yard, alarms = Yard(seed), 0
    with TemporaryDirectory() as folder, History(Path(folder, "history.sqlite")) as history:
        for _ in range(nights):
            night = history.begin(None)
            for kind in KINDS:
                history.add(night, NightCampaign(kind, "", "", "PASS", 0, ""), yard.night(kind))
            flagged = find_changes(list_comparisons(history, night))
            history.finish(night, FINISHED, [(one.campaign, one.metric, one.p_value, one.worse) for one in flagged])
            alarms += bool(flagged)
    return alarms


def planted_found(worsened: str, nights: int, seed: int) -> int:
    """Count nights in which a planted increase of errors is detected for the correct campaign and figure."""
    yard, named = Yard(seed), 0
    for _ in range(nights):
        comparisons = []
        for kind in KINDS:
            before = [yard.night(kind) for _ in range(BEFORE)]
            for place, figure in enumerate(yard.night(kind, WORSE if kind == worsened else 1.0)):
                comparisons.append(Comparison(kind, figure, [night[place].sample for night in before]))
        named += (worsened, "error (m)") in {(one.campaign, one.metric) for one in find_changes(comparisons)}
    return named
