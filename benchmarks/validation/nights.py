"""Simulated nightly runs ("nights") of campaigns, to measure false alarms and detections of regressions.

The campaigns differ in the assignment of cases to terrains: cases on one terrain are correlated.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from marsyard.reports.metrics import Metric
from marsyard.reports.night_history import FINISHED, History, NightCampaign
from marsyard.reports.nightly import NightComparison, find_changes, list_comparisons
from marsyard.reports.statistics.difference_tests import Sample

#: Assignments of cases to terrains.
KINDS = ("a bank of 12 terrains", "20 new terrains every night", "a terrain for each case")
#: Cases of a campaign in a nightly run.
CASES = 100
#: Number of nightly runs before a simulated regression, and factor by which the regression increases the errors.
EARLIER_NIGHTS, ERROR_FACTOR = 7, 2.0
#: Limit of the errors, metres.
_LIMIT_M = 2.0


class CampaignSimulator:
    """Draws the cases of campaigns for successive nightly runs.

    Difficult terrains have larger errors and fewer answers. Errors have a heavy-tailed distribution; cases without an
    answer have no error.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._bank = self._draw_terrains(12)
        self._number = 0

    def draw_metrics(self, kind: str, error_factor: float = 1.0) -> list[Metric]:
        """Draw the metrics of a campaign in the next nightly run; every error is multiplied by `error_factor`."""
        self._number += 1
        terrains, (scale_m, answer_probability) = self._draw_terrains_of_cases(kind)
        errors = error_factor * scale_m[terrains] * np.abs(self._rng.standard_t(4, CASES))
        is_answered = self._rng.random(CASES) < answer_probability[terrains]
        # terrains of a bank have the same numbers in every nightly run; other terrains are new
        terrain_numbers = terrains if kind == KINDS[0] else terrains + 1000 * self._number
        is_within_bound = (is_answered & (errors < _LIMIT_M)).astype(np.float64)
        errors = np.where(is_answered, errors, np.nan)
        return [
            Metric("within the bound", True, Sample(is_within_bound, terrain_numbers)),
            Metric("answered", True, Sample(is_answered.astype(np.float64), terrain_numbers)),
            Metric("error (m)", False, Sample(errors, terrain_numbers)),
        ]

    def _draw_terrains_of_cases(self, kind: str) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Draw the terrain of each case, and the error scales and answer probabilities of the terrains."""
        if kind == KINDS[0]:
            return self._rng.integers(0, 12, CASES), self._bank
        if kind == KINDS[1]:
            return self._rng.integers(0, 20, CASES), self._draw_terrains(20)
        return np.arange(CASES), self._draw_terrains(CASES)

    def _draw_terrains(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw error scales in metres and answer probabilities."""
        return self._rng.uniform(0.4, 1.6, count), self._rng.beta(19.0, 1.0, count)


def count_false_alarms(nights: int, seed: int) -> int:
    """Count the nightly runs with a false alarm among successive runs without a change.

    The runs are stored in a history, so that effects of a false alarm on later runs are included.
    """
    simulator, alarm_count = CampaignSimulator(seed), 0
    with TemporaryDirectory() as folder, History(Path(folder, "history.sqlite")) as history:
        for _ in range(nights):
            night = history.begin(None)
            for kind in KINDS:
                history.add(night, NightCampaign(kind, "", "", "PASS", 0, ""), simulator.draw_metrics(kind))
            changes = find_changes(list_comparisons(history, night))
            history.finish(night, FINISHED, changes)
            alarm_count += bool(changes)
    return alarm_count


def count_detections(changed_kind: str, nights: int, seed: int) -> int:
    """Count nightly runs in which an increase of errors is detected for the correct campaign and metric."""
    simulator, detection_count = CampaignSimulator(seed), 0
    for _ in range(nights):
        comparisons = []
        for kind in KINDS:
            earlier_runs = [simulator.draw_metrics(kind) for _ in range(EARLIER_NIGHTS)]
            for index, metric in enumerate(simulator.draw_metrics(kind, ERROR_FACTOR if kind == changed_kind else 1.0)):
                comparisons.append(NightComparison(kind, metric, [run[index].sample for run in earlier_runs]))
        changes = {(change.campaign, change.metric) for change in find_changes(comparisons)}
        detection_count += (changed_kind, "error (m)") in changes
    return detection_count
