"""Tests of sampling designs: stratification, single cases, appended blocks and added dispersions."""

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import DefinitionError
from marsyard.campaigns.sampling.design import build_stratified_design
from tests.campaigns.fake_campaign import CampaignFile

TOP_LEVEL_KEYS = (
    'name = "fake"\nscenario = "tests.campaigns.fake_scenario:FakeScenario"\nseed = {seed}\ncases = {cases}\n'
)
DISPERSIONS = """
[dispersions]
"wind.east_m_s" = {distribution = "uniform", low = 0, high = 1}
"wind.north_m_s" = {distribution = "normal", mean = 0, sd = 1}
"heights_m.1" = {distribution = "beta", a = 2, b = 5}
kind = {distribution = "choice", values = ["rough", "plain"]}
"""
#: A correlated pair of the parameters in `DISPERSIONS`.
GROUP = """
[[correlations]]
parameters = ["wind.north_m_s", "heights_m.1"]
rank = [[1.0, 0.8], [0.8, 1.0]]
"""
#: Two grid dispersions: 3 x 2 grid points.
GRID = """
terrain = {distribution = "grid", low = 0, high = 6, step = 3}
error_scale = {distribution = "grid", values = [0.5, 2.0]}
"""


def load_design(
    campaign_file: CampaignFile,
    kind: str,
    cases: int,
    *,
    dispersions: str = DISPERSIONS,
    nominal: bool = False,
    seed: int = 5,
    extra_keys: str = "",
) -> Campaign:
    """Load a campaign of the fake scenario with a sampling design.

    With `nominal`, case 0 has the parameters of the campaign file instead of sampled ones.
    """
    design = f'[design]\nkind = "{kind}"\nnominal = {str(nominal).lower()}\n'
    top_level_keys = TOP_LEVEL_KEYS.format(cases=cases, seed=seed) + extra_keys
    return load_campaign(str(campaign_file(top_level_keys=top_level_keys, dispersions=design + dispersions)))


def read_probabilities(campaign: Campaign, cases: range) -> np.ndarray:
    """Return the cases as points of the unit cube (one probability per dispersion), shape (cases, dispersions)."""
    return np.array([list((campaign.probabilities(case) or {}).values()) for case in cases])


@given(cases=st.integers(1, 300), seed=st.integers(0, 2**63 - 1))
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_each_latin_hypercube_stratum_has_one_case(campaign_file: CampaignFile, cases: int, seed: int) -> None:
    for dispersions in (DISPERSIONS, DISPERSIONS + GROUP):
        points = read_probabilities(
            load_design(campaign_file, "latin-hypercube", cases, dispersions=dispersions, seed=seed), range(cases)
        )
        assert points.shape == (cases, 4)
        for column in points.T:
            assert sorted(np.floor(column * cases).astype(int).tolist()) == list(range(cases))


def test_latin_hypercube_values_are_stratified(campaign_file: CampaignFile) -> None:
    campaign = load_design(campaign_file, "latin-hypercube", 200, dispersions=DISPERSIONS + GROUP)
    draws = [campaign.draws(case) for case in range(200)]
    probabilities = stats.norm.cdf([draw["wind.north_m_s"] for draw in draws])
    assert sorted(np.floor(200 * probabilities).astype(int).tolist()) == list(range(200))
    assert [draw["kind"] for draw in draws].count("rough") == 100


def test_latin_hypercube_columns_are_uncorrelated(campaign_file: CampaignFile) -> None:
    points = read_probabilities(load_design(campaign_file, "latin-hypercube", 2000), range(2000))
    rank_error = stats.spearmanr(points).statistic - np.eye(4)
    # limit for the maximum of six pairs of columns: 4.5 standard errors of 1 / sqrt(n - 1)
    assert np.abs(rank_error).max() < 4.5 / np.sqrt(1999)


def test_sobol_design_is_a_digital_net(campaign_file: CampaignFile) -> None:
    """In the first two dimensions, 2^8 points have one point per elementary interval of volume 2^-8."""
    points = read_probabilities(load_design(campaign_file, "sobol", 256), range(256))[:, :2]
    for exponent in range(9):
        intervals = np.floor(points * [2**exponent, 2 ** (8 - exponent)]).astype(int)
        assert len({tuple(interval) for interval in intervals.tolist()}) == 256
    assert points.min() > 0.0
    assert points.max() < 1.0


@pytest.mark.parametrize("kind", ["random", "latin-hypercube", "sobol"])
@pytest.mark.parametrize("nominal", [False, True])
def test_single_case_equals_case_of_full_design(campaign_file: CampaignFile, kind: str, nominal: bool) -> None:
    # 16 cases at each of the 6 grid points, and the nominal case
    cases = 6 * 16 + nominal
    design: dict[str, Any] = {"dispersions": DISPERSIONS + GRID + GROUP, "nominal": nominal}
    campaign = load_design(campaign_file, kind, cases, **design)
    draws = [campaign.draws(case) for case in range(cases)]
    for case in (cases - 1, 17, 3, 0):
        build_stratified_design.cache_clear()
        assert load_design(campaign_file, kind, cases, **design).draws(case) == draws[case]
    # all cases differ
    assert len({str(draw) for draw in draws}) == cases


