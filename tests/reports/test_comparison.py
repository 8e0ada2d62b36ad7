"""Tests of paired comparisons of algorithms and of the consistency of covariances."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from marsyard.reports.common_sections import evaluate_consistencies, evaluate_consistency
from marsyard.reports.comparison import compare_algorithms, select_algorithm


def make_paired_rows(first_errors: list[float], other_errors: list[float]) -> pd.DataFrame:
    """Return rows of the algorithm `dimes` and the compared algorithm `other`; NaN denotes a crash."""
    frame: dict[str, Any] = {"case": range(len(first_errors)), "algorithm": "dimes", "velocity_error_m_s": first_errors}
    for prefix, errors in (("", first_errors), ("other.", other_errors)):
        is_answered = np.isfinite(errors)
        frame[f"{prefix}outcome"] = np.where(is_answered, "VALID", "CRASHED")
        frame[f"{prefix}answered"] = is_answered
    return pd.DataFrame({**frame, "other.velocity_error_m_s": other_errors, "altitude_m": 1.0})


def test_paired_comparison_averages_the_cases_that_both_algorithms_answer() -> None:
    nan = float("nan")
    algorithms, (difference,) = compare_algorithms(
        make_paired_rows([1, 2, 3, 9], [2, 3, nan, 4]), "velocity_error_m_s", 5.0
    )
    assert [
        (algorithm.name, algorithm.answered, algorithm.failed, algorithm.succeeded) for algorithm in algorithms
    ] == [("dimes", 4, 0, 3), ("other", 3, 1, 3)]
    assert (difference.only_first, difference.only_other, difference.pairs) == (1, 1, 3)
    assert difference.mean == pytest.approx((1 + 1 - 5) / 3)


@pytest.mark.slow
def test_p_values_are_corrected_for_the_number_of_algorithms() -> None:
    frame = make_paired_rows([1.0] * 12, [2.0] * 12)
    third = frame.filter(like="other.").rename(columns=lambda name: name.replace("other.", "third."))
    (pair,) = compare_algorithms(frame, "velocity_error_m_s", 1.5)[1]
    triple = compare_algorithms(pd.concat([frame, third], axis=1), "velocity_error_m_s", 1.5)[1]
    assert [difference.success_p for difference in triple] == pytest.approx([2.0 * pair.success_p] * 2)
    assert [difference.error_p for difference in triple] == pytest.approx([2.0 * pair.error_p] * 2)


def test_single_algorithm_gives_no_comparison() -> None:
    frame = make_paired_rows([1, 2], [1, 2])[["case", "algorithm", "outcome", "answered", "velocity_error_m_s"]]
    assert compare_algorithms(frame, "velocity_error_m_s", 5.0) == ([], [])


def test_columns_of_a_compared_algorithm_are_selected() -> None:
    other_rows = select_algorithm(make_paired_rows([1, 2], [3, 4]), "other")
    assert other_rows["velocity_error_m_s"].tolist() == [3, 4]
    assert other_rows["altitude_m"].tolist() == [1.0, 1.0]
    assert not any("." in str(name) for name in other_rows.columns)


def test_correct_covariances_are_consistent_at_95_percent() -> None:
    rng = np.random.default_rng(7)
    verdicts = [evaluate_consistency(stats.chi2.rvs(2, size=50, random_state=rng))["word"] for _ in range(400)]
    # 0.95, minus 4 and plus 3 standard deviations of 1.1 %
    assert 0.91 <= verdicts.count("consistent") / 400 <= 0.985
    overconfident = evaluate_consistency(stats.chi2.rvs(2, size=50, random_state=rng) * 4.0)
    assert overconfident["word"] == "optimistic"
    assert evaluate_consistency(stats.chi2.rvs(2, size=50, random_state=rng) / 4.0)["word"] == "pessimistic"


@pytest.mark.parametrize("column", ["velocity_nees", "position_nees"])
def test_consistency_covers_all_algorithms_with_covariances(column: str) -> None:
    frame = make_paired_rows([1, 2, 3], [3, 4, 5]).assign(**{f"other.{column}": [2.0, 2.0, np.nan]})
    ((name, values),) = evaluate_consistencies(frame).items()
    assert (name, values["n"], values["mean"], values["word"]) == ("other", 2, 2.0, "consistent")
    # the sum of two values with two degrees of freedom each
    assert values["lower"] == pytest.approx(stats.chi2.ppf(0.025, 4) / 2)
