"""Fit of the boundary between passed and failed cases over two conditions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from marsyard.reports import rates

#: Number of folds of the cross-validation, and of bins of the calibration.
FOLDS, CALIBRATION_BINS = 5, 5


#: Number of knots of the spline functions.
_KNOTS = 4


#: Maximum calibration error of a fit that is drawn.
MAX_CALIBRATION_ERROR = 0.1


@dataclass(frozen=True)
class BoundaryFit:
    """Fit of the probability of a violation over two conditions, with its cross-validation.

    - conditions: columns of the two conditions; cases, violations: numbers of cases with both conditions
    - skill, skill_lower: Brier skill score: 1 - (mean square error of the predictions) / (that of the violation rate),
      and its one-sided lower bound at 95 % (bootstrap over terrains)
    - calibration_error: mean |predicted probability - violation rate| over bins with equal numbers of cases
    """

    conditions: tuple[str, str]
    cases: int
    violations: int
    skill: float
    skill_lower: float
    calibration_error: float

    @property
    def is_good(self) -> bool:
        """Whether the fit predicts better than the violation rate, with calibrated probabilities."""
        return self.skill_lower > 0.0 and self.calibration_error <= MAX_CALIBRATION_ERROR


def validate_fit(
    values: Float[np.ndarray, "n 2"],
    is_violation: Bool[np.ndarray, " n"],
    groups: Int[np.ndarray, " n"],
    conditions: tuple[str, str],
) -> BoundaryFit:
    """Cross-validate the fit over groups of cases (terrains)."""
    from sklearn.model_selection import GroupKFold  # imported here: slow, and few reports have a boundary

    target = is_violation.astype(np.float64)
    predicted, base_rate = np.empty(target.size), np.empty(target.size)
    for train, test in GroupKFold(FOLDS).split(values, groups=groups):
        base_rate[test] = target[train].mean()
        has_both_classes = 0.0 < target[train].mean() < 1.0
        predicted[test] = (
            fit_probability(values[train], is_violation[train])(values[test])
            if has_both_classes
            else target[train].mean()
        )
    losses, base_losses = (predicted - target) ** 2, (base_rate - target) ** 2
    weights = rates.bootstrap_weights(np.unique(groups, return_inverse=True)[1], np.random.default_rng(0))
    skills = 1.0 - (weights @ losses) / (weights @ base_losses)
    bins = np.array_split(np.argsort(predicted, kind="stable"), CALIBRATION_BINS)
    calibration_error = float(np.mean([abs(predicted[cases].mean() - target[cases].mean()) for cases in bins]))
    return BoundaryFit(
        conditions,
        target.size,
        int(is_violation.sum()),
        float(skills[0]),
        float(np.quantile(skills[1:], 0.05)),
        calibration_error,
    )


def fit_probability(values: Float[np.ndarray, "n 2"], is_violation: Bool[np.ndarray, " n"]) -> Any:
    """Fit a logistic regression on products of spline functions; return the function of the violation's probability."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, QuantileTransformer, SplineTransformer

    model = make_pipeline(
        QuantileTransformer(n_quantiles=min(100, len(values)), random_state=0),
        SplineTransformer(n_knots=_KNOTS, degree=2, include_bias=False),
        PolynomialFeatures(2, interaction_only=True, include_bias=False),
        LogisticRegression(C=1.0, max_iter=1000),
    )
    model.fit(values, is_violation)
    return lambda points: model.predict_proba(points)[:, 1]
