"""Kullback-Leibler divergence of failure rates."""

from __future__ import annotations

import math

from scipy.special import rel_entr


def binary_divergence(rate: float, reference: float) -> float:
    """Compute the Kullback-Leibler divergence of two binary distributions, rate > reference; 0 for other rates."""
    if math.isnan(reference):
        return math.nan
    return 0.0 if rate <= reference else float(rel_entr(rate, reference) + rel_entr(1.0 - rate, 1.0 - reference))


def population_divergence(rate: float, reference: float, member_rate: float) -> float:
    """Compute the smallest divergence of the distribution of all cases that changes the failure rate of a population.

    - rate, reference: failure rates in the population after and before the change
    - member_rate: fraction of all cases that belong to the population, before the change
    """
    divergence = binary_divergence(rate, reference)
    is_bounded = math.isfinite(divergence) and member_rate < 1.0
    return -math.log1p(member_rate * math.expm1(-divergence)) if is_bounded else divergence
