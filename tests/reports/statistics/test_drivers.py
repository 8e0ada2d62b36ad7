from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from marsyard.reports.statistics.drivers import Driver, driver


def _driver(x: np.ndarray, y: np.ndarray, groups: np.ndarray | None = None) -> Driver:
    found = driver(x, y, groups, 0.9)
    assert found is not None
    return found


def test_a_straight_driver() -> None:
    rng = np.random.default_rng(1)
    x, noise = rng.normal(size=(2, 4000))
    found = _driver(x, x + noise)
    assert found.correlation == pytest.approx(stats.spearmanr(x, x + noise).statistic)
    # Spearman of a normal pair with Pearson 1 / sqrt(2): 6 / pi asin(0.7071 / 2) = 0.690.
    assert found.lower < 0.690 < found.upper
    # Ranks of the response are explained by the square of that, and a little by bins as fine as these not at all.
    assert found.share == pytest.approx(0.690**2, abs=0.03)
    assert found.p_value < 1e-9


def test_a_valley_explains_variance_without_rank_correlation() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.0, 1.0, 2000)
    found = _driver(x, x**2 + rng.normal(0.0, 0.05, 2000))
    assert abs(found.correlation) < 0.06
    assert found.share_lower > 0.8


@pytest.mark.parametrize("n", [60, 600])
def test_intervals_of_an_unrelated_condition_contain_zero(n: int) -> None:
    # 200 samples: one standard deviation of a coverage of 90 % is 2.1 %, of 95 % 1.5 %.
    rng = np.random.default_rng(3)
    found = [_driver(rng.normal(size=n), rng.exponential(size=n)) for _ in range(200)]
    assert np.mean([one.lower <= 0.0 <= one.upper for one in found]) >= 0.9 - 3 * 0.021
    assert np.mean([one.p_value < 0.1 for one in found]) <= 0.1 + 3 * 0.021
    # The lower bound of a share is one-sided: above zero in no more than 5 %.
    assert np.mean([one.share_lower > 0.0 for one in found]) <= 0.05 + 3 * 0.015


def test_a_condition_of_terrains_is_worth_as_many_cases() -> None:
    # Slopes of 40 terrains that explain nothing, and errors that differ between terrains: as for 800 independent cases
    # the interval misses zero far more often than one time in ten.
    rng = np.random.default_rng(4)
    groups = np.repeat(np.arange(40), 20)
    missed = {True: 0, False: 0}
    for _ in range(100):
        slope, level = rng.normal(size=(2, 40))
        errors = level[groups] + rng.normal(size=800)
        for shared in missed:
            found = _driver(slope[groups], errors, groups if shared else None)
            missed[shared] += not found.lower <= 0.0 <= found.upper
    assert missed[True] / 100 <= 0.1 + 3 * 0.03
    assert missed[False] / 100 > 0.5


def test_two_kinds() -> None:
    x = np.repeat([0.0, 1.0], [90, 10])
    found = _driver(x, np.where(x == 1.0, 5.0, 1.0) + np.linspace(0.0, 0.5, 100))
    assert found.share > 0.2
    assert found.p_value < 1e-4


def test_constants_have_no_effect() -> None:
    assert driver(np.ones(50), np.arange(50.0), None, 0.9) is None
    assert driver(np.arange(19.0), np.arange(19.0), None, 0.9) is None


def test_a_condition_that_leaves_nothing_to_explain() -> None:
    """Two kinds of condition, one response each: the share is 1, where the F ratio is infinite."""
    condition = np.repeat([400.0, 800.0], 20)
    found = driver(condition, condition / 400.0, None, 0.9)
    assert found is not None
    assert (found.share, found.share_lower, found.share_upper, found.p_value) == (1.0, 1.0, 1.0, 0.0)
    assert found.correlation == pytest.approx(1.0)
