"""Base class and common field types of all parameters, and former names of keys, columns and options."""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator


class RenamedWarning(FutureWarning):
    """A former name was given."""


@cache
def _names(section: str) -> Mapping[str, str]:
    with Path(__file__).with_name("renamed.toml").open("rb") as file:
        names: dict[str, str] = tomllib.load(file)[section]
    return names


def current_key(name: str, known: Collection[str], given: Collection[str] = ()) -> str:
    """Current name of a key in a table with `known` keys; the name itself if it is known, or both are given."""
    current = _names("keys").get(name)
    if current is None or name in known or current not in known or current in given:
        return name
    return _warn_former(name, current)


def current_column(name: str, exists: Callable[[str], bool]) -> str:
    """Current name of a column, given which columns exist; it may follow a compared algorithm's name and a dot."""
    algorithm, dot, column = name.rpartition(".")
    for former, current in _names("columns").items():
        match = re.fullmatch(former.replace("*", r"(\d+)"), column)
        renamed = current.replace("*", match[1]) if match and match.groups() else current
        if match and exists(renamed):
            return algorithm + dot + _warn_former(column, renamed)
    return name


def current_options(words: Sequence[str]) -> list[str]:
    """Words of a command line with the current names of options."""
    return [_warn_former(word, _names("options").get(word, word)) for word in words]


def stream_name(path: str) -> str:
    """Name of the random stream of a dispersion."""
    return _names("streams").get(path, path)


def _warn_former(former: str, current: str) -> str:
    if former != current:
        warnings.warn(f"'{former}' is now '{current}'; the former name is accepted until 0.2", RenamedWarning, 3)
    return current


Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


def bounded_field(low: float, high: float, description: str) -> Any:
    """Field of a number from `low` to `high`, both included."""
    return Field(ge=low, le=high, description=description)


class Parameters(BaseModel):
    """User parameters: unknown keys are errors, validated objects are immutable. Former names of keys are accepted."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _rename_former_keys(cls, given: Any) -> Any:
        if not isinstance(given, Mapping) or cls.model_fields.keys() >= given.keys():
            return given
        return {
            current_key(name, cls.model_fields, given) if isinstance(name, str) else name: value
            for name, value in given.items()
        }


def merge_settings(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge changes into nested settings: tables are merged, other values replaced."""
    merged = dict(base)
    for key, value in changes.items():
        below = merged.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = merge_settings(below, value)
        merged[key] = value
    return merged
