"""Base class and field types of all user parameters, and replacement of deprecated names of keys, columns, options."""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator


class DeprecatedNameWarning(FutureWarning):
    """A deprecated name was used."""


@cache
def _read_names(section: str) -> Mapping[str, str]:
    """Read the current names by deprecated name from a section: keys, columns, options, values or streams."""
    with Path(__file__).with_name("renamed.toml").open("rb") as file:
        names: dict[str, str] = tomllib.load(file)[section]
    return names


def current_key(name: str, valid_keys: Collection[str], input_keys: Collection[str] = ()) -> str:
    """Return the current name of a key; the name itself if it is valid, or if the input contains both names."""
    current = _read_names("keys").get(name)
    if current is None or name in valid_keys or current not in valid_keys or current in input_keys:
        return name
    return warn_deprecated(name, current)


def current_column(name: str, exists: Callable[[str], bool]) -> str:
    """Return the current name of a column; the name may have the prefix "<algorithm>." of a comparison."""
    algorithm, dot, column = name.rpartition(".")
    for deprecated, current in _read_names("columns").items():
        match = re.fullmatch(deprecated.replace("*", r"(\d+)"), column)
        current_name = current.replace("*", match[1]) if match and match.groups() else current
        if match and exists(current_name):
            return algorithm + dot + warn_deprecated(column, current_name)
    return name


def current_fault(name: str) -> str:
    """Return the current name of a fault that a stored row contains; faults are keys of parameters."""
    return _read_names("keys").get(name, name)


def current_options(arguments: Sequence[str]) -> list[str]:
    """Replace deprecated names of options in the arguments of a command line."""
    return [warn_deprecated(argument, _read_names("options").get(argument, argument)) for argument in arguments]


class Choice(Enum):
    """Base class of options with named values in campaign files; deprecated values are accepted."""

    @classmethod
    def _missing_(cls, value: object) -> Choice | None:
        current = _read_names("values").get(str(value))
        return None if current is None else cls(warn_deprecated(str(value), current))


def stream_name(path: str) -> str:
    """Return the random stream name of a dispersed parameter; a renamed parameter uses the stream of its old name."""
    return _read_names("streams").get(path, path)


def warn_deprecated(name: str, current: str) -> str:
    """Warn that a name is deprecated if it differs from the current name; return the current name."""
    if name != current:
        warnings.warn(f"'{name}' is now '{current}'; the former name is accepted until 0.2", DeprecatedNameWarning, 3)
    return current


Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


def bounded_field(low: float, high: float, description: str) -> Any:
    """Create a field of a number from `low` to `high`, both included."""
    return Field(ge=low, le=high, description=description)


class Parameters(BaseModel):
    """Base class of user parameters: unknown keys are errors, deprecated keys are accepted, objects are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _rename_deprecated_keys(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or cls.model_fields.keys() >= values.keys():
            return values
        return {
            current_key(name, cls.model_fields, values) if isinstance(name, str) else name: value
            for name, value in values.items()
        }


def merge_settings(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge changes into nested settings: tables are merged, other values replaced."""
    settings = dict(base)
    for key, value in changes.items():
        current = settings.get(key)
        if isinstance(current, Mapping) and isinstance(value, Mapping):
            value = merge_settings(current, value)
        settings[key] = value
    return settings
