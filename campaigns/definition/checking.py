"""Holds what a campaign disperses against what its scenario takes, before any case is run."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign, leaves, value_at
from marsyard.campaigns.definition.configuration import Key, key_text, problems_of
from marsyard.campaigns.errors import not_allowed
from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.campaigns.sampling.levels import Choice, Fixed, Grid

#: Cases whose draws are tried together before a campaign starts; the reach of each dispersion is tried in full.
TRIED_CASES = 32
#: The most varying parameters in the formulas of one dispersion: both ends of each are tried with those of the others.
MOST_VARYING = 8


def sampling_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """All that is wrong with how a campaign's parameters are drawn: keys, and what is wrong and allowed there."""
    problems = [*campaign.configuration.sampling_problems(), *_name_problems(campaign)]
    return problems or _reach_problems(campaign) or _draw_problems(campaign)


def _name_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """Dispersions of what is no parameter, and formulas over what is none."""
    known = dict(leaves(campaign.configuration.parameters))
    dispersions = campaign.configuration.dispersions
    problems: list[tuple[Key, str]] = []
    for path, dispersion in dispersions.items():
        message = _path_problem(path, dispersion, known)
        if message:
            problems.append((("dispersions", path), message))
        for key, one in dispersion.formulas.items():
            wrong = (_formula_name_problem(name, dispersions, known) for name in one.names)
            problems += [(("dispersions", path, *key), message) for message in wrong if message]
    if not problems:
        try:
            campaign.order  # noqa: B018  (works it out)
        except ValueError as error:
            problems.append((("dispersions",), str(error)))
    return problems


def _path_problem(path: str, dispersion: Dispersion, known: Mapping[str, Any]) -> str:
    """What is wrong with what a dispersion is of; empty if nothing is."""
    if path in known:
        return ""
    if not any(leaf.startswith(f"{path}.") for leaf in known):
        return not_allowed("parameter", path, known, _beside(path, known))
    if isinstance(dispersion, Choice | Fixed) or (isinstance(dispersion, Grid) and dispersion.values is not None):
        return ""
    return "is a table; disperse one of its values, or choose between tables"


def _formula_name_problem(name: str, dispersions: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    """What is wrong with a name in a formula; empty if nothing is."""
    inside = next((path for path in dispersions if name.startswith(f"{path}.")), None)
    if inside is not None:
        return f"'{name}' lies within '{inside}', which is dispersed as a whole"
    return "" if name in known else not_allowed("parameter", name, known, _beside(name, known))


def _beside(path: str, known: Iterable[str]) -> list[str]:
    """The parameters in the innermost table on a path that there is, further tables in it by their names alone."""
    names = list(known)
    table = path
    while table:
        table = table.rpartition(".")[0]
        prefix = f"{table}." if table else ""
        inside = [name.removeprefix(prefix).partition(".") for name in names if name.startswith(prefix)]
        if inside:
            return list(dict.fromkeys(f"{prefix}{head}{'.*' if rest else ''}" for head, rest, _ in inside))
    return names


def _reach_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """Draws that a parameter refuses, and formulas that have no value, at the ends of what can be drawn."""
    problems: list[tuple[Key, str]] = []
    reach: dict[str, list[Any]] = {}
    for path in campaign.order:
        if any(name in campaign.marginals and name not in reach for name in campaign.marginals[path].names):
            continue  # what it depends on is wrong already
        found, message = _reach(campaign, path, reach)
        if message:
            problems.append((("dispersions", path), message))
        else:
            reach[path] = _ends(found)
    return problems


def _reach(campaign: Campaign, path: str, reach: Mapping[str, list[Any]]) -> tuple[list[Any], str]:
    """Values that stand for all that a dispersion can draw; and what is wrong with one of them, empty if nothing is."""
    found: list[Any] = []
    for given, values in _met(campaign, path, reach):
        if isinstance(given, str):
            return found, given
        try:
            extremes = given.extremes()
        except ValueError as error:
            return found, _said(error)
        for value in extremes:
            refused = _refusal(campaign, {**values, path: value})
            if refused:
                where = "".join(f" where {name} = {one}" for name, one in values.items())
                text = f"{given.describe()} reaches {value!r}{where}, which the parameter does not take: {refused}"
                return found, text
            found.append(value)
    return found, ""


def _met(
    campaign: Campaign, path: str, reach: Mapping[str, list[Any]]
) -> Iterator[tuple[Dispersion | str, dict[str, Any]]]:
    """The distributions that a dispersion can become, with the drawn values that do it; a text where it is none."""
    dispersion = campaign.marginals[path]
    varying = [name for name in dispersion.names if name in reach]
    if len(varying) > MOST_VARYING:
        yield f"its formulas name {len(varying)} parameters that vary; allowed: up to {MOST_VARYING}", {}
        return
    fixed = {
        name: value_at(campaign.configuration.parameters, name) for name in dispersion.names if name not in varying
    }
    for corner in itertools.product(*(reach[name] for name in varying)):
        values = dict(zip(varying, corner, strict=True))
        try:
            yield dispersion.given({**fixed, **values}), values
        except ValueError as error:
            yield _said(error), values


def _ends(values: list[Any]) -> list[Any]:
    """The least and the greatest of numbers; other values as they are."""
    numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
    return list(dict.fromkeys((min(numbers), max(numbers)))) if len(numbers) == len(values) else values


def _draw_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """The first case whose draws are refused together, if there is one early on."""
    if not campaign.configuration.dispersions:
        return []
    for case in range(min(campaign.configuration.cases, TRIED_CASES)):
        try:
            refused = _refusal(campaign, campaign.draws(case))
        except ValueError as error:
            refused = _said(error)
        if refused:
            return [(("dispersions",), f"the draws of case {case} are refused together: {refused}")]
    return []


def _refusal(campaign: Campaign, values: Mapping[str, Any]) -> str:
    """Why the scenario refuses its parameters with these values; empty where it takes them."""
    endless = [path for path, value in values.items() if isinstance(value, float) and not math.isfinite(value)]
    if endless:
        return f"{endless[0]} must be finite"
    try:
        campaign.with_values(values)
    except ValidationError as error:
        found = problems_of(error, campaign.scenario.parameters_type)
        return "; ".join(f"{key_text(key)}: {message}" if key else message for key, message in found)
    return ""


def _said(error: ValueError) -> str:
    """What an error says, without pydantic's frame."""
    if isinstance(error, ValidationError):
        return "; ".join(str(detail["msg"]).removeprefix("Value error, ") for detail in error.errors())
    return str(error)
