"""Results of a benchmark with their limits, and the measurement of processor time."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


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
    run()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return times
