"""Tests of correlated dispersions: correlations, marginal distributions and rejected matrices."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy import stats

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import DefinitionError
from marsyard.campaigns.sampling.correlation import Correlation
from tests.campaigns.fake_campaign import CampaignFile

N_CASES = 4000
TOP_LEVEL_KEYS = 'name = "fake"\nscenario = "tests.campaigns.fake_scenario:FakeScenario"\nseed = 5\ncases = {cases}\n'
#: Tolerance in standard errors: a correct sampler exceeds it for one of 16,000 seeds (normal distribution, two-sided).
MAX_STANDARD_ERRORS = 4.0
#: Minimum p-value of a test: a correct sampler fails for one of 1000 seeds. The seeds are fixed.
MIN_P_VALUE = 1e-3

#: Three correlated parameters of different distributions, and one outside the group.
SKEWED = """
[dispersions]
"wind.east_m_s" = {distribution = "gamma", a = 2.0, scale = 3.0, truncate = [0.0, 40.0]}
"wind.north_m_s" = {distribution = "uniform", low = -10, high = 10}
altitude_m = {distribution = "normal", mean = 2000, sd = 100, truncate = [1700, 2100]}
terrain = {distribution = "integer", low = 0, high = 3}
[[correlations]]
parameters = ["wind.east_m_s", "wind.north_m_s", "altitude_m"]
rank = [[1.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 1.0]]
"""
#: Two correlated normal parameters; the matrix is a covariance or a correlation.
NORMAL = """
[dispersions]
"wind.east_m_s" = {{distribution = "normal", mean = 1{east}}}
"wind.north_m_s" = {{distribution = "normal", mean = -2{north}}}
[[correlations]]
parameters = ["wind.east_m_s", "wind.north_m_s"]
{matrix}
"""


def load_correlated(
    write_file: CampaignFile, dispersions: str, design: str = "random", cases: int = N_CASES
) -> Campaign:
    """Load a campaign of the fake scenario with correlated dispersions."""
    text = f'[design]\nkind = "{design}"\n{dispersions}'
    return load_campaign(str(write_file(top_level_keys=TOP_LEVEL_KEYS.format(cases=cases), dispersions=text)))


def draw_table(campaign: Campaign, cases: int = N_CASES) -> np.ndarray:
    """Return the sampled values, shape (cases, dispersions)."""
    return np.array([list(campaign.draws(case).values()) for case in range(cases)], dtype=np.float64)


def rank_standard_error(rank: float, cases: int) -> float:
    """Compute an upper bound of the standard error of Spearman's coefficient: sqrt((1 + r^2 / 2) / (n - 3)) (1 - r^2).

    Fisher's z of Pearson's coefficient has variance 1 / (n - 3) for normal numbers. The variance for Spearman's
    coefficient is (1 + r^2 / 2) times as large (Bonett & Wright 2000, Psychometrika 65, 23-28); dr/dz = 1 - r^2.
    """
    return float(np.sqrt((1.0 + 0.5 * rank**2) / (cases - 3)) * (1.0 - rank**2))


@pytest.mark.slow
@pytest.mark.parametrize(("design", "cases"), [("random", N_CASES), ("latin-hypercube", N_CASES), ("sobol", 4096)])
def test_rank_correlation_holds_for_any_distribution(campaign_file: CampaignFile, design: str, cases: int) -> None:
    campaign = load_correlated(campaign_file, SKEWED, design, cases)
    draws = draw_table(campaign, cases)
    estimated = np.atleast_2d(stats.spearmanr(draws).statistic)
    ranks = campaign.definition.correlations[0].rank
    assert ranks is not None
    for row in range(3):
        for column in range(row):
            rank = ranks[row][column]
            assert abs(estimated[row, column] - rank) < MAX_STANDARD_ERRORS * rank_standard_error(rank, cases)
    # the parameter outside the group is uncorrelated
    assert np.abs(estimated[3, :3]).max() < MAX_STANDARD_ERRORS / np.sqrt(cases - 1)


@pytest.mark.parametrize("design", ["random", "latin-hypercube"])
def test_correlated_parameters_have_their_marginal_distributions(campaign_file: CampaignFile, design: str) -> None:
    draws = draw_table(load_correlated(campaign_file, SKEWED, design))
    gamma = stats.gamma(2, scale=3)
    low, high = stats.norm(2000, 100).cdf([1700, 2100])
    cdfs = [
        lambda x: gamma.cdf(x) / gamma.cdf(40),
        stats.uniform(-10, 20).cdf,
        lambda x: (stats.norm(2000, 100).cdf(x) - low) / (high - low),
    ]
    for column, cdf in enumerate(cdfs):
        assert stats.kstest(draws[:, column], cdf).pvalue > MIN_P_VALUE


@pytest.mark.parametrize(
    ("east", "north", "matrix"),
    [
        ("", "", "covariance = [[4.0, -4.5], [-4.5, 9.0]]"),
        (", sd = 2", ", sd = 3", "correlation = [[1.0, -0.75], [-0.75, 1.0]]"),
    ],
)
def test_normal_groups_have_their_covariance(campaign_file: CampaignFile, east: str, north: str, matrix: str) -> None:
    """Draws multiplied by the inverse Cholesky factor are independent standard normal numbers (whitening)."""
    draws = draw_table(load_correlated(campaign_file, NORMAL.format(east=east, north=north, matrix=matrix)))
    covariance = np.array([[4.0, -4.5], [-4.5, 9.0]])
    whitened_draws = np.linalg.solve(np.linalg.cholesky(covariance), (draws - [1.0, -2.0]).T)
    first, second = whitened_draws
    for row in (first, second, (first + second) / np.sqrt(2), (first - second) / np.sqrt(2)):
        assert stats.kstest(row, stats.norm.cdf).pvalue > MIN_P_VALUE
    assert stats.kstest((whitened_draws**2).sum(axis=0), stats.chi2(2).cdf).pvalue > MIN_P_VALUE
    # Wishart distribution: the variance of an entry s_ij is (c_ij^2 + c_ii c_jj) / (n - 1)
    variances = np.diag(covariance)
    standard_error = np.sqrt((covariance**2 + np.outer(variances, variances)) / (N_CASES - 1))
    assert np.all(np.abs(np.cov(draws.T) - covariance) < MAX_STANDARD_ERRORS * standard_error)


def test_normal_correlation_has_the_specified_rank_correlation() -> None:
    """Compare 2 sin(pi/6 rho_s) with Spearman's coefficient of a bivariate normal by quadrature."""
    group = Correlation(parameters=("a", "b"), rank=((1.0, 0.4), (0.4, 1.0)))
    rho = group.normal_correlation[0, 1]
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    x, y = np.meshgrid(nodes, nodes)
    weight = np.outer(weights, weights) / (2 * np.pi)
    spearman = 12 * np.sum(weight * stats.norm.cdf(x) * stats.norm.cdf(rho * x + np.sqrt(1 - rho**2) * y)) - 3
    assert spearman == pytest.approx(0.4, abs=1e-9)