@pytest.mark.parametrize("kind", ["random", "latin-hypercube", "sobol"])
@given(name=st.sampled_from(["wind.east_m_s", "heights_m.0", "lowest_altitude_m"]), case=st.integers(0, 63))
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_added_dispersion_changes_no_other_draw(campaign_file: CampaignFile, kind: str, name: str, case: int) -> None:
    """The new dispersion can be anywhere in the file, except in a Sobol design, where it must be the last."""
    other_dispersions = DISPERSIONS.replace('"wind.east_m_s" = {distribution = "uniform", low = 0, high = 1}', "")
    entry = f'"{name}" = {{distribution = "uniform", low = 0, high = 1}}\n'
    draws_without = load_design(campaign_file, kind, 64, dispersions=other_dispersions).draws(case)
    first, last = other_dispersions.replace("[dispersions]", f"[dispersions]\n{entry}"), other_dispersions + entry
    for text in [last] if kind == "sobol" else [first, last]:
        draw = load_design(campaign_file, kind, 64, dispersions=text).draws(case)
        assert 0.0 < draw.pop(name) < 1.0
        assert draw == draws_without


@pytest.mark.parametrize("kind", ["random", "latin-hypercube", "sobol"])
def test_appended_cases_do_not_change_earlier_cases(campaign_file: CampaignFile, kind: str) -> None:
    initial_campaign = load_design(campaign_file, kind, 33, nominal=True)
    extended_campaign = load_design(campaign_file, kind, 33, nominal=True, extra_keys="appended = [16, 8]")
    assert extended_campaign.definition.total_cases == 57
    assert [extended_campaign.draws(case) for case in range(33)] == [initial_campaign.draws(case) for case in range(33)]
    points = read_probabilities(extended_campaign, range(1, 57))
    assert len(np.unique(points[:, 0])) == 56
    if kind != "random":
        for block in (points[:32], points[32:48], points[48:]):
            assert sorted(np.floor(block[:, 0] * len(block)).astype(int).tolist()) == list(range(len(block)))


def test_draws_depend_on_the_seed_and_only_stratified_ones_on_the_number_of_cases(campaign_file: CampaignFile) -> None:
    for kind, is_equal in (("latin-hypercube", False), ("random", True)):
        small, large, other_seed = (
            load_design(campaign_file, kind, cases, seed=seed).draws(3) for cases, seed in ((10, 5), (11, 5), (10, 6))
        )
        assert (small == large, small == other_seed) == (is_equal, False)


def test_grid_is_a_full_factorial_in_all_designs(campaign_file: CampaignFile) -> None:
    for kind in ("random", "latin-hypercube", "sobol"):
        campaign = load_design(campaign_file, kind, 48, dispersions=DISPERSIONS + GRID)
        draws = [campaign.draws(case) for case in range(48)]
        points = [(draw["terrain"], draw["error_scale"]) for draw in draws]
        assert points[:6] == [(0.0, 0.5), (0.0, 2.0), (3.0, 0.5), (3.0, 2.0), (6.0, 0.5), (6.0, 2.0)]
        assert points == points[:6] * 8
        if kind != "random":  # the 8 cases at each of the 6 grid points are stratified
            rows = read_probabilities(campaign, range(48))[:, 0].reshape(8, 6)
            assert np.all(np.sort(np.floor(8 * rows), axis=0) == np.arange(8)[:, None])
            assert len(np.unique(rows)) == 48


def test_nominal_case_uses_no_draws(campaign_file: CampaignFile) -> None:
    derived_entry = 'altitude_m = {distribution = "derived", formula = "1000 + 100 * heights_m[1]"}\n'
    fixed_entry = 'lowest_altitude_m = {distribution = "fixed", value = 7.0}\n'
    text = DISPERSIONS + GRID + derived_entry + fixed_entry
    campaign = load_design(campaign_file, "random", 7, dispersions=text, nominal=True)
    assert campaign.probabilities(0) is None
    nominal = campaign.parameters(0).model_dump()
    assert nominal["wind"] == {"east_m_s": 0.0, "north_m_s": 0.0}
    assert (nominal["altitude_m"], nominal["lowest_altitude_m"], nominal["terrain"]) == (1200.0, 7.0, 0)
    # the other cases are drawn as without a nominal case
    assert campaign.draws(1)["altitude_m"] == 1000.0 + 100.0 * campaign.draws(1)["heights_m.1"]


@pytest.mark.parametrize(
    ("kind", "cases", "options", "message"),
    [
        ("sobol", 48, {}, "design: a Sobol design needs a power of 2, such as 32 or 64"),
        ("sobol", 32, {"nominal": True}, "31 cases after the nominal case"),
        ("sobol", 18, {"dispersions": DISPERSIONS + GRID}, "a power of 2 at each point of the grid, such as 2 or 4"),
        ("random", 7, {"dispersions": DISPERSIONS + GRID}, "cases: 7 cases do not fit the sampling design: the grid"),
        ("latin-hypercube", 1, {"nominal": True}, "no case remains"),
        ("latin-hypercube", 2**20 + 1, {}, "has at most 1048576 cases"),
        ("sobol", 8, {"extra_keys": "appended = [8, 3]"}, "appended[1]: 3 cases do not fit the sampling design"),
        ("halton", 8, {}, "design.kind: input should be 'random', 'latin-hypercube', 'sobol' or 'adaptive', got 'h"),
    ],
)
def test_invalid_designs_are_rejected(
    campaign_file: CampaignFile, kind: str, cases: int, options: dict[str, object], message: str
) -> None:
    with pytest.raises(DefinitionError) as error:
        load_design(campaign_file, kind, cases, **options)  # type: ignore[arg-type]
    assert message in str(error.value)
