"""Tests of formulas: arithmetic with parameters is evaluated; other syntax is rejected."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marsyard.campaigns.sampling.dispersion import MAX_FORMULA_LENGTH, parse_formula

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


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "().__class__",
        "altitude_m.__class__()",
        "[x for x in (1, 2)]",
        "lambda: 1",
        "'a'",
        "1j",
        "True",
        "a if b else c",
        "a < b",
        "a[b]",
        "a[1.5]",
        "a[-1]",
        "a['b']",
        "a and b",
        "a // b",
        "a % b",
        "a @ b",
        "~a",
        "(1, 2)",
        "a := 3",
        "f'{a}'",
        "max(*a)",
        "sqrt(x=1)",
        "sqrt(1, 2)",
        "eval(1)",
        "",
        "a b",
        "1; 2",
        "a\x00",
        "(" * 100,
        "9" * (MAX_FORMULA_LENGTH + 1),
        "[" * 200 + "1" + "]" * 200,
    ],
)
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
