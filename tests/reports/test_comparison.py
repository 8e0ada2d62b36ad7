"""Algorithms in pairs, and covariances against errors: closed forms, and rates over many repetitions."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from reports.comparison import comparison, mcnemar, own_frame, paired_errors
from reports.consistency import consistencies, consistency


def rows(mine: list[float], its: list[float]) -> pd.DataFrame:
    frame = {"case": range(len(mine)), "algorithm": "dimes", "velocity_error_m_s": mine}
    for prefix, errors in (("", mine), ("other.", its)):
        known = np.isfinite(errors)
        frame[f"{prefix}outcome"] = np.where(known, "VALID", "CRASHED")
        frame[f"{prefix}answered"] = known
    return pd.DataFrame({**frame, "other.velocity_error_m_s": its, "altitude_m": 1.0})


def test_mcnemar_is_exact() -> None:
    first = np.array([True] * 9 + [False] * 1 + [True] * 5)
    other = np.array([False] * 9 + [True] * 1 + [True] * 5)
    only_first, only_other, p = mcnemar(first, other)
    assert (only_first, only_other) == (9, 1)
    assert p == pytest.approx(2 * (1 + 10) / 2**10)  # two tails of ten fair coins
    assert mcnemar(first, first)[2] == 1.0


def test_algorithms_side_by_side() -> None:
    nan = float("nan")
    contenders, (difference,) = comparison(rows([1, 2, 3, 9], [2, 3, nan, 4]), "velocity_error_m_s", 5.0)
    assert [(one.name, one.answered, one.failed, one.succeeded) for one in contenders] == [
        ("dimes", 4, 0, 3),
        ("other", 3, 1, 3),
    ]
    assert (difference.only_first, difference.only_other, difference.pairs) == (1, 1, 3)
    assert difference.mean == pytest.approx((1 + 1 - 5) / 3)


def test_one_algorithm_alone_is_no_comparison() -> None:
    frame = rows([1, 2], [1, 2])[["case", "algorithm", "outcome", "answered", "velocity_error_m_s"]]
    assert comparison(frame, "velocity_error_m_s", 5.0) == ([], [])


def test_a_frame_as_if_the_other_had_been_judged() -> None:
    own = own_frame(rows([1, 2], [3, 4]), "other")
    assert own["velocity_error_m_s"].tolist() == [3, 4]
    assert own["altitude_m"].tolist() == [1.0, 1.0]
    assert not any("." in str(name) for name in own.columns)


def test_the_interval_of_a_paired_mean_covers_it() -> None:
    rng = np.random.default_rng(5)
    hits = sum(
        lower <= 0.3 <= upper
        for _, lower, upper, _ in (paired_errors(rng.normal(0.3, 1.0, 60), None) for _ in range(200))
    )
    # 90 % of 200, with 4 standard deviations of sqrt(200 * 0.9 * 0.1) and what a bootstrap of 60 falls short of
    assert 158 <= hits <= 197


def test_cases_on_one_terrain_are_drawn_together() -> None:
    rng = np.random.default_rng(6)
    terrains = np.repeat(np.arange(20), 10)
    differences = np.repeat(rng.normal(size=20), 10)
    _, lower, upper, _ = paired_errors(differences, terrains)
    _, lone_lower, lone_upper, _ = paired_errors(differences, None)
    assert (upper - lower) / (lone_upper - lone_lower) == pytest.approx(np.sqrt(10.0), rel=0.15)


def test_right_covariances_are_consistent_19_times_in_20() -> None:
    rng = np.random.default_rng(7)
    words = [consistency("x", stats.chi2.rvs(2, size=50, random_state=rng)).word for _ in range(400)]
    assert 0.91 <= words.count("consistent") / 400 <= 0.985  # 0.95 with 4 standard deviations below, 3 above
    found = consistency("x", stats.chi2.rvs(2, size=50, random_state=rng) * 4.0)
    assert found.word == "too sure"
    assert consistency("x", stats.chi2.rvs(2, size=50, random_state=rng) / 4.0).word == "too cautious"


def test_consistency_of_every_algorithm_that_states_covariances() -> None:
    frame = rows([1, 2], [3, 4]).assign(**{"other.velocity_nees": [2.0, 2.0]})
    (only,) = consistencies(frame)
    assert (only.name, only.n, only.mean, only.word) == ("other", 2, 2.0, "consistent")
