"""Tests of comparisons of algorithms and of campaigns, and of the consistency of covariances."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from marsyard.reports.campaign_diff import MetricComparison, campaign_diff_grid, compare_campaigns
from marsyard.reports.comparison import compare_algorithms, comparison_section, select_algorithm
from marsyard.reports.consistency import evaluate_consistencies, evaluate_consistency
from marsyard.reports.metrics import list_metrics
from marsyard.reports.statistics.difference_tests import difference_p_value
from marsyard.reports.stored import read_run
from tests.reports.synthetic_run import MakeRun, make_rows, make_subject


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


def test_cases_without_all_algorithms_are_left_out_and_counted() -> None:
    frame = make_paired_rows([1.0] * 8, [2.0] * 8).astype({"other.answered": object})
    frame.loc[:1, "other.answered"] = None
    section = comparison_section(make_subject(frame, "velocity_error_m_s", 5.0))
    assert section is not None
    assert section.blocks[0].note == "Left out: 2 cases that ended before all algorithms had run."


def test_unfinished_cases_are_no_successes_and_have_no_error() -> None:
    """A lander that flies on after a crash of the algorithm has an error, which is not the algorithm's."""
    frame = make_paired_rows([0.5] * 100, [0.5] * 100)
    is_crashed = frame["case"] < 60
    frame["other.outcome"] = np.where(is_crashed, "CRASHED", "VALID")
    frame["other.velocity_error_m_s"] = np.where(is_crashed, 0.1, 0.5)
    (_, other), (difference,) = compare_algorithms(frame, "velocity_error_m_s", 1.0)
    assert (other.failed, other.succeeded, other.median) == (60, 40, 0.5)
    assert (difference.only_first, difference.only_other, difference.pairs, difference.mean) == (60, 0, 40, 0.0)
    assert difference.success_p < 1e-9


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
    verdicts = [evaluate_consistency(stats.chi2.rvs(2, size=50, random_state=rng)).word for _ in range(400)]
    # 0.95, minus 4 and plus 3 standard deviations of 1.1 %
    assert 0.91 <= verdicts.count("consistent") / 400 <= 0.985
    overconfident = evaluate_consistency(stats.chi2.rvs(2, size=50, random_state=rng) * 4.0)
    assert overconfident.word == "optimistic"
    assert evaluate_consistency(stats.chi2.rvs(2, size=50, random_state=rng) / 4.0).word == "pessimistic"


@pytest.mark.parametrize("column", ["velocity_nees", "position_nees"])
def test_consistency_covers_all_algorithms_with_covariances(column: str) -> None:
    frame = make_paired_rows([1, 2, 3], [3, 4, 5]).assign(**{f"other.{column}": [2.0, 2.0, np.nan]})
    ((name, values),) = evaluate_consistencies(frame).items()
    assert (name, values.n, values.mean, values.word) == ("other", 2, 2.0, "consistent")
    # the sum of two values with two degrees of freedom each
    assert values.lower == pytest.approx(stats.chi2.ppf(0.025, 4) / 2)


def _compare(first: Path, second: Path) -> tuple[bool, dict[str, MetricComparison]]:
    is_paired, comparisons = compare_campaigns(read_run(first), read_run(second))
    return is_paired, {comparison.name: comparison for comparison in comparisons}


def test_campaigns_with_the_same_draws_are_compared_in_pairs(make_run: MakeRun) -> None:
    frame = make_rows(200, terrains=40)
    worse_frame = frame.assign(velocity_error_m_s=frame["velocity_error_m_s"] * 1.02)
    is_paired, comparisons = _compare(make_run(frame), make_run(worse_frame, name="other"))
    assert is_paired
    # errors larger by 2 %: the paired test detects them in spite of the large scatter
    assert comparisons["velocity error (m/s)"].p_value < 1e-9
    assert comparisons["answered"].p_value == 1.0
    assert comparisons["came to an end"].second.summary == 1.0
    # with four terrains the sign test has p = 2 / 2^4; Holm's correction for 4 metrics multiplies it by 4
    four_terrains = make_rows(200)
    worse_frame = four_terrains.assign(velocity_error_m_s=four_terrains["velocity_error_m_s"] * 1.02)
    _, comparisons = _compare(
        make_run(four_terrains, name="four-terrains"), make_run(worse_frame, name="four-terrains-worse")
    )
    assert comparisons["velocity error (m/s)"].p_value == pytest.approx(4 * 2 / 2**4)


