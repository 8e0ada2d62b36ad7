"""Base class and field types of all user parameters, and replacement of deprecated names of keys, columns, options."""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator


class DeprecatedNameWarning(FutureWarning):
    """A deprecated name was used."""


@cache
def _read_section(section: str) -> Mapping[str, Any]:
    """Read a section of the deprecated names: keys, columns, products, options, values or streams."""
    with Path(__file__).with_name("renamed.toml").open("rb") as file:
        names: dict[str, Any] = tomllib.load(file)[section]
    return names


def _read_names(section: str) -> Mapping[str, str]:
    """Read the current names by deprecated name from a section in which each name has one current name."""
    return _read_section(section)


def current_key(name: str, valid_keys: Collection[str], input_keys: Collection[str] = ()) -> str:
    """Return the current name of a key; the name itself if it is valid, or if the input contains both names."""
    if name in valid_keys:
        return name
    names = _read_section("keys").get(name, [])
    current = next((key for key in ([names] if isinstance(names, str) else names) if key in valid_keys), None)
    if current is None or current in input_keys:
        return name
    return warn_deprecated(name, current)


def current_column(name: str, exists: Callable[[str], bool]) -> str:
    """Return the current name of a column; the name may have the prefix "<algorithm>." of a comparison."""
    algorithm, dot, column = name.rpartition(".")
    for current in _match_names("columns", column):
        if exists(current):
            return algorithm + dot + warn_deprecated(column, current)
    return name


def rename_products(products: Mapping[str, Any]) -> dict[str, Any]:
    """Replace deprecated names of a stored case's products, without a warning."""
    current = {name: next(_match_names("products", name), name) for name in products}
    return {name if current[name] in products else current[name]: value for name, value in products.items()}


def _match_names(section: str, name: str) -> Iterator[str]:
    """Yield the current names of a deprecated name; "*" in the section stands for a number."""
    for deprecated, current in _read_names(section).items():
        if match := re.fullmatch(deprecated.replace("*", r"(\d+)"), name):
            yield current.replace("*", match[1]) if match.groups() else current


def current_fault(name: str) -> str:
    """Return the current name of a fault that a stored row contains; faults are keys of parameters."""
    names = _read_section("keys").get(name, name)
    return names if isinstance(names, str) else names[0]


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
    """Return the current name; warn if it differs from the used name."""
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
        """Replace deprecated keys, and complete tables whose default is a preset."""
        if not isinstance(values, Mapping):
            return values
        if not cls.model_fields.keys() >= values.keys():
            values = _rename_keys(values, cls.model_fields)
        presets = {
            name: _complete_table(field.default, values[name])
            for name, field in cls.model_fields.items()
            if isinstance(field.default, BaseModel) and isinstance(values.get(name), Mapping)
        }
        values = {**values, **presets} if presets else values
        # pydantic calls no validator of this class for tables that are data classes, such as options of algorithms
        options = {
            name: _rename_keys(value, field_names(cls.model_fields[name].annotation))
            for name, value in values.items()
            if isinstance(value, Mapping) and name in cls.model_fields
        }
        return {**values, **options} if options else values


def _complete_table(preset: BaseModel, table: Mapping[Any, Any]) -> Mapping[Any, Any]:
    """Complete a table by the values of the field's default, if these are not the defaults of their class.

    A file that changes one value of a preset, such as the noise of an instrument, then keeps the other values. A table
    with keys of another class, such as a custom instrument, is returned unchanged.
    """
    kind = type(preset)
    table = _rename_keys(table, kind.model_fields)
    try:
        is_preset = preset != kind()
    except ValidationError:
        is_preset = True
    if not is_preset or not table.keys() <= kind.model_fields.keys():
        return table
    values = {name: getattr(preset, name) for name in kind.model_fields}
    for name, value in table.items():
        is_table = isinstance(value, Mapping) and isinstance(values[name], BaseModel)
        values[name] = _complete_table(values[name], value) if is_table else value
    return values


def field_names(kind: Any) -> set[str]:
    """Return the field names of a data class; empty for any other type."""
    return {field.name for field in fields(kind)} if is_dataclass(kind) else set()


def _rename_keys(values: Mapping[Any, Any], valid_keys: Collection[str]) -> dict[Any, Any]:
    """Replace deprecated keys of a table by keys in `valid_keys`, with warnings."""
    return {
        current_key(name, valid_keys, values) if isinstance(name, str) else name: value
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
