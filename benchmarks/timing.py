"""Figures of a benchmark, and how they are taken."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """Some measurements of one quantity.

    Attributes
    ----------
    name
        What was measured.
    values
        Each measurement; core-seconds unless the name says otherwise.
    bar
        What the median must not exceed; None where nothing is asked.
    least
        What the median must reach; None where nothing is asked.
    """

    name: str
    values: list[float]
    bar: float | None = None
    least: float | None = None

    @property
    def median(self) -> float:
        """The figure to quote."""
        return statistics.median(self.values)

    @property
    def asked(self) -> str:
        """The bar as text."""
        if self.bar is not None:
            return f"<= {self.bar:g}"
        return f">= {self.least:g}" if self.least is not None else ""

    @property
    def met(self) -> bool:
        """Whether the median keeps the bar."""
        return (self.bar is None or self.median <= self.bar) and (self.least is None or self.median >= self.least)


def core_seconds(run: Callable[[], object], repeats: int) -> list[float]:
    """Processor time of each of some runs, after one that is not counted."""
    run()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return times
