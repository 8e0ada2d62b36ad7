"""Errors that wander: first-order Gauss-Markov processes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its signal is slow to import, and so left until it is called
from jaxtyping import Float64
from scipy.interpolate import make_interp_spline

#: Knots per correlation time. Straight lines between them lose at most 1 % of the variance, half-way between two.
KNOTS_PER_CORRELATION = 50


@dataclass(frozen=True)
class GaussMarkov:
    """One realisation of exponentially correlated errors, stationary, of mean 0; linear between its knots.

    Attributes
    ----------
    knots_s
        Times of the knots, seconds.
    values
        One row for each knot, one column for each independent channel.
    """

    knots_s: Float64[np.ndarray, "knots"]
    values: Float64[np.ndarray, "knots channels"]

    @classmethod
    def drawn(
        cls,
        sd: Float64[np.ndarray, "channels"],
        correlation_s: float,
        span_s: tuple[float, float],
        rng: np.random.Generator,
    ) -> GaussMarkov:
        """A realisation over a span of time, given each channel's standard deviation and the correlation time.

        Raises
        ------
        ValueError
            If the span is not finite or runs backwards.
        """
        first, last = span_s
        if not (np.isfinite(first) and np.isfinite(last) and first <= last):
            raise ValueError(f"a process cannot be drawn from {first} s to {last} s; a finite span is needed")
        step = correlation_s / KNOTS_PER_CORRELATION
        count = int(np.ceil((last - first) / step)) + 2
        kept = np.exp(-step / correlation_s)
        innovations = rng.standard_normal((count, sd.size))
        innovations[1:] *= np.sqrt(1.0 - kept**2)
        values: Float64[np.ndarray, "knots channels"] = sd * scipy.signal.lfilter(
            [1.0], [1.0, -kept], innovations, axis=0
        )
        return cls(first + step * np.arange(count), values)

    def at(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n channels"]:
        """Errors at these times.

        Raises
        ------
        ValueError
            If a time lies outside of the span that was drawn.
        """
        if times_s.size and (times_s.min() < self.knots_s[0] or times_s.max() > self.knots_s[-1]):
            raise ValueError(
                f"errors are asked for from {times_s.min():.3f} s to {times_s.max():.3f} s; they were drawn from "
                f"{self.knots_s[0]:.3f} s to {self.knots_s[-1]:.3f} s"
            )
        return np.asarray(make_interp_spline(self.knots_s, self.values, k=1)(times_s))
