"""Checks of a campaign against its scenario before any case runs: dispersions, and columns of requirements."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.campaign import Campaign, leaves, value_at
from marsyard.campaigns.definition.configuration import POPULATIONS, Key, key_text, problems_of
from marsyard.campaigns.definition.identity import selected_algorithms
from marsyard.campaigns.errors import not_allowed
from marsyard.campaigns.sampling.dispersion import Dispersion
from marsyard.campaigns.sampling.dispersions import Choice, Fixed, Grid
from marsyard.scenarios.estimators import labels
from marsyard.scenarios.interface import HasParts
from marsyard.scenarios.parts.named import SCORE
from marsyard.scenarios.systems import RowColumns, row_columns

#: Cases whose draws are validated before a campaign starts; the range of each dispersion is checked in full.
_CHECKED_CASES = 32
#: Maximum number of dispersed parameters in the formulas of one dispersion: all combinations of extremes are checked.
_MAX_VARYING = 8
#: Columns that the engine writes.
_ENGINE_FLAGS, _ENGINE_NUMBERS = ("answered",), ("wall_time_s", "cpu_time_s")


def sampling_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """Problems of the campaign's dispersions: keys, and messages with the allowed values."""
    problems = [*campaign.configuration.sampling_problems(), *_name_problems(campaign)]
    return problems or _range_problems(campaign) or _draw_problems(campaign)


def _name_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """Unknown parameters that dispersions or formulas name, and cycles of formulas."""
    parameters = dict(leaves(campaign.configuration.parameters))
    dispersions = campaign.configuration.dispersions
    problems: list[tuple[Key, str]] = []
    for path, dispersion in dispersions.items():
        message = _path_problem(path, dispersion, parameters)
        if message:
            problems.append((("dispersions", path), message))
        for key, formula in dispersion.formulas.items():
            messages = (_formula_name_problem(name, dispersions, parameters) for name in formula.names)
            problems += [(("dispersions", path, *key), message) for message in messages if message]
    if not problems:
        try:
            campaign.order  # noqa: B018  (evaluates the property)
        except ValueError as error:
            problems.append((("dispersions",), str(error)))
    return problems


def _path_problem(path: str, dispersion: Dispersion, parameters: Mapping[str, Any]) -> str:
    if path in parameters:
        return ""
    if not any(leaf.startswith(f"{path}.") for leaf in parameters):
        return not_allowed("parameter", path, parameters, _siblings(path, parameters))
    if isinstance(dispersion, Choice | Fixed) or (isinstance(dispersion, Grid) and dispersion.values is not None):
        return ""
    return "is a table; disperse one of its values, or choose between tables"


def _formula_name_problem(name: str, dispersions: Mapping[str, Any], parameters: Mapping[str, Any]) -> str:
    parent = next((path for path in dispersions if name.startswith(f"{path}.")), None)
    if parent is not None:
        return f"'{name}' lies within '{parent}', which is dispersed as a whole"
    return "" if name in parameters else not_allowed("parameter", name, parameters, _siblings(name, parameters))


def _siblings(path: str, parameters: Iterable[str]) -> list[str]:
    """Parameters in the innermost existing table of a path; its subtables by name only."""
    names = list(parameters)
    table = path
    while table:
        table = table.rpartition(".")[0]
        prefix = f"{table}." if table else ""
        inside = [name.removeprefix(prefix).partition(".") for name in names if name.startswith(prefix)]
        if inside:
            return list(dict.fromkeys(f"{prefix}{head}{'.*' if rest else ''}" for head, rest, _ in inside))
    return names


def _range_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """Values that a parameter refuses, and formulas without a value, at the extremes of the dispersions."""
    problems: list[tuple[Key, str]] = []
    extremes: dict[str, list[Any]] = {}
    for path in campaign.order:
        if any(name in campaign.marginals and name not in extremes for name in campaign.marginals[path].names):
            continue  # a dispersion that it depends on has a problem already
        values, message = _check_extremes(campaign, path, extremes)
        if message:
            problems.append((("dispersions", path), message))
            continue
        numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
        all_numbers = len(numbers) == len(values)
        extremes[path] = list(dict.fromkeys((min(numbers), max(numbers)))) if all_numbers else values
    return problems


def _check_extremes(campaign: Campaign, path: str, extremes: Mapping[str, list[Any]]) -> tuple[list[Any], str]:
    """Extreme values of a dispersion, and the problem of one of them; empty if there is none."""
    checked: list[Any] = []
    for given, values in _possible_distributions(campaign, path, extremes):
        if isinstance(given, str):
            return checked, given
        try:
            candidates = given.extremes()
        except ValueError as error:
            return checked, _plain_message(error)
        for value in candidates:
            refused = _refusal(campaign, {**values, path: value})
            if refused:
                where = "".join(f" where {name} = {one}" for name, one in values.items())
                text = f"{given.describe()} reaches {value!r}{where}, which the parameter does not take: {refused}"
                return checked, text
            checked.append(value)
    return checked, ""


