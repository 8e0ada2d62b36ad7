"""Draws follow their distributions, and one dispersion's draws depend on nothing but itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.sampling.dispersion import TAIL, Dispersion, scipy_distributions, scipy_parameters
from marsyard.campaigns.sampling.dispersions import AnyDispersion
from marsyard.sim.streams import Streams

CampaignFile = Callable[..., Path]
CASES = 2000
#: The streams are fixed, so the outcome is too; a right sampler passes this for all but one seed in a thousand.
MIN_P = 1e-3


_ADAPTER: TypeAdapter[Dispersion] = TypeAdapter(AnyDispersion)


def dispersion(**stated: object) -> Dispersion:
    return _ADAPTER.validate_python(stated)


@cache
def uniform() -> list[float]:
    return [float(Streams(1, "ks", case).generator("dispersion:x").random()) for case in range(CASES)]


def draws(drawn: Dispersion) -> np.ndarray:
    return np.array([drawn.quantile(value) for value in uniform()])


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
    assert stats.kstest(draws(drawn), shape.cdf).pvalue > MIN_P  # type: ignore[attr-defined]


_SHAPES: dict[str, dict[str, st.SearchStrategy[float]]] = {
    "beta": {"a": st.floats(0.5, 8.0), "b": st.floats(0.5, 8.0)},
    "expon": {},
    "gamma": {"a": st.floats(0.5, 20.0)},
    "gumbel_r": {},
    "laplace": {},
    "lognorm": {"s": st.floats(0.1, 1.5)},
    "norm": {},
    "rayleigh": {},
    "t": {"df": st.floats(2.0, 30.0)},
    "triang": {"c": st.floats(0.0, 1.0)},
    "weibull_min": {"c": st.floats(0.7, 5.0)},
}


@given(data=st.data(), name=st.sampled_from(sorted(_SHAPES)))
@settings(max_examples=25)
def test_any_distribution_of_scipy_is_followed_within_any_limits(data: st.DataObject, name: str) -> None:
    """Of forty thousand runs of twenty-five examples chance alone fails one: the least p is 1e-6."""
    stated = {key: data.draw(values) for key, values in _SHAPES[name].items()}
    stated |= {"loc": data.draw(st.floats(-100.0, 100.0)), "scale": data.draw(st.floats(0.1, 100.0))}
    shape = getattr(stats, name)(**stated)
    first = data.draw(st.floats(0.0, 0.9))
    limits = [float(shape.ppf(max(first, 1e-9))), float(shape.ppf(data.draw(st.floats(first + 0.05, 1.0 - 1e-9))))]
    drawn = draws(dispersion(distribution=name, truncate=limits, **stated))
    assert limits[0] <= drawn.min()
    assert drawn.max() <= limits[1]
    low, high = shape.cdf(limits)
    assert stats.kstest(drawn, lambda x: (shape.cdf(x) - low) / (high - low)).pvalue > 1e-6


@pytest.mark.parametrize(
    ("stated", "shape"),
    [
        ({"distribution": "poisson", "mu": 3.5}, stats.poisson(3.5)),
        ({"distribution": "poisson", "mu": 3.5, "truncate": [1.5, 6.0]}, stats.poisson(3.5)),
        ({"distribution": "binom", "n": 12, "p": 0.3, "loc": 2, "truncate": [4, 9]}, stats.binom(12, 0.3, 2)),
        ({"distribution": "geom", "p": 0.25, "truncate": [6, 15]}, stats.geom(0.25)),
    ],
)
def test_whole_numbers_of_scipy_follow_their_weights(stated: dict[str, Any], shape: Any) -> None:
    one = dispersion(**stated)
    drawn = [one.quantile(value) for value in np.random.default_rng(3).random(CASES)]
    assert {type(one) for one in drawn} == {int}
    first, last = stated.get("truncate", (0, 60))
    allowed = np.arange(np.ceil(first), last + 1)
    chance = shape.pmf(allowed) / shape.pmf(allowed).sum()
    assert set(drawn) <= set(allowed.astype(int).tolist())
    often = chance * CASES > 5
    seen = np.array([drawn.count(int(value)) for value in allowed])
    table = [np.append(np.asarray(one)[often], np.asarray(one)[~often].sum()) for one in (seen, chance * CASES)]
    kept = table[1] > 0
    assert stats.chisquare(table[0][kept], table[1][kept]).pvalue > MIN_P


@pytest.mark.parametrize("name", sorted(scipy_distributions()))
def test_every_distribution_of_scipy_is_drawn_or_refused(name: str) -> None:
    """Whatever its parameters are: a ValidationError, or a finite value between its bounds."""
    required, allowed = scipy_parameters(name)
    for value in (0.5, 1.0, 3.0, -2.0):
        stated = dict.fromkeys(required, value) | ({"scale": 2.0} if "scale" in allowed else {})
        try:
            one = dispersion(distribution=name, **stated)
        except ValidationError:
            continue
        low, high = one.bounds() or (-np.inf, np.inf)
        assert low <= one.quantile(0.3) <= high


def test_grids_have_their_levels() -> None:
    assert dispersion(distribution="grid", low=0, high=1, levels=5).extremes() == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert dispersion(distribution="grid", low=-1, high=2, step=0.1).extremes()[::10] == (-1.0, 0.0, 1.0, 2.0)
    grid = dispersion(distribution="grid", values=["a", 2, {"b": 3.0}])
    assert [grid.quantile((place + 0.5) / 3) for place in range(3)] == ["a", 2, {"b": 3.0}]


def test_numbers_may_depend_on_drawn_ones(campaign_file: CampaignFile) -> None:
    text = """
    [dispersions]
    lowest_altitude_m = {distribution = "uniform", low = "altitude_m - 300", high = "altitude_m - 100"}
    altitude_m = {distribution = "normal", mean = "1500 + 100 * terrain", sd = "5 + terrain", truncate = [1000, 3000]}
    terrain = {distribution = "integer", low = 0, high = "shared"}
    "heights_m.1" = {distribution = "gamma", a = 3.0, scale = "0.5 * heights_m[0]"}
    """
    campaign = load_campaign(str(campaign_file("shared = 4\nheights_m = [6.0, 1.0]", dispersions=text)))
    assert campaign.order == ("terrain", "heights_m.1", "altitude_m", "lowest_altitude_m")
    drawn = [campaign.draws(case) for case in range(CASES)]
    assert list(drawn[0]) == ["lowest_altitude_m", "altitude_m", "terrain", "heights_m.1"]
    values = {name: np.array([one[name] for one in drawn]) for name in drawn[0]}
    assert set(values["terrain"].tolist()) == {0, 1, 2, 3, 4}
    standard = (values["altitude_m"] - 1500.0 - 100.0 * values["terrain"]) / (5.0 + values["terrain"])
    assert stats.kstest(standard, stats.norm.cdf).pvalue > MIN_P
    share = (values["lowest_altitude_m"] - values["altitude_m"] + 300.0) / 200.0
    assert stats.kstest(share, stats.uniform.cdf).pvalue > MIN_P
    assert stats.kstest(values["heights_m.1"], stats.gamma(3, scale=3).cdf).pvalue > MIN_P
    # what is set on the command line is what the formulas see
    fixed = load_campaign(str(campaign_file("shared = 4", dispersions=text)), ["terrain=2"])
    assert (
        fixed.configuration.dispersions["altitude_m"]
        .insert_values({"terrain": 2})
        .describe()
        .startswith("normal(mean=1700")
    )


def test_truncation_far_out_keeps_its_digits() -> None:
    # Beyond 9 standard deviations 1 - cdf is 0 in double precision; exponential with rate 9 is right to 1/81.
    drawn = draws(dispersion(distribution="normal", mean=0, sd=1, truncate=[9, 20]))
    assert drawn.min() >= 9.0
    assert np.unique(drawn).size == CASES
    assert drawn.mean() - 9.0 == pytest.approx(stats.truncnorm(9, 20).mean() - 9.0, rel=0.1)


def test_whole_numbers_and_choices_follow_their_weights() -> None:
    counts = np.unique_counts(draws(dispersion(distribution="integer", low=-1, high=2)))
    assert counts.values.tolist() == [-1, 0, 1, 2]
    assert stats.chisquare(counts.counts).pvalue > MIN_P
    chosen = draws(dispersion(distribution="choice", values=["a", "b", "c"], weights=[1, 2, 5]))
    counts = np.unique_counts(chosen)
    assert stats.chisquare(counts.counts, CASES * np.array([1, 2, 5]) / 8).pvalue > MIN_P


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


@pytest.mark.parametrize("design", ["random", "sobol"])
def test_whole_numbers_in_turn_repeat_only_when_all_are_used(campaign_file: CampaignFile, design: str) -> None:
    dispersions = '[dispersions]\nterrain = {distribution = "in-turn", low = 2, high = "2 + 2"}\n'
    path = campaign_file(dispersions=dispersions, more=f'[design]\nkind = "{design}"\n')
    campaign = load_campaign(str(path), cases=8)
    assert [campaign.draws(case)["terrain"] for case in range(8)] == [2, 3, 4, 2, 3, 4, 2, 3]
    with pytest.raises(ValidationError, match="must not be above"):
        dispersion(distribution="in-turn", low=3, high=2)
