"""Requirements and their populations in words."""

import math
from collections.abc import Sequence
from typing import Any

from marsyard.reports.wording import format_fraction
from marsyard.scenarios.columns import split_unit
from marsyard.scenarios.declared_columns import find_column
from marsyard.scenarios.declared_columns import label as column_label

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
