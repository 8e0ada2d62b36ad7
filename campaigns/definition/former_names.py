"""Campaigns that use former names of keys and columns, by the current names."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from pydantic import ValidationError

from marsyard.campaigns.definition.configuration import CampaignConfiguration, current_path
from marsyard.scenarios.interface import Scenario
from marsyard.scenarios.systems import UnknownScenarioError, row_columns, scenario
from marsyard.sim.parameters import RenamedWarning, current_column, current_key

_NAME = re.compile(r"[A-Za-z_]\w*(?:\.\w+)*")
#: Keys of a dispersion whose texts are no formulas.
_TEXTS = ("distribution", "source", "description", "unit")


def use_current_names(tables: Mapping[str, Any], selected: Scenario) -> dict[str, Any]:
    """Tables of a campaign file with the current names of dispersed parameters and columns; warns of former ones.

    Keys of the parameters themselves are renamed by their model.
    """
    path = partial(current_path, selected.parameters_type)
    column = _column_names(str(tables.get("scenario")))
    current = dict(tables)
    dispersions, correlations = tables.get("dispersions"), tables.get("correlations")
    if isinstance(dispersions, Mapping):
        current["dispersions"] = {
            path(name): {key: _replace(value, path) if key not in _TEXTS else value for key, value in stated.items()}
            if isinstance(stated, Mapping)
            else stated
            for name, stated in dispersions.items()
        }
    if isinstance(correlations, list):
        current["correlations"] = [_rename_entries(group, ("parameters",), path) for group in correlations]
    if isinstance(tables.get("requirements"), list):
        keys = ("metric", "population")
        current["requirements"] = [_rename_entries(stated, keys, column) for stated in tables["requirements"]]
    return current


def stored_configuration_now(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Configuration of a stored campaign by the current names, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RenamedWarning)
        stored = {current_key(key, CampaignConfiguration.model_fields): value for key, value in stored.items()}
        try:
            selected = scenario(str(stored.get("scenario")))
            current = use_current_names(stored, selected)
            parameters = selected.parameters_type.model_validate(stored.get("parameters", {}))
        except (UnknownScenarioError, ValidationError, ImportError):
            return dict(stored)
        return {**current, "parameters": parameters.model_dump(mode="json", round_trip=True, exclude_unset=True)}


def stored_columns_now(names: Iterable[str], scenario_name: str) -> dict[str, str]:
    """Stored columns with a former name, each with its current one; without a warning."""
    column = _column_names(scenario_name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RenamedWarning)
        return {name: current for name in names if (current := column(name)) != name}


def _column_names(scenario_name: str) -> Callable[[str], str]:
    try:
        columns = row_columns(scenario_name)
    except ValueError:
        columns = None
    if columns is None:
        return lambda name: name
    return lambda name: current_column(name, lambda one: columns.has_flag(one) or columns.has_number(one))


def _replace(value: Any, rename: Callable[[str], str]) -> Any:
    """Value with the names in its formulas, or in its list of names, renamed."""
    if isinstance(value, str):
        return _NAME.sub(lambda match: rename(match[0]), value)
    return [_replace(one, rename) for one in value] if isinstance(value, list) else value


def _rename_entries(stated: Any, keys: Iterable[str], rename: Callable[[str], str]) -> Any:
    if not isinstance(stated, Mapping):
        return stated
    return {key: _replace(value, rename) if key in keys else value for key, value in stated.items()}
