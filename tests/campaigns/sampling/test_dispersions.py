"""Tests of dispersions: draws follow their distributions and do not depend on other dispersions."""

import pickle
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.sampling.dispersion_base import TAIL, Dispersion
from marsyard.campaigns.sampling.dispersions import AnyDispersion
from marsyard.campaigns.sampling.distributions import TruncationError, scipy_distributions, scipy_parameters
from marsyard.sim.streams import Streams
from tests.campaigns.fake_campaign import CampaignFile

N_CASES = 2000
#: Minimum p-value of a test: a correct sampler fails for one of 1000 seeds. The seeds are fixed.
MIN_P_VALUE = 1e-3

_ADAPTER: TypeAdapter[Dispersion] = TypeAdapter(AnyDispersion)


def make_dispersion(**keys: object) -> Dispersion:
    return _ADAPTER.validate_python(keys)


@cache
def draw_uniform_numbers() -> list[float]:
    """Draw one uniform number per case."""
    return [float(Streams(1, "ks", case).generator("dispersion:x").random()) for case in range(N_CASES)]


def draw_values(dispersion: Dispersion) -> np.ndarray:
    """Draw one value of the dispersion per case."""
    return np.array([dispersion.quantile(value) for value in draw_uniform_numbers()])


@pytest.mark.parametrize(
    ("dispersion", "reference"),
    [
        (make_dispersion(distribution="uniform", low=-30, high=30), stats.uniform(-30, 60)),
        (make_dispersion(distribution="normal", mean=5, sd=2), stats.norm(5, 2)),
        (make_dispersion(distribution="normal", mean=5, sd=2, truncate=[4, 12]), stats.truncnorm(-0.5, 3.5, 5, 2)),
        (make_dispersion(distribution="normal", mean=5, sd=2, truncate=[8, 20]), stats.truncnorm(1.5, 7.5, 5, 2)),
        (make_dispersion(distribution="truncnorm", a=-1.0, b=2.0, loc=3.0), stats.truncnorm(-1, 2, 3)),
        (make_dispersion(distribution="gamma", a=2.0, scale=3.0), stats.gamma(2, scale=3)),
        (make_dispersion(distribution="rayleigh", scale=3.0), stats.rayleigh(scale=3)),
        (make_dispersion(distribution="beta", a=2.0, b=5.0, loc=1.0, scale=4.0), stats.beta(2, 5, 1, 4)),
    ],
    ids=lambda value: value.describe() if isinstance(value, Dispersion) else "",
)
def test_continuous_draws_follow_their_distribution(dispersion: Dispersion, reference: object) -> None:
    assert stats.kstest(draw_values(dispersion), reference.cdf).pvalue > MIN_P_VALUE  # type: ignore[attr-defined]


