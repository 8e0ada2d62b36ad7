"""Tests of subset simulation, importance sampling and intervals on limit states with known probabilities."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks.validation.limit_states import LimitState, linear_margin, plateau_margin, run_subset
from marsyard.campaigns.studies.importance import fit_density
from marsyard.campaigns.studies.interval import additional_replicates, replicate_interval, weighted_interval
from marsyard.campaigns.studies.subset import SubsetEnd, SubsetResult
from marsyard.sim.streams import Blend


def run_seeded(margins: LimitState, dimension: int, samples: int, rng: np.random.Generator) -> tuple[SubsetResult, int]:
    """Run one subset simulation of `samples` cases per level with a random seed; also return its number of cases."""
    return run_subset(margins, dimension, int(rng.integers(2**31)), samples)


@pytest.mark.parametrize(
    ("dimension", "probability", "noise_fraction"),
    [(2, 1e-2, 0.0), (20, 1e-4, 0.0), (100, 1e-6, 0.0), (5, 1e-3, 0.3), (5, 1e-3, 0.95)],
)
def test_estimates_are_unbiased(dimension: int, probability: float, noise_fraction: float) -> None:
    rng = np.random.default_rng(1)
    margins = linear_margin(dimension, probability, noise_fraction)
    estimates = [run_seeded(margins, dimension, 300, rng)[0].probability for _ in range(40)]
    ratio = np.array(estimates) / probability
    # tolerance: three standard errors of the mean
    assert abs(ratio.mean() - 1.0) < 3.0 * ratio.std(ddof=1) / math.sqrt(len(ratio))
    assert ratio.std() < 1.5


@pytest.mark.slow
def test_intervals_of_replicates_cover_the_probability() -> None:
    rng, n_covering = np.random.default_rng(2), 0
    margins = linear_margin(10, 1e-3)
    for _ in range(100):
        results = [run_seeded(margins, 10, 100, rng)[0] for _ in range(4)]
        interval = replicate_interval([result.probability for result in results], 0.9)
        n_covering += interval.lower <= 1e-3 <= interval.upper
    # coverage of 90 %: mean 90 of 100, standard deviation sqrt(100 * 0.9 * 0.1) = 3
    assert n_covering >= 82


@pytest.mark.slow
def test_lower_bound_of_many_replicates_does_not_exceed_the_probability() -> None:
    """The mean of the estimates is a fifth too large with 100 cases per level; more replicates do not reduce this."""
    rng, margins = np.random.default_rng(11), linear_margin(2, 1e-4)
    studies = [[run_seeded(margins, 2, 100, rng)[0].probability for _ in range(60)] for _ in range(10)]
    assert np.mean(studies) > 1.1e-4
    # risk of each bound: 5 %; at most two of ten with a probability of 99 %
    assert sum(replicate_interval(estimates, 0.9).lower > 1e-4 for estimates in studies) <= 2


def test_simulation_needs_fewer_cases_than_counting() -> None:
    rng = np.random.default_rng(3)
    results = [run_seeded(linear_margin(20, 1e-4), 20, 300, rng) for _ in range(40)]
    estimates = np.array([result.probability for result, _ in results])
    mean_cases = np.mean([cases for _, cases in results])
    # counting with n cases has the relative variance 1 / (n p)
    counting_cases = 1e4 / (estimates.std() / 1e-4) ** 2
    assert mean_cases < counting_cases / 8.0


def test_cases_outside_the_population_do_not_bias_the_estimate() -> None:
    def margins(coordinates: np.ndarray, _blends: Sequence[Blend]) -> np.ndarray:
        # 95 % of the cases are outside the population: 1.645 is the 95 % quantile of the normal distribution
        return np.where(coordinates[:, 0] > 1.645, 2.5 - coordinates[:, 1], np.inf)

    rng = np.random.default_rng(4)
    estimates = [run_seeded(margins, 2, 300, rng)[0].probability for _ in range(30)]
    assert np.mean(estimates) == pytest.approx(0.05 * norm.sf(2.5), rel=0.4)


@pytest.mark.parametrize("plateau", [1.0, 0.0, math.inf])
def test_plateau_ends_the_simulation_without_an_estimate(plateau: float) -> None:
    """All cases of the first level have the same margin; a margin of 0 is no violation."""
    rng = np.random.default_rng(5)
    result, cases = run_seeded(lambda coordinates, _: np.where(coordinates[:, 0] > 8.0, -1.0, plateau), 2, 100, rng)
    assert result.end is SubsetEnd.PLATEAU
    assert not result.reached
    assert cases == 100


def test_few_cases_below_a_plateau_give_no_estimate() -> None:
    """2 of 200 cases are below the plateau on average; their number is too uncertain for an estimate."""
    rng = np.random.default_rng(15)
    ends = [run_seeded(plateau_margin(0.99, 1e-4), 2, 200, rng)[0].end for _ in range(50)]
    # 5 or more of 200 cases have the probability 5 %: 2.6 of 50 simulations continue on average
    assert ends.count(SubsetEnd.PLATEAU) >= 40


def test_step_with_a_tenth_of_a_level_is_an_estimate() -> None:
    """Violations are the only cases below a plateau, and have the probability 7 % (1.476: 93 % quantile)."""
    rng = np.random.default_rng(16)
    result, cases = run_seeded(lambda coordinates, _: np.where(coordinates[:, 0] > 1.476, -1.0, 0.0), 2, 400, rng)
    assert result.reached
    assert result.probability == pytest.approx(0.07, abs=0.04)
    assert cases == 400


def test_levels_count_violations_whose_parent_is_safe() -> None:
    rng = np.random.default_rng(17)
    result, _ = run_seeded(linear_margin(5, 1e-3), 5, 200, rng)
    first, *later = result.levels
    assert (first.probability, first.drawn) == (1.0, 200)
    assert len(later) == len(result.thresholds)
    assert [level.probability for level in later] == pytest.approx([0.1 ** (n + 1) for n in range(len(later))])
    assert all(0 <= level.entered <= level.drawn <= 180 for level in later)
    assert later[-1].entered > 0


@pytest.mark.parametrize("dimension", [2, 20])
def test_importance_sampling_is_unbiased_and_precise(dimension: int) -> None:
    rng = np.random.default_rng(6)
    margins = linear_margin(dimension, 1e-4)
    violations = np.concatenate([run_seeded(margins, dimension, 200, rng)[0].violations for _ in range(4)])
    density = fit_density(violations)
    coordinates, weights = density.draw(4000, rng)
    # a tenth of the cases is drawn from the nominal density, which limits the weights to 10
    assert weights.max() <= 10.0
    interval = weighted_interval((weights * (margins(coordinates, ()) < 0.0)).tolist(), 0.99)
    assert interval.lower < 1e-4 < interval.upper
    assert interval.upper / interval.lower < 2.0


def test_separate_failure_regions_have_separate_densities() -> None:
    rng = np.random.default_rng(7)
    coordinates = rng.standard_normal((200_000, 2))
    violations = coordinates[np.abs(coordinates[:, 0]) > 3.0]
    density = fit_density(violations)
    assert sorted(np.sign(density.centres[:, 0])) == [-1.0, 1.0]


def test_more_replicates_are_needed_near_the_limit() -> None:
    estimates = [0.8e-4, 0.5e-4, 1.2e-4, 0.7e-4]
    near, far = (additional_replicates(estimates, 0.9, max_probability) for max_probability in (6e-5, 4e-5))
    assert additional_replicates(estimates, 0.9, 1e-4) is None
    assert near is not None
    assert far is not None
    assert near > far >= 1


def test_too_few_results_give_no_density_and_no_interval() -> None:
    assert fit_density(np.ones((9, 2))) is None
    interval = weighted_interval([0.0, 0.0, 0.0], 0.9)
    assert (interval.lower, interval.upper) == (0.0, 1.0)
    with pytest.raises(ValueError, match="at least 2 replicates"):
        replicate_interval([1e-4], 0.9)
