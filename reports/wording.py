"""Formatted texts of reports: numbers, fractions, names of columns with units, requirements, and notes."""

import math
import tomllib
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.scenarios.columns import split_unit
from marsyard.scenarios.declared_columns import find_column
from marsyard.scenarios.declared_columns import label as column_label

#: Text of a missing value.
NOTHING = "–"

#: Magnitudes below this value are rounding errors in all units of the rows (metres, degrees, pixels).
_ROUNDING = 1e-9


def number(value: float) -> str:
    """Format a number with at least three significant digits; a dash for NaN, 0 for rounding errors.

    >>> number(1.23456), number(123.456), number(0.0123456), number(9.09e-13)
    ('1.235', '123.5', '0.0123', '0.000')
    """
    if not math.isfinite(value):
        return NOTHING if math.isnan(value) else "∞" if value > 0 else "−∞"
    magnitude = abs(value) if abs(value) >= _ROUNDING else 0.0
    if magnitude != 0.0 and (magnitude >= 1e5 or magnitude < 1e-3):
        return f"{value:.2e}".replace("-", "−")
    # numbers of decimals for magnitudes up to each limit
    digits_by_limit = ((0.0, 3), (0.01, 5), (0.1, 4), (10.0, 3), (100.0, 2), (math.inf, 1))
    digits = next(digits for limit, digits in digits_by_limit if magnitude <= limit)
    return f"{value if magnitude else 0.0:.{digits}f}".replace("-", "−")


def coefficient(value: float) -> str:
    """Format a correlation with three decimals; a dash for NaN.

    >>> coefficient(-0.25), coefficient(1e-5)
    ('−0.250', '0.000')
    """
    return NOTHING if math.isnan(value) else f"{value:z.3f}".replace("-", "−")


def p_text(value: float) -> str:
    """Format the p-value of a test; a dash for NaN."""
    if math.isnan(value):
        return NOTHING
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def interval(lower: float, upper: float) -> str:
    """Format two bounds, or one bound if the other is not finite; a dash if both are not finite."""
    if math.isfinite(lower) and math.isfinite(upper):
        return f"{number(lower)} to {number(upper)}"
    if math.isfinite(lower):
        return f"≥ {number(lower)}"
    return f"≤ {number(upper)}" if math.isfinite(upper) else NOTHING


def percent(fraction: float) -> str:
    """Format a measured fraction in per cent, never rounded up to 100 or down to 0; a dash for NaN.

    Fractions can exceed 1, for example the slip of a wheel that slides back.
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


def format_fraction(fraction: float) -> str:
    """Format a specified fraction in per cent, with all its digits."""
    return NOTHING if math.isnan(fraction) else f"{100.0 * fraction:.10g} %"


def count(quantity: int, noun: str) -> str:
    """Format a quantity with its noun: ``1 case``, ``24 cases``."""
    return f"{quantity:,} {noun}{'' if quantity == 1 else 's'}"


def plain_value(value: object) -> str:
    """Format a stored value, integers without a decimal point."""
    return str(int(value)) if isinstance(value, float | np.floating) and value.is_integer() else str(value)


@cache
def _read_notes() -> Mapping[str, Mapping[str, str]]:
    with (Path(__file__).parent / "templates" / "notes.toml").open("rb") as file:
        return tomllib.load(file)


def note_text(key: str, **values: object) -> str:
    """Return a text of `templates/notes.toml` by ``table.key``, with its values filled in."""
    table, name = key.split(".")
    return _read_notes()[table][name].format(**values)


def label(column: str) -> str:
    """Return the column in words, with its unit: ``velocity error (m/s)``."""
    unit = split_unit(column)[1]
    words = _read_notes()["labels"].get(column) or column_label(column)
    return f"{words} ({unit})" if unit else words


def magnitude_label(column: str) -> str:
    """Return the magnitude of a column in words, with its unit: ``|velocity error| (m/s)``."""
    unit = split_unit(column)[1]
    return f"|{label(column).removesuffix(f' ({unit})')}|{f' ({unit})' if unit else ''}"


def format_value(value: object) -> str:
    """Format a value of a record or row; whole floating-point numbers have no decimals."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={inner}" for name, inner in value.items())
    if isinstance(value, float | np.floating):
        return f"{value:.0f}" if float(value).is_integer() else number(float(value))
    return str(value)


#: Built-in populations in words; other populations are boolean columns.
_POPULATIONS = {"all": "all cases", "completed": "completed cases", "valid": "valid answers"}


def requirement_text(requirement: Any) -> str:
    """Describe the criterion of a requirement (of a campaign) or of a `Verdict` in words."""
    confidence = f"{format_fraction(requirement.confidence)} confidence"
    by_rate = requirement.decide_by == "estimate"
    decision = f"evaluated by the observed rate, with bounds at {confidence}" if by_rate else f"at {confidence}"
    cases = f"{format_fraction(requirement.probability)} of {population_text(requirement.population)}"
    return f"{_metric_text(requirement)} in at least {cases}, {decision}"


def _metric_text(requirement: Any) -> str:
    """Describe when a case meets a requirement; flags that no system declares are quoted by name."""
    columns = requirement.metric.split(" + ")
    if requirement.bound is None or math.isnan(requirement.bound):
        flag = find_column(requirement.metric)
        return f"'{requirement.metric}' is true" if flag is None or flag.type is not bool else flag.meaning
    texts = [
        column_label(column) if find_column(column) else f"magnitude of '{column_label(column)}'" for column in columns
    ]
    quantity = f"the {texts[0]}" if len(texts) == 1 else f"the sum of {_enumerate(texts)}"
    factor = "" if requirement.scale == 1.0 else f"{requirement.scale:g} times "
    return f"{factor}{quantity} is at most {requirement.bound:g} {split_unit(columns[-1])[1]}".rstrip()


def population_text(population: str) -> str:
    """Describe a population: ``valid answers``, ``cases with feasible overlap``; undeclared flags by name."""
    parts = population.split(" and ")
    base = next((_POPULATIONS[part] for part in parts if part in _POPULATIONS), "cases")
    flags = [part for part in parts if part and part not in _POPULATIONS]
    columns = {part: find_column(part) for part in flags}
    phrases = [column.population_of(part) for part, column in columns.items() if column is not None]
    unknown = [f"'{part}'" for part, column in columns.items() if column is None]
    # "with A, B, and C without D": phrases with the same preposition share it
    groups: dict[str, list[str]] = {}
    for phrase in phrases:
        preposition, _, rest = phrase.partition(" ")
        is_shared = preposition in ("with", "without")
        groups.setdefault(preposition if is_shared else phrase, []).append(rest if is_shared else "")
    texts = [
        f"{preposition} {_enumerate(rests, 'or' if preposition == 'without' else 'and')}".rstrip()
        for preposition, rests in sorted(groups.items(), key=lambda group: (group[0] != "with", group[0]))
    ]
    unknown_text = f" for which {_enumerate(unknown)} {'is' if len(unknown) == 1 else 'are'} true" if unknown else ""
    return f"{base} {' and '.join(texts)}".rstrip() + unknown_text


def _enumerate(texts: Sequence[str], conjunction: str = "and") -> str:
    """Join texts: ``a``, ``a and b``, ``a, b, and c``."""
    head, last = texts[:-1], "".join(texts[-1:])
    return f"{', '.join(head)}{',' if len(head) > 1 else ''} {conjunction} {last}" if head else last