def test_added_parameter_does_not_change_draws_of_the_group(campaign_file: CampaignFile) -> None:
    draws_before = load_correlated(campaign_file, SKEWED).draws(7)
    text = SKEWED.replace('"altitude_m"]', '"altitude_m", "heights_m.0"]').replace(
        "rank = [[1.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 1.0]]",
        "rank = [[1.0, 0.6, -0.3, 0.1], [0.6, 1.0, 0.2, 0.1], [-0.3, 0.2, 1.0, 0.1], [0.1, 0.1, 0.1, 1.0]]",
    )
    text = text.replace("[dispersions]", '[dispersions]\n"heights_m.0" = {distribution = "uniform", low=0, high=1}')
    draws_after = load_correlated(campaign_file, text).draws(7)
    assert draws_after.pop("heights_m.0") != draws_before["altitude_m"]
    assert draws_after == draws_before


def test_overridden_parameter_is_removed_from_its_group(campaign_file: CampaignFile) -> None:
    path = str(campaign_file(dispersions=SKEWED))
    (group,) = load_campaign(path, ["wind.north_m_s=3"]).definition.correlations
    assert (group.parameters, group.rank) == (("wind.east_m_s", "altitude_m"), ((1.0, -0.3), (-0.3, 1.0)))
    without_group = load_campaign(path, ["wind={}", "altitude_m=1800"])
    assert without_group.definition.correlations == ()


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        ({}, "one of covariance, correlation, rank is needed, got none"),
        ({"rank": [[1, 0], [0, 1]], "correlation": [[1, 0], [0, 1]]}, "got correlation, rank"),
        ({"rank": [[1, 0.5]]}, "rank must have 2 rows of 2 numbers"),
        ({"rank": [[1, 0.5], [0.4, 1]]}, "rank is not symmetric"),
        ({"rank": [[2, 0.5], [0.5, 1]]}, "rank must be 1 along its diagonal"),
        ({"rank": [[1, 5.5], [5.5, 1]]}, "rank has an entry that is not between -1 and 1"),
        ({"correlation": [[1, 1], [1, 1]]}, "not positive definite"),
        ({"covariance": [[1, 2], [2, 1]]}, "not positive definite"),
        ({"covariance": [[0, 0], [0, 1]]}, "a variance that is not above 0"),
        ({"covariance": [[1, float("nan")], [0, 1]]}, "finite number"),
    ],
)
def test_invalid_correlations_are_rejected(matrices: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError) as error:
        Correlation.model_validate({"parameters": ["a", "b"], **matrices})
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("dispersions", "message"),
    [
        (NORMAL.format(east=", sd=2", north="", matrix="covariance=[[4,1],[1,4]]"), "has an sd, but the covariance"),
        (NORMAL.format(east=", sd=2", north="", matrix="correlation=[[1,0],[0,1]]"), 'm_s".sd: required, but missing'),
        (NORMAL.format(east="", north=", truncate=[0,1]", matrix="covariance=[[4,1],[1,4]]"), "use the group's rank"),
        (SKEWED.replace('"altitude_m"]', '"terrain"]'), "correlations[0].parameters[2]: 'terrain' has no density"),
        (SKEWED.replace('"altitude_m"]', '"altitud_m"]'), "is not dispersed (did you mean 'altitude_m'?)"),
        (SKEWED.replace('"altitude_m"]', '"wind.east_m_s"]'), "repeated parameters: wind.east_m_s"),
        (SKEWED.replace("mean = 2000", 'mean = "2000 + terrain"'), "'altitude_m' has a formula"),
        (SKEWED + '[[correlations]]\nparameters=["altitude_m"]\nrank=[[1.0]]', "is in correlations[0] already"),
        (SKEWED + "x = 1", "correlations[0].x: unknown key; allowed: correlation, covariance, parameters, rank"),
        ("[correlations]\nx = 1", "correlations: input should be a valid tuple"),
    ],
)
def test_invalid_groups_are_rejected(campaign_file: CampaignFile, dispersions: str, message: str) -> None:
    with pytest.raises(DefinitionError) as error:
        load_campaign(str(campaign_file(dispersions=dispersions)))
    assert message in str(error.value)
