"""Components that instruments share: sampling times, time tags, readings and time-correlated errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy  # scipy.signal is slow to import: it is loaded at its first use
from jaxtyping import Float64
from numpy.random import Generator
from pydantic import Field
from scipy.interpolate import make_interp_spline

from marsyard.sim.error_sources import TIME_TAGS
from marsyard.sim.parameters import Parameters

#: Knots per correlation time. Linear interpolation between knots reduces the variance by at most 1 %.
KNOTS_PER_CORRELATION = 50
#: Maximum error of a time tag in standard deviations: 2e-9 of the tags have a larger one.
MAX_TAG_DEVIATIONS = 6.0
_Deviation = Annotated[float, Field(ge=0.0, le=10.0)]
Times = Float64[np.ndarray, "n"]  #: One time per row, seconds.
Vector = Float64[np.ndarray, "3"]
Vectors = Float64[np.ndarray, "n 3"]  #: One vector per row.


@dataclass(frozen=True)
class Readings:
    """Ranges of an altimeter, metres, with time tags; NaN marks a missing reading."""

    times_s: Times
    values: Float64[np.ndarray, "n"]


@dataclass(frozen=True)
class Sampling:
    """Periodic sampling at a rate; `phase_s` is the true time of one sample."""

    rate_hz: float
    phase_s: float

    @classmethod
    def draw(cls, rate_hz: float, rng: Generator) -> Sampling:
        """Draw a uniformly distributed phase."""
        return cls(rate_hz, float(rng.random()) / rate_hz)

    def within(self, start_s: float, end_s: float) -> Times:
        """Return the true times of all samples from start to end."""
        first = np.ceil((start_s - self.phase_s) * self.rate_hz)
        last = np.floor((end_s - self.phase_s) * self.rate_hz)
        return np.asarray(self.phase_s + np.arange(first, last + 1.0) / self.rate_hz)

    def latest(self, times_s: Times) -> Times:
        """Return the true time of the last sample at or before each time."""
        return np.asarray(self.phase_s + np.floor((times_s - self.phase_s) * self.rate_hz) / self.rate_hz)


class ClockParameters(Parameters):
    """Errors of time tags: tag minus true time."""

    offset_s: Annotated[float, TIME_TAGS, Field(ge=-10.0, le=10.0, description="mean of the constant offset, s")] = 0.0
    offset_sd_s: Annotated[_Deviation, TIME_TAGS, Field(description="sd of the constant offset between units, s")] = 0.0
    jitter_sd_s: Annotated[_Deviation, TIME_TAGS, Field(description="sd of the random part of each tag, s")] = 0.0

    @property
    def max_error_s(self) -> float:
        """Largest error of a time tag, with `MAX_TAG_DEVIATIONS` standard deviations, s."""
        return abs(self.offset_s) + MAX_TAG_DEVIATIONS * float(np.hypot(self.offset_sd_s, self.jitter_sd_s))


@dataclass(frozen=True)
class Clock:
    """An instrument's clock; `offset_s` is the constant part of tag minus true time."""

    parameters: ClockParameters
    offset_s: float

    @classmethod
    def draw(cls, parameters: ClockParameters, rng: Generator) -> Clock:
        """Draw the constant offset."""
        return cls(parameters, parameters.offset_s + parameters.offset_sd_s * float(rng.standard_normal()))

    def tags(self, times_s: Times, rng: Generator) -> Times:
        """Return the time tags of events at true times."""
        jitter = self.parameters.jitter_sd_s * rng.standard_normal(times_s.size)
        return np.asarray(times_s + self.offset_s + jitter)


@dataclass(frozen=True)
class GaussMarkov:
    """A stationary first-order Gauss-Markov process with zero mean, one column per channel; linear between knots."""

    knots_s: Float64[np.ndarray, "knots"]
    values: Float64[np.ndarray, "knots channels"]

    @classmethod
    def draw(
        cls, sd: Float64[np.ndarray, "channels"], correlation_s: float, span_s: tuple[float, float], rng: Generator
    ) -> GaussMarkov:
        """Draw a realisation with these standard deviations. Raises ValueError for an invalid span."""
        first, last = span_s
        if not (np.isfinite(first) and np.isfinite(last) and first <= last):
            raise ValueError(f"the time span {first} s to {last} s is not valid; a finite span is needed")
        step = correlation_s / KNOTS_PER_CORRELATION
        count = int(np.ceil((last - first) / step)) + 2
        decay = np.exp(-step / correlation_s)
        innovations = rng.standard_normal((count, sd.size))
        innovations[1:] *= np.sqrt(1.0 - decay**2)
        values = scipy.signal.lfilter([1.0], [1.0, -decay], innovations, axis=0)
        return cls(first + step * np.arange(count), sd * values)

    def at(self, times_s: Times) -> Float64[np.ndarray, "n channels"]:
        """Interpolate the process. Raises ValueError if a time is outside the span."""
        if times_s.size and (times_s.min() < self.knots_s[0] or times_s.max() > self.knots_s[-1]):
            raise ValueError(
                f"requested times {times_s.min():.3f} s to {times_s.max():.3f} s are outside the sampled errors, "
                f"{self.knots_s[0]:.3f} s to {self.knots_s[-1]:.3f} s"
            )
        return np.asarray(make_interp_spline(self.knots_s, self.values, k=1)(times_s))
