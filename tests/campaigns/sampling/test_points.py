"""Tests of `StudyPoint`, a case in standard normal space, and of formulas: arithmetic with parameters is evaluated."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm, spearmanr

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.sampling.formulas import MAX_FORMULA_LENGTH, parse_formula
from marsyard.campaigns.sampling.study_points import StudyPoint
from tests.campaigns.fake_campaign import campaign_fixture

CAMPAIGN = """
name = "points"
scenario = "tests.campaigns.fake_scenario:FakeScenario"
cases = 4

[parameters]
altitude_m = 1234.0

[dispersions]
"wind.east_m_s" = { distribution = "uniform", low = -30.0, high = 30.0 }
"wind.north_m_s" = { distribution = "normal", mean = 0.0, sd = 5.0 }
altitude_m = { distribution = "normal", mean = "2000 + wind.east_m_s", sd = 10.0 }
terrain = { distribution = "integer", low = 0, high = 3 }
kind = { distribution = "choice", values = ["rough", "plain"], weights = [1, 3] }

[[correlations]]
parameters = ["wind.east_m_s", "wind.north_m_s"]
rank = [[1.0, 0.6], [0.6, 1.0]]
"""


campaign_path = campaign_fixture(CAMPAIGN)


def test_points_have_the_distributions_of_the_cases(campaign_path: Path) -> None:
    campaign, rng = load_campaign(str(campaign_path)), np.random.default_rng(1)
    # five dispersions; the tolerances are three to four standard errors of 2000 points
    values = [campaign.draws_at(StudyPoint(tuple(rng.standard_normal(5)), 0)) for _ in range(2000)]
    east, north = (np.array([value[path] for value in values]) for path in ("wind.east_m_s", "wind.north_m_s"))
    assert np.quantile(east, [0.1, 0.5, 0.9]) == pytest.approx([-24.0, 0.0, 24.0], abs=2.0)
    assert spearmanr(east, north).statistic == pytest.approx(0.6, abs=0.05)
    assert np.mean([value["kind"] == "plain" for value in values]) == pytest.approx(0.75, abs=0.04)
    residuals = [value["altitude_m"] - 2000.0 - value["wind.east_m_s"] for value in values]
    assert np.std(residuals) == pytest.approx(10.0, rel=0.06)


def test_coordinates_are_quantiles_of_the_standard_normal_distribution(campaign_path: Path) -> None:
    campaign = load_campaign(str(campaign_path))
    values = campaign.draws_at(StudyPoint((1.0, 0.0, -2.0, 0.0, 0.0), 7))
    assert values["wind.east_m_s"] == pytest.approx(-30.0 + 60.0 * norm.cdf(1.0))
    assert values["altitude_m"] == pytest.approx(2000.0 + values["wind.east_m_s"] - 20.0)


def test_nominal_paths_have_the_parameters_of_the_campaign(campaign_path: Path) -> None:
    campaign = load_campaign(str(campaign_path))
    values = campaign.draws_at(StudyPoint((1.0, 1.0, 1.0, 1.0, 1.0), 0, ("altitude_m", "kind")))
    assert (values["altitude_m"], values["kind"]) == (1234.0, "plain")
    assert campaign.draws_at(StudyPoint((0.0,) * 5, 0))["terrain"] in range(4)


def test_extreme_coordinates_have_finite_values(campaign_path: Path) -> None:
    campaign = load_campaign(str(campaign_path))
    for extreme in (-40.0, 40.0):
        values = campaign.draws_at(StudyPoint((extreme,) * 5, 0))
        assert all(np.isfinite(value) for value in values.values() if isinstance(value, float))


def test_point_round_trips_as_text() -> None:
    for blend in ((), ((3, 0.8), (12, 0.6))):
        point = StudyPoint((0.1, -1.0 / 3.0), 12, ("a.b",), blend=blend)
        assert StudyPoint.read(point.text) == point
    with pytest.raises(ValueError, match="not a point"):
        StudyPoint.read("[1, 2]")


#: Values of parameters by path, as formulas use them.
VALUES = {"altitude_m": 2000.0, "wind.east_m_s": -3.0, "heights_m.1": 4, "on": True, "site": "gusev"}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.04 * altitude_m", 80.0),
        ("-wind.east_m_s + heights_m[1]", 7.0),
        ("hypot(wind.east_m_s, heights_m[1])", 5.0),
        ("2 ** 3 ** 2", 512.0),
        ("max(1, min(altitude_m, 30), 2)", 30.0),
        ("degrees(atan2(1, 1)) / (pi / pi)", 45.0),
        (" 7 ", 7.0),
        ("1e3", 1000.0),
    ],
)
def test_formulas_have_the_expected_value(text: str, value: float) -> None:
    assert parse_formula(text).evaluate(VALUES) == pytest.approx(value, rel=1e-15)


def test_formula_names_are_parameter_paths() -> None:
    assert parse_formula("a.b_m * heights_m[1] + a.b_m + pi").names == ("a.b_m", "heights_m.1")


NOT_ARITHMETIC = [
    "__import__('os').system('true')", "().__class__", "altitude_m.__class__()", "[x for x in (1, 2)]", "lambda: 1",
    "'a'", "1j", "True", "a if b else c", "a < b", "a[b]", "a[1.5]", "a[-1]", "a['b']", "a and b", "a // b", "a % b",
    "a @ b", "~a", "(1, 2)", "a := 3", "f'{a}'", "max(*a)", "sqrt(x=1)", "sqrt(1, 2)", "eval(1)", "", "a b", "1; 2",
    "a\x00", "(" * 100, "9" * (MAX_FORMULA_LENGTH + 1), "[" * 200 + "1" + "]" * 200,
]  # fmt: skip


@pytest.mark.parametrize("text", NOT_ARITHMETIC)
def test_non_arithmetic_syntax_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r"is neither a number nor a formula|has at most"):
        parse_formula(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 / (altitude_m - 2000)", "is undefined for altitude_m = 2000: "),
        ("sqrt(wind.east_m_s)", "is undefined for wind.east_m_s = -3: "),
        ("wind.east_m_s ** 0.5", "is undefined"),
        ("9.0 ** 9 ** 9", "is undefined"),
        ("1e308 * 10", "the result is inf"),
        ("site + 1", "uses site, which is 'gusev' and not a number"),
        ("on + 1", "uses on, which is True and not a number"),
    ],
)
def test_formulas_without_a_value_are_reported(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        parse_formula(text).evaluate(VALUES)


@given(text=st.text(max_size=40) | st.text("ab.[]()+-*/0123456789e ,", max_size=40))
def test_random_text_has_a_finite_value_or_is_rejected(text: str) -> None:
    try:
        formula = parse_formula(text)
        value = formula.evaluate(dict.fromkeys(formula.names, 1.5))
    except ValueError:
        return
    assert math.isfinite(value)


@given(st.recursive(
    st.floats(-1e3, 1e3).map(repr) | st.sampled_from(["a", "t.b"]),
    lambda term: st.builds("({} {} {})".format, term, st.sampled_from("+-*"), term) | term.map("(-{})".format),
    max_leaves=8,
))  # fmt: skip
def test_formulas_evaluate_like_python(text: str) -> None:
    if len(text) > MAX_FORMULA_LENGTH:
        return
    # in Python, the parameter path t.b is an attribute
    table = type("Table", (), {"b": -0.75})
    expected = eval(text, {"a": 2.5, "t": table})  # noqa: S307
    assert parse_formula(text).evaluate({"a": 2.5, "t.b": -0.75}) == expected
