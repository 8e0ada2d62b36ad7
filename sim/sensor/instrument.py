"""What altimeters and position receivers have in common: readings at a rate and with time tags of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from marsyard.sim.dynamics import Trajectory


@dataclass(frozen=True)
class Readings:
    """What an instrument delivers.

    Attributes
    ----------
    times_s
        Time tags, seconds.
    values
        One row for each reading: a range (altimeters, metres) or a position (receivers, metres, world axes, three
        columns). Not a number where the instrument had nothing to deliver.
    """

    times_s: Float64[np.ndarray, "n"]
    values: Float64[np.ndarray, "n *quantity"]


@runtime_checkable
class Instrument(Protocol):
    """An instrument with its constant errors drawn, that reads a motion at given true times."""

    @property
    def sampling(self) -> Sampling:
        """When it reads."""
        ...

    def measure(self, trajectory: Trajectory, times_s: Float64[np.ndarray, "n"], rng: np.random.Generator) -> Readings:
        """One reading at each true time; `rng` gives its noise."""
        ...


@dataclass(frozen=True)
class Sampling:
    """When an instrument reads: every 1 / rate seconds, at a phase of its own.

    Attributes
    ----------
    rate_hz
        Readings per second.
    phase_s
        True time of a reading, seconds.
    """

    rate_hz: float
    phase_s: float

    @classmethod
    def drawn(cls, rate_hz: float, rng: np.random.Generator) -> Sampling:
        """Readings at a rate, their phase drawn evenly."""
        return cls(rate_hz, float(rng.random()) / rate_hz)

    def within(self, start_s: float, end_s: float) -> Float64[np.ndarray, "n"]:
        """True times of all readings from a start to an end, seconds."""
        first = np.ceil((start_s - self.phase_s) * self.rate_hz)
        last = np.floor((end_s - self.phase_s) * self.rate_hz)
        return np.asarray(self.phase_s + np.arange(first, last + 1.0) / self.rate_hz)

    def latest(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
        """True time of the last reading at or before each time, seconds."""
        return np.asarray(self.phase_s + np.floor((times_s - self.phase_s) * self.rate_hz) / self.rate_hz)