_SHAPE_PARAMETERS: dict[str, dict[str, st.SearchStrategy[float]]] = {
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


@pytest.mark.slow
@given(data=st.data(), name=st.sampled_from(sorted(_SHAPE_PARAMETERS)))
@settings(max_examples=25)
def test_truncated_scipy_draws_follow_their_distribution(data: st.DataObject, name: str) -> None:
    """With a significance level of 1e-6, a correct sampler fails in one of 40,000 runs of 25 examples."""
    keys = {key: data.draw(values) for key, values in _SHAPE_PARAMETERS[name].items()}
    keys |= {"loc": data.draw(st.floats(-100.0, 100.0)), "scale": data.draw(st.floats(0.1, 100.0))}
    reference = getattr(stats, name)(**keys)
    low_probability = data.draw(st.floats(0.0, 0.9))
    high_probability = data.draw(st.floats(low_probability + 0.05, 1.0 - 1e-9))
    limits = [float(reference.ppf(max(low_probability, 1e-9))), float(reference.ppf(high_probability))]
    draws = draw_values(make_dispersion(distribution=name, truncate=limits, **keys))
    assert limits[0] <= draws.min()
    assert draws.max() <= limits[1]
    low, high = reference.cdf(limits)
    assert stats.kstest(draws, lambda x: (reference.cdf(x) - low) / (high - low)).pvalue > 1e-6


@pytest.mark.parametrize(
    ("keys", "reference"),
    [
        ({"distribution": "poisson", "mu": 3.5}, stats.poisson(3.5)),
        ({"distribution": "poisson", "mu": 3.5, "truncate": [1.5, 6.0]}, stats.poisson(3.5)),
        ({"distribution": "binom", "n": 12, "p": 0.3, "loc": 2, "truncate": [4, 9]}, stats.binom(12, 0.3, 2)),
        ({"distribution": "geom", "p": 0.25, "truncate": [6, 15]}, stats.geom(0.25)),
    ],
)
def test_discrete_scipy_draws_follow_their_weights(keys: dict[str, Any], reference: Any) -> None:
    dispersion = make_dispersion(**keys)
    draws = [dispersion.quantile(value) for value in np.random.default_rng(3).random(N_CASES)]
    assert {type(value) for value in draws} == {int}
    first, last = keys.get("truncate", (0, 60))
    allowed = np.arange(np.ceil(first), last + 1)
    probabilities = reference.pmf(allowed) / reference.pmf(allowed).sum()
    assert set(draws) <= set(allowed.astype(int).tolist())
    # the chi-square test needs more than five expected draws; other values are counted together
    is_frequent = probabilities * N_CASES > 5
    observed = np.array([draws.count(int(value)) for value in allowed])
    observed_counts, expected_counts = (
        np.append(counts[is_frequent], counts[~is_frequent].sum()) for counts in (observed, probabilities * N_CASES)
    )
    is_used = expected_counts > 0
    assert stats.chisquare(observed_counts[is_used], expected_counts[is_used]).pvalue > MIN_P_VALUE


@pytest.mark.parametrize("name", sorted(scipy_distributions()))
def test_scipy_distributions_give_finite_values_or_errors(name: str) -> None:
    """Each parameter value gives a ValidationError, or a finite draw within the bounds."""
    required, allowed = scipy_parameters(name)
    for value in (0.5, 1.0, 3.0, -2.0):
        keys = dict.fromkeys(required, value) | ({"scale": 2.0} if "scale" in allowed else {})
        try:
            dispersion = make_dispersion(distribution=name, **keys)
        except ValidationError:
            continue
        low, high = dispersion.bounds() or (-np.inf, np.inf)
        assert low <= dispersion.quantile(0.3) <= high


def test_grids_have_the_expected_levels() -> None:
    """For a grid, `extremes` returns all levels."""
    assert make_dispersion(distribution="grid", low=0, high=1, levels=5).extremes() == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert make_dispersion(distribution="grid", low=-1, high=2, step=0.1).extremes()[::10] == (-1.0, 0.0, 1.0, 2.0)
    grid = make_dispersion(distribution="grid", values=["a", 2, {"b": 3.0}])
    assert [grid.quantile((position + 0.5) / 3) for position in range(3)] == ["a", 2, {"b": 3.0}]


def test_formulas_use_draws_and_parameters(campaign_file: CampaignFile) -> None:
    text = """
    [dispersions]
    lowest_altitude_m = {distribution = "uniform", low = "altitude_m - 300", high = "altitude_m - 100"}
    altitude_m = {distribution = "normal", mean = "1500 + 100 * terrain", sd = "5 + terrain", truncate = [1000, 3000]}
    terrain = {distribution = "integer", low = 0, high = "shared"}
    "heights_m.1" = {distribution = "gamma", a = 3.0, scale = "0.5 * heights_m[0]"}
    """
    campaign = load_campaign(str(campaign_file("shared = 4\nheights_m = [6.0, 1.0]", dispersions=text)))
    assert campaign.order == ("terrain", "heights_m.1", "altitude_m", "lowest_altitude_m")
    draws = [campaign.draws(case) for case in range(N_CASES // 4)]
    assert list(draws[0]) == ["lowest_altitude_m", "altitude_m", "terrain", "heights_m.1"]
    values = {name: np.array([draw[name] for draw in draws]) for name in draws[0]}
    assert set(values["terrain"].tolist()) == {0, 1, 2, 3, 4}
    standardised_altitude = (values["altitude_m"] - 1500.0 - 100.0 * values["terrain"]) / (5.0 + values["terrain"])
    assert stats.kstest(standardised_altitude, stats.norm.cdf).pvalue > MIN_P_VALUE
    fraction = (values["lowest_altitude_m"] - values["altitude_m"] + 300.0) / 200.0
    assert stats.kstest(fraction, stats.uniform.cdf).pvalue > MIN_P_VALUE
    assert stats.kstest(values["heights_m.1"], stats.gamma(3, scale=3).cdf).pvalue > MIN_P_VALUE
    # formulas use the values of overrides
    # with terrain 2, the mean altitude is 1500 + 100 * 2
    campaign_with_fixed_terrain = load_campaign(str(campaign_file("shared = 4", dispersions=text)), ["terrain=2"])
    altitude = campaign_with_fixed_terrain.definition.dispersions["altitude_m"].insert_values({"terrain": 2})
    assert altitude.describe().startswith("normal(mean=1700")


def test_truncation_in_the_far_tail_is_accurate() -> None:
    # beyond 9 standard deviations, 1 - cdf is 0 in double precision
    draws = draw_values(make_dispersion(distribution="normal", mean=0, sd=1, truncate=[9, 20]))
    assert draws.min() >= 9.0
    assert np.unique(draws).size == N_CASES
    assert draws.mean() - 9.0 == pytest.approx(stats.truncnorm(9, 20).mean() - 9.0, rel=0.1)


def test_integers_and_choices_follow_their_probabilities() -> None:
    counts = np.unique_counts(draw_values(make_dispersion(distribution="integer", low=-1, high=2)))
    assert counts.values.tolist() == [-1, 0, 1, 2]
    assert stats.chisquare(counts.counts).pvalue > MIN_P_VALUE
    choices = draw_values(make_dispersion(distribution="choice", values=["a", "b", "c"], weights=[1, 2, 5]))
    counts = np.unique_counts(choices)
    assert stats.chisquare(counts.counts, N_CASES * np.array([1, 2, 5]) / 8).pvalue > MIN_P_VALUE


@pytest.mark.parametrize("probability", [2.0**-54, TAIL, 0.5, 1.0 - TAIL, 1.0 - 2.0**-53])
def test_draws_stay_within_their_bounds(probability: float) -> None:
    assert -3 <= make_dispersion(distribution="uniform", low=-3, high=0.1).quantile(probability) <= 0.1
    assert 1 <= make_dispersion(distribution="normal", mean=0, sd=1, truncate=[1, 1.5]).quantile(probability) <= 1.5
    assert make_dispersion(distribution="integer", low=0, high=6).quantile(probability) in range(7)
    assert make_dispersion(distribution="choice", values=[1, 2]).quantile(probability) in (1, 2)
    assert np.isfinite(make_dispersion(distribution="norm").quantile(probability))


def test_draws_set_the_parameters(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file()))
    draws, parameters = campaign.draws(2), campaign.parameters(2).model_dump()
    assert parameters["wind"]["east_m_s"] == draws["wind.east_m_s"]
    assert parameters["heights_m"] == (1.0, draws["heights_m.1"])
    assert parameters["kind"] == draws["kind"]
    assert parameters["lowest_altitude_m"] == 0.0


@pytest.mark.parametrize("design", ["random", "sobol"])
def test_in_turn_integers_are_used_in_order_and_repeated(campaign_file: CampaignFile, design: str) -> None:
    dispersions = '[dispersions]\nterrain = {distribution = "in-turn", low = 2, high = "2 + 2"}\n'
    path = campaign_file(dispersions=dispersions, extra_tables=f'[design]\nkind = "{design}"\n')
    campaign = load_campaign(str(path), cases=8)
    assert [campaign.draws(case)["terrain"] for case in range(8)] == [2, 3, 4, 2, 3, 4, 2, 3]
    with pytest.raises(ValidationError, match="must not be above"):
        make_dispersion(distribution="in-turn", low=3, high=2)


def test_truncation_error_names_the_limits_also_after_pickling() -> None:
    """A worker process sends the error to its parent."""
    error = pickle.loads(pickle.dumps(TruncationError(90, 95.0, "no probability")))  # noqa: S301
    assert str(error) == "truncate = [90, 95.0]: no probability"
    assert error.reason == "no probability"
