"""Failure boundary over two conditions: where a case of a campaign becomes likely to violate a requirement.

For each pair of the most influential conditions, the probability that a case violates a requirement is fitted by a
logistic regression on spline functions (scikit-learn). The fit is validated by its predictions for terrains that were
not used for it, and drawn only if they are good.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure

from marsyard.reports import rates
from marsyard.reports.column_selection import distinct_columns
from marsyard.reports.column_values import numbers
from marsyard.reports.conditions import CONDITIONS
from marsyard.reports.decision import requirement_masks
from marsyard.reports.effects import rank_drivers
from marsyard.reports.figure_style import INK, REQUIREMENT, in_page_style, new_axes
from marsyard.reports.section import Block, Grid, Section, Subject, svg_figure
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import label, note_text, number

#: Minimum number of violations, and of other cases, of a requirement.
MIN_CASES_PER_CLASS = 20
#: Maximum number of cases of a fit: the first ones.
_MAX_CASES = 5000
#: Maximum number of conditions, and maximum corrected p-value of a condition.
_MAX_CONDITIONS, _MAX_P_VALUE = 4, 0.05
#: Number of folds of the cross-validation, and of bins of the calibration.
FOLDS, CALIBRATION_BINS = 5, 5
#: Number of knots of the spline functions.
_KNOTS = 4
#: Maximum calibration error of a fit that is drawn.
MAX_CALIBRATION_ERROR = 0.1
#: Fixed seed of the bootstrap, for reproducible reports.
_SEED = 0
#: Number of grid points of the figure along each axis, and quantiles of the conditions between which they lie.
_GRID_POINTS, _DRAWN_QUANTILES = 41, (0.01, 0.99)


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
        predicted[test] = base_rate[test]
        if 0.0 < target[train].mean() < 1.0:
            predicted[test] = fit_probability(values[train], is_violation[train])(values[test])
    losses, base_losses = (predicted - target) ** 2, (base_rate - target) ** 2
    weights = rates.bootstrap_weights(np.unique(groups, return_inverse=True)[1], np.random.default_rng(_SEED))
    skills = 1.0 - (weights @ losses) / (weights @ base_losses)
    bins = np.array_split(np.argsort(predicted, kind="stable"), CALIBRATION_BINS)
    calibration_error = float(np.mean([abs(predicted[cases].mean() - target[cases].mean()) for cases in bins]))
    skill, skill_lower = float(skills[0]), float(np.quantile(skills[1:], 0.05))
    return BoundaryFit(conditions, target.size, int(is_violation.sum()), skill, skill_lower, calibration_error)


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


def boundary_section(subject: Subject) -> Section | None:
    """Create the section of the failure boundaries; None without enough violations or conditions."""
    blocks: list[Block] = []
    data: dict[str, Any] = {}
    columns = list_conditions(subject.run)
    for requirement in subject.run.requirements:
        name = str(requirement.get("id"))
        drawn_fits = _fit_requirement(subject.frame.head(_MAX_CASES), requirement, columns)
        fits = [fit for fit, _ in drawn_fits]
        if not fits:
            continue
        rows = []
        for fit in fits:
            counts = [" and ".join(map(label, fit.conditions)), f"{fit.cases:,}", f"{fit.violations:,}"]
            measures = map(number, (fit.skill, fit.skill_lower, fit.calibration_error))
            rows.append([*counts, *measures, "yes" if fit.is_good else "no"])
        head = ["Conditions", "Cases", "Violations", "Brier skill", "Lower bound (95 %)", "Calibration error", "Figure"]
        good_fits = [(fit, figure) for fit, figure in drawn_fits if figure is not None]
        svg_figures = [
            svg_figure(
                figure,
                f"boundary-{len(blocks)}-{index}",
                f"Probability that a case violates {name}, by {' and '.join(map(label, fit.conditions))}; the other "
                "conditions vary as in the campaign. Shading and contours: fitted probability; crosses: violations.",
            )
            for index, (fit, figure) in enumerate(good_fits)
        ]
        blocks.append(Block(f"Violations of {name}", figures=svg_figures, grid=Grid(head, rows)))
        data[name] = [asdict(fit) | {"drawn": fit.is_good} for fit in fits]
    if not blocks:
        return None
    note = note_text(
        "common.boundary", conditions=_MAX_CONDITIONS, bins=CALIBRATION_BINS, max_error=f"{MAX_CALIBRATION_ERROR:g}"
    )
    return Section("boundary", "Failure boundary", "Failure boundary", [*blocks, Block(note=note)], data)


def list_conditions(run: StoredRun) -> list[str]:
    """List the columns of the dispersed parameters and of the measured conditions of a campaign; not the terrain."""
    frame = run.frame
    measured = [name for name in map(str, frame.columns) if name.startswith(CONDITIONS) and run.is_condition(name)]
    dispersed = [path for path in run.dispersed_paths if path in frame and not path.endswith("terrain")]
    names = distinct_columns(frame, [*dict.fromkeys((*dispersed, *measured))])
    return [name for name in names if pd.api.types.is_numeric_dtype(frame[name]) and frame[name].nunique() > 2]


def _fit_requirement(
    frame: pd.DataFrame, requirement: Mapping[str, Any], columns: Sequence[str]
) -> list[tuple[BoundaryFit, Figure | None]]:
    """Fit the violations of a requirement over each pair of conditions, with a figure of each good fit."""
    masks = requirement_masks(frame, requirement)
    if masks is None:
        return []
    member, success = masks
    rows, is_violation = frame[member].reset_index(drop=True), ~success[member]
    if not _has_enough_cases(is_violation):
        return []
    drivers = rank_drivers(rows, columns, is_violation.astype(np.float64))
    conditions = [column for column, _, p_value in drivers if p_value <= _MAX_P_VALUE][:_MAX_CONDITIONS]
    terrains = rates.terrain_groups(rows)
    fits: list[tuple[BoundaryFit, Figure | None]] = []
    for pair in itertools.combinations(conditions, 2):
        values = np.stack([numbers(rows, column) for column in pair], axis=1)
        is_known = np.isfinite(values).all(axis=1)
        values, known_violations = values[is_known], is_violation[is_known]
        if _has_enough_cases(known_violations):
            groups = _validation_groups(None if terrains is None else terrains[is_known], len(values))
            fit = validate_fit(values, known_violations, groups, pair)
            fits.append((fit, _draw_boundary(values, known_violations, pair) if fit.is_good else None))
    return fits


def _validation_groups(terrains: Int[np.ndarray, " n"] | None, cases: int) -> Int[np.ndarray, " n"]:
    """Return the groups that the cross-validation keeps together: terrains, or cases if there are few terrains."""
    return np.arange(cases) if terrains is None or np.unique(terrains).size < 2 * FOLDS else terrains


def _has_enough_cases(is_violation: Bool[np.ndarray, " n"]) -> bool:
    return min(int(is_violation.sum()), int((~is_violation).sum())) >= MIN_CASES_PER_CLASS


@in_page_style
def _draw_boundary(
    values: Float[np.ndarray, "n 2"], is_violation: Bool[np.ndarray, " n"], conditions: Sequence[str]
) -> Figure:
    """Draw the fitted probability as grey levels with contours, and the violations."""
    probability = fit_probability(values, is_violation)
    low, high = np.quantile(values, _DRAWN_QUANTILES, axis=0)
    axes_values = np.linspace(low, high, _GRID_POINTS).T
    x, y = np.meshgrid(*axes_values)
    levels = probability(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
    figure, axes = new_axes(4.6, 3.6)
    filled = axes.contourf(x, y, levels, levels=np.linspace(0.0, 1.0, 11), cmap="Blues", alpha=0.85)
    lines = axes.contour(x, y, levels, levels=[0.01, 0.05, 0.1, 0.25, 0.5, 0.75], colors=INK, linewidths=0.8)
    axes.clabel(lines, fmt=lambda level: f"{level:g}", fontsize=7)
    axes.plot(*values[is_violation].T, linestyle="none", marker="x", color=REQUIREMENT, markersize=4)
    axes.set(xlabel=label(conditions[0]), ylabel=label(conditions[1]))
    axes.set(xlim=axes_values[0][[0, -1]], ylim=axes_values[1][[0, -1]])
    figure.colorbar(filled, ax=axes, label="probability of a violation")
    return figure
