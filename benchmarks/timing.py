"""Results of a benchmark with their limits, and the measurement of processor time."""

import itertools
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

from marsyard.campaigns.definition.campaign import Campaign


@dataclass(frozen=True)
class Measurement:
    """Measured values of one quantity, in core-seconds unless the name contains a unit.

    - limit, minimum: largest and smallest accepted median, or None
    """

    name: str
    values: list[float]
    limit: float | None = None
    minimum: float | None = None

    @property
    def median(self) -> float:
        """Median of the measured values."""
        return statistics.median(self.values)

    @property
    def limit_text(self) -> str:
        """The limit as text, for example "<= 2"."""
        if self.limit is not None:
            return f"<= {self.limit:g}"
        return f">= {self.minimum:g}" if self.minimum is not None else ""


def core_seconds(run: Callable[[], object], repeats: int) -> list[float]:
    """Measure the processor time of each run after a warm-up run."""
    return measure_seconds(run, repeats, time.process_time)


def measure_seconds(run: Callable[[], object], repeats: int, clock: Callable[[], float]) -> list[float]:
    """Measure the time of each run after a warm-up run."""
    run()
    return [elapsed_seconds(run, clock) for _ in range(repeats)]


def elapsed_seconds(run: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """Measure the time of one run."""
    start = clock()
    run()
    return clock() - start


def case_runner() -> Callable[[Campaign], None]:
    """Return a function that runs the next case of a campaign, which no earlier call has run."""
    case_numbers = itertools.count()

    def run_next(campaign: Campaign) -> None:
        case = next(case_numbers)
        campaign.scenario.run(campaign.parameters(case), campaign.streams(case))

    return run_next
