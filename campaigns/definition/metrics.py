"""Holds requirements against the columns that a scenario states, before anything is built or run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from marsyard.campaigns.definition.campaign import Campaign, value_at
from marsyard.campaigns.definition.configuration import POPULATIONS, Key
from marsyard.campaigns.definition.identity import chosen_algorithms
from marsyard.campaigns.errors import not_allowed
from marsyard.scenarios.estimators import labels
from marsyard.scenarios.interface import TakesParts
from marsyard.scenarios.parts.named import SCORE
from marsyard.scenarios.systems import StatedColumns, stated_columns

#: Columns that the engine writes.
_ENGINE_FLAGS, _ENGINE_NUMBERS = ("answered",), ("wall_time_s", "cpu_time_s")


def metric_problems(campaign: Campaign) -> list[tuple[Key, str]]:
    """What requirements ask for that the scenario's rows do not have: keys, and what is wrong and allowed there.

    Columns of a user's own scores are accepted by their prefix. Of a user's own scenario nothing is known: its first
    finished case is held against the requirements instead (`marsyard.campaigns.running.engine.check_metrics`).
    """
    try:
        columns = _columns(campaign)
    except ValueError as error:
        return [(("scenario",), str(error))]
    if columns is None:
        return []
    problems: list[tuple[Key, str]] = []
    others = labels(chosen_algorithms(campaign.configuration))[1:]
    for place, asked in enumerate(campaign.configuration.requirements):
        by_bound = asked.bound is not None
        known, has = (columns.numbers, columns.has_number) if by_bound else (columns.flags, columns.has_flag)
        kind = "column of numbers" if by_bound else "column of true and false"
        wrong = [name for name in asked.metric_columns if not has(_own_name(name, others))]
        problems += [(("requirements", place, "metric"), not_allowed(kind, name, known)) for name in wrong]
        unknown = [name for name in asked.population_columns if not columns.has_flag(_own_name(name, others))]
        allowed = (*POPULATIONS, *columns.flags)
        key = ("requirements", place, "population")
        problems += [(key, not_allowed("column of true and false", name, allowed)) for name in unknown]
    return problems


def _own_name(name: str, others: Iterable[str]) -> str:
    """A column's name without the label of a further algorithm before it."""
    return next((name.removeprefix(f"{one}.") for one in others if name.startswith(f"{one}.")), name)


def _columns(campaign: Campaign) -> StatedColumns | None:
    """The scenario's columns with those that the campaign's parameters add; None where they are not known."""
    configuration = campaign.configuration
    stated = stated_columns(configuration.scenario)
    if stated is None:
        return None
    own: list[str] = []
    keys = campaign.scenario.part_keys if isinstance(campaign.scenario, TakesParts) else {}
    for path in (path for path, kind in keys.items() if kind is SCORE):
        if path in configuration.dispersions:
            return None
        own += [f"{label}_*" for label in labels(_value(campaign, path))]
    named = [str(one["name"]) for one in _value(campaign, stated.named_flags)] if stated.named_flags else []
    return replace(
        stated,
        flags=(*stated.flags, *_ENGINE_FLAGS, *named, *own),
        numbers=(*stated.numbers, *_ENGINE_NUMBERS, *own),
    )


def _value(campaign: Campaign, path: str) -> Any:
    try:
        return value_at(campaign.configuration.parameters, path)
    except ValueError:
        return ()
