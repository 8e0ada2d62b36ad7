"""Draws follow their distributions, and one dispersion's draws depend on nothing but itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy import stats

from campaigns.dispersions import TAIL, AnyDispersion, Dispersion
from campaigns.loading import load_campaign
from sim.streams import Streams

CampaignFile = Callable[..., Path]
CASES = 2000
#: The streams are fixed, so the outcome is too; a right sampler passes this for all but one seed in a thousand.
LEAST_P = 1e-3


def dispersion(**stated: object) -> Dispersion:
    adapter: TypeAdapter[Dispersion] = TypeAdapter(AnyDispersion)
    return adapter.validate_python(stated)


def draws(drawn: Dispersion) -> np.ndarray:
    uniform = [Streams(1, "ks", case).generator("dispersion:x").random() for case in range(CASES)]
    return np.array([drawn.quantile(value) for value in uniform])


@pytest.mark.parametrize(
    ("drawn", "shape"),
    [
        (dispersion(distribution="uniform", low=-30, high=30), stats.uniform(-30, 60)),
        (dispersion(distribution="normal", mean=5, sd=2), stats.norm(5, 2)),
        (dispersion(distribution="normal", mean=5, sd=2, truncate=[4, 12]), stats.truncnorm(-0.5, 3.5, 5, 2)),
        (dispersion(distribution="normal", mean=5, sd=2, truncate=[8, 20]), stats.truncnorm(1.5, 7.5, 5, 2)),
        (dispersion(distribution="truncnorm", a=-1.0, b=2.0, loc=3.0), stats.truncnorm(-1, 2, 3)),
        (dispersion(distribution="gamma", a=2.0, scale=3.0), stats.gamma(2, scale=3)),
        (dispersion(distribution="rayleigh", scale=3.0), stats.rayleigh(scale=3)),
        (dispersion(distribution="beta", a=2.0, b=5.0, loc=1.0, scale=4.0), stats.beta(2, 5, 1, 4)),
    ],
    ids=lambda value: value.describe() if isinstance(value, Dispersion) else "",
)
def test_continuous_draws_follow_their_distribution(drawn: Dispersion, shape: object) -> None:
    assert stats.kstest(draws(drawn), shape.cdf).pvalue > LEAST_P  # type: ignore[attr-defined]


def test_truncation_far_out_keeps_its_digits() -> None:
    # Beyond 9 standard deviations 1 - cdf is 0 in double precision; exponential with rate 9 is right to 1/81.
    drawn = draws(dispersion(distribution="normal", mean=0, sd=1, truncate=[9, 20]))
    assert drawn.min() >= 9.0
    assert np.unique(drawn).size == CASES
    assert drawn.mean() - 9.0 == pytest.approx(stats.truncnorm(9, 20).mean() - 9.0, rel=0.1)


def test_whole_numbers_and_choices_follow_their_weights() -> None:
    counts = np.unique_counts(draws(dispersion(distribution="integer", low=-1, high=2)))
    assert counts.values.tolist() == [-1, 0, 1, 2]
    assert stats.chisquare(counts.counts).pvalue > LEAST_P
    chosen = draws(dispersion(distribution="choice", values=["a", "b", "c"], weights=[1, 2, 5]))
    counts = np.unique_counts(chosen)
    assert stats.chisquare(counts.counts, CASES * np.array([1, 2, 5]) / 8).pvalue > LEAST_P


@pytest.mark.parametrize("probability", [2.0**-54, TAIL, 0.5, 1.0 - TAIL, 1.0 - 2.0**-53])
def test_draws_stay_within_what_is_stated(probability: float) -> None:
    assert -3 <= dispersion(distribution="uniform", low=-3, high=0.1).quantile(probability) <= 0.1
    assert 1 <= dispersion(distribution="normal", mean=0, sd=1, truncate=[1, 1.5]).quantile(probability) <= 1.5
    assert dispersion(distribution="integer", low=0, high=6).quantile(probability) in range(7)
    assert dispersion(distribution="choice", values=[1, 2]).quantile(probability) in (1, 2)
    assert np.isfinite(dispersion(distribution="norm").quantile(probability))


def test_a_case_is_drawn_alone_as_among_others(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file()))
    forward = [campaign.draws(case) for case in range(5)]
    assert [load_campaign(str(campaign_file())).draws(case) for case in reversed(range(5))] == forward[::-1]
    assert load_campaign(str(campaign_file()), cases=1000).draws(3) == forward[3]
    assert load_campaign(str(campaign_file()), seed=6).draws(3) != forward[3]
    assert len({str(drawn) for drawn in forward}) == 5


def test_adding_a_dispersion_changes_no_other_draw(campaign_file: CampaignFile) -> None:
    path = str(campaign_file())
    before = load_campaign(path).draws(4)
    added = ['dispersions."wind.north_m_s"={distribution="normal", mean=0, sd=3}']
    after = load_campaign(path, added).draws(4)
    assert after.pop("wind.north_m_s") != 0.0
    assert after == before


def test_draws_arrive_in_the_parameters(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file()))
    drawn, parameters = campaign.draws(2), campaign.parameters(2).model_dump()
    assert parameters["wind"]["east_m_s"] == drawn["wind.east_m_s"]
    assert parameters["heights_m"] == (1.0, drawn["heights_m.1"])
    assert parameters["kind"] == drawn["kind"]
    assert parameters["lowest_altitude_m"] == 0.0
