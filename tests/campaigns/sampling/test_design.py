"""Sampling designs: stratification, cases drawn alone, appended blocks and added dispersions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.stats import qmc

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import ConfigurationError
from marsyard.campaigns.sampling.design import build_stratified_design

CampaignFile = Callable[..., Path]
HEAD = (
    'name = "fake"\nscenario = "tests.campaigns.fake_scenario:FakeScenario"\nseed = {seed}\ncases = {cases}\n{more}\n'
)
DISPERSIONS = """
[dispersions]
"wind.east_m_s" = {distribution = "uniform", low = 0, high = 1}
"wind.north_m_s" = {distribution = "normal", mean = 0, sd = 1}
"heights_m.1" = {distribution = "beta", a = 2, b = 5}
kind = {distribution = "choice", values = ["rough", "plain"]}
"""
GROUP = """
[[correlations]]
parameters = ["wind.north_m_s", "heights_m.1"]
rank = [[1.0, 0.8], [0.8, 1.0]]
"""
GRID = """
terrain = {distribution = "grid", low = 0, high = 6, step = 3}
error_scale = {distribution = "grid", values = [0.5, 2.0]}
"""


def load(
    file: CampaignFile,
    kind: str,
    cases: int,
    *,
    dispersions: str = DISPERSIONS,
    nominal: bool = False,
    seed: int = 5,
    more: str = "",
) -> Campaign:
    design = f'[design]\nkind = "{kind}"\nnominal = {str(nominal).lower()}\n'
    head = HEAD.format(cases=cases, seed=seed, more=more)
    return load_campaign(str(file(head=head, dispersions=design + dispersions)))


def uniform(of: Campaign, cases: range) -> np.ndarray:
    return np.array([list((of.probabilities(case) or {}).values()) for case in cases])


@given(cases=st.integers(1, 300), seed=st.integers(0, 2**63 - 1))
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_stratum_of_a_latin_hypercube_holds_one_case(campaign_file: CampaignFile, cases: int, seed: int) -> None:
    for dispersions in (DISPERSIONS, DISPERSIONS + GROUP):
        points = uniform(
            load(campaign_file, "latin-hypercube", cases, dispersions=dispersions, seed=seed), range(cases)
        )
        assert points.shape == (cases, 4)
        for column in points.T:
            assert sorted(np.floor(column * cases).astype(int).tolist()) == list(range(cases))


def test_strata_reach_the_values(campaign_file: CampaignFile) -> None:
    campaign = load(campaign_file, "latin-hypercube", 200, dispersions=DISPERSIONS + GROUP)
    drawn = [campaign.draws(case) for case in range(200)]
    normal = stats.norm.cdf([one["wind.north_m_s"] for one in drawn])
    assert sorted(np.floor(200 * normal).astype(int).tolist()) == list(range(200))
    assert [one["kind"] for one in drawn].count("rough") == 100


def test_columns_of_a_latin_hypercube_are_independent(campaign_file: CampaignFile) -> None:
    points = uniform(load(campaign_file, "latin-hypercube", 2000), range(2000))
    found = stats.spearmanr(points).statistic - np.eye(4)
    # six pairs of random orders: the largest stays below 4.5 standard errors
    assert np.abs(found).max() < 4.5 / np.sqrt(1999)


def test_a_sobol_design_is_a_net(campaign_file: CampaignFile) -> None:
    """The first two scrambled dimensions of 2^m points: one in every elementary interval of volume 2^-m (t = 0)."""
    points = uniform(load(campaign_file, "sobol", 256), range(256))[:, :2]
    for rows in range(9):
        boxes = np.floor(points * [2**rows, 2 ** (8 - rows)]).astype(int)
        assert len({tuple(box) for box in boxes.tolist()}) == 256
    assert points.min() > 0.0
    assert points.max() < 1.0


def test_a_sobol_design_is_evener_than_random_draws(campaign_file: CampaignFile) -> None:
    sobol = uniform(load(campaign_file, "sobol", 512), range(512))
    random = uniform(load(campaign_file, "random", 512), range(512))
    assert qmc.discrepancy(sobol) < 0.1 * qmc.discrepancy(random)


@pytest.mark.parametrize("kind", ["random", "latin-hypercube", "sobol"])
@pytest.mark.parametrize("nominal", [False, True])
def test_any_case_is_drawn_alone(campaign_file: CampaignFile, kind: str, nominal: bool) -> None:
    cases = 6 * 16 + nominal
    of: dict[str, Any] = {"dispersions": DISPERSIONS + GRID + GROUP, "nominal": nominal}
    forward = load(campaign_file, kind, cases, **of)
    drawn = [forward.draws(case) for case in range(cases)]
    for case in (cases - 1, 17, 3, 0):
        build_stratified_design.cache_clear()
        assert load(campaign_file, kind, cases, **of).draws(case) == drawn[case]
    assert len({str(one) for one in drawn}) == cases


@pytest.mark.parametrize("kind", ["random", "latin-hypercube", "sobol"])
@given(name=st.sampled_from(["wind.east_m_s", "heights_m.0", "lowest_altitude_m"]), case=st.integers(0, 63))
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_an_added_dispersion_changes_no_other_draw(
    campaign_file: CampaignFile, kind: str, name: str, case: int
) -> None:
    """Wherever it stands in the file; of a Sobol design's dimensions only if it stands behind the others."""
    others = DISPERSIONS.replace('"wind.east_m_s" = {distribution = "uniform", low = 0, high = 1}', "")
    one = f'"{name}" = {{distribution = "uniform", low = 0, high = 1}}\n'
    without = load(campaign_file, kind, 64, dispersions=others).draws(case)
    texts = (
        [others + one] if kind == "sobol" else [others + one, others.replace("[dispersions]", f"[dispersions]\n{one}")]
    )
    for text in texts:
        drawn = load(campaign_file, kind, 64, dispersions=text).draws(case)
        assert 0.0 < drawn.pop(name) < 1.0
        assert drawn == without


