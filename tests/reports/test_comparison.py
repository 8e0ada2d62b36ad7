"""Algorithms in pairs, and covariances against errors: closed forms, and rates over many repetitions."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from marsyard.reports.common_sections import consistencies, consistency
from marsyard.reports.comparison import comparison, select_algorithm


def rows(mine: list[float], its: list[float]) -> pd.DataFrame:
    frame: dict[str, Any] = {"case": range(len(mine)), "algorithm": "dimes", "velocity_error_m_s": mine}
    for prefix, errors in (("", mine), ("other.", its)):
        known = np.isfinite(errors)
        frame[f"{prefix}outcome"] = np.where(known, "VALID", "CRASHED")
        frame[f"{prefix}answered"] = known
    return pd.DataFrame({**frame, "other.velocity_error_m_s": its, "altitude_m": 1.0})


def test_algorithms_side_by_side() -> None:
    nan = float("nan")
    contenders, (difference,) = comparison(rows([1, 2, 3, 9], [2, 3, nan, 4]), "velocity_error_m_s", 5.0)
    assert [(one.name, one.answered, one.failed, one.succeeded) for one in contenders] == [
        ("dimes", 4, 0, 3),
        ("other", 3, 1, 3),
    ]
    assert (difference.only_first, difference.only_other, difference.pairs) == (1, 1, 3)
    assert difference.mean == pytest.approx((1 + 1 - 5) / 3)


def test_probabilities_are_corrected_for_the_number_of_algorithms() -> None:
    frame = rows([1.0] * 12, [2.0] * 12)
    again = frame.filter(like="other.").rename(columns=lambda name: name.replace("other.", "third."))
    (alone,) = comparison(frame, "velocity_error_m_s", 1.5)[1]
    both = comparison(pd.concat([frame, again], axis=1), "velocity_error_m_s", 1.5)[1]
    assert [one.success_p for one in both] == pytest.approx([2.0 * alone.success_p] * 2)
    assert [one.error_p for one in both] == pytest.approx([2.0 * alone.error_p] * 2)


def test_one_algorithm_alone_is_no_comparison() -> None:
    frame = rows([1, 2], [1, 2])[["case", "algorithm", "outcome", "answered", "velocity_error_m_s"]]
    assert comparison(frame, "velocity_error_m_s", 5.0) == ([], [])


def test_a_frame_as_if_the_other_had_been_judged() -> None:
    own = select_algorithm(rows([1, 2], [3, 4]), "other")
    assert own["velocity_error_m_s"].tolist() == [3, 4]
    assert own["altitude_m"].tolist() == [1.0, 1.0]
    assert not any("." in str(name) for name in own.columns)


def test_right_covariances_are_consistent_19_times_in_20() -> None:
    rng = np.random.default_rng(7)
    words = [consistency(stats.chi2.rvs(2, size=50, random_state=rng))["word"] for _ in range(400)]
    assert 0.91 <= words.count("consistent") / 400 <= 0.985  # 0.95 with 4 standard deviations below, 3 above
    found = consistency(stats.chi2.rvs(2, size=50, random_state=rng) * 4.0)
    assert found["word"] == "too sure"
    assert consistency(stats.chi2.rvs(2, size=50, random_state=rng) / 4.0)["word"] == "too cautious"


def test_consistency_of_every_algorithm_that_states_covariances() -> None:
    frame = rows([1, 2], [3, 4]).assign(**{"other.velocity_nees": [2.0, 2.0]})
    ((name, only),) = consistencies(frame).items()
    assert (name, only["n"], only["mean"], only["word"]) == ("other", 2, 2.0, "consistent")
