"""Changes of one dispersion: weights of the stored cases, and sizes in declared standard deviations.

Each random dispersion is a function of a standard normal variable z (`marsyard.campaigns.sampling.study_points`). A
change replaces the distribution of z; the distribution of all other random numbers, given this one, stays as declared:

- mean up, mean down: N(d, 1) and N(-d, 1). A normal dispersion is shifted by d standard deviations; the values of a
  bounded one stay within its range, where cases exist, so that its mean moves less.
- wider, narrower: N(0, s^2). The standard deviation of a normal dispersion is multiplied by s, that of a bounded one
  changes less.
- more frequent: the probability P of a value of `choice` becomes P + a (1 - P).

Sizes are those of mean, standard deviation or probability themselves, computed by quadrature over z.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.special import ndtr, ndtri

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.parameter_paths import value_at
from marsyard.campaigns.sampling.correlation import MAX_DRAW, MIN_DRAW
from marsyard.campaigns.sampling.dispersions import Choice
from marsyard.reports.statistics.reweighted_rates import MIN_EFFECTIVE, Changes

#: Number of evaluated sizes of a change; between them, rates are interpolated.
_STEPS = 41
#: Nodes of the quadrature of means and standard deviations of dispersions: standard normal numbers up to `MAX_DRAW`.
_NODES = np.linspace(-8.2, 8.2, 1641)
_DENSITY = np.exp(-0.5 * _NODES**2) / np.exp(-0.5 * _NODES**2).sum()
#: Nodes beyond this number are the tails, and maximum fraction of a variance in them; beyond it, it can be infinite.
_TAIL_NODE, _MAX_TAIL_FRACTION = 7.0, 0.01


class ChangeKind(StrEnum):
    """Kind of a change, see above.

    DIVERGENCE: any change of all dispersions at once, by its Kullback-Leibler divergence
    (`marsyard.reports.robustness_evaluation`). VALUE: another value of a parameter that the campaign does not disperse.
    """

    MEAN_UP = "mean up"
    MEAN_DOWN = "mean down"
    WIDER = "wider"
    NARROWER = "narrower"
    MORE_FREQUENT = "more frequent"
    DIVERGENCE = "divergence"
    VALUE = "value"


@dataclass(frozen=True)
class Change:
    """Changes of one kind: sizes in assumed spreads, from 0, and the weights of the cases.

    - efficiency: expected effective number of cases per case; that of a sample is too large for heavy-tailed weights
    - max_weights: largest possible weight; 0 if it is infinite
    - value: index of the value of `choice`
    """

    kind: ChangeKind
    sizes: Changes
    weights: Float64[np.ndarray, "changes n"]
    efficiency: Changes
    max_weights: Changes | float = 0.0
    value: int = 0


def draw_coordinates(
    campaign: Campaign, cases: Float64[np.ndarray, " n"] | Any
) -> Float64[np.ndarray, "n dispersions"]:
    """Compute the standard normal variables of the random dispersions of cases, after the correlation of groups."""
    draws = (campaign.probabilities(int(case)) or {} for case in cases)
    uniform = np.array([[values[path] for path in campaign.drawn_paths] for values in draws])
    return np.asarray(ndtri(np.clip(uniform, MIN_DRAW, MAX_DRAW)))


@dataclass(frozen=True)
class DispersedQuantity:
    """A dispersion with its values at `_NODES`; empty for values without numbers (`choice`).

    is_absolute: whether mean and standard deviation are the same for all cases (no formula)
    """

    dispersion: Any
    values: Float64[np.ndarray, " _"]
    is_absolute: bool

    @classmethod
    def of(cls, campaign: Campaign, path: str, case: int) -> DispersedQuantity:
        """Create the quantity of a path. Formulas are evaluated for one case: relative sizes depend on it little."""
        dispersion = campaign.marginals[path]
        if isinstance(dispersion, Choice):
            return cls(dispersion, np.empty(0), is_absolute=True)
        drawn = campaign.draws(case) if dispersion.names else {}
        inputs = {
            name: drawn[name] if name in drawn else value_at(campaign.definition.parameters, name)
            for name in dispersion.names
        }
        distribution = dispersion.insert_values(inputs)
        draws = np.clip(ndtr(_NODES), MIN_DRAW, MAX_DRAW).tolist()
        values = np.array([float(distribution.quantile(draw)) for draw in draws])
        return cls(dispersion, values, not dispersion.names)

    def moments(self, shift: float, scale: float) -> tuple[float, float]:
        """Compute mean and standard deviation for z from N(shift, scale^2); NaN if they can be infinite."""
        values = np.interp(shift + scale * _NODES, _NODES, self.values)
        mean = float(_DENSITY @ values)
        squares = _DENSITY * (values - mean) ** 2
        variance = float(squares.sum())
        in_tails = float(squares[np.abs(_NODES) > _TAIL_NODE].sum())
        return (mean, math.sqrt(variance)) if in_tails <= _MAX_TAIL_FRACTION * variance else (math.nan, math.nan)

    @cached_property
    def declared(self) -> tuple[float, float]:
        """Mean and standard deviation without a change."""
        return self.moments(0.0, 1.0)

    def sizes(self, change: Change) -> Changes | None:
        """Convert sizes of a change of z to changes of mean or standard deviation, in declared standard deviations.

        Unchanged if these can be infinite; None if the change of z does not change them.
        """
        if not self.values.size:
            return change.sizes
        mean, deviation = self.declared
        moves_mean = change.kind in (ChangeKind.MEAN_UP, ChangeKind.MEAN_DOWN)
        signed = change.sizes * sign_of(change.kind)
        moments = np.array(
            [self.moments(size, 1.0) if moves_mean else self.moments(0.0, 1.0 + size) for size in signed]
        )
        sizes = np.abs(moments[:, 0] - mean if moves_mean else moments[:, 1] - deviation)
        if np.isnan(sizes).any():
            return change.sizes
        return sizes / deviation if (np.diff(sizes) > 0.0).all() else None


def sign_of(kind: ChangeKind) -> float:
    """Return the sign of a change of mean, standard deviation or probability."""
    return -1.0 if kind in (ChangeKind.MEAN_DOWN, ChangeKind.NARROWER) else 1.0


def list_changes(dispersion: Any, z: Float64[np.ndarray, " n"]) -> Iterator[Change]:
    """List the changes of a dispersion with the standard normal variables z of the cases.

    Changes of mean and standard deviation end where the expected number of effective cases is 30; those of a value of
    `choice` end at the probability 1.
    """
    steps, fraction = np.linspace(0.0, 1.0, _STEPS), MIN_EFFECTIVE / z.size
    if fraction >= 1.0:
        return
    if isinstance(dispersion, Choice):
        limits = np.cumsum(dispersion.weights or np.ones(len(dispersion.values)))
        indices = np.minimum(np.searchsorted(limits / limits[-1], ndtr(z), side="right"), limits.size - 1)
        for index, probability in enumerate(np.diff(limits, prepend=0.0) / limits[-1] if limits.size > 1 else ()):
            others, ratio = 1.0 - steps, steps / probability
            weights = others[:, None] + ratio[:, None] * (indices == index)
            # E w^2 = (1 - a)^2 + 2 a (1 - a) + a^2 / P
            efficiency = 1.0 / (1.0 - steps**2 + steps**2 / probability)
            sizes = steps * math.sqrt((1.0 - probability) / probability)
            yield Change(ChangeKind.MORE_FREQUENT, sizes, weights, efficiency, others + ratio, index)
        return
    shifts = steps * math.sqrt(-math.log(fraction))
    for kind, sign in ((ChangeKind.MEAN_UP, 1.0), (ChangeKind.MEAN_DOWN, -1.0)):
        weights = np.exp(sign * shifts[:, None] * z - 0.5 * shifts[:, None] ** 2)
        yield Change(kind, shifts, weights, np.exp(-(shifts**2)))
    # E w^2 = 1 / (s sqrt(2 - s^2)), infinite from s^2 = 2
    root = math.sqrt(1.0 - fraction**2)
    for kind, limit in ((ChangeKind.WIDER, math.sqrt(1.0 + root)), (ChangeKind.NARROWER, math.sqrt(1.0 - root))):
        scales = 1.0 + steps * (limit - 1.0)
        weights = np.exp(0.5 * z**2 * (1.0 - scales[:, None] ** -2)) / scales[:, None]
        yield Change(kind, np.abs(scales - 1.0), weights, scales * np.sqrt(np.maximum(2.0 - scales**2, 0.0)))