def _possible_distributions(
    campaign: Campaign, path: str, extremes: Mapping[str, list[Any]]
) -> Iterator[tuple[Dispersion | str, dict[str, Any]]]:
    """Distributions at all combinations of the extremes that formulas name; a text for an invalid one."""
    dispersion, parameters = campaign.marginals[path], campaign.configuration.parameters
    varying = [name for name in dispersion.names if name in extremes]
    if len(varying) > _MAX_VARYING:
        yield f"its formulas name {len(varying)} parameters that vary; allowed: up to {_MAX_VARYING}", {}
        return
    fixed = {name: value_at(parameters, name) for name in dispersion.names if name not in varying}
    for corner in itertools.product(*(extremes[name] for name in varying)):
        values = dict(zip(varying, corner, strict=True))
        try:
            yield dispersion.given({**fixed, **values}), values
        except ValueError as error:
            yield _plain_message(error), values


def _draw_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """First of the checked cases whose drawn values the scenario refuses."""
    if not campaign.configuration.dispersions:
        return []
    for case in range(min(campaign.configuration.cases, _CHECKED_CASES)):
        try:
            refused = _refusal(campaign, campaign.draws(case))
        except ValueError as error:
            refused = _plain_message(error)
        if refused:
            return [(("dispersions",), f"the draws of case {case} are refused together: {refused}")]
    return []


def _refusal(campaign: Campaign, values: Mapping[str, Any]) -> str:
    """Reason why the scenario refuses its parameters with these values; empty where it accepts them."""
    infinite = [path for path, value in values.items() if isinstance(value, float) and not math.isfinite(value)]
    if infinite:
        return f"{infinite[0]} must be finite"
    try:
        campaign.with_values(values)
    except ValidationError as error:
        problems = problems_of(error, campaign.scenario.parameters_type)
        return "; ".join(f"{key_text(key)}: {message}" if key else message for key, message in problems)
    return ""


def _plain_message(error: ValueError) -> str:
    """Message of an error without pydantic's frame."""
    if isinstance(error, ValidationError):
        return "; ".join(str(detail["msg"]).removeprefix("Value error, ") for detail in error.errors())
    return str(error)


def metric_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """Columns that requirements name and the scenario does not state: keys, and messages with the allowed columns.

    Columns of custom scores are accepted by their prefix. Columns of a custom scenario are unknown here: its first
    finished case is checked instead (`marsyard.campaigns.running.engine.check_metrics`).
    """
    try:
        columns = _stated_columns(campaign)
    except ValueError as error:
        return [(("scenario",), str(error))]
    if columns is None:
        return []
    problems: list[tuple[Key, str]] = []
    compared = labels(selected_algorithms(campaign.configuration))[1:]

    def unlabelled(name: str) -> str:
        return next((name.removeprefix(f"{one}.") for one in compared if name.startswith(f"{one}.")), name)

    for index, asked in enumerate(campaign.configuration.requirements):
        by_bound = asked.bound is not None
        allowed, has = (columns.numbers, columns.has_number) if by_bound else (columns.flags, columns.has_flag)
        kind = "column of numbers" if by_bound else "column of true and false"
        unknown = [name for name in asked.metric_columns if not has(unlabelled(name))]
        problems += [(("requirements", index, "metric"), not_allowed(kind, name, allowed)) for name in unknown]
        unknown = [name for name in asked.population_columns if not columns.has_flag(unlabelled(name))]
        flags = (*POPULATIONS, *columns.flags)
        key = ("requirements", index, "population")
        problems += [(key, not_allowed("column of true and false", name, flags)) for name in unknown]
    return problems


def _stated_columns(campaign: Campaign) -> RowColumns | None:
    """Columns of the scenario and of the campaign's parameters; None where they are not known."""
    configuration = campaign.configuration
    stated = row_columns(configuration.scenario)
    if stated is None:
        return None
    scores: list[str] = []
    keys = campaign.scenario.part_keys if isinstance(campaign.scenario, HasParts) else {}
    for path in (path for path, kind in keys.items() if kind is SCORE):
        if path in configuration.dispersions:
            return None
        scores += [f"{label}_*" for label in labels(_value(campaign, path))]
    named = [str(one["name"]) for one in _value(campaign, stated.named_flags)] if stated.named_flags else []
    return replace(
        stated,
        flags=(*stated.flags, *_ENGINE_FLAGS, *named, *scores),
        numbers=(*stated.numbers, *_ENGINE_NUMBERS, *scores),
    )


def _value(campaign: Campaign, path: str) -> Any:
    try:
        return value_at(campaign.configuration.parameters, path)
    except ValueError:
        return ()
