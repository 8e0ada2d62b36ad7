"""Numbers, fractions and requirements as text: significant digits, and rates never rounded up to certainty."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

#: Text of a missing value.
NOTHING = "–"

#: Magnitudes below this are rounding errors of double precision in any unit that rows have (metres, degrees, pixels).
_ROUNDING = 1e-9

#: Built-in populations in words; other populations are columns of true and false.
_POPULATIONS = {"all": "all cases", "completed": "completed cases", "valid": "valid answers"}


def asked_text(asked: Any, metric: str) -> str:
    """A requirement (of a campaign, or repeated by a verdict) in words, with the metric's name for readers."""
    unbounded = asked.bound is None or math.isnan(asked.bound)
    scaled = "" if asked.scale == 1.0 else f"{asked.scale:g} × "
    what = metric if unbounded else f"{scaled}|{metric}| ≤ {asked.bound:g}"
    confidence = f"{stated(asked.confidence)} confidence"
    how = f"decided by rate, bounds at {confidence}" if asked.decide_by == "estimate" else f"at {confidence}"
    return f"{what} in at least {stated(asked.probability)} of {population_text(asked.population)}, {how}"


def population_text(population: str) -> str:
    """A population in words: ``valid answers``, ``cases with room``, ``valid answers with room``."""
    parts = population.split(" and ")
    whole = next((_POPULATIONS[part] for part in parts if part in _POPULATIONS), "cases")
    flags = [part.removeprefix("with_").replace("_", " ") for part in parts if part not in _POPULATIONS]
    return f"{whole} with {' and '.join(flags)}" if flags else whole


def number(value: float) -> str:
    """A number with about three significant digits; a dash where there is none, 0 for what rounding errors left.

    >>> number(1.23456), number(123.456), number(0.0123456), number(9.09e-13)
    ('1.235', '123.5', '0.0123', '0.000')
    """
    if not math.isfinite(value):
        return NOTHING if math.isnan(value) else "∞" if value > 0 else "−∞"
    magnitude = abs(value) if abs(value) >= _ROUNDING else 0.0
    if magnitude != 0.0 and (magnitude >= 1e5 or magnitude < 1e-3):
        return f"{value:.2e}".replace("-", "−")
    places = ((0.0, 3), (0.01, 5), (0.1, 4), (10.0, 3), (100.0, 2), (math.inf, 1))
    digits = next(digits for below, digits in places if magnitude <= below)
    return f"{value if magnitude else 0.0:.{digits}f}".replace("-", "−")


def coefficient(value: float) -> str:
    """A correlation, to three decimals; a dash where there is none.

    >>> coefficient(-0.25), coefficient(1e-5)
    ('−0.250', '0.000')
    """
    return NOTHING if math.isnan(value) else f"{value:z.3f}".replace("-", "−")


def p_text(value: float) -> str:
    """A probability of a test; a dash for NaN."""
    if math.isnan(value):
        return NOTHING
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def interval(lower: float, upper: float) -> str:
    """Two bounds; one alone, or a dash, where the sample is too small to give both."""
    if math.isfinite(lower) and math.isfinite(upper):
        return f"{number(lower)} to {number(upper)}"
    if math.isfinite(lower):
        return f"≥ {number(lower)}"
    return f"≤ {number(upper)}" if math.isfinite(upper) else NOTHING


def percent(fraction: float) -> str:
    """A measured fraction in per cent, never rounded up to 100 nor down to 0; a dash for NaN.

    Some shares exceed 1: wheels slip by more where they slide back.
    """
    if math.isnan(fraction):
        return NOTHING
    if fraction in (0.0, 1.0):
        return f"{100.0 * fraction:.0f} %"
    if not 0.0 < fraction < 1.0:
        return f"{100.0 * fraction:.2f} %"
    for decimals in range(2, 8):
        text = f"{100.0 * fraction:.{decimals}f}"
        if 0.0 < float(text) < 100.0:
            return f"{text} %"
    return "< 0.0000001 %" if fraction < 0.5 else "> 99.9999999 %"


def stated(fraction: float) -> str:
    """A given fraction in per cent, with all its digits."""
    return NOTHING if math.isnan(fraction) else f"{100.0 * fraction:.10g} %"


def count(quantity: int, noun: str) -> str:
    """A quantity with its noun: ``1 case``, ``24 cases``."""
    return f"{quantity:,} {noun}{'' if quantity == 1 else 's'}"


def plain_value(value: object) -> str:
    """A stored value as text, whole numbers without a decimal point."""
    return str(int(value)) if isinstance(value, float | np.floating) and value.is_integer() else str(value)


@cache
def _notes() -> Mapping[str, Mapping[str, str]]:
    with (Path(__file__).parent / "templates" / "notes.toml").open("rb") as file:
        return tomllib.load(file)


def note_text(key: str, **values: object) -> str:
    """A text of `templates/notes.toml` by ``table.key``, with its values."""
    table, name = key.split(".")
    return _notes()[table][name].format(**values)