def test_terrains_of_different_banks_are_not_paired(make_run: MakeRun) -> None:
    banks = [{"parameters": {"location": {"bank_seed": seed}}} for seed in (1, 2)]
    runs = [make_run(make_rows(100), name=f"run-{seed}", definition=bank) for seed, bank in enumerate(banks)]
    assert not _compare(*runs)[0]
    assert _compare(runs[0], runs[0])[0]


def test_stratified_designs_of_different_sizes_are_not_paired(make_run: MakeRun) -> None:
    for kind, expected in (("random", True), ("latin-hypercube", False)):
        runs = [
            make_run(make_rows(cases), name=f"{kind}-{cases}", definition={"design": {"kind": kind}, "cases": cases})
            for cases in (40, 80)
        ]
        assert _compare(*runs)[0] is expected


def test_campaigns_with_different_draws_are_compared_as_two_samples(make_run: MakeRun) -> None:
    first = make_run(make_rows(300))
    is_paired, comparisons = _compare(first, make_run(make_rows(300, seed=2), name="same", seed=8))
    assert not is_paired
    assert min(comparison.p_value for comparison in comparisons.values()) > 0.01
    _, worse_comparisons = _compare(
        first, make_run(make_rows(300, seed=2, answer_rate=0.6, error_scale=2.0), name="worse", seed=8)
    )
    assert worse_comparisons["answered"].p_value < 1e-6
    # no permutation of 10,000 has a larger difference
    assert worse_comparisons["velocity error (m/s)"].p_value < 1e-3
    grid = campaign_diff_grid(["a", "b"], list(worse_comparisons.values()))
    assert ["answered", "< 0.001"] in [[row[0], row[-1]] for row in grid.rows]


def test_campaigns_without_terrains_are_compared_case_by_case(make_run: MakeRun) -> None:
    first, worse = (make_rows(200, answer_rate=rate).drop(columns="terrain") for rate in (0.9, 0.5))
    definition = {"parameters": {"site": "meridiani"}}
    _, comparisons = _compare(make_run(first), make_run(worse, name="worse", definition=definition))
    assert comparisons["answered"].p_value < 1e-6


def test_terrains_of_different_sites_are_not_paired(make_run: MakeRun) -> None:
    # Errors depend on the terrain. Terrain numbers of two sites denote different terrains, so no pairs exist.
    def write_site_run(name: str, seed: int) -> Path:
        terrain_error = np.random.default_rng(seed).uniform(1.0, 3.0, 20)
        frame = make_rows(400, terrains=20, answer_rate=1.0, seed=seed)
        frame["velocity_error_m_s"] = terrain_error[frame["terrain"]] + 0.1 * np.arange(400) / 400
        definition = {"parameters": {"site": name}}
        return make_run(frame, name=name, seed=seed, definition=definition)

    gusev, meridiani = read_run(write_site_run("gusev", 1)), read_run(write_site_run("meridiani", 6))
    assert min(entry.p_value for entry in compare_campaigns(gusev, meridiani)[1]) > 0.05
    first, second = ({item.name: item.sample for item in list_metrics(run)[1]} for run in (gusev, meridiani))
    assert difference_p_value(first["velocity error (m/s)"], second["velocity error (m/s)"]) < 1e-3


def test_campaigns_without_common_metric_are_compared_by_completion(make_run: MakeRun) -> None:
    first = make_run(make_rows(20)[["case", "outcome"]], [])
    _, comparisons = _compare(first, make_run(make_rows(20), name="other", seed=8))
    assert set(comparisons) == {"came to an end"}