@pytest.mark.parametrize("kind", ["random", "latin-hypercube", "sobol"])
def test_an_appended_block_keeps_the_earlier_cases(campaign_file: CampaignFile, kind: str) -> None:
    before = load(campaign_file, kind, 33, nominal=True)
    after = load(campaign_file, kind, 33, nominal=True, more="appended = [16, 8]")
    assert after.configuration.total_cases == 57
    assert [after.draws(case) for case in range(33)] == [before.draws(case) for case in range(33)]
    points = uniform(after, range(1, 57))
    assert len(np.unique(points[:, 0])) == 56
    if kind != "random":
        for block in (points[:32], points[32:48], points[48:]):
            assert sorted(np.floor(block[:, 0] * len(block)).astype(int).tolist()) == list(range(len(block)))


def test_the_size_is_part_of_what_a_latin_hypercube_is(campaign_file: CampaignFile) -> None:
    small, large = (load(campaign_file, "latin-hypercube", cases) for cases in (10, 11))
    assert small.draws(3) != large.draws(3)
    assert load(campaign_file, "random", 10).draws(3) == load(campaign_file, "random", 11).draws(3)


def test_a_grid_is_a_full_factorial_under_any_design(campaign_file: CampaignFile) -> None:
    for kind in ("random", "latin-hypercube", "sobol"):
        campaign = load(campaign_file, kind, 48, dispersions=DISPERSIONS + GRID)
        drawn = [campaign.draws(case) for case in range(48)]
        points = [(one["terrain"], one["error_scale"]) for one in drawn]
        assert points[:6] == [(0.0, 0.5), (0.0, 2.0), (3.0, 0.5), (3.0, 2.0), (6.0, 0.5), (6.0, 2.0)]
        assert points == points[:6] * 8
        if kind != "random":  # each point of the grid has a design of its own
            rows = uniform(campaign, range(48))[:, 0].reshape(8, 6)
            assert np.all(np.sort(np.floor(8 * rows), axis=0) == np.arange(8)[:, None])
            assert len(np.unique(rows)) == 48


def test_the_nominal_case_draws_nothing(campaign_file: CampaignFile) -> None:
    derived = 'altitude_m = {distribution = "derived", formula = "1000 + 100 * heights_m[1]"}\n'
    fixed = 'lowest_altitude_m = {distribution = "fixed", value = 7.0}\n'
    text = DISPERSIONS + GRID + derived + fixed
    campaign = load(campaign_file, "random", 7, dispersions=text, nominal=True)
    assert campaign.probabilities(0) is None
    nominal = campaign.parameters(0).model_dump()
    assert nominal["wind"] == {"east_m_s": 0.0, "north_m_s": 0.0}
    assert (nominal["altitude_m"], nominal["lowest_altitude_m"], nominal["terrain"]) == (1200.0, 7.0, 0)
    # the drawn cases are what they are without it, but for their numbers
    assert campaign.draws(1)["altitude_m"] == 1000.0 + 100.0 * campaign.draws(1)["heights_m.1"]


@pytest.mark.parametrize(
    ("kind", "cases", "more", "message"),
    [
        ("sobol", 48, {}, "cases: 48 cases cannot be laid out: a Sobol design takes a power of 2, such as 32 or 64"),
        ("sobol", 32, {"nominal": True}, "31 cases behind the nominal one"),
        ("sobol", 18, {"dispersions": DISPERSIONS + GRID}, "a power of 2 at each point of the grid, such as 2 or 4"),
        ("random", 7, {"dispersions": DISPERSIONS + GRID}, "cases: 7 cases cannot be laid out: the grid has 6 points"),
        ("latin-hypercube", 1, {"nominal": True}, "none is left"),
        ("latin-hypercube", 2**20 + 1, {}, "has at most 1048576 cases"),
        ("sobol", 8, {"more": "appended = [8, 3]"}, "appended[1]: 3 cases cannot be laid out"),
        ("halton", 8, {}, "design.kind: input should be 'random', 'latin-hypercube' or 'sobol', got 'halton'"),
    ],
)
def test_impossible_designs_are_refused(
    campaign_file: CampaignFile, kind: str, cases: int, more: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load(campaign_file, kind, cases, **more)  # type: ignore[arg-type]
    assert message in str(caught.value)
