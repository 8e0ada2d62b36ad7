"""What a check hands back: a claim, its bar and the figure measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Measure:
    """One row of the validation.

    Attributes
    ----------
    claim
        What is held.
    measured, unit
        The figure, and what it is counted in; "" for a share.
    bar, sense
        The figure that it has to keep to, None where it is reported and not judged; and on which side of it.
    how
        How it was measured, short.
    """

    claim: str
    measured: float
    unit: str
    bar: float | None
    how: str
    sense: Literal["at most", "at least"] = "at most"

    @property
    def passed(self) -> bool:
        """Whether the bar is kept; what is not judged is."""
        if self.bar is None:
            return True
        # written so that NaN misses every bar
        return self.measured <= self.bar if self.sense == "at most" else self.measured >= self.bar


@dataclass(frozen=True)
class Check:
    """Measurements made together.

    Attributes
    ----------
    name
        What the command line calls it.
    section
        Heading in the document under which its rows stand.
    run
        Makes the measurements; its argument selects few samples (with the same bars).
    """

    name: str
    section: str
    run: Callable[[bool], Iterator[Measure]]
