"""Figures of a benchmark and their measurement."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Measurement:
    """Measurements of one quantity in core-seconds, unless its name states another unit, and bounds of their median."""

    name: str
    values: list[float]
    limit: float | None = None
    minimum: float | None = None

    @property
    def median(self) -> float:
        """Median of the measurements."""
        return statistics.median(self.values)

    @property
    def limit_text(self) -> str:
        """The bound as text."""
        if self.limit is not None:
            return f"<= {self.limit:g}"
        return f">= {self.minimum:g}" if self.minimum is not None else ""

    @property
    def is_within_limit(self) -> bool:
        """Whether the median is within the bounds."""
        return (self.limit is None or self.median <= self.limit) and (
            self.minimum is None or self.median >= self.minimum
        )


def core_seconds(run: Callable[[], object], repeats: int) -> list[float]:
    """Processor time of each run after a warm-up run."""
    run()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return times
