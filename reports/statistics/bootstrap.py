"""The BCa bootstrap, widened for small samples.

Efron, "Better bootstrap confidence intervals" (J. Amer. Statist. Assoc. 82, 1987) as SciPy has it, at the level of
Student's t instead of the normal distribution (Hesterberg, "What teachers should know about the bootstrap", Amer.
Statist. 69, 2015): in small samples BCa alone covers too little.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from marsyard.reports.statistics.proportions import Interval

#: Above this many values (or terrains) the bootstrap's interval equals the large-sample one in what is printed.
LARGEST_SAMPLE = 2000
_RESAMPLES = 2000
#: A report draws from a fixed seed: the same rows give the same page.
_SEED = 19340401


def bca(data: Sequence[Float[np.ndarray, " n"]], statistic: Callable[..., Any], confidence: float) -> Interval:
    """Two-sided interval of a statistic of one or more columns, drawn together; NaN where it cannot be told."""
    with warnings.catch_warnings():
        # A degenerate bootstrap distribution (two values, say) is answered by NaN bounds, which the caller prints.
        warnings.simplefilter("ignore")
        result = stats.bootstrap(
            tuple(data),
            statistic,
            paired=True,
            confidence_level=_widened(confidence, data[0].size),
            n_resamples=_RESAMPLES,
            batch=200,
            vectorized=True,
            method="BCa",
            rng=np.random.default_rng(_SEED),
        )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _widened(confidence: float, n: int) -> float:
    """The level at which the normal quantile is Student's, times sqrt(n / (n - 1)): Hesterberg 2015, section 5."""
    quantile = float(stats.t.ppf(0.5 * (1.0 + confidence), n - 1)) * math.sqrt(n / (n - 1.0))
    # below 1, which the bootstrap does not take
    return min(2.0 * float(stats.norm.cdf(quantile)) - 1.0, 1.0 - 1e-6)
